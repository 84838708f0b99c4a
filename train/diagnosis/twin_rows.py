"""Fresh rows of the twin: what logs of this task look like where nothing is wrong with them.

The scripted planner drives, and the operator takes over, as on robots; a share of their actions is
any action, so that every action is taken in every situation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.arrays import Ints
from restock.ingest.task.conditions import Condition, label, primary
from restock.ingest.task.robot import Robot
from restock.ingest.task.signals import STORED_SIGNALS
from restock.ingest.task.task import Task
from restock.train.diagnosis.fed_rows import FedRows
from restock.train.twin.drivers.operator_policy import Operator
from restock.train.twin.drivers.policies import Handover, PlannerFollower
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.missions.registry import KINDS
from restock.train.twin.physics.perturbation import Perturbation

ROBOTS = 24
STEPS = 400  # of each robot
EXPLORATION = 0.1
_STORED = tuple(signal.name for signal in STORED_SIGNALS)


def drive_twin(
    task: Task,
    conditions: Sequence[Condition],
    *,
    robot: Robot | None = None,
    perturbation: Perturbation | None = None,
    seed: int = 0,
    robots: int = ROBOTS,
    steps: int = STEPS,
) -> FedRows:
    """Rows of whole episodes that ended within `steps` steps of each robot.

    `conditions` are those that the twin's signals can say.

    Raises:
        ConfigError: the twin cannot keep the task's control period, or has no such body.
    """
    env = WarehouseVectorEnv(
        robots, conditions=dict.fromkeys(KINDS, 1.0), perturbation=perturbation, seed=seed,
        nthread=0, task=task, robot=robot,
    )  # fmt: skip
    table = np.asarray(task.actions, np.float64)
    driver = Handover(
        PlannerFollower(epsilon=EXPLORATION, seed=seed), Operator(epsilon=EXPLORATION, seed=seed)
    )
    taken: list[dict[str, NDArray[Any]]] = []
    observation, _ = env.reset(seed=seed)
    for _ in range(steps):
        action, _ = driver.act(env, observation)
        now = {name: column.copy() for name, column in env.signals.items()}
        after, reward, terminated, truncated, info = env.step(action)
        ended = terminated | truncated
        now["command_speed_mps"], now["command_yaw_rate_radps"] = table[action].T
        step = {"now " + name: now[name] for name in _STORED}
        step |= {"after " + name: info["signals"][name] for name in _STORED}
        following = after.copy()
        for place in np.flatnonzero(ended):
            following[place] = info["final_obs"][place]
        taken.append(
            step
            | {"observation": observation, "next_observation": following, "action": action}
            | {"reward": reward, "terminated": terminated, "truncated": truncated}
            | {"ended": ended, "invalid": info["invalid"]}
        )
        observation = after
    env.close()
    return _rows(task, conditions, taken)


def _rows(
    task: Task, conditions: Sequence[Condition], taken: Sequence[dict[str, NDArray[Any]]]
) -> FedRows:
    """Of T steps of N robots those whose episode ended, robot by robot."""
    steps = {name: np.stack([step[name] for step in taken], axis=1) for name in taken[0]}
    flat = {name: values.reshape(-1, *values.shape[2:]) for name, values in steps.items()}
    ended = steps["ended"]
    later = np.cumsum(ended[:, ::-1], axis=1)[:, ::-1].reshape(-1)  # ends from here on
    robot = np.repeat(np.arange(len(ended)), ended.shape[1])
    episode = np.unique(robot * (ended.shape[1] + 1) - later, return_inverse=True)[1].reshape(-1)
    broken = np.isin(episode, episode[flat["invalid"]])
    kept = (later > 0) & ~broken
    chosen = {name: values[kept] for name, values in flat.items()}
    episode = np.unique(episode[kept], return_inverse=True)[1].reshape(-1).astype(np.int64)
    first = np.flatnonzero(np.append(True, np.diff(episode) != 0)[: len(episode)])
    step = np.arange(len(episode)) - np.repeat(first, np.diff(np.append(first, len(episode))))
    return FedRows(
        task=task,
        observation=chosen["observation"],
        next_observation=chosen["next_observation"],
        action=chosen["action"].astype(np.int64),
        reward=chosen["reward"].astype(np.float64),
        terminated=chosen["terminated"],
        truncated=chosen["truncated"],
        episode=episode,
        step=step.astype(np.int64),
        recording=np.full(len(episode), "twin"),
        robot=np.full(len(episode), ""),
        logged_ns=np.zeros(len(episode), np.int64),
        condition=_labels(conditions, chosen, episode, step),
        transition_id=np.arange(len(episode), dtype=np.int64),
    )


def _labels(
    conditions: Sequence[Condition], rows: dict[str, NDArray[Any]], episode: Ints, step: Ints
) -> NDArray[np.str_]:
    """The one condition of each row, by the very rules that label logs."""
    ends = np.flatnonzero(rows["ended"])
    order = np.argsort(np.concatenate([np.arange(len(episode)), ends + 0.5]), kind="stable")
    columns: dict[str, Any] = {
        "episode_index": np.concatenate([episode, episode[ends]])[order],
        "step_index": np.concatenate([step, step[ends] + 1])[order],
    }
    for name in _STORED:
        both = np.concatenate([rows["now " + name], rows["after " + name][ends]])
        columns[name] = both[order]
    labels = label(pa.table(columns), list(conditions))
    names = np.array(primary(labels, list(conditions)) or ["nominal"] * len(order))
    return np.asarray(names[order < len(episode)], np.str_)


__all__ = ["drive_twin"]
