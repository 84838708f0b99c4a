"""Rows as they were sampled: columns that grow by a batch, their sums by episode, and audit rows.

The update loop only appends, in one pass of compiled code if it is built. Statistics are computed
once an interval, and the rows of a few audited batches are written down.

Some conditions look ahead, so a row of the twin has its condition only once its episode has ended;
by then it may have been drawn. An interval's fresh rows are therefore held until every one of them
has its condition, and written after that: with it, in every table.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from restock import native
from restock.arrays import F32, Ints
from restock.replay.sampling.ring import FreshRing
from restock.state import Stateful
from restock.train.feed.fresh_log import FreshPerturbations
from restock.train.feed.logs import Coded, Logs

_MAX_CELLS = 1 << 22  # of a dense count; wider ranges of episodes are sorted instead
_BATCH: dict[str, DTypeLike] = {
    **dict.fromkeys(("td", "q", "weight"), "f4"),
    "action": "i2",
    **dict.fromkeys(("reward", "discount"), "f4"),
}
LOGGED: dict[str, DTypeLike] = {"row": "i8", "stratum": "i8", **_BATCH}  # row: of the panel
GREEDY: dict[str, DTypeLike] = {"row": "i8", "stratum": "i8", "action": "i8"}  # audited, of logs
FRESH: dict[str, DTypeLike] = {
    "condition": "i2",  # WAITING while its episode goes on
    "stratum": "i2",  # of the mixture; without strata, the condition
    "episode": "i8",  # the ring's key
    "episode_step": "i4",
    "policy": "i2",
    "age_env_steps": "i8",
    "age_gradient_steps": "i8",
    **_BATCH,
}

_OF_RING = ("episode", "episode_step", "behaviour_policy", "env_step", "gradient_step")
_MIN_ROOM = 1 << 12  # rows

Columns = dict[str, Any]  # arrays, lists, or scalars that hold for all rows
Arrays = Mapping[str, NDArray[Any]]  # (n,) each


class SampledRows(Stateful):
    """Columns (n,) of the rows sampled since `clear`."""

    STATE: ClassVar[tuple[str, ...]] = ("columns",)

    def __init__(self, kinds: Mapping[str, DTypeLike]) -> None:
        self._kinds = {name: np.dtype(kind) for name, kind in kinds.items()}
        self._places = {name: place for place, name in enumerate(kinds)}
        self._count = self._last = 0
        self._held = self._made(0)  # more than there are rows

    def __len__(self) -> int:
        return self._count

    def grow(self, rows: int) -> tuple[tuple[NDArray[Any], ...], int]:
        """Room for more rows: the columns, and where in them these begin."""
        begin, self._last = self._count, self._count
        self._count += rows
        if self._count > len(self._held[0]):
            longer = self._made(max(2 * self._count, _MIN_ROOM))
            for column, old in zip(longer, self._held, strict=True):
                column[:begin] = old[:begin]
            self._held = longer
        return self._held, begin

    def append(self, *part: NDArray[Any]) -> None:
        """Rows (n,), columns in their order."""
        columns, begin = self.grow(len(part[0]))
        for column, values in zip(columns, part, strict=True):
            column[begin : self._count] = values

    def clear(self) -> None:
        """Begin again; `columns` that were taken stay as they are."""
        if self._count:
            self._held = self._made(self._count)  # as many as the interval before
        self._count = self._last = 0

    @property
    def last(self) -> dict[str, NDArray[Any]]:
        """The rows last appended."""
        return self._since(self._last)

    def last_of(self, *names: str) -> tuple[NDArray[Any], ...]:
        """Return some columns of the rows last appended."""
        part = slice(self._last, self._count)
        return tuple(self._held[self._places[name]][part] for name in names)

    @property
    def columns(self) -> dict[str, NDArray[Any]]:
        """Return all rows."""
        return self._since(0)

    @columns.setter
    def columns(self, columns: Arrays) -> None:
        self._held = tuple(np.array(columns[name], kind) for name, kind in self._kinds.items())
        self._count, self._last = len(self._held[0]), 0

    def _since(self, begin: int) -> dict[str, NDArray[Any]]:
        named = zip(self._kinds, self._held, strict=True)
        return {name: column[begin : self._count] for name, column in named}

    def _made(self, rows: int) -> tuple[NDArray[Any], ...]:
        return tuple(np.empty(rows, kind) for kind in self._kinds.values())


@dataclass(frozen=True)
class BatchValues:
    """Values computed for each row of a batch (B,), its logged rows first."""

    td: F32
    q: F32
    weight: F32 | None  # None: 1
    tail: F32  # (B, 3) action, reward, discount


def keep_rows(
    values: BatchValues,
    log_rows: Ints,  # (L,) of the panel
    log_stratum: Ints,  # (L,)
    slots: Ints,  # (B - L,) of the ring
    ring: FreshRing,
    clocks: tuple[int, int],  # environment steps and updates, now
    logged: SampledRows,
    fresh: SampledRows,
    *,
    by_native: bool,
) -> None:
    """Append a batch to the rows of both sources, LOGGED and FRESH; or have compiled code do it."""
    meta, condition = ring.meta, ring.by_condition.stratum
    of_ring = (condition, ring.stratum, *(meta[name] for name in _OF_RING))
    logged_to, logged_at = logged.grow(len(log_rows))
    fresh_to, fresh_at = fresh.grow(len(slots))
    if by_native:
        native.compiled.keep_rows(
            (values.td, values.q, values.weight, values.tail),
            (log_rows, log_stratum),
            logged_to,
            logged_at,
            of_ring,
            slots,
            fresh_to,
            fresh_at,
            clocks,
        )
        return
    weight = np.ones_like(values.td) if values.weight is None else values.weight
    of_rows = (values.td, values.q, weight, *values.tail.T)
    *kinds, episode, step, policy, env_step, gradient_step = (of[slots] for of in of_ring)
    ages = (clocks[0] - env_step, clocks[1] - gradient_step)
    of_logs = (log_rows, log_stratum, *(of[: len(log_rows)] for of in of_rows))
    of_fresh = (*kinds, episode, step, policy, *ages, *(of[len(log_rows) :] for of in of_rows))
    for columns, begin, every in ((logged_to, logged_at, of_logs), (fresh_to, fresh_at, of_fresh)):
        for column, found in zip(columns, every, strict=True):
            column[begin : begin + len(found)] = found


def episode_sums(
    episode: NDArray[np.int64],  # (n,) of each row
    pair: NDArray[np.int64],  # (n,) of stratum and condition
    weight: NDArray[np.float32],  # (n,)
    pairs: int,
) -> dict[str, NDArray[Any]]:
    """Rows summed by episode and pair: columns episode, pair, drawn_rows, weight.

    Rows of one episode are drawn together and are alike, so what a critic learnt from is only as
    certain as its episodes are many. `restock compare` resamples these.
    """
    first = int(episode.min(initial=0))
    key = (episode.astype(np.int64) - first) * pairs + pair
    if int(key.max(initial=0)) < _MAX_CELLS:
        drawn = np.bincount(key)
        cells = np.flatnonzero(drawn)
        count, total = drawn[cells], np.bincount(key, weight)[cells]
    else:
        cells, place, count = np.unique(key, return_inverse=True, return_counts=True)
        total = np.bincount(place, weight)
    return {
        "episode": cells // pairs + first,
        "pair": cells % pairs,
        "drawn_rows": count,
        "weight": total,
    }


def row_hashes(packed: NDArray[np.float32]) -> list[str]:
    """blake2b of each packed row (B, W), 16 hex digits: `restock trace` compares rows with it."""
    return [hashlib.blake2b(row.tobytes(), digest_size=8).hexdigest() for row in packed]


def logged_audit(rows: Arrays, logs: Logs, age_days: NDArray[np.float64], step: int) -> Columns:
    """Return columns of the run's table `audit` for logged rows of the batch of update `step`.

    They could be drawn since update 0: that is their age in updates.
    """
    row = rows["row"]
    return {
        "source": "logs",
        "transition_id": logs.transition_id[row],
        "panel_row": row,
        "ring_slot": None,
        "episode": _names(logs.episode, row),
        "episode_step": None,
        "age_days": age_days[row],
        "age_env_steps": None,
        "age_gradient_steps": step,
        "stratum": [logs.strata[code] for code in rows["stratum"].tolist()],
        "condition": _names(logs.condition, row),
        "behaviour_policy": _names(logs.behaviour_policy, row),
        "behaviour_version": _names(logs.behaviour_version, row),
        "perturbation": (
            [logs.perturbation.known(place) for place in row.tolist()]
            if logs.perturbation
            else None
        ),
        "perturbation_values": None,
        **{name: rows[name] for name in _BATCH},
    }


def fresh_audit(
    rows: Arrays,
    slots: NDArray[np.int64],  # (n,) of the ring
    ring: FreshRing,
    perturbations: FreshPerturbations | None = None,
) -> Columns:
    """Return the audit's columns of fresh rows, without the names that `add_names` adds."""
    keys = rows["episode"]
    return {
        "source": "fresh",
        "transition_id": None,
        "panel_row": None,
        "ring_slot": slots,
        "key": keys,
        "episode_step": rows["episode_step"],
        "age_days": None,
        "age_env_steps": rows["age_env_steps"],
        "age_gradient_steps": rows["age_gradient_steps"],
        "condition": rows["condition"].copy(),
        "of_stratum": rows["stratum"].copy(),
        "behaviour_policy": [ring.behaviour_policies[code] for code in rows["policy"].tolist()],
        "behaviour_version": [str(v) for v in ring.meta["policy_version"][slots].tolist()],
        "perturbation": perturbations.names(keys) if perturbations else None,
        "perturbation_values": perturbations.values(keys) if perturbations else None,
        **{name: rows[name] for name in _BATCH},
    }


