"""Sections on the feed: rows and weights, missions practised, and actions."""

from __future__ import annotations

from typing import Any

import altair as alt

from restock.replay.plan.exclusions import DAY_NS
from restock.report.look import charts
from restock.report.look.blocks import (
    Drawing,
    Figure,
    Rows,
    Section,
    Table,
    shown,
    words,
)
from restock.report.run.facts import Facts, evaluation_bias

_YEARS_FROM_DAYS = 512  # ages are in years from there on


def sampled(facts: Facts) -> Section:
    """Show what the critic was fed: the section that matters most."""
    of_shares = shares_figure(facts)
    figures = [] if of_shares is None else [of_shares]
    if facts.ages:
        figures.append(
            Figure(
                charts.ages(_age_rows(facts)),
                "How old the sampled rows were",
                f"The age of logs is in days (before training began{_newest(facts)}), that of "
                "fresh rows in environment steps since they were collected. The two are never "
                "pooled.",
            )
        )
    if facts.policies:
        policies = [{**row, "who": row["behaviour_policy"]} for row in facts.policies]
        stacked = charts.stacked(
            policies, group="source", part="who", value="share", colours=charts.POLICY_COLOURS
        )
        figures.append(Figure(stacked, "Behaviour policies of the sampled rows"))
    return Section(
        "fed",
        "What was the critic fed?",
        intro="The replay mix is the training distribution. A quota is a stratum's share of the "
        "batch, whether its rows are logged or fresh. Wanted: the quota. Drawn: the share of all "
        "rows fed. After weights: the share in the gradient.",
        callout=evaluation_bias(facts),
        figures=figures,
        two=True,
        tables=[*([fed_table(facts)] if facts.fed else []), source_table(facts)],
    )


def _newest(facts: Facts) -> str:
    """Return the age of the panel's newest row: what is only as old is not stale."""
    began_ns = facts.config.get("created_ns")
    if facts.panel is None or began_ns is None:
        return ""
    days = (began_ns - facts.panel.header.newest_ns) / DAY_NS
    age = f"{days:,.1f} days" if days < _YEARS_FROM_DAYS else f"{days / 365.25:.1f} years"
    return f"; the panel's newest row was {age} old then"


def _age_rows(facts: Facts) -> Rows:
    rows: Rows = []
    for row in facts.ages:
        unit = "d" if row["unit"] == "days" else "steps"
        text = f"< 1 {unit}" if row["bucket"] < 0 else _span(2 ** row["bucket"], unit)
        rows.append(
            {
                "source": row["source"],
                "bucket": text,
                "order": row["bucket"] + (0 if unit == "d" else 100),
                "share": row["share"],
            }
        )
    return rows


def _span(low: int, unit: str) -> str:
    """Label ages from `low` to twice that, in years if they are that old."""
    if unit == "d" and low >= _YEARS_FROM_DAYS:
        return f"{low / 365.25:.1f} to {2 * low / 365.25:.1f} y"
    return f"{_short(low)} to {_short(2 * low)} {unit}"


def _short(value: int) -> str:
    return f"{value / 1024:.0f}k" if value >= 1024 else str(value)


SHARE_COLOURS = {
    "natural": "#cbd5e1",
    "wanted": "#94a3b8",
    "drawn": "#0f766e",
}


def shares_figure(facts: Facts) -> Figure | None:
    """Chart three bars per stratum; None for a run without a panel."""
    rows = [
        {"stratum": words(row["stratum"]), "kind": kind, "share": row[f"{kind}_share"]}
        for row in facts.fed
        for kind in SHARE_COLOURS
    ]
    return Figure(_share_chart(rows), "All rows fed: natural, wanted and drawn") if rows else None


def fed_table(facts: Facts) -> Table:
    """Show the feed in numbers, with sources, shortages and their reasons."""
    columns = {
        "stratum": "stratum",
        **{f"{name}_share": name for name in ("natural", "wanted", "drawn")},
        **{"logs_share": "from logs", "fresh_share": "fresh", "short_share": "short"},
        **{"drawn_rows": "rows drawn", "reason": "why short"},
    }
    return Table(
        shown(facts.fed, columns),
        caption="Shares are of all rows fed, over the whole run. Natural: the share under uniform "
        "draws from the same sources.",
    )


