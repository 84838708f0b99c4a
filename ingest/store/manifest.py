"""The manifest row of an ingest: what was read, by which definitions, and what became of it."""

from __future__ import annotations

import datetime as dt
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa

from restock.ingest.containers.recording import Recording
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.profile.profile import Profile, profile_toml
from restock.ingest.steps.aligned_inputs import fallbacks_used
from restock.ingest.steps.episodes import Split, Steps
from restock.ingest.store.transitions import EpisodeRows, Provenance
from restock.ingest.task.conditions import Condition, reported, unknown_rows, unseen
from restock.ingest.task.label_scores import LabelScore
from restock.ingest.task.signals import OUTLINE_SIGNALS

UNUSED = "not used by the profile"


def software_version() -> str:
    """Restock's version."""
    try:
        return version("restock")
    except PackageNotFoundError:  # running from a source tree that was never installed
        return "0.0.0+unknown"


def definitions(profile: Profile) -> dict[str, str]:
    """What rows depend on beside the recording."""
    return {
        "profile_hash": profile.hash,
        "task_hash": profile.task.hash,
        "labels_version": profile.labels_version,
        "restock_version": software_version(),
    }


def manifest_row(
    profile: Profile,
    provenance: Provenance,
    table: pa.Table,
    scores: Sequence[LabelScore],
    dropped: Mapping[str, int],
    **recorded: Any,
) -> dict[str, Any]:
    """The row of `recordings` for these transitions, by `restock.ingest.task.schema`.

    `dropped` are ticks in no episode by reason; `recorded` is what only who made the steps knows:
    format, clock, counts and tags.
    """
    drops = sorted(dropped.items(), key=lambda item: (-item[1], item[0]))
    return {
        "recording_id": provenance.recording_id,
        "ingest_id": provenance.ingest_id,
        "ingested_at": dt.datetime.now(dt.UTC),
        "source_file": provenance.source_file,
        "profile": profile.name,
        **definitions(profile),
        "tags": {},
        "transitions": len(table),
        "drops": [{"reason": reason, "count": count} for reason, count in drops],
        "topics": [],
        "stand_ins": [],
        "label_scores": score_rows(scores),
        "label_counts": count_rows(scores),
        "clocks": [],
        "findings": [],
        "signals": [],
        "cameras": [],
        "unknown_conditions": unknown_rows(
            profile.definitions, lidar=profile.task.lidar, driven_plan=driven_plan(table)
        ),
        "uncertain_conditions": uncertain_conditions(profile),
        "corrections": [],
        "task_json": msgspec.json.encode(profile.task).decode(),
        "conditions_json": conditions_json(profile.conditions),
        "exposures_json": conditions_json(profile.exposures),
        "profile_toml": profile_toml(profile),
        **recorded,
    }


def uncertain_conditions(profile: Profile) -> list[str]:
    """Return the conditions and exposures whose labels rest on an outline that nobody measured."""
    if profile.robot is None or not profile.robot.outline_guessed:
        return []
    hindsight = profile.goal_source == "hindsight"
    known = reported(profile.definitions, lidar=profile.task.lidar, driven_plan=hindsight)
    return sorted(unseen(known, OUTLINE_SIGNALS))


def driven_plan(rows: pa.Table) -> bool:
    """Whether the plan of a recording's rows is the path that was driven: goals in hindsight."""
    return (
        "goal_source" in rows.column_names
        and "hindsight" in rows["goal_source"].unique().to_pylist()
    )


def recorded_facts(
    recording: Recording,
    profile: Profile,
    columns: Mapping[str, TopicColumns],
    steps: Steps,
    episodes: Split,
    rows: EpisodeRows,
) -> dict[str, Any]:
    """What `manifest_row` needs to know of a recording."""
    stamps, span = steps.signals["stamp_ns"], recording.span_ns or (0, 0)
    fallbacks = fallbacks_used(profile, columns) | steps.stand_ins
    return {
        "format": recording.format,
        "integrity": recording.integrity,
        "duration_s": (span[1] - span[0]) * 1e-9,
        "start_stamp_ns": int(stamps.min()),
        "end_stamp_ns": int(stamps.max()),
        "clock": steps.clock.alignment,
        "clock_offset_ns": steps.clock.offset_ns,
        "clock_jumps": steps.clock.jumps,
        "ticks": len(steps),
        "steps": len(np.unique(rows.tick)),
        "episodes": len(episodes.episodes),
        "episode_ends": episodes.ends,
        "topics": topic_rows(recording),
        "stand_ins": [{"input": name, "instead": how} for name, how in fallbacks.items()],
        "clocks": clock_rows(recording, steps),
        "findings": [one.as_row() for one in steps.findings],
        "signals": steps.custom.rows(),
    }


def topic_rows(recording: Recording) -> list[dict[str, Any]]:
    """Every topic: the messages the container counts, those decoded, and why not the rest."""
    rows = []
    for name, info in recording.topics.items():
        account = recording.accounts.get(name)
        reason = info.skipped or UNUSED
        if account is not None:
            reason = "; ".join(f"{why}: {count}" for why, count in account.reasons.items() if count)
        decoded = account.decoded if account is not None else 0
        rows.append(
            {
                "topic": name,
                "type": info.type,
                "expected": info.expected,
                "decoded": decoded,
                "skipped": max(info.expected - decoded, 0),
                "reason": reason,
            }
        )
    return rows


def clock_rows(recording: Recording, steps: Steps) -> list[dict[str, Any]]:
    """Every topic's clocks, and what aligning did about its messages."""
    report = steps.clock
    return [
        {
            **one.as_row(),
            "log_backsteps": recording.accounts[one.topic].log_backsteps,
            "off_clock": report.off_clock.get(one.topic, 0),
            "restamped": report.restamped.get(one.topic, 0),
        }
        for one in steps.clocks
    ]


def score_rows(scores: Sequence[LabelScore]) -> list[dict[str, Any]]:
    """Precision and recall a step, as the manifest holds them."""
    names = ("condition", "precision", "recall", "labelled", "support")
    return [{name: getattr(score, name) for name in names} for score in scores]


def count_rows(scores: Sequence[LabelScore]) -> list[dict[str, Any]]:
    """The counts of scores, which add up over recordings, as the manifest holds them."""
    return [asdict(score) for score in scores]


def conditions_json(conditions: Sequence[Condition]) -> str:
    """Conditions of one kind as the manifest holds them: all but their kind and doc."""
    names = ("name", "timing", "priority", "sql", "let", "probability", "uncertain", "constants")
    return msgspec.json.encode(
        [{name: getattr(condition, name) for name in names} for condition in conditions]
    ).decode()
