"""The page of a store's coverage: shelves, weeks, robots, the map, drift and the shopping list."""

from __future__ import annotations

import math
from typing import Any

import altair as alt
from markupsafe import Markup

from restock.errors import by_priority, counted, figure, quoted, uncertain_labels
from restock.replay.fleet.drift import Drift
from restock.replay.fleet.shopping_list import readable
from restock.replay.store.definitions import UNITS, install_named
from restock.replay.store.definitions import unit as unit_of
from restock.replay.store.novelty import explain_novel_rows, novel_rows, strangest
from restock.replay.store.store import Store
from restock.report.look import blocks, charts, floor_map
from restock.report.look.blocks import (
    Figure,
    Rows,
    Section,
    Table,
    count,
    fetch_rows,
    listed,
    percent,
    statements,
    words,
)

MAX_DOTS = 1500
MAX_CELLS_ACROSS = 90  # cells of the map along an axis
SHARE_COLOURS = {"held": "#0f766e", "by priority": "#94a3b8"}
MAX_ROBOTS = 12  # in a chart
MAX_PERIODS = 26  # a chart shows the newest
MAX_FINDINGS = 8  # findings with a chart of their own
_BESIDE = ("driving", "conditions")  # parts of findings on use, not hardware
_PERIODS = alt.Axis(labelAngle=-60, grid=False)
_SCOPE = {
    "robot": "this robot",
    "site": "the whole site",
    "alone": "no other robot to compare",
    "unclear": "unclear",
}


def coverage_page(store: Store, gaps: dict[str, Any], drift: Drift | str) -> dict[str, Any]:
    """Return the content of the page, for `write_page`.

    Args:
        gaps: as `restock coverage gaps --json` prints them.
        drift: the drift measured, or the reason why it could not be measured.
    """
    shelves, robots, (totals,) = (_rows(store, name) for name in ("shelves", "robots", "totals"))
    counts = {noun: totals[f"{noun}s"] for noun in ("row", "episode", "recording")}
    counts["robot"] = len({row["robot"] for row in robots})
    return {
        "kicker": "coverage of a store",
        "title": f"Coverage of {gaps['store']}",
        "headline": headline(shelves, gaps),
        "lead": f"{listed([counted(n, noun) for noun, n in counts.items()])}: how much of each "
        f"condition they hold, and what they lack of the requirements of mixture {gaps['mixture']}"
        " and the audits.",
        "sections": [
            _shelves(shelves, _priority_note(store)),
            shopping_section(gaps),
            _strangest(store, gaps["store"]),
            coverage_weeks(store)[1],
            _robots(robots),
            _map(store),
            Section("drift", "Has a robot changed?", intro=f"Not measured: {drift}")
            if isinstance(drift, str)
            else drift_section(drift),
        ],
        "source": f"{gaps['store']}, version {gaps['store_version']}",
    }


def _rows(store: Store, name: str, **parameters: Any) -> Rows:
    """Run a statement of coverage.sql and return its rows."""
    sql = statements("restock.report.fleet", "coverage.sql")[name]
    install_named(store.connection, sql)
    return fetch_rows(store.connection, sql, **parameters)


def _priority_note(store: Store) -> str:
    return by_priority(words(name) for name in store.priority())


def headline(shelves: Rows, gaps: dict[str, Any]) -> str:
    """Name the largest gap, the conditions never seen, and what it takes to fill all gaps."""
    if gaps["closed"]:
        return f"No gaps: the store has all that {gaps['mixture']} requires"
    short = [gap for gap in gaps["gaps"] if gap["needed"]]
    shelves_short = [gap for gap in short if gap["action"] is None] or short
    worst = min(shelves_short, key=lambda gap: gap["there"] / gap["needed"], default=None)
    text = ""
    if worst is not None:
        text = (
            f"Largest gap: {words(worst['cell'])}, {worst['there']:,} of {worst['needed']:,} "
            f"{worst['counted']}"
        )
    never = [words(row["condition"]) for row in shelves if row["rows_held"] == 0]
    if never:
        text += f"; never seen: {', '.join(never)}"
    unknown = [words(row["condition"]) for row in shelves if row["rows_held"] is None]
    if unknown:
        text += f"; unknown in every recording: {', '.join(unknown)}"
    plan = gaps["plan"]
    if plan["orders"]:
        text += (
            f"; {figure(plan['total'])} {gaps['unit']} [{figure(plan['total_low'])}, "
            f"{figure(plan['total_high'])}] would fill the gaps that can be filled"
        )
    return text.removeprefix("; ")


