"""A task's own SQL: reward terms and observation entries that a profile adds.

Each is a numeric expression over the steps that must pass the check of a `pre` condition. It is
evaluated like a condition, by the same code on logs, in the twin and on a running robot.

- A reward term is evaluated at the step that ends a transition: `bumped` is the bumper at t + 1,
  `lag(x) OVER episode` the signal at t. Its window is the episode up to that step.
- An observation entry is evaluated at the observed step. A running robot cannot know where ingest
  will cut its drive into episodes, so the window is the unbroken run of steps up to this one, and
  the entry may only look back a limited number of steps.
"""

from __future__ import annotations

import re
from typing import Any, Literal

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.arrays import F32, F64, Bools, Ints
from restock.errors import ConfigError
from restock.ingest.task.condition_sql import names_in, steps_back
from restock.ingest.task.conditions import NO_LIDAR, Condition, numbers, signals_named
from restock.ingest.task.schema import SIGNAL_COLUMNS, signal_arrays, steps_schema
from restock.ingest.task.task import OWN_LIMIT, Signals, Task
from restock.state import Stateful

Table = Literal["reward_terms", "observed"]  # table of [task] that holds the SQL
MAX_VALUE = 1e9  # larger values are refused: neither a reward nor a sensor reading
_COMMANDS = {"command_speed_mps", "command_yaw_rate_radps"}
_UNFILLED = re.compile(r'column (?:named )?"(\w+)"')  # in DuckDB's error about a missing column


def own_sql(task: Task, table: Table) -> list[Condition]:
    """Return the SQL of one table as conditions, with the task's constants."""
    given = getattr(task, table) or {}
    sql = {name: one if isinstance(one, str) else one[1] for name, one in given.items()}
    limits = task.condition_limits
    return [Condition(name, "pre", text).with_constants(limits) for name, text in sql.items()]


def own_values(task: Task, table: Table, steps: pa.Table) -> dict[str, F64]:
    """Evaluate the SQL of one table at each step, (N,); null becomes 0.

    `steps` are as in `restock.ingest.task.conditions.label`.

    Raises:
        ConfigError: an expression does not run, may look ahead, is not a number or names the
            command (which is chosen after the step), a signal that needs a lidar that the robot
            lacks or, in `observed`, the number of step or episode; or `observed` looks back
            without limit. Names the expression.
    """

    def refused(name: str, what: str, remedy: str | None) -> ConfigError:
        return ConfigError(what, where=f"`task.{table}.{name}`", remedy=remedy)

    own = own_sql(task, table)
    for name, signals in ({} if task.lidar else signals_named(own)).items():
        raise refused(name, f"its SQL names {signals[0]}, and there is {NO_LIDAR}", "leave it out")
    try:
        values = numbers(steps, own)
    except ConfigError as error:
        raise refused((error.where or "").split("'")[1], error.what, error.remedy) from error
    for term in own:
        if early := sorted(_COMMANDS & names_in(term.sql)):
            what = f"its SQL names {early[0]}, which is chosen only after the step"
            raise refused(term.name, what, "use the measured motion, such as wheel_speed_mps")
        if table == "observed" and steps_back(term.sql) is None:
            what = "its SQL looks back without limit, and a running robot cannot"
            remedy = "begin its frame at a number of steps: ROWS BETWEEN {2 s} PRECEDING AND …"
            raise refused(term.name, what, remedy)
        if table == "observed" and re.search(r"\b(step|episode)_index\b", term.sql):
            what = "its SQL names the step or episode, which a running robot does not number"
            raise refused(term.name, what, "use the signals alone")
        if len(wrong := values[term.name][np.abs(values[term.name]) > MAX_VALUE]):
            raise refused(term.name, f"it is {wrong[0]:.4g} at a step", "bound it with least()")
    return {name: np.nan_to_num(value) for name, value in values.items()}


def own_reward(task: Task, steps: pa.Table) -> F32:
    """Return the sum (N,) of the task's own reward terms for transitions that end at these steps.

    Raises:
        ConfigError: as `own_values`.
    """
    total, terms = np.zeros(len(steps)), task.reward_terms or {}
    for name, value in own_values(task, "reward_terms", steps).items():
        total += terms[name][0] * value
    return total.astype(np.float32)


