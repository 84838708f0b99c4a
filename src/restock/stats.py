"""Statistics of evaluations and logs, with confidence intervals.

Intervals over episodes, of which there are many, are percentile bootstraps (Efron and Tibshirani
1993). They resample independent units: values within a stratum, or whole clusters, because segments
of one episode are not independent. Every draw uses the generator that the caller passes. Intervals
over training seeds, of which there are few, are Student's t.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64

CONFIDENCE = 0.95  # confidence level of all intervals
TAILS = [(1 - CONFIDENCE) / 2, 1 - (1 - CONFIDENCE) / 2]  # quantiles at an interval's ends
MIN_PAIRS = 3  # with fewer pairs, `paired_t` returns only the mean
_WEIGHTS_AT_ONCE = 4_000_000  # bootstrap weights that are held in memory at a time


@dataclass(frozen=True)
class ConfidenceInterval:
    """A statistic and its interval, in the unit of the values; NaN means unknown."""

    value: float
    low: float
    high: float

    def within(self, least: float, most: float = math.inf) -> ConfidenceInterval:
        """Return the interval, clipped to the range that the quantity can have."""
        low, high = np.clip([self.low, self.high], least, most).tolist()
        return ConfidenceInterval(self.value, low, high)


NOT_KNOWN = ConfidenceInterval(float("nan"), float("nan"), float("nan"))


def interval_text(value: float, low: float | None, high: float | None, form: str = ".2f") -> str:
    """Format a value, and its interval if there is one: `.52 [.41, .63]`."""
    return f"{value:{form}}" + ("" if low is None else f" [{low:{form}}, {high:{form}}]")


def no_interval_text(why: str | None) -> str:
    """Return the note for a value without an interval: ` (no interval: WHY)`."""
    return f" (no interval: {why})" if why else ""


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Return the Wilson score interval of a proportion; (0, 1) if there are no trials.

    Unlike the normal interval it stays inside [0, 1], and is not empty at 0 or n successes.
    """
    if not 0 <= successes <= trials:
        raise ValueError(f"successes must be in [0, trials], got {successes} of {trials}")
    if trials == 0:
        return 0.0, 1.0
    z = NormalDist().inv_cdf(0.5 + CONFIDENCE / 2)
    share = successes / trials
    centre = (share + z * z / (2 * trials)) / (1 + z * z / trials)
    half = (z / (1 + z * z / trials)) * math.sqrt(
        share * (1 - share) / trials + z * z / (4 * trials * trials)
    )
    # At 0 and n successes an end is exactly 0 or 1; rounding must not move it.
    low = 0.0 if successes == 0 else max(0.0, centre - half)
    high = 1.0 if successes == trials else min(1.0, centre + half)
    return low, high


def iqm(values: NDArray[Any]) -> float:
    """Return the interquartile mean, the mean of the middle half (arXiv:2108.13264)."""
    from scipy.stats import trim_mean

    return float(trim_mean(np.asarray(values, np.float64), 0.25, axis=None))


def mean(values: NDArray[Any]) -> float:
    return float(np.mean(values))


def median(values: NDArray[Any]) -> float:
    return float(np.median(values))


def improvement_of_arms(
    better: NDArray[Any],
    worse: NDArray[Any],
    *,
    rng: np.random.Generator,
    resamples: int = 2000,
) -> ConfidenceInterval:
    """Return P(a run of `better` beats a run of `worse` on an episode); a tie counts as half.

    It is the mean over episodes and all pairs of runs (arXiv:2108.13264). The bootstrap resamples
    the runs of each arm, and the episodes common to both, so the interval covers the variation
    over seeds and over episodes. The ends are NaN if an arm has only one run.

    Args:
        better, worse: (runs, episodes), the same episodes in the same order.
    """
    better, worse = np.asarray(better, np.float64), np.asarray(worse, np.float64)
    apart = better[:, None, :] - worse[None, :, :]
    wins = (apart > 0) + 0.5 * (apart == 0)  # (runs, runs, episodes)
    if min(len(better), len(worse)) < 2:
        return ConfidenceInterval(float(wins.mean()), float("nan"), float("nan"))
    weights = [cluster_counts(n, resamples, rng) / n for n in wins.shape]
    draws = np.einsum("ijk,ri,rj,rk->r", wins, *weights, optimize=True)
    return ConfidenceInterval(float(wins.mean()), *percentiles(draws))


def percentiles(draws: NDArray[Any]) -> tuple[float, float]:
    """Return the percentile interval of the bootstrap draws (R,) of a statistic."""
    low, high = np.quantile(draws, TAILS)
    return float(low), float(high)


