"""Keep rows as they were sampled, and compute the run's tables from them.

The update loop only appends rows, in one pass of compiled code if that is built. Statistics are
computed once per interval, by one function per table. The rows of a few batches are audited.

Some conditions look ahead, so a fresh row gets its condition only when its episode has ended; by
then it may have been drawn. An interval's fresh rows are therefore held until all of them have
their condition, and only then written to the tables.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from restock import native
from restock.arrays import F32, F64, Ints
from restock.replay.sampling.ring import FreshRing
from restock.state import Stateful
from restock.train.feed.fresh_labels import WAITING, EpisodeLabels, FreshPerturbations
from restock.train.feed.logs import Coded, Logs

_MAX_CELLS = 1 << 22  # most cells counted in one array; if episode keys span more, rows are sorted
_BATCH: dict[str, DTypeLike] = {
    **dict.fromkeys(("td", "q", "weight"), "f4"),
    "action": "i2",
    **dict.fromkeys(("reward", "discount"), "f4"),
}
LOGGED: dict[str, DTypeLike] = {"row": "i8", "stratum": "i8", **_BATCH}  # row: in the panel
GREEDY: dict[str, DTypeLike] = {"row": "i8", "stratum": "i8", "action": "i8"}  # audited log rows
FRESH: dict[str, DTypeLike] = {
    "condition": "i2",  # WAITING while the row's episode goes on
    "stratum": "i2",  # the mixture's stratum; without a mixture, the condition
    "episode": "i8",  # the ring's key
    "episode_step": "i4",
    "policy": "i2",
    "age_env_steps": "i8",
    "age_gradient_steps": "i8",
    **_BATCH,
}

_OF_RING = ("episode", "episode_step", "behaviour_policy", "env_step", "gradient_step")
_MIN_ROOM = 1 << 12  # rows to allocate at least

Columns = dict[str, Any]  # arrays, lists, or scalars that hold for all rows
Arrays = Mapping[str, NDArray[Any]]  # (n,) each


class SampledRows(Stateful):
    """Columns (n,) of the rows sampled since `clear`."""

    STATE: ClassVar[tuple[str, ...]] = ("columns",)

    def __init__(self, kinds: Mapping[str, DTypeLike]) -> None:
        self._kinds = {name: np.dtype(kind) for name, kind in kinds.items()}
        self._places = {name: place for place, name in enumerate(kinds)}
        self._count = self._last = 0
        self._held = self._allocate(0)  # arrays with room for more rows

    def __len__(self) -> int:
        return self._count

    def grow(self, rows: int) -> tuple[tuple[NDArray[Any], ...], int]:
        """Make room for more rows; return the columns and where the new rows begin."""
        begin, self._last = self._count, self._count
        self._count += rows
        if self._count > len(self._held[0]):
            longer = self._allocate(max(2 * self._count, _MIN_ROOM))
            for column, old in zip(longer, self._held, strict=True):
                column[:begin] = old[:begin]
            self._held = longer
        return self._held, begin

    def append(self, *part: NDArray[Any]) -> None:
        """Append rows, given as one array (n,) per column, in the order of the columns."""
        columns, begin = self.grow(len(part[0]))
        for column, values in zip(columns, part, strict=True):
            column[begin : self._count] = values

    def clear(self) -> None:
        """Remove all rows; columns returned earlier stay valid."""
        if self._count:
            self._held = self._allocate(self._count)  # room for as many rows as before
        self._count = self._last = 0

    @property
    def last(self) -> dict[str, NDArray[Any]]:
        """Return the rows last appended."""
        return self._rows_from(self._last)

    def last_of(self, *names: str) -> tuple[NDArray[Any], ...]:
        """Return some columns of the rows last appended."""
        part = slice(self._last, self._count)
        return tuple(self._held[self._places[name]][part] for name in names)

    @property
    def columns(self) -> dict[str, NDArray[Any]]:
        """Return all rows."""
        return self._rows_from(0)

    @columns.setter
    def columns(self, columns: Arrays) -> None:
        self._held = tuple(np.array(columns[name], kind) for name, kind in self._kinds.items())
        self._count, self._last = len(self._held[0]), 0

    def _rows_from(self, begin: int) -> dict[str, NDArray[Any]]:
        named = zip(self._kinds, self._held, strict=True)
        return {name: column[begin : self._count] for name, column in named}

    def _allocate(self, rows: int) -> tuple[NDArray[Any], ...]:
        return tuple(np.empty(rows, kind) for kind in self._kinds.values())


@dataclass(frozen=True)
class BatchValues:
    """Values per row of a batch (B,), its logged rows first."""

    td: F32
    q: F32
    weight: F32 | None  # None: 1
    tail: F32  # (B, 3) action, reward, discount


def keep_rows(
    values: BatchValues,
    log_rows: Ints,  # (L,) row numbers in the panel
    log_stratum: Ints,  # (L,)
    slots: Ints,  # (B - L,) slots of the ring
    ring: FreshRing,
    clocks: tuple[int, int],  # environment steps and updates, now
    logged: SampledRows,
    fresh: SampledRows,
    *,
    by_native: bool,
) -> None:
    """Append a batch's rows to `logged` and `fresh`, by compiled code if `by_native`."""
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
    *kinds, episode, step, policy, env_step, gradient_step = (column[slots] for column in of_ring)
    ages = (clocks[0] - env_step, clocks[1] - gradient_step)
    of_logs = (log_rows, log_stratum, *(part[: len(log_rows)] for part in of_rows))
    of_fresh = (*kinds, episode, step, policy, *ages, *(part[len(log_rows) :] for part in of_rows))
    for columns, begin, every in ((logged_to, logged_at, of_logs), (fresh_to, fresh_at, of_fresh)):
        for column, found in zip(columns, every, strict=True):
            column[begin : begin + len(found)] = found