def source_table(facts: Facts) -> Table:
    """Show the rows of each source by stratum, also after weights."""
    rows = [
        row | {"replays": f"{row['drawn_rows'] / there:.1f}" if there else ""}
        for row in facts.sampled
        for there in [row["available_rows"]]
    ]
    columns = {
        **{name: name for name in ("source", "stratum", "timing")},
        **{"available_rows": "available", "drawn_share": "drawn"},
        **{"effective_share": "after weights", "drawn_rows": "rows drawn"},
        **{"replays": "replays per row", "reward_mean": "mean reward"},
        "terminal_share": "terminal",
    }
    return Table(
        shown(rows, columns),
        caption="Shares are of the source. Replays per row: rows drawn divided by rows available "
        "at the end; for a ring that was overwritten, this is an upper bound.",
    )


def _share_chart(rows: Rows) -> Drawing:
    """Draw bars on a square-root axis, so that rare strata can be seen."""
    strata = list(dict.fromkeys(row["stratum"] for row in rows))
    kinds = charts.ordered(rows, "kind", SHARE_COLOURS)

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
                    axis=alt.Axis(format=".1~%", values=marks),
                ),
                color=charts.coloured("kind", kinds, SHARE_COLOURS, width, charts.label_px(strata)),
            )
            .properties(height=52 * max(len(strata), 1))
        )

    return charts.draw(chart)


def practice_section(facts: Facts) -> Section | None:
    """Return the section on practice; None if the run has no record of it."""
    rows = by_arm(facts)
    if not rows:
        return None
    columns = {
        **{"arm": "missions", "natural_share": "natural", "first_share": "wanted at first"},
        **{"last_share": "wanted at last", "given_share": "given", "episodes": "ended"},
        "success": "success, exploring",
    }
    rule = rows[0]["rule"]
    return Section(
        "practice",
        "What did it practise?",
        intro=f"Missions in the twin, by the rule “{rule}”. Shares are of missions that ended "
        "while the agent explored; its success is lower there than in evaluations.",
        tables=[Table(shown(rows, columns))],
    )


def by_arm(facts: Facts) -> Rows:
    """Return a row for each arm: its first and last shares, and all missions that ended."""
    arms: dict[str, dict[str, Any]] = {}
    for row in facts.practice:
        arm = arms.setdefault(
            row["arm"],
            {
                **{name: row[name] for name in ("rule", "arm", "condition", "natural_share")},
                "first_share": row["wanted_share"],
                "episodes": 0,
                "successes": 0.0,
            },
        )
        arm["last_share"] = row["wanted_share"]
        arm["episodes"] += row["episodes"]
        arm["successes"] += row["episodes"] * (row["success"] or 0.0)
    total = sum(arm["episodes"] for arm in arms.values())
    for arm in arms.values():
        ended, successes = arm["episodes"], arm.pop("successes")
        arm["given_share"] = ended / total if total else None
        arm["success"] = successes / ended if ended else None
    return list(arms.values())


_MIN_AUDITED = 20  # rows in which the policy was asked, for a line of the table
_LINES = 12


def actions_section(facts: Facts) -> Section | None:
    """Return the section on actions; None for a run that kept no such counts."""
    if not facts.actions:
        return None
    return Section(
        "actions",
        "Which actions does the policy prefer that the logs lack?",
        intro="The share of fresh rows in which the policy would take an action (from audited"
        " batches, in the last quarter of the updates), beside its share in the sampled rows of the"
        " condition. The logs do not show the outcome of an action that is not in them; `restock"
        " diagnose` tells whether that causes failures. Actions are named by their m/s and rad/s.",
        tables=_action_table(facts.actions),
    )


def _action_table(rows: Rows) -> list[Table]:
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
    columns = {
        **{"condition": "condition", "name": "action", "wanted_share": "wanted"},
        **{"logged_share": "in the logs", "drawn_share": "in fresh rows"},
        "audited_rows": "rows checked",
    }
    title = "Preferred more than twice as often as in the logs"
    lines = [row | {"logged_share": share} for _, share, row in gaps[:_LINES]]
    return [Table(shown(lines, columns), title=title)] if lines else []
