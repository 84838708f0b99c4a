"""Tables of `restock eval`: of driven episodes, of `--on-logs` and of `--baseline`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from restock.stats import interval_text
from restock.words import policy_words

if TYPE_CHECKING:
    from restock.train.evaluation.ope import OpeConfig, OpeResult


def show_measures(rows: list[dict[str, Any]]) -> None:
    """Print a table for each perturbation: success, return and safety of each policy.

    A table that is too wide is split, so that no measure is left out.
    """
    from restock.cli.output import print_parted, say

    names = policy_words(row["policy"] for row in rows)
    for perturbation in dict.fromkeys(row["perturbation"] for row in rows):
        own = [row for row in rows if row["perturbation"] == perturbation]
        cells = list(dict.fromkeys(row["condition"] for row in own))
        own.sort(key=lambda row: cells.index(row["condition"]))
        shown = [_measures_row(row, names[row["policy"]]) for row in own]
        if not any(row["held back"] for row in shown):
            for row in shown:
                del row["held back"]
        print_parted(
            shown,
            key=("condition", "policy"),
            title=f"perturbation {perturbation} [95 % over episodes]; time of the successful ones",
        )
    if not any(row["policy"] == "planner" for row in rows) and not any(
        row["time_lost_episodes"] for row in rows
    ):
        say("time lost is not known: add the planner to --policies once")


def _measures_row(row: dict[str, Any], policy: str) -> dict[str, Any]:
    nearest = row["closest_person_least_m"]
    return {
        "condition": row["condition"],
        "policy": policy,
        "episodes": row["episodes"],
        "success": "no goal" if row["success"] is None else _with_interval(row, "success", ".2f"),
        "discounted return": _with_interval(row, "discounted_return", ".2f"),
        "bumps per km": _with_interval(row, "bumps_per_km", ".1f"),
        "people, least (mean) m": ""
        if nearest is None
        else f"{nearest:.2f} ({row['closest_person_m']:.2f})",
        "time s": "" if row["time_s"] is None else f"{row['time_s']:.1f}",
        "lost s": _with_interval(row, "time_lost_s", "+.1f"),
        "held back": ""
        if row["limited_share"] is None
        else f"{row['limited_share']:.0%} ({row['stopped_share']:.0%} to a stop)",
    }


def _with_interval(row: dict[str, Any], name: str, form: str) -> str:
    value, low, high = (row[name + end] for end in ("", "_low", "_high"))
    return "" if value is None else interval_text(value, low, high, form)


def show_off_policy(path: Path, result: OpeResult, config: OpeConfig, *, as_json: bool) -> None:
    """Print a row per measure and condition, and why weighting is refused if it is."""
    from restock.cli.output import print_json, print_table, say

    if as_json:
        print_json(
            {
                "run": str(path),
                "policy": result.version,
                "trained": None if result.origin is None else result.origin.document,
                "notes": list(result.notes),
                "results": result.rows,
            }
        )
        return
    cells: dict[tuple[str, str], dict[str, Any]] = {}
    for row in result.rows:
        key = row["measure"], row["condition"]
        shown = cells.setdefault(
            key, {"measure": key[0], "condition": key[1], "episodes": row["episodes"]}
        )
        shown[row["estimator"]] = _value(row)
        shown["weights worth"] = f"{row['ess']:.1f} episodes"
    step = "" if result.origin is None else f" ({result.origin.text})"
    print_table(
        list(cells.values()),
        title=f"{result.version}{step}, greedy with {config.epsilon:.0%} random actions, "
        "off-policy on logs it did not learn from [95 % over episodes]",
    )
    for row in result.rows:
        if row["condition"] == "all" and row["estimator"] == "pdwis" and row["refused"]:
            longest = f"; --horizon {row['ess_steps']} is enough" if row["ess_steps"] else ""
            say(f"{row['measure']}: pdwis is refused: {row['refused']}{longest}")
    if any(row["estimator"] == "fqe" for row in result.rows):
        say(
            "fqe is the value of the starts by the fitted model: it has no interval, as the error "
            "of the model cannot be measured on these logs"
        )
    estimated = result.rows[0]["estimated_share"] if result.rows else 0.0
    if estimated:
        say(
            f"the behaviour policy's probabilities are estimated (cloned) for {estimated:.0%} of "
            "the rows: the logs do not contain them"
        )
    for note in result.notes:
        say(note)


def _value(row: dict[str, Any]) -> str:
    if row["value"] is None:
        return "refused"
    return interval_text(row["value"], row["low"], row["high"])


def show_regression(rows: list[dict[str, Any]], baseline: str, margin: float) -> None:
    """Print a row per perturbation and condition, and one line with the result."""
    from restock.cli.output import print_table, say

    print_table(
        [_regression_row(row) for row in rows],
        title=f"success against the baseline {baseline}, paired by episode [95 %]",
    )
    for row in rows:
        if row["reason"]:
            say(f"{row['perturbation']}, {row['condition']}: {row['reason']}")
    if any(row["verdict"] == "refused" for row in rows):
        say("drive both with the same --episodes, --perturbations and --seed")
    worse = [f"{r['condition']} ({r['perturbation']})" for r in rows if r["verdict"] == "worse"]
    if worse:
        say(f"WORSE by more than {margin:g}, with the interval below 0: {', '.join(worse)}")


def _regression_row(row: dict[str, Any]) -> dict[str, Any]:
    known = row["baseline"] is not None
    difference = f"{row['difference']:+.2f}" if known else ""
    if row["difference_low"] is not None:
        difference += f" [{row['difference_low']:+.2f}, {row['difference_high']:+.2f}]"
    return {
        "perturbation": row["perturbation"],
        "condition": row["condition"],
        "episodes": row["episodes"],
        "baseline": f"{row['baseline']:.2f}" if known else "",
        "candidate": f"{row['candidate']:.2f}" if known else "",
        "difference": difference,
        "P(improvement)": f"{row['improvement']:.2f}" if known else "",
        "": row["verdict"],
    }


__all__ = ["show_measures", "show_off_policy", "show_regression"]