def episode_sums(
    episode: NDArray[np.int64],  # (n,) key of each row's episode
    pair: NDArray[np.int64],  # (n,) code of each row's stratum and condition
    weight: NDArray[np.float32],  # (n,)
    pairs: int,
) -> dict[str, NDArray[Any]]:
    """Sum rows by episode and pair, into columns episode, pair, drawn_rows, weight.

    Rows of one episode are drawn together and are alike, so how certain it is what a critic was fed
    depends on the number of episodes, not of rows: `restock compare` resamples episodes.
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
    """Return blake2b of each packed row (B, W), 16 hex digits, which `restock trace` checks."""
    return [hashlib.blake2b(row.tobytes(), digest_size=8).hexdigest() for row in packed]


def logged_audit(rows: Arrays, logs: Logs, age_days: NDArray[np.float64], step: int) -> Columns:
    """Return columns of the run's table `audit` for logged rows of the batch of update `step`.

    Logged rows could be drawn from update 0 on, so their age in updates is `step`.
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
    slots: NDArray[np.int64],  # (n,) the rows' slots in the ring
    ring: FreshRing,
    perturbations: FreshPerturbations | None = None,
) -> Columns:
    """Return columns of `audit` for fresh rows, without the names that `add_names` adds."""
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
    """Add names to the columns of `fresh_audit`; rows in no stratum get `unlabelled`."""
    names = [conditions[code] if code >= 0 else None for code in audit["condition"].tolist()]
    of_strata = audit["of_stratum"].tolist()
    values = audit["perturbation_values"]  # pairs (name, value); lists if from a checkpoint
    columns = {
        **audit,
        "episode": [str(key) for key in audit["key"].tolist()],
        "stratum": [strata[code] if code >= 0 else unlabelled for code in of_strata],
        "condition": names,
        "perturbation_values": None
        if values is None
        else [None if row is None else [tuple(pair) for pair in row] for row in values],
    }
    del columns["key"], columns["of_stratum"]
    return columns


def _names(coded: Coded, rows: NDArray[np.int64]) -> list[str]:
    return [str(coded.names[code]) for code in coded.codes[rows].tolist()]


