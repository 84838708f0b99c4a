"""The replay card: one page, as Markdown and as JSON, about what a run's critic was fed.

A metric without its replay is half a result. The card answers a reviewer's questions: which policy,
capacity, sampling rule, age of the sampled rows, target rule, conditions in the batches, behaviour
policies and corrections, the mix after corrections, and the one imbalance most likely to make the
evaluation look better than deployment.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec

from restock.files import write_text
from restock.report.look import write
from restock.report.look.blocks import Rows, Section, Table, estimate, shown
from restock.report.run.facts import Facts, evaluation_bias, gather
from restock.report.run.page import AGES, FED, POLICIES, PRACTICE, feed_rules, in_words

FORMAT = "restock-replay-card/1"
_UNKNOWN = "unknown: run `restock eval` on a run whose panel and store are at hand"

_CONDITIONS = {
    "source": "source",
    "condition": "condition",
    "drawn_rows": "rows",
    "drawn_share": "drawn",
    "effective_share": "after weights",
    "td_abs_mean": "mean absolute TD error at the end",
}
_TEACHER = {
    "source": "source",
    "condition": "condition",
    "asked_rows": "states",
    "agreement": "behaviour network as the teacher",
    "plausible_actions": "plausible actions",
    "changed": "choice of Q changed",
    "chosen_agreement": "choice as the teacher",
}


def write_card(run: Path) -> tuple[dict[str, Any], str]:
    """Write the replay card into a run directory; return it as JSON values and as Markdown.

    Raises:
        RunError: there is no run in the directory, or it has logged no update yet.
    """
    card = replay_card(gather(run))
    markdown = as_markdown(card)
    write_text(run / "replay_card.json", json.dumps(card, indent=1, default=str) + "\n")
    write_text(run / "replay_card.md", markdown)
    return card, markdown


def replay_card(facts: Facts) -> dict[str, Any]:
    """Return the card as JSON values; None for a value that the run lacks."""
    settings = facts.config.get("config", {})
    teacher, panel = settings.get("teacher", {}), facts.panel
    mixture = msgspec.to_builtins(panel.header.mixture) if panel is not None else None
    logs = [row for row in facts.sampled if row["source"] == "logs"]
    return {
        "format": FORMAT,
        "run": str(facts.run),
        "policy": None if facts.policy is None else facts.policy.document,
        **feed_rules(facts),
        "fed": _columns(facts.fed, *FED, "drawn_rows"),
        "ages": facts.ages,
        "conditions": _columns(facts.conditions, *_CONDITIONS),
        "strata": _columns(
            facts.sampled,
            *("source", "stratum", "timing", "available_rows", "quota_share"),
            *("drawn_rows", "drawn_share", "effective_share", "terminal_share"),
        ),
        "practice": {
            "rule": settings.get("practice", {}).get("rule", "natural"),
            "arms": _columns(facts.practice, *PRACTICE, "success"),
        },
        "teacher": {
            **{
                name: teacher.get(name)
                for name in ("source", "margin", "ratio", "policies", "successes", "mirror")
            },
            "states": _columns(facts.teacher, *_TEACHER),
        }
        if teacher.get("source", "none") != "none"
        else None,
        "behaviour_policies": facts.policies,
        "corrections": {
            "rules": mixture.get("correction") if mixture is not None else None,
            "post_strata": [row["stratum"] for row in logs if row["timing"] == "post"],
            "moved_by_weights": sum(
                abs((row["effective_share"] or 0.0) - (row["drawn_share"] or 0.0)) for row in logs
            )
            / 2,
        },
        "off_policy": _columns(
            facts.off_policy,
            *("measure", "estimator", "value", "low", "high", "refused", "episodes"),
            *("ess", "horizon", "epsilon", "estimated_share"),
        ),
        "left_out": dict(panel.header.left_out) if panel is not None else None,
        "evaluation": facts.evaluation or None,
        "imbalance": evaluation_bias(facts) or None,
        "missing": list(facts.missing),
    }


def as_markdown(card: dict[str, Any]) -> str:
    """Write the card as a page of Markdown."""
    teacher = dict(card["teacher"] or {})
    states = teacher.pop("states", [])
    facts = {
        "Policy": card["policy"] and card["policy"]["text"],
        "Capacity": card["capacity"],
        "Sampling": card["sampling"],
        "Teacher": teacher or None,
        "Practice": card["practice"]["rule"],
        "Target": card["target"],
        "Corrections": card["corrections"],
        "Left out of the panel": card["left_out"],
        "Evaluation shown": card["evaluation"],
    }
    off_policy = [
        {**{name: row[name] for name in ("measure", "estimator")}, "value [95 %]": estimate(row)}
        for row in card["off_policy"]
    ]
    tables = {
        "What it was": [{"of the run": name, "": in_words(value)} for name, value in facts.items()],
        "Quotas of the batch, and what filled them (shares of all rows fed)": shown(
            card["fed"], FED
        ),
        "Conditions in the sampled batches": shown(card["conditions"], _CONDITIONS),
        "Age of the sampled rows": shown(card["ages"], AGES),
        "Whose behaviour it was": shown(card["behaviour_policies"], POLICIES),
        "Off-policy evaluation on held-out logs, before it drove": off_policy,
        "Missions that the twin gave": shown(card["practice"]["arms"], PRACTICE),
        "What the teacher's filter did at the end": shown(states, _TEACHER),
        "Unknown": [{"why": line} for line in card["missing"]],
    }
    return write.as_markdown(
        {
            "title": f"Replay card of {card['run']}",
            "headline": (card["imbalance"] or f"Evaluation bias: {_UNKNOWN}").removesuffix("."),
            "lead": "",
            "sections": [
                Section("", title, tables=[Table(rows)]) for title, rows in tables.items() if rows
            ],
        }
    )


def _columns(rows: Rows, *names: str) -> Rows:
    return [{name: row[name] for name in names} for row in rows]
