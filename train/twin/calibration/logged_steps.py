"""A store's steps for comparison with the twin: each row, and the step after it.

A store has one row per step, sensed as in training. So comparisons with a twin, and fitted
latencies, start from the observation at a tick, as in training. A row has its signals at t. Those
at t + 1 are in the next row or, at an episode's end, in the step that only ends the episode, which
the store keeps in its files' metadata.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.arrays import F32, F64, Bools, Ints
from restock.errors import ConfigError, StoreError
from restock.ingest.profile.profile import parse_profile
from restock.ingest.task.robot import Robot
from restock.ingest.task.schema import SIGNAL_COLUMNS
from restock.ingest.task.task import Signals, Task
from restock.replay.store.parquet_views import passed_in
from restock.replay.store.store import Store, profiles_of
from restock.train.twin.physics.model import robot_model
from restock.train.twin.physics.robot_model import RobotModel

Strings = NDArray[np.str_]
NOMINAL = "nominal"
COMMAND = ("command_speed_mps", "command_yaw_rate_radps")
SIGNALS = tuple(column.name for column in SIGNAL_COLUMNS)


@dataclass(frozen=True)
class LoggedSteps:
    """N rows of one task, sorted by recording, episode and step."""

    task: Task
    now: Signals  # the stored signals at t, (N,) each
    transition_id: Ints  # (N,)
    recording_id: Strings  # (N,)
    episode_id: Strings  # (N,)
    step_index: Ints  # (N,) in its episode
    begins: Bools  # (N,) the row before is not the step before: new episode, or missing steps
    condition: Strings  # (N,) the labelled condition
    true_condition: Strings  # (N,) logged by a simulator; "" if unknown
    conditions: dict[str, Bools]  # name -> (N,) whether it holds; `nominal` if no other does
    action: Ints  # (N,)
    reward: F64  # (N,)
    progress_m: F64  # (N,)
    ending: Ints  # (E,) indices of rows whose successor only ends the episode
    ends: Signals  # the signals of these successors, (E,) each
    robot: RobotModel | None = None  # the profile's robot; None: the twin's stand-in

    def __len__(self) -> int:
        return len(self.transition_id)

    @cached_property
    def followed(self) -> Bools:
        """Return whether the step at t + 1 is known, (N,)."""
        followed = np.append(~self.begins[1:], False)
        followed[self.ending] = True
        return followed

    @cached_property
    def after(self) -> Signals:
        """Return the signals at t + 1, (N,) each; meaningless if not `followed`."""
        after = {name: np.append(column[1:], column[:1]) for name, column in self.now.items()}
        for name, column in self.ends.items():
            after[name][self.ending] = column
        return after

    @cached_property
    def first(self) -> Ints:
        """Return the index (N,) of the first row of each row's stretch of consecutive steps."""
        first: Ints = np.maximum.accumulate(np.where(self.begins, np.arange(len(self)), 0))
        return first

    def commands(self, rows: Ints, before: int, count: int) -> F64:
        """Return the commands of `before` steps before `rows` (n,) and of `count` steps from there.

        Returns m/s and rad/s, (n, before + count, 2). Before a stretch begins, commands are 0.
        """
        steps = rows[:, None] + np.arange(-before, count)
        commands = np.stack([self.now[name] for name in COMMAND], axis=-1)
        given = commands[np.maximum(steps, 0)]
        return np.where((steps >= self.first[rows][:, None])[..., None], given, 0.0)


def logged_steps(
    store: Store,
    task_hash: str | None = None,
    recordings: Sequence[str] = (),
) -> LoggedSteps:
    """Read the rows of a task from these recordings of a store (all by default).

    Raises:
        ConfigError: there is no such recording, or the twin cannot build the robot.
        StoreError: there are no rows, there are rows of several tasks but no `task_hash`, or
            columns are missing.
    """
    task = store.task(task_hash)
    robot = robot_of_store(store, task_hash or task.hash)
    recordings_of(store, recordings, task_hash)
    sql = (files("restock.train.twin.calibration") / "logged_steps.sql").read_text(encoding="utf-8")
    parameters = {"task_hash": task_hash or task.hash, "recordings": list(recordings)}
    try:
        table = store.connection.sql(
            sql.format(signals=", ".join(SIGNALS)), params=parameters
        ).to_arrow_table()
    except duckdb.BinderException as error:
        raise StoreError(
            f"lacks a column: {str(error).splitlines()[0]}",
            where=str(store.path),
            remedy="ingest the recordings again with this version",
        ) from error
    if not len(table):
        raise StoreError(
            "no transitions" + (f" of {', '.join(recordings)}" if recordings else ""),
            where=str(store.path),
            remedy="ingest recordings into it",
        )
    episode, step = _text(table["episode_id"]), _numbers(table["step_index"]).astype(np.int64)
    consecutive = (episode[1:] == episode[:-1]) & (step[1:] == step[:-1] + 1)
    begins = ~np.append(False, consecutive)
    ending, ends = _ends(store, recordings, episode, step, np.append(begins[1:], True))
    return LoggedSteps(
        task=task,
        now={name: _numbers(table[name]) for name in SIGNALS},
        transition_id=_numbers(table["transition_id"]),
        recording_id=_text(table["recording_id"]),
        episode_id=episode,
        step_index=step,
        begins=begins,
        condition=_text(table["condition"]),
        true_condition=_text(table["true_condition"]),
        conditions=_conditions(table["conditions"].to_pylist()),
        action=_numbers(table["action"]).astype(np.int64),
        reward=_numbers(table["reward"]),
        progress_m=_numbers(table["progress_m"]),
        ending=ending,
        ends=ends,
        robot=None if robot is None else robot_model(robot, task.body),
    )


