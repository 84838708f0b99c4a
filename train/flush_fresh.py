"""Episodes of the twin as a recording of a store: transition rows, a manifest row, one commit."""

from __future__ import annotations

import datetime as dt
import hashlib
import json
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.errors import RunError
from restock.ingest.profile.profile import Profile
from restock.ingest.store.episode_rows import ENDS, EpisodeRows, packed
from restock.ingest.store.manifest import conditions_json, definitions, score_rows, software_version
from restock.ingest.store.writer import StoreWriter
from restock.ingest.task.conditions import NOMINAL, primary
from restock.ingest.task.label_scores import score
from restock.ingest.task.perturbation_columns import Perturbed
from restock.ingest.task.schema import (
    SIGNAL_COLUMNS,
    STEP_BITS,
    recording_schema,
    transition_schema,
)
from restock.train.feed.fresh_log import read_episodes
from restock.train.jump_start import POLICIES
from restock.train.run.run import now_ns

FORMAT = "twin"
_MOVED = ("stamp_ns", "pose_stamp_ns")  # episodes begin at 0: laid out one after the other


@dataclass(frozen=True)
class Flushed:
    """What a flush put in a store."""

    recording_id: str
    status: str  # written | unchanged
    episodes: int
    transitions: int
    version: int | None  # of the store's transitions, where they were written


def flush(run: Path, store: StoreWriter, profile: Profile, dropped_steps: int = 0) -> Flushed:
    """Write the episodes that a run kept in its folder `fresh` as one recording.

    Its id is a hash of what is in it: the same episodes are there once, however often they are
    flushed, and a run that collected more since is another recording.

    Raises:
        RunError: the run kept no episode.
        StoreError: the store cannot be written.
    """
    episodes = read_episodes(run / "fresh")
    if not episodes:
        raise RunError(
            "kept no finished episode to flush",
            where=str(run),
            remedy="give --flush-fresh when the run begins: episodes are kept from then on",
        )
    recording_id = _content_id(episodes)
    count = sum(int(episode["count"]) for episode in episodes)
    for row in store.live(recording_id).to_pylist():
        if all(row[name] == value for name, value in definitions(profile).items()):
            return Flushed(recording_id, "unchanged", len(episodes), count, None)
    ingest_id = uuid.uuid4().hex
    laid_out = _lay_out(episodes, profile)
    table = _rows(laid_out, episodes, profile, run, recording_id, ingest_id)
    manifest = _manifest(laid_out, table, profile, run, dropped_steps)
    version = store.write(pa.Table.from_pylist([manifest], recording_schema()), table)
    return Flushed(recording_id, "written", len(episodes), len(table), version)


def _content_id(episodes: Sequence[Mapping[str, Any]]) -> str:
    digest = hashlib.blake2b(digest_size=8)
    for episode in episodes:
        for name in ("observation", "action", "reward", "probability"):
            digest.update(np.ascontiguousarray(episode[name]).tobytes())
        for name in sorted(episode["signals"]):
            digest.update(np.ascontiguousarray(episode["signals"][name]).tobytes())
    return digest.hexdigest()


def _lay_out(episodes: Sequence[Mapping[str, Any]], profile: Profile) -> EpisodeRows:
    """All steps one after the other, as if one robot had driven the episodes in turn."""
    lengths = np.array([int(episode["count"]) + 1 for episode in episodes], np.int64)
    first = np.concatenate([[0], np.cumsum(lengths)])[:-1].astype(np.int64)
    tick = np.arange(lengths.sum(), dtype=np.int64)
    step = tick - np.repeat(first, lengths)
    signals = {
        column.name: np.concatenate([episode["signals"][column.name] for episode in episodes])
        for column in SIGNAL_COLUMNS
    }
    period_ns = round(profile.task.control_period_s * 1e9)
    for name in _MOVED:
        signals[name] = signals[name] + np.repeat(first, lengths) * period_ns
    labels = {
        name: np.concatenate([episode["labels"][name] for episode in episodes])
        for name in episodes[0]["labels"]
    }
    number = np.repeat(np.arange(len(episodes), dtype=np.int64), lengths)
    is_end = step == np.repeat(lengths, lengths) - 1
    return EpisodeRows(tick, number, step, is_end, signals, labels, pa.table({}))