def bootstrap(
    strata: Sequence[NDArray[Any]],
    statistic: Callable[[F64], float] = mean,
    *,
    rng: np.random.Generator,
    resamples: int = 2000,
) -> tuple[float, float]:
    """Return a stratified bootstrap interval of `statistic` over all values together.

    Each stratum (such as a condition) is resampled by itself, so every resample has the same number
    of values of each stratum: the episodes vary, the mix does not.
    """
    groups = [np.asarray(group, np.float64) for group in strata if len(group)]
    if not groups:
        raise ValueError("bootstrap needs at least one value")
    draws = np.empty(resamples)
    for index in range(resamples):
        sample = [group[rng.integers(len(group), size=len(group))] for group in groups]
        draws[index] = statistic(np.concatenate(sample))
    return percentiles(draws)


def mean_over_strata(
    strata: Sequence[NDArray[Any]],
    *,
    rng: np.random.Generator,
    resamples: int = 2000,
) -> ConfidenceInterval:
    """Return the mean of the means of strata (n,): each stratum has the same weight.

    If the values are differences of pairs, the interval is that of a paired bootstrap.
    """
    means = [
        values[rng.integers(len(values), size=(resamples, len(values)))].mean(axis=1)
        for values in strata
    ]
    value = float(np.mean([values.mean() for values in strata]))
    return ConfidenceInterval(value, *percentiles(np.mean(means, axis=0)))


def difference_of_arms(
    first: NDArray[Any],
    second: NDArray[Any],
) -> ConfidenceInterval:
    """Return mean(second) - mean(first) of two arms that drove the same episodes.

    Runs (of each arm) and episodes (common to both arms) are crossed random effects, so the
    interval covers the variation over seeds and over episodes. It is Student's t with
    Satterthwaite's degrees of freedom, because a percentile bootstrap is too narrow for five runs
    an arm. The ends are NaN if an arm has only one run, or if there is only one episode.

    Args:
        first, second: (runs, episodes), the same episodes in the same order.
    """
    from scipy.stats import t

    first, second = np.asarray(first, np.float64), np.asarray(second, np.float64)
    value, episodes = float(second.mean() - first.mean()), first.shape[1]
    if min(len(first), len(second), episodes) < 2:
        return ConfidenceInterval(value, float("nan"), float("nan"))
    parts = [  # variance of the difference and degrees of freedom: episodes, runs of each arm
        (float(np.var(second.mean(axis=0) - first.mean(axis=0), ddof=1)) / episodes, episodes - 1),
        *(
            (float(np.var(arm.mean(axis=1), ddof=1)) / len(arm), len(arm) - 1)
            for arm in (first, second)
        ),
    ]
    # The interaction of runs and episodes is in the variances of both sources: subtract it once.
    both = sum(_interaction(arm) / arm.size for arm in (first, second))
    variance = max(sum(part for part, _ in parts) - both, max(part for part, _ in parts))
    if variance == 0:
        return ConfidenceInterval(value, value, value)
    freedom = sum(part for part, _ in parts) ** 2 / sum(part**2 / df for part, df in parts)
    half = float(t.ppf(0.5 + CONFIDENCE / 2, freedom)) * math.sqrt(variance)
    return ConfidenceInterval(value, value - half, value + half)


def _interaction(arm: F64) -> float:
    """Return the residual variance of values (runs, episodes) after run and episode means."""
    left = arm - arm.mean(axis=1, keepdims=True) - arm.mean(axis=0, keepdims=True) + arm.mean()
    return float((left**2).sum() / ((arm.shape[0] - 1) * (arm.shape[1] - 1)))


def paired_t(differences: NDArray[Any]) -> tuple[ConfidenceInterval, float]:
    """Return the mean of paired differences (n,) with its Student's t interval, and the p value.

    With n = 5 the interval has its nominal coverage of .95; a percentile bootstrap has .84 to .91.
    The ends and p are NaN for fewer than `MIN_PAIRS` values, or if all values are the same.
    """
    from scipy.stats import ttest_1samp

    values = np.asarray(differences, np.float64)
    value = float(values.mean())
    if len(values) < MIN_PAIRS or nothing_varies(values):
        return ConfidenceInterval(value, float("nan"), float("nan")), float("nan")
    test = ttest_1samp(values, 0.0)
    low, high = test.confidence_interval(CONFIDENCE)
    return ConfidenceInterval(value, float(low), float(high)), float(test.pvalue)