def _shelves(rows: Rows, once: str) -> Section:
    unknown = [words(row["condition"]) for row in rows if row["rows_held"] is None]
    guessed = {words(r["condition"]): n for r in rows if (n := r["uncertain_recordings"])}
    rows = [row for row in rows if row["rows_held"] is not None]
    bars = [
        {"condition": words(row["condition"]), "kind": kind, "share": row[name]}
        for row in rows
        for kind, name in (("held", "held_share"), ("by priority", "primary_share"))
    ]
    table = [
        {
            "condition": words(row["condition"]),
            "rows": count(row["rows_held"]),
            "share": percent(row["held_share"]),
            "episodes": count(row["episodes_held"]),
            "effective episodes": f"{row['effective_episodes']:.1f}",
            "success": "" if row["success_share"] is None else f"{row['success_share']:.0%}",
            "zones": count(row["zones"]),
            "recordings": count(row["recordings"]),
            "who drove": ", ".join(str(name) for name in row["behaviour_policies"] if name),
            "by priority": f"{row['primary_rows']:,} ({percent(row['primary_share'])})",
        }
        for row in rows
    ]
    return Section(
        "shelves",
        "What the store holds",
        intro="Rows in which each condition holds: a row that holds several counts for each. "
        f"{once} Effective episodes: the number of equally long episodes with the same information."
        + (f" {uncertain_labels(guessed, max(guessed.values()))}." if guessed else "")
        + (
            f" Unknown in every row: {', '.join(unknown)} (the view unknown_conditions says why)."
            if unknown
            else ""
        ),
        figures=[Figure(charts.shares(bars, "condition", SHARE_COLOURS))] if rows else [],
        tables=[Table(table)],
    )


def _strangest(store: Store, place: str) -> Section | None:
    novel = novel_rows(store)
    if not (rows := strangest(store)):
        return None
    shown = [
        {
            "row": row["row"],
            "novelty": f"{row['novelty']:.2f}",
            "what is strange": row["strange"],
            "condition": words(row["condition"]),
            "zone": row["zone"] or "",
            "robot": row["robot"] or "",
            "logged": f"{row['logged_time']:%Y-%m-%d %H:%M:%S}",
            "recording": row["source_file"],
        }
        for row in rows
    ]
    return Section(
        "strangest",
        "What does no rule name?",
        intro=f"{explain_novel_rows(novel)} These are the strangest, one per episode, with the"
        " entries of the observation that are furthest from the mean of the nearest rows."
        f" `restock trace {quoted(place)} ROW` follows a row to its recording.",
        tables=[Table(shown)],
    )


def coverage_weeks(store: Store) -> tuple[Rows, Section | None]:
    """Return rows by week and condition, and a section that shows them; None if all are zero."""
    every = _rows(store, "weeks")
    rows = [row for row in every if row["primary_rows"]]
    if not rows:
        return every, None
    shown = [
        {
            "week": "not known" if row["week"] is None else str(row["week"]),
            "condition": words(row["condition"]),
            "rows": row["primary_rows"],
        }
        for row in rows
    ]
    names = charts.ordered(shown, "condition", blocks.WORDS_COLOURS)

    def chart(width: int) -> Any:
        return (
            charts.plot(shown)
            .mark_bar()
            .encode(
                x=alt.X("week:O", title=None, axis=alt.Axis(labelAngle=-60, grid=False)),
                y=alt.Y("rows:Q", title="rows", axis=alt.Axis(labelExpr=charts.SHORT_NUMBERS)),
                color=charts.coloured("condition", names, blocks.WORDS_COLOURS, width),
            )
            .properties(height=200)
        )

    weeks = len({row["week"] for row in shown})
    return every, Section(
        "weeks",
        "When was it logged?",
        intro=f"Rows by week of logging (Mondays), {counted(weeks, 'week')}."
        f" {_priority_note(store)}",
        figures=[Figure(charts.draw(chart))],
    )


def _robots(rows: Rows) -> Section | None:
    if not rows:
        return None
    robots = sorted({row["robot"] for row in rows})
    names = charts.ordered(
        [{"condition": words(row["condition"])} for row in rows],
        "condition",
        blocks.WORDS_COLOURS,
    )
    cells = {(row["robot"], words(row["condition"])): row for row in rows}
    hours = {row["robot"]: row["hours"] or 0.0 for row in rows}
    table = [
        {
            "robot": robot,
            "hours": f"{hours[robot]:.2f}",
            **{
                name: f"{cell['rows_held']:,} ({percent(cell['held_share'])})" if cell else "none"
                for name in names
                for cell in [cells.get((robot, name))]
            },
        }
        for robot in robots
    ]
    return Section(
        "robots",
        "Which robot has seen which condition?",
        intro="Rows in which each condition holds, and their share of the robot's own. "
        "A condition that only one robot has seen is learned only from that robot's hardware.",
        tables=[Table(table)],
    )


