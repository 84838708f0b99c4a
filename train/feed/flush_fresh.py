"""Episodes of the twin as a recording of a store: transition rows, a manifest row, one commit."""

from __future__ import annotations

import hashlib
import json
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.errors import RunError
from restock.ingest.profile.profile import Profile
from restock.ingest.store.episode_rows import EpisodeRows, label_table
from restock.ingest.store.manifest import definitions, manifest_row, software_version
from restock.ingest.store.transitions import Provenance, TransitionValues, transition_table
from restock.ingest.store.writer import StoreWriter
from restock.ingest.task.conditions import label, probabilities, reported, runnable
from restock.ingest.task.label_scores import label_scores
from restock.ingest.task.perturbation_columns import Perturbed
from restock.ingest.task.schema import SIGNAL_COLUMNS, recording_schema
from restock.train.feed.fresh_log import FreshEpisode, read_episodes
from restock.train.run.run import now_ns

FORMAT = "twin"
AGENT = "dqn"  # who drove
_MOVED = ("stamp_ns", "pose_stamp_ns")  # episodes begin at 0: laid out one after the other


@dataclass(frozen=True)
class Flushed:
    """What a flush put in a store."""

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
    """Lay all steps one after the other, as if one robot had driven the episodes in turn."""
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
    """Collect the values that were kept of each step, end to end."""
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
    """Make the row of `recordings`, with log times such that the last step was just now."""
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
