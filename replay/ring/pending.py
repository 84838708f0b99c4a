"""Steps that wait until their n-step row is complete, of N parallel environments."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.replay.mixture.packed_row import F32, F64, Ints, row_columns, row_width


class PendingSteps:
    """Up to n steps of each environment, the oldest at its `_first`, round and round.

    Args:
        num_envs: N.
        observation_size: D.
        discount: gamma of one step.
        n_step: steps of a return.
        meta: what is known of a step besides: name -> type.
    """

    def __init__(
        self,
        num_envs: int,
        observation_size: int,
        *,
        discount: float,
        n_step: int,
        meta: Mapping[str, type[np.generic]],
    ) -> None:
        self.discount, self.n_step = discount, n_step
        self._columns = row_columns(observation_size)
        self._width = row_width(observation_size)
        self._observation: F32 = np.zeros((num_envs, n_step, observation_size), np.float32)
        self._reward: F64 = np.zeros((num_envs, n_step))
        self._action: NDArray[np.int16] = np.zeros((num_envs, n_step), np.int16)
        self._meta: dict[str, NDArray[Any]] = {
            name: np.zeros((num_envs, n_step), dtype) for name, dtype in meta.items()
        }
        self.waiting: Ints = np.zeros(num_envs, np.int64)  # steps pending, 0..n_step - 1
        self._first: Ints = np.zeros(num_envs, np.int64)  # position of the oldest step
        self._envs = np.arange(num_envs)
        self._ahead = np.arange(n_step)
        self._powers = discount**self._ahead

    def add(
        self,
        observation: NDArray[Any],
        action: NDArray[Any],
        reward: NDArray[Any],
        meta: Mapping[str, Any],
    ) -> None:
        """One step of every environment: `observation` (N, D), `action` and `reward` (N,)."""
        at = self._envs, (self._first + self.waiting) % self.n_step
        self._observation[at] = observation
        self._action[at] = action
        self._reward[at] = reward
        for name, value in meta.items():
            self._meta[name][at] = value
        self.waiting = self.waiting + 1

    def pack(
        self, envs: Ints, next_observation: NDArray[Any], terminated: NDArray[Any]
    ) -> tuple[F32, dict[str, NDArray[Any]]]:
        """The oldest step of each of these environments (n,), packed, and forgotten.

        `next_observation` (N, D) and `terminated` (N,) are of the step added last. Returns rows
        (n, W) and their metadata (n,) each.
        """
        horizon, first = self.waiting[envs], self._first[envs]  # (n,)
        inside = self._ahead < horizon[:, None]
        ahead = (first[:, None] + self._ahead) % self.n_step
        part = self._columns
        rows: F32 = np.empty((len(envs), self._width), np.float32)
        rows[:, part["observation"]] = self._observation[envs, first]
        rows[:, part["next_observation"]] = np.asarray(next_observation)[envs]
        rows[:, part["action"]] = self._action[envs, first][:, None]
        returns = (self._reward[envs[:, None], ahead] * self._powers * inside).sum(axis=1)
        rows[:, part["reward"]] = returns[:, None]
        going_on = ~np.asarray(terminated, np.bool_)[envs]
        rows[:, part["discount"]] = (self.discount**horizon * going_on)[:, None]
        meta = {name: values[envs, first] for name, values in self._meta.items()}
        meta["horizon"] = horizon
        self._first[envs] = (first + 1) % self.n_step
        self.waiting[envs] -= 1
        return rows, meta

    def state_dict(self) -> dict[str, Any]:
        """Arrays."""
        return {
            "waiting": self.waiting.copy(),
            "pending.first": self._first.copy(),
            "pending.observation": self._observation.copy(),
            "pending.reward": self._reward.copy(),
            "pending.action": self._action.copy(),
            **{f"pending.{name}": values.copy() for name, values in self._meta.items()},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Puts the steps where `state_dict` found them."""
        self.waiting = np.array(state["waiting"], np.int64)
        self._first = np.array(state["pending.first"], np.int64)
        self._observation[...] = state["pending.observation"]
        self._reward[...] = state["pending.reward"]
        self._action[...] = state["pending.action"]
        for name, values in self._meta.items():
            values[...] = state[f"pending.{name}"]
