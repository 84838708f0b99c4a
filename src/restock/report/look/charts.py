"""The pages' charts: functions from rows to SVG and its Vega-Lite specification.

A chart is drawn at several widths and never scaled, so that text has the same size in every figure
and on every screen. The result is a `Drawing`: the SVG by width in CSS pixels. The page shows the
widest that fits, and `write.live` makes it interactive. A condition, source or policy has the same
colour in every chart; `blocks.DARK` has the colours for a dark background.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from itertools import count
from typing import Any

import altair as alt
import numpy as np
import vl_convert

from restock.report.look.blocks import (
    SPARE_COLOURS,
    WORDS_COLOURS,
    Drawing,
    Rows,
    palette,
    words,
)

Row = Mapping[str, Any]

HALF = (300, 470)  # widths of a figure that takes half of a line on a desktop
FULL = (300, 630, 1000)  # widths of a figure that takes a full line

POLICY_COLOURS = {
    "agent": "#0f766e",
    "cloned": "#7c3aed",
    "planner": "#b45309",
    "operator": "#2563eb",
    "random": "#9ca3af",
}
# Colours of other policies, distinct from each other and from POLICY_COLOURS in both themes.
POLICY_SPARES = ("#be185d", "#b58900", "#0c98dd", "#111827", "#7f1d1d", "#cc79a7", "#84643a")

FEW_POINTS = 10  # a line with fewer points than this shows each of them
STEPS = {"env_steps": "environment steps", "gradient_steps": "updates"}
SHORT_NUMBERS = "format(datum.value, '~s')"  # 0, 500, 50k; `format="~s"` of an axis would write 0k
LETTER_PX = 5.8  # approximate width of a letter of a label
WIDER_FONT = 0.15  # the reader's font may make a label wider by this share
FONT = "Inter, Helvetica Neue, Helvetica, Arial, Liberation Sans, sans-serif"

CONFIG = {
    "background": "transparent",
    "font": FONT,
    "view": {"stroke": None},
    "mark": {"tooltip": True},  # shows the fields that the chart encodes
    "axis": {
        "labelColor": "#475569",
        "titleColor": "#475569",
        "titleFontWeight": 500,
        "labelFontSize": 12,
        "titleFontSize": 12,
        "gridColor": "#e2e8f0",
        "domainColor": "#cbd5e1",
        "tickColor": "#cbd5e1",
        "labelOverlap": "greedy",
        "labelSeparation": 6,
        "labelLimit": 220,
    },
    "legend": {
        "labelFontSize": 12,
        "labelColor": "#334155",
        "title": None,
        "titleColor": "#475569",
        "titleFontSize": 12,
        "titleFontWeight": 500,
        "orient": "top",
    },
    "header": {"labelFontSize": 12, "labelFontWeight": 600, "labelColor": "#0f172a", "title": None},
    "range": {"category": list(SPARE_COLOURS)},
}
_numbers = count()


def plot(rows: Sequence[Row]) -> Any:
    """Make a chart that contains its rows; NaN and infinite values leave gaps."""
    values = [{name: _shown(value) for name, value in row.items()} for row in rows]
    return alt.Chart(alt.InlineData(values=values))


def _shown(value: Any) -> Any:
    """Replace NaN and infinity, which JSON lacks, by None."""
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value


def draw(chart_of: Callable[[int], Any], widths: Sequence[int] = HALF) -> Drawing:
    """Draw a chart at several widths; `chart_of` makes the chart for a width.

    The width includes axes and legend. Facet charts are not fitted: `chart_of` sets their widths.
    """
    spec = {width: _fitted(chart_of(width), width) for width in widths}
    return Drawing({width: _svg(one) for width, one in spec.items()}, spec)


def _fitted(chart: Any, width: int) -> dict[str, Any]:
    if not isinstance(chart, alt.FacetChart):
        fit = alt.AutoSizeParams(type="fit-x", contains="padding")
        chart = chart.properties(width=width, autosize=fit)
    spec: dict[str, Any] = chart.configure(**CONFIG).to_dict()
    return spec


def _svg(spec: dict[str, Any]) -> str:
    """Draw a chart as SVG, with element ids that no other drawing on the page has."""
    svg, number = str(vl_convert.vegalite_to_svg(spec)), next(_numbers)
    return re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>d{number}-", svg)


def legend(names: Sequence[str], width: int, labels_px: int = 60) -> alt.Legend:
    """Place a legend above the chart, in as many columns as fit beside its axis labels."""
    longest = max((len(name) for name in names), default=1) * LETTER_PX
    apart = 10 + WIDER_FONT * longest  # between columns, with room for a wider font
    columns = max(1, min(len(names), int((width - labels_px) // (longest + 26 + apart))))
    # Names often differ only at the end: cut a name only if the chart is too narrow for it.
    limit = max(width - labels_px - 30, 160)
    return alt.Legend(columns=columns, columnPadding=apart, symbolOpacity=1, labelLimit=limit)


def coloured(
    field: str,
    names: Sequence[str],
    colours: Mapping[str, str],
    width: int,
    labels_px: int = 60,
) -> alt.Color:
    """Encode the names in a column as colours, with a legend in the order of `names`."""
    found = palette(names, colours, POLICY_SPARES if colours is POLICY_COLOURS else SPARE_COLOURS)
    return alt.Color(
        f"{field}:N",
        scale=alt.Scale(domain=list(names), range=[found[name] for name in names]),
        legend=legend(names, width, labels_px),
    )


def label_px(names: Sequence[str]) -> int:
    """Estimate the width of an axis' labels, in pixels."""
    return round(max((len(name) for name in names), default=0) * LETTER_PX) + 14