def add_names(
    audit: Columns, conditions: Sequence[str], strata: Sequence[str], unlabelled: str
) -> Columns:
    """Add names to the columns of `fresh_audit`; `unlabelled` is the stratum of the others."""
    names = [conditions[code] if code >= 0 else None for code in audit["condition"].tolist()]
    of_strata = audit["of_stratum"].tolist()
    values = audit["perturbation_values"]  # a checkpoint gives back lists
    columns = {
        **audit,
        "episode": [str(key) for key in audit["key"].tolist()],
        "stratum": [strata[code] if code >= 0 else unlabelled for code in of_strata],
        "condition": names,
        "perturbation_values": None
        if values is None
        else [None if of is None else [tuple(pair) for pair in of] for of in values],
    }
    del columns["key"], columns["of_stratum"]
    return columns


def _names(coded: Coded, rows: NDArray[np.int64]) -> list[str]:
    return [str(coded.names[code]) for code in coded.codes[rows].tolist()]


WAITING, NEVER = -1, -2  # codes of a row without a condition: its episode goes on; it is not known


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


@dataclass(frozen=True)
class HeldInterval:
    """The fresh rows of a closed interval.

    `rows` are columns (n,) of `FRESH`; of each audited batch there are columns in
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
        """True if a row has no condition yet, and may get one."""
        parts = (self.rows, self.open_rows)
        return any((part["condition"] == WAITING).any() for part in parts)


__all__ = [
    "BatchValues",
    "EpisodeLabels",
    "FRESH",
    "GREEDY",
    "HeldInterval",
    "LOGGED",
    "NEVER",
    "SampledRows",
    "WAITING",
    "episode_sums",
    "fresh_audit",
    "keep_rows",
    "logged_audit",
    "add_names",
]
