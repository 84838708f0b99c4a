"""Which slots of a ring belong to which stratum, while slots come and go."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from restock.replay.mixture.packed_row import Ints

NONE = -1


class StratumSlots:
    """Slots (0..capacity - 1) in disjoint strata, with constant-time moves and uniform draws.

    A slot that leaves its stratum is replaced by the stratum's last one, so members stay dense.
    """

    def __init__(self, capacity: int, strata: int) -> None:
        self.stratum: NDArray[np.int16] = np.full(capacity, NONE, np.int16)
        self._place = np.zeros(capacity, np.int64)  # of a slot among its stratum's members
        self._members = [np.empty(64, np.int64) for _ in range(strata)]
        self.counts: Ints = np.zeros(strata, np.int64)

    def move(self, slots: Ints, stratum: int) -> None:
        """Put distinct slots (n,) into a stratum, or into none (-1)."""
        if stratum != NONE and (self.stratum[slots] == NONE).all():
            self._add_all(slots, stratum)  # as when an episode's labels come
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
        """The slots of a stratum, (counts[stratum],), in no meaningful order."""
        return self._members[stratum][: self.counts[stratum]]

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
