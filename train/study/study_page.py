"""What a study found, as a page of Markdown and as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from restock.train.comparison.compare import Comparison
from restock.train.study.study import Plan


def findings(plan: Plan, comparisons: Sequence[Comparison]) -> dict[str, Any]:
    """The study and every comparison, as JSON values."""
    return {
        "doc": plan.study.doc,
        "seeds": list(plan.study.seeds),
        "runs": {arm.name: [str(path) for path in plan.runs(arm)] for arm in plan.study.arms},
        "comparisons": [
            {"arm": pair.arm.name, "baseline": pair.baseline.name, **comparison.as_json()}
            for pair, comparison in zip(plan.study.pairs, comparisons, strict=True)
        ],
    }


def as_markdown(found: dict[str, Any]) -> str:
    """The same for people."""
    lines = [f"# Study: {', '.join(found['runs'])}", ""]
    lines += [found["doc"], ""] if found["doc"] else []
    lines += [
        f"Seeds of each arm: {', '.join(map(str, found['seeds']))}. All are evaluated on the same"
        " episodes. Intervals are 95 %, over seeds and episodes; bold where they exclude 0.",
    ]
    for comparison in found["comparisons"]:
        baseline, treatment = comparison["baseline"], comparison["treatment"]
        lines += ["", f"## {comparison['arm']} against {baseline}", ""]
        lines += [f"Compared: the {treatment}.", ""]
        if treatment == "method":
            lines += [_held(comparison), ""]
        if comparison["verdict"] != "comparable":
            lines += [_refusal(comparison)]
            continue
        lines += [
            f"| perturbation | condition | {baseline} | {comparison['arm']} | difference |"
            " P(higher return) |",
            "| --- | --- | --- | --- | --- | --- |",
        ]
        for row in comparison["outcomes"]:
            low, high = row["difference_low"], row["difference_high"]
            apart = "**" if low > 0 or high < 0 else ""
            lines.append(
                f"| {row['perturbation']} | {row['condition']} | {row['success'][0]:.2f}"
                f" | {row['success'][1]:.2f} | {apart}{row['difference']:+.2f}"
                f" [{low:+.2f}, {high:+.2f}]{apart} | {row['improvement']:.2f} |"
            )
    return "\n".join(lines) + "\n"


def _refusal(comparison: dict[str, Any]) -> str:
    """Why the gate let no outcomes through."""
    if comparison["refused"]:
        return (
            f"Not compared: they differ in {', '.join(comparison['refused'])}, which"
            f' treatment = "{comparison["treatment"]}" does not allow.'
        )
    verdict = comparison["verdict"]
    names = [check["name"] for check in comparison["checks"] if check["verdict"] == verdict]
    return f"Not compared: {verdict} in {', '.join(dict.fromkeys(names))}."


def _held(comparison: dict[str, Any]) -> str:
    """What a comparison of methods holds fixed, and what it does not."""
    kinds = ("feed", "target", "algorithm")
    differ: dict[str, list[str]] = {kind: [] for kind in kinds}
    for difference in comparison["differences"]:
        name = difference["setting"]
        if name.startswith("library.arguments."):  # its own: one name for all of them
            name = "library.arguments"
        if name not in differ.get(difference["kind"], [name]):
            differ[difference["kind"]].append(name)
    words = {"feed": "replay", "target": "the target rule", "algorithm": "the algorithm"}
    told = [f"{words[kind]} ({', '.join(names)})" for kind, names in differ.items() if names]
    same = [words[kind] for kind in kinds[:2] if not differ[kind]]
    fixed = ", ".join(["the environment and its conditions", "environment steps", *same])
    return f"Held fixed: {fixed} and the evaluation. Not held: {'; '.join(told) or 'nothing'}."


__all__ = ["as_markdown", "findings"]