def own_observation(task: Task, steps: pa.Table) -> F32:
    """Return the task's own observation entries (N, E), clipped to +-OWN_LIMIT.

    Raises:
        ConfigError: as `own_values`.
    """
    values = own_values(task, "observed", steps)
    entries = np.stack(list(values.values()), axis=-1)
    return np.clip(entries, -OWN_LIMIT, OWN_LIMIT).astype(np.float32)


def observed_in_log(
    task: Task, signals: Signals, follows: Bools, at: Ints | None = None, now: Signals | None = None
) -> F32:
    """Return the task's own observation entries (T, E) at each tick of a recording.

    `follows` (T,) is whether a tick directly follows the one before. With `at` (n,), return the
    entries (n, E) at these ticks only, and use `now` (n,) in place of `signals` at them.
    """
    run = np.cumsum(~follows, dtype=np.int64)
    if at is None:
        tick, of, last = np.arange(len(run)), run, np.arange(len(run))
    else:
        near = at[:, None] + np.arange(-_max_steps_back(task, "observed"), 1)  # (n, steps kept)
        of, place = np.nonzero((near >= 0) & (run[near] == run[at][:, None]))
        tick, last = near[of, place], np.flatnonzero(place == near.shape[1] - 1)
    columns = {name: signals[name][tick] for name in _named_signals(task, "observed")}
    if now is not None:
        for name, column in columns.items():
            column[last] = now[name]
    return own_observation(task, _steps_table(columns, of, tick))[last]


def _max_steps_back(task: Task, table: Table) -> int:
    """Return how many steps the SQL of a table looks back, at most `time_limit_steps`."""
    back = [steps_back(one.sql) for one in own_sql(task, table)]
    most = task.time_limit_steps
    return min(max(most if steps is None else steps for steps in back), most)


def _named_signals(task: Task, table: Table) -> dict[str, pa.DataType]:
    """Return the signals that the SQL of a table names, with their types in the store."""
    named = {name for one in own_sql(task, table) for name in names_in(one.sql)}
    return {column.name: column.type for column in SIGNAL_COLUMNS if column.name in named}


def _steps_table(columns: Signals, episode: Ints, step: Ints) -> pa.Table:
    types = {column.name: column.type for column in SIGNAL_COLUMNS}
    arrays = {n: a.cast(types[n], safe=False) for n, a in signal_arrays(columns).items()}
    return pa.table({"episode_index": episode, "step_index": step} | arrays)


class Past(Stateful):
    """The last steps of N robots, as many as the SQL of a table looks back.

    Raises:
        ConfigError: the SQL names a column that `who` does not fill, such as a profile's
            `[signals.*]`.
    """

    STATE = ("steps", "columns")

    def __init__(self, task: Task, table: Table, robots: int, who: str = "the twin") -> None:
        self._task, self._table = task, table
        try:
            own_values(task, table, steps_schema().empty_table())
        except ConfigError as error:
            if (unfilled := _UNFILLED.search(error.what)) is None:
                raise
            raise ConfigError(
                f"uses {unfilled[1]}, which {who} does not fill",
                where=error.where,
                remedy=f"{error.remedy}; or leave it out of the profile, and ingest again",
            ) from error
        self._kept = _max_steps_back(task, table) + 1
        self.columns: dict[str, NDArray[Any]] = {  # (N, steps kept), the newest last
            name: np.zeros((robots, self._kept), kind.to_pandas_dtype())
            for name, kind in _named_signals(task, table).items()
        }
        self.steps = np.zeros(robots, np.int64)  # number of each robot's step in its episode

    def begin(self, ids: Ints, signals: Signals) -> None:
        """Begin episodes of robots `ids` (n,) with their first signals (n,)."""
        self.steps[ids] = 0
        for name, column in self.columns.items():
            column[ids, -1] = signals[name]

    def step(self, signals: Signals) -> None:
        """Add the signals (N,) of the next step."""
        self.steps += 1
        for name, column in self.columns.items():
            column[:, :-1] = column[:, 1:]
            column[:, -1] = signals[name]

    def now(self, ids: Ints) -> F32:
        """Evaluate the SQL at the last step of robots `ids` (n,): reward (n,) or entries (n, E)."""
        step = self.steps[ids, None] + np.arange(1 - self._kept, 1)  # (n, steps kept)
        robot, place = np.nonzero(step >= 0)
        known = {name: column[ids[robot], place] for name, column in self.columns.items()}
        steps = _steps_table(known, robot, step[robot, place])
        compute = own_reward if self._table == "reward_terms" else own_observation
        found: F32 = compute(self._task, steps)[place == self._kept - 1]
        return found
