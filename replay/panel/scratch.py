"""What packing must know of every row of the source, on disk and not in memory: a few bytes a row.

Lies beside the panel while it is built, and is gone when it is there.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.arrays import F32, F64, Bools, Ints
from restock.errors import PanelError
from restock.replay.mixture.n_step import (
    CONTINUES,
    ON_POLICY,
    TERMINATED,
    n_step_horizon,
    n_step_return,
    return_to_go,
    step_flags,
)

# The order of the rows of a source: the order in which a plan numbers them.
ORDER = "ORDER BY recording_id, episode_index, step_index"
BATCH_ROWS = 16_384  # of the source, in memory at a time
STRETCH = 1 << 18  # scalars in memory at a time

_STEPS = f"""
SELECT transition_id, episode_id, step_index, reward,
    behaviour_policy || '@' || coalesce(behaviour_version, '') AS policy,
    terminated, truncated, coalesce(action_probability < $random_probability, false) AS explored
FROM transitions {ORDER}
"""


class SourceSteps:
    """Every row of the source in order: ids, rewards and what each is to the next, (N,) on disk.

    Args:
        folder: where the files go.
        connection: with the view `transitions`, of `rows` rows.
        random_probability: of an action chosen blindly; below it a policy explores. 0: unknown.
        cut_at_off_policy: end returns before off-policy actions; see `n_step`.
    """

    def __init__(
        self,
        folder: Path,
        connection: duckdb.DuckDBPyConnection,
        rows: int,
        *,
        random_probability: float,
        cut_at_off_policy: bool,
    ) -> None:
        self.rows = rows
        self._bit = ON_POLICY if cut_at_off_policy else CONTINUES
        self.ids: Ints = _on_disk(folder / "ids", np.int64, rows)
        self.reward: F32 = _on_disk(folder / "reward", np.float32, rows)
        self.flags: NDArray[np.uint8] = _on_disk(folder / "flags", np.uint8, rows)
        self._folder = folder
        self._read(connection, random_probability)

    def _read(self, connection: duckdb.DuckDBPyConnection, random_probability: float) -> None:
        at, before = 0, None
        reader = connection.sql(
            _STEPS, params={"random_probability": random_probability}
        ).to_arrow_reader(BATCH_ROWS)
        for batch in reader:
            count = len(batch)
            if at + count > self.rows:
                raise _changed(self._folder)
            self.ids[at : at + count] = batch.column("transition_id").to_numpy()
            self.reward[at : at + count] = batch.column("reward").to_numpy(zero_copy_only=False)
            # With the last row of the batch before: what that one is to this batch's first.
            both = pa.Table.from_batches([batch] if before is None else [before, batch])
            start = at if before is None else at - 1
            self.flags[start : at + count - 1] = _flags(both)
            before = batch.slice(count - 1)
            at += count
        if at != self.rows:
            raise _changed(self._folder)
        if before is not None and before.column("terminated")[0].as_py():
            self.flags[-1] = TERMINATED

    def _continues(self, begin: int, end: int) -> Bools:
        return (self.flags[begin:end] & self._bit) > 0

    def horizon(self, begin: int, end: int, n_step: int) -> Ints:
        """Steps of the returns of the rows [begin, end)."""
        return n_step_horizon(self._continues(begin, end + n_step - 1), n_step)[: end - begin]

    def returns(self, begin: int, end: int, horizon: Ints, discount: float) -> F64:
        """n-step returns of the rows [begin, end), of those horizons."""
        ahead = int(horizon.max(initial=1)) - 1
        reward = self.reward[begin : end + ahead]
        padded = np.concatenate([horizon, np.ones(len(reward) - len(horizon), np.int64)])
        return n_step_return(reward, padded, discount)[: end - begin]

    def returns_to_go(self, discount: float) -> tuple[F32, Bools]:
        """Discounted rewards to where a row's return must end, (N,), on disk; and whether that is
        where its episode terminated, so that nothing is missing of it, (N,)."""
        total: F32 = _on_disk(self._folder / "return_to_go", np.float32, self.rows)
        whole: Bools = _on_disk(self._folder / "whole", np.bool_, self.rows)
        after, ends_whole = 0.0, False
        for begin in reversed(range(0, self.rows, STRETCH)):
            end = min(begin + STRETCH, self.rows)
            continues = self._continues(begin, end)
            sums = return_to_go(self.reward[begin:end], continues, discount, after)
            total[begin:end] = sums
            # Of each row, the last of the stretch that it reaches.
            stops = np.append(np.flatnonzero(~continues[:-1]), len(continues) - 1)
            last = stops[np.searchsorted(stops, np.arange(len(continues)))]
            terminated = (self.flags[begin:end] & TERMINATED) > 0
            reached = terminated.copy()
            if continues[-1]:
                reached[-1] = ends_whole
            whole[begin:end] = reached[last]
            after, ends_whole = float(sums[0]), bool(whole[begin])
        return total, whole

    def places(self) -> Places:
        """Where a transition is, by its id."""
        return Places(self.ids, self._folder)


class Places:
    """Finds ids (N,) in their order: they rise within each recording, so runs are searched.

    Where the runs of two recordings overlap (ids that `restock ingest` did not give), the ids are
    sorted in memory.
    """

    def __init__(self, ids: Ints, where: Path) -> None:
        self._ids, self._where = ids, where
        self._order: Ints | None = None
        starts = [0]
        for begin, end in _stretches(len(ids) - 1):
            falls = np.flatnonzero(ids[begin + 1 : end + 1] <= ids[begin:end]) + begin + 1
            starts += falls.tolist()
        begins = np.array(starts, np.int64)
        ends = np.append(begins[1:], len(ids))
        order = np.argsort(ids[begins])
        self._begins, self._ends = begins[order], ends[order]
        self._first = ids[self._begins]
        if (ids[self._ends - 1][:-1] >= self._first[1:]).any():
            self._order = np.argsort(ids, kind="stable")
            self._ids = ids[self._order]
            self._begins, self._ends = np.array([0]), np.array([len(ids)])
            self._first = self._ids[:1]

    def of(self, ids: Ints) -> Ints:
        """The place of each of these ids. Raises PanelError for one that was not there."""
        place = np.empty(len(ids), np.int64)
        run = np.maximum(np.searchsorted(self._first, ids, "right") - 1, 0)
        for number in np.unique(run).tolist():
            in_run = run == number
            begin, end = int(self._begins[number]), int(self._ends[number])
            place[in_run] = begin + np.searchsorted(self._ids[begin:end], ids[in_run])
        place = np.minimum(place, len(self._ids) - 1)
        if not np.array_equal(self._ids[place], ids):
            raise _changed(self._where)
        return place if self._order is None else self._order[place]


def _flags(rows: pa.Table) -> NDArray[np.uint8]:
    return step_flags(
        episode=_codes(rows, "episode_id"),
        step_index=rows["step_index"].to_numpy(),
        policy=_codes(rows, "policy"),
        terminated=rows["terminated"].to_numpy(),
        truncated=rows["truncated"].to_numpy(),
        explored=rows["explored"].to_numpy(),
    )


def _codes(rows: pa.Table, name: str) -> Ints:
    column = rows[name].combine_chunks().dictionary_encode()
    return np.asarray(column.indices.fill_null(-1).to_numpy(zero_copy_only=False), np.int64)


def _stretches(rows: int) -> Iterator[tuple[int, int]]:
    for begin in range(0, rows, STRETCH):
        yield begin, min(begin + STRETCH, rows)


def _on_disk(path: Path, dtype: Any, rows: int) -> NDArray[Any]:
    return np.memmap(path, dtype, "w+", shape=(rows,))


def _changed(where: Path) -> PanelError:
    return PanelError("the source changed while it was read", where=str(where.parent))
