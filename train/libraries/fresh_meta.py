"""What is known of fresh rows that another library keeps: metadata without rows, and labels.

As in other libraries, only the `info` of each step is seen. The twin's single environment gives the
signals at t and at t + 1 in it, so an episode that ended is labelled by the very conditions, over
the very signals, that label logs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.arrays import Bools, Ints
from restock.ingest.task.conditions import NOMINAL, Condition, label, primary
from restock.ingest.task.schema import signal_arrays
from restock.ingest.task.signals import STORED_SIGNALS
from restock.replay.sampling.ring import META, NONE, StratumSlots

EPISODES_PER_QUERY = 8  # at most: as many as there are environments
_COMMANDS = ("command_speed_mps", "command_yaw_rate_radps")
_NAMES = tuple(signal.name for signal in STORED_SIGNALS)


class FreshMeta:
    """Metadata beside `capacity` slots that N environments' steps are written to, a step a slot.

    Has what a `FreshRing` has for the record of batches: `meta`, `conditions`, `condition`,
    `by_condition`, `strata`, `stratum`, `behaviour_policies` and its length.
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
        self.meta["teacher_action"][:] = -1
        self.strata = self.conditions  # nothing else tells these rows apart
        self.by_condition = StratumSlots(capacity, len(self.conditions))
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
        ended: Bools,
        *,
        env_step: int,
        gradient_step: int,
    ) -> Ints:
        """Write one step of `envs` (n,) to `slots` (n,); return their episodes' keys (n,)."""
        self.by_condition.move(slots, NONE)
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
        begun = envs[ended]
        self.episode_key[begun] = self._next_key + np.arange(len(begun))
        self._slots |= {int(key): [] for key in self.episode_key[begun]}
        self._next_key += len(begun)
        return keys

    def set_labels(self, episode_key: int, codes: Ints) -> int:
        """Label an ended episode's rows, as a ring does; returns how many were still there."""
        # Once each: an episode longer than the buffer overwrites its own.
        slots = np.unique(np.array(self._slots.pop(episode_key, []), np.int64))
        slots = slots[self.meta["episode"][slots] == episode_key]  # the others were overwritten
        steps = self.meta["episode_step"][slots]
        for code in np.unique(codes[steps]):
            self.by_condition.move(slots[codes[steps] == code], int(code))
        return len(slots)

    @property
    def stratum(self) -> NDArray[np.int16]:
        """The stratum of each slot (capacity,): its condition's code."""
        return self.by_condition.stratum

    def condition(self, slots: NDArray[Any]) -> NDArray[np.int16]:
        """Return the condition code of each slot (n,); -1 where it has no label yet."""
        codes: NDArray[np.int16] = self.by_condition.stratum[slots]
        return codes

    def forget(self) -> None:
        """Forget all rows after the library emptied its buffer."""
        self.by_condition.move(np.flatnonzero(self.filled), NONE)
        self.filled[:] = False
        self._episode_step[:] = 0
        self.episode_key = self._next_key + np.arange(self.num_envs, dtype=np.int64)
        self._next_key += self.num_envs
        self._slots = {int(key): [] for key in self.episode_key}


@dataclass(frozen=True)
class Labelled:
    """An episode's labels: the code of each step's condition, nominal last."""

    key: int
    codes: Ints  # (T,)
    conditions: list[str]  # that held at some step


class InfoLabels:
    """Labels of N environments' episodes.

    Steps whose info has no `signals` are not labelled; `unlabelled_episodes` counts their episodes.
    """

    def __init__(self, conditions: Sequence[Condition], num_envs: int) -> None:
        self.conditions = sorted(conditions, key=lambda c: (c.priority, c.name))
        self.names = (*(condition.name for condition in self.conditions), NOMINAL)
        self._codes = {name: code for code, name in enumerate(self.names)}
        self._worth_a_query = min(EPISODES_PER_QUERY, num_envs)
        self._running: list[list[dict[str, Any]]] = [[] for _ in range(num_envs)]
        self._ended: list[tuple[int, list[dict[str, Any]]]] = []
        self.unlabelled_episodes = 0

    def step(self, env: int, info: Mapping[str, Any], *, ended: bool, key: int) -> bool:
        """Take one environment's step; `key` names its episode.

        Returns whether the episode will have labels, as far as is known.
        """
        steps = self._running[env]
        before, after = info.get("signals_before"), info.get("signals")
        if before is not None and after is not None:
            row = {name: before[name] for name in _NAMES}
            steps.append(row | {name: after[name] for name in _COMMANDS})
        if not ended:
            return True
        whole = bool(steps) and after is not None
        if whole and after is not None:
            steps.append({name: after[name] for name in _NAMES})
            self._ended.append((key, steps))
        else:
            self.unlabelled_episodes += 1
        self._running[env] = []
        return whole

    def forget(self) -> None:
        """Forget the episodes under way: they stay unlabelled."""
        self.unlabelled_episodes += sum(bool(steps) for steps in self._running)
        self._running = [[] for _ in self._running]

    def label(self, *, all_of_them: bool = False) -> list[Labelled]:
        """Label the ended episodes, once enough wait to be worth a query."""
        waiting = self._ended
        if not waiting or (len(waiting) < self._worth_a_query and not all_of_them):
            return []
        self._ended = []
        rows = [row for _, steps in waiting for row in steps]
        lengths = [len(steps) for _, steps in waiting]
        columns: dict[str, Any] = {
            "episode_index": np.repeat(np.arange(len(lengths)), lengths),
            "step_index": np.concatenate([np.arange(length) for length in lengths]),
        }
        signals = {
            signal.name: np.array([row[signal.name] for row in rows], signal.dtype)
            for signal in STORED_SIGNALS
        }
        columns |= signal_arrays(signals)
        held = label(pa.table(columns), self.conditions)
        codes = np.array([self._codes[n] for n in primary(held, self.conditions)], np.int64)
        if not self.conditions:
            codes = np.zeros(len(rows), np.int64)
        labelled, begin = [], 0
        for (key, _), length in zip(waiting, lengths, strict=True):
            inside = slice(begin, begin + length - 1)  # the last step is no transition
            begin += length
            names = [name for name, steps in held.items() if steps[inside].any()]
            labelled.append(Labelled(key, codes[inside], names))
        return labelled
