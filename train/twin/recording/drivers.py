"""Who drives the recorded fleet: each robot by its own mission's driver, at its own turn.

A driver is a script of `restock.train.twin.drivers`, or any policy that acts on observations.
Each is tagged with a name, a version and the probability of every action, so that what it drove is
its own behaviour policy in the store.
"""

from __future__ import annotations

import numpy as np

from restock.arrays import F32, F64, Ints
from restock.errors import ConfigError
from restock.train.twin.drivers.operator_policy import Operator
from restock.train.twin.drivers.policies import (
    BehaviourPolicy,
    Handover,
    PlannerFollower,
    RandomPolicy,
)
from restock.train.twin.env.interface import Policy, epsilon_greedy
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.recording.missions import Mission

_Key = tuple[str, str, bool]  # a mission's driver, its version, whether the operator takes over


class CarefulPlanner(PlannerFollower):
    """The planner's next release, on a few robots at first: slows and stops farther away."""

    version = "2"
    stop_m = 0.40
    slow_m = 1.20


class ExternalPolicy:
    """A policy from outside at the wheel; with probability `epsilon` its action is any action."""

    def __init__(self, policy: Policy, *, epsilon: float = 0.0, seed: int = 0) -> None:
        self.policy, self.epsilon = policy, epsilon
        self.name, self.version = policy.name, policy.version
        self._rng = np.random.default_rng([seed, 0x6775])
        self.acting = np.array([], np.str_)
        self.acting_version = np.array([], np.str_)

    def act(self, env: WarehouseVectorEnv, observation: F32) -> tuple[Ints, F64]:
        """Actions (N,) and the probabilities (N,) they had.

        Raises:
            ConfigError: epsilon is set for a policy that is itself stochastic.
        """
        action, given = self.policy.act(env, observation)
        probability = np.asarray(given, np.float64)
        if self.epsilon:
            if (probability < 1).any():
                raise ConfigError(
                    f"{self.name} is stochastic itself: the probability of an action that epsilon "
                    "chooses is not known",
                    where="--epsilon",
                    remedy="leave it out",
                )
            actions = len(env.task.actions)
            action, explored = epsilon_greedy(action, actions, self.epsilon, self._rng)
            probability = explored.astype(np.float64)
        self.acting = np.full(len(action), self.name)
        self.acting_version = np.full(len(action), self.version)
        return np.asarray(action, np.int64), probability


class BehaviourPolicies:
    """The drivers of N robots that run side by side. A driver that no robot has now does not act.

    Args:
        epsilon: share of random actions of the scripted drivers; None: each one's default.
        external: drives all missions in place of the scripts.
    """

    def __init__(
        self,
        robots: int,
        *,
        seed: int,
        epsilon: float | None = None,
        external: ExternalPolicy | None = None,
    ) -> None:
        self._seed, self._external = seed, external
        self._epsilon = {} if epsilon is None else {"epsilon": epsilon}
        self._drivers: dict[_Key, BehaviourPolicy] = {}
        self._keys: list[_Key] = [("planner", "1", False)] * robots

    def begin(self, robot: int, mission: Mission) -> None:
        """Robot `robot` starts a mission."""
        self._keys[robot] = (mission.driver, mission.version, mission.handover)

    def act(self, env: WarehouseVectorEnv) -> tuple[Ints, list[tuple[str, str]], F64]:
        """Actions (N,), who chose each as (policy, version), and its probability (N,)."""
        action = np.zeros(env.num_envs, np.int64)
        probability = np.ones(env.num_envs)
        tags = [("", "")] * env.num_envs
        for key in sorted(set(self._keys)):
            if key not in self._drivers:
                self._drivers[key] = self._make(*key)
            driver = self._drivers[key]
            actions, probabilities = driver.act(env, env.observation)
            for robot in (robot for robot, other in enumerate(self._keys) if other == key):
                action[robot], probability[robot] = actions[robot], probabilities[robot]
                tags[robot] = (str(driver.acting[robot]), str(driver.acting_version[robot]))
        return action, tags, probability

    def _make(self, name: str, version: str, handover: bool) -> BehaviourPolicy:
        if self._external is not None:
            return self._external
        seed = self._seed * 16 + len(self._drivers)  # every driver draws from its own
        if name == "random":
            return RandomPolicy(seed=seed)
        if name == "operator":
            return Operator(seed=seed, **self._epsilon)
        kind = CarefulPlanner if version == "2" else PlannerFollower
        planner = kind(seed=seed, **self._epsilon)
        return Handover(planner, Operator(seed=seed, **self._epsilon)) if handover else planner
