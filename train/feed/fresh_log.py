"""Whole labelled episodes of the twin, kept to be put in a store like logs.

The ring keeps packed n-step rows and forgets the oldest. Here every labelled episode is kept in the
run's directory, steps and signals, until `restock train --flush-fresh STORE` writes them as one
recording of format `twin`: the same columns, labels and provenance as a robot's log.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F32, Bools
from restock.state import Stateful, saved
from restock.train.run import checkpoint

if TYPE_CHECKING:
    from restock.train.feed.collector import EndedEpisode

_STEP = ("action", "probability", "reward", "progress_m", "truth", "exposure")
_KINDS = {"action": "i2", "truth": "<U64", "exposure": "<U64"}


@dataclass(frozen=True)
class FreshEpisode:
    """A kept episode of T steps: T + 1 observations, and no action in the last one."""

    count: int  # T
    terminated: bool
    version: int  # gradient step of the policy at its begin
    perturbation: str
    perturbation_values: str  # JSON: those that are not nominal
    layout: str
    zones: Sequence[str] | None  # (T + 1,) on its layout; None: what the profile says
    observation: F32  # (T + 1, D)
    action: NDArray[np.int16]  # (T,)
    probability: F32  # (T,)
    reward: F32  # (T,)
    progress_m: F32  # (T,)
    truth: NDArray[np.str_]  # (T,) the true conditions
    exposure: NDArray[np.str_]  # (T,) the true exposures; empty if the twin does not say
    signals: Mapping[str, NDArray[Any]] = field(default_factory=dict)  # (T + 1,) each
    labels: Mapping[str, Bools] = field(default_factory=dict)  # (T + 1,) each


class FreshLog(Stateful):
    """Keeps episodes of N environments: writes one file to `folder` per batch of labelled episodes.

    Args:
        longest: steps of an episode at most.
        begun: (N,) steps that the episodes under way already have: those are not kept, unless a
            checkpoint brings their beginning.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "_whole",
        "_version",
        "_observation",
        "_steps",
        "_waiting",
        "parts",
        "dropped_steps",
    )

    def __init__(
        self, folder: Path, observation_size: int, longest: int, begun: NDArray[np.int64]
    ) -> None:
        self.folder = folder
        count = len(begun)
        self._whole: Bools = np.asarray(begun == 0)
        self._version = np.zeros(count, np.int64)  # gradient step at the episode's begin
        self._observation = np.zeros((count, longest + 1, observation_size), np.float32)
        self._steps: dict[str, NDArray[Any]] = {
            name: np.zeros((count, longest), _KINDS.get(name, "f4")) for name in _STEP
        }
        self._waiting: dict[int, FreshEpisode] = {}  # ended, not labelled; by the ring's key
        self.parts = 0  # files written
        self.dropped_steps = 0  # whose physics blew up

    def begin_step(
        self, at: NDArray[np.int64], observation: NDArray[np.float32], version: int
    ) -> None:
        """Keep the observations (N, D) before a step, `at` (N,) in their episodes."""
        first = at == 0
        self._whole |= first
        self._version[first] = version
        self._observation[np.arange(len(at)), at] = observation

    def end_step(self, at: NDArray[np.int64], **values: NDArray[Any]) -> None:
        """Keep a step: action, probability, reward, progress_m, truth and exposure, (N,) each."""
        for name, value in values.items():
            self._steps[name][np.arange(len(at)), at] = value

    def end_episode(
        self,
        env: int,
        episode: EndedEpisode,
        last: NDArray[np.float32],
        *,
        terminated: bool,
        broken: bool,
    ) -> None:
        """End an episode with observation `last` (D,); `broken` if its physics blew up."""
        if not self._whole[env]:
            return
        count = episode.steps - int(broken)  # a step that blew up does not count
        self.dropped_steps += int(broken)
        if not count:
            return
        self._observation[env, episode.steps] = last
        of_steps: dict[str, Any] = {
            n: column[env, :count].copy() for n, column in self._steps.items()
        }
        self._waiting[episode.key] = FreshEpisode(
            count=count,
            terminated=terminated and not broken,
            version=int(self._version[env]),
            perturbation=episode.perturbation,
            perturbation_values=episode.perturbation_values,
            layout=episode.layout,
            zones=None if episode.zones is None else episode.zones[: count + 1],
            observation=self._observation[env, : count + 1].copy(),
            **of_steps,
        )

    def keep_labelled(self, episodes: Sequence[EndedEpisode], labels: Mapping[str, Bools]) -> None:
        """Keep ended episodes; `labels` are over their steps, (steps + 1) each, end to end."""
        kept: list[FreshEpisode] = []
        begin = 0
        for episode in episodes:
            if (entry := self._waiting.pop(episode.key, None)) is not None:
                steps, inside = slice(entry.count + 1), slice(begin, begin + entry.count + 1)
                signals = {name: column[steps] for name, column in episode.signals.items()}
                holds = {name: column[inside] for name, column in labels.items()}
                kept.append(replace(entry, signals=signals, labels=holds))
            begin += episode.steps + 1
        if kept:
            write_episodes(self.folder / f"{self.parts:06d}.episodes", kept)
            self.parts += 1

    def restored(self) -> None:
        """Files written since the checkpoint go: their steps come again."""
        waiting: Mapping[Any, Any] = self._waiting  # as JSON has it
        self._waiting = {int(key): FreshEpisode(**entry) for key, entry in waiting.items()}
        for path in episode_files(self.folder)[self.parts :]:
            path.unlink()


