"""What is known of the fresh rows in a buffer that another library keeps: a ring without rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.replay.ring.ring import META
from restock.replay.ring.slots import NONE, StratumSlots

Ints = NDArray[np.int64]


class FreshMeta:
    """Metadata beside `capacity` slots that N environments' steps are written to, a step a slot.

    Has what a `FreshRing` has for the record of batches: `meta`, `conditions`, `condition`,
    `strata`, `behaviour_policies` and its length.
    """

    def __init__(
        self, capacity: int, num_envs: int, *, conditions: Sequence[str], behaviour_policy: str
    ) -> None:
        self.capacity, self.num_envs = capacity, num_envs
        self.conditions = tuple(conditions)
        self.behaviour_policies = (behaviour_policy,)
        self.meta: dict[str, NDArray[Any]] = {
            name: np.zeros(capacity, dtype) for name, dtype in META.items()
        }
        self.meta["action_probability"][:] = np.nan
        self.strata = StratumSlots(capacity, len(self.conditions))
        self.filled = np.zeros(capacity, np.bool_)
        self.episode_key: Ints = np.arange(num_envs, dtype=np.int64)
        self._episode_step: Ints = np.zeros(num_envs, np.int64)
        self._next_key = num_envs
        self._slots: dict[int, list[int]] = {key: [] for key in range(num_envs)}

    def __len__(self) -> int:
        return int(self.filled.sum())

    def write(
        self,
        slots: Ints,
        envs: Ints,
        ended: NDArray[np.bool_],
        *,
        env_step: int,
        gradient_step: int,
    ) -> Ints:
        """One step of `envs` (n,) went to `slots` (n,); returns their episodes' keys (n,)."""
        self.strata.move(slots, NONE)
        keys = self.episode_key[envs].copy()
        now = {
            "env_step": env_step,
            "gradient_step": gradient_step,
            "policy_version": gradient_step,
            "episode": keys,
            "episode_step": self._episode_step[envs],
            "horizon": 1,
        }
        for name, value in now.items():
            self.meta[name][slots] = value
        self.filled[slots] = True
        for slot, key in zip(slots.tolist(), keys.tolist(), strict=True):
            self._slots[key].append(slot)
        self._episode_step[envs] = np.where(ended, 0, self._episode_step[envs] + 1)
        over = envs[ended]
        self.episode_key[over] = self._next_key + np.arange(len(over))
        self._slots |= {int(key): [] for key in self.episode_key[over]}
        self._next_key += len(over)
        return keys

    def set_labels(self, episode_key: int, codes: Ints) -> int:
        """Label an ended episode's rows, as a ring does; returns how many were still there."""
        # Once each: an episode longer than the buffer overwrites its own.
        slots = np.unique(np.array(self._slots.pop(episode_key, []), np.int64))
        slots = slots[self.meta["episode"][slots] == episode_key]  # the others were overwritten
        steps = self.meta["episode_step"][slots]
        for code in np.unique(codes[steps]):
            self.strata.move(slots[codes[steps] == code], int(code))
        return len(slots)

    def condition(self, slots: NDArray[Any]) -> NDArray[np.int16]:
        """The condition code of each slot (n,); -1 where it has no label yet."""
        codes: NDArray[np.int16] = self.strata.stratum[slots]
        return codes

    def forget(self) -> None:
        """The library emptied its buffer."""
        self.strata.move(np.flatnonzero(self.filled), NONE)
        self.filled[:] = False
        self._episode_step[:] = 0
        self.episode_key = self._next_key + np.arange(self.num_envs, dtype=np.int64)
        self._next_key += self.num_envs
        self._slots = {int(key): [] for key in self.episode_key}
