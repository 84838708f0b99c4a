"""Training without a twin: on the logs alone, where no twin is worth trusting for the robot.

Nothing drives, so there is no success to choose a checkpoint by: what was learnt last is kept, and
`restock eval RUN --on-logs own` says what it is worth on episodes that it did not learn from.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from restock.arrays import F32
from restock.errors import ConfigError
from restock.ingest.task.signals import Signals
from restock.ingest.task.task import Task
from restock.replay.panel.panel import Panel
from restock.train.dqn.config import TrainConfig
from restock.train.twin.env.interface import Info, Step


class NoTwin:
    """Stands where a run has its twin, and cannot be driven in."""

    num_envs = 1

    def __init__(self, task: Task) -> None:
        self._observation: F32 = np.zeros((1, task.observation_size), np.float32)

    @property
    def signals(self) -> Signals:
        return {}

    def set_episodes(self, specs: Iterable[Any], /) -> None:
        raise RuntimeError("a run on the logs alone does not drive")

    def reset(self, *, seed: int | None = None) -> tuple[F32, Info]:
        return self._observation, {}

    def step(self, actions: NDArray[Any], /) -> Step:
        raise RuntimeError("a run on the logs alone does not drive")

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any], /) -> None:
        pass


def without_twin(config: TrainConfig, panel: Panel | None) -> TrainConfig:
    """The config of a run whose `env.twin` is false: no environment step, nobody in the twin asked.

    Raises:
        ConfigError: it has no panel, or something of it needs a twin.
    """
    where = "env.twin"
    if panel is None:
        raise ConfigError(
            "false means learning from the logs alone, but there is no panel",
            where=where,
            remedy="give --panel",
        )
    if config.teacher.source not in (None, "logs", "none"):
        raise ConfigError(
            f"false, but the teacher {config.teacher.source!r} needs the twin",
            where=where,
            remedy='use teacher.source = "logs" or "none"',
        )
    teacher = config.teacher
    if teacher.source is None:
        teacher = msgspec.structs.replace(teacher, source="none")
    schedule = msgspec.structs.replace(config.schedule, env_steps=0)
    env = msgspec.structs.replace(config.env, overlap=False)
    practice = msgspec.structs.replace(config.practice, rule="natural")
    return msgspec.structs.replace(
        config, teacher=teacher, schedule=schedule, env=env, practice=practice
    )


__all__ = ["NoTwin", "without_twin"]
