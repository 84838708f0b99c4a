"""Who drives the recorded fleet: each robot by its own mission's driver, at its own turn."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from restock.train.twin.env.operator_policy import Operator
from restock.train.twin.env.policies import Handover, PlannerFollower, Policy, RandomPolicy
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.recording.drivers import Guest
from restock.train.twin.recording.missions import Mission


class CarefulPlanner(PlannerFollower):
    """The planner's next release, on a few robots at first: slows and stops farther away."""

    version = "2"
    stop_m = 0.40
    slow_m = 1.20


class FleetCrew:
    """The drivers of N robots that run side by side. A driver nobody needs is not asked.

    Args:
        epsilon: share of random actions of the scripted drivers; None: what each has of its own.
        guest: drives the missions whose driver is none of the scripts.
    """

    def __init__(
        self, robots: int, *, seed: int, epsilon: float | None = None, guest: Guest | None = None
    ) -> None:
        self._seed, self._guest = seed, guest
        self._chance = {} if epsilon is None else {"epsilon": epsilon}
        self._drivers: dict[tuple[str, str, bool], Policy] = {}
        self._of: list[tuple[str, str, bool]] = [("planner", "1", False)] * robots

    def begin(self, robot: int, mission: Mission) -> None:
        """Robot `robot` starts a mission."""
        self._of[robot] = (mission.driver, mission.version, mission.handover)

    def act(
        self, env: WarehouseVectorEnv
    ) -> tuple[NDArray[np.int64], list[tuple[str, str]], NDArray[np.float64]]:
        """Actions (N,), who chose each as (policy, version), and its probability (N,)."""
        action = np.zeros(env.num_envs, np.int64)
        probability = np.ones(env.num_envs)
        who = [("", "")] * env.num_envs
        for key in sorted(set(self._of)):
            driver = self._driver(key)
            chosen, chance = driver.act(env, env.observation)
            for robot in (robot for robot, of in enumerate(self._of) if of == key):
                action[robot], probability[robot] = chosen[robot], chance[robot]
                who[robot] = (str(driver.acting[robot]), str(driver.acting_version[robot]))
        return action, who, probability

    def _driver(self, key: tuple[str, str, bool]) -> Policy:
        if key not in self._drivers:
            self._drivers[key] = self._make(*key)
        return self._drivers[key]

    def _make(self, name: str, version: str, handover: bool) -> Policy:
        if self._guest is not None:
            return self._guest
        # Every driver has dice of its own.
        seed = self._seed * 16 + len(self._drivers)
        if name == "random":
            return RandomPolicy(seed=seed)
        if name == "operator":
            return Operator(seed=seed, **self._chance)
        planner = (CarefulPlanner if version == "2" else PlannerFollower)(seed=seed, **self._chance)
        return Handover(planner, Operator(seed=seed, **self._chance)) if handover else planner
