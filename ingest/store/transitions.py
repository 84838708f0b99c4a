"""Episodes to transition rows: observation, action, reward, what came next, labels, provenance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.errors import RecordingError
from restock.ingest.decoding.columns import offsets_of
from restock.ingest.profile.profile import Profile
from restock.ingest.steps.episodes import Split
from restock.ingest.steps.steps import Steps
from restock.ingest.store.episode_rows import ENDS, EpisodeRows, episode_rows, groups, packed
from restock.ingest.task.conditions import primary
from restock.ingest.task.schema import SIGNAL_COLUMNS, STEP_BITS, transition_schema
from restock.ingest.task.task import observe, reward

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Provenance:
    """Where rows come from; the same in every row of an ingest."""

    recording_id: str
    ingest_id: str
    source_file: str
    restock_version: str


def recording_table(
    profile: Profile, steps: Steps, episodes: Split, provenance: Provenance
) -> tuple[pa.Table, EpisodeRows]:
    """All transitions of a recording, and the steps they are made of (without their signals).

    Some whole episodes at a time, which changes no value: an episode's rows and labels depend on
    its own steps alone, and only those of one group are in memory in full.

    Raises:
        RecordingError: as `transitions`.
    """
    tables, ends, parts = [], [], []
    for group in groups(episodes):
        rows = episode_rows(profile, steps, episodes, group)
        tables.append(transitions(profile, steps, episodes, rows, provenance))
        ends.append(rows.ends_table())
        parts.append(rows.without_signals())
    table = pa.concat_tables(tables)
    metadata = {ENDS: packed(pa.concat_tables(ends).combine_chunks())}
    return table.replace_schema_metadata(metadata), EpisodeRows.join(parts)


def transitions(
    profile: Profile,
    steps: Steps,
    episodes: Split,
    rows: EpisodeRows,
    provenance: Provenance,
) -> pa.Table:
    """One row a transition, by `restock.ingest.task.schema`.

    Raises:
        RecordingError: the recording has more steps than a transition id can number.
    """
    task, begin = profile.task, rows.starts
    tick = rows.tick[begin]
    if len(steps) >> STEP_BITS:
        raise RecordingError(
            f"{len(steps):,} steps are more than the {1 << STEP_BITS:,} a recording may have",
            remedy="split the recording",
        )
    previous_tick = rows.tick - steps.follows[rows.tick]
    previous_action = np.where(steps.follows[rows.tick], steps.action[previous_tick], 0)
    before = {name: column[previous_tick] for name, column in steps.signals.items()}
    observation = observe(task, rows.signals, before, previous_action)  # (R, D)
    now = {name: column[begin] for name, column in rows.signals.items()}
    after = {name: column[begin + 1] for name, column in rows.signals.items()}
    progress = steps.routing.progress_m(task, steps.routing.plan[tick], now, after)
    rewards = reward(task, now, after, progress, steps.action[tick], previous_action[begin])

    last = rows.is_end[begin + 1]
    terminates = np.array([e.terminated for e in episodes.episodes], np.bool_)
    for_good = terminates[rows.episode[begin]] if len(terminates) else last
    named = primary(rows.labels, profile.conditions) or ["nominal"] * len(rows.tick)
    number = int(provenance.recording_id, 16) >> (64 - (63 - STEP_BITS))
    count = len(begin)

    def each(values: Sequence[Any]) -> list[Any]:
        return [values[index] for index in tick]

    names, values = steps.perturbed.columns(tick)
    columns: dict[str, Any] = {
        "transition_id": (number << STEP_BITS) + tick,
        "recording_id": [provenance.recording_id] * count,
        "episode_id": [f"{provenance.recording_id}/{e}" for e in rows.episode[begin]],
        "episode_index": rows.episode[begin],
        "step_index": rows.step[begin],
        "observation": _vectors(observation[begin]),
        "action": steps.action[tick],
        "reward": rewards,
        "next_observation": _vectors(observation[begin + 1]),
        "terminated": last & for_good,
        "truncated": last & ~for_good,
        "condition": [named[row] for row in begin],
        "conditions": _names(rows.labels, begin),
        "true_condition": each(steps.truth),
        "perturbation": names,
        "perturbation_values": values,
        "zone": profile.zone_of(now["pose_x_m"], now["pose_y_m"]),
        "behaviour_policy": each(steps.policy),
        "behaviour_version": each(steps.policy_version),
        "action_probability": each(steps.probability),
        "action_residual": steps.residual[tick],
        "progress_m": progress,
        **{column.name: now[column.name] for column in SIGNAL_COLUMNS},
        "ingest_id": [provenance.ingest_id] * count,
        "source_file": [provenance.source_file] * count,
        "profile_hash": [profile.hash] * count,
        "task_hash": [task.hash] * count,
        "labels_version": [profile.labels_version] * count,
        "restock_version": [provenance.restock_version] * count,
    }
    own = rows.custom.take(pa.array(begin))
    columns |= dict(zip(own.column_names, own.columns, strict=True))
    schema = transition_schema(task.observation_size, list(own.schema))
    table = pa.table([_typed(columns[field.name], field.type) for field in schema], schema=schema)
    return table.replace_schema_metadata({ENDS: packed(rows.ends_table())})


def _vectors(rows: NDArray[np.float32]) -> pa.Array:
    """(N, D) float32 to a fixed-size list array, without a copy of each row."""
    size = rows.shape[1]
    flat = pa.array(np.ascontiguousarray(rows, np.float32).reshape(-1))
    kind = pa.list_(pa.field("element", pa.float32()), size)
    return pa.FixedSizeListArray.from_arrays(flat, type=kind)


def _typed(values: Any, kind: pa.DataType) -> pa.Array:
    if isinstance(values, pa.Array | pa.ChunkedArray):
        return values if values.type == kind else values.cast(kind)
    if isinstance(values, np.ndarray):
        return pa.array(values).cast(kind, safe=False) if len(values) else pa.array([], kind)
    return pa.array(values, kind)


def _names(labels: Mapping[str, Bools], rows: Ints) -> pa.Array:
    """The labels that hold in each of these rows, in their order, as a list array."""
    table = np.zeros((len(rows), len(labels)), np.bool_)
    for column, holds in zip(table.T, labels.values(), strict=True):
        column[:] = holds[rows]
    which = pa.array(np.nonzero(table)[1].astype(np.int32))
    names = pa.DictionaryArray.from_arrays(which, pa.array(list(labels), pa.string()))
    offsets = pa.array(offsets_of(table.sum(axis=1)).astype(np.int32))
    return pa.ListArray.from_arrays(offsets, names.cast(pa.string()))