def recordings_of(store: Store, wanted: Sequence[str], task_hash: str | None) -> list[str]:
    """Return the IDs of a store's recordings with rows of a task, or check and return `wanted`.

    Raises:
        ConfigError: a wanted recording has no rows of the task.
        StoreError: there are no rows, or rows of several tasks but no `task_hash`.
    """
    task_hash = task_hash or store.task().hash
    store.task(task_hash)
    rows = store.connection.execute(
        "SELECT DISTINCT recording_id FROM transitions WHERE task_hash = ? ORDER BY recording_id",
        [task_hash],
    ).fetchall()
    known = [str(row[0]) for row in rows]
    for name in wanted:
        if name not in known:
            raise ConfigError(
                f"no recording {name!r} of task {task_hash}",
                where=str(store.path),
                remedy='restock sql STORE "FROM recordings" lists them',
            )
    return list(wanted) or known


def observations(store: Store, transition_id: Ints, size: int) -> tuple[F32, F32]:
    """Return the observations and next observations of these rows, (n, D) each, in order."""
    wanted = pa.table({"transition_id": transition_id, "place": np.arange(len(transition_id))})
    with passed_in(store.connection, wanted=wanted):
        table = store.connection.sql(
            "SELECT observation, next_observation FROM wanted"
            " JOIN transitions USING (transition_id) ORDER BY place"
        ).to_arrow_table()
    now, after = (_vectors(table[name], size) for name in ("observation", "next_observation"))
    return now, after


def sector_clearance(task: Task, observation: F32) -> F64:
    """Invert observations (n, D) to sector clearances (n, sectors) in metres.

    Clearances beyond the task's range come out as its range, as observations are clipped there.
    """
    if not task.lidar:
        return np.zeros((len(observation), 0))
    first = next(
        place for place, name in enumerate(task.observation_names) if name.startswith("clearance_")
    )
    seen = observation[:, first : first + task.sectors].astype(np.float64)
    return np.asarray(seen**2 * task.range_max_m, np.float64)


def previous_action(task: Task, observation: F32) -> Ints:
    """Return the action before t (n,), from the observation at t."""
    first = task.observation_names.index("previous_action_0")
    one_hot = observation[:, first : first + len(task.actions)]
    chosen: Ints = np.argmax(one_hot, axis=1).astype(np.int64)
    return chosen


def rows_of(columns: Signals, rows: NDArray[Any]) -> Signals:
    """Select these rows of every column."""
    return {name: column[rows] for name, column in columns.items()}


def _conditions(held: Sequence[Sequence[str] | None]) -> dict[str, Bools]:
    lists = [names or () for names in held]
    known = sorted({name for names in lists for name in names})
    holds = {name: np.array([name in names for names in lists], np.bool_) for name in known}
    return {NOMINAL: np.array([not names for names in lists], np.bool_), **holds}


def _ends(
    store: Store, recordings: Sequence[str], episode: Strings, step: Ints, last: Bools
) -> tuple[Ints, Signals]:
    """Return which rows of `last` (N,) precede an episode's end, and the signals at these ends."""
    row_of = {(str(episode[row]), int(step[row])): row for row in np.flatnonzero(last).tolist()}
    rows, parts = [], []
    for recording, ends in store.episode_ends(recordings):
        numbers = zip(
            ends["episode_index"].to_pylist(), ends["step_index"].to_pylist(), strict=True
        )
        found = [row_of.get((f"{recording}/{index}", at - 1), -1) for index, at in numbers]
        known = np.array(found, np.int64) >= 0
        rows += [row for row in found if row >= 0]
        parts.append({name: _numbers(ends[name])[known] for name in SIGNALS})
    columns = {name: np.concatenate([part[name] for part in parts]) for name in SIGNALS if parts}
    return np.array(rows, np.int64), columns


def _numbers(column: pa.ChunkedArray) -> NDArray[Any]:
    """Convert float32 to float64, so that results are computed as in ingest."""
    values: NDArray[Any] = column.combine_chunks().to_numpy(zero_copy_only=False)
    return values.astype(np.float64) if values.dtype == np.float32 else values.copy()


def _text(column: pa.ChunkedArray) -> Strings:
    """Convert to text, with "" for null."""
    return np.asarray(column.fill_null("").to_numpy(zero_copy_only=False)).astype(np.str_)


def _vectors(column: pa.ChunkedArray, size: int) -> F32:
    flat = column.combine_chunks().flatten().to_numpy(zero_copy_only=False)
    return np.ascontiguousarray(flat, np.float32).reshape(-1, size)


def robot_of_store(store: Store, task_hash: str) -> Robot | None:
    """Return the robot of the newest readable profile that a task's rows were ingested with.

    None if this profile has no [robot], or if there is no such profile.
    """
    for stored in profiles_of(store.connection, task_hash):
        if not stored.toml:
            continue
        try:
            profile = parse_profile(stored.toml, where=str(store.path))
        except ConfigError:  # written by another version: ignored
            continue
        return profile.robot
    return None
