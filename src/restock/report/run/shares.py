"""The section on the feed: quotas of the batch, rows that filled them, and weights."""

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
from restock.train.run.fed_shares import SHORT

COLOURS = {
    "natural": "#cbd5e1",
    "wanted": "#94a3b8",
    "drawn": "#0f766e",
}


def figure(facts: Facts) -> Figure | None:
    """Three bars a stratum; None for a run without a panel."""
    rows = bars(facts)
    if not rows:
        return None
    title = "All rows fed: natural, wanted and drawn shares"
    return Figure(_drawn(rows), title, " ".join(remarks(facts)))


def bars(facts: Facts) -> Rows:
    """Return stratum, kind and share of all rows that the critic was fed."""
    return [
        {"stratum": words(row["stratum"]), "kind": kind, "share": row[f"{kind}_share"]}
        for row in facts.fed
        for kind in COLOURS
    ]


def fed_table(facts: Facts) -> Table:
    """Show the feed in numbers, with sources, shortages and their reasons."""
    shares = ("natural", "wanted", "drawn", "logs", "fresh", "short")
    return Table(
        [
            {
                "stratum": words(row["stratum"]),
                **{_TITLES.get(name, name): percent(row[f"{name}_share"]) for name in shares},
                "rows drawn": count(row["drawn_rows"]),
                "why short": row["reason"] or "",
            }
            for row in facts.fed
        ],
        {*(_TITLES.get(name, name) for name in shares), "rows drawn"},
        caption="Shares are of all rows fed, over the whole run. Natural: what the same sources "
        "would have given if drawn from uniformly.",
    )


_TITLES = {"logs": "from logs", "fresh": "fresh"}


def remarks(facts: Facts) -> list[str]:
    """Say which strata were short, which lose by weights, and what rows are missing."""
    natural = {stratum.name: stratum.natural_share for stratum in facts.strata}
    lost = []
    for row in facts.sampled:
        of_rows = natural.get(row["stratum"], row["available_share"])
        weighted = row["effective_share"]
        if row["source"] == "fresh" or of_rows is None or weighted is None:
            continue
        if row["drawn_share"] >= of_rows and weighted < (1 - TOLERANCE) * of_rows:
            lost.append(
                f"{words(row['stratum'])} ({of_rows:.2%} of the rows, {row['drawn_share']:.2%} of"
                f" the draws, {weighted:.2%} of the gradient)"
            )
    short = [
        f"{words(stratum.name)} {stratum.missing_rows:,} rows"
        + (
            ""
            if stratum.missing_hours is None
            else f" ({span(3600 * stratum.missing_hours)} of driving as logged)"
        )
        for stratum in facts.strata
        if stratum.missing_rows
    ]
    texts = [
        f"{words(row['stratum'])} was short by {row['short_share']:.1%} of the rows fed, of"
        f" {row['wanted_share']:.1%} wanted: {row['reason'] or 'too few rows'}."
        for row in facts.fed
        if row["short_share"] >= SHORT
    ]
    if lost:
        texts.append(
            f"The share after weights is smaller than in the plain logs for {'; '.join(lost)}."
        )
    if short:
        texts.append(
            "At the draws that `restock mix` planned, the logs alone have too few rows; missing:"
            f" {', '.join(short)}."
        )
    return texts


def table(facts: Facts) -> Table:
    """Show the rows of each source by stratum, also after weights."""
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
    """Draw bars on a square-root axis, so that rare strata can be seen."""
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
