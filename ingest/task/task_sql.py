"""SQL of a task's own: terms of its reward, evaluated as conditions are, on logs and in the twin.

A term is an expression over the steps that passes the check of a `pre` condition, and gives a
number. It is evaluated at the step that ends a transition: `bumped` is the bumper at t + 1,
`lag(x) OVER episode` the signal at t. So no more is needed than the episode up to there.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.arrays import F32, Ints
from restock.errors import ConfigError
from restock.ingest.task.condition_sql import names_in, steps_back
from restock.ingest.task.conditions import NO_LIDAR, Condition, numbers, unseen
from restock.ingest.task.schema import SIGNAL_COLUMNS, signal_arrays, steps_schema
from restock.ingest.task.task import Signals, Task
from restock.state import Stateful

_COMMANDS = {"command_speed_mps", "command_yaw_rate_radps"}
_UNFILLED = re.compile(r'column (?:named )?"(\w+)"')  # in DuckDB's words, of one that is not there


def reward_terms(task: Task) -> list[Condition]:
    """Return the terms of the task's own, with the constants of the robot's task."""
    terms, limits = task.reward_terms or {}, task.condition_limits
    return [Condition(name, "pre", sql).with_constants(limits) for name, (_, sql) in terms.items()]


def own_reward(task: Task, steps: pa.Table) -> F32:
    """Return what the task's own terms pay (N,) for the transitions that end at steps (N,).

    A term that is null pays nothing. `steps` are as `restock.ingest.task.conditions.label` takes
    them.

    Raises:
        ConfigError: a term's SQL does not run, may look ahead, names the command, which is chosen
            after the step, or gives other than finite numbers; names the term.
    """
    terms, total = reward_terms(task), np.zeros(len(steps))
    for name, signals in ({} if task.lidar else unseen(terms)).items():
        what = f"its SQL names {signals[0]}, and there is {NO_LIDAR}"
        raise ConfigError(what, where=_where(name), remedy="leave it out")
    try:
        values = numbers(steps, terms)
    except ConfigError as error:
        name = (error.where or "").split("'")[1]
        raise ConfigError(error.what, where=_where(name), remedy=error.remedy) from error
    for term in terms:
        if early := sorted(_COMMANDS & names_in(term.sql)):
            raise ConfigError(
                f"its SQL names {early[0]}, which is chosen only after the step that it judges",
                where=_where(term.name),
                remedy="use the measured motion, such as wheel_speed_mps",
            )
        value = np.where(np.isnan(values[term.name]), 0.0, values[term.name])
        paid = (task.reward_terms or {})[term.name][0] * value
        if len(wrong := paid[np.abs(paid) > np.finfo(np.float32).max]):
            what = f"it pays {wrong[0]:.4g} for a step"
            raise ConfigError(what, where=_where(term.name), remedy="bound it with least()")
        total += paid
    return total.astype(np.float32)


def _where(term: str) -> str:
    return f"`task.reward_terms.{term}`"


class Past(Stateful):
    """The last steps of N robots in the twin, as many as the task's own SQL looks back on.

    Raises:
        ConfigError: a term names what the twin does not fill, such as a profile's `[signals.*]`.
    """

    STATE = ("steps", "columns")

    def __init__(self, task: Task, robots: int) -> None:
        self._task, terms = task, reward_terms(task)
        try:
            own_reward(task, steps_schema().empty_table())
        except ConfigError as error:
            if (unfilled := _UNFILLED.search(error.what)) is None:
                raise
            raise ConfigError(
                f"{error.where} uses {unfilled[1]}, which the twin does not fill",
                where="the twin",
                remedy="write the term with Restock's own signals, or leave it out of the profile"
                " and ingest again",
            ) from error
        back = [steps_back(term.sql) for term in terms]
        longest = max(task.time_limit_steps if steps is None else steps for steps in back)
        named = {name for term in terms for name in names_in(term.sql)}
        self._kept = min(longest, task.time_limit_steps) + 1
        self.columns: dict[str, NDArray[Any]] = {  # (N, steps kept), the newest last
            column.name: np.zeros((robots, self._kept), column.type.to_pandas_dtype())
            for column in SIGNAL_COLUMNS
            if column.name in named
        }
        self.steps = np.zeros(robots, np.int64)  # that each episode has had

    def begin(self, ids: Ints, signals: Signals) -> None:
        """Take the first signals (n,) of the episodes of robots `ids` (n,)."""
        self.steps[ids] = 0
        for name, column in self.columns.items():
            column[ids, -1] = signals[name]

    def reward(self, signals: Signals) -> F32:
        """Take the signals (N,) of the next step; return what the terms pay for it, (N,)."""
        self.steps += 1
        for name, column in self.columns.items():
            column[:, :-1] = column[:, 1:]
            column[:, -1] = signals[name]
        step = self.steps[:, None] + np.arange(1 - self._kept, 1)  # (N, steps kept)
        robot, place = np.nonzero(step >= 0)
        known = {name: column[robot, place] for name, column in self.columns.items()}
        keys = {"episode_index": robot, "step_index": step[robot, place]}
        steps = pa.table(keys | signal_arrays(known))
        paid: F32 = own_reward(self._task, steps)[place == self._kept - 1]
        return paid
