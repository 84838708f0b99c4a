"""The steps of episodes laid out one after the other, with their labels: what rows are made of."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa

from restock.arrays import F32, Bools, Ints
from restock.ingest.profile.profile import Profile
from restock.ingest.steps.episodes import Split, Steps, changed_route, with_route
from restock.ingest.store.summary import ENDS
from restock.ingest.task.conditions import label_with_probabilities, reported
from restock.ingest.task.schema import signal_columns
from restock.ingest.task.signals import Signals

GROUP_ROWS = 8192  # of whole episodes that are worked out together: bounds memory


@dataclass(frozen=True)
class EpisodeRows:
    """The steps of all episodes, one after the other: R rows, the last of each only an end."""

    tick: Ints  # (R,)
    episode: Ints  # (R,) index of the episode
    step: Ints  # (R,) in its episode, from 0
    is_end: Bools  # (R,)
    signals: Signals  # leading axis R, as the row's episode sees them
    labels: dict[str, Bools]  # condition that can be told -> (R,)
    custom: pa.Table  # (R,) the profile's own signals
    probabilities: dict[str, F32]  # condition that has a rule for it -> (R,); NaN: not known
    exposures: dict[str, Bools]  # as `labels`

    @property
    def starts(self) -> Ints:
        """The rows that begin a transition, (N,); each one's successor is the row after it."""
        return np.flatnonzero(~self.is_end)

    def ends_table(self) -> pa.Table:
        """The ends of the episodes, as `label_table` has them."""
        ends = np.flatnonzero(self.is_end)
        signals = {name: column[ends] for name, column in self.signals.items()}
        custom = self.custom.take(pa.array(ends))
        return label_table(signals, self.episode[ends], self.step[ends], custom)

    def without_signals(self) -> EpisodeRows:
        """The same steps and labels; their signals, which take most of the memory, gone."""
        return replace(self, signals={}, custom=self.custom.select([]))

    @classmethod
    def join(cls, parts: Sequence[EpisodeRows]) -> EpisodeRows:
        """Steps of several groups of episodes, without their signals."""
        none: Signals = {}
        labels, exposures = (
            {name: np.concatenate([getattr(p, kind)[name] for p in parts]) for name in first}
            for kind, first in (("labels", parts[0].labels), ("exposures", parts[0].exposures))
        )
        return cls(
            np.concatenate([part.tick for part in parts]),
            np.concatenate([part.episode for part in parts]),
            np.concatenate([part.step for part in parts]),
            np.concatenate([part.is_end for part in parts]),
            none,
            labels,
            parts[0].custom.select([]),
            {
                name: np.concatenate([part.probabilities[name] for part in parts])
                for name in parts[0].probabilities
            },
            exposures,
        )


def groups(episodes: Split) -> Iterator[range]:
    """The episodes by their numbers, some GROUP_ROWS steps at a time."""
    first = count = 0
    for number, episode in enumerate(episodes.episodes):
        count += episode.last - episode.first + 1
        if count >= GROUP_ROWS:
            yield range(first, number + 1)
            first, count = number + 1, 0
    if count or not episodes.episodes:
        yield range(first, len(episodes.episodes))


def episode_rows(
    profile: Profile, steps: Steps, episodes: Split, group: range | None = None
) -> EpisodeRows:
    """Lay the steps of these episodes (None: of all) out, with their own route, and label them."""
    group = range(len(episodes.episodes)) if group is None else group
    chosen = [episodes.episodes[number] for number in group]
    lengths = np.array([e.last - e.first + 1 for e in chosen], np.int64)
    start = np.concatenate([[0], np.cumsum(lengths)])[:-1]
    step = np.arange(lengths.sum(), dtype=np.int64) - np.repeat(start, lengths)
    tick = step + np.repeat(np.array([e.first for e in chosen], np.int64), lengths)
    is_end = step == np.repeat(lengths, lengths) - 1
    episode = np.repeat(np.arange(group.start, group.stop, dtype=np.int64), lengths)
    signals = {name: column[tick] for name, column in steps.signals.items()}
    # A tick that ends one episode and begins the next is seen with each one's own route.
    old = np.flatnonzero(is_end & np.isin(tick, changed_route(steps)))
    if len(old):
        before, routing = tick[old] - 1, steps.routing
        seen = with_route(
            profile.task, steps, tick[old], routing.goal[before], routing.plan[before]
        )
        for name, column in seen.items():
            signals[name][old] = column
    custom = steps.custom.take(tick)
    table = label_table(signals, episode, step, custom)
    lidar, driven_plan = profile.task.lidar, profile.goal_source == "hindsight"
    conditions, situations = (
        reported(several, lidar=lidar, driven_plan=driven_plan)
        for several in (profile.conditions, profile.exposures)
    )
    held, probable = label_with_probabilities(table, [*conditions, *situations])
    labels, exposures = (
        {condition.name: held[condition.name] for condition in several}
        for several in (conditions, situations)
    )
    return EpisodeRows(tick, episode, step, is_end, signals, labels, custom, probable, exposures)


def label_table(signals: Signals, episode: Ints, step: Ints, custom: pa.Table) -> pa.Table:
    """The steps as conditions see them: stored signals and custom ones, as they are stored."""
    columns = signal_columns(signals)
    columns |= dict(zip(custom.column_names, custom.columns, strict=True))
    return pa.table({"episode_index": episode, "step_index": step, **columns})


def episode_ends(table: pa.Table) -> pa.Table | None:
    """The steps that only end an episode, as conditions see them, of a recording's rows.

    They are no transitions, but conditions that look ahead see them; they lie in the rows'
    metadata (and so in that of their Parquet file). None where the rows carry none.
    """
    packed = (table.schema.metadata or {}).get(ENDS)
    if packed is None:
        return None
    return pa.ipc.open_stream(base64.b64decode(packed)).read_all()


def packed(table: pa.Table) -> bytes:
    """A table of episode ends as metadata holds it."""
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema) as writer:
        writer.write_table(table)
    return base64.b64encode(sink.getvalue())
