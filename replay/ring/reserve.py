"""Which slots of a ring new rows go to: the oldest's, or those of conditions with rows to spare."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from restock.errors import MixtureError
from restock.replay.mixture.packed_row import Ints
from restock.replay.ring.slots import NONE, StratumSlots

_VICTIMS = 1024  # slots to be overwritten that are chosen at a time


class Reserve:
    """Hands out the slots of a ring of `capacity` rows.

    Args:
        strata: which slots belong to which condition; kept by the ring.
        conditions: their names.
        reserved: rows of a condition that others' rows do not overwrite, by its name.

    Raises:
        MixtureError: rows reserved for no condition, or more than the ring holds.
    """

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
        over = max(self.appended + count - self.capacity, 0)
        if over and self.rows.any():
            over = min(over, count)
            if len(self._victims) < over:
                self._choose(over)
            victims, self._victims = self._victims[:over], self._victims[over:]
            slots = np.concatenate([self.appended + np.arange(count - over), victims])
        else:
            slots = (self.appended + np.arange(count)) % self.capacity
        if over and len(self.rows):
            self._strata.move(slots, NONE)
        self._serial[slots] = self.appended + np.arange(count)
        self.appended += count
        return slots

    def _choose(self, at_least: int) -> None:
        """The slots to overwrite next: the oldest of conditions above their reserve.

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

    def state_dict(self) -> dict[str, Any]:
        """Arrays and JSON values."""
        filled = min(self.appended, self.capacity)
        return {
            "appended": self.appended,
            "reserved": self.rows.copy(),
            "serial": self._serial[:filled].copy(),
            "victims": self._victims.copy(),
        }

    def load_state_dict(self, state: Mapping[str, Any], strata: StratumSlots) -> None:
        """Raises MixtureError when other rows were reserved."""
        if not np.array_equal(state["reserved"], self.rows):
            raise MixtureError(
                f"the saved ring reserved {np.asarray(state['reserved']).tolist()} rows of its"
                f" conditions, not {self.rows.tolist()}",
                remedy="resume with the settings the run began with",
            )
        self._strata = strata
        self.appended = int(state["appended"])
        self._serial[: len(state["serial"])] = state["serial"]
        self._victims = np.array(state["victims"], np.int64)