@dataclass(frozen=True)
class HeldInterval:
    """The fresh rows of a closed interval, held until all of them have labels.

    `rows` are columns (n,) of `FRESH`, `audits` are columns of each audited batch. `open_rows` are
    the rows of the ring that had no condition yet when the interval was closed.
    """

    clocks: Mapping[str, int]
    phase: str
    rows: dict[str, NDArray[Any]]
    available: Ints  # (S,) labelled rows of the ring, by stratum
    open_rows: dict[str, NDArray[Any]]  # condition, stratum, episode, episode_step
    audits: Sequence[dict[str, Any]]  # columns of `audit`, with condition, key and greedy action
    quotas: Mapping[str, NDArray[Any]] | None = None  # the argument of `fed`

    def fill(self, labels: EpisodeLabels) -> None:
        """Fill in the conditions that are known by now."""
        for part in (self.rows, self.open_rows):
            labels.fill(part["condition"], part["stratum"], part["episode"], part["episode_step"])
        for audit in self.audits:
            labels.fill(
                audit["condition"], audit["of_stratum"], audit["key"], audit["episode_step"]
            )

    @property
    def waits(self) -> bool:
        """Return whether a row has no condition yet and may get one."""
        parts = (self.rows, self.open_rows)
        return any((part["condition"] == WAITING).any() for part in parts)


_SHORT = 1e-3  # share of all rows fed; a smaller shortfall is taken as rounding
_MAX_MARKS = 1 << 25  # longest array of marks, one per possible key; beyond it, keys are sorted


@dataclass(frozen=True)
class SourceRows:
    """The rows (n,) of an interval from one source, with the names of their codes.

    A row has one action and one condition. *Cells* are combinations of stratum, condition and
    action, numbered in that order (the action's number changes fastest).
    """

    name: str  # logs | fresh
    rows: Mapping[str, NDArray[Any]]  # td, q, weight, action, reward, discount
    stratum: Ints
    strata: Sequence[str]
    row: Ints  # row numbers in the source
    available: Ints  # (S,) rows of each stratum in the source
    timings: Sequence[str | None]  # (S,)
    quota: Sequence[float | None]  # (S,)
    condition: Ints
    conditions: Sequence[str]
    episode: Ints
    episodes: Sequence[str] | None  # names of the codes in `episode`; None: the codes are keys
    policy: NDArray[Any]
    policies: Sequence[str]
    ages: Mapping[str, F64]  # unit -> ages
    greedy: GreedyRows | None  # None: the policy is not available

    @cached_property
    def pair(self) -> Ints:
        """Return one code per row (n,) for its stratum and condition."""
        return self.stratum * len(self.conditions) + self.condition

    @property
    def pairs(self) -> int:
        """Return the number of combinations of stratum and condition."""
        return len(self.strata) * len(self.conditions)

    @cached_property
    def action_count(self) -> int:
        """Return the number of actions that cells distinguish."""
        return int(self.rows["action"].max(initial=0)) + 1

    @cached_property
    def drawn(self) -> Ints:
        """Return the number of rows in each cell (S, C, A)."""
        return self._by_cell(slice(None))

    @cached_property
    def unique(self) -> Ints:
        """Return the number of distinct rows in each cell (S, C, A)."""
        return self._by_cell(first_places(self.row * len(self.strata) + self.stratum))

    def summed(self, values: NDArray[Any]) -> F64:
        """Sum `values` (n,) by stratum and condition, (S, C)."""
        sums: F64 = np.bincount(self.pair, values, minlength=self.pairs).astype(np.float64)
        return sums.reshape(len(self.strata), len(self.conditions))

    @cached_property
    def sums(self) -> dict[str, F64]:
        """Return the sums (S, C) that means are computed from, by stratum and condition."""
        rows = self.rows
        return {
            "weight": self.summed(rows["weight"]),
            "td_abs": self.summed(np.abs(rows["td"])),
            "q": self.summed(rows["q"]),
            "reward": self.summed(rows["reward"]),
            "terminal": self.summed(rows["discount"] == 0),
        }

    def _by_cell(self, chosen: slice | Ints) -> Ints:
        """Count the chosen rows in each cell."""
        shape = len(self.strata), len(self.conditions), self.action_count
        cell = self.pair[chosen] * self.action_count + self.rows["action"][chosen]
        return np.bincount(cell, minlength=self.pairs * self.action_count).reshape(shape)


