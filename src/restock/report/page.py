"""The page: facts to headline, cards and sections. The template only lays them out."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from restock.report import logs_alone
from restock.report.actions import actions_section
from restock.report.blocks import span, words
from restock.report.capacity import capacity_section
from restock.report.facts import Facts, mean_success
from restock.report.labels import labels_section
from restock.report.practice import practice_section
from restock.report.sections import critic, floor_section, learning, provenance, sampled, success
from restock.report.twin_gap import find_gap, run_section
from restock.train.twin.calibration.twin_gap import TRUSTED

REFERENCES = {
    "cloned": "a clone of whoever drove in the logs",
    "planner": "the scripted planner",
    "random": "a random policy",
}


def page(facts: Facts) -> dict[str, Any]:
    """Everything the template asks for."""
    sections = [
        success(facts) if facts.twin else logs_alone.judged_section(facts),
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
        "headline": _headline(facts),
        "lead": _lead(facts),
        "cards": _cards(facts),
        "sections": [section for section in sections if section is not None],
        "footer": f"restock {facts.config.get('versions', {}).get('restock', '')} · written"
        f" {datetime.now(UTC):%Y-%m-%d %H:%M} UTC from {facts.run}",
    }


def _headline(facts: Facts) -> str:
    if not facts.twin:
        return logs_alone.headline(facts)
    cells = facts.clean_cells()
    if not cells:
        return f"Run {facts.run.name}: trained, not yet evaluated"
    if facts.no_goal:
        mean = sum(row["return"] for row in cells) / len(cells)
        return f"No goal, so no success: mean return {mean:.2f} over {len(cells)} kinds of episode"
    average, random = mean_success(cells), facts.clean_cells("random")
    if random and average <= mean_success(random):
        return (
            f"Nothing was learnt: success {average:.0%}, of a random policy"
            f" {mean_success(random):.0%}, on the same episodes"
        )
    worst = min(cells, key=lambda row: row["success"])
    return (
        f"Success {average:.0%} on average over {len(cells)} kinds of episode, "
        f"{worst['success']:.0%} in the hardest, {words(worst['cell'])}{_distrust(facts)}"
    )


def _distrust(facts: Facts) -> str:
    """What a success in the twin is worth little by: its gap to these logs."""
    gap = find_gap(facts)
    verdicts = () if gap is None else gap.verdicts
    nominal = next((each.verdict for each in verdicts if each.condition == "nominal"), TRUSTED)
    if nominal == TRUSTED:
        return ""
    return f": in a twin whose gap to these logs is {nominal} in nominal driving"


def _lead(facts: Facts) -> str:
    last = facts.loss[-1]
    if not facts.twin:
        return (
            f"A DQN trained on logs alone, without a twin, for {last['gradient_steps']:,} updates"
            f" in {span(last['wall_s'])}. Nothing has driven yet."
        )
    fed = "logs and fresh experience" if facts.panel is not None else "fresh experience alone"
    text = (
        f"A DQN trained on {fed} for {last['env_steps']:,} environment steps and"
        f" {last['gradient_steps']:,} updates in {span(last['wall_s'])}."
    )
    others = [
        f"{who} {mean_success(cells):.0%}"
        for name, who in REFERENCES.items()
        if (cells := facts.clean_cells(name)) and not facts.no_goal
    ]
    if others:
        text += f" Success on the same episodes: {', '.join(others)}."
    return text


def _cards(facts: Facts) -> list[dict[str, str]]:
    config = facts.config.get("config", {})
    replay, kept = config.get("replay", {}), facts.kept
    cards = []
    if facts.panel is not None:
        header = facts.panel.header
        cards.append({"value": f"{header.rows:,}", "label": f"logged rows in panel {header.id}"})
    if not facts.twin:
        return [
            *cards,
            {"value": f"{facts.loss[-1]['gradient_steps']:,}", "label": "updates"},
            {"value": facts.target_rule, "label": "target rule"},
        ]
    cards += [
        {
            "value": f"{replay.get('ring_capacity', 0):,}",
            "label": "capacity of the fresh ring, rows",
        },
        {"value": _sampling(facts), "label": "of each online batch from logs, by quotas"},
        {"value": facts.target_rule, "label": "target rule"},
        {"value": f"{facts.loss[-1]['env_steps']:,}", "label": "environment steps"},
    ]
    if kept is not None:
        cards.append(
            {
                "value": ("no goal" if kept["success"] is None else f"{kept['success']:.0%}")
                + f" at {kept['env_steps']:,}",
                "label": "kept checkpoint: greedy success, at environment step",
            }
        )
    return cards


def _sampling(facts: Facts) -> str:
    share = (facts.config.get("panel") or {}).get("logs_share")
    if facts.panel is None:
        return "0 %"
    return "?" if share is None else f"{share:.0%}"