def _rows(
    rows: EpisodeRows,
    episodes: Sequence[Mapping[str, Any]],
    profile: Profile,
    run: Path,
    recording_id: str,
    ingest_id: str,
) -> pa.Table:
    """One row a transition, by `restock.ingest.task.schema`."""
    begin = rows.starts
    if len(rows.tick) >> STEP_BITS:
        raise RunError(
            f"its {len(rows.tick):,} steps are more than the {1 << STEP_BITS:,} of a recording",
            where=str(run),
        )

    def each(name: str) -> Any:
        return np.concatenate([episode[name] for episode in episodes])

    observation = np.concatenate([episode["observation"] for episode in episodes])
    ends = rows.is_end[begin + 1]
    for_good = np.array([bool(episode["terminated"]) for episode in episodes])[rows.episode[begin]]
    version = [f"{run.name}@{int(episode['version'])}" for episode in episodes]
    named = primary(rows.labels, profile.conditions) or [NOMINAL] * len(rows.tick)
    perturbed, values = _perturbed(episodes).columns(rows.episode[begin])
    now = {name: column[begin] for name, column in rows.signals.items()}
    number = int(recording_id, 16) >> (64 - (63 - STEP_BITS))
    columns: dict[str, Any] = {
        "transition_id": (number << STEP_BITS) + rows.tick[begin],
        "recording_id": recording_id,
        "episode_id": [f"{recording_id}/{episode}" for episode in rows.episode[begin]],
        "episode_index": rows.episode[begin],
        "step_index": rows.step[begin],
        "observation": observation[begin],
        "action": each("action"),
        "reward": each("reward"),
        "next_observation": observation[begin + 1],
        "terminated": ends & for_good,
        "truncated": ends & ~for_good,
        "condition": [named[row] for row in begin],
        "conditions": [[name for name, holds in rows.labels.items() if holds[r]] for r in begin],
        "true_condition": each("truth").tolist(),
        "perturbation": perturbed,
        "perturbation_values": values,
        "zone": _zones(rows, episodes, profile)[begin].tolist(),
        "behaviour_policy": _policies(episodes),
        "behaviour_version": [version[episode] for episode in rows.episode[begin]],
        "action_probability": each("probability"),
        "action_residual": np.zeros(len(begin), np.float32),  # the action is the command
        "progress_m": each("progress_m"),
        **{column.name: now[column.name] for column in SIGNAL_COLUMNS},
        "ingest_id": ingest_id,
        "source_file": str(run),
        "profile_hash": profile.hash,
        "task_hash": profile.task.hash,
        "labels_version": profile.labels_version,
        "restock_version": software_version(),
    }
    schema = transition_schema(profile.task.observation_size)
    arrays = [_array(columns[field.name], field.type, len(begin)) for field in schema]
    table = pa.Table.from_arrays(arrays, schema=schema)
    return table.replace_schema_metadata({ENDS: packed(rows.ends_table())})


def _policies(episodes: Sequence[Mapping[str, Any]]) -> list[str]:
    """Who chose each step; an older run had no jump start."""
    codes = [episode.get("policy", np.zeros(int(episode["count"]), int)) for episode in episodes]
    return [POLICIES[code] for code in np.concatenate(codes)]


def _zones(
    rows: EpisodeRows, episodes: Sequence[Mapping[str, Any]], profile: Profile
) -> NDArray[np.object_]:
    """The zone of every step: the profile's on the floor that it describes, else the layout's."""
    names = profile.zone_of(rows.signals["pose_x_m"], rows.signals["pose_y_m"])
    zones = np.array(names, object)
    for number, episode in enumerate(episodes):
        if (said := episode.get("zones")) is not None:
            zones[rows.episode == number] = said
    return zones


def _perturbed(episodes: Sequence[Mapping[str, Any]]) -> Perturbed:
    """What was in force in each episode; those that an older run kept do not know."""
    said = [
        (str(episode["perturbation"]), json.loads(episode["perturbation_values"]))
        if "perturbation" in episode
        else None
        for episode in episodes
    ]
    return Perturbed(said, np.arange(len(said), dtype=np.int64))


def _array(values: Any, kind: pa.DataType, count: int) -> pa.Array:
    if isinstance(values, pa.Array):
        return values
    if isinstance(values, str):
        return pa.repeat(pa.scalar(values, kind), count)
    if pa.types.is_fixed_size_list(kind):
        flat = pa.array(np.ascontiguousarray(values, np.float32).reshape(-1))
        return pa.FixedSizeListArray.from_arrays(flat, type=kind)
    if isinstance(values, np.ndarray):
        return pa.array(values).cast(kind, safe=False)
    return pa.array(values, kind)


def _manifest(
    rows: EpisodeRows, table: pa.Table, profile: Profile, run: Path, dropped_steps: int
) -> dict[str, Any]:
    """The row of `recordings`. Log time is such that the last step was just now."""
    stamps = rows.signals["stamp_ns"]
    condition = np.array(table["condition"].to_pylist(), object)
    scores = score(
        {name: condition == name for name in rows.labels}, table["true_condition"].to_pylist()
    )
    dropped = [{"reason": "physics blew up", "count": dropped_steps}] if dropped_steps else []
    return {
        "recording_id": table["recording_id"][0].as_py(),
        "ingest_id": table["ingest_id"][0].as_py(),
        "ingested_at": dt.datetime.now(dt.UTC),
        "source_file": str(run),
        "format": FORMAT,
        "integrity": "verified",
        "duration_s": float(stamps[-1] - stamps[0]) * 1e-9,
        "start_stamp_ns": int(stamps[0]),
        "end_stamp_ns": int(stamps[-1]),
        "clock": "simulated",
        "clock_offset_ns": now_ns() - int(stamps[-1]),
        "clock_jumps": 0,
        "profile": profile.name,
        **definitions(profile),
        "ticks": len(rows.tick) + dropped_steps,
        "steps": len(rows.tick),
        "episodes": int(rows.is_end.sum()),
        "transitions": len(table),
        "episode_ends": int(rows.is_end.sum()),
        "drops": dropped,
        "topics": [],
        "stand_ins": [],
        "label_scores": score_rows(scores),
        "clocks": [],
        "signals": [],
        "task_json": msgspec.json.encode(profile.task).decode(),
        "conditions_json": conditions_json(profile.conditions),
    }