def first_places(key: Ints) -> Ints:
    """Return the index of one row for each distinct value of `key` (n,), ordered by value.

    Keys span few values, so marking each in an array takes a thirtieth of the time of sorting.
    """
    first = int(key.min()) if len(key) else 0
    span = int(key.max(initial=first)) - first + 1
    if span > _MAX_MARKS:
        sorted_places: Ints = np.unique(key, return_index=True)[1]
        return sorted_places
    marked, place = np.zeros(span, np.bool_), np.empty(span, np.int32)
    marked[key - first] = True
    place[key - first] = np.arange(len(key), dtype=np.int32)
    return place[np.flatnonzero(marked)].astype(np.int64)


@dataclass(frozen=True)
class GreedyRows:
    """The audited rows (m,) of a source, with the action that the policy would take in each."""

    stratum: Ints
    condition: Ints
    action: Ints


def strata(source: SourceRows, total: Ints) -> Columns:
    """Compute the columns of `strata`; `total` (S,) counts rows drawn since the run began."""
    drawn, unique = (cells.sum(axis=(1, 2)) for cells in (source.drawn, source.unique))
    sums = {name: by_pair.sum(axis=1) for name, by_pair in source.sums.items()}

    def mean(name: str) -> list[float | None]:
        pairs = zip(sums[name].tolist(), drawn.tolist(), strict=True)
        return [x / n if n else None for x, n in pairs]

    return {
        "source": source.name,
        "stratum": source.strata,
        "timing": source.timings,
        "quota_share": source.quota,
        "available_rows": source.available,
        "available_share": source.available / max(source.available.sum(), 1),
        "drawn_rows": drawn,
        "drawn_share": drawn / len(source.stratum),
        "effective_share": sums["weight"] / max(sums["weight"].sum(), 1e-12),
        "unique_rows": unique,
        "replays_per_row": [n / u if u else None for n, u in zip(drawn, unique, strict=True)],
        "total_drawn_rows": total,
        "td_abs_mean": mean("td_abs"),
        "q_mean": mean("q"),
        "reward_mean": mean("reward"),
        "terminal_share": mean("terminal"),
    }


def fed(
    names: Sequence[str], quotas: Mapping[str, NDArray[Any]], fresh: Ints, available: Ints
) -> Columns:
    """Compute the columns of `fed`: a row per stratum (S,), and one for rows in none, if any.

    Args:
        quotas: (S,) each: `wanted` and `natural` shares, `logged` rows drawn, and the `reason` why
            a stratum is short.
        fresh: (S + 1,) fresh rows drawn; the last count is of rows in no stratum.
        available: (S + 1,) rows in the ring, in the same order.
    """
    logged = np.append(quotas["logged"], 0)
    total = max(int(logged.sum() + fresh.sum()), 1)
    wanted = np.append(quotas["wanted"], 0.0)
    in_logs = np.append(quotas["natural"], 0.0)
    in_ring = available / max(int(available.sum()), 1)
    drawn = (logged + fresh) / total
    short = np.maximum(wanted - drawn, 0.0)
    count = len(names) + bool(fresh[-1])
    part = slice(count)
    reasons = [*quotas["reason"].tolist(), None]
    return {
        "stratum": [*names, "unlabelled"][part],
        "natural_share": (logged.sum() * in_logs + fresh.sum() * in_ring)[part] / total,
        "wanted_share": wanted[part],
        "drawn_share": drawn[part],
        "logs_share": (logged / total)[part],
        "fresh_share": (fresh / total)[part],
        "short_share": short[part],
        "reason": [
            why if lack > _SHORT else None
            for why, lack in zip(reasons[part], short[part].tolist(), strict=True)
        ],
        "drawn_rows": (logged + fresh)[part],
    }


