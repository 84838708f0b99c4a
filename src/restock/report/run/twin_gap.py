"""The gap between twin and logs, as a section of a run's report and as a page of its own."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from restock.errors import counted
from restock.report.look import charts
from restock.report.look.blocks import Drawing, Figure, Rows, Section, Table, words
from restock.report.run.facts import Facts
from restock.stats import ConfidenceInterval, interval_text
from restock.train.twin.calibration.gap import AFTER, BEFORE
from restock.train.twin.calibration.twin_gap import (
    TRUSTED,
    UNDECIDED,
    UNKNOWN,
    UNTRUSTED,
    TwinGap,
)

COLOURS = {
    "nominal twin": "#b45309",
    "calibrated twin": "#0f766e",
    "odometry": "#64748b",
}


def source_name(source: str) -> str:
    """Add "twin" to the name of a twin: "nominal" alone is also a condition."""
    return f"{source} twin" if source in (BEFORE, AFTER) else source


def run_section(facts: Facts) -> Section | None:
    """Return the section of a run's report; None if no gap was measured."""
    gap = facts.gap
    if gap is None:
        return None
    section, version = gap_section(gap), gap.about["store_version"]
    if facts.panel is None or version == facts.panel.header.store_version:
        return section
    note = (
        f" It was measured at version {version} of the store; the run's panel is from version "
        f"{facts.panel.header.store_version}."
    )
    return replace(section, intro=section.intro + note)


def gap_page(gap: TwinGap) -> dict[str, Any]:
    """Return the content of a page about a gap alone, for `write_page`."""
    about = gap.about
    return {
        "kicker": "gap between twin and logs",
        "title": f"Twin and logs of {about['store']}",
        "headline": headline(gap),
        "lead": f"{counted(about['rows'], 'logged step')} of"
        f" {counted(about['episodes'], 'episode')}, driven again in the twin. Verdicts are on"
        f" the {source_name(about['judged'])}.",
        "sections": [replace(gap_section(gap), callout="")],  # as in the headline
        "source": f"{about['store']}, version {about['store_version']}",
    }


def headline(gap: TwinGap) -> str:
    """State in one sentence where not to trust the twin."""
    names = ", ".join(words(name) for name in gap.untrusted)
    if names:
        return f"Do not trust the twin in: {names}"
    if all(item.verdict == UNKNOWN for item in gap.verdicts):
        return "Too few logs could be driven again to assess the twin in any condition"
    if all(item.verdict == TRUSTED for item in gap.verdicts):
        return "The twin is within its limits in every logged condition"
    return "No condition is shown to be beyond the limits; not all are shown to be within"


def gap_section(gap: TwinGap) -> Section:
    """Show pose gaps by horizon and condition, the verdicts, and what could not be measured."""
    limits = gap.about["limits"]
    worst_first = [UNTRUSTED, UNDECIDED, UNKNOWN, TRUSTED]
    shown = [
        {
            **row,
            "condition": words(row["condition"]),
            "source": source_name(row["source"]),
            "horizon": f"after {row['horizon_s']:g} s",
        }
        for row in gap.paths
        if row["quantity"] == "position" and row["median"] is not None
    ]
    rows = [
        {
            "condition": words(item.condition),
            "verdict": item.verdict,
            "segments": item.segments,
            "episodes": item.episodes,
            f"9 in 10 end within, after {limits['horizon_s']:g} s": _interval(
                item.position_p90, "m"
            ),
            "reward gap / its spread": _interval(item.reward_ratio, ""),
            "why": "; ".join(item.reasons),
        }
        for item in sorted(gap.verdicts, key=lambda item: worst_first.index(item.verdict))
    ]
    return Section(
        "twin-gap",
        "Can the twin be trusted?",
        intro="Logged commands, driven again in the twin in open loop, without feedback from the "
        "log. Odometry: dead reckoning from the logged wheels; a twin should be better. A "
        f"condition is trusted if nine in ten segments of {limits['horizon_s']:g} s end within "
        f"{limits['position_m']:g} m of the log, and the error of the one-step reward is less than "
        f"{limits['reward_ratio']:g} times its standard deviation in the log (its spread), both "
        "with 95 % confidence over episodes. Undecided: the interval contains a limit, and more "
        "logs would decide. rewards.parquet has each term of the reward.",
        callout=headline(gap) + "." if gap.untrusted else "",
        figures=[
            Figure(
                _positions(shown),
                "Distance from the log at the end",
                "Dots are medians with 95 % intervals over episodes; ticks are 90th percentiles. "
                "A segment counts for all conditions in it.",
            )
        ]
        if shown
        else [],
        tables=[
            Table(rows),
            Table([{"notes": note} for note in gap.not_done]),
        ],
    )


def _positions(rows: Rows) -> Drawing:
    return charts.estimates(
        rows,
        y="condition",
        series="source",
        names=charts.ordered(rows, "source", COLOURS),
        colours=COLOURS,
        value="median",
        ends=("median_low", "median_high"),
        title="metres",
        tick="p90",
        beside="horizon",
    )


def _interval(interval: ConfidenceInterval, unit: str) -> str:
    if math.isnan(interval.value):
        return ""
    form = ".3f" if 0 < interval.value < 0.1 else ".2f"
    low = None if math.isnan(interval.low) else interval.low
    return f"{interval_text(interval.value, low, interval.high, form)} {unit}".strip()
