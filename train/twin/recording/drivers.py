"""Who can drive the recorded fleet: scripted drivers, and any policy that acts on observations.

A policy is named as `restock eval` names it: `run:DIRECTORY` (what the run kept as its best),
`onnx:FILE`. Whoever drives is tagged with a name, a version and the probability of every action,
so that what it recorded is its own behaviour policy in the store.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from restock.errors import ConfigError
from restock.ingest.task.task import Task
from restock.train.twin.env.interface import epsilon_greedy
from restock.train.twin.env.vector_env import WarehouseVectorEnv

HANDOVER = "handover"
SCRIPTED = ("planner", "operator", "random")
LEARNED = "dqn"  # the behaviour policy's name of what `restock train` made


class Chooser(Protocol):
    """What drives by observations: a run's policy, an ONNX file, one of your own."""

    name: str
    version: str

    def act(
        self, env: Any, observation: NDArray[np.float32]
    ) -> tuple[NDArray[np.int64], NDArray[Any]]:
        """Actions (N,) for observations (N, D), and the probabilities (N,) they had."""
        ...


class Guest:
    """A policy at the wheel of the fleet; with probability `epsilon` its action is any action."""

    def __init__(
        self,
        policy: Chooser,
        *,
        epsilon: float = 0.0,
        seed: int = 0,
        name: str | None = None,
        version: str | None = None,
    ) -> None:
        self.policy, self.epsilon = policy, epsilon
        self.name = policy.name if name is None else name
        self.version = policy.version if version is None else version
        self._rng = np.random.default_rng([seed, 0x6775])
        self.acting = np.array([], np.str_)
        self.acting_version = np.array([], np.str_)

    def act(
        self, env: WarehouseVectorEnv, observation: NDArray[np.float32]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Actions (N,) and the probabilities (N,) they had.

        Raises:
            ConfigError: epsilon is asked of a policy that leaves something to chance itself.
        """
        action, probability = self.policy.act(env, observation)
        chance = np.asarray(probability, np.float64)
        if self.epsilon:
            if (chance < 1).any():
                raise ConfigError(
                    f"{self.name} takes chances of its own: what it would have given to an action"
                    " that epsilon takes is not known",
                    where="--epsilon",
                    remedy="leave it out",
                )
            actions = len(env.task.actions)
            action, explored = epsilon_greedy(action, actions, self.epsilon, self._rng)
            chance = explored.astype(np.float64)
        self.acting = np.full(len(action), self.name)
        self.acting_version = np.full(len(action), self.version)
        return np.asarray(action, np.int64), chance


def load_guest(name: str, task: Task, *, epsilon: float = 0.0, seed: int = 0) -> Guest | None:
    """The policy that `run:DIRECTORY` or `onnx:FILE` names; None for the names of scripts.

    Raises:
        ConfigError: no such policy, or one of another task.
        RunError: a run without a policy, or a damaged one.
    """
    if name in (HANDOVER, *SCRIPTED):
        return None
    from restock.train.evaluation.eval_run import load_policy

    policy = load_policy(name, task)
    if policy is None:
        raise ConfigError(
            f"there is no policy {name!r}",
            where="--policy",
            remedy=f"give {', '.join((HANDOVER, *SCRIPTED))}, run:DIRECTORY or onnx:FILE",
        )
    if policy.version:  # made by Restock: the same policy has the same tag from a run or a file
        return Guest(policy, epsilon=epsilon, seed=seed, name=LEARNED)
    digest = hashlib.sha256(Path(name.removeprefix("onnx:")).read_bytes()).hexdigest()[:12]
    return Guest(policy, epsilon=epsilon, seed=seed, name="onnx", version=digest)


def check_epsilon(epsilon: float | None, policy: str) -> None:
    """Raises ConfigError where `policy` cannot take that share of random actions."""
    if epsilon is None:
        return
    if not 0 <= epsilon <= 1:
        raise ConfigError(f"must be in [0, 1], got {epsilon}", where="--epsilon")
    if policy == "random":
        raise ConfigError(
            "random takes every action with the same probability already",
            where="--epsilon",
            remedy="leave it out",
        )
