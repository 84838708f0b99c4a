"""The section on actions: what batches held of each, and which the policy wants instead."""

from __future__ import annotations

from typing import Any

import altair as alt

from restock.report.look import charts
from restock.report.look.blocks import Drawing, Figure, Rows, Section, Table, count, percent, words
from restock.report.run.facts import Facts

KINDS = ("logs", "fresh", "wanted")
_MIN_AUDITED = 20  # rows in which the policy was asked, for a line of the table
_LINES = 12
MIN_TILE_PX = 34  # for a number in it


def actions_section(facts: Facts) -> Section | None:
    """Return the section on actions; None for a run that kept no such counts."""
    if not facts.actions:
        return None
    cells = _cells(facts.actions)
    return Section(
        "actions",
        "Which actions were in the data, and which ones does the policy prefer?",
        intro="For each condition, the share of each action in sampled rows from logs and in "
        "fresh rows, and the share of fresh rows in which the policy would take it (from "
        "audited batches, in the last quarter of the updates). The logs do not show the "
        "outcome of an action that is preferred but not in the logs; `restock diagnose` tells "
        "whether that causes failures. Actions are named by their m/s and rad/s.",
        figures=[Figure(_heatmap(cells), "Share of a condition's rows by action")],
        tables=_table(facts.actions),
    )


def _row_name(row: dict[str, Any]) -> str:
    """Return the name of a condition, or of the stratum of logs that it belongs to."""
    stratum, condition = words(row["stratum"]), words(row["condition"])
    return condition if stratum == condition else f"{stratum}: {condition}"


def _cells(rows: Rows) -> Rows:
    """Return a cell for each source, condition and action; `wanted` is a source here."""
    cells: Rows = []
    for row in rows:
        name = _row_name(row)
        shares = {row["source"]: row["drawn_share"]}
        if row["source"] == "fresh":
            shares["wanted"] = row["wanted_share"]
        cells += [
            {
                **{"row": name, "action": row["name"], "order": row["action"]},
                **{"kind": kind, "share": share, "text": _short(share)},
            }
            for kind, share in shares.items()
            if share is not None
        ]
    return cells


def _short(share: float) -> str:
    """Format a share for a tile, where never differs from seldom."""
    if not share:
        return "0"
    return f"{share:.0%}" if share >= 0.01 else "<1%"


def _heatmap(cells: Rows) -> Drawing:
    kinds = [kind for kind in KINDS if any(cell["kind"] == kind for cell in cells)]
    actions = [c["action"] for c in sorted(cells, key=lambda cell: int(cell["order"]))]
    names = list(dict.fromkeys(cell["row"] for cell in cells))

    def chart(width: int) -> Any:
        # A small tile has no number: the pointer shows it, and the table has the largest.
        labels_px = min(charts.label_px(names), 200 if width > charts.FULL[0] else 140)
        tile = (width - labels_px - 12) // max(len(set(actions)), 1)
        axis = alt.Axis(
            grid=False, ticks=False, labelOverlap=False, labelAngle=-60 if tile >= 24 else -90
        )
        base = charts.plot(cells).encode(
            x=alt.X("action:N", sort=list(dict.fromkeys(actions)), title=None, axis=axis),
            y=alt.Y(
                "row:N",
                title=None,
                axis=alt.Axis(grid=False, ticks=False, labelLimit=labels_px, labelOverlap=False),
            ),
        )
        tiles = base.mark_rect(stroke="#ffffff").encode(
            color=alt.Color(
                "share:Q",
                scale=alt.Scale(type="sqrt", domain=[0, 1], range=["#f1f5f9", "#0b5f58"]),
                legend=None,
            )
        )
        layers = [tiles]
        if tile >= MIN_TILE_PX:
            number = alt.condition("datum.share > 0.35", alt.value("#fdfdfd"), alt.value("#1f2937"))
            layers.append(base.mark_text(fontSize=12).encode(text="text:N", color=number))
        layered = alt.layer(*layers).properties(width=tile * len(set(actions)), height=alt.Step(24))
        header = alt.Header(orient="top", labelAnchor="start", labelPadding=4)
        rows = alt.Row("kind:N", sort=kinds, header=header)
        return layered.facet(row=rows).resolve_scale(y="independent")

    return charts.draw(chart, charts.FULL)


def _table(rows: Rows) -> list[Table]:
    """Show which actions the policy wants most beyond the logs, by condition."""
    logged: dict[tuple[str, int], int] = {}
    of_condition: dict[str, int] = {}
    for row in rows:
        if row["source"] == "logs":
            key = row["condition"], row["action"]
            logged[key] = logged.get(key, 0) + row["drawn_rows"]
            of_condition[row["condition"]] = (
                of_condition.get(row["condition"], 0) + row["drawn_rows"]
            )
    gaps = []
    for row in rows:
        drawn = of_condition.get(row["condition"], 0)
        if row["source"] != "fresh" or not drawn or (row["audited_rows"] or 0) < _MIN_AUDITED:
            continue
        share = logged.get((row["condition"], row["action"]), 0) / drawn
        if row["wanted_share"] > 2 * share:
            gaps.append((row["wanted_share"] - share, share, row))
    gaps.sort(key=lambda gap: -gap[0])
    lines = [
        {
            "condition": words(row["condition"]),
            "action": row["name"],
            "wanted": percent(row["wanted_share"]),
            "in the logs": percent(share),
            "in fresh rows": percent(row["drawn_share"]),
            "rows checked": count(row["audited_rows"]),
        }
        for _, share, row in gaps[:_LINES]
    ]
    numbers = {"wanted", "in the logs", "in fresh rows", "rows checked"}
    title = "Preferred more than twice as often as in the logs"
    return [Table(lines, numbers, title=title)] if lines else []


__all__ = ["actions_section"]
