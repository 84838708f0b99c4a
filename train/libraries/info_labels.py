"""Conditions of episodes of which only the `info` of each step is seen, as in other libraries.

The twin's single environment gives the signals at t and at t + 1 with every step, so an episode
that ended is labelled by the very conditions, over the very signals, that label logs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.ingest.task.conditions import NOMINAL, Condition, label, primary
from restock.ingest.task.signals import STORED_SIGNALS

EPISODES_PER_QUERY = 8  # at most: as many as there are environments
_COMMANDS = ("command_speed_mps", "command_yaw_rate_radps")
_NAMES = tuple(signal.name for signal in STORED_SIGNALS)


@dataclass(frozen=True)
class Labelled:
    """An episode's labels: the code of each step's condition, nominal last."""

    key: int
    codes: NDArray[np.int64]  # (T,)
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

    def step(self, env: int, info: Mapping[str, Any], *, ended: bool, key: int) -> None:
        """Take one environment's step; `key` names its episode."""
        steps = self._running[env]
        before, after = info.get("signals_before"), info.get("signals")
        if before is not None and after is not None:
            row = {name: before[name] for name in _NAMES}
            steps.append(row | {name: after[name] for name in _COMMANDS})
        if not ended:
            return
        if steps and after is not None:
            steps.append({name: after[name] for name in _NAMES})
            self._ended.append((key, steps))
        else:
            self.unlabelled_episodes += 1
        self._running[env] = []

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
        for signal in STORED_SIGNALS:
            columns[signal.name] = np.array([row[signal.name] for row in rows], signal.dtype)
        held = label(pa.table(columns), self.conditions)
        codes = np.array([self._codes[n] for n in primary(held, self.conditions)], np.int64)
        if not self.conditions:
            codes = np.zeros(len(rows), np.int64)
        found, begin = [], 0
        for (key, _), length in zip(waiting, lengths, strict=True):
            inside = slice(begin, begin + length - 1)  # the last step is no transition
            begin += length
            names = [name for name, steps in held.items() if steps[inside].any()]
            found.append(Labelled(key, codes[inside], names))
        return found
