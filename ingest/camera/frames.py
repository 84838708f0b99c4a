"""The frames of one camera in a recording: which are kept, and what became of the others."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from restock.arrays import Bools, Ints
from restock.ingest.camera.frame_columns import PROBLEM
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.profile.camera import Camera

NS = 1_000_000_000
OFF_CLOCK = "its stamp does not fit the clock"
MAX_REASONS = 20  # a file may give another one with each message


@dataclass(frozen=True)
class CameraFrames:
    """A camera's N messages, and the frame in force at each of T ticks."""

    camera: Camera
    columns: TopicColumns  # what its images are: `frame_columns`
    stamp_ns: Ints  # (N,) on the alignment clock; -1 where it is off it
    usable: Bools  # (N,) an image, on the clock, and not thinned out
    at_tick: Ints  # (T,) the last usable frame received and not too old, or -1

    @property
    def problems(self) -> Counter[str]:
        """Messages without an image that can be kept, by why."""
        words = np.asarray(self.columns.fields[PROBLEM], object)
        off = (words == "") & (self.stamp_ns < 0)
        counted = Counter([word for word in words if word])
        most = Counter(dict(counted.most_common(MAX_REASONS)))
        rest = {"other problems": counted.total() - most.total(), OFF_CLOCK: int(off.sum())}
        return most + Counter(rest)

    def in_force(self, ticks: Ints) -> tuple[Ints, Ints, Ints]:
        """The frames in force at some of these ticks, in their order, and the first and the last
        tick (of all) at which each is: (K,) each."""
        at = self.at_tick[ticks]
        seen = at >= 0
        frames, which = np.unique(at[seen], return_inverse=True)
        first = np.full(len(frames), np.iinfo(np.int64).max)
        last = np.full(len(frames), -1)
        np.minimum.at(first, which, ticks[seen])
        np.maximum.at(last, which, ticks[seen])
        return frames, first, last

    def account(self, kept: int, steps: int) -> dict[str, Any]:
        """What became of its decoded messages: they are the sum of all counts but `steps`."""
        problems = self.problems
        usable, decoded = int(self.usable.sum()), len(self.columns)
        return {
            "decoded": decoded,
            "kept": kept,
            "thinned": decoded - usable - problems.total(),
            "unused": usable - kept,
            "problems": [{"reason": why, "count": n} for why, n in problems.most_common()],
            "steps": steps,
        }


def usable_frames(columns: TopicColumns, row: Ints, stamp_ns: Ints, max_hz: float | None) -> Bools:
    """(S,) which of these messages, in the order of their stamps, are frames to keep: with
    `max_hz`, the first in each 1 / max_hz seconds of the alignment clock."""
    problem = np.asarray(columns.fields[PROBLEM], object)[row]
    usable = np.asarray((problem == "") & (stamp_ns >= 0), np.bool_)
    if max_hz is not None:
        fine = np.flatnonzero(usable)
        bins = stamp_ns[fine] // max(round(NS / max_hz), 1)
        usable[fine[1:]] = bins[1:] != bins[:-1]
    return usable