def nothing_varies(values: NDArray[Any]) -> bool:
    """Return whether all values (n,) are the same up to rounding."""
    return bool(np.allclose(values, values[0], rtol=1e-9, atol=1e-12))


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p values adjusted for multiple tests, in the given order (Holm 1979).

    If those below alpha are rejected, the probability of any false rejection is at most alpha.
    """
    p = np.asarray(p_values, np.float64)
    order = np.argsort(p, kind="stable")
    steps = np.minimum((len(p) - np.arange(len(p))) * p[order], 1.0)
    adjusted = np.empty_like(p)
    adjusted[order] = np.maximum.accumulate(steps)
    return [float(value) for value in adjusted]


def which_adjusted(primary: bool) -> str:
    """Return a note on which p values `holm` adjusted."""
    if primary:
        return (
            "The primary contrast was named before the runs; p of the others is adjusted for their"
            " number (Holm)."
        )
    return (
        "None of these contrasts was named as primary before the runs: all p values are adjusted"
        " for their number (Holm)."
    )


def cluster_counts(clusters: int, resamples: int, rng: np.random.Generator) -> F64:
    """Draw how often each cluster is in each resample of a cluster bootstrap, (R, C)."""
    return rng.multinomial(clusters, np.full(clusters, 1 / clusters), resamples).astype(np.float64)


def for_few_clusters(interval: ConfidenceInterval, clusters: int) -> ConfidenceInterval:
    """Return the percentile interval of a bootstrap over C clusters, widened for small C.

    The interval is too narrow for small C: the variance of a bootstrap draw is (C - 1) / C of the
    statistic's variance, and the spread is itself an estimate. The distance of each end from the
    value is multiplied by t / z * sqrt(C / (C - 1)), where t is the quantile of Student's t with
    C - 1 degrees of freedom and z that of the normal distribution.
    """
    from scipy.stats import t

    if clusters < 2:
        return ConfidenceInterval(interval.value, float("nan"), float("nan"))
    normal = NormalDist().inv_cdf(0.5 + CONFIDENCE / 2)
    factor = float(t.ppf(0.5 + CONFIDENCE / 2, clusters - 1)) / normal
    factor *= math.sqrt(clusters / (clusters - 1))
    low, high = (
        interval.value + factor * (end - interval.value) for end in (interval.low, interval.high)
    )
    return ConfidenceInterval(interval.value, low, high)


def clustered_quantiles(
    values: NDArray[Any],
    cluster: NDArray[Any],
    shares: Sequence[float],
    *,
    rng: np.random.Generator,
    resamples: int = 1000,
) -> list[ConfidenceInterval]:
    """Return quantiles of values (N,) in clusters (N,); each value has the same weight.

    The quantile of a share in `shares` is the smallest value with at least that share of values at
    or below it. With only one cluster there is nothing to resample, and the ends are NaN.
    """
    values = np.asarray(values, np.float64)
    if not len(values):
        return [NOT_KNOWN] * len(shares)
    order = np.argsort(values, kind="stable")
    values, place = values[order], np.unique(cluster, return_inverse=True)[1].reshape(-1)[order]
    number = int(place.max()) + 1
    at = _quantile_rows(values, np.ones((1, len(values))), shares)[0]
    if number < 2:
        return [ConfidenceInterval(float(value), float("nan"), float("nan")) for value in at]
    draws, chunk = [], max(_WEIGHTS_AT_ONCE // len(values), 1)
    for start in range(0, resamples, chunk):
        counts = cluster_counts(number, min(chunk, resamples - start), rng)
        draws.append(_quantile_rows(values, counts[:, place], shares))
    return _intervals(at, np.concatenate(draws))


def clustered_ratio(
    above: NDArray[Any],
    below: NDArray[Any],
    cluster: NDArray[Any],
    *,
    rng: np.random.Generator,
    resamples: int = 1000,
) -> ConfidenceInterval:
    """Return sum(above) / sum(below) of arrays (N,); this is a mean if `below` is all ones.

    The ends are NaN if there is only one cluster, because there is nothing to resample.
    """
    if not len(above) or not np.sum(below):
        return NOT_KNOWN
    place = np.unique(cluster, return_inverse=True)[1].reshape(-1)
    number = int(place.max()) + 1
    top = np.bincount(place, np.asarray(above, np.float64), number)
    bottom = np.bincount(place, np.asarray(below, np.float64), number)
    at = np.array([top.sum() / bottom.sum()])
    if number < 2:
        return ConfidenceInterval(float(at[0]), float("nan"), float("nan"))
    counts = cluster_counts(number, resamples, rng)
    with np.errstate(divide="ignore", invalid="ignore"):
        drawn = (counts @ top) / (counts @ bottom)
    drawn = drawn[np.isfinite(drawn)]
    return _intervals(at, drawn[:, None])[0] if len(drawn) else NOT_KNOWN


def _quantile_rows(values: F64, weights: F64, shares: Sequence[float]) -> F64:
    """Return weighted quantiles (R, Q) of sorted values (N,) under weights (R, N)."""
    total = np.cumsum(weights, axis=1)
    rows = np.empty((len(weights), len(shares)))
    for column, share in enumerate(shares):
        reached = total >= share * total[:, -1:] - 1e-9
        rows[:, column] = values[np.argmax(reached, axis=1)]
    return rows


def _intervals(at: F64, draws: F64) -> list[ConfidenceInterval]:
    """Return the intervals of statistics (Q,) from their bootstrap draws (R, Q)."""
    low, high = np.quantile(draws, TAILS, axis=0)
    return [
        ConfidenceInterval(float(value), float(least), float(most))
        for value, least, most in zip(at, low, high, strict=True)
    ]
