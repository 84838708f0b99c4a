"""Keep labelled episodes of the twin: labels for sampled rows, and steps for a store.

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

from restock.arrays import F32, Bools, Ints
from restock.state import Stateful, saved
from restock.train.run import checkpoint

if TYPE_CHECKING:
    from restock.train.feed.collector import EndedEpisode


import hashlib
import uuid

import pyarrow as pa

from restock.errors import RunError
from restock.ingest.profile.profile import Profile
from restock.ingest.store.manifest import definitions, label_scores, manifest_row, software_version
from restock.ingest.store.transitions import (
    EpisodeRows,
    Provenance,
    TransitionValues,
    label_table,
    transition_table,
)
from restock.ingest.store.writer import StoreWriter
from restock.ingest.task.conditions import label, probabilities, reported, runnable
from restock.ingest.task.schema import SIGNAL_COLUMNS, Perturbed, recording_schema
from restock.train.run.run import now_ns

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
    """A log of N environments' episodes: one file in `folder` per batch of labelled episodes.

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
        """Keep ended episodes; `labels` are of their steps, (steps + 1) each, concatenated."""
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
        """Remove files written since the checkpoint: their steps will be made again."""
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
    """Yield every kept episode, in order.

    Raises:
        RunError: a file is damaged, or of an earlier Restock.
    """
    files = map(checkpoint.load, episode_files(folder))
    return [FreshEpisode(**episode) for file in files for episode in file.values()]


Entries = list[tuple[str, float]]


WAITING, NEVER = -1, -2  # codes of a row without a condition: its episode has not ended; unknown


class EpisodeLabels(Stateful):
    """Conditions and strata of ended episodes since the last `clear`, by the ring's key."""

    STATE: ClassVar[tuple[str, ...]] = ("_keys", "_codes", "_given_up")

    def __init__(self) -> None:
        self._keys: list[int] = []
        self._codes: list[NDArray[np.int16]] = []  # (2, T) of each: conditions and strata
        self._given_up: list[int] = []  # keys

    def note(self, key: int, codes: NDArray[Any], strata: NDArray[Any] | None = None) -> None:
        """Keep the labels of ended episode `key`.

        `codes[t]` (T,) is the condition of its step t, `strata[t]` its stratum; None: as the
        condition.
        """
        self._keys.append(int(key))
        both = (codes, codes if strata is None else strata)
        self._codes.append(np.asarray(np.stack(both), np.int16))

    def give_up(self, key: int) -> None:
        """Mark episode `key` as one that will never have labels."""
        self._given_up.append(int(key))

    def clear(self) -> None:
        """Forget the labels: rows that are drawn from now on have them."""
        self._keys, self._codes = [], []

    def restored(self) -> None:
        self._codes = [np.asarray(codes, np.int16) for codes in self._codes]

    def fill(
        self, condition: NDArray[Any], stratum: NDArray[Any], key: Ints, step: NDArray[Any]
    ) -> None:
        """Fill in conditions and strata of WAITING rows (n,) that have labels by now."""
        waiting = np.flatnonzero(condition == WAITING)
        if self._given_up:
            lost = np.isin(key[waiting], self._given_up)
            condition[waiting[lost]] = NEVER
            waiting = waiting[~lost]
        if not len(waiting) or not self._keys:
            return
        order = np.argsort(self._keys)
        keys = np.array(self._keys, np.int64)[order]
        codes = [self._codes[at] for at in order.tolist()]
        lengths = np.array([of_episode.shape[1] for of_episode in codes])
        begins, flat = np.cumsum(lengths) - lengths, np.concatenate(codes, axis=1)
        place = np.minimum(np.searchsorted(keys, key[waiting]), len(keys) - 1)
        at = step[waiting].astype(np.int64)
        known = (keys[place] == key[waiting]) & (at < lengths[place])
        found = flat[:, begins[place[known]] + at[known]]
        condition[waiting[known]], stratum[waiting[known]] = found


class FreshPerturbations(Stateful):
    """Perturbation names and values by the ring's episode key, for the audit of sampled rows."""

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


FORMAT = "twin"
AGENT = "dqn"  # who drove
_MOVED = ("stamp_ns", "pose_stamp_ns")  # episodes begin at 0: laid out one after the other


@dataclass(frozen=True)
class Flushed:
    """The result of a flush into a store."""

    recording_id: str
    status: str  # written | unchanged
    episodes: int
    transitions: int
    version: int | None  # of the store's transitions, if they were written


def flush(run: Path, store: StoreWriter, profile: Profile, dropped_steps: int = 0) -> Flushed:
    """Write the episodes that a run kept in its folder `fresh` as one recording.

    Its id is a hash of what is in it: the same episodes are there once, however often they are
    flushed, and a run that collected more since is another recording.

    Raises:
        RunError: the run kept no episode.
        StoreError: the store cannot be written.
    """
    episodes = read_episodes(run / "fresh")
    if not episodes:
        raise RunError(
            "kept no finished episode to flush",
            where=str(run),
            remedy="give --flush-fresh when the run starts: episodes are kept only from then on",
        )
    recording_id = _content_id(episodes)
    count = sum(episode.count for episode in episodes)
    for row in store.live(recording_id).to_pylist():
        if all(row[name] == value for name, value in definitions(profile).items()):
            return Flushed(recording_id, "unchanged", len(episodes), count, None)
    provenance = Provenance(recording_id, uuid.uuid4().hex[:16], str(run), software_version())
    rows = _lay_out(episodes, profile)
    values = _values(rows, episodes, profile, run.name)
    table = transition_table(profile, rows, values, provenance)
    manifest = _manifest(rows, table, profile, provenance, dropped_steps)
    version = store.write(pa.Table.from_pylist([manifest], recording_schema()), table)
    return Flushed(recording_id, "written", len(episodes), len(table), version)


