"""The section on drift: what has changed about which robot, and since when."""

from __future__ import annotations

from typing import Any

import altair as alt

from restock.errors import counted
from restock.replay.fleet.drift import Drift
from restock.replay.store.definitions import UNITS
from restock.replay.store.definitions import unit as unit_of
from restock.report.look import charts
from restock.report.look.blocks import Figure, Section, Table, listed, words

MAX_ROBOTS = 12  # in a chart
MAX_PERIODS = 26  # the newest
MAX_FINDINGS = 8  # findings with a chart of their own
_BESIDE = ("driving", "conditions")  # parts about the use, not about the hardware
_PERIODS = alt.Axis(labelAngle=-60, grid=False)
_SCOPE = {
    "robot": "this robot",
    "site": "the whole site",
    "alone": "no other robot to compare",
    "unclear": "unclear",
}


def headline(drift: Drift) -> str:
    """Say in one sentence what has changed."""
    parts: dict[str, list[str]] = {}
    for row in drift.findings:
        if row["part"] not in _BESIDE:
            named = parts.setdefault(row["part"], [])
            who = f"site {row['site']}" if row["scope"] == "site" else row["robot"]
            named += [] if who in named else [who]
    if parts:
        text = "Changed: " + "; ".join(f"{part} of {listed(who)}" for part, who in parts.items())
        hardware = [row for row in drift.findings if row["part"] not in _BESIDE]
        if len(hardware) == 1:
            (row,) = hardware
            text += f", {signal_name(row)} {change_text(row)} since {row['since']}"
        return text
    if drift.findings:
        return "No robot's hardware has changed enough to matter; how or where it drives has"
    return drift.without_findings()


def drift_section(drift: Drift) -> Section:
    """Show each finding with its size and date, and the weeks behind it."""
    robots = {row["robot"] for row in drift.periods}
    periods = {row["period"] for row in drift.periods}
    rows = [
        {
            "robot": row["robot"],
            "part": row["part"],
            "signal": signal_name(row),
            "change": change_text(row),
            "since": str(row["since"]),
            f"{drift.every}s": f"{row['periods']} of {row['periods_tested']}",
            "scope": _SCOPE[row["scope"]],
            "corrected p": f"{row['q']:.1g}",
        }
        for row in drift.findings
    ]
    shown = [row for row in drift.findings if row["part"] != "conditions"][:MAX_FINDINGS]
    return Section(
        "drift",
        "Has a robot changed?",
        intro=f"{counted(len(robots), 'robot')} over {counted(len(periods), drift.every)}: each"
        f" {drift.every} of a robot compared with its first"
        f" {counted(drift.reference, drift.every)} ({counted(drift.tested, 'test')}), and with the"
        " other robots of its site. A change is reported if it is at least the least change that"
        " matters for its signal, and if its p-value, corrected over all signals, robots and"
        " periods, is below .05. The interval has 95 % confidence for the single signal. Scope:"
        " whether the other robots of the site changed in the same way in the same period, for"
        " example because of a new floor.",
        callout=headline(drift) + ".",
        figures=[_trend(drift, row) for row in shown],
        two=True,
        tables=[Table(rows), Table([{"notes": note} for note in drift.notes])],
    )


def _trend(drift: Drift, finding: dict[str, Any]) -> Figure:
    """Draw one signal of a site's robots over the periods."""
    rows = [
        {**row, "period": str(row["period"])}
        for row in drift.periods
        if row["signal"] == finding["signal"] and row["site"] == finding["site"]
    ]
    own = finding["robot"]
    robots = sorted({row["robot"] for row in rows}, key=lambda robot: (robot != own, robot))
    robots = sorted(robots[:MAX_ROBOTS])
    periods = sorted({row["period"] for row in rows if row["robot"] in robots})[-MAX_PERIODS:]
    rows = [row for row in rows if row["robot"] in robots and row["period"] in periods]
    colours = {own: "#b91c1c"}

    def chart(width: int) -> Any:
        base = charts.plot(rows).encode(
            x=alt.X("period:O", title=None, axis=_PERIODS),
            color=charts.coloured("robot", robots, colours, width),
            xOffset=alt.XOffset("robot:N", sort=robots),
        )
        bars = base.mark_rule(strokeWidth=3, opacity=0.4).encode(
            y=alt.Y("p25:Q", title=signal_name(finding), scale=alt.Scale(zero=False)), y2="p75:Q"
        )
        dots = base.mark_circle(size=55, opacity=1).encode(y=alt.Y("median:Q"))
        return alt.layer(bars, dots).properties(height=190)

    return Figure(
        charts.draw(chart),
        f"{finding['robot']}: {signal_name(finding)}",
        "Median and middle half of the episodes.",
    )


def signal_name(row: dict[str, Any]) -> str:
    """Name a signal with its unit, or a condition's events with their zone."""
    name, unit = row["signal"], unit_of(row["signal"])
    ending = next((ending for ending, _ in UNITS if unit and name.endswith(ending)), "")
    name = words(name.removesuffix(ending)) + (f" ({unit})" if unit else "")
    if row["part"] == "conditions":
        name += " events"
    zone = row.get("zone")
    return f"{name} in {zone}" if zone else name


def change_text(row: dict[str, Any]) -> str:
    """Format a ratio as `× 0.942 [0.935, 0.950]`, or a difference with its sign."""
    if row["change"] is None:
        return ""
    ratio = row["compared"] == "ratio"
    values = [row["change"], row["change_low"], row["change_high"]]
    least = 0.0 if ratio else 1e-3 * max(abs(row["change_low"]), abs(row["change_high"]))
    value, low, high = (  # values far below the interval's width are zero
        f"{v:.3f}" if ratio else f"{v if abs(v) >= least else 0.0:+.3g}" for v in values
    )
    unit = " sd" if row["compared"] == "spread" else ""
    return f"{'× ' if ratio else ''}{value}{unit} [{low}, {high}]"
