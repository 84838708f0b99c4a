"""The section on logged ways: the policy sent from where robots set out to where they went."""

from __future__ import annotations

from typing import Any

from restock.report.look.blocks import Section, Table, words
from restock.report.run.facts import Facts
from restock.stats import interval_text
from restock.words import policy_words

OWN = "agent"


def ways_section(facts: Facts) -> Section | None:
    """Show logged routes; None if none was driven, or nothing else was."""
    if not facts.ways:
        return None
    rows = sorted(
        facts.ways,
        key=lambda row: (
            *(row["perturbation"] != "none", row["cell"] != "nominal", row["cell"]),
            *(row["policy"] != OWN, row["policy"]),
        ),
    )
    names = policy_words(row["policy"] for row in rows)
    shown: list[dict[str, Any]] = [
        {
            "kind of episode": words(row["cell"])
            + ("" if row["perturbation"] == "none" else f", {row['perturbation']}"),
            "policy": names[row["policy"]],
            "success": interval_text(
                row["success"], row["success_low"], row["success_high"], ".0%"
            ),
            "ways": row["episodes"],
            "bumps an episode": f"{row['bumps_per_episode']:.2f}",
            "time to goal": "" if row["time_s"] is None else f"{row['time_s']:.1f} s",
            "time lost to the planner": ""
            if row["time_lost_s"] is None or row["policy"] == "planner"
            else f"{row['time_lost_s']:+.1f} s",
        }
        for row in rows
    ]
    return Section(
        "ways",
        "And on routes that robots really drove?",
        intro="Start and goal of logged episodes, each route once, on the floor of the logs"
        f" (`restock eval --missions logged`). {facts.evaluation_on_ways}",
        tables=[
            Table(
                shown,
                set(shown[0]) - {"kind of episode", "policy"},
                title="Success on logged routes",
                caption="Intervals are 95 % Wilson intervals over routes; with few routes they "
                "are wide.",
            )
        ],
    )


__all__ = ["ways_section"]
