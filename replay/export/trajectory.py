"""Join transitions to trajectories, which other libraries' formats contain.

A trajectory is an unbroken sequence of steps of one episode, with the observation after its last
step. If rows are missing (a query left them out), an episode becomes several trajectories. One with
missing rows after it is cut: it counts as truncated, because its return would continue.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from restock.arrays import F32, Bools, Ints
from restock.errors import StoreError

REQUIRED = (
    *("episode_id", "step_index", "observation", "action", "reward", "next_observation"),
    *("terminated", "truncated"),
)
COMMAND = ("command_speed_mps", "command_yaw_rate_radps")
CARRIED = (  # optional columns, exported if the query has them
    *("transition_id", "stamp_ns", "condition", "zone", "behaviour_policy", "behaviour_version"),
    *("action_probability", "action_residual", "robot", "site"),
)
STATE = "observation.state"  # a query's struct of named numbers, exported as the observation


@dataclass(frozen=True)
class Trajectory:
    """T steps and the observation after them."""

    episode_id: str
    first_step: int  # step_index of the first step
    observations: F32  # (T + 1, D)
    actions: NDArray[Any]  # (T,) int64, or (T, 2) float32: m/s and rad/s
    rewards: F32  # (T,)
    terminated: bool  # whether the last step terminated the episode; else it is truncated
    cut: bool  # truncated because the selection lacks the episode's next rows
    carried: dict[str, NDArray[Any]]  # column -> (T,); text has dtype object

    def __len__(self) -> int:
        return len(self.rewards)

    @property
    def truncated(self) -> bool:
        return not self.terminated

    @property
    def robot_and_site(self) -> dict[str, str]:
        """Return the robot and site of all steps, if the rows have these columns."""
        first = {name: self.carried[name][0] for name in ("robot", "site") if name in self.carried}
        return {name: "" if value is None else str(value) for name, value in first.items()}


@dataclass
class Counts:
    """Counts of the rows that were read, and of the trajectories made from them."""

    rows: int = 0
    transitions: int = 0
    trajectories: int = 0
    terminated: int = 0
    truncated: int = 0  # trajectories truncated where the episode was
    cut: int = 0  # trajectories truncated because rows are missing
    episodes: int = 0
    left_out: Counter[str] = field(default_factory=Counter)  # reason -> number of rows

    def describe(self) -> dict[str, Any]:
        """Return the counts as plain values for JSON."""
        names = ("rows", "transitions", "trajectories", "episodes", "terminated", "truncated")
        return {name: getattr(self, name) for name in names} | {
            "cut": self.cut,
            "left_out": dict(self.left_out),
        }


def trajectories(
    batches: Iterable[pa.RecordBatch], *, continuous: bool, counts: Counts, where: str
) -> Iterator[Trajectory]:
    """Yield trajectories from rows sorted by episode and step.

    It keeps one batch and one episode in memory.

    Args:
        batches: rows with the columns of REQUIRED, and of COMMAND for continuous actions.
        continuous: actions are commands, not indices.
        counts: updated while it runs.
        where: the source, for errors.

    Raises:
        StoreError: a step occurs twice, observations have several sizes, or values are missing.
    """
    left: pa.Table | None = None
    for batch in batches:
        counts.rows += len(batch)
        table = pa.Table.from_batches([batch])
        if left is not None and len(left):
            table = pa.concat_tables([left, table])
        rows = _Rows(table, continuous, where)
        starts = rows.starts()
        for begin, end in pairwise(starts.tolist()):
            yield _trajectory(rows, begin, end, counts)
        left = table.slice(int(starts[-1])) if len(starts) else None
    if left is not None and len(left):
        yield _trajectory(_Rows(left, continuous, where), 0, len(left), counts)


class _Rows:
    """The columns of a table of rows as checked arrays."""

    def __init__(self, table: pa.Table, continuous: bool, where: str) -> None:
        self.where = where
        self.episode: NDArray[Any] = _required_column(table, "episode_id", where)
        self.step: Ints = np.asarray(_required_column(table, "step_index", where), np.int64)
        self.observation = observation_matrix(table["observation"], where)
        self.next_observation = observation_matrix(table["next_observation"], where)
        if self.observation.shape != self.next_observation.shape:
            raise StoreError(
                f"observations have {self.observation.shape[1]} entries, next observations"
                f" {self.next_observation.shape[1]}",
                where=where,
                remedy="export the observations as they are stored",
            )
        self.terminated: Bools = np.asarray(_required_column(table, "terminated", where), np.bool_)
        self.truncated: Bools = np.asarray(_required_column(table, "truncated", where), np.bool_)
        self.reward: F32 = np.asarray(_required_column(table, "reward", where), np.float32)
        if count := int(np.isnan(self.reward).sum()):
            raise StoreError(
                f"{count} rows have a reward that is not a number",
                where=where,
                remedy="add WHERE NOT isnan(reward)",
            )
        self.action: NDArray[Any] = (
            np.stack(
                [np.asarray(_required_column(table, name, where), np.float32) for name in COMMAND],
                axis=1,
            )
            if continuous
            else np.asarray(_required_column(table, "action", where), np.int64)
        )
        self.carried = {
            name: _column(table, name) for name in CARRIED if name in table.column_names
        }
        if STATE in table.column_names:
            self.carried[STATE] = observation_matrix(table[STATE], where)

    def starts(self) -> Ints:
        """Return the rows at which trajectories begin, ascending; the first is 0."""
        same = self.episode[1:] == self.episode[:-1]
        if (again := same & (self.step[1:] == self.step[:-1])).any():
            row = int(np.flatnonzero(again)[0])
            raise StoreError(
                f"step {self.step[row]} of episode {self.episode[row]} comes twice",
                where=self.where,
                remedy="select each transition once: a join or held_conditions may double rows",
            )
        goes_on = same & (self.step[1:] == self.step[:-1] + 1)
        goes_on &= ~(self.terminated[:-1] | self.truncated[:-1])
        goes_on &= np.all(
            (self.next_observation[:-1] == self.observation[1:])
            | (np.isnan(self.next_observation[:-1]) & np.isnan(self.observation[1:])),
            axis=1,
        )
        return np.concatenate([[0], np.flatnonzero(~goes_on) + 1]).astype(np.int64)


def _trajectory(rows: _Rows, begin: int, end: int, counts: Counts) -> Trajectory:
    """Return the rows [begin, end) as one trajectory."""
    last, inside = end - 1, slice(begin, end)
    terminated = bool(rows.terminated[last])
    ended = terminated or bool(rows.truncated[last])
    counts.transitions += end - begin
    counts.trajectories += 1
    counts.terminated += terminated
    counts.truncated += ended and not terminated
    counts.cut += not ended
    return Trajectory(
        episode_id=str(rows.episode[begin]),
        first_step=int(rows.step[begin]),
        observations=np.concatenate([rows.observation[inside], rows.next_observation[last:end]]),
        actions=rows.action[inside],
        rewards=rows.reward[inside],
        terminated=terminated,
        cut=not ended,
        carried={name: column[inside] for name, column in rows.carried.items()},
    )


def count_episodes(trajectories: Iterable[Trajectory], counts: Counts) -> Iterator[Trajectory]:
    """Yield the trajectories, which are sorted by episode, and count their episodes."""
    before: str | None = None
    for trajectory in trajectories:
        counts.episodes += trajectory.episode_id != before
        before = trajectory.episode_id
        yield trajectory


def observation_matrix(column: pa.ChunkedArray, where: str) -> F32:
    """Convert a list column to (n, D) float32. Raises StoreError if lengths differ."""
    array = column.combine_chunks()
    if isinstance(array, pa.ChunkedArray):
        array = array.combine_chunks()
    lengths = set(pc.unique(pc.list_value_length(array)).to_pylist())
    if array.null_count or len(lengths) > 1:
        raise StoreError(
            "observations are missing or of several sizes",
            where=where,
            remedy="export rows of one task: add WHERE task_hash = '…'",
        )
    size = lengths.pop() if lengths else 0
    flat = np.asarray(array.flatten().to_numpy(zero_copy_only=False), np.float32)
    return flat.reshape(len(array), size)


def _required_column(table: pa.Table, name: str, where: str) -> NDArray[Any]:
    """Return a column as an array; raise StoreError if it has nulls."""
    if count := table[name].null_count:
        raise StoreError(
            f"{count} rows have no {name}", where=where, remedy=f"add WHERE {name} IS NOT NULL"
        )
    return _column(table, name)


def _column(table: pa.Table, name: str) -> NDArray[Any]:
    """Return a scalar column; integers with nulls become float64, text becomes objects."""
    values: NDArray[Any] = table[name].to_numpy()
    return values


def missing_columns(columns: Sequence[str], *, continuous: bool) -> list[str]:
    """Return the columns that an export needs and these lack."""
    needed = (*REQUIRED, *COMMAND) if continuous else REQUIRED
    return [name for name in needed if name not in columns]


def fixed_lists(values: NDArray[np.float32]) -> pa.FixedSizeListArray:
    """Convert (n, k) float32 to n lists of k."""
    flat = np.ascontiguousarray(values, np.float32).ravel()
    return pa.FixedSizeListArray.from_arrays(pa.array(flat), values.shape[1])
