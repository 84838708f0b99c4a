"""The charts of methods beside each other, as rliable draws them (arXiv:2108.13264).

Intervals by condition, the probability of improvement, and learning curves with bands over seeds.
"""

from __future__ import annotations

import math
from typing import Any

import altair as alt

from restock.report.look import charts
from restock.report.look.blocks import Drawing, Rows, words
from restock.report.look.charts import POLICY_COLOURS

# None is a reference's: planner and operator have their colours of every report.
ARM_COLOURS = ("#0f766e", "#7c3aed", "#cc79a7", "#84643a", "#56b4e9", "#b58900", "#6b7280")
_PERCENT = alt.Axis(format="%", values=[0, 0.25, 0.5, 0.75, 1])
_SHARE = alt.Scale(domain=[0, 1])
_QUIET = alt.Axis(grid=False, ticks=False)


def colours(arms: list[str]) -> dict[str, str]:
    """Return a colour for each arm, the same in every chart; references have their own."""
    found = {arm: POLICY_COLOURS[arm] for arm in arms if arm in POLICY_COLOURS}
    free = [colour for colour in ARM_COLOURS if colour not in found.values()]
    others = [arm for arm in arms if arm not in found]
    return found | {arm: free[place % len(free)] for place, arm in enumerate(others)}


def intervals(rows: Rows, arms: list[str]) -> Drawing:
    """Draw success by condition: rows of arm, condition, value, low, high (None: unknown)."""
    conditions = _conditions(rows)
    shown = charts.in_words(rows)
    known = [row for row in shown if row["low"] is not None]

    def chart(width: int) -> Any:
        def base(of: Rows) -> Any:
            return charts.plot(of).encode(
                y=alt.Y("condition:N", sort=conditions, title=None, axis=_QUIET),
                yOffset=alt.YOffset("arm:N", sort=arms),
                color=charts.coloured(
                    "arm", arms, colours(arms), width, charts.label_px(conditions)
                ),
            )

        bars = (
            base(known)
            .mark_bar(size=10, opacity=0.35)
            .encode(x=alt.X("low:Q", title="success", axis=_PERCENT, scale=_SHARE), x2="high:Q")
        )
        ticks = (
            base(shown)
            .mark_tick(thickness=3, size=14)
            .encode(x=alt.X("value:Q", title="success", axis=_PERCENT, scale=_SHARE))
        )
        layers = [bars, ticks] if known else [ticks]
        return alt.layer(*layers).properties(height=(16 * len(arms) + 18) * len(conditions))

    return charts.draw(chart)


def differences(rows: Rows) -> Drawing:
    """Draw differences in success by condition, perturbations side by side."""
    shown = _outcomes(rows)
    return _forest(shown, "difference", "difference in success (points)", 0.0, scale=alt.Scale())


def improvements(rows: Rows) -> Drawing:
    """Draw the probability that the second arm's return is higher."""
    shown = _outcomes(rows)
    return _forest(shown, "improvement", "P(higher return)", 0.5, scale=alt.Scale(domain=[0, 1]))


def _forest(rows: Rows, value: str, title: str, neutral: float, *, scale: alt.Scale) -> Drawing:
    """Draw a dot and its interval for each condition, beside the value of no difference."""
    conditions = _conditions(rows)
    perturbations = list(dict.fromkeys(row["perturbation"] for row in rows))
    low, high = f"{value}_low", f"{value}_high"

    def chart(width: int) -> Any:
        base = charts.plot(rows).encode(
            y=alt.Y("condition:N", sort=conditions, title=None, axis=_QUIET),
            yOffset=alt.YOffset("perturbation:N", sort=perturbations),
            color=alt.Color(
                "perturbation:N",
                sort=perturbations,
                scale=charts.scale(perturbations, colours(perturbations)),
                legend=charts.legend(perturbations, width, charts.label_px(conditions))
                if len(perturbations) > 1
                else None,
            ),
        )
        dots = base.mark_circle(size=70, opacity=1).encode(
            x=alt.X(f"{value}:Q", title=title, scale=scale)
        )
        bars = (
            base.transform_filter(f"isValid(datum.{low})")
            .mark_rule(strokeWidth=3, opacity=0.5)
            .encode(x=alt.X(f"{low}:Q", title=title, scale=scale), x2=f"{high}:Q")
        )
        rule = charts.plot([{"at": neutral}]).mark_rule(strokeDash=[4, 3], color="#475569")
        layers = alt.layer(rule.encode(x="at:Q"), bars, dots)
        return layers.properties(height=(16 * len(perturbations) + 18) * len(conditions))

    return charts.draw(chart)


def curves(rows: Rows, arms: list[str]) -> Drawing:
    """Draw success over environment steps for each condition, with bands for intervals."""
    conditions = _conditions(rows)
    shown = charts.in_words(rows)

    def chart(width: int) -> Any:
        most = 1 if width < 600 else 2 if width < 900 else 4
        across = math.ceil(len(conditions) / math.ceil(len(conditions) / most))  # even lines
        base = charts.plot(shown).encode(
            x=alt.X("env_steps:Q", title="environment steps", axis=charts.x_axis(width // across)),
            color=charts.coloured("arm", arms, colours(arms), width),
        )
        axis, domain = alt.Axis(format="%"), alt.Scale(domain=[0, 1], padding=4)
        band = (
            base.transform_filter("isValid(datum.low)")
            .mark_area(opacity=0.18)
            .encode(y=alt.Y("low:Q", title="success", axis=axis, scale=domain), y2="high:Q")
        )
        line = base.mark_line(strokeWidth=2, point={"size": 26, "filled": True}).encode(
            y=alt.Y("success:Q", title="success", axis=axis, scale=domain)
        )
        each = alt.layer(band, line).properties(
            width=(width - 70) // across - 20, height=170 if across > 1 else 140
        )
        header = alt.Header(labelAnchor="start")
        return each.facet(
            facet=alt.Facet("condition:N", sort=conditions, header=header), columns=across
        )

    return charts.draw(chart, charts.FULL)


def _outcomes(rows: Rows) -> Rows:
    """Return outcomes with words for names, and differences in points."""
    points = ("difference", "difference_low", "difference_high")
    return [
        {
            "perturbation": "clean" if row["perturbation"] == "none" else row["perturbation"],
            "condition": words(row["condition"]),
            **{name: None if row[name] is None else 100 * row[name] for name in points},
            "improvement": row["improvement"],
            "improvement_low": row.get("improvement_low"),
            "improvement_high": row.get("improvement_high"),
        }
        for row in rows
    ]


def _conditions(rows: Rows) -> list[str]:
    """Return conditions as words, in the order of every page."""
    named = [{"condition": words(row["condition"])} for row in rows]
    return charts.ordered(named, "condition", charts.WORDS_COLOURS)


__all__ = ["colours", "curves", "differences", "improvements", "intervals"]
