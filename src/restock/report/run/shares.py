"""Shares of the logs' strata: natural, wanted, drawn, and what is left of them after weights."""

from __future__ import annotations

from typing import Any

import altair as alt

from restock.replay.plan.source_plan import TOLERANCE
from restock.report.look import charts
from restock.report.look.blocks import (
    Drawing,
    Figure,
    Rows,
    Table,
    count,
    number,
    percent,
    span,
    words,
)
from restock.report.run.facts import Facts

COLOURS = {
    "natural": "#cbd5e1",
    "wanted": "#94a3b8",
    "drawn": "#0f766e",
    "after weights": "#d55e00",
}


def figure(facts: Facts) -> Figure | None:
    """Four bars a stratum of the logs; None where no logged row was drawn."""
    rows = bars(facts)
    if not rows:
        return None
    title = "Logs: natural, wanted, drawn, and after weights"
    return Figure(_drawn(rows), title, " ".join(remarks(facts)))


def bars(facts: Facts) -> Rows:
    """stratum, kind, share: natural and wanted as the panel has them, the others of the run."""
    natural = {stratum.name: stratum.natural_share for stratum in facts.strata}
    wanted = {stratum.name: stratum.wanted_share for stratum in facts.strata}
    return [
        {"stratum": words(row["stratum"]), "kind": kind, "share": value}
        for row in facts.sampled
        if row["source"] == "logs"
        for kind, value in (
            ("natural", natural.get(row["stratum"], row["available_share"])),
            ("wanted", wanted.get(row["stratum"], row["quota_share"])),
            ("drawn", row["drawn_share"]),
            ("after weights", row["effective_share"]),
        )
        if value is not None
    ]


def remarks(facts: Facts) -> list[str]:
    """Which strata lose by their weights, and what the short ones miss."""
    by_stratum: dict[str, dict[str, float]] = {}
    for row in bars(facts):
        by_stratum.setdefault(row["stratum"], {})[row["kind"]] = row["share"]
    lost = [
        f"{name} ({share['natural']:.2%} of the rows, {share['drawn']:.2%} of the draws,"
        f" {share['after weights']:.2%} of the gradient)"
        for name, share in by_stratum.items()
        if {"natural", "drawn", "after weights"} <= share.keys()
        and share["drawn"] >= share["natural"]
        and share["after weights"] < (1 - TOLERANCE) * share["natural"]
    ]
    short = [
        f"{words(stratum.name)} {stratum.missing_rows:,} rows"
        + (
            ""
            if stratum.missing_hours is None
            else f" ({span(3600 * stratum.missing_hours)} of logging)"
        )
        for stratum in facts.strata
        if stratum.missing_rows
    ]
    texts = []
    if lost:
        texts.append(
            f"The share after weights is smaller than in the plain logs for {'; '.join(lost)}."
        )
    if short:
        texts.append(f"Too few rows for the wanted shares; missing: {', '.join(short)}.")
    return texts


def table(facts: Facts) -> Table:
    """The same in numbers, of fresh rows too."""
    natural = {stratum.name: stratum.natural_share for stratum in facts.strata}
    wanted = {stratum.name: stratum.wanted_share for stratum in facts.strata}
    rows = []
    for row in facts.sampled:
        of_panel = row["source"] != "fresh"
        name, available = row["stratum"], row["available_rows"]
        share = natural.get(name, row["available_share"]) if of_panel else row["available_share"]
        replays = f"{row['drawn_rows'] / available:.1f}" if available else ""
        rows.append(
            {
                "source": row["source"],
                "stratum": words(name),
                "timing": row["timing"] or "",
                "available": count(available),
                "natural": percent(share),
                "wanted": percent(wanted.get(name, row["quota_share"]) if of_panel else None),
                "drawn": percent(row["drawn_share"]),
                "after weights": percent(row["effective_share"]),
                "rows drawn": count(row["drawn_rows"]),
                "replays per row": replays,
                "mean reward": number(row["reward_mean"]),
                "terminal": percent(row["terminal_share"]),
            }
        )
    numbers = set(rows[0]) - {"source", "stratum", "timing"} if rows else set()
    return Table(
        rows,
        numbers,
        caption="Shares are of the source. Replays per row: rows drawn divided by rows available "
        "at the end; for a ring that was overwritten, this is an upper bound.",
    )


def _drawn(rows: Rows) -> Drawing:
    """Bars on a square-root axis, so that the rare strata can be seen at all."""
    strata = list(dict.fromkeys(row["stratum"] for row in rows))
    kinds = charts.ordered(rows, "kind", COLOURS)

    def chart(width: int) -> Any:
        quiet = alt.Axis(grid=False, ticks=False)
        marks = [0, 0.01, 0.05, 0.1, 0.25, 0.5, 0.75, 1]
        return (
            charts.plot(rows)
            .mark_bar(cornerRadiusEnd=2)
            .encode(
                y=alt.Y("stratum:N", sort=strata, title=None, axis=quiet),
                yOffset=alt.YOffset("kind:N", sort=kinds),
                x=alt.X(
                    "share:Q",
                    title="share of rows (square-root axis)",
                    scale=alt.Scale(type="sqrt"),
                    axis=alt.Axis(format="%", values=marks),
                ),
                color=charts.coloured("kind", kinds, COLOURS, width, charts.label_px(strata)),
            )
            .properties(height=52 * max(len(strata), 1))
        )

    return charts.draw(chart)
