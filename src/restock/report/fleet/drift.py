"""The sections on drift: what has changed about which robot, and since when."""

from __future__ import annotations

from typing import Any

import altair as alt

from restock.errors import counted
from restock.replay.fleet.drift import Drift
from restock.replay.store.definitions import UNITS
from restock.replay.store.definitions import unit as unit_of
from restock.report.look import charts
from restock.report.look.blocks import MAX_ROWS, Figure, Rows, Section, Table, listed, words

MAX_ROBOTS = 12  # in a chart: those with findings first
MAX_PERIODS = 26  # the newest
MAX_FINDINGS = 8  # findings with a chart of their own
_BESIDE = ("driving", "conditions")  # parts about the use, not about the hardware
_VERDICTS = ("changed", "undecided", "unchanged", "too few")
_PERIODS = alt.Axis(labelAngle=-60, grid=False)
_SCOPE = {
    "robot": "this robot",
    "site": "the whole site",
    "alone": "no other robot to compare",
    "unclear": "unclear",
}


def drift_sections(drift: Drift) -> list[Section | None]:
    return [_findings_section(drift), _comparisons_section(drift.own)]


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


def _findings_section(drift: Drift) -> Section:
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
    robots = _chosen({row["robot"] for row in rows}, {finding["robot"]})
    rows = _newest([row for row in rows if row["robot"] in robots])
    colours = {finding["robot"]: "#b91c1c"}

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


def _comparisons_section(own: Rows) -> Section | None:
    """Show the newest comparison of each hardware signal, with its sizes of effect."""
    newest: dict[tuple[str, str], dict[str, Any]] = {}
    for row in own:
        if row["part"] not in _BESIDE:
            newest[row["robot"], row["signal"]] = row
    if not newest:
        return None
    rows = [
        {
            "robot": row["robot"],
            "signal": signal_name(row),
            "reference": value_text(row["reference_value"]),
            "now": value_text(row["value"]),
            "change": change_text(row),
            "verdict": row["verdict"],
            "Cliff's delta": value_text(row["cliffs_delta"]),
            "KS": value_text(row["ks_distance"]),
            "corrected p": "" if row["q"] is None else f"{row['q']:.1g}",
            "samples": f"{row['n']} / {row['n_reference']} {row['samples']}",
        }
        for row in sorted(newest.values(), key=lambda row: _VERDICTS.index(row["verdict"]))
    ]
    return Section(
        "comparisons",
        "The newest comparison of each signal",
        intro="Changed signals come first. Undecided: neither a change nor its absence is shown; "
        "more drives would decide. Samples: now / reference. Cliff's delta and the "
        "Kolmogorov-Smirnov distance compare episodes: 0 is no difference, 1 no overlap. "
        "docs/coverage.md says what each signal is.",
        tables=[
            Table(
                rows[:120],
                title=counted(min(len(rows), 120), "comparison"),
                folded=len(rows) > MAX_ROWS,
            ),
        ],
    )


def _chosen(robots: set[str], first: set[str]) -> list[str]:
    """Return at most MAX_ROBOTS robots, these first, sorted by name."""
    return sorted((sorted(robots & first) + sorted(robots - first))[:MAX_ROBOTS])


def _newest(rows: Rows) -> Rows:
    """Return the rows of the newest periods."""
    kept = sorted({row["period"] for row in rows})[-MAX_PERIODS:]
    return [row for row in rows if row["period"] in kept]


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


def value_text(value: float | None) -> str:
    """Format three digits; nothing if there is no value."""
    return "" if value is None else f"{value:.3g}"
