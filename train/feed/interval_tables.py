"""The sums of an interval's sampled rows: columns of the run's tables, one function a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Ints
from restock.train.feed.sampled_rows import Columns, episode_sums

_SHORT = 1e-3  # of the rows fed: less is rounding
_MAX_MARKS = 1 << 25  # keys that are marked in place; those of a wider range are sorted instead


@dataclass(frozen=True)
class SourceRows:
    """The rows (n,) of an interval that came from one source, and what their codes name.

    A row has one action and one condition. *Cells* are combinations of stratum, condition and
    action, numbered in that order (the action's number changes fastest).
    """

    name: str  # logs | fresh
    rows: Mapping[str, NDArray[Any]]  # td, q, weight, action, reward, discount
    stratum: Ints
    strata: Sequence[str]
    row: Ints  # which row of the source each was
    available: Ints  # (S,) rows of each stratum that the source has
    timings: Sequence[str | None]  # (S,)
    quota: Sequence[float | None]  # (S,)
    condition: Ints
    conditions: Sequence[str]
    episode: Ints
    episodes: Sequence[str] | None  # their names; None: keys
    policy: NDArray[Any]
    policies: Sequence[str]
    ages: Mapping[str, F64]  # by their unit
    greedy: GreedyRows | None  # None: the policy is not at hand

    @cached_property
    def pair(self) -> Ints:
        """Stratum and condition of each row (n,)."""
        return self.stratum * len(self.conditions) + self.condition

    @property
    def pairs(self) -> int:
        """Number of combinations of stratum and condition."""
        return len(self.strata) * len(self.conditions)

    @cached_property
    def action_count(self) -> int:
        """Number of actions that cells distinguish."""
        return int(self.rows["action"].max(initial=0)) + 1

    @cached_property
    def drawn(self) -> Ints:
        """Rows by cell (S, C, A)."""
        return self._by_cell(slice(None))

    @cached_property
    def unique(self) -> Ints:
        """Different rows by cell (S, C, A)."""
        return self._by_cell(first_places(self.row * len(self.strata) + self.stratum))

    def summed(self, values: NDArray[Any]) -> F64:
        """Sum `values` (n,) by stratum and condition, (S, C)."""
        sums: F64 = np.bincount(self.pair, values, minlength=self.pairs).astype(np.float64)
        return sums.reshape(len(self.strata), len(self.conditions))

    @cached_property
    def sums(self) -> dict[str, F64]:
        """Sums of the averaged columns by stratum and condition, (S, C)."""
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
    """Return the place of one row for each distinct value of `key` (n,), ordered by value.

    Keys of rows are dense enough to be marked in place, which takes a thirtieth of sorting them.
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
    """Compute the columns of `strata`; `total` (S,) are rows since the run began."""
    drawn, unique = (of.sum(axis=(1, 2)) for of in (source.drawn, source.unique))
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
    """Compute the columns of `fed`: a row per stratum (S,), and one of rows in none, if any.

    Args:
        quotas: `wanted` and `natural` shares, `logged` rows drawn, and the `reason` for one that is
            short, (S,) each.
        fresh: (S + 1,) fresh rows drawn, last those in no stratum.
        available: (S + 1,) rows in the ring.
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

    `names` (A,) are the task's.
    """
    count, size = len(names), len(source.conditions)
    pairs = np.flatnonzero(source.drawn.sum(axis=2).ravel())  # (P,)

    def of_task(by_cell: Ints) -> Ints:
        """(S, C, a) or (S * C, a), of the pairs that were met and all actions: (P, A)."""
        of_pairs = by_cell.reshape(source.pairs, -1)[pairs]
        none_of = ((0, 0), (0, max(count - of_pairs.shape[1], 0)))
        whole: Ints = np.pad(of_pairs, none_of)[:, :count]
        return whole

    drawn, unique = of_task(source.drawn), of_task(source.unique)
    in_pair = np.repeat(drawn.sum(axis=1), count)
    wanted: dict[str, Any] = {"audited_rows": None, "greedy_rows": None, "greedy_share": None}
    if source.greedy is not None:
        audited = source.greedy.stratum * size + source.greedy.condition
        cell = audited * count + source.greedy.action
        greedy = of_task(np.bincount(cell, minlength=source.pairs * count))
        looked_at = np.repeat(greedy.sum(axis=1), count)
        per_action = zip(greedy.ravel(), looked_at, strict=True)
        share = [n / of if of else None for n, of in per_action]
        wanted = {"audited_rows": looked_at, "greedy_rows": greedy.ravel(), "greedy_share": share}
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
    # 2**bucket <= age < 2**(bucket + 1); -1 below 1
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


__all__ = [
    "GreedyRows",
    "SourceRows",
    "actions",
    "ages",
    "conditions",
    "fed",
    "first_places",
    "policies",
    "sampled_episodes",
    "strata",
]