def episode_files(folder: Path) -> list[Path]:
    """List the files of a log, in order."""
    return sorted(folder.glob("*.episodes"))


def write_episodes(path: Path, episodes: Sequence[FreshEpisode]) -> None:
    """Write a file of episodes, in order."""
    checkpoint.save(path, {f"{at:06d}": saved(episode) for at, episode in enumerate(episodes)})


def read_episodes(folder: Path) -> list[FreshEpisode]:
    """Every episode kept, in order.

    Raises:
        RunError: a file is damaged, or of an earlier Restock.
    """
    files = map(checkpoint.load, episode_files(folder))
    return [FreshEpisode(**episode) for file in files for episode in file.values()]


Entries = list[tuple[str, float]]


class FreshPerturbations(Stateful):
    """Names and values by the ring's key of an episode, for the audit of sampled rows."""

    STATE: ClassVar[tuple[str, ...]] = ("_of",)
    STATE_TYPES: ClassVar[Mapping[str, Any]] = {"_of": dict[int, tuple[str, str]]}

    def __init__(self) -> None:
        self._of: dict[int, tuple[str, str]] = {}  # name, values as JSON

    def note(self, keys: NDArray[np.int64], names: Sequence[str], values: Sequence[str]) -> None:
        """Keep the names and values in force in the running episodes `keys` (N,)."""
        for place, key in enumerate(keys.tolist()):
            if key not in self._of:
                self._of[key] = str(names[place]), str(values[place])

    def forget(self, kept: NDArray[np.int64]) -> None:
        """Forget episodes without a row: `kept` (n,) are the keys of the ring's rows."""
        if len(self._of) > len(kept) + 1:  # never more than one a row
            alive = set(np.unique(kept).tolist())
            self._of = {key: entry for key, entry in self._of.items() if key in alive}

    def names(self, keys: NDArray[np.int64]) -> list[str | None]:
        """Return the name in force in each of these episodes; None if it is not known."""
        return [entry[0] if (entry := self._of.get(key)) else None for key in keys.tolist()]

    def values(self, keys: NDArray[np.int64]) -> list[Entries | None]:
        """Return the values that are not nominal, as entries of a map."""
        return [
            values_entries(entry[1]) if (entry := self._of.get(key)) else None
            for key in keys.tolist()
        ]


def values_entries(values: str) -> Entries:
    """Return a JSON object of numbers as the entries of a map column."""
    return [(field, float(value)) for field, value in json.loads(values).items()]
