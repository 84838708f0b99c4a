"""The fresh ring: what the twin just produced, packed like the panel, first in first out.

Steps of N parallel environments go in; n-step rows come out when they are complete, cut at the end
of an episode (a truncated one bootstraps with the shortened n). Labels arrive only when an episode
has ended, because some conditions look ahead: until then its rows can be drawn uniformly, and
belong to no stratum.

A condition that is seldom met would be washed out by those that are met all the time. Rows may be
reserved for it: then the next row overwrites the oldest of those conditions that hold more than
what is reserved for them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.errors import MixtureError
from restock.replay.mixture.packed_row import F32, Bools, Ints, row_columns, row_width
from restock.replay.ring.pending import PendingSteps
from restock.replay.ring.reserve import Reserve
from restock.replay.ring.slots import NONE, StratumSlots
from restock.replay.sampling.quotas import Quotas

UNLABELLED = NONE

# Metadata of a row, one array (capacity,) each: name -> type.
META: dict[str, type[np.generic]] = {
    "env_step": np.int64,  # environment steps of the run when the row's first step was taken
    "gradient_step": np.int64,  # gradient steps of the run at that moment
    "policy_version": np.int64,  # the caller's number for the policy that acted
    "behaviour_policy": np.int16,  # code into `behaviour_policies`
    "action_probability": np.float32,  # of the action under that policy; NaN if unknown
    "episode": np.int64,  # the episode's key
    "episode_step": np.int32,  # of the row's first step in its episode, from 0
    "horizon": np.int16,  # steps the row's return spans, 1..n_step
}


class FreshRing:
    """N environments' steps as packed n-step rows, oldest overwritten first.

    Args:
        capacity: rows held.
        num_envs: N, parallel environments.
        observation_size: D.
        discount: gamma of one step.
        n_step: steps of a return.
        conditions: names that labels index, e.g. `["nominal", "wheel_slip"]`.
        behaviour_policies: names that behaviour codes index.
        reserved: rows of a condition that others' rows do not overwrite, by its name; together at
            most `capacity`. Without, the oldest row is overwritten whatever its condition. With
            them `sample` draws reserved rows as often as others, so more often than they occur.

    `rows` (capacity, W) float32 is packed as `replay.layout` says; `meta` holds the arrays of META;
    the first `len(ring)` slots are filled.
    """

    def __init__(
        self,
        capacity: int,
        num_envs: int,
        observation_size: int,
        *,
        discount: float,
        n_step: int = 1,
        conditions: Sequence[str] = (),
        behaviour_policies: Sequence[str] = ("dqn",),
        reserved: Mapping[str, int] | None = None,
    ) -> None:
        if capacity < num_envs * n_step:
            raise MixtureError(
                f"a ring of {capacity} rows is too small for {num_envs} environments"
                f" and n_step {n_step}",
                remedy=f"give it at least {num_envs * n_step} rows",
            )
        if n_step < 1 or not 0.0 <= discount <= 1.0:
            raise MixtureError(f"n_step {n_step} below 1 or discount {discount} outside [0, 1]")
        self.capacity, self.num_envs, self.observation_size = capacity, num_envs, observation_size
        self.discount, self.n_step = discount, n_step
        self.conditions = tuple(conditions)
        self.behaviour_policies = tuple(behaviour_policies)
        self.columns = row_columns(observation_size)
        self.rows: F32 = np.zeros((capacity, row_width(observation_size)), np.float32)
        self.meta: dict[str, NDArray[Any]] = {
            name: np.zeros(capacity, dtype) for name, dtype in META.items()
        }
        self.strata = StratumSlots(capacity, len(self.conditions))
        self._reserve = Reserve(capacity, self.strata, self.conditions, reserved or {})
        self._pending = PendingSteps(
            num_envs, observation_size, discount=discount, n_step=n_step, meta=META
        )
        self.episode_key: Ints = np.arange(num_envs, dtype=np.int64)  # of the episode under way
        self._episode_step: Ints = np.zeros(num_envs, np.int64)
        self._next_key = num_envs
        # The slot of each step of the episodes under way, (N, longest so far), and of ended ones.
        self._env_slots: Ints = np.full((num_envs, 256), NONE, np.int64)
        self._awaiting_labels: dict[int, Ints] = {}  # episode key -> slots of its steps

    @property
    def appended(self) -> int:
        """Rows ever appended. Where none are reserved, the next slot is appended % capacity."""
        return self._reserve.appended

    @appended.setter
    def appended(self, rows: int) -> None:
        """For who filled `rows` themselves."""
        self._reserve.appended = rows

    def __len__(self) -> int:
        return min(self.appended, self.capacity)

    def append(
        self,
        *,
        observation: NDArray[Any],
        action: NDArray[Any],
        reward: NDArray[Any],
        terminated: NDArray[Any],
        truncated: NDArray[Any],
        next_observation: NDArray[Any],
        env_step: int,
        gradient_step: int,
        policy_version: int = 0,
        behaviour_policy: NDArray[Any] | int = 0,
        action_probability: NDArray[Any] | float = float("nan"),
    ) -> Ints:
        """Take one step of every environment.

        `observation`, `next_observation` (N, D); `action`, `reward`, `terminated`, `truncated`
        (N,). Where an episode ended, `next_observation` must be its last one (`info["final_obs"]`
        under SAME_STEP autoreset), never the first of the next episode.

        Returns the key of the episode each of these steps belongs to, (N,), for `set_labels`.
        """
        now: dict[str, Any] = {
            "env_step": env_step,
            "gradient_step": gradient_step,
            "policy_version": policy_version,
            "behaviour_policy": behaviour_policy,
            "action_probability": action_probability,
            "episode": self.episode_key,
            "episode_step": self._episode_step,
        }
        self._pending.add(observation, action, reward, now)
        envs = np.arange(self.num_envs)
        ended = np.asarray(terminated, np.bool_) | np.asarray(truncated, np.bool_)
        full = self._pending.waiting == self.n_step
        self._emit(envs[full], next_observation, terminated)
        while len(left := envs[ended & (self._pending.waiting > 0)]):
            self._emit(left, next_observation, terminated)
        keys = self.episode_key.copy()
        for env in np.flatnonzero(ended).tolist() if self.conditions else ():
            steps = int(self._episode_step[env]) + 1
            self._awaiting_labels[int(keys[env])] = self._env_slots[env, :steps].copy()
        self._episode_step = np.where(ended, 0, self._episode_step + 1)
        count = int(ended.sum())
        self.episode_key[ended] = self._next_key + np.arange(count)
        self._next_key += count
        return keys

    def _emit(self, envs: Ints, next_observation: NDArray[Any], terminated: NDArray[Any]) -> None:
        """Pack the oldest pending step of each of these environments into slots of its own."""
        if not len(envs):
            return
        rows, meta = self._pending.pack(envs, next_observation, terminated)
        slots = self._reserve.take(len(envs))
        self.rows[slots] = rows
        for name, values in meta.items():
            self.meta[name][slots] = values
        if self.conditions:
            steps = meta["episode_step"]
            if steps.max() >= self._env_slots.shape[1]:
                self._env_slots = np.concatenate([self._env_slots, self._env_slots], axis=1)
            self._env_slots[envs, steps] = slots

    def set_labels(self, episode_key: int, conditions: NDArray[Any]) -> int:
        """Label the rows of an ended episode: `conditions[t]` (T,) codes its step t.

        Returns how many of its rows were still in the ring. Raises MixtureError for a code that
        names no condition or a row beyond the labels given.
        """
        codes = np.asarray(conditions, np.int64)
        if len(codes) and not ((codes >= 0) & (codes < len(self.conditions))).all():
            raise MixtureError(
                f"labels {sorted(set(codes.tolist()))} name no condition of {self.conditions}",
                where=f"episode {episode_key} of the fresh ring",
            )
        slots = self._awaiting_labels.pop(int(episode_key), np.empty(0, np.int64))
        steps = np.arange(len(slots))
        # The others were overwritten, by other episodes' rows or later ones of the same.
        there = slots >= 0
        there &= self.meta["episode"][slots] == episode_key
        there &= self.meta["episode_step"][slots] == steps
        slots, steps = slots[there], steps[there]
        if steps.max(initial=-1) >= len(codes):
            raise MixtureError(
                f"{len(codes)} labels for an episode of at least {int(steps.max()) + 1} steps",
                where=f"episode {episode_key} of the fresh ring",
            )
        for code in np.unique(codes[steps]):
            self.strata.move(slots[codes[steps] == code], int(code))
        return len(slots)

    def condition(self, slots: NDArray[Any]) -> NDArray[np.int16]:
        """The condition code of each slot (n,); -1 where it has no label yet."""
        codes: NDArray[np.int16] = self.strata.stratum[slots]
        return codes

    def sample(self, batch_size: int, rng: np.random.Generator) -> Ints:
        """Slots (B,), every row in the ring with the same probability.

        Raises MixtureError when the ring is empty.
        """
        if not len(self):
            raise MixtureError("the fresh ring is empty", remedy="collect steps before sampling")
        return rng.integers(len(self), size=batch_size)

    def sample_strata(self, quotas: Quotas, rng: np.random.Generator) -> tuple[Ints, Ints]:
        """Slots (B,) and their condition codes (B,) by exact quotas over the conditions.

        What a stratum without rows was owed is drawn from all rows instead, whatever their label
        (then the code is that row's, -1 if it has none yet).
        """
        quota = quotas.next()
        if len(quota) != len(self.conditions):
            raise MixtureError(f"{len(quota)} quotas for {len(self.conditions)} conditions")
        parts, missing = [], 0
        for code, count in enumerate(quota.tolist()):
            members = self.strata.members(code)
            if len(members):
                parts.append(members[rng.integers(len(members), size=count)])
            else:
                missing += count
        if missing:
            parts.append(self.sample(missing, rng))
        slots = np.concatenate(parts)
        return slots, self.strata.stratum[slots].astype(np.int64)

    def ended_mask(self) -> Bools:
        """Which filled slots belong to an episode that is over, (len(ring),)."""
        return ~np.isin(self.meta["episode"][: len(self)], self.episode_key)

    def state_dict(self) -> dict[str, Any]:
        """Everything, as numpy arrays and plain JSON values; only filled slots."""
        filled = len(self)
        state: dict[str, Any] = {
            "shape": [self.capacity, self.num_envs, self.observation_size, self.n_step],
            "discount": self.discount,
            "conditions": list(self.conditions),
            "behaviour_policies": list(self.behaviour_policies),
            "next_key": self._next_key,
            "rows": self.rows[:filled].copy(),
            "stratum": self.strata.stratum[:filled].copy(),
            "episode_key": self.episode_key.copy(),
            "episode_step": self._episode_step.copy(),
            **self._reserve.state_dict(),
            **self._pending.state_dict(),
        }
        state |= {f"meta.{name}": value[:filled].copy() for name, value in self.meta.items()}
        # Draws within a stratum depend on the order of its members, so the order is kept.
        state |= {
            f"members.{code}": self.strata.members(code).copy()
            for code in range(len(self.conditions))
        }
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Raises MixtureError when the state is of a ring of another shape or other conditions."""
        mine = [self.capacity, self.num_envs, self.observation_size, self.n_step]
        if list(state["shape"]) != mine or list(state["conditions"]) != list(self.conditions):
            raise MixtureError(
                "the saved ring has another shape or other conditions:"
                f" {list(state['shape'])} {list(state['conditions'])},"
                f" not {mine} {list(self.conditions)}",
                remedy="resume with the settings the run began with",
            )
        filled = len(state["rows"])
        self._next_key = int(state["next_key"])
        self.rows[:filled] = state["rows"]
        for name, values in self.meta.items():
            values[:filled] = state[f"meta.{name}"]
        self._pending.load_state_dict(state)
        self.episode_key = np.array(state["episode_key"], np.int64)
        self._episode_step = np.array(state["episode_step"], np.int64)
        self.strata = StratumSlots(self.capacity, len(self.conditions))
        for code in range(len(self.conditions)):
            self.strata.move(np.asarray(state[f"members.{code}"], np.int64), code)
        self._reserve.load_state_dict(state, self.strata)
        self._awaiting_labels = {}
        if self.conditions:
            self._find_slots()

    def _find_slots(self) -> None:
        """Where the steps of episodes without labels are, from the rows themselves."""
        slots = np.flatnonzero(self.strata.stratum[: len(self)] == UNLABELLED)
        keys, steps = self.meta["episode"][slots], self.meta["episode_step"][slots]
        longest = max(256, 2 * int(steps.max(initial=0)), 2 * int(self._episode_step.max()))
        self._env_slots = np.full((self.num_envs, longest), NONE, np.int64)
        env_of = {key: env for env, key in enumerate(self.episode_key.tolist())}
        for key in np.unique(keys).tolist():
            mine = keys == key
            if key in env_of:
                self._env_slots[env_of[key], steps[mine]] = slots[mine]
            else:
                found = np.full(int(steps[mine].max()) + 1, NONE, np.int64)
                found[steps[mine]] = slots[mine]
                self._awaiting_labels[key] = found
