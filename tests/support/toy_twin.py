"""A twin small enough to solve: a corridor of cells, the interface of the warehouse's.

The robot starts at cell 0 and must reach the last cell. Actions: stop, forward, back. In episodes
of `wheel_slip` a forward step fails half the time, and the wheels turn all the same. Each episode
is fully determined by its spec, as in the real one.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from restock.ingest.task.conditions import Condition
from restock.ingest.task.task import STORED_SIGNALS, Body, Task
from restock.train.twin.env.episode_queue import MissionArm
from restock.train.twin.physics.episode import EpisodeSpec

CELLS = 6
TASK = Task(
    body=Body(length_m=0.7, width_m=0.5),
    actions=((0.0, 0.0), (1.0, 0.0), (-1.0, 0.0)),
    control_period_s=0.2,
    sectors=4,
    time_limit_steps=20,
)
CONDITIONS = [
    Condition(
        "wheel_slip",
        "post",
        "coalesce(lead(wheel_speed_mps - localised_speed_mps) OVER episode > 0.5, false)",
        30,
    ),
    Condition("near_goal", "pre", "goal_distance_m <= 2", 40),
]


class ToyTwin:
    """N corridors with SAME_STEP autoreset."""

    def __init__(
        self, num_envs: int, conditions: Mapping[str, float] | None = None, seed: int = 0
    ) -> None:
        self.num_envs = num_envs
        self.bump_terminates = False
        shares = conditions or {"nominal": 0.5, "wheel_slip": 0.5}
        self._names = list(shares)
        self._shares = np.array(list(shares.values())) / sum(shares.values())
        self._draws = np.random.default_rng(seed)
        self._fixed: list[EpisodeSpec] = []
        self.number = np.full(num_envs, -1)
        self._specs: list[EpisodeSpec] = [EpisodeSpec("nominal", 0)] * num_envs
        self._floors = [np.random.default_rng(0) for _ in range(num_envs)]
        self.cell = np.zeros(num_envs, np.int64)
        self.steps = np.zeros(num_envs, np.int64)
        self.wheel = np.zeros(num_envs)
        self.moved = np.zeros(num_envs)

    def set_episodes(self, specs: Iterable[EpisodeSpec]) -> None:
        self._fixed, self._taken = list(specs), 0

    def mission_arms(self) -> list[MissionArm]:
        shares = zip(self._names, self._shares.tolist(), strict=True)
        return [MissionArm(name, name, share) for name, share in shares if share]

    def set_mission_shares(self, shares: Sequence[float]) -> None:
        self._names = [arm.name for arm in self.mission_arms()]
        self._shares = np.array(shares)

    def _next(self, place: int) -> EpisodeSpec:
        self.number[place] = -1
        if self._fixed and self._taken < len(self._fixed):
            self.number[place] = self._taken
            self._taken += 1
            return self._fixed[self._taken - 1]
        condition = self._names[self._draws.choice(len(self._names), p=self._shares)]
        return EpisodeSpec(condition, int(self._draws.integers(1 << 30)))

    def _begin(self, place: int) -> None:
        self._specs[place] = self._next(place)
        self._floors[place] = np.random.default_rng(self._specs[place].seed)
        self.cell[place] = self.steps[place] = 0
        self.wheel[place] = self.moved[place] = 0.0

    @property
    def signals(self) -> dict[str, np.ndarray]:
        columns = {s.name: np.zeros(self.num_envs, s.dtype) for s in STORED_SIGNALS}
        columns["stamp_ns"] = (self.steps * 200_000_000).astype(np.int64)
        columns["pose_x_m"] = self.cell.astype(float)
        columns["goal_distance_m"] = (CELLS - 1 - self.cell).astype(float)
        columns["wheel_speed_mps"] = self.wheel.copy()
        columns["localised_speed_mps"] = self.moved.copy()
        columns["bumped"] = (self.wheel < 0) & (self.cell == 0)
        return columns

    def _observe(self) -> np.ndarray:
        observation = np.zeros((self.num_envs, TASK.observation_size), np.float32)
        observation[np.arange(self.num_envs), self.cell] = 1.0
        return observation

    def reset(self, *, seed: int | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        if seed is not None:
            self._draws = np.random.default_rng(seed)
        for place in range(self.num_envs):
            self._begin(place)
        return self._observe(), {}

    def step(self, actions: np.ndarray) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        self.steps += 1
        for place, action in enumerate(np.asarray(actions)):
            want = TASK.actions[action][0]
            slips = self._specs[place].condition == "wheel_slip" and want > 0
            grips = not (slips and self._floors[place].random() < 0.5)
            target = np.clip(self.cell[place] + (int(want) if grips else 0), 0, CELLS - 1)
            self.wheel[place], self.moved[place] = want, target - self.cell[place]
            self.cell[place] = target
        success = self.cell == CELLS - 1
        reward = np.where(success, 1.0, -0.05).astype(np.float32)
        truncated = (self.steps >= TASK.time_limit_steps) & ~success
        terminated = success | (self.signals["bumped"] & self.bump_terminates)
        truncated &= ~terminated
        ended = terminated | truncated
        info: dict[str, Any] = {
            "signals": self.signals,
            "travelled_m": np.abs(self.moved),
            "closest_person_m": np.full(self.num_envs, np.inf),
            "success": success,
            "invalid": np.zeros(self.num_envs, np.bool_),
            "episode_number": self.number.copy(),
            "block": np.array(["none"] * self.num_envs, object),
            "episode_seed": np.array([s.seed for s in self._specs]),
            "perturbation": np.array(["worn"] * self.num_envs, object),
            "perturbation_values": np.array(['{"gain": 0.9}'] * self.num_envs, object),
            "episode_condition": np.array([s.condition for s in self._specs], object),
            "final_obs": np.array([None] * self.num_envs, object),
        }
        final = self._observe()
        for place in np.flatnonzero(ended):
            info["final_obs"][place] = final[place]
            self._begin(place)
        return self._observe(), reward, terminated, truncated, info

    def state_dict(self) -> dict[str, Any]:
        return {
            "cell": self.cell.copy(),
            "steps": self.steps.copy(),
            "wheel": self.wheel.copy(),
            "moved": self.moved.copy(),
            "draws": self._draws.bit_generator.state,
            "floors": [floor.bit_generator.state for floor in self._floors],
            "specs": [[spec.condition, spec.seed] for spec in self._specs],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.cell[:], self.steps[:] = state["cell"], state["steps"]
        self.wheel[:], self.moved[:] = state["wheel"], state["moved"]
        self._draws.bit_generator.state = state["draws"]
        for floor, saved in zip(self._floors, state["floors"], strict=True):
            floor.bit_generator.state = saved
        self._specs = [EpisodeSpec(*spec) for spec in state["specs"]]
