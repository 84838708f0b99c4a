"""The page that a study ends in: its contrasts, what each arm came to, and each comparison."""

from __future__ import annotations

from typing import Any

from restock.stats import MIN_PAIRS, interval_text, no_interval_text, which_adjusted
from restock.train.comparison.compare import MIN_EPISODES, MIN_RUNS
from restock.train.study.findings import SAFETY

FEW_SETTINGS = 4  # that differ, to be named in a line
_FORMS = {"bumps_per_km": ".1f", "closest_person_m": ".2f", "time_lost_s": "+.1f"}


def as_markdown(study: dict[str, Any]) -> str:
    """`findings` for people."""
    lines = [f"# Study: {', '.join(study['runs'])}", ""]
    lines += [study["doc"], ""] if study["doc"] else []
    lines += [
        f"Seeds of each arm: {', '.join(map(str, study['seeds']))}. All are evaluated on the same"
        " episodes."
    ]
    if study.get("power"):
        lines += ["", power_sentence(study["power"])]
    lines += _contrasts(study.get("contrasts", []), study.get("rare", []))
    lines += _arms(study.get("arms", []))
    for comparison in study["comparisons"]:
        lines += _comparison(comparison)
    return "\n".join(lines) + "\n"


def power_sentence(power: dict[str, Any]) -> str:
    """What the study can see of its primary contrast."""
    text = (
        f"Power: {power['measure']} of {power['arm']} against {power['baseline']}, {power['seeds']}"
        f" seeds, paired differences of standard deviation {power['sd']:.3f}"
        f" ({power['spread_from']})."
    )
    if power["least_effect"] is None:
        text += f" Below {MIN_PAIRS} seeds there is no interval, so no difference is found."
    else:
        text += (
            f" A true difference of {power['least_effect']:.3f} is found with a probability of .8."
        )
    if power["effect"] is not None:
        text += f" One of {power['effect']:g} is found with {power['power']:.2f}"
        needed = power["seeds_needed"]
        text += f"; {needed} seeds find it with .8." if needed else "."
    return text


def _contrasts(contrasts: list[dict[str, Any]], rare: list[str]) -> list[str]:
    if not contrasts:
        return []
    lines = [
        *("", "## Contrasts", ""),
        "Paired by seed, with Student's t interval of 95 % over seeds. `auc` is the area under the"
        " curve of success over environment steps, `success` the kept policy's at the end, `rare`"
        f" the mean of {', '.join(rare).replace('_', ' ')}. "
        + which_adjusted(any(row["primary"] for row in contrasts)),
        "",
        "| | measure | arm | baseline | difference | seeds | p | p adjusted |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in contrasts:
        name = f"{row['arm']} against {row['baseline']}"
        p = row["p"] if row["primary"] else row["p_holm"]
        apart = "**" if p is not None and p < 0.05 else ""
        difference = interval_text(row["difference"], row["low"], row["high"], "+.3f")
        why = no_interval_text(row.get("no_interval"))
        lines.append(
            f"| {f'**primary**: {name}' if row['primary'] else name} | {row['measure']}"
            f" | {row['arm_mean']:.3f} | {row['baseline_mean']:.3f}"
            f" | {apart}{difference}{apart}{why} | {row['pairs']}"
            f" | {_p(row['p'])} | {'' if row['primary'] else _p(row['p_holm'])} |"
        )
    return lines


def _p(value: float | None) -> str:
    return "" if value is None else "< .001" if value < 0.001 else f"{value:.3f}"


def _arms(arms: list[dict[str, Any]]) -> list[str]:
    """Success by cell, safety and return side by side."""
    if not arms:
        return []
    cells = list(dict.fromkeys(name for row in arms for name in row if name.startswith("success ")))
    cells.sort(key=lambda name: name != "success nominal")
    names = [*cells, *SAFETY]
    heads = [name.removeprefix("success ").replace("_", " ") for name in names]
    lines = [
        *("", "## Success and safety at the end", ""),
        "Of the kept policies on the unperturbed episodes, means with 95 % over seeds; from bumps"
        " on, in the rare missions. Time is lost against the planner, where both arrived. From"
        f" fewer than {MIN_PAIRS} seeds, and where all came to the same, there are values alone.",
        "",
        f"| | {' | '.join(heads)} |",
        f"| --- |{' --- |' * len(names)}",
    ]
    for row in arms:
        values = [_over_seeds(row.get(name), _FORMS.get(name, ".2f")) for name in names]
        lines.append(f"| {row['arm']} | {' | '.join(values)} |")
    return lines


def _over_seeds(value: list[float | None] | None, form: str) -> str:
    mean, low, high = value or (None, None, None)
    return "" if mean is None else interval_text(mean, low, high, form)


def _comparison(comparison: dict[str, Any]) -> list[str]:
    baseline, treatment = comparison["baseline"], comparison["treatment"]
    lines = [
        "",
        f"## {comparison['arm']} against {baseline}",
        "",
        f"Treatment: {treatment}{_differing(comparison)}.",
        "",
    ]
    if treatment == "method":
        lines += [_held(comparison), ""]
    if comparison["verdict"] != "comparable":
        return [*lines, f"Not compared: {comparison['why']}."]
    lines += [
        "Intervals are 95 %, over seeds and episodes; bold where they exclude 0. From fewer than"
        f" {MIN_RUNS} seeds or {MIN_EPISODES} episodes, and where nothing varies, there are"
        " values alone.",
        "",
        f"| perturbation | condition | {baseline} | {comparison['arm']} | difference |"
        " P(higher return) |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for row in comparison["outcomes"]:
        low, high = row["difference_low"], row["difference_high"]
        known = low is not None
        apart = "**" if known and (low > 0 or high < 0) else ""
        interval = f" [{low:+.2f}, {high:+.2f}]" if known else ""
        lines.append(
            f"| {row['perturbation']} | {row['condition'].replace('_', ' ')}"
            f" | {_cell(row['success'][0], '.2f')}"
            f" | {_cell(row['success'][1], '.2f')} | {apart}{_cell(row['difference'], '+.2f')}"
            f"{interval}{apart} | {_improvement(row)} |"
        )
    return lines


def _differing(comparison: dict[str, Any]) -> str:
    """The settings that differ, where they are few enough to read."""
    named = [
        f"`{row['setting'].removeprefix('config.')}`"
        for row in comparison["differences"]
        if row["kind"] not in ("free", "software")
    ]
    return f"; what differs: {', '.join(named)}" if 0 < len(named) <= FEW_SETTINGS else ""


def _improvement(row: dict[str, Any]) -> str:
    ends = row.get("improvement_low"), row.get("improvement_high")
    return interval_text(row["improvement"], *ends)


def _cell(value: float | None, form: str) -> str:
    return "no goal" if value is None else format(value, form)


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
    free = [f"{words[kind]} ({', '.join(names)})" for kind, names in differ.items() if names]
    same = [words[kind] for kind in kinds[:2] if not differ[kind]]
    fixed = ", ".join(["the environment and its conditions", "environment steps", *same])
    return f"Held fixed: {fixed} and the evaluation. Not held: {'; '.join(free) or 'nothing'}."


__all__ = ["as_markdown", "power_sentence"]
