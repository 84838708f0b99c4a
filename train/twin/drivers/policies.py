"""Scripted behaviour policies, each with a name and a version that go into the log.

A policy's `act(env, observation)` gives the actions (N,) and the probability (N,) that it gives
to each: a small share of its actions is random, so that the log covers more than its habits.
`acting` (N,) names who chose the last actions, which differs from `name` where control is handed
over. Policies draw from their own seeded generator.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F32, F64, Bools, Ints
from restock.train.twin.env.interface import Policy
from restock.train.twin.env.navigation import PathFollower
from restock.train.twin.env.vector_env import WarehouseVectorEnv

STUCK_STEPS = 15
SLIP_STEPS = 4
MIN_STEPS_BETWEEN_HANDOVERS = 15


class BehaviourPolicy(Policy, Protocol):
    """A policy that reports who chose each of its last actions."""

    acting: NDArray[np.str_]  # (N,) names
    acting_version: NDArray[np.str_]  # (N,)


class Overseer(BehaviourPolicy, Protocol):
    """A policy that can take over, and knows when it is no longer needed."""

    def sees_trouble(self, env: WarehouseVectorEnv) -> Bools:
        """Return where (N,) it would not hand back yet."""
        ...


class SoftPolicy:
    """A policy that takes a random action with probability `epsilon`."""

    name = "soft"
    version = "1"

    def __init__(self, *, epsilon: float, seed: int = 0) -> None:
        self.epsilon = epsilon
        self._rng = np.random.default_rng([seed, sum(self.name.encode())])
        self.acting = np.array([], "U16")
        self.acting_version = np.array([], "U16")

    def choose(self, env: WarehouseVectorEnv) -> Ints:
        """Return the actions (N,) it would take without exploration."""
        raise NotImplementedError

    def certain(self, env: WarehouseVectorEnv) -> Bools:
        """Return where (N,) it does not explore: nowhere by default."""
        return np.zeros(env.num_envs, np.bool_)

    def act(self, env: WarehouseVectorEnv, observation: F32) -> tuple[Ints, F64]:
        """Return the actions of each robot's current driver, and their probabilities."""
        chosen = self.choose(env)
        count = len(env.task.actions)
        epsilon = np.where(self.certain(env), 0.0, self.epsilon)
        explores = self._rng.random(env.num_envs) < epsilon
        action = np.where(explores, self._rng.integers(count, size=env.num_envs), chosen)
        probability = np.where(action == chosen, 1 - epsilon, 0.0) + epsilon / count
        self.acting = np.full(env.num_envs, self.name, "U16")
        self.acting_version = np.full(env.num_envs, self.version, "U16")
        return action, probability


class RandomPolicy(SoftPolicy):
    """A policy that takes every action with the same probability."""

    name = "random"

    def __init__(self, *, seed: int = 0) -> None:
        super().__init__(epsilon=1.0, seed=seed)

    def choose(self, env: WarehouseVectorEnv) -> Ints:
        """Return action 0 everywhere; exploration makes the choice."""
        return np.zeros(env.num_envs, np.int64)


class PlannerFollower(SoftPolicy):
    """A driver that follows the plan, slows for turns and obstacles, and stops before them.

    Apart from random actions it does what the navigation stack proposes (the signals `nav_*`).
    """

    name = "planner"
    stop_m = 0.30
    slow_m = 0.80

    def __init__(self, *, epsilon: float = 0.02, seed: int = 0) -> None:
        super().__init__(epsilon=epsilon, seed=seed)

    def choose(self, env: WarehouseVectorEnv) -> Ints:
        """Return the action whose velocity is nearest to the plan's."""
        return self._follower(env).choose(env.signals)

    def certain(self, env: WarehouseVectorEnv) -> Bools:
        """Return where (N,) it does not explore: near anything, where it may have to stop."""
        return self._follower(env).near(env.signals)

    def _follower(self, env: WarehouseVectorEnv) -> PathFollower:
        return PathFollower(env.task, stop_m=self.stop_m, slow_m=self.slow_m)


@dataclass(frozen=True)
class HandoverEvent:
    """A change of control from one policy to another."""

    env: int
    episode_seed: int
    step: int  # of the episode
    driver: str  # who drives from here on
    reason: str  # stuck, bumped, slipping, clear


