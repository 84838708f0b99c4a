"""The section on practice: which missions the twin gave, over the run, and how they went."""

from __future__ import annotations

from typing import Any

from restock.report.look import charts
from restock.report.look.blocks import Drawing, Figure, Rows, Section, Table, count, percent, words
from restock.report.run.facts import Facts


def practice_section(facts: Facts) -> Section | None:
    """Return the section on practice; None if the run has no record of it."""
    rows = by_arm(facts)
    if not rows:
        return None
    shown = [
        {
            "missions": words(row["arm"]),
            "natural": percent(row["natural_share"]),
            "wanted at first": percent(row["first_share"]),
            "wanted at last": percent(row["last_share"]),
            "given": percent(row["given_share"]),
            "ended": count(row["episodes"]),
            "success, exploring": "" if row["success"] is None else f"{row['success']:.2f}",
        }
        for row in rows
    ]
    rule = rows[0]["rule"]
    return Section(
        "practice",
        "What did it practise?",
        intro=f"Missions in the twin, by the rule “{rule}”. Shares are of missions that ended "
        "while the agent explored; its success is lower there than in evaluations.",
        figures=[] if rule in FIXED else [Figure(_shares(facts.practice), "Wanted shares")],
        tables=[Table(shown, set(shown[0]) - {"missions"})],
    )


FIXED = ("natural", "even", "shares", "logs", "missions")


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


def _shares(rows: Rows) -> Drawing:
    return charts.lines(
        charts.in_words(rows, "arm"),
        x="env_steps",
        y="wanted_share",
        series="arm",
        y_title="share of missions",
        percent=True,
        steps=True,
    )


__all__ = ["by_arm", "practice_section"]
