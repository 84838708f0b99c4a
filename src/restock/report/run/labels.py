"""The section on labels: how good they are on the run's logs, where a simulator knew the truth."""

from __future__ import annotations

from typing import Any

from restock.report.look.blocks import Section, Table, count, percent, words
from restock.report.run.facts import Facts
from restock.stats import wilson


def labels_section(facts: Facts) -> Section | None:
    """Return the section on labels; None if no recording of the store knows the truth."""
    if not facts.labels:
        return None
    rows = [_score(row) for row in facts.labels]
    reliability = _reliability(facts.reliability)
    tables = [Table(rows, set(rows[0]) - {"condition"})]
    if reliability:
        title = "Steps with probability p: the share that is true should be p"
        tables.append(Table(reliability, set(reliability[0]) - {"condition"}, title=title))
    return Section(
        "labels",
        "How good are the labels?",
        intro="Compared with the true conditions of the simulator, over all recordings of the "
        "store. An event is a run of steps of an episode; it counts as found within .4 s. "
        "Ranges are 95 % (Wilson). Uncertain: the share of all steps that are uncertain by "
        "the condition's probability.",
        tables=tables,
    )


def _score(row: dict[str, Any]) -> dict[str, str]:
    return {
        "condition": words(row["condition"]),
        "true steps": count(row["support"]),
        "precision": _share(row["precision"]),
        "recall": _share(row["recall"]),
        "true events": count(row["event_support"]) if row["event_support"] is not None else "",
        "event precision": _with_range(row["event_precision"], row["event_labelled"]),
        "event recall": _with_range(row["event_recall"], row["event_support"]),
        "uncertain": percent(row["uncertain_share"] or 0.0),
    }


def _share(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def _with_range(value: float | None, events: int | None) -> str:
    if value is None or not events:
        return ""
    low, high = wilson(round(value * events), events)
    return f"{value:.2f} ({low:.2f} to {high:.2f})"


def _reliability(bins: list[dict[str, Any]]) -> list[dict[str, str]]:
    """Show the true share of each condition by tenths of probability."""
    rows: dict[str, dict[str, str]] = {}
    for one in bins:
        blank = {f"{tenth / 10:g}+": "" for tenth in range(10)}
        row = rows.setdefault(one["condition"], {"condition": words(one["condition"]), **blank})
        row[f"{one['from_probability']:g}+"] = f"{one['true_share']:.2f} of {one['known']:,}"
    return list(rows.values())