def _content_id(episodes: Sequence[FreshEpisode]) -> str:
    digest = hashlib.blake2b(digest_size=8)
    for episode in episodes:
        for name in ("observation", "action", "reward", "probability"):
            digest.update(np.ascontiguousarray(getattr(episode, name)).tobytes())
        for name in sorted(episode.signals):
            digest.update(np.ascontiguousarray(episode.signals[name]).tobytes())
    return digest.hexdigest()


def _lay_out(episodes: Sequence[FreshEpisode], profile: Profile) -> EpisodeRows:
    """Concatenate all steps, as if one robot had driven the episodes in turn."""
    lengths = np.array([episode.count + 1 for episode in episodes], np.int64)
    first = np.concatenate([[0], np.cumsum(lengths)])[:-1].astype(np.int64)
    tick = np.arange(lengths.sum(), dtype=np.int64)
    step = tick - np.repeat(first, lengths)
    signals = {
        column.name: np.concatenate([episode.signals[column.name] for episode in episodes])
        for column in SIGNAL_COLUMNS
    }
    period_ns = round(profile.task.control_period_s * 1e9)
    for name in _MOVED:
        signals[name] = signals[name] + np.repeat(first, lengths) * period_ns
    labels = {
        name: np.concatenate([episode.labels[name] for episode in episodes])
        for name in episodes[0].labels
    }
    number = np.repeat(np.arange(len(episodes), dtype=np.int64), lengths)
    is_end = step == np.repeat(lengths, lengths) - 1
    evaluated = [condition for condition in profile.conditions if condition.name in labels]
    steps = label_table(signals, number, step, pa.table({}))
    probable = probabilities(steps, evaluated)
    situations = reported(profile.exposures, lidar=profile.task.lidar)
    exposures = label(steps, runnable(steps, situations))
    return EpisodeRows(
        tick, number, step, is_end, signals, labels, pa.table({}), probable, exposures
    )


def _values(
    rows: EpisodeRows, episodes: Sequence[FreshEpisode], profile: Profile, run: str
) -> TransitionValues:
    """Concatenate the values that were kept of each step."""
    begin = rows.starts
    number = rows.episode[begin]
    version = [f"{run}@{episode.version}" for episode in episodes]

    def each(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(episode, name) for episode in episodes])

    return TransitionValues(
        observation=each("observation"),
        action=each("action"),
        reward=each("reward"),
        progress_m=each("progress_m"),
        residual=np.zeros(len(begin)),  # the action is the command
        terminates=np.array([episode.terminated for episode in episodes])[number],
        zone=_zones(rows, episodes, profile)[begin].tolist(),
        truth=each("truth").tolist(),
        true_exposure=[reported or None for reported in each("exposure").tolist()],
        policy=[AGENT] * len(number),
        policy_version=[version[episode] for episode in number],
        probability=each("probability"),
        perturbation=_perturbed(episodes).columns(number),
        goal_source="logged" if profile.goal_source else None,  # the twin orders its goals
    )


def _zones(
    rows: EpisodeRows, episodes: Sequence[FreshEpisode], profile: Profile
) -> NDArray[np.object_]:
    """Return the zone of every step: the profile's on the floor it describes, else the layout's."""
    names = profile.zone_of(rows.signals["pose_x_m"], rows.signals["pose_y_m"])
    zones = np.array(names, object)
    for number, episode in enumerate(episodes):
        if episode.zones is not None:
            zones[rows.episode == number] = episode.zones
    return zones


def _perturbed(episodes: Sequence[FreshEpisode]) -> Perturbed:
    """Return the perturbation of each episode."""
    known = [
        (episode.perturbation, json.loads(episode.perturbation_values)) for episode in episodes
    ]
    return Perturbed(known, np.arange(len(known), dtype=np.int64))


def _manifest(
    rows: EpisodeRows, table: pa.Table, profile: Profile, provenance: Provenance, dropped_steps: int
) -> dict[str, Any]:
    """Make the row of `recordings`; its log times end now."""
    stamps = rows.signals["stamp_ns"]
    return manifest_row(
        profile,
        provenance,
        table,
        label_scores(table, rows.labels, profile.task.control_period_s),
        {"physics blew up": dropped_steps} if dropped_steps else {},
        format=FORMAT,
        integrity="verified",
        duration_s=float(stamps[-1] - stamps[0]) * 1e-9,
        start_stamp_ns=int(stamps[0]),
        end_stamp_ns=int(stamps[-1]),
        clock="simulated",
        clock_offset_ns=now_ns() - int(stamps[-1]),
        clock_jumps=0,
        ticks=len(rows.tick) + dropped_steps,
        steps=len(rows.tick),
        episodes=int(rows.is_end.sum()),
        episode_ends=int(rows.is_end.sum()),
    )
