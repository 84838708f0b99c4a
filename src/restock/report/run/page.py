"""The page: facts to headline, cards and sections. The template only lays them out."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from restock.report.run import logs_alone
from restock.report.run.actions import actions_section
from restock.report.run.capacity import capacity_section
from restock.report.run.facts import Facts
from restock.report.run.films import films_section
from restock.report.run.headline import headline, lead
from restock.report.run.labels import labels_section
from restock.report.run.practice import practice_section
from restock.report.run.sections import (
    critic,
    floor_section,
    learning,
    provenance,
    sampled,
    success,
)
from restock.report.run.twin_gap import run_section
from restock.report.run.ways import ways_section
from restock.words import counted


def page(facts: Facts) -> dict[str, Any]:
    """Return everything that the page's template needs."""
    sections = [
        success(facts) if facts.twin else logs_alone.judged_section(facts),
        ways_section(facts),
        films_section(facts),
        sampled(facts),
        practice_section(facts),
        actions_section(facts),
        labels_section(facts),
        capacity_section(facts) if facts.twin else None,
        learning(facts),
        critic(facts),
        floor_section(facts),
        run_section(facts),
        provenance(facts),
    ]
    return {
        "kicker": "run report",
        "title": facts.run.name,
        "headline": headline(facts),
        "lead": lead(facts),
        "cards": _cards(facts),
        "sections": [section for section in sections if section is not None],
        "footer": f"restock {facts.config.get('versions', {}).get('restock', '')} · written"
        f" {datetime.now(UTC):%Y-%m-%d %H:%M} UTC from {facts.run}",
    }


def _cards(facts: Facts) -> list[dict[str, str]]:
    config = facts.config.get("config", {})
    replay, policy = config.get("replay", {}), facts.policy
    cards = []
    if facts.panel is not None:
        header = facts.panel.header
        cards.append({"value": f"{header.rows:,}", "label": f"logged rows in panel {header.id}"})
    if not facts.twin:
        return [
            *cards,
            {"value": f"{facts.trained['gradient_steps']:,}", "label": "updates"},
            {"value": facts.target_rule, "label": "target rule"},
        ]
    cards += [
        {
            "value": f"{replay.get('ring_capacity', 0):,}",
            "label": "capacity of the fresh ring, rows",
        },
        {"value": _sampling(facts), "label": "of the rows fed from logs"},
        {"value": facts.target_rule, "label": "target rule"},
        {"value": f"{facts.trained['env_steps']:,}", "label": "environment steps"},
    ]
    if policy is not None:
        made = counted(len({row["env_steps"] for row in facts.learning}), "evaluation")
        cards.append(
            {
                "value": f"{policy.env_steps:,}",
                "label": "environment step of the "
                + (
                    f"kept policy, the best of {made} in training"
                    if policy.chosen == "best"
                    else "latest policy; not evaluated in training"
                ),
            }
        )
    return cards


def _sampling(facts: Facts) -> str:
    if facts.panel is None and not facts.fed:
        return "0 %"
    rows = sum(row["drawn_rows"] for row in facts.sampled)
    logged = sum(row["drawn_rows"] for row in facts.sampled if row["source"] == "logs")
    return f"{logged / rows:.0%}" if rows else "?"
