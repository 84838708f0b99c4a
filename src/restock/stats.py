"""Statistics of evaluations: intervals that say how much a number can be trusted."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


def wilson(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """The Wilson score interval of a proportion; (0, 1) without trials.

    Unlike the normal interval it stays inside [0, 1] and has a width at 0 and n successes.
    """
    if not 0 <= successes <= trials:
        raise ValueError(f"successes must be in [0, trials], got {successes} of {trials}")
    if trials == 0:
        return 0.0, 1.0
    from statistics import NormalDist

    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    share = successes / trials
    centre = (share + z * z / (2 * trials)) / (1 + z * z / trials)
    half = (z / (1 + z * z / trials)) * math.sqrt(
        share * (1 - share) / trials + z * z / (4 * trials * trials)
    )
    # At the ends the formula is exact; rounding must not push the interval past them.
    low = 0.0 if successes == 0 else max(0.0, centre - half)
    high = 1.0 if successes == trials else min(1.0, centre + half)
    return low, high


def iqm(values: NDArray[Any]) -> float:
    """The interquartile mean: of the middle half of all values (arXiv:2108.13264)."""
    from scipy.stats import trim_mean

    return float(trim_mean(np.asarray(values, np.float64), 0.25, axis=None))


def mean(values: NDArray[Any]) -> float:
    return float(np.mean(values))


def median(values: NDArray[Any]) -> float:
    return float(np.median(values))


def bootstrap(
    strata: Sequence[NDArray[Any]],
    statistic: Callable[[F64], float] = mean,
    *,
    rng: np.random.Generator,
    resamples: int = 2000,
    confidence: float = 0.95,
) -> tuple[float, float]:
    """A stratified percentile bootstrap interval of `statistic` over all values together.

    Each stratum (a condition, say) is resampled within itself, so that every resample holds the
    same number of values of each: what varies is the episodes, not the mix.
    """
    groups = [np.asarray(group, np.float64) for group in strata if len(group)]
    if not groups:
        raise ValueError("bootstrap needs at least one value")
    draws = np.empty(resamples)
    for index in range(resamples):
        sample = [group[rng.integers(len(group), size=len(group))] for group in groups]
        draws[index] = statistic(np.concatenate(sample))
    return percentiles(draws, confidence)


def percentiles(draws: NDArray[Any], confidence: float = 0.95) -> tuple[float, float]:
    """The percentile interval of a statistic's bootstrap draws (R,)."""
    tail = (1 - confidence) / 2
    low, high = np.quantile(draws, [tail, 1 - tail])
    return float(low), float(high)


def probability_of_improvement(better: NDArray[Any], worse: NDArray[Any]) -> float:
    """P(a value of `better` beats one of `worse`), ties counting half (Mann-Whitney)."""
    difference = np.asarray(better, np.float64)[:, None] - np.asarray(worse, np.float64)[None, :]
    return float(np.mean((difference > 0) + 0.5 * (difference == 0)))
