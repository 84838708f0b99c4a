"""The sums of an interval's sampled rows: columns of the run's tables, one function a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Ints
from restock.train.feed.sampled_rows import Columns, episode_sums


@dataclass(frozen=True)
class SourceRows:
    """The rows (n,) of an interval that came from one source, and what their codes name."""

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

    @property
    def first_of_row(self) -> Ints:
        """Of each different row in each stratum, one of its places."""
        key = self.row * len(self.strata) + self.stratum
        first: Ints = np.unique(key, return_index=True)[1]
        return first


@dataclass(frozen=True)
class GreedyRows:
    """The audited rows (m,) of a source, with the action that the policy would take in each."""

    stratum: Ints
    condition: Ints
    action: Ints


def strata(source: SourceRows, first: Ints, total: Ints) -> Columns:
    """Of `strata`. `first` is `source.first_of_row`; `total` (S,) are rows since the run began."""
    size, stratum, rows = len(source.strata), source.stratum, source.rows
    drawn = np.bincount(stratum, minlength=size)
    weight = np.bincount(stratum, rows["weight"], minlength=size)
    unique = np.bincount(stratum[first], minlength=size)

    def mean(values: NDArray[Any]) -> list[float | None]:
        sums = np.bincount(stratum, values, minlength=size).tolist()
        return [x / n if n else None for x, n in zip(sums, drawn.tolist(), strict=True)]

    return {
        "source": source.name,
        "stratum": source.strata,
        "timing": source.timings,
        "quota_share": source.quota,
        "available_rows": source.available,
        "available_share": source.available / max(source.available.sum(), 1),
        "drawn_rows": drawn,
        "drawn_share": drawn / len(stratum),
        "effective_share": weight / max(weight.sum(), 1e-12),
        "unique_rows": unique,
        "replays_per_row": [n / u if u else None for n, u in zip(drawn, unique, strict=True)],
        "total_drawn_rows": total,
        "td_abs_mean": mean(np.abs(rows["td"])),
        "q_mean": mean(rows["q"]),
        "reward_mean": mean(rows["reward"]),
        "terminal_share": mean(rows["discount"] == 0),
    }


def conditions(source: SourceRows) -> Columns:
    """Of `conditions`."""
    code, size = source.condition, len(source.conditions)
    drawn = np.bincount(code, minlength=size)
    weight, td, q = (
        np.bincount(code, values, minlength=size)
        for values in (source.rows["weight"], np.abs(source.rows["td"]), source.rows["q"])
    )
    met = np.flatnonzero(drawn)
    return {
        "source": source.name,
        "condition": np.array(source.conditions, object)[met],
        "drawn_rows": drawn[met],
        "drawn_share": drawn[met] / len(code),
        "effective_share": weight[met] / max(weight.sum(), 1e-12),
        "td_abs_mean": td[met] / drawn[met],
        "q_mean": q[met] / drawn[met],
    }


def actions(source: SourceRows, first: Ints, names: Sequence[str]) -> Columns:
    """Of `actions`: every action of each stratum and condition that was met, those never drawn too.

    `names` (A,) are the task's.
    """
    count, size = len(names), len(source.conditions)
    pair = source.stratum * size + source.condition
    cell = pair * count + source.rows["action"]
    pairs = np.unique(pair)
    cells = (pairs[:, None] * count + np.arange(count)).ravel()  # (P * A,)
    most = int(cells.max(initial=-1)) + 1
    drawn, unique = (np.bincount(of, minlength=most)[cells] for of in (cell, cell[first]))
    in_pair = np.repeat(drawn.reshape(-1, count).sum(axis=1), count)
    wanted: dict[str, Any] = {"audited_rows": None, "greedy_rows": None, "greedy_share": None}
    if source.greedy is not None:
        audited = source.greedy.stratum * size + source.greedy.condition
        greedy = np.bincount(audited * count + source.greedy.action, minlength=most)[cells]
        looked_at = np.repeat(greedy.reshape(-1, count).sum(axis=1), count)
        share = [n / of if of else None for n, of in zip(greedy, looked_at, strict=True)]
        wanted = {"audited_rows": looked_at, "greedy_rows": greedy, "greedy_share": share}
    return {
        "source": source.name,
        "stratum": np.array(source.strata, object)[cells // count // size],
        "condition": np.array(source.conditions, object)[cells // count % size],
        "action": np.tile(np.arange(count), len(pairs)),
        "name": np.tile(np.array(names, object), len(pairs)),
        "drawn_rows": drawn,
        "drawn_share": drawn / in_pair,
        "unique_rows": unique,
        **wanted,
    }


def ages(unit: str, age: F64) -> Columns:
    """Of `ages`, without the source."""
    bucket = np.where(age < 1, -1, np.floor(np.log2(np.maximum(age, 1)))).astype(np.int32)
    buckets, counts = np.unique(bucket, return_counts=True)
    quantiles = np.quantile(age, [0.5, 0.9, 0.99]).tolist()
    return {
        "unit": unit,
        "bucket": buckets,
        "count": counts,
        **dict(zip(("p50", "p90", "p99"), quantiles, strict=True)),
    }


def sampled_episodes(source: SourceRows) -> Columns:
    """Of `sampled_episodes`."""
    sums = episode_sums(source.episode, source.stratum, source.rows["weight"], len(source.strata))
    key = sums["episode"]
    named = np.array(source.episodes, object)[key] if source.episodes else key.astype(str)
    stratum = np.array(source.strata, object)[sums["stratum"]]
    return {"source": source.name, **sums, "stratum": stratum, "episode": named}


def policies(source: SourceRows) -> Columns:
    """Of `policies`."""
    counts = np.bincount(source.policy, minlength=len(source.policies))
    met = np.flatnonzero(counts)
    return {
        "source": source.name,
        "behaviour_policy": np.array(source.policies, object)[met],
        "rows": counts[met],
    }


__all__ = [
    "GreedyRows",
    "SourceRows",
    "actions",
    "ages",
    "conditions",
    "policies",
    "sampled_episodes",
    "strata",
]
