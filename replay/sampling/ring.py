"""The fresh ring: the twin's latest transitions, packed like the panel, first in, first out.

Steps of N parallel environments go in. Each step becomes an n-step row once it is complete or its
episode ends (a truncated row bootstraps with the smaller n). Labels arrive only when an episode has
ended, because some conditions look ahead. Until then its rows can be drawn uniformly, and belong to
no stratum.

Frequent conditions would push out rare ones. To prevent that, rows may be reserved for a condition:
a new row then overwrites the oldest row of conditions that hold more rows than are reserved.

Labelled rows also have a stratum of the mixture, so that fresh rows can fill a quota for which the
logs have too few rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F32, F64, Ints
from restock.errors import MixtureError
from restock.replay.sampling.packed_rows import row_columns, row_width
from restock.replay.sampling.rules import uniform_places
from restock.state import Stateful

NONE = -1
_VICTIMS = 1024  # number of slots to overwrite that are chosen at a time


class StratumSlots(Stateful):
    """Slots (0..capacity - 1) in disjoint strata, with constant-time moves and uniform draws.

    When a slot leaves its stratum, the stratum's last slot moves to its index: no gaps arise.
    """

    # A checkpoint keeps the order of a stratum's slots, because draws depend on it.
    STATE: ClassVar[tuple[str, ...]] = ("_slots",)

    def __init__(self, capacity: int, strata: int) -> None:
        self.stratum: NDArray[np.int16] = np.full(capacity, NONE, np.int16)
        self._place = np.zeros(capacity, np.int64)  # index of each slot in its stratum's members
        self._members = [np.empty(64, np.int64) for _ in range(strata)]
        self.counts: Ints = np.zeros(strata, np.int64)

    def move(self, slots: Ints, stratum: int) -> None:
        """Move distinct slots (n,) to a stratum, or out of all strata (-1)."""
        if stratum != NONE and (self.stratum[slots] == NONE).all():
            self._add_all(slots, stratum)  # usual case: an episode ended and got its labels
            return
        for slot in slots.tolist():
            old = int(self.stratum[slot])
            if old == stratum:
                continue
            if old != NONE:
                self._remove(slot, old)
            if stratum != NONE:
                self._add(slot, stratum)
            self.stratum[slot] = stratum

    def members(self, stratum: int) -> Ints:
        """Return the slots of a stratum, (counts[stratum],), in arbitrary order."""
        return self._members[stratum][: self.counts[stratum]]

    @property
    def _slots(self) -> list[Ints]:
        return [self.members(stratum) for stratum in range(len(self.counts))]

    @_slots.setter
    def _slots(self, slots: list[Ints]) -> None:
        self.stratum[:] = NONE
        self.counts[:] = 0
        for stratum, members in enumerate(slots):
            self.move(np.asarray(members, np.int64), stratum)

    def _add_all(self, slots: Ints, stratum: int) -> None:
        count, size = int(self.counts[stratum]), len(slots)
        while count + size > len(self._members[stratum]):
            members = self._members[stratum]
            self._members[stratum] = np.concatenate([members, np.empty_like(members)])
        self._members[stratum][count : count + size] = slots
        self._place[slots] = count + np.arange(size)
        self.counts[stratum] = count + size
        self.stratum[slots] = stratum

    def _add(self, slot: int, stratum: int) -> None:
        count = int(self.counts[stratum])
        members = self._members[stratum]
        if count == len(members):
            members = self._members[stratum] = np.concatenate([members, np.empty_like(members)])
        members[count] = slot
        self._place[slot] = count
        self.counts[stratum] = count + 1

    def _remove(self, slot: int, stratum: int) -> None:
        members, last = self._members[stratum], int(self.counts[stratum]) - 1
        hole = int(self._place[slot])
        moved = int(members[last])
        members[hole] = moved
        self._place[moved] = hole
        self.counts[stratum] = last


class Reserve(Stateful):
    """Allocates the slots of a ring of `capacity` rows.

    Args:
        strata: the slots of each condition, which the ring keeps up to date.
        conditions: names of the conditions.
        reserved: condition -> number of its rows that rows of other conditions do not overwrite.

    Raises:
        MixtureError: rows reserved for an unknown condition, or more than the ring holds.
    """

    SAME: ClassVar[tuple[str, ...]] = ("rows",)
    STATE: ClassVar[tuple[str, ...]] = ("appended", "_serial", "_victims")

    def __init__(
        self,
        capacity: int,
        strata: StratumSlots,
        conditions: Sequence[str],
        reserved: Mapping[str, int],
    ) -> None:
        self.rows: Ints = np.array([reserved.get(name, 0) for name in conditions], np.int64)
        if set(reserved) - set(conditions) or (self.rows < 0).any() or self.rows.sum() > capacity:
            raise MixtureError(
                f"{dict(reserved)} cannot be reserved in a ring of {capacity} rows for"
                f" {list(conditions)}",
                remedy="reserve rows for conditions of the ring, together at most its capacity",
            )
        self.capacity, self._strata = capacity, strata
        self.appended = 0  # number of rows ever appended
        self._serial: Ints = np.full(capacity, -1, np.int64)  # serial number of each slot's row
        self._victims: Ints = np.empty(0, np.int64)  # slots to overwrite next

    def take(self, count: int) -> Ints:
        """Return slots (count,) for new rows; slots to overwrite lose their condition."""
        beyond = max(self.appended + count - self.capacity, 0)
        if beyond and self.rows.any():
            beyond = min(beyond, count)
            if len(self._victims) < beyond:
                self._choose_victims(beyond)
            victims, self._victims = self._victims[:beyond], self._victims[beyond:]
            slots = np.concatenate([self.appended + np.arange(count - beyond), victims])
        else:
            slots = (self.appended + np.arange(count)) % self.capacity
        if beyond and len(self.rows):
            self._strata.move(slots, NONE)
        self._serial[slots] = self.appended + np.arange(count)
        self.appended += count
        return slots

    def _choose_victims(self, at_least: int) -> None:
        """Choose the slots to overwrite next: the oldest rows of conditions above their reserve.

        If there are too few, for example before the first episode ends, add the oldest rows without
        a label. If there are still too few, because all rows are reserved, add the oldest rows.
        """
        surplus = np.maximum(self._strata.counts - self.rows, 0)
        oldest = [np.empty(0, np.int64)]
        for code in np.flatnonzero(surplus).tolist():
            members = self._strata.members(code)
            oldest.append(members[np.argsort(self._serial[members])[: surplus[code]]])
        candidates = np.concatenate(oldest)
        filled = self._serial >= 0
        for others in ((self._strata.stratum == NONE) & filled, filled):
            if len(candidates) < at_least:
                slots = np.setdiff1d(np.flatnonzero(others), candidates)
                by_age = slots[np.argsort(self._serial[slots])]
                candidates = np.concatenate([candidates, by_age[: at_least - len(candidates)]])
        some = max(min(_VICTIMS, self.capacity // 16), at_least)
        self._victims = candidates[np.argsort(self._serial[candidates])[:some]]

    def mismatch(self, name: str, value: Any) -> MixtureError:
        """Return the error for a saved state with other reserved rows."""
        saved = None if value is None else np.asarray(value).tolist()
        return MixtureError(
            f"the saved ring reserved {saved} rows of its conditions, not {self.rows.tolist()}",
            remedy="resume with the settings the run began with",
        )


UNLABELLED = NONE
_SLOT_ARRAYS = ("rows", "stratum", "draws")  # arrays (capacity, …) besides those of META

# Metadata of rows: name -> type of its array (capacity,).
META: dict[str, type[np.generic]] = {
    "env_step": np.int64,  # environment steps of the run when the row's first step was taken
    "gradient_step": np.int64,  # gradient steps of the run when that step was taken
    "policy_version": np.int64,  # the caller's number for the policy that acted
    "behaviour_policy": np.int16,  # index in `behaviour_policies`
    "action_probability": np.float32,  # probability of the action under that policy; NaN: unknown
    "teacher_action": np.int16,  # the teacher's action; -1: none, or not queried
    "episode": np.int64,  # the episode's key
    "episode_step": np.int32,  # number of the row's first step in its episode, from 0
    "horizon": np.int16,  # number of steps that the row's return spans, 1..n_step
}


class PendingSteps(Stateful):
    """Steps whose n-step return is not complete, in a circular buffer per environment.

    Args:
        num_envs: number of environments, N.
        observation_size: numbers in an observation, D.
        discount: gamma of one step.
        n_step: steps of a return.
        meta: name -> type of a step's metadata.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        *("waiting", "_first", "_observation", "_reward", "_action", "_meta"),
    )

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
        self.waiting: Ints = np.zeros(num_envs, np.int64)  # number of pending steps, 0..n_step - 1
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
        """Add one step of every environment: `observation` (N, D), `action` and `reward` (N,)."""
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
        """Pack and remove the oldest step of each of these environments (n,).

        `next_observation` (N, D) and `terminated` (N,) are of the step added last. Returns rows
        (n, W) and their metadata, arrays (n,).
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
        not_terminated = ~np.asarray(terminated, np.bool_)[envs]
        rows[:, part["discount"]] = (self.discount**horizon * not_terminated)[:, None]
        meta = {name: values[envs, first] for name, values in self._meta.items()}
        meta["horizon"] = horizon
        self._first[envs] = (first + 1) % self.n_step
        self.waiting[envs] -= 1
        return rows, meta


class FreshRing(Stateful):
    """A ring buffer of packed n-step rows from N environments; the oldest is overwritten first.

    Args:
        capacity: largest number of rows.
        num_envs: N, parallel environments.
        observation_size: D.
        discount: gamma of one step.
        n_step: steps of a return.
        conditions: names that labels index, e.g. `["nominal", "wheel_slip"]`.
        strata: names of the strata that rows are drawn by; default: the conditions.
        behaviour_policies: names that behaviour codes index.
        reserved: condition -> number of its rows that rows of other conditions do not overwrite;
            together at most `capacity`. Without it, the oldest row of any condition is
            overwritten. With it, reserved conditions stay longer, so `sample` draws them more
            often than they occur.

    `rows` (capacity, W) float32 has the layout of `replay.sampling.packed_rows`. `meta` holds the
    arrays of META. The first `len(ring)` slots are filled.
    """

    SAME: ClassVar[tuple[str, ...]] = (
        *("capacity", "num_envs", "observation_size", "n_step", "conditions", "strata"),
    )
    STATE: ClassVar[tuple[str, ...]] = (
        *("_reserve", "_filled", "_pending", "by_condition", "by_stratum"),
        *("episode_key", "_episode_step", "_next_key"),
    )

    def __init__(
        self,
        capacity: int,
        num_envs: int,
        observation_size: int,
        *,
        discount: float,
        n_step: int = 1,
        conditions: Sequence[str] = (),
        strata: Sequence[str] | None = None,
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
        self.strata = self.conditions if strata is None else tuple(strata)
        self.by_condition = StratumSlots(capacity, len(self.conditions))
        self._reserve = Reserve(capacity, self.by_condition, self.conditions, reserved or {})
        self.stratum: NDArray[np.int16] = np.full(capacity, NONE, np.int16)  # -1: in no stratum
        self.by_stratum = StratumSlots(capacity, len(self.strata))  # rows that `draw` may return
        self.draws: NDArray[np.int32] = np.zeros(capacity, np.int32)  # draws of each slot's row
        self._pending = PendingSteps(
            num_envs, observation_size, discount=discount, n_step=n_step, meta=META
        )
        # Slots written since the owner of a copy of the rows cleared this list; None: no copy.
        self.written: list[Ints] | None = None
        self.episode_key: Ints = np.arange(num_envs, dtype=np.int64)  # keys of the current episodes
        self._episode_step: Ints = np.zeros(num_envs, np.int64)
        self._next_key = num_envs
        # The slot of each step of the current episodes, (N, T); T grows with the longest episode.
        self._env_slots: Ints = np.full((num_envs, 256), NONE, np.int64)
        self._awaiting_labels: dict[int, Ints] = {}  # episode key -> slots of its steps

    @property
    def appended(self) -> int:
        """Return the number of rows ever appended (% capacity: next slot, if none is reserved)."""
        return self._reserve.appended

    @appended.setter
    def appended(self, rows: int) -> None:
        """Set the number after the array `rows` was filled directly."""
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
        teacher_action: NDArray[Any] | int = -1,
    ) -> Ints:
        """Append one step of every environment.

        `observation`, `next_observation` (N, D); `action`, `reward`, `terminated`, `truncated`
        (N,). If an episode ended, `next_observation` must be its last observation
        (`info["final_obs"]` under SAME_STEP autoreset), not the first of the next episode.

        Returns the key of each step's episode, (N,), for `set_labels`.
        """
        now: dict[str, Any] = {
            "env_step": env_step,
            "gradient_step": gradient_step,
            "policy_version": policy_version,
            "behaviour_policy": behaviour_policy,
            "action_probability": action_probability,
            "teacher_action": teacher_action,
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

    def begin_episodes(self) -> Ints:
        """Begin a new episode in every environment, and drop steps without a complete return.

        Returns the keys of the episodes cut off, (N,); they get no labels.
        """
        keys = self.episode_key
        self._pending.waiting = np.zeros_like(self._pending.waiting)
        self._episode_step = np.zeros_like(self._episode_step)
        self.episode_key = self._next_key + np.arange(self.num_envs, dtype=np.int64)
        self._next_key += self.num_envs
        return keys

    def _emit(self, envs: Ints, next_observation: NDArray[Any], terminated: NDArray[Any]) -> None:
        """Pack the oldest pending step of each of these environments into a new slot."""
        if not len(envs):
            return
        rows, meta = self._pending.pack(envs, next_observation, terminated)
        slots = self._reserve.take(len(envs))
        self.rows[slots] = rows
        self.by_stratum.move(slots, NONE)
        self.stratum[slots], self.draws[slots] = NONE, 0
        if self.written is not None:
            self.written.append(slots)
        for name, values in meta.items():
            self.meta[name][slots] = values
        if self.conditions:
            steps = meta["episode_step"]
            if steps.max() >= self._env_slots.shape[1]:
                self._env_slots = np.concatenate([self._env_slots, self._env_slots], axis=1)
            self._env_slots[envs, steps] = slots

    def set_labels(
        self, episode_key: int, conditions: NDArray[Any], strata: NDArray[Any] | None = None
    ) -> int:
        """Label the rows of an ended episode.

        `conditions` (T,) are the condition codes of its steps, `strata` (T,) their stratum codes,
        -1 for no stratum; None: equal to `conditions`. Returns how many of its rows were still in
        the ring. Raises MixtureError for an invalid condition code, or a row without a label.
        """
        codes = np.asarray(conditions, np.int64)
        stratum_codes = codes if strata is None else np.asarray(strata, np.int64)
        if len(codes) and not ((codes >= 0) & (codes < len(self.conditions))).all():
            raise MixtureError(
                f"labels {sorted(set(codes.tolist()))} name no condition of {self.conditions}",
                where=f"episode {episode_key} of the fresh ring",
            )
        slots = self._awaiting_labels.pop(int(episode_key), np.empty(0, np.int64))
        steps = np.arange(len(slots))
        # Skip slots that rows of other episodes, or later rows of this episode, have overwritten.
        present = slots >= 0
        present &= self.meta["episode"][slots] == episode_key
        present &= self.meta["episode_step"][slots] == steps
        slots, steps = slots[present], steps[present]
        if steps.max(initial=-1) >= len(codes):
            raise MixtureError(
                f"{len(codes)} labels for an episode of at least {int(steps.max()) + 1} steps",
                where=f"episode {episode_key} of the fresh ring",
            )
        for slots_of, found in ((self.by_condition, codes), (self.by_stratum, stratum_codes)):
            for code in np.unique(found[steps]):
                slots_of.move(slots[found[steps] == code], int(code))
        self.stratum[slots] = stratum_codes[steps]
        return len(slots)

    def condition(self, slots: NDArray[Any]) -> NDArray[np.int16]:
        """Return the condition code of each slot (n,); -1 if it has no label yet."""
        codes: NDArray[np.int16] = self.by_condition.stratum[slots]
        return codes

    @property
    def stratum_rows(self) -> Ints:
        """Return the number of rows of each stratum in the ring, (S,)."""
        in_one = self.stratum[: len(self)]
        return np.bincount(in_one[in_one >= 0], minlength=len(self.strata))

    def draw(
        self,
        counts: Ints,
        rng: np.random.Generator,
        limit: int | None = None,
        since: int | None = None,
    ) -> Ints:
        """Draw `counts` (S,) slots of the strata, uniformly with replacement; return them, (n,).

        Args:
            limit: a row that was drawn this many times is not drawn by later calls; None: no limit.
            since: earliest environment step of a row that may be drawn.

        Nothing is drawn for a stratum without rows that may be drawn.
        """
        each = counts.tolist()
        at, begin = rng.random(sum(each)), 0
        found: list[Ints] = [np.empty(0, np.int64)]
        for stratum, count in enumerate(each):
            begin += count
            if not count:
                continue
            members = self.by_stratum.members(stratum)
            if since is not None:
                members = members[self.meta["env_step"][members] >= since]
            if len(members):
                found.append(members[uniform_places(at[begin - count : begin], len(members))])
        slots = np.concatenate(found)
        if limit is not None:
            np.add.at(self.draws, slots, 1)
            if (full := self.draws[slots] >= limit).any():
                self.by_stratum.move(np.unique(slots[full]), NONE)
        return slots

    def sample(self, batch_size: int, rng: np.random.Generator) -> Ints:
        """Draw slots (B,) uniformly from the ring.

        Raises MixtureError when the ring is empty.
        """
        if not len(self):
            raise MixtureError("the fresh ring is empty", remedy="collect steps before sampling")
        return rng.integers(len(self), size=batch_size)

    @property
    def _filled(self) -> dict[str, NDArray[Any]]:
        """Return the filled part, (n, …), of each array in _SLOT_ARRAYS and META, by name."""
        filled = len(self)
        meta = {name: values[:filled] for name, values in self.meta.items()}
        own = {name: getattr(self, name)[:filled] for name in _SLOT_ARRAYS}
        return {**own, **meta}

    @_filled.setter
    def _filled(self, filled: dict[str, NDArray[Any]]) -> None:
        for name, values in filled.items():
            place = getattr(self, name) if name in _SLOT_ARRAYS else self.meta[name]
            place[: len(values)] = values

    def mismatch(self, name: str, value: Any) -> MixtureError:
        """Return the error for a saved state with another shape or other conditions."""
        return MixtureError(
            f"the saved ring has another shape or other conditions: {name} {value},"
            f" not {getattr(self, name)}",
            remedy="resume with the settings the run began with",
        )

    def restored(self) -> None:
        """Find the slots of unlabelled episodes again after a checkpoint was loaded."""
        self._awaiting_labels = {}
        if self.conditions:
            self._find_slots()

    def _find_slots(self) -> None:
        """Find the slots of unlabelled episodes by the metadata of their rows."""
        slots = np.flatnonzero(self.by_condition.stratum[: len(self)] == UNLABELLED)
        keys, steps = self.meta["episode"][slots], self.meta["episode_step"][slots]
        longest = max(256, 2 * int(steps.max(initial=0)), 2 * int(self._episode_step.max()))
        self._env_slots = np.full((self.num_envs, longest), NONE, np.int64)
        env_of = {key: env for env, key in enumerate(self.episode_key.tolist())}
        for key in np.unique(keys).tolist():
            of_key = keys == key
            if key in env_of:
                self._env_slots[env_of[key], steps[of_key]] = slots[of_key]
            else:
                of_step = np.full(int(steps[of_key].max()) + 1, NONE, np.int64)
                of_step[steps[of_key]] = slots[of_key]
                self._awaiting_labels[key] = of_step
