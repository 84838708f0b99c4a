"""What may be done in the twin: an index into the task's table, or any command within its reach.

There is one task. In the continuous space the base gets the very command of the action, while
the observation's previous action and the reward's change of action are those of the nearest action
of the table: what `restock ingest` does to the continuous commands of a log. The same holds where a
limiter in front changes a command.
"""

from __future__ import annotations

from typing import Any, Literal

import gymnasium
import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Ints
from restock.errors import ConfigError
from restock.ingest.task.limiter import Limits, limit
from restock.ingest.task.signals import Signals
from restock.ingest.task.task import Task, nearest_action

ActionKind = Literal["discrete", "continuous"]
# Task actions (N,), commands (N, 2) in m/s and rad/s, and what to add to `info`.
Chosen = tuple[Ints, F64, dict[str, NDArray[Any]]]


class DiscreteActions:
    """`actions` (N,) index the task's actions."""

    def __init__(self, task: Task, num_envs: int) -> None:
        self._num_envs = num_envs
        self._table = np.asarray(task.actions, np.float64)
        self.space = gymnasium.spaces.Discrete(len(task.actions))

    def read(self, actions: NDArray[Any]) -> Chosen:
        """What these actions (N,) are. Raises ConfigError for one that is not in the table."""
        given = _shaped(actions, (self._num_envs,))
        with np.errstate(invalid="ignore"):
            action = given.astype(np.int64)
        wrong = (action != given) | (action < 0) | (action >= len(self._table))
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            raise ConfigError(
                f"an action must be an index from 0 to {len(self._table) - 1}, got {given[row]}",
                where=f"environment {row} of the twin",
                remedy='for speeds and yaw rates make the environment with action="continuous"',
            )
        return action, self._table[action], {}


class ContinuousActions:
    """`actions` (N, 2): forward speed in m/s and yaw rate in rad/s, clipped to the space.

    The space is what the table's actions span. `info["action"]` (N,) is the nearest of them, and
    `info["action_residual"]` (N,) how far away it was, as the store's column of that name.
    """

    def __init__(self, task: Task, num_envs: int) -> None:
        self._task, self._num_envs = task, num_envs
        table = np.asarray(task.actions, np.float32)
        self.space = gymnasium.spaces.Box(table.min(axis=0), table.max(axis=0), dtype=np.float32)

    def read(self, actions: NDArray[Any]) -> Chosen:
        """As for discrete ones. Raises ConfigError for an action that is not finite."""
        requested = _shaped(actions, (self._num_envs, 2)).astype(np.float64)
        if not np.isfinite(requested).all():
            row = int(np.flatnonzero(~np.isfinite(requested).all(axis=1))[0])
            raise ConfigError(
                f"an action must be two finite numbers, got {requested[row].tolist()}",
                where=f"environment {row} of the twin",
                remedy="the policy that chose it has diverged, or its output is not scaled",
            )
        command = np.clip(requested, self.space.low, self.space.high)
        action, residual = nearest_action(self._task, command[:, 0], command[:, 1])
        return action, command, {"action": action, "action_residual": residual}


def _shaped(actions: Any, shape: tuple[int, ...]) -> NDArray[Any]:
    """Numbers in this shape. Raises ConfigError for another number of them, or none at all."""
    given = np.asarray(actions)
    if given.size != np.prod(shape) or given.dtype.kind not in "biuf":
        raise ConfigError(
            f"actions must be numbers of shape {shape}, got {actions!r}",
            where="the twin",
            remedy="give one action for each environment, of env.action_space",
        )
    return given.reshape(shape)


def action_space(
    kind: ActionKind, task: Task, num_envs: int
) -> DiscreteActions | ContinuousActions:
    """The action space by name. Raises ConfigError for another name."""
    if kind == "discrete":
        return DiscreteActions(task, num_envs)
    if kind == "continuous":
        return ContinuousActions(task, num_envs)
    raise ConfigError(
        f"unknown action space {kind!r}", where="the twin", remedy="discrete, or continuous"
    )


def behind_limiter(limits: Limits, task: Task, now: Signals, chosen: Chosen) -> Chosen:
    """What becomes of the chosen actions behind a limiter; `info["limiter"]` has the rule of each.

    The action of a command that was held back is the nearest, as a log of it would have it.
    """
    action, command, reported = chosen
    before = np.stack([now["command_speed_mps"], now["command_yaw_rate_radps"]], axis=-1)
    limited = limit(limits, command, now["sector_clearance_m"], before)
    held, command = limited.intervened, limited.command
    nearest, residual = nearest_action(task, *command.T)
    action = np.where(held, nearest, action)
    residual = np.where(held, residual, reported.get("action_residual", 0.0))
    return action, command, {"action": action, "action_residual": residual, "limiter": limited.rule}
