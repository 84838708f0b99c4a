"""Statistics of values that come in clusters: segments of an episode are not independent.

Intervals are percentile bootstraps over whole clusters (episodes). With a single cluster there is
nothing to resample and so no interval: its ends are NaN.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
Ints = NDArray[np.int64]

RESAMPLES = 1000
CONFIDENCE = 0.95
_AT_ONCE = 4_000_000  # weights in memory


@dataclass(frozen=True)
class Estimate:
    """A statistic and its interval, in the unit of the values; NaN is not known."""

    value: float
    low: float
    high: float


NOT_KNOWN = Estimate(float("nan"), float("nan"), float("nan"))


def quantiles(
    values: NDArray[Any],
    cluster: NDArray[Any],
    shares: Sequence[float],
    *,
    rng: np.random.Generator,
    resamples: int = RESAMPLES,
    confidence: float = CONFIDENCE,
) -> list[Estimate]:
    """Quantiles of values (N,) whose clusters are (N,), each value counting once.

    A quantile is the smallest value that has at least that share of the values at or below it.
    """
    values = np.asarray(values, np.float64)
    if not len(values):
        return [NOT_KNOWN] * len(shares)
    order = np.argsort(values, kind="stable")
    values, place = values[order], np.unique(cluster, return_inverse=True)[1].reshape(-1)[order]
    number = int(place.max()) + 1
    at = _quantile_rows(values, np.ones((1, len(values))), shares)[0]
    if number < 2:
        return [Estimate(float(value), float("nan"), float("nan")) for value in at]
    draws, chunk = [], max(_AT_ONCE // len(values), 1)
    for start in range(0, resamples, chunk):
        counts = _draw(number, min(chunk, resamples - start), rng)
        draws.append(_quantile_rows(values, counts[:, place], shares))
    return _estimates(at, np.concatenate(draws), confidence)


def ratio(
    above: NDArray[Any],
    below: NDArray[Any],
    cluster: NDArray[Any],
    *,
    rng: np.random.Generator,
    resamples: int = RESAMPLES,
    confidence: float = CONFIDENCE,
) -> Estimate:
    """sum(above) / sum(below) of (N,) each; a mean where `below` is ones."""
    if not len(above) or not np.sum(below):
        return NOT_KNOWN
    place = np.unique(cluster, return_inverse=True)[1].reshape(-1)
    number = int(place.max()) + 1
    top = np.bincount(place, np.asarray(above, np.float64), number)
    bottom = np.bincount(place, np.asarray(below, np.float64), number)
    at = np.array([top.sum() / bottom.sum()])
    if number < 2:
        return Estimate(float(at[0]), float("nan"), float("nan"))
    counts = _draw(number, resamples, rng)
    with np.errstate(divide="ignore", invalid="ignore"):
        drawn = (counts @ top) / (counts @ bottom)
    drawn = drawn[np.isfinite(drawn)]
    return _estimates(at, drawn[:, None], confidence)[0] if len(drawn) else NOT_KNOWN


def _draw(clusters: int, resamples: int, rng: np.random.Generator) -> F64:
    """How often each cluster is drawn, (R, C)."""
    return rng.multinomial(clusters, np.full(clusters, 1 / clusters), resamples).astype(np.float64)


def _quantile_rows(values: F64, weights: F64, shares: Sequence[float]) -> F64:
    """Weighted quantiles (R, Q) of sorted values (N,) under weights (R, N)."""
    total = np.cumsum(weights, axis=1)
    found = np.empty((len(weights), len(shares)))
    for column, share in enumerate(shares):
        reached = total >= share * total[:, -1:] - 1e-9
        found[:, column] = values[np.argmax(reached, axis=1)]
    return found


def _estimates(at: F64, draws: F64, confidence: float) -> list[Estimate]:
    tail = (1 - confidence) / 2
    low, high = np.quantile(draws, [tail, 1 - tail], axis=0)
    return [
        Estimate(float(value), float(least), float(most))
        for value, least, most in zip(at, low, high, strict=True)
    ]
