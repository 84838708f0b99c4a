"""Sentences of `restock train` about a run: what it will do, or has not done."""

from __future__ import annotations

from typing import Any

from restock.ingest.task.signals import LIDAR_SIGNALS
from restock.replay.panel.panel import Panel
from restock.toml import changed
from restock.train.dqn.config import TeacherConfig, TrainConfig
from restock.train.feed.imitation import cloned
from restock.train.loop import TrainResult
from restock.train.prepare import Prepared, rows_by_policy
from restock.train.run.fed_shares import SHORT
from restock.train.twin.env.floor_report import sealed
from restock.train.twin.floors.floors import open_floors

_OF_LOGS = ("policies", "successes", "logs_share", "offline_updates")  # of a teacher's settings


def describe_run(prepared: Prepared) -> str:
    """Describe the run, and what not to expect of it, in a line each."""
    config, panel, document = prepared.config, prepared.panel, prepared.document
    schedule = config.schedule
    fed = "no panel: online only"
    if panel is not None:
        fed = f"panel {panel.id} ({len(panel):,} rows)"
    steps = f"up to {schedule.env_steps:,} environment steps"
    if not config.env.twin:
        steps = f"{schedule.offline_updates:,} updates on the logs alone, without a twin"
    if schedule.seconds is not None:
        steps += f" or {schedule.seconds:g} s"
    lines = [
        f"run {prepared.path}: {fed}; target {config.target}; {steps};"
        f" seed {config.seed}, {config.device}"
    ]
    if panel is not None:
        lines += describe_forecast(document["panel"], config)
    if ring := document.get("ring_capacity"):
        lines.append(f"a ring of {ring['ring_rows']:,} rows: {ring['reason']}")
    if config.teacher.filters:
        lines.append(_teacher(config.teacher, panel))
    if panel is None and config.teacher.asks:
        resolved = {"successes": False, "offline_updates": config.schedule.offline_updates}
        lines += [
            f"teacher.{key} has no effect: there is no panel"
            for key in changed(config.teacher, _OF_LOGS, **resolved)
        ]
    if config.evaluation.off_policy and (panel is None or not panel.splits):
        has = "there is no panel" if panel is None else "the panel holds out no rows"
        lines.append(
            f"evaluation.off_policy has no effect: {has} ([evaluation_split] of a mixture)"
        )
    if config.env.twin:
        lines += _not_evaluated(document)
        lines += sealed(open_floors(config.env.layouts))
    return "\n".join(lines)


def describe_forecast(fed: dict[str, Any], config: TrainConfig) -> list[str]:
    """Say what a run's batches are to be made of, and what they will be short of.

    `fed` is the panel's part of config.json.
    """
    rows, planned = fed["forecast"], fed["planned_draws"]
    total = planned["offline"] + planned["online"]
    steps = planned["end_env_steps"]
    budget = f"{total:,.0f} rows"
    if config.env.twin:
        budget += f" in {steps:,} environment steps"
        if config.schedule.seconds is not None:
            budget += (
                f" (a first guess for {config.schedule.seconds:g} s; planned again from the"
                " measured speed)"
            )
    parts = ", ".join(
        f"{row['stratum']} {row['wanted_share']:.1%} ({row['logs_share']:.1%} logged"
        + (f", {row['fresh_share']:.1%} fresh)" if config.env.twin else ")")
        for row in rows
    )
    lines = [f"quotas of the {budget} that the critic is fed: {parts}"]
    lines += [
        f"warning: {row['stratum']} will be short by {row['short_share']:.1%} of the rows fed, of"
        f" {row['wanted_share']:.1%} wanted: {row['reason']}; log more of it, let the twin drive"
        " it, raise max_replays_per_row, or lower its share in the mixture"
        for row in rows
        if row["short_share"] >= SHORT
        or (row["wanted_share"] and row["short_share"] > 0.5 * row["wanted_share"])
    ]
    return lines


def fed_table(fed: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return rows for people of what the critic was fed, in % of all rows (`fed_shares`)."""
    columns = {
        "natural": "natural_share",
        "wanted": "wanted_share",
        "drawn": "drawn_share",
        "logged": "logs_share",
        "fresh": "fresh_share",
        "short": "short_share",
    }
    return [
        {"stratum": row["stratum"]}
        | {name: f"{100 * row[column]:.1f}" for name, column in columns.items()}
        for row in fed
    ]


def no_update(outcome: TrainResult, config: TrainConfig) -> str | None:
    """Say why a run has learned nothing, or nothing in the twin; None if it has."""
    if outcome.online_updates:
        return None
    if not outcome.gradient_steps:
        learnt = "as random as at the beginning"
    elif outcome.env_steps:
        learnt = f"that of the {outcome.gradient_steps:,} updates on the logs alone"
    else:
        return None
    return (
        f"no update was made in {outcome.env_steps:,} environment steps, so the policy is {learnt};"
        " online updates begin after"
        f" schedule.warmup_env_steps={config.schedule.warmup_env_steps:,}, once there are"
        f" replay.batch_size={config.replay.batch_size:,} rows: give more"
        f" {'--env-steps' if config.schedule.seconds is None else '--seconds'}"
    )


def unmoved(practised: list[dict[str, Any]], config: TrainConfig) -> str | None:
    """Explain why success-based practice never changed its shares; None if it did, or was off.

    `practised` are the rows of the run's table `practice`.
    """
    practice = config.practice
    drawn = {(row["arm"], row["wanted_share"]) for row in practised}
    if practice.rule != "success" or len(drawn) > len({arm for arm, _ in drawn}):
        return None
    return (
        'practice.rule="success" never changed the shares of the missions: it may at the'
        f" end of every practice.every_env_steps={practice.every_env_steps:,}, by arms or kinds of"
        f" which practice.warmup_episodes={practice.warmup_episodes:,} missions have ended"
    )


def _teacher(teacher: TeacherConfig, panel: Panel | None) -> str:
    logged = {} if panel is None else rows_by_policy(panel)
    there = [name for name in teacher.policies if logged.get(name)]
    absent = [name for name in teacher.policies if name not in there]
    rows = sum(logged[name] for name in there)
    cloned_rows = f"{rows:,} logged rows of {', '.join(there or absent)}"
    if there and absent:
        cloned_rows += f" (none of {', '.join(absent)}: the panel has {', '.join(sorted(logged))})"
    if panel is not None and teacher.successes:
        others = int(cloned(panel, teacher).sum()) - rows
        cloned_rows += (
            f", and {others:,} rows of episodes in which other drivers alone reached the goal,"
        )
        rows += others
    first = f"{cloned_rows} are cloned first"
    mirrored = ", half of its rows mirrored left to right" if teacher.mirror else ""
    return (
        f"teacher {teacher.source}: the policy chooses by Q among the actions that it finds"
        " plausible; "
        + (
            (first if rows else "there are no logged rows to clone, so at first all actions are")
            + mirrored
        )
    )


def _not_evaluated(document: dict[str, Any]) -> list[str]:
    """Return the conditions that the twin cannot show, and why."""
    return [
        f"condition {name!r} is not evaluated in the twin, which has no {', '.join(signals)}: "
        + (
            "no log contains it"
            if LIDAR_SIGNALS.issuperset(signals)
            else "its stratum is of logs alone"
        )
        for name, signals in document.get("not_evaluated", {}).items()
    ]
