"""Sections on the feed: rows and their sources, missions practised, and actions."""

from __future__ import annotations

from restock.replay.plan.exclusions import DAY_NS
from restock.report.look import charts
from restock.report.look.blocks import Figure, Rows, Section, Table, shown, words
from restock.report.run.facts import Facts, evaluation_bias

# Columns of tables and their titles, on the page and on the replay card.
FED = {
    "stratum": "stratum",
    **{f"{name}_share": name for name in ("natural", "wanted", "drawn")},
    **{"logs_share": "from logs", "fresh_share": "fresh", "short_share": "short"},
    "reason": "why short",
}
AGES = {name: name for name in ("source", "unit", "rows", "p50", "p90", "p99")}
POLICIES = {"source": "source", "behaviour_policy": "policy", "rows": "rows", "share": "share"}
PRACTICE = {
    **{"arm": "missions", "natural_share": "natural", "first_share": "wanted at first"},
    **{"last_share": "wanted at last", "given_share": "given", "episodes": "ended"},
}
ACTIONS = {
    **{"condition": "condition", "name": "action", "wanted_share": "wanted"},
    **{"logged_share": "in the logs", "drawn_share": "in fresh rows"},
    "audited_rows": "rows checked",
}
SHARE_COLOURS = {"natural": "#cbd5e1", "wanted": "#94a3b8", "drawn": "#0f766e"}


def sampled(facts: Facts) -> Section:
    """Show what the critic was fed: the section that matters most."""
    rows: Rows = [
        {"stratum": words(row["stratum"]), "kind": kind, "share": row[f"{kind}_share"]}
        for row in facts.fed
        for kind in SHARE_COLOURS
    ]
    figures = [Figure(charts.shares(rows, "stratum", SHARE_COLOURS))] if rows else []
    return Section(
        "fed",
        "What was the critic fed?",
        intro="The replay mix is the training distribution. A quota is a stratum's share of the "
        "batch, whether its rows are logged or fresh. Natural: the share under uniform draws from "
        "the same sources. Wanted: the quota. Drawn: the share of all rows fed in the whole run.",
        callout=evaluation_bias(facts),
        figures=figures,
        tables=[
            Table(shown(facts.fed, FED)),
            Table(
                shown(facts.ages, AGES),
                title="How old the sampled rows were",
                caption="Upper ends of log2 buckets: days before training began for logs"
                f"{_newest(facts)}, environment steps since they were collected for fresh rows.",
            ),
            Table(shown(facts.policies, POLICIES), title="Who drove the sampled rows"),
        ],
    )


def _newest(facts: Facts) -> str:
    """Return the age of the panel's newest row: what is only as old is not stale."""
    began_ns = facts.config.get("created_ns")
    if facts.panel is None or began_ns is None:
        return ""
    days = (began_ns - facts.panel.header.newest_ns) / DAY_NS
    return f" (the panel's newest row was {days:,.1f} days old then)"


def practice_section(facts: Facts) -> Section | None:
    """Return the section on practice; None if the run has no record of it."""
    if not facts.practice:
        return None
    return Section(
        "practice",
        "What did it practise?",
        intro=f"Missions in the twin, by the rule “{facts.practice[0]['rule']}”. Shares are of "
        "missions that ended while the agent explored; its success is lower there than in "
        "evaluations.",
        tables=[Table(shown(facts.practice, PRACTICE | {"success": "success, exploring"}))],
    )


def actions_section(facts: Facts) -> Section | None:
    """Return the section on actions; None if the policy prefers none that the logs lack."""
    if not facts.actions:
        return None
    return Section(
        "actions",
        "Which actions does the policy prefer that the logs lack?",
        intro="Actions that the policy would take in fresh rows (of audited batches, in the last"
        " quarter of the updates) more than twice as often as they are in the sampled logged rows"
        " of the condition. The logs do not show the outcome of an action that is not in them;"
        " `restock diagnose` tells whether that causes failures. Actions are named by their m/s and"
        " rad/s.",
        tables=[Table(shown(facts.actions, ACTIONS))],
    )
