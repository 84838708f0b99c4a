"""Fresh rows that wait for their episodes' end, when their conditions become known.

Some conditions look ahead, so a row of the twin has its condition only once its episode has ended;
by then it may have been drawn, and written down. An interval's fresh rows are therefore held until
every one of them has its condition, and written after that: with it, in every table.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from restock.arrays import Ints
from restock.state import Stateful

WAITING, NEVER = -1, -2  # codes of a row without a condition: its episode goes on; it is not known


class EpisodeLabels(Stateful):
    """Conditions and strata of ended episodes since the last `clear`, by the ring's key."""

    STATE: ClassVar[tuple[str, ...]] = ("_keys", "_codes", "_given_up")

    def __init__(self) -> None:
        self._keys: list[int] = []
        self._codes: list[NDArray[np.int16]] = []  # (2, T) of each: conditions and strata
        self._given_up: list[int] = []  # keys

    def note(self, key: int, codes: NDArray[Any], strata: NDArray[Any] | None = None) -> None:
        """Episode `key` ended; `codes[t]` (T,) is the condition of its step t, `strata[t]` its
        stratum; None: as the condition."""
        self._keys.append(int(key))
        both = (codes, codes if strata is None else strata)
        self._codes.append(np.asarray(np.stack(both), np.int16))

    def give_up(self, key: int) -> None:
        """No labels will come for episode `key`."""
        self._given_up.append(int(key))

    def clear(self) -> None:
        """Forget the labels: rows that are drawn from now on have them."""
        self._keys, self._codes = [], []

    def restored(self) -> None:
        self._codes = [np.asarray(codes, np.int16) for codes in self._codes]

    def fill(
        self, condition: NDArray[Any], stratum: NDArray[Any], key: Ints, step: NDArray[Any]
    ) -> None:
        """Give the rows (n,) of `condition` that are WAITING theirs, and their stratum, where they
        are known by now."""
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


@dataclass(frozen=True)
class HeldInterval:
    """The fresh rows of a closed interval.

    `rows` are columns (n,) of `sampled_rows.FRESH`; of each audited batch there are columns in
    `audits`. `open_rows` are the rows that the ring held without a condition as it was closed.
    """

    clocks: Mapping[str, int]
    phase: str
    rows: dict[str, NDArray[Any]]
    available: Ints  # (S,) labelled rows of the ring, by stratum
    open_rows: dict[str, NDArray[Any]]  # condition, stratum, episode, episode_step
    audits: Sequence[dict[str, Any]]  # columns of `audit`, with condition, key and greedy action
    quotas: Mapping[str, NDArray[Any]] | None = None  # of the batch, as `interval_tables.fed` takes

    def fill(self, labels: EpisodeLabels) -> None:
        """Conditions that are known by now."""
        for part in (self.rows, self.open_rows):
            labels.fill(part["condition"], part["stratum"], part["episode"], part["episode_step"])
        for audit in self.audits:
            labels.fill(
                audit["condition"], audit["of_stratum"], audit["key"], audit["episode_step"]
            )

    @property
    def waits(self) -> bool:
        """Whether a row has no condition yet, and may get one."""
        parts = (self.rows, self.open_rows)
        return any((part["condition"] == WAITING).any() for part in parts)


__all__ = ["NEVER", "WAITING", "EpisodeLabels", "HeldInterval"]
