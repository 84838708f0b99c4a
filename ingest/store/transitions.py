"""Build a store's transition rows from labelled steps of a recording or of the twin."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.arrays import F32, Bools, Ints
from restock.errors import RecordingError
from restock.ingest.decoding.columns import offsets_of
from restock.ingest.profile.profile import Profile
from restock.ingest.steps.episodes import Split, Steps, changed_route, with_route
from restock.ingest.store.summary import ENDS, WIDE
from restock.ingest.task.conditions import (
    NOMINAL,
    Condition,
    label_several,
    primary,
    uncertain_steps,
)
from restock.ingest.task.schema import (
    PROVENANCE,
    STEP_BITS,
    signal_columns,
    transition_ids,
    transition_schema,
    true_names,
    truth_text,
)
from restock.ingest.task.task import Signals, observe, reward
from restock.ingest.task.task_sql import own_reward
from restock.process import Work

GROUP_ROWS = 8192  # steps of whole episodes that are processed together: bounds memory


@dataclass(frozen=True)
class EpisodeRows:
    """R steps of consecutive episodes. The last step of an episode begins no transition."""

    tick: Ints  # (R,)
    episode: Ints  # (R,) index of the episode
    step: Ints  # (R,) index of the step in its episode
    is_end: Bools  # (R,)
    signals: Signals  # leading axis R; route signals use the route of the row's episode
    labels: dict[str, Bools]  # name of an evaluated condition -> whether it holds, (R,)
    custom: pa.Table  # (R,) the profile's own signals
    probabilities: dict[str, F32]  # condition with a probability rule -> (R,); NaN: unknown
    exposures: dict[str, Bools]  # name of an evaluated exposure -> whether it holds, (R,)

    @property
    def starts(self) -> Ints:
        """Return the rows that begin a transition, (N,); the row after each is its next step."""
        return np.flatnonzero(~self.is_end)

    def ends_table(self) -> pa.Table:
        """Return the last steps of the episodes as a `label_table`."""
        ends = np.flatnonzero(self.is_end)
        signals = {name: column[ends] for name, column in self.signals.items()}
        custom = self.custom.take(pa.array(ends))
        return label_table(signals, self.episode[ends], self.step[ends], custom)

    @classmethod
    def join(cls, parts: Sequence[EpisodeRows]) -> EpisodeRows:
        """Concatenate the steps of several groups of episodes, without their signals."""
        none: Signals = {}
        labels, exposures = (
            {name: np.concatenate([getattr(p, kind)[name] for p in parts]) for name in first}
            for kind, first in (("labels", parts[0].labels), ("exposures", parts[0].exposures))
        )
        return cls(
            np.concatenate([part.tick for part in parts]),
            np.concatenate([part.episode for part in parts]),
            np.concatenate([part.step for part in parts]),
            np.concatenate([part.is_end for part in parts]),
            none,
            labels,
            parts[0].custom.select([]),
            {
                name: np.concatenate([part.probabilities[name] for part in parts])
                for name in parts[0].probabilities
            },
            exposures,
        )


def groups(episodes: Split) -> Iterator[range]:
    """Yield ranges of episode numbers of about GROUP_ROWS steps each."""
    first = count = 0
    for number, episode in enumerate(episodes.episodes):
        count += episode.last - episode.first + 1
        if count >= GROUP_ROWS:
            yield range(first, number + 1)
            first, count = number + 1, 0
    if count or not episodes.episodes:
        yield range(first, len(episodes.episodes))


def episode_rows(
    profile: Profile, steps: Steps, episodes: Split, group: range | None = None
) -> Work[EpisodeRows]:
    """Collect and label the steps of a `group` of episodes (None: all), each with its own route."""
    group = range(len(episodes.episodes)) if group is None else group
    chosen = [episodes.episodes[number] for number in group]
    lengths = np.array([e.last - e.first + 1 for e in chosen], np.int64)
    start = np.concatenate([[0], np.cumsum(lengths)])[:-1]
    step = np.arange(lengths.sum(), dtype=np.int64) - np.repeat(start, lengths)
    tick = step + np.repeat(np.array([e.first for e in chosen], np.int64), lengths)
    is_end = step == np.repeat(lengths, lengths) - 1
    episode = np.repeat(np.arange(group.start, group.stop, dtype=np.int64), lengths)
    signals = {name: column[tick] for name, column in steps.signals.items()}
    # A tick may end one episode and begin the next, with a new route. The end keeps the old route.
    old = np.flatnonzero(is_end & np.isin(tick, changed_route(steps)))
    if len(old):
        before, routing = tick[old] - 1, steps.routing
        seen = with_route(
            profile.task, steps, tick[old], routing.goal[before], routing.plan[before]
        )
        for name, column in seen.items():
            signals[name][old] = column
    custom = steps.custom.take(tick)
    table = label_table(signals, episode, step, custom)
    conditions, situations = map(profile.shown_by_logs, (profile.conditions, profile.exposures))
    held, probable = yield label_several, (table, [*conditions, *situations])
    labels, exposures = (
        {condition.name: held[condition.name] for condition in several}
        for several in (conditions, situations)
    )
    return EpisodeRows(tick, episode, step, is_end, signals, labels, custom, probable, exposures)


def label_table(signals: Signals, episode: Ints, step: Ints, custom: pa.Table) -> pa.Table:
    """Return the steps as the table that conditions query: stored and custom signals."""
    columns = signal_columns(signals)
    columns |= dict(zip(custom.column_names, custom.columns, strict=True))
    return pa.table({"episode_index": episode, "step_index": step, **columns})


def episode_ends(table: pa.Table) -> pa.Table | None:
    """Return the last steps of a recording's episodes as a `label_table`, or None if missing.

    These steps begin no transition, but conditions that look ahead need them. They are stored in
    the metadata of the rows, and so of their Parquet file.
    """
    packed = (table.schema.metadata or {}).get(ENDS)
    if packed is None:
        return None
    return pa.ipc.open_stream(base64.b64decode(packed)).read_all()


def packed(table: pa.Table) -> bytes:
    """Pack a table of episode ends for metadata."""
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema) as writer:
        writer.write_table(table)
    return base64.b64encode(sink.getvalue())


_CONSTANT_COLUMNS = ("recording_id", *(column.name for column in PROVENANCE))
_SECTORS = "sector_clearance_m"  # the only signal with several numbers per step


@dataclass(frozen=True)
class Provenance:
    """The source of rows; the same in every row of an ingest."""

    recording_id: str
    ingest_id: str
    source_file: str
    restock_version: str


@dataclass(frozen=True)
class TransitionValues:
    """Columns of N transitions, other than the signals and labels of their R steps."""

    observation: NDArray[np.float32]  # (R, D) at every step, including the last of each episode
    action: Ints  # (N,)
    reward: NDArray[np.float32]  # (N,)
    progress_m: NDArray[np.floating]  # (N,)
    residual: NDArray[np.floating]  # (N,) scaled distance from the command to the action
    terminates: Bools  # (N,) whether the row's episode ends by termination
    zone: Sequence[str]  # (N,)
    truth: Sequence[str | None]  # (N,) true condition
    policy: Sequence[str]  # (N,)
    policy_version: Sequence[str | None]  # (N,)
    probability: Sequence[float | None] | NDArray[np.floating]  # (N,) of choosing `action`
    perturbation: tuple[pa.Array, pa.Array]  # (N,) names, and (N,) values
    true_exposure: Sequence[str | None] | None = None  # (N,); None: unknown in all rows
    goal_source: str | None = None  # the same for all rows; None: there is no goal
    logged_ns: Ints | None = None  # (N,); None: stamp_ns plus the manifest's clock_offset_ns


def recording_table(
    profile: Profile,
    steps: Steps,
    episodes: Split,
    provenance: Provenance,
    *,
    done: Callable[[int], None] = lambda ticks: None,
) -> Work[tuple[pa.Table, EpisodeRows]]:
    """Return all transitions of a recording, and their steps (without signals).

    Rows are computed for a group of whole episodes at a time, so that only its signals are in
    memory. This changes no value: an episode's rows and labels depend on its own steps alone.
    `done` is called with the number of ticks that are finished.

    Raises:
        RecordingError: as `transitions`.
    """
    tables, ends, parts = [], [], []
    same: dict[str, pa.ChunkedArray] = {}  # constant column -> array for the largest group so far
    for group in groups(episodes):
        rows = yield from episode_rows(profile, steps, episodes, group)
        made = transitions(profile, steps, episodes, rows, provenance)
        tables.append(_share_constants(made, same))
        del made
        ends.append(rows.ends_table())
        # Drop the signals, which take most of the memory.
        parts.append(replace(rows, signals={}, custom=rows.custom.select([])))
        done(int(rows.tick.max()) + 1)
    metadata = {ENDS: packed(pa.concat_tables(ends).combine_chunks())}
    return _join(tables).replace_schema_metadata(metadata), EpisodeRows.join(parts)


def _join(tables: list[pa.Table]) -> pa.Table:
    """Join the groups' rows to one table, and empty `tables`.

    Each column is copied to new memory: a group's columns lie between arrays that are no longer
    used, and Arrow can only free them together.
    """
    schema = tables[0].schema
    columns = [[table.column(place) for table in tables] for place in range(len(schema))]
    tables.clear()
    for place, name in enumerate(schema.names):
        parts = [chunk for part in columns[place] for chunk in part.chunks]
        whole = pa.chunked_array(parts, schema.field(place).type)
        shared = name in WIDE or name in _CONSTANT_COLUMNS
        columns[place] = whole if shared else whole.combine_chunks()
        del parts, whole
    pa.default_memory_pool().release_unused()
    return pa.table(columns, schema=schema)


def _share_constants(rows: pa.Table, same: dict[str, pa.ChunkedArray]) -> pa.Table:
    """Share memory between groups for columns that have one value in the whole recording."""
    for name in _CONSTANT_COLUMNS:
        longest = same.setdefault(name, rows[name])
        if len(longest) < len(rows):
            same[name] = rows[name]
        else:
            place = rows.schema.get_field_index(name)
            column = longest.slice(0, len(rows))
            rows = rows.set_column(place, rows.schema.field(place), column)
    return rows


def transitions(
    profile: Profile, steps: Steps, episodes: Split, rows: EpisodeRows, provenance: Provenance
) -> pa.Table:
    """Return one row per transition of a recording.

    Raises:
        RecordingError: as `transition_table`.
    """
    task, begin = profile.task, rows.starts
    tick = rows.tick[begin]
    previous_tick = rows.tick - steps.follows[rows.tick]
    previous_action = np.where(steps.follows[rows.tick], steps.action[previous_tick], 0)
    before = {_SECTORS: steps.signals[_SECTORS][previous_tick]}
    narrow = {name: column for name, column in rows.signals.items() if name != _SECTORS}
    now = {name: column[begin] for name, column in narrow.items()}
    after = {name: column[begin + 1] for name, column in narrow.items()}
    progress_m = steps.routing.progress_m(task, steps.routing.plan[tick], now, after)
    earned = reward(task, now, after, progress_m, steps.action[tick], previous_action[begin])
    if task.reward_terms:
        table = label_table(rows.signals, rows.episode, rows.step, rows.custom)
        earned = earned + own_reward(task, table)[begin + 1]
    terminates = np.array([episode.terminated for episode in episodes.episodes], np.bool_)
    values = TransitionValues(
        observation=observe(task, rows.signals, before, previous_action),
        action=steps.action[tick],
        reward=earned,
        progress_m=progress_m,
        residual=steps.residual[tick],
        terminates=terminates[rows.episode[begin]],
        zone=profile.zone_of(now["pose_x_m"], now["pose_y_m"]),
        truth=_sorted_truths(steps.truth, tick),
        policy=[steps.policy[index] for index in tick],
        policy_version=[steps.policy_version[index] for index in tick],
        probability=[steps.probability[index] for index in tick],
        perturbation=steps.perturbed.columns(tick),
        true_exposure=_sorted_truths(steps.true_exposure, tick),
        goal_source=profile.goal_source,
        logged_ns=steps.logged_ns[tick],
    )
    return transition_table(profile, rows, values, provenance)


def transition_table(
    profile: Profile, rows: EpisodeRows, values: TransitionValues, provenance: Provenance
) -> pa.Table:
    """Build store rows of a recording or of the twin, with the columns of `transition_schema`.

    Raises:
        RecordingError: there are more steps than a transition id can number.
    """
    begin = rows.starts
    tick, count = rows.tick[begin], len(begin)
    if (most := int(rows.tick.max(initial=-1)) + 1) >> STEP_BITS:
        raise RecordingError(
            f"{most:,} steps are more than the {1 << STEP_BITS:,} a recording may have",
            where=provenance.source_file,
            remedy="split the recording",
        )
    last = rows.is_end[begin + 1]
    # The twin does not evaluate conditions over signals that it does not fill.
    evaluated = [one for one in profile.conditions if one.name in rows.labels]
    observation, next_observation = _vectors(values.observation, begin)
    columns: dict[str, Any] = {
        "transition_id": transition_ids(provenance.recording_id, tick),
        "recording_id": provenance.recording_id,
        "episode_id": [f"{provenance.recording_id}/{e}" for e in rows.episode[begin]],
        "episode_index": rows.episode[begin],
        "step_index": rows.step[begin],
        "logged_ns": pa.nulls(count, pa.int64()) if values.logged_ns is None else values.logged_ns,
        "observation": observation,
        "action": values.action,
        "reward": values.reward,
        "next_observation": next_observation,
        "terminated": last & values.terminates,
        "truncated": last & ~values.terminates,
        **label_columns(rows.labels, rows.exposures, rows.probabilities, evaluated, begin),
        "true_condition": values.truth,
        "true_exposure": values.true_exposure or pa.nulls(count, pa.string()),
        "perturbation": values.perturbation[0],
        "perturbation_values": values.perturbation[1],
        "zone": values.zone,
        "behaviour_policy": values.policy,
        "behaviour_version": values.policy_version,
        "action_probability": values.probability,
        "action_residual": values.residual,
        "progress_m": values.progress_m,
        "goal_source": values.goal_source or pa.nulls(count, pa.string()),
        **signal_columns(rows.signals, begin),
        "ingest_id": provenance.ingest_id,
        "source_file": provenance.source_file,
        "profile_hash": profile.hash,
        "task_hash": profile.task.hash,
        "labels_version": profile.labels_version,
        "restock_version": provenance.restock_version,
    }
    custom = rows.custom.take(pa.array(begin))
    columns |= dict(zip(custom.column_names, custom.columns, strict=True))
    schema = transition_schema(profile.task.observation_size, list(custom.schema))
    arrays = [column_array(columns[field.name], field.type, count) for field in schema]
    table = pa.table(arrays, schema=schema)
    return table.replace_schema_metadata({ENDS: packed(rows.ends_table())})


def label_columns(
    labels: dict[str, Bools],
    exposures: Mapping[str, Bools],
    probabilities: Mapping[str, F32],
    conditions: Sequence[Condition],
    rows: Ints,
) -> dict[str, Any]:
    """Return the columns of the conditions and exposures that hold at these rows.

    `conditions` are the definitions of `labels`.
    """
    named = primary(labels, conditions)
    return {
        "condition": [named[row] for row in rows] if named else [NOMINAL] * len(rows),
        "conditions": names_of(labels, rows),
        "probabilities": by_name(probabilities, rows),
        "uncertain": names_of(uncertain_steps(probabilities, conditions), rows),
        "exposures": names_of(exposures, rows),
    }


def _sorted_truths(truth: Sequence[str | None], tick: Ints) -> list[str | None]:
    """Return the true conditions at these ticks (N,), with sorted names in each text.

    A recording has only a few different texts, so each is parsed once.
    """
    texts = [truth[index] for index in tick]
    ordered = {text: truth_text(true_names(text)) for text in set(texts) if text is not None}
    return [None if text is None else ordered[text] for text in texts]


def _vectors(
    observation: NDArray[np.float32], begin: Ints
) -> tuple[pa.ChunkedArray, pa.ChunkedArray]:
    """Return columns `observation` and `next_observation` (N,) of observations (R, D).

    `begin` (N,) are the steps that begin a transition. Both columns are fixed-size lists over the
    same memory, one chunk per episode: all but an episode's first and last observation are in both.
    """
    size = observation.shape[1]
    flat = pa.array(np.ascontiguousarray(observation, np.float32).reshape(-1))
    kind = pa.list_(pa.field("element", pa.float32()), size)
    edges = np.flatnonzero(np.diff(begin) > 1) + 1
    runs = [(int(run[0]), len(run)) for run in np.split(begin, edges) if len(run)]

    def column(later: int) -> pa.ChunkedArray:
        parts = (flat.slice((first + later) * size, count * size) for first, count in runs)
        return pa.chunked_array(
            [pa.FixedSizeListArray.from_arrays(part, type=kind) for part in parts], kind
        )

    return column(0), column(1)


def column_array(values: Any, kind: pa.DataType, count: int) -> pa.Array:
    """Return values as a column of this type; a single string is repeated `count` times."""
    if isinstance(values, str):
        return pa.repeat(pa.scalar(values, kind), count)
    if isinstance(values, pa.Array | pa.ChunkedArray):
        return values if values.type == kind else values.cast(kind)
    if isinstance(values, np.ndarray):
        return pa.array(values).cast(kind, safe=False) if len(values) else pa.array([], kind)
    return pa.array(values, kind)


def replaced(rows: pa.Table, columns: Mapping[str, Any]) -> pa.Table:
    """Replace the values of some columns, keeping types and metadata."""
    metadata = rows.schema.metadata
    for name, values in columns.items():
        index = rows.schema.get_field_index(name)
        field = rows.schema.field(index)
        rows = rows.set_column(index, field, column_array(values, field.type, len(rows)))
    return rows.replace_schema_metadata(metadata)


def by_name(values: Mapping[str, F32], rows: Ints) -> pa.Array:
    """Return a map array of name -> value for these rows, without NaN."""
    table = np.stack([column[rows] for column in values.values()], axis=1) if values else None
    if table is None:
        table = np.zeros((len(rows), 0), np.float32)
    known = np.isfinite(table)
    which = pa.array(np.nonzero(known)[1].astype(np.int32))
    names = pa.DictionaryArray.from_arrays(which, pa.array(list(values), pa.string()))
    offsets = pa.array(offsets_of(known.sum(axis=1)).astype(np.int32))
    items = pa.array(table[known].astype(np.float32))
    return pa.MapArray.from_arrays(offsets, names.cast(pa.string()), items)


def names_of(labels: Mapping[str, Bools], rows: Ints) -> pa.Array:
    """Return a list array of the labels that hold in each of these rows, in `labels` order."""
    table = np.zeros((len(rows), len(labels)), np.bool_)
    for column, holds in zip(table.T, labels.values(), strict=True):
        column[:] = holds[rows]
    which = pa.array(np.nonzero(table)[1].astype(np.int32))
    names = pa.DictionaryArray.from_arrays(which, pa.array(list(labels), pa.string()))
    offsets = pa.array(offsets_of(table.sum(axis=1)).astype(np.int32))
    return pa.ListArray.from_arrays(offsets, names.cast(pa.string()))