def _map(store: Store) -> Section | None:
    (bounds,) = _rows(store, "bounds")
    if bounds["x0"] is None:
        return None
    across = bounds["x1"] - bounds["x0"]
    cell_m = max(0.25, math.ceil(across / MAX_CELLS_ACROSS / 0.25) * 0.25)
    margin = 0.5
    x0, y0 = bounds["x0"] - margin, bounds["y0"] - margin
    size_m = bounds["x1"] + margin - x0, bounds["y1"] + margin - y0

    def moved(rows: Rows) -> Rows:
        return [{**row, "x_m": row["x_m"] - x0, "y_m": row["y_m"] - y0} for row in rows]

    visited = moved(_rows(store, "visited", cell_m=cell_m))
    rare = moved(_rows(store, "rare", most=MAX_DOTS))
    drawing, legend = floor_map.draw(size_m, [], visited, cell_m, rare)
    caption = (
        f"Logged steps in cells of {cell_m:g} m, stronger where there are more (logarithmic); dots"
        f" are rare conditions; the bar is {floor_map.BAR_M} m. Poses are in the map frame, from"
        f" ({x0:.1f}, {y0:.1f}) m."
    )
    caption = legend + Markup("<br>") + caption
    return Section("map", "Where was it logged?", figures=[Figure(drawing, caption=caption)])


MAX_GAPS = 20  # in the table


def shopping_section(gaps: dict[str, Any]) -> Section:
    unit = gaps["unit"]
    if gaps["closed"]:
        return Section("shopping", "What to log next", intro="Nothing: there are no gaps.")
    gaps = gaps | {
        "gaps": sorted(gaps["gaps"], key=lambda gap: gap["there"] / max(gap["needed"], 1))
    }
    known, unknown, orders = readable(gaps)
    left = len(known) - MAX_GAPS
    intro = []
    if orders:
        which = "every gap that has a rate" if unknown else "every gap"
        intro.append(
            f"The least number of {unit} that fills {which} with {gaps['confidence']:.0%},"
            " at the rates of the store's own episodes; intervals are 95 %."
        )
    if orders and unit == "missions":  # the twin cannot drive a plan in hours
        intro.append("`restock coverage gaps --missions-out FILE` writes it as missions to drive.")
    if unknown:
        intro.append("What was never logged has no rate, so the amount needed is not known.")
    return Section(
        "shopping",
        "What to log next",
        intro=" ".join(intro),
        tables=[
            Table(_in_words(orders), title="What to drive"),
            Table(
                _in_words(known[:MAX_GAPS]),
                title="What is missing",
                caption=f"{left:,} more gaps: `restock coverage gaps --json` has all."
                if left > 0
                else "",
            ),
            Table(_in_words(unknown), title="What was never seen"),
        ],
    )


def _in_words(lines: Rows) -> Rows:
    return [{name: _in_word(name, value) for name, value in line.items()} for line in lines]


def _in_word(name: str, value: Any) -> str:
    if isinstance(value, str):
        return value if name == "asked by" else words(value)
    return f"{value:,}"


def drift_headline(drift: Drift) -> str:
    """State in one sentence what has changed."""
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
        return "No robot's hardware has changed enough to matter; how or where robots drive has"
    return drift.without_findings()


def drift_section(drift: Drift) -> Section:
    """Show each finding with its size and date, and charts of its signal over the periods."""
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
        callout=drift_headline(drift) + ".",
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
    """Format a change as a ratio, `× 0.942 [0.935, 0.950]`, or as a difference with its sign."""
    if row["change"] is None:
        return ""
    ratio = row["compared"] == "ratio"
    values = [row["change"], row["change_low"], row["change_high"]]
    least = 0.0 if ratio else 1e-3 * max(abs(row["change_low"]), abs(row["change_high"]))
    value, low, high = (  # show values far below the interval's ends as zero
        f"{v:.3f}" if ratio else f"{v if abs(v) >= least else 0.0:+.3g}" for v in values
    )
    unit = " sd" if row["compared"] == "spread" else ""
    return f"{'× ' if ratio else ''}{value}{unit} [{low}, {high}]"
