"""Which slot of a ring holds what: the strata of slots, and which slot a new row goes to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from restock.arrays import Ints
from restock.errors import MixtureError
from restock.state import Stateful

NONE = -1
_VICTIMS = 1024  # slots to be overwritten that are chosen at a time


class StratumSlots(Stateful):
    """Slots (0..capacity - 1) in disjoint strata, with constant-time moves and uniform draws.

    A slot that leaves its stratum is replaced by the stratum's last one, so members stay dense.
    """

    # Draws within a stratum depend on the order of its members, so the order is kept.
    STATE: ClassVar[tuple[str, ...]] = ("_slots",)

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
        """Return the slots of a stratum, (counts[stratum],), in no meaningful order."""
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
    """Hands out the slots of a ring of `capacity` rows.

    Args:
        strata: which slots belong to which condition; kept by the ring.
        conditions: their names.
        reserved: rows of a condition that others' rows do not overwrite, by its name.

    Raises:
        MixtureError: rows reserved for no condition, or more than the ring holds.
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
        self.appended = 0  # rows ever appended
        self._serial: Ints = np.full(capacity, -1, np.int64)  # of the row in each slot, by age
        self._victims: Ints = np.empty(0, np.int64)  # slots that are overwritten next

    def take(self, count: int) -> Ints:
        """Slots (count,) for new rows; those that held others belong to no condition any more."""
        beyond = max(self.appended + count - self.capacity, 0)
        if beyond and self.rows.any():
            beyond = min(beyond, count)
            if len(self._victims) < beyond:
                self._choose(beyond)
            victims, self._victims = self._victims[:beyond], self._victims[beyond:]
            slots = np.concatenate([self.appended + np.arange(count - beyond), victims])
        else:
            slots = (self.appended + np.arange(count)) % self.capacity
        if beyond and len(self.rows):
            self._strata.move(slots, NONE)
        self._serial[slots] = self.appended + np.arange(count)
        self.appended += count
        return slots

    def _choose(self, at_least: int) -> None:
        """Choose the slots to overwrite next: the oldest of conditions above their reserve.

        If those do not suffice, for example before the first episode ends, add the oldest
        unlabelled ones. If all that the ring holds is reserved, add the oldest of all.

        Where those do not suffice, as while no episode has ended, also the oldest without a label,
        and where all that the ring holds is reserved, the oldest of all.
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
        """Return the error for a saved state that reserved other rows."""
        saved = None if value is None else np.asarray(value).tolist()
        return MixtureError(
            f"the saved ring reserved {saved} rows of its conditions, not {self.rows.tolist()}",
            remedy="resume with the settings the run began with",
        )
