"""Packing: a plan's rows into one file of float32 rows, with metadata beside, in bounded memory.

Whatever the size of the store, memory holds the plan, a batch and some blocks of packed rows.
Observations are read in the order in which the files have them and put where they belong, because
sorting rows this wide would spill all of them to disk first: a recording's rows lie together in
both, so what is written together lies together, and a block is full soon after it was begun.
"""

from __future__ import annotations

import hashlib
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

from restock.arrays import Ints
from restock.errors import PanelError
from restock.replay.mixture.mixture import Mixture
from restock.replay.mixture.packed_row import row_columns, row_width
from restock.replay.panel.packed_file import PackedFile, Values
from restock.replay.panel.scratch import SourceSteps
from restock.replay.panel.seal import FileRecord
from restock.replay.plan.candidates import any_order, as_stored, matrix
from restock.replay.plan.plan import PanelPlan
from restock.replay.plan.strata import NO_STRATUM
from restock.replay.plan.transition_ids import stretches

ROW_GROUP_ROWS = 65_536
BATCH_BYTES = 4 << 20  # of observations, in memory at a time
FINITE = (
    'where = "isfinite(list_sum(observation::FLOAT[]) + list_sum(next_observation::FLOAT[])'
    ' + reward)"'
)
# Of these hardly two rows have the same.
_NO_DICTIONARY = ("transition_id", "stamp_ns", "logged_ns", "reward", "return_to_go")
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


