"""Episodes to transition rows: observation, action, reward, what came next, labels, provenance."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.errors import RecordingError
from restock.ingest.conditions import label, primary
from restock.ingest.episodes import Split, changed_route, with_route
from restock.ingest.profile import Profile
from restock.ingest.schema import SIGNAL_COLUMNS, STEP_BITS, transition_schema
from restock.ingest.steps import Steps
from restock.ingest.task import observe, reward

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]


ENDS = b"restock.episode_ends"  # key in the rows' metadata


@dataclass(frozen=True)
class Provenance:
    """Where rows come from; the same in every row of an ingest."""

    recording_id: str
    ingest_id: str
    source_file: str
    restock_version: str


@dataclass(frozen=True)
class EpisodeRows:
    """The steps of all episodes, one after the other: R rows, the last of each only an end."""

    tick: Ints  # (R,)
    episode: Ints  # (R,) index of the episode
    step: Ints  # (R,) in its episode, from 0
    is_end: Bools  # (R,)
    signals: dict[str, NDArray[Any]]  # leading axis R, as the row's episode sees them
    labels: dict[str, Bools]  # condition -> (R,)

    @property
    def starts(self) -> Ints:
        """The rows that begin a transition, (N,); each one's successor is the row after it."""
        return np.flatnonzero(~self.is_end)

    def ends_table(self) -> pa.Table:
        """The ends of the episodes, as `label_table` has them."""
        ends = np.flatnonzero(self.is_end)
        signals = {name: column[ends] for name, column in self.signals.items()}
        return label_table(signals, self.episode[ends], self.step[ends])


def episode_rows(profile: Profile, steps: Steps, episodes: Split) -> EpisodeRows:
    """Lay the episodes' steps out, with the route that is theirs, and label them."""
    lengths = np.array([e.last - e.first + 1 for e in episodes.episodes], np.int64)
    episode = np.repeat(np.arange(len(lengths)), lengths)
    start = np.concatenate([[0], np.cumsum(lengths)])[:-1]
    step = np.arange(lengths.sum(), dtype=np.int64) - np.repeat(start, lengths)
    first = np.array([e.first for e in episodes.episodes], np.int64)
    tick = first[episode] + step if len(first) else step
    is_end = step == lengths[episode] - 1 if len(first) else np.zeros(0, np.bool_)
    signals = {name: column[tick] for name, column in steps.signals.items()}
    # A tick that ends one episode and begins the next is seen with each one's own route.
    old = np.flatnonzero(is_end & np.isin(tick, changed_route(steps)))
    if len(old):
        before, routing = tick[old] - 1, steps.routing
        seen = with_route(
            profile.task, steps, tick[old], routing.goal[before], routing.plan[before]
        )
        for name, column in seen.items():
            signals[name][old] = column
    table = label_table(signals, episode, step)
    return EpisodeRows(tick, episode, step, is_end, signals, label(table, profile.conditions))


def label_table(signals: Mapping[str, NDArray[Any]], episode: Ints, step: Ints) -> pa.Table:
    """The steps as conditions see them: the stored signals, in the types they are stored in."""
    columns = {
        column.name: pa.array(np.asarray(signals[column.name]), pa.float64()).cast(column.type)
        if column.type == pa.float32()
        else pa.array(np.asarray(signals[column.name]), column.type)
        for column in SIGNAL_COLUMNS
    }
    return pa.table({"episode_index": episode, "step_index": step, **columns})


def transitions(
    profile: Profile,
    steps: Steps,
    episodes: Split,
    rows: EpisodeRows,
    provenance: Provenance,
) -> pa.Table:
    """One row a transition, by `restock.ingest.schema`.

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
    held = [_names(rows.labels, row) for row in begin]
    number = int(provenance.recording_id, 16) >> (64 - (63 - STEP_BITS))
    count = len(begin)

    def each(values: Sequence[Any]) -> list[Any]:
        return [values[index] for index in tick]

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
        "conditions": held,
        "true_condition": each(steps.truth),
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
    schema = transition_schema(task.observation_size)
    table = pa.table([_typed(columns[field.name], field.type) for field in schema], schema=schema)
    return table.replace_schema_metadata({ENDS: _packed(rows.ends_table())})


def episode_ends(table: pa.Table) -> pa.Table | None:
    """The steps that only end an episode, as conditions see them, of a recording's rows.

    They are no transitions, but conditions that look ahead see them; they lie in the rows'
    metadata (and so in that of their Parquet file). None where the rows carry none.
    """
    packed = (table.schema.metadata or {}).get(ENDS)
    if packed is None:
        return None
    return pa.ipc.open_stream(base64.b64decode(packed)).read_all()


def _packed(table: pa.Table) -> bytes:
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema) as writer:
        writer.write_table(table)
    return base64.b64encode(sink.getvalue())


def _vectors(rows: NDArray[np.float32]) -> pa.Array:
    """(N, D) float32 to a fixed-size list array, without a copy of each row."""
    size = rows.shape[1]
    flat = pa.array(np.ascontiguousarray(rows, np.float32).reshape(-1))
    kind = pa.list_(pa.field("element", pa.float32()), size)
    return pa.FixedSizeListArray.from_arrays(flat, type=kind)


def _typed(values: Any, kind: pa.DataType) -> pa.Array:
    if isinstance(values, pa.Array):
        return values
    if isinstance(values, np.ndarray):
        return pa.array(values).cast(kind, safe=False) if len(values) else pa.array([], kind)
    return pa.array(values, kind)


def _names(labels: Mapping[str, Bools], row: int) -> list[str]:
    return [name for name, holds in labels.items() if holds[row]]
