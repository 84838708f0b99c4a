"""Packing: a plan's rows into one file of float32 rows, with metadata beside, in bounded memory.

Whatever the size of the store, memory holds the plan, a batch and some blocks of packed rows.
Observations are read in the order in which the files have them and put where they belong, because
sorting rows this wide would spill all of them to disk first: a recording's rows lie together in
both, so what is written together lies together, and a block is full soon after it was begun.
"""

from __future__ import annotations

import hashlib
import itertools
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from restock.arrays import Ints
from restock.errors import PanelError
from restock.replay.mixture.mixture import Mixture
from restock.replay.mixture.packed_row import row_columns, row_width
from restock.replay.panel.scratch import STRETCH, SourceSteps
from restock.replay.plan.candidates import any_order, as_stored, matrix
from restock.replay.plan.plan import PanelPlan
from restock.replay.plan.strata import NO_STRATUM
from restock.replay.sampling.row_file import read_into

ROW_GROUP_ROWS = 65_536
BATCH_ROWS = 16_384  # of what stands beside the rows, in memory at a time
BLOCK_ROWS = 512  # of packed rows, written together
HELD_BYTES = 128 << 20  # of blocks that are not full, in memory at a time
BATCH_BYTES = 4 << 20  # of observations, in memory at a time
FINITE = (
    'where = "isfinite(list_sum(observation::FLOAT[]) + list_sum(next_observation::FLOAT[])'
    ' + reward)"'
)
_TEXT = pa.dictionary(pa.int32(), pa.string())
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
        for begin in range(0, self.steps.rows, STRETCH):
            end = min(begin + STRETCH, self.steps.rows)
            yield begin, end, np.flatnonzero(self.plan.stratum[begin:end] != NO_STRATUM)

    def digest(self) -> str:
        """Names the rows: ids, strata, horizons, weights."""
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

    def write_rows(self, path: Path, advance: Callable[[int], None]) -> int:
        """Write the packed rows; returns the observation size.

        Raises PanelError where an observation or reward is not finite, or of another size.
        """
        of_task = f"FROM {as_stored(self.connection)} WHERE task_hash = '{self.plan.task_hash}'"
        first = self.connection.sql(f"SELECT len(observation) {of_task} LIMIT 1").fetchall()
        size = int(first[0][0])
        at_a_time = max(BATCH_BYTES // (8 * size), 1)
        names = "transition_id, recording_id, action, terminated, observation, next_observation"
        query = f"SELECT {names} {of_task}"
        places = self.steps.places()
        # Two halves of a row: what is observed and done, and what comes of it.
        with (
            _PackedRows(path, len(self.chosen), row_width(size), parts=2) as rows,
            any_order(self.connection),  # each row knows where it belongs
        ):
            for batch in self.connection.sql(query).to_arrow_reader(at_a_time):
                place = places.of(batch.column("transition_id").to_numpy())
                self._write(rows, size, batch, place)
                advance(len(batch))
            if not rows.is_full:
                raise PanelError("the source changed while it was read", where=str(path.parent))
        return size

    def _write(self, rows: _PackedRows, size: int, batch: pa.RecordBatch, place: Ints) -> None:
        """Put a batch's values where they belong."""
        part = row_columns(size)
        target = np.searchsorted(self.chosen, place)
        packed = np.flatnonzero(_at(self.chosen, target) == place)
        target = target[packed]
        observation = _chosen(matrix(batch.column("observation"), size), packed)
        next_observation = matrix(batch.column("next_observation"), size)
        horizon = self.last[target] - place[packed] + 1
        returns = np.zeros(len(packed))
        for ahead in range(int(horizon.max(initial=0))):
            reach = np.flatnonzero(horizon > ahead)
            reward = self.steps.reward[place[packed[reach]] + ahead]
            returns[reach] += self.mixture.discount**ahead * reward
        action = batch.column("action").to_numpy()[packed, None]
        rows.put(
            target,
            (part["observation"], observation),
            (part["action"], action),
            (part["reward"], returns[:, None]),
        )
        # Returns that end with a row of this batch take its next observation.
        first, behind = (np.searchsorted(self.last, place, side) for side in ("left", "right"))
        source = np.repeat(np.arange(len(place)), behind - first)
        ends = np.arange(len(source)) + np.repeat(first - _starts(behind - first), behind - first)
        next_observation = _chosen(next_observation, source)
        not_terminated = ~np.asarray(
            batch.column("terminated").to_numpy(zero_copy_only=False), np.bool_
        )
        spanned = self.last[ends] - self.chosen[ends] + 1
        discount = (self.mixture.discount**spanned * not_terminated[source])[:, None]
        rows.put(ends, (part["next_observation"], next_observation), (part["discount"], discount))
        if not all(np.isfinite(one).all() for one in (observation, next_observation, returns)):
            raise PanelError(
                "an observation or a reward is NaN or infinite, which makes training fail",
                where=f"recording {batch.column('recording_id')[0].as_py()}",
                remedy=f"`restock audit` lists the rows; a mixture leaves them out with {FINITE}",
            )

    def write_meta(self, meta: Path, evaluation_split: Path) -> None:
        """Write what stands beside the rows, and the evaluation split, in the same order."""
        names = pa.array([line.name for line in self.plan.strata], pa.string())
        to_go = None
        if self.mixture.return_to_go:
            to_go = self.steps.returns_to_go(self.mixture.discount)
        at = 0
        with _Table(meta) as kept, _Table(evaluation_split) as left:
            for begin in range(0, self.steps.rows, BATCH_ROWS):
                table = _compact(self.plan.rows.slice(begin, BATCH_ROWS))
                end = begin + len(table)
                split = table.select(_SPLIT_COLUMNS).filter(
                    pa.array(self.plan.evaluation_split[begin:end])
                )
                # For the audit `leakage`.
                split_by = pa.repeat(self.plan.split_by, len(split))
                left.write(split.append_column("split_by", split_by))
                code = self.plan.stratum[begin:end]
                rows = np.flatnonzero(code != NO_STRATUM)
                table, code = table.take(pa.array(rows)), code[rows]
                packed = slice(at, at + len(rows))
                beside: dict[str, Any] = {
                    "stratum": pa.DictionaryArray.from_arrays(pa.array(code, pa.int32()), names),
                    "stratum_code": pa.array(code),
                    "horizon": pa.array(
                        (self.last[packed] - self.chosen[packed] + 1).astype(np.int16)
                    ),
                    "weight": pa.array(self.plan.weight[packed]),
                    **{name: pa.array(v[packed]) for name, v in self.plan.beside.items()},
                }
                if to_go is not None:
                    beside["return_to_go"] = pa.array(to_go[0][begin:end][rows])
                    beside["return_to_go_whole"] = pa.array(to_go[1][begin:end][rows])
                for name, values in beside.items():
                    table = table.append_column(name, values)
                kept.write(table)
                at += len(rows)


class _PackedRows:
    """Rows (n, W) float32 of a file, put there part by part, in any order, each part once.

    Blocks are written when they are full; those that wait for the rest of their rows are held, and
    where they are too many, written as they are and read again.
    """

    def __init__(self, path: Path, rows: int, width: int, *, parts: int) -> None:
        self._rows, self._width, self._parts = rows, width, parts
        self._path = str(path)
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666)
        self._put: Ints = np.zeros(-(-rows // BLOCK_ROWS), np.int64)  # parts of rows, of each block
        self._held: dict[int, NDArray[np.float32]] = {}

    def __enter__(self) -> _PackedRows:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._file)

    @property
    def is_full(self) -> bool:
        """Whether every part of every row was put."""
        return int(self._put.sum()) == self._rows * self._parts

    def put(self, rows: Ints, *values: tuple[slice, NDArray[Any]]) -> None:
        """One part of rows (m,): some of their columns, with what they hold, (m, c)."""
        if (np.diff(rows) < 0).any():
            order = np.argsort(rows, kind="stable")
            rows, values = rows[order], tuple((columns, held[order]) for columns, held in values)
        block = rows // BLOCK_ROWS
        for begin, end in itertools.pairwise([0, *np.flatnonzero(np.diff(block)) + 1, len(rows)]):
            if begin == end:
                continue
            number = int(block[begin])
            packed = self._block(number)
            inside = rows[begin:end] - number * BLOCK_ROWS
            to: Ints | slice = inside
            if inside[-1] - inside[0] == end - begin - 1 and (np.diff(inside) == 1).all():
                to = slice(int(inside[0]), int(inside[-1]) + 1)
            for columns, held in values:
                packed[to, columns] = held[begin:end]
            self._put[number] += end - begin
            if self._put[number] == len(packed) * self._parts:
                self._write(number)
        while len(self._held) * BLOCK_ROWS * self._width * 4 > HELD_BYTES:
            self._write(next(iter(self._held)))

    def _block(self, number: int) -> NDArray[np.float32]:
        if (held := self._held.get(number)) is None:
            count = min(BLOCK_ROWS, self._rows - number * BLOCK_ROWS)
            held = np.zeros((count, self._width), "<f4")
            if self._put[number] and not read_into(held, self._file, self._place(number)):
                raise PanelError("what was written of it is gone", where=self._path)
            self._held[number] = held
        return held

    def _write(self, number: int) -> None:
        rest = self._held.pop(number).data.cast("B")
        place = self._place(number)
        while rest:  # a full disk is an OSError; what is written short goes on
            written = os.pwrite(self._file, rest, place)
            rest, place = rest[written:], place + written

    def _place(self, number: int) -> int:
        return number * BLOCK_ROWS * self._width * 4


class _Table:
    """A Parquet file, written a row group at a time."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._waiting: list[pa.Table] = []
        self._writer: pq.ParquetWriter | None = None

    def __enter__(self) -> _Table:
        return self

    def __exit__(self, *_: object) -> None:
        self._flush()
        if self._writer is not None:
            self._writer.close()

    def write(self, table: pa.Table) -> None:
        self._waiting.append(table)
        if sum(map(len, self._waiting)) >= ROW_GROUP_ROWS:
            self._flush()

    def _flush(self) -> None:
        if self._waiting:
            table, self._waiting = pa.concat_tables(self._waiting), []
            if self._writer is None:
                self._writer = pq.ParquetWriter(self._path, table.schema, compression="zstd")
            self._writer.write_table(table.unify_dictionaries())


def _compact(table: pa.Table) -> pa.Table:
    """Text as codes of what these rows have alone: readers keep them so."""
    for place, field in enumerate(table.schema):
        if field.type == _TEXT:
            column = table.column(place).cast(pa.string()).cast(_TEXT)
            table = table.set_column(place, field, column)
    return table


def _chosen(matrix: NDArray[np.float32], rows: Ints) -> NDArray[np.float32]:
    """matrix[rows], without a copy where these are all of them, in order."""
    whole = len(rows) == len(matrix) and np.array_equal(rows, np.arange(len(rows)))
    return matrix if whole else matrix[rows]


def _at(values: Ints, place: Ints) -> Ints:
    """values[place], and -1 beyond the end."""
    if not len(values):
        return np.full(len(place), -1)
    at: Ints = np.where(place < len(values), values[np.minimum(place, len(values) - 1)], -1)
    return at


def _starts(counts: Ints) -> Ints:
    """Where each of consecutive groups of these sizes begins."""
    return np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64)
