"""The report's charts: rows in, one static SVG out, so that the page opens without a network.

Every function takes plain rows (dicts) and returns SVG text. One colour per condition, per source
and per policy, the same in every chart.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import altair as alt
import vl_convert

Row = Mapping[str, Any]

# Okabe-Ito: colour-blind readers can distinguish them too.
CONDITION_COLOURS = {
    "nominal": "#6b7280",
    "wheel_slip": "#0072b2",
    "blocked_aisle": "#e69f00",
    "blocked_aisle (partial)": "#e69f00",
    "blocked_aisle (full)": "#8a5a00",
    "near_collision": "#d55e00",
    "recovery": "#cc79a7",
}
SPARE_COLOURS = ("#009e73", "#56b4e9", "#8b5cf6", "#84643a", "#111827")
POLICY_COLOURS = {
    "agent": "#0f766e",
    "cloned": "#7c3aed",
    "planner": "#b45309",
    "random": "#9ca3af",
}
SOURCE_COLOURS = {"logs": "#334155", "fresh": "#14b8a6"}

FEW_POINTS = 10  # of a line, with which each is drawn

_CONFIG = {
    "background": "transparent",
    "font": "Inter, Helvetica Neue, Helvetica, Arial, sans-serif",
    "view": {"stroke": None},
    "axis": {
        "labelColor": "#475569",
        "titleColor": "#475569",
        "titleFontWeight": 500,
        "labelFontSize": 12,
        "titleFontSize": 12,
        "gridColor": "#e2e8f0",
        "domainColor": "#cbd5e1",
        "tickColor": "#cbd5e1",
    },
    "legend": {"labelFontSize": 12, "labelColor": "#334155", "title": None, "orient": "top"},
    "header": {"labelFontSize": 13, "labelFontWeight": 600, "labelColor": "#0f172a", "title": None},
    "range": {"category": list(SPARE_COLOURS)},
}


def plot(rows: Sequence[Row]) -> Any:
    """A chart over rows that travel in the page itself."""
    return alt.Chart(alt.InlineData(values=[dict(row) for row in rows]))


def svg(chart: Any) -> str:
    """A chart as SVG that scales with the page."""
    chart = chart.configure(**_CONFIG)
    text: str = vl_convert.vegalite_to_svg(chart.to_json())
    # Keep the view box, let the page set the size.
    return re.sub(
        r'(<svg[^>]*?) width="(\d+)" height="(\d+)"', r'\1 style="max-width:\2px"', text, count=1
    )


def scale(names: Sequence[str], colours: Mapping[str, str]) -> alt.Scale:
    """A colour scale over the names that occur, known ones in their own colour."""
    spare = iter(SPARE_COLOURS * (1 + len(names)))
    return alt.Scale(domain=list(names), range=[colours.get(name) or next(spare) for name in names])


def ordered(rows: Sequence[Row], key: str, first: Mapping[str, str]) -> list[str]:
    """The values of a column: the known ones in their order, then the others by name."""
    values = {str(row[key]) for row in rows}
    return [name for name in first if name in values] + sorted(values - set(first))


def success(rows: Sequence[Row]) -> str:
    """Success with intervals: rows of cell, perturbation, policy, success, low, high."""
    policies = ordered(rows, "policy", POLICY_COLOURS)
    cells = list(dict.fromkeys(row["cell"] for row in rows))
    perturbations = list(dict.fromkeys(row["perturbation"] for row in rows))
    base = plot(rows).encode(
        y=alt.Y("cell:N", sort=cells, title=None, axis=alt.Axis(grid=False, ticks=False)),
        yOffset=alt.YOffset("policy:N", sort=policies),
        color=alt.Color("policy:N", scale=scale(policies, POLICY_COLOURS), sort=policies),
    )
    percent = alt.Axis(format="%", values=[0, 0.25, 0.5, 0.75, 1])
    x_scale = alt.Scale(domain=[0, 1])
    bars = base.mark_rule(strokeWidth=3, opacity=0.45).encode(
        x=alt.X("low:Q", title=None, axis=percent, scale=x_scale), x2="high:Q"
    )
    dots = base.mark_circle(size=70, opacity=1).encode(x=alt.X("success:Q", scale=x_scale))
    layered = alt.layer(bars, dots).properties(width=235, height=46 * max(len(cells), 1))
    return svg(layered.facet(column=alt.Column("perturbation:N", sort=perturbations)))


def lines(
    rows: Sequence[Row],
    *,
    x: str,
    y: str,
    series: str,
    x_title: str,
    y_title: str,
    colours: Mapping[str, str] = CONDITION_COLOURS,
    percent: bool = False,
    log: bool = False,
    points: bool = False,
    marker: float | None = None,
) -> str:
    """Lines over training; `marker` is a vertical line (the step of the kept checkpoint)."""
    names = ordered(rows, series, colours)
    # A line of a single point would not be seen.
    points = points or len({row[x] for row in rows}) < FEW_POINTS
    axis = alt.Axis(format="%") if percent else alt.Axis(format="~g")
    y_scale = alt.Scale(domain=[0, 1]) if percent else alt.Scale(type="log" if log else "linear")
    line = (
        plot(rows)
        .mark_line(strokeWidth=2, point={"size": 28, "filled": True} if points else False)
        .encode(
            x=alt.X(f"{x}:Q", title=x_title, axis=alt.Axis(format="~s", grid=False)),
            y=alt.Y(f"{y}:Q", title=y_title, axis=axis, scale=y_scale),
            color=alt.Color(f"{series}:N", scale=scale(names, colours), sort=names),
        )
    )
    chart: Any = line
    if marker is not None:
        rule = (
            plot([{"at": marker, "text": "kept"}])
            .mark_rule(strokeDash=[4, 3], color="#0f172a")
            .encode(x="at:Q")
        )
        text = (
            plot([{"at": marker, "text": "kept"}])
            .mark_text(align="right", dx=-4, dy=-6, baseline="bottom", fontSize=11)
            .encode(x="at:Q", y=alt.value(230), text="text:N")
        )
        chart = alt.layer(line, rule, text)
    return svg(chart.properties(width=430, height=230))


def ages(rows: Sequence[Row]) -> str:
    """Age histograms by source: rows of source, bucket (text), order, share."""
    sources = ordered(rows, "source", SOURCE_COLOURS)
    buckets = [row["bucket"] for row in sorted(rows, key=lambda row: row["order"])]
    chart = (
        plot(rows)
        .mark_bar(cornerRadiusEnd=2)
        .encode(
            x=alt.X(
                "bucket:N",
                sort=list(dict.fromkeys(buckets)),
                title=None,
                axis=alt.Axis(labelAngle=-35, grid=False),
            ),
            y=alt.Y("share:Q", title="share of sampled rows", axis=alt.Axis(format="%")),
            color=alt.Color("source:N", scale=scale(sources, SOURCE_COLOURS), sort=sources),
        )
    )
    return svg(chart.properties(width=430, height=200))


def stacked(rows: Sequence[Row], *, group: str, part: str, value: str) -> str:
    """One horizontal bar per group, split into parts that sum to one."""
    parts = list(dict.fromkeys(row[part] for row in rows))
    groups = list(dict.fromkeys(row[group] for row in rows))
    chart = (
        plot(rows)
        .mark_bar()
        .encode(
            y=alt.Y(f"{group}:N", sort=groups, title=None, axis=alt.Axis(grid=False, ticks=False)),
            x=alt.X(f"{value}:Q", stack="normalize", title=None, axis=alt.Axis(format="%")),
            color=alt.Color(f"{part}:N", scale=scale(parts, CONDITION_COLOURS), sort=parts),
        )
    )
    return svg(chart.properties(width=430, height=30 * max(len(groups), 1)))
