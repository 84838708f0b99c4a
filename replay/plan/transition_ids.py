"""Transition ids in the order of a plan's rows: whether one is there twice, and where each is."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from restock.arrays import Ints

STRETCH = 1 << 18  # of values in memory at a time


def stretches(rows: int) -> Iterator[tuple[int, int]]:
    """Begin and end of stretches of so many rows."""
    for begin in range(0, rows, STRETCH):
        yield begin, min(begin + STRETCH, rows)


class Places:
    """Finds ids (N,) in their order: they rise within each recording, so runs are searched.

    Where the runs of two recordings overlap (ids that `restock ingest` did not give), the ids are
    sorted in memory.
    """

    def __init__(self, ids: Ints) -> None:
        self._ids = ids
        self._order: Ints | None = None
        starts = [0]
        for begin, end in stretches(len(ids) - 1):
            falls = np.flatnonzero(ids[begin + 1 : end + 1] <= ids[begin:end]) + begin + 1
            starts += falls.tolist()
        begins = np.array(starts, np.int64)
        ends = np.append(begins[1:], len(ids))
        order = np.argsort(ids[begins])
        self._begins, self._ends = begins[order], ends[order]
        self._first = ids[self._begins]
        if (ids[self._ends - 1][:-1] >= self._first[1:]).any():
            self._order = np.argsort(ids, kind="stable")
            self._ids = ids[self._order]
            self._begins, self._ends = np.array([0]), np.array([len(ids)])
            self._first = self._ids[:1]

    @property
    def twice(self) -> int:
        """Count the ids that occurred before."""
        if self._order is None:  # each run rises, and ends before the next begins
            return 0
        return int((self._ids[1:] == self._ids[:-1]).sum())

    def of(self, ids: Ints) -> Ints:
        """Return the place of each of these ids (n,); -1 of one that is not there."""
        place = np.empty(len(ids), np.int64)
        run = np.maximum(np.searchsorted(self._first, ids, "right") - 1, 0)
        # Ids that come together are mostly of one run.
        cuts = np.flatnonzero(run[1:] != run[:-1]) + 1
        if len(cuts) > len(self._first):  # they come in no order: each run is searched once
            order = np.argsort(run, kind="stable")
            place[order] = self.of(ids[order])
            return place
        for begin, end in zip([0, *cuts.tolist()], [*cuts.tolist(), len(ids)], strict=True):
            if begin < end:
                here = slice(int(self._begins[run[begin]]), int(self._ends[run[begin]]))
                place[begin:end] = here.start + np.searchsorted(self._ids[here], ids[begin:end])
        place = np.minimum(place, len(self._ids) - 1)
        there = self._ids[place] == ids
        return np.where(there, place if self._order is None else self._order[place], -1)
