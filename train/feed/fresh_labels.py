"""Label the fresh rows that a run has sampled: conditions, strata and perturbations by episode.

Conditions look ahead, so a row's labels are known once its episode has ended. The ring may have
overwritten the row by then, but the record of sampled rows still needs its labels.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from restock.arrays import Ints
from restock.state import Stateful

Entries = list[tuple[str, float]]
WAITING, NEVER = -1, -2  # codes of rows without a condition yet, and of rows that never get one


class EpisodeLabels(Stateful):
    """Conditions and strata of episodes that ended since the last `clear`, by the ring's key."""

    STATE: ClassVar[tuple[str, ...]] = ("_keys", "_codes", "_given_up")

    def __init__(self) -> None:
        self._keys: list[int] = []
        self._codes: list[NDArray[np.int16]] = []  # (2, T) per episode: conditions and strata
        self._given_up: list[int] = []  # keys of episodes that never get labels

    def note(self, key: int, codes: NDArray[Any], strata: NDArray[Any] | None = None) -> None:
        """Keep the labels of ended episode `key`.

        `codes[t]` is the condition of step t, `strata[t]` its stratum; both are (T,). Without
        `strata`, the conditions serve as strata.
        """
        self._keys.append(int(key))
        both = (codes, codes if strata is None else strata)
        self._codes.append(np.asarray(np.stack(both), np.int16))

    def give_up(self, key: int) -> None:
        """Mark episode `key` as one that will never have labels."""
        self._given_up.append(int(key))

    def clear(self) -> None:
        """Forget the labels; rows that are drawn from now on get theirs from the ring."""
        self._keys, self._codes = [], []

    def restored(self) -> None:
        self._codes = [np.asarray(codes, np.int16) for codes in self._codes]

    def fill(
        self, condition: NDArray[Any], stratum: NDArray[Any], key: Ints, step: NDArray[Any]
    ) -> None:
        """Fill in conditions and strata (n,) of WAITING rows whose labels are known by now."""
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
        self._of: dict[int, tuple[str, str]] = {}  # key -> name, values as JSON

    def note(self, keys: NDArray[np.int64], names: Sequence[str], values: Sequence[str]) -> None:
        """Keep the names and values in force in the running episodes `keys` (N,)."""
        for place, key in enumerate(keys.tolist()):
            if key not in self._of:
                self._of[key] = str(names[place]), str(values[place])

    def forget(self, kept: NDArray[np.int64]) -> None:
        """Forget episodes without a row: `kept` (n,) are the keys of the ring's rows."""
        if len(self._of) > len(kept) + 1:  # more entries than rows: some have no row
            alive = set(np.unique(kept).tolist())
            self._of = {key: entry for key, entry in self._of.items() if key in alive}

    def names(self, keys: NDArray[np.int64]) -> list[str | None]:
        """Return the name of each episode's perturbation; None if unknown."""
        return [entry[0] if (entry := self._of.get(key)) else None for key in keys.tolist()]

    def values(self, keys: NDArray[np.int64]) -> list[Entries | None]:
        """Return each episode's perturbed values, as (name, value) entries; None if unknown."""
        return [
            values_entries(entry[1]) if (entry := self._of.get(key)) else None
            for key in keys.tolist()
        ]


def values_entries(values: str) -> Entries:
    """Return a JSON object of numbers as (name, value) entries, for a column of Arrow maps."""
    return [(field, float(value)) for field, value in json.loads(values).items()]