class Handover:
    """A pair of drivers: the operator takes over from the planner in trouble, then hands back.

    Trouble is what the robot itself notices: no way made for 3 s, the bumper, or wheels that
    disagree with the localisation. `events` keeps every handover, oldest first.
    """

    version = "1"

    def __init__(self, planner: BehaviourPolicy, operator: Overseer) -> None:
        self.planner, self.operator = planner, operator
        self.name = f"{planner.name}+{operator.name}"
        self.events: list[HandoverEvent] = []
        self.acting = np.array([], "U16")
        self.acting_version = np.array([], "U16")
        self._prepare(0)

    def _prepare(self, count: int) -> None:
        self._by_operator = np.zeros(count, np.bool_)
        self._since_handover = np.zeros(count, np.int64)  # steps
        self._still = np.zeros(count, np.int64)  # steps without way made
        self._slipping = np.zeros(count, np.int64)
        self._anchor = np.zeros((count, 3))

    def act(self, env: WarehouseVectorEnv, observation: F32) -> tuple[Ints, F64]:
        """Return the actions of each robot's current driver, and their probabilities."""
        if len(self._by_operator) != env.num_envs:
            self._prepare(env.num_envs)
        self._watch(env)
        action, probability = self.planner.act(env, observation)
        if self._by_operator.any():
            operator_action, operator_probability = self.operator.act(env, observation)
            action = np.where(self._by_operator, operator_action, action)
            probability = np.where(self._by_operator, operator_probability, probability)
        names = self.planner.name, self.operator.name
        self.acting = np.where(self._by_operator, names[1], names[0]).astype("U16")
        versions = self.planner.version, self.operator.version
        self.acting_version = np.where(self._by_operator, versions[1], versions[0]).astype("U16")
        return action, probability

    def _watch(self, env: WarehouseVectorEnv) -> None:
        """Decide for each robot who drives."""
        signals = env.signals
        begun = env.steps == 0
        self._by_operator[begun] = False
        self._since_handover[begun] = self._still[begun] = self._slipping[begun] = 0
        pose = np.stack(
            [signals["pose_x_m"], signals["pose_y_m"], signals["pose_yaw_rad"]], axis=-1
        )
        moved = np.abs(pose - self._anchor)
        moved[:, 2] = np.minimum(moved[:, 2], 2 * np.pi - moved[:, 2])
        away = (moved > (0.25, 0.25, 0.6)).any(axis=1) | begun
        self._anchor[away] = pose[away]
        self._still = np.where(away, 0, self._still + 1)
        slip = np.abs(signals["wheel_speed_mps"] - signals["localised_speed_mps"]) > 0.3
        slip |= np.abs(signals["wheel_yaw_rate_radps"] - signals["gyro_yaw_rate_radps"]) > 0.5
        self._slipping = np.where(slip, self._slipping + 1, np.maximum(self._slipping - 1, 0))
        self._since_handover += 1
        stuck = self._still >= STUCK_STEPS
        slipping = self._slipping >= SLIP_STEPS
        trouble = stuck | signals["bumped"] | slipping
        for index in np.flatnonzero(trouble & ~self._by_operator):
            reason = (
                "bumped" if signals["bumped"][index] else "slipping" if slipping[index] else "stuck"
            )
            self._pass(env, int(index), True, reason)
        clear = (
            ~(signals["clearance_m"] <= 0.2)  # NaN: not known
            & (self._slipping == 0)
            & ~signals["bumped"]
            & (self._since_handover >= MIN_STEPS_BETWEEN_HANDOVERS)
            & ~self.operator.sees_trouble(env)
        )
        for index in np.flatnonzero(clear & self._by_operator):
            self._pass(env, int(index), False, "clear")

    def _pass(self, env: WarehouseVectorEnv, index: int, taken: bool, reason: str) -> None:
        names = self.planner.name, self.operator.name
        self._by_operator[index] = taken
        self._since_handover[index] = self._still[index] = 0
        self.events.append(
            HandoverEvent(
                env=index,
                episode_seed=int(env.episode_seed[index]),
                step=int(env.steps[index]),
                driver=names[taken],
                reason=reason,
            )
        )
