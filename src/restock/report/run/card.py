"""The replay card: one page, for people and as JSON, that says what a run's critic was fed.

A metric without its replay is half a result. The card answers, in the order a reviewer would ask:
which policy, capacity, sampling rule, age of the sampled rows, target rule, conditions in the
batches, whose behaviour, which corrections, the mix after them, and the one imbalance most likely
to make the evaluation look better than deployment.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec

from restock.files import write_text
from restock.replay.sampling.rules import RULES
from restock.report.look import write
from restock.report.look.blocks import Rows, Section, Table, cell, estimate, shown, words
from restock.report.run.facts import Facts, evaluation_bias, gather
from restock.report.run.page import AGES, FED, POLICIES, PRACTICE

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
        RunError: no run there, or one with nothing to report on yet.
    """
    card = replay_card(gather(run))
    markdown = as_markdown(card)
    write_text(run / "replay_card.json", json.dumps(card, indent=1, default=str) + "\n")
    write_text(run / "replay_card.md", markdown)
    return card, markdown


def replay_card(facts: Facts) -> dict[str, Any]:
    """Return the card as JSON values, with null for what the run does not say."""
    settings = facts.config.get("config", {})
    replay, teacher = settings.get("replay", {}), settings.get("teacher", {})
    panel = facts.panel
    mixture = msgspec.to_builtins(panel.header.mixture) if panel is not None else None
    logs = [row for row in facts.sampled if row["source"] == "logs"]
    return {
        "format": FORMAT,
        "run": str(facts.run),
        "policy": None if facts.policy is None else facts.policy.document,
        "capacity": {
            "ring_rows": replay.get("ring_capacity"),
            "panel_rows": len(panel) if panel is not None else None,
            "panel": (facts.config.get("panel") or {}).get("id"),
            "store_version": panel.header.store_version if panel is not None else None,
        },
        "sampling": {
            "batch_size": replay.get("batch_size"),
            "logs_share": _drawn_share(facts, "logs"),
            "logs": _rule(mixture),
            "fresh": _fresh_rule(facts, mixture),
            "n_step": {
                "logs": panel.n_step if panel is not None else None,
                "fresh": settings.get("loss", {}).get("n_step"),
            },
        },
        "fed": _columns(facts.fed, *FED, "drawn_rows"),
        "ages": facts.ages,
        "target": facts.config.get("target") or settings.get("target"),
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
        "What it was": [{"of the run": name, "": _words(value)} for name, value in facts.items()],
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


def _rule(mixture: dict[str, Any] | None) -> str | None:
    """Say how the logged part of a batch is drawn."""
    if mixture is None:
        return None
    name = str(mixture.get("within", "uniform"))
    within = RULES[name].doc if name in RULES else name
    cap = mixture.get("max_replays_per_row")
    most = f", a row at most {cap:g} times" if cap else ""
    return f"quotas by stratum, within one {within}{most}"


def _fresh_rule(facts: Facts, mixture: dict[str, Any] | None) -> str | None:
    """Say how the fresh part of a batch was drawn; None if there was none."""
    if not _drawn_share(facts, "fresh"):
        return None
    rules = [] if mixture is None else [*mixture["strata"], mixture["each_condition"] or {}]
    by_quota = any(rule.get("share", "natural") != "natural" for rule in rules)
    return "quotas by stratum, each of its rows alike" if by_quota else "uniform over the ring"


def _drawn_share(facts: Facts, source: str) -> float | None:
    rows = sum(row["drawn_rows"] for row in facts.sampled)
    of_source = sum(row["drawn_rows"] for row in facts.sampled if row["source"] == source)
    return of_source / rows if rows else None


def _columns(rows: Rows, *names: str) -> Rows:
    return [{name: row[name] for name in names} for row in rows]


def _words(value: Any, name: str = "") -> str:
    """Write a small document for people."""
    if isinstance(value, dict):
        parts = [f"{words(key)} {_words(item, key)}" for key, item in value.items()]
        return ", ".join(parts) or "none"
    if isinstance(value, list | tuple):
        return " and ".join(map(_words, value)) or "none"
    if value is None or isinstance(value, bool):
        return "yes" if value else "no" if value is False else "none"
    return cell(name, value)