def conditions(source: SourceRows) -> Columns:
    """Compute the columns of `conditions`."""
    drawn = source.drawn.sum(axis=(0, 2))
    weight, td, q = (source.sums[name].sum(axis=0) for name in ("weight", "td_abs", "q"))
    observed = np.flatnonzero(drawn)
    return {
        "source": source.name,
        "condition": np.array(source.conditions, object)[observed],
        "drawn_rows": drawn[observed],
        "drawn_share": drawn[observed] / len(source.condition),
        "effective_share": weight[observed] / max(weight.sum(), 1e-12),
        "td_abs_mean": td[observed] / drawn[observed],
        "q_mean": q[observed] / drawn[observed],
    }


def actions(source: SourceRows, names: Sequence[str]) -> Columns:
    """Compute the columns of `actions`, including actions that were never drawn.

    `names` (A,) are the names of the task's actions.
    """
    count, size = len(names), len(source.conditions)
    pairs = np.flatnonzero(source.drawn.sum(axis=2).ravel())  # (P,)

    def of_task(by_cell: Ints) -> Ints:
        """Reduce counts (S, C, a) or (S * C, a) to the pairs that occurred, all actions: (P, A)."""
        of_pairs = by_cell.reshape(source.pairs, -1)[pairs]
        padding = ((0, 0), (0, max(count - of_pairs.shape[1], 0)))
        whole: Ints = np.pad(of_pairs, padding)[:, :count]
        return whole

    drawn, unique = of_task(source.drawn), of_task(source.unique)
    in_pair = np.repeat(drawn.sum(axis=1), count)
    wanted: dict[str, Any] = {"audited_rows": None, "greedy_rows": None, "greedy_share": None}
    if source.greedy is not None:
        pair = source.greedy.stratum * size + source.greedy.condition
        cell = pair * count + source.greedy.action
        greedy = of_task(np.bincount(cell, minlength=source.pairs * count))
        audited = np.repeat(greedy.sum(axis=1), count)
        per_action = zip(greedy.ravel(), audited, strict=True)
        share = [n / total if total else None for n, total in per_action]
        wanted = {"audited_rows": audited, "greedy_rows": greedy.ravel(), "greedy_share": share}
    of_pair = np.repeat(pairs, count)
    return {
        "source": source.name,
        "stratum": np.array(source.strata, object)[of_pair // size],
        "condition": np.array(source.conditions, object)[of_pair % size],
        "action": np.tile(np.arange(count), len(pairs)),
        "name": np.tile(np.array(names, object), len(pairs)),
        "drawn_rows": drawn.ravel(),
        "drawn_share": drawn.ravel() / in_pair,
        "unique_rows": unique.ravel(),
        **wanted,
    }


def ages(unit: str, age: F64) -> Columns:
    """Compute the columns of `ages`, except the source."""
    # Bucket b counts ages from 2**b to below 2**(b + 1); bucket -1 counts ages below 1.
    rows = np.bincount(np.frexp(np.maximum(age, 0.5))[1])
    observed = np.flatnonzero(rows)
    quantiles = np.quantile(age, [0.5, 0.9, 0.99]).tolist()
    return {
        "unit": unit,
        "bucket": observed - 1,
        "count": rows[observed],
        **dict(zip(("p50", "p90", "p99"), quantiles, strict=True)),
    }


def sampled_episodes(source: SourceRows) -> Columns:
    """Compute the columns of `sampled_episodes`."""
    sums = episode_sums(source.episode, source.pair, source.rows["weight"], source.pairs)
    key, pair, size = sums["episode"], sums.pop("pair"), len(source.conditions)
    return {
        "source": source.name,
        **sums,
        "stratum": np.array(source.strata, object)[pair // size],
        "condition": np.array(source.conditions, object)[pair % size],
        "episode": np.array(source.episodes, object)[key] if source.episodes else key.astype(str),
    }


def policies(source: SourceRows) -> Columns:
    """Compute the columns of `policies`."""
    counts = np.bincount(source.policy, minlength=len(source.policies))
    observed = np.flatnonzero(counts)
    return {
        "source": source.name,
        "behaviour_policy": np.array(source.policies, object)[observed],
        "rows": counts[observed],
    }
