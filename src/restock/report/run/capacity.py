"""The section on capacity: how much of the logs' diversity a buffer of so many rows keeps."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import altair as alt

from restock.errors import RestockError
from restock.replay.store.capacity import capacity_of_rows
from restock.report.look import charts
from restock.report.look.blocks import Drawing, Figure, Section, Table, count, percent
from restock.report.run.facts import Facts


def capacity_section(facts: Facts) -> Section | None:
    """Return the section on capacity; None if nothing says what the logs cover."""
    chosen = facts.config.get("ring_capacity")
    ring = facts.config.get("config", {}).get("replay", {}).get("ring_capacity")
    capacity = chosen or _of_panel(facts)
    if capacity is None:
        return None
    requested = capacity["recommended"]
    how = (
        "chosen by task diversity"
        if chosen
        else (f"by the panel's diversity, {requested:,} would be enough")
    )
    intro = f"The ring holds {ring or 0:,} rows; {how}: {capacity['reason']}."
    rows = [
        {
            "newest rows": count(point["capacity"]),
            "cells": count(point["cells"]),
            "share of cells": percent(point["cells_share"]),
            "conditions": count(point["conditions"]),
            "episodes": count(point["episodes"]),
            "effective episodes": f"{point['effective_episodes']:.1f}",
        }
        for point in capacity["curve"]
        if point["capacity"] >= 64
    ]
    return Section(
        "capacity",
        "How large must the buffer be?",
        intro=f"{intro} A cell is a condition x zone x action. A smaller first-in-first-out "
        "buffer forgets whole cells, which no sampling can bring back.",
        figures=[Figure(_curve(capacity, requested), "Cells covered by the newest logged rows")],
        two=True,
        tables=[Table(rows, set(rows[0]) if rows else set())],
    )


def _of_panel(facts: Facts) -> dict[str, Any] | None:
    if facts.panel is None:
        return None
    try:
        capacity = capacity_of_rows(facts.panel.meta)
    except (RestockError, KeyError):  # a panel of an earlier Restock has no such columns
        return None
    return {**asdict(capacity), "reason": capacity.reason}


def _curve(capacity: dict[str, Any], requested: int) -> Drawing:
    def chart(width: int) -> Any:
        line = (
            charts.plot(capacity["curve"])
            .mark_line(strokeWidth=2, color="#0f766e", point={"size": 28, "color": "#0f766e"})
            .encode(
                x=alt.X(
                    "capacity:Q",
                    title="newest rows kept",
                    scale=alt.Scale(type="log"),
                    axis=charts.x_axis(width),
                ),
                y=alt.Y(
                    "cells_share:Q",
                    title="share of the cells ever seen",
                    axis=alt.Axis(format="%"),
                    scale=alt.Scale(domain=[0, 1]),
                ),
            )
        )
        at = charts.plot([{"at": requested, "text": f"{requested:,} rows"}]).encode(x="at:Q")
        rule = at.mark_rule(strokeDash=[4, 3], color="#0f172a")
        text = at.mark_text(
            align="right", dx=-4, dy=-4, baseline="bottom", fontSize=12, color="#475569"
        ).encode(y=alt.value(230), text="text:N")
        return alt.layer(line, rule, text).properties(height=230)

    return charts.draw(chart)


__all__ = ["capacity_section"]
