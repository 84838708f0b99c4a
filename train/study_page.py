"""What a study found, as a page of Markdown and as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from restock.train.compare import Comparison
from restock.train.study import Plan


def findings(plan: Plan, comparisons: Sequence[Comparison]) -> dict[str, Any]:
    """The study and every comparison, as JSON values."""
    base = plan.study.base
    others = [arm for arm in plan.study.arms if arm.name != base.name]
    return {
        "doc": plan.study.doc,
        "treatment": plan.study.treatment,
        "baseline": base.name,
        "seeds": list(plan.study.seeds),
        "runs": {
            arm.name: [str(job.path) for job in plan.jobs if job.arm.name == arm.name]
            for arm in plan.study.arms
        },
        "comparisons": [
            {"arm": arm.name, **comparison.as_json()}
            for arm, comparison in zip(others, comparisons, strict=True)
        ],
    }


def as_markdown(found: dict[str, Any]) -> str:
    """The same for people."""
    lines = [f"# Study: {found['doc'] or ', '.join(found['runs'])}", ""]
    lines += [
        f"Treatment: {found['treatment']}. Every arm against **{found['baseline']}**,"
        f" {len(found['seeds'])} seeds each, on the same episodes. Intervals are 95 %, over seeds"
        " and episodes.",
    ]
    for comparison in found["comparisons"]:
        lines += ["", f"## {comparison['arm']}", ""]
        if found["treatment"] == "method":
            lines += [_held(comparison), ""]
        if comparison["verdict"] != "comparable":
            why = ", ".join(comparison["refused"]) or ", ".join(
                dict.fromkeys(
                    check["name"]
                    for check in comparison["checks"]
                    if check["verdict"] == comparison["verdict"]
                )
            )
            lines += [f"Not compared: {comparison['verdict']} in {why}."]
            continue
        lines += [
            f"| perturbation | condition | {found['baseline']} | {comparison['arm']} | difference |"
            " P(better) |",
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


def _held(comparison: dict[str, Any]) -> str:
    """What a comparison of methods holds fixed, and what it does not."""
    kinds = ("feed", "target", "algorithm")
    differ = {
        kind: [d["setting"] for d in comparison["differences"] if d["kind"] == kind]
        for kind in kinds
    }
    words = {"feed": "replay", "target": "the target rule", "algorithm": "the algorithm"}
    told = [f"{words[kind]} ({', '.join(names)})" for kind, names in differ.items() if names]
    same = [words[kind] for kind in kinds[:2] if not differ[kind]]
    fixed = ", ".join(["the environment and its conditions", "environment steps", *same])
    return f"Held fixed: {fixed} and the evaluation. Not held: {'; '.join(told) or 'nothing'}."


__all__ = ["as_markdown", "findings"]