class Packer:
    """Packs one plan. `steps` are those of the source, in the order of the plan."""

    def __init__(
        self,
        connection: duckdb.DuckDBPyConnection,
        plan: PanelPlan,
        steps: SourceSteps,
        scratch: Path,
    ) -> None:
        self.connection, self.plan, self.steps = connection, plan, steps
        self.mixture: Mixture = plan.mixture
        count = len(plan.weight)
        # Of each packed row: its place in the source, and that of the last step of its return.
        self.chosen: Ints = np.memmap(scratch / "chosen", np.int64, "w+", shape=(count,))
        self.last: Ints = np.memmap(scratch / "last", np.int64, "w+", shape=(count,))
        at = 0
        for begin, end, rows in self._stretches():
            horizon = steps.horizon(begin, end, self.mixture.n_step)[rows]
            self.chosen[at : at + len(rows)] = begin + rows
            self.last[at : at + len(rows)] = begin + rows + horizon - 1
            at += len(rows)

    def _stretches(self) -> Iterator[tuple[int, int, Ints]]:
        """Stretches of the source, and which of their rows are packed."""
        for begin, end in stretches(self.steps.rows):
            yield begin, end, np.flatnonzero(self.plan.stratum[begin:end] != NO_STRATUM)

    def digest(self) -> str:
        """Return a hash of the rows: ids, strata, horizons, weights."""
        digests = [hashlib.blake2b(digest_size=8) for _ in range(4)]
        at = 0
        for begin, _, rows in self._stretches():
            packed = slice(at, at + len(rows))
            for digest, values in zip(
                digests,
                (
                    self.steps.ids[self.chosen[packed]],
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
        """Write the packed rows; returns the observation size, and the file's record.

        Raises PanelError where an observation or reward is not finite, or of another size.
        """
        of_task = f"FROM {as_stored(self.connection)} WHERE task_hash = '{self.plan.task_hash}'"
        first = self.connection.sql(f"SELECT len(observation) {of_task} LIMIT 1").fetchall()
        size = int(first[0][0])
        at_a_time = max(BATCH_BYTES // (8 * size), 1)
        names = "transition_id, action, terminated, observation, next_observation"
        query = f"SELECT {names} {of_task}"
        places = self.steps.places()
        # Two halves of a row: what is observed and done, and what comes of it.
        with (
            PackedFile(path, len(self.chosen), row_width(size), parts=2) as rows,
            any_order(self.connection),  # each row knows where it belongs
        ):
            for batch in filter(len, self.connection.sql(query).to_arrow_reader(at_a_time)):
                place = places.of(batch.column("transition_id").to_numpy())
                self._write(rows, size, batch, place)
                advance(len(batch))
            return size, rows.finish()

    def _write(self, rows: PackedFile, size: int, batch: pa.RecordBatch, place: Ints) -> None:
        """Put a batch's values where they belong."""
        part = row_columns(size)
        target, behind = _between(self.chosen, place)
        packed = np.flatnonzero(behind > target)  # those that are there
        target = target[packed]
        observation = matrix(batch.column("observation"), size)
        next_observation = matrix(batch.column("next_observation"), size)
        horizon = self.last[target] - place[packed] + 1
        returns = np.zeros(len(batch))
        for ahead in range(int(horizon.max(initial=0))):
            reach = packed[horizon > ahead]
            reward = self.steps.reward[place[reach] + ahead]
            returns[reach] += self.mixture.discount**ahead * reward
        rows.put(
            target,
            Values(part["observation"], observation, packed),
            Values(part["action"], batch.column("action").to_numpy()[:, None], packed),
            Values(part["reward"], returns[:, None], packed),
        )
        # Returns that end with a row of this batch take its next observation.
        first, behind = _between(self.last, place)
        source = np.repeat(np.arange(len(place)), behind - first)
        ends = np.arange(len(source)) + np.repeat(first - _starts(behind - first), behind - first)
        not_terminated = ~np.asarray(
            batch.column("terminated").to_numpy(zero_copy_only=False), np.bool_
        )
        spanned = self.last[ends] - self.chosen[ends] + 1
        discount = (self.mixture.discount**spanned * not_terminated[source])[:, None]
        rows.put(
            ends,
            Values(part["next_observation"], next_observation, source),
            Values(part["discount"], discount),
        )
        if not (
            _finite(observation, packed)
            and _finite(next_observation, source)
            and np.isfinite(returns).all()
        ):
            raise PanelError(
                "an observation or a reward is NaN or infinite, which makes training fail",
                where=f"recording {self.plan.rows['recording_id'][int(place.max())]}",
                remedy=f"`restock audit` lists the rows; a mixture leaves them out with {FINITE}",
            )

    def write_meta(self, meta: Path, evaluation_split: Path, stop: Event) -> None:
        """Write the metadata of the rows, and the evaluation split, in the same order.

        Writing ends early if `stop` is set.
        """
        held = np.flatnonzero(self.plan.evaluation_split)
        with _writer(evaluation_split) as write:
            for begin in _groups(len(held), stop):
                part = self.plan.rows.select(_SPLIT_COLUMNS).take(pa.array(held[begin]))
                # For the audit `leakage`.
                split_by = pa.array([self.plan.split_by], pa.string())
                column = pa.DictionaryArray.from_arrays(np.zeros(len(part), np.int8), split_by)
                write(part.append_column("split_by", column))
        names = pa.array([line.name for line in self.plan.strata], pa.string())
        to_go = None
        if self.mixture.return_to_go:
            to_go = self.steps.returns_to_go(self.mixture.discount)
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
                if to_go is not None:
                    beside["return_to_go"] = pa.array(to_go[0][chosen])
                    beside["return_to_go_whole"] = pa.array(to_go[1][chosen])
                for name, values in beside.items():
                    part = part.append_column(name, values)
                write(part)


def _groups(rows: int, stop: Event) -> Iterator[slice]:
    """Yield the row groups of a table of `rows` rows; an empty table has one empty group."""
    for begin in range(0, max(rows, 1), ROW_GROUP_ROWS):
        if stop.is_set():
            return
        yield slice(begin, min(begin + ROW_GROUP_ROWS, rows))


@contextmanager
def _writer(path: Path) -> Iterator[Callable[[pa.Table], None]]:
    """Write a Parquet file, a row group at a time."""
    made: list[pq.ParquetWriter] = []

    def write(rows: pa.Table) -> None:
        for place, field in enumerate(rows.schema):
            if pa.types.is_dictionary(field.type):
                column = _compact(rows.column(place).combine_chunks())
                rows = rows.set_column(place, field.name, column)
        if not made:
            coded = [name for name in rows.schema.names if name not in _NO_DICTIONARY]
            writer = pq.ParquetWriter(path, rows.schema, compression="zstd", use_dictionary=coded)
            made.append(writer)
        made[0].write_table(rows)

    try:
        yield write
    finally:
        for writer in made:
            writer.close()


def _compact(column: pa.DictionaryArray) -> pa.DictionaryArray:
    """Text as codes of what these rows have alone: readers keep them so."""
    used = column.indices.unique().drop_null()
    order = used.take(pc.array_sort_indices(used))
    codes = pc.index_in(column.indices, value_set=order)
    return pa.DictionaryArray.from_arrays(codes, column.dictionary.take(order))


def _finite(values: NDArray[np.float32], rows: Ints) -> bool:
    """Return whether there is neither NaN nor infinity in these rows (n,) of (m, c)."""
    return bool(np.isfinite(values).all() or np.isfinite(values[rows]).all())


def _between(ascending: Ints, values: Ints) -> tuple[Ints, Ints]:
    """Return the begin and end of each of these values (n,) in an ascending array."""
    # Those of one batch mostly lie together: the part of the array that may have them is small.
    low, high = np.searchsorted(ascending, [values.min(), values.max() + 1])
    near = np.asarray(ascending[low:high])
    begin, end = (low + np.searchsorted(near, values, side) for side in ("left", "right"))
    return np.asarray(begin, np.int64), np.asarray(end, np.int64)


def _starts(counts: Ints) -> Ints:
    """Return where each of consecutive groups of these sizes begins."""
    return np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64)
