"""Pack a plan's rows into a file of float32 rows and a table of metadata, in bounded memory.

For a store of any size, memory holds only the plan and a batch.
Observations are read in the order of the files and written to their places, because sorting such
wide rows would spill all of them to disk first. The rows of a recording are adjacent in both
orders, so each batch is written to few parts of the file.

An n-step return of step t uses the rewards of [t, t + n) and bootstraps from the state at t + n. It
is cut where the episode ends, where a step is missing, and before an off-policy action: the action
of step j ends the returns of earlier steps if

- another behaviour policy (or version) than in the step before chose it (a handover);
- its policy gave it less than chance, 1 / number of actions (exploration).

Such a cut depends on the action of j, which is chosen in the state from which the return then
bootstraps. Given that state, the action is independent of the rewards before it, so the cut adds no
bias (it is the cut of Watkins's Q(lambda), 1989). It never depends on a reward or a state after j.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from restock.arrays import F32, Bools, Ints
from restock.errors import PanelError
from restock.replay.mixture.mixture import Mixture
from restock.replay.panel.panel import FileRecord
from restock.replay.plan.candidates import Places, any_order, codes, matrix, stored_view, stretches
from restock.replay.plan.plan import PanelPlan
from restock.replay.plan.strata import NO_STRATUM
from restock.replay.sampling.packed_rows import row_columns, row_width


class PackedFile:
    """Writes a file of rows (n, W) float32 from parts of rows, each put once, in any order.

    Each `put` maps only the part of the file that it writes, so memory does not grow with the file.

    Raises:
        OSError: the disk has too little space for the file.
    """

    def __init__(self, path: Path, rows: int, width: int, *, parts: int) -> None:
        self._path, self._width = path, width
        self._missing = rows * parts
        with path.open("wb") as file:
            if rows:  # reserve the space: a disk that is full later would end the process
                os.posix_fallocate(file.fileno(), 0, 4 * rows * width)

    def put(self, rows: Ints, *values: tuple[slice, NDArray[Any]]) -> None:
        """Set some columns of rows (m,); each value has the columns and their content, (m, c)."""
        if not len(rows):
            return
        first, last = int(rows.min()), int(rows.max())
        packed = np.memmap(
            self._path,
            "<f4",
            "r+",
            offset=4 * first * self._width,
            shape=(last - first + 1, self._width),
        )
        for columns, content in values:
            packed[rows - first, columns] = content
        self._missing -= len(rows)

    def finish(self) -> FileRecord:
        """Return the size and checksums of the file.

        Raises:
            PanelError: a part of a row is missing.
        """
        if self._missing:
            raise PanelError("the source changed while it was read", where=str(self._path.parent))
        return FileRecord.of(self._path)


ROW_GROUP_ROWS = 65_536
BATCH_BYTES = 4 << 20  # largest size of a batch of observations
FINITE = (
    'where = "isfinite(list_sum(observation::FLOAT[]) + list_sum(next_observation::FLOAT[])'
    ' + reward)"'
)
# Columns that are written without a dictionary, because few of their values repeat.
_NO_DICTIONARY = ("transition_id", "stamp_ns", "logged_ns", "reward")
_SPLIT_COLUMNS = (
    "transition_id",
    "recording_id",
    "episode_id",
    "step_index",
    "logged_ns",
    "condition",
    "robot",
    "site",
)


def continues_return(rows: pa.Table, random_probability: float) -> Bools:
    """Return for each row whether its n-step return may include the next row, (N,).

    It may if the next row is the next step of the same episode, and the same policy chose its
    action without exploring. `rows` (N) have META_COLUMNS and are sorted. `random_probability` is
    the probability of an action under random choice, 0 if unknown: an action that was less likely
    counts as exploration.
    """
    # A policy without a version has version "".
    version = pc.coalesce(rows["behaviour_version"].cast(pa.string()), "")
    version = version.combine_chunks().dictionary_encode()
    policy = codes(rows, "behaviour_policy").astype(np.int64)
    policy = np.where(policy < 0, -1, policy * len(version.dictionary) + version.indices.to_numpy())
    episode, step = codes(rows, "episode_id"), rows["step_index"].to_numpy()
    ended = rows["terminated"].to_numpy() | rows["truncated"].to_numpy()
    explored = rows["action_probability"].to_numpy() < random_probability
    goes_on = np.zeros(len(rows), np.bool_)
    goes_on[:-1] = (episode[1:] == episode[:-1]) & (step[1:] == step[:-1] + 1) & ~ended[:-1]
    goes_on[:-1] &= (policy[1:] == policy[:-1]) & ~explored[1:]
    return goes_on


def n_step_horizon(continues: Bools, n_step: int) -> Ints:
    """Return how many steps each row's return spans, (N,) in 1..n_step.

    `continues` (N,) comes from `continues_return`.
    """
    horizon = np.ones(len(continues), np.int64)
    unbroken = np.ones(len(continues), np.bool_)
    for ahead in range(1, min(n_step, len(continues) + 1)):
        # Row i's return includes row i + ahead if it includes the row before and that continues.
        step = np.zeros(len(continues), np.bool_)
        step[: len(continues) - ahead + 1] = continues[ahead - 1 :]
        unbroken &= step
        horizon += unbroken
    return horizon


class Packer:
    """Packs the rows of one plan. For `random_probability` see `continues_return`."""

    def __init__(
        self,
        connection: duckdb.DuckDBPyConnection,
        plan: PanelPlan,
        scratch: Path,
        *,
        random_probability: float,
    ) -> None:
        self.connection, self.plan = connection, plan
        self.mixture: Mixture = plan.mixture
        self._ids: Ints = plan.rows["transition_id"].to_numpy()
        self._reward: F32 = plan.rows["reward"].to_numpy()
        count = len(plan.weight)
        # Positions in the source of each packed row, and of the last row that its return includes.
        self.chosen: Ints = np.memmap(scratch / "chosen", np.int64, "w+", shape=(count,))
        self.last: Ints = np.memmap(scratch / "last", np.int64, "w+", shape=(count,))
        at = 0
        for begin, end, rows in self._stretches():
            # Also read the rows after `end` that a return can include.
            part = plan.rows.slice(begin, end - begin + self.mixture.n_step)
            horizon = n_step_horizon(
                continues_return(part, random_probability), self.mixture.n_step
            )[rows]
            self.chosen[at : at + len(rows)] = begin + rows
            self.last[at : at + len(rows)] = begin + rows + horizon - 1
            at += len(rows)

    def _stretches(self) -> Iterator[tuple[int, int, Ints]]:
        """Yield ranges [begin, end) of the source's rows, and which rows in each are packed."""
        for begin, end in stretches(len(self.plan.rows)):
            yield begin, end, np.flatnonzero(self.plan.stratum[begin:end] != NO_STRATUM)

    def digest(self) -> str:
        """Return a hash over the ids, strata, horizons and weights of the packed rows."""
        digests = [hashlib.blake2b(digest_size=8) for _ in range(4)]
        at = 0
        for begin, _, rows in self._stretches():
            packed = slice(at, at + len(rows))
            for digest, values in zip(
                digests,
                (
                    self._ids[self.chosen[packed]],
                    self.plan.stratum[begin + rows],
                    self.last[packed] - self.chosen[packed],
                    self.plan.weight[packed],
                ),
                strict=True,
            ):
                digest.update(np.ascontiguousarray(values).tobytes())
            at += len(rows)
        return hashlib.blake2b(b"".join(d.digest() for d in digests), digest_size=8).hexdigest()

    def write_rows(self, path: Path, advance: Callable[[int], None]) -> tuple[int, FileRecord]:
        """Write the packed rows; return the observation size, and the file's record.

        Raises PanelError if an observation or reward is not finite, or an observation has another
        size.
        """
        of_task = f"FROM {stored_view(self.connection)} WHERE task_hash = '{self.plan.task_hash}'"
        first = self.connection.sql(f"SELECT len(observation) {of_task} LIMIT 1").fetchall()
        size = int(first[0][0])
        at_a_time = max(BATCH_BYTES // (8 * size), 1)
        names = "transition_id, action, terminated, observation, next_observation"
        query = f"SELECT {names} {of_task}"
        places = Places(self._ids)
        # A row has two parts: observation, action and reward; next observation and discount.
        rows = PackedFile(path, len(self.chosen), row_width(size), parts=2)
        with any_order(self.connection):  # allowed, as a row's place follows from its id
            for batch in filter(len, self.connection.sql(query).to_arrow_reader(at_a_time)):
                place = places.of(batch.column("transition_id").to_numpy())
                self._write(rows, size, batch, place)
                advance(len(batch))
        return size, rows.finish()

    def _write(self, rows: PackedFile, size: int, batch: pa.RecordBatch, place: Ints) -> None:
        """Write a batch's values to the packed rows that use them."""
        part = row_columns(size)
        target, behind = _find_ranges(self.chosen, place)
        packed = np.flatnonzero(behind > target)  # rows of the batch that are packed
        target = target[packed]
        observation = matrix(batch.column("observation"), size)
        next_observation = matrix(batch.column("next_observation"), size)
        horizon = self.last[target] - place[packed] + 1
        returns = np.zeros(len(batch))
        for ahead in range(int(horizon.max(initial=0))):
            reach = packed[horizon > ahead]
            reward = self._reward[place[reach] + ahead]
            returns[reach] += self.mixture.discount**ahead * reward
        rows.put(
            target,
            (part["observation"], observation[packed]),
            (part["action"], batch.column("action").to_numpy()[packed, None]),
            (part["reward"], returns[packed, None]),
        )
        # A row's next observation completes the packed rows whose return ends with that row.
        first, behind = _find_ranges(self.last, place)
        source = np.repeat(np.arange(len(place)), behind - first)
        ends = np.arange(len(source)) + np.repeat(first - _starts(behind - first), behind - first)
        not_terminated = ~np.asarray(
            batch.column("terminated").to_numpy(zero_copy_only=False), np.bool_
        )
        spanned = self.last[ends] - self.chosen[ends] + 1
        discount = (self.mixture.discount**spanned * not_terminated[source])[:, None]
        rows.put(
            ends,
            (part["next_observation"], next_observation[source]),
            (part["discount"], discount),
        )
        if not (
            _is_finite(observation, packed)
            and _is_finite(next_observation, source)
            and np.isfinite(returns).all()
        ):
            raise PanelError(
                "an observation or a reward is NaN or infinite, which makes training fail",
                where=f"recording {self.plan.rows['recording_id'][int(place.max())]}",
                remedy=f"`restock audit` lists the rows; a mixture leaves them out with {FINITE}",
            )

    def write_meta(self, meta: Path, evaluation_split: Path, stop: Event) -> None:
        """Write the metadata of packed rows and of the evaluation split; end early if `stop`."""
        held = np.flatnonzero(self.plan.evaluation_split)
        with _writer(evaluation_split) as write:
            for begin in _groups(len(held), stop):
                part = self.plan.rows.select(_SPLIT_COLUMNS).take(pa.array(held[begin]))
                # The audit `leakage` uses this column.
                split_by = pa.array([self.plan.split_by], pa.string())
                column = pa.DictionaryArray.from_arrays(np.zeros(len(part), np.int8), split_by)
                write(part.append_column("split_by", column))
        names = pa.array([line.name for line in self.plan.strata], pa.string())
        with _writer(meta) as write:
            for packed in _groups(len(self.chosen), stop):
                chosen = np.asarray(self.chosen[packed])
                part, code = self.plan.rows.take(pa.array(chosen)), self.plan.stratum[chosen]
                beside: dict[str, Any] = {
                    "stratum": pa.DictionaryArray.from_arrays(pa.array(code, pa.int32()), names),
                    "stratum_code": pa.array(code),
                    "horizon": pa.array((self.last[packed] - chosen + 1).astype(np.int16)),
                    "weight": pa.array(self.plan.weight[packed]),
                    **{name: pa.array(v[packed]) for name, v in self.plan.beside.items()},
                }
                for name, values in beside.items():
                    part = part.append_column(name, values)
                write(part)


def _groups(rows: int, stop: Event) -> Iterator[slice]:
    """Yield the slices of row groups; an empty table has one empty group. End early if `stop`."""
    for begin in range(0, max(rows, 1), ROW_GROUP_ROWS):
        if stop.is_set():
            return
        yield slice(begin, min(begin + ROW_GROUP_ROWS, rows))


@contextmanager
def _writer(path: Path) -> Iterator[Callable[[pa.Table], None]]:
    """Yield a function that appends a row group to a Parquet file."""
    writers: list[pq.ParquetWriter] = []

    def write(rows: pa.Table) -> None:
        for place, field in enumerate(rows.schema):
            if pa.types.is_dictionary(field.type):
                column = _compact(rows.column(place).combine_chunks())
                rows = rows.set_column(place, field.name, column)
        if not writers:
            coded = [name for name in rows.schema.names if name not in _NO_DICTIONARY]
            writer = pq.ParquetWriter(path, rows.schema, compression="zstd", use_dictionary=coded)
            writers.append(writer)
        writers[0].write_table(rows)

    try:
        yield write
    finally:
        for writer in writers:
            writer.close()


def _compact(column: pa.DictionaryArray) -> pa.DictionaryArray:
    """Reduce a dictionary to values that occur, in order: readers load all of a dictionary."""
    used = column.indices.unique().drop_null()
    order = used.take(pc.array_sort_indices(used))
    codes = pc.index_in(column.indices, value_set=order)
    return pa.DictionaryArray.from_arrays(codes, column.dictionary.take(order))


def _is_finite(values: NDArray[np.float32], rows: Ints) -> bool:
    """Return whether values (m, c) are finite in these rows (n,)."""
    return bool(np.isfinite(values).all() or np.isfinite(values[rows]).all())


def _find_ranges(ascending: Ints, values: Ints) -> tuple[Ints, Ints]:
    """Return begin and end of the range of each value (n,) in an ascending array, (n,) each."""
    # Values of one batch are mostly close together: search only the part that they can be in.
    low, high = np.searchsorted(ascending, [values.min(), values.max() + 1])
    near = np.asarray(ascending[low:high])
    begin, end = (low + np.searchsorted(near, values, side) for side in ("left", "right"))
    return np.asarray(begin, np.int64), np.asarray(end, np.int64)


def _starts(counts: Ints) -> Ints:
    """Return where each group begins if groups of these sizes follow each other."""
    return np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64)