def ordered(rows: Sequence[Row], key: str, first: Mapping[str, str]) -> list[str]:
    """Return the values of a column: those in `first` in its order, then the others by name."""
    values = {str(row[key]) for row in rows}
    return [name for name in first if name in values] + sorted(values - set(first))


def side_by_side(layered: Any, key: str, names: Sequence[str], width: int, labels_px: int) -> Any:
    """Make a layered chart for each value of `key`, side by side if there is room.

    `labels_px` is the width of the labels of the vertical axis.
    """
    beside = (width - labels_px) // max(len(names), 1) - 24
    if len(names) > 1 and beside < 150:
        panel = layered.properties(width=max(width - labels_px - 24, 90))
        header = alt.Header(orient="top", labelAnchor="start", labelPadding=4)
        return panel.facet(row=alt.Row(f"{key}:N", sort=list(names), header=header))
    panel = layered.properties(width=max(beside, 90))
    return panel.facet(column=alt.Column(f"{key}:N", sort=list(names)))


def in_words(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the rows with conditions as words, without underscores."""
    return [{**row, "condition": words(row["condition"])} for row in rows]


def estimates(
    rows: Sequence[Row],
    *,
    y: str,
    series: str,
    names: Sequence[str],
    colours: Mapping[str, str],
    value: str,
    ends: tuple[str, str],
    title: str | None = None,
    axis: Any = alt.Undefined,
    x_scale: Any = alt.Undefined,
    neutral: float | None = None,
    tick: str | None = None,
    beside: str | None = None,
) -> Drawing:
    """Draw a dot and its interval for each series, in a line for each value of column `y`.

    A dashed line marks the `neutral` value, which means no difference. A tick marks the value of
    the column `tick`. Each value of the column `beside` gets a chart of its own, side by side.
    """
    lines_of = list(dict.fromkeys(str(row[y]) for row in rows))
    labels_px, (low, high) = label_px(lines_of), ends
    known = any(row[low] is not None for row in rows)

    def chart(width: int) -> Any:
        base = plot(rows).encode(
            y=alt.Y(f"{y}:N", sort=lines_of, title=None, axis=_QUIET),
            yOffset=alt.YOffset(f"{series}:N", sort=list(names)),
            color=coloured(series, names, colours, width, labels_px),
        )

        def along(column: str) -> alt.X:
            return alt.X(f"{column}:Q", title=title, axis=axis, scale=x_scale)

        bars = base.transform_filter(f"isValid(datum.{low})").mark_rule(strokeWidth=3, opacity=0.45)
        layers = [bars.encode(x=along(low), x2=f"{high}:Q")] if known else []
        layers.append(base.mark_circle(size=70, opacity=1).encode(x=along(value)))
        if tick is not None:
            layers.append(base.mark_tick(thickness=2, size=9).encode(x=along(tick)))
        if neutral is not None:
            rule = plot([{"at": neutral}]).mark_rule(strokeDash=[4, 3], color="#475569")
            layers.insert(0, rule.encode(x="at:Q"))
        layered = alt.layer(*layers).properties(height=(16 * len(names) + 18) * len(lines_of))
        if beside is None:
            return layered
        across = list(dict.fromkeys(row[beside] for row in rows))
        return side_by_side(layered, beside, across, width, labels_px)

    return draw(chart, HALF if beside is None else FULL)


def success(rows: Sequence[Row]) -> Drawing:
    """Draw success by condition and policy with intervals, perturbations side by side."""
    return estimates(
        rows,
        y="condition",
        series="policy",
        names=ordered(rows, "policy", POLICY_COLOURS),
        colours=POLICY_COLOURS,
        value="success",
        ends=("success_low", "success_high"),
        axis=_PERCENT,
        x_scale=_SHARE,
        beside="perturbation",
    )


def lines(
    rows: Sequence[Row],
    *,
    x: str,
    y: str,
    series: str,
    y_title: str,
    colours: Mapping[str, str] = WORDS_COLOURS,
    percent: bool = False,
    marker: float | None = None,
) -> Drawing:
    """Draw lines over training, by `env_steps` or `gradient_steps`.

    With `percent`, values are shares. `marker` is the step of the kept checkpoint.
    """
    names = ordered(rows, series, colours)
    # A line with a single point would be invisible.
    points = percent or len({row[x] for row in rows}) < FEW_POINTS
    axis = alt.Axis(format=".1~%") if percent else alt.Axis(format="~g")
    y_scale = _SHARE if percent else alt.Undefined

    def chart(width: int) -> Any:
        base = plot(rows).encode(
            x=alt.X(
                f"{x}:Q",
                title=STEPS[x],
                axis=x_axis(width),
            ),
            color=coloured(series, names, colours, width),
        )
        line = base.mark_line(
            strokeWidth=2,
            point={"size": 28, "filled": True} if points else False,
        ).encode(y=alt.Y(f"{y}:Q", title=y_title, axis=axis, scale=y_scale))
        layers = [line]
        if marker is not None:
            at = plot([{"at": marker, "text": "kept"}]).encode(x="at:Q")
            early = marker < max(row[x] for row in rows) / 2  # the text fits only on the right
            layers.append(at.mark_rule(strokeDash=[4, 3], color="#0f172a"))
            layers.append(
                at.mark_text(
                    align="left" if early else "right",
                    dx=4 if early else -4,
                    dy=-6,
                    baseline="bottom",
                    fontSize=12,
                    color="#475569",
                ).encode(y=alt.value(230), text="text:N")
            )
        return (alt.layer(*layers) if len(layers) > 1 else line).properties(height=230)

    return draw(chart)


def x_axis(width: int, labels: str = SHORT_NUMBERS) -> alt.Axis:
    """Return a horizontal axis of counts, with no more labels than fit."""
    return alt.Axis(labelExpr=labels, grid=False, tickCount=max(3, width // 80))


def shares(rows: Sequence[Row], y: str, colours: Mapping[str, str]) -> Drawing:
    """Draw a bar for each kind of share, on a square-root axis so that small shares can be seen.

    Args:
        rows: rows with a name in column `y`, a `kind` and a `share`.
        colours: kind -> colour.
    """
    names = list(dict.fromkeys(row[y] for row in rows))

    def chart(width: int) -> Any:
        marks = [0, 0.01, 0.05, 0.1, 0.25, 0.5, 0.75, 1]
        return (
            plot(rows)
            .mark_bar(cornerRadiusEnd=2)
            .encode(
                y=alt.Y(f"{y}:N", sort=names, title=None, axis=_QUIET),
                yOffset=alt.YOffset("kind:N", sort=list(colours)),
                x=alt.X(
                    "share:Q",
                    title="share of rows (square-root axis)",
                    scale=alt.Scale(type="sqrt"),
                    axis=alt.Axis(format=".1~%", values=marks),
                ),
                color=coloured("kind", list(colours), colours, width, label_px(names)),
            )
            .properties(height=(16 * len(colours) + 4) * max(len(names), 1))
        )

    return draw(chart)


_PERCENT = alt.Axis(format=".1~%", values=[0, 0.25, 0.5, 0.75, 1])
_SHARE = alt.Scale(domain=[0, 1])
_QUIET = alt.Axis(grid=False, ticks=False)


def intervals(rows: Rows, arms: list[str]) -> Drawing:
    """Draw success by condition, from rows of arm, condition, value, low, high (None: unknown)."""
    return estimates(
        _by_condition(in_words(rows)),
        y="condition",
        series="arm",
        names=arms,
        colours=POLICY_COLOURS,
        value="value",
        ends=("low", "high"),
        title="success",
        axis=_PERCENT,
        x_scale=_SHARE,
    )


def differences(rows: Rows) -> Drawing:
    """Draw differences in success by condition and perturbation, in points."""
    ends = "difference_low", "difference_high"
    shown: Rows = [
        {
            "perturbation": "clean" if row["perturbation"] == "none" else row["perturbation"],
            "condition": words(row["condition"]),
            **{n: None if row[n] is None else 100 * row[n] for n in ("difference", *ends)},
        }
        for row in rows
    ]
    names = list(dict.fromkeys(row["perturbation"] for row in shown))
    return estimates(
        _by_condition(shown),
        y="condition",
        series="perturbation",
        names=names,
        colours=POLICY_COLOURS,
        value="difference",
        ends=ends,
        title="difference in success (points)",
        neutral=0.0,
    )


def curves(rows: Rows, arms: list[str]) -> Drawing:
    """Draw success over environment steps for each condition, with bands for intervals."""
    shown = in_words(rows)
    conditions = ordered(shown, "condition", WORDS_COLOURS)

    def chart(width: int) -> Any:
        most = 1 if width < 600 else 2 if width < 900 else 4
        across = math.ceil(len(conditions) / math.ceil(len(conditions) / most))  # equal rows
        base = plot(shown).encode(
            x=alt.X("env_steps:Q", title="environment steps", axis=x_axis(width // across)),
            color=coloured("arm", arms, POLICY_COLOURS, width),
        )
        axis, domain = alt.Axis(format=".1~%"), alt.Scale(domain=[0, 1], padding=4)
        band = (
            base.transform_filter("isValid(datum.low)")
            .mark_area(opacity=0.18)
            .encode(y=alt.Y("low:Q", title="success", axis=axis, scale=domain), y2="high:Q")
        )
        line = base.mark_line(strokeWidth=2, point={"size": 26, "filled": True}).encode(
            y=alt.Y("success:Q", title="success", axis=axis, scale=domain)
        )
        panel = alt.layer(band, line).properties(
            width=(width - 70) // across - 20, height=170 if across > 1 else 140
        )
        header = alt.Header(labelAnchor="start")
        return panel.facet(
            facet=alt.Facet("condition:N", sort=conditions, header=header), columns=across
        )

    return draw(chart, FULL)


def _by_condition(rows: Rows) -> Rows:
    """Sort rows by condition, in the order that all pages use."""
    order = ordered(rows, "condition", WORDS_COLOURS)
    return sorted(rows, key=lambda row: order.index(row["condition"]))
