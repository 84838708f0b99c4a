"""Test whether two samples of episodes differ, by how much, and if that could be chance.

The unit is the episode: rows of one are alike, and as rows they would make every trifle certain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64
from restock.stats import NOT_KNOWN, ConfidenceInterval

MIN_EPISODES = 5  # of each sample: fewer say nothing of its spread
_RESAMPLES_AT_ONCE = 50


@dataclass(frozen=True)
class Shift:
    """One figure of an episode in two samples."""

    episodes: tuple[int, int]
    mean: tuple[float, float]
    standardised: ConfidenceInterval  # difference of the means in units of their common spread
    ks: float  # the largest distance of the two distribution functions (Kolmogorov-Smirnov)
    p_value: float  # of that distance or a larger one, were both from one distribution


def shift(first: NDArray[Any], second: NDArray[Any]) -> Shift:
    """Compare a figure, one value per episode, in two samples (n,) and (m,); NaN is unknown.

    The interval of the standardised difference is the normal one of Hedges and Olkin (1985).
    From fewer than MIN_EPISODES episodes of either there is none, and no p-value.
    """
    samples = [np.asarray(values, np.float64) for values in (first, second)]
    a, b = (values[np.isfinite(values)] for values in samples)
    episodes = len(a), len(b)
    mean = tuple(float(values.mean()) if len(values) else float("nan") for values in (a, b))
    nan = float("nan")
    if min(episodes) < MIN_EPISODES:
        return Shift(episodes, (mean[0], mean[1]), NOT_KNOWN, nan, nan)
    from scipy.stats import ks_2samp

    test = ks_2samp(a, b)
    difference = standardised_difference(a, b)
    return Shift(
        episodes, (mean[0], mean[1]), difference, float(test.statistic), float(test.pvalue)
    )


def standardised_difference(
    first: F64, second: F64, confidence: float = 0.95
) -> ConfidenceInterval:
    """(mean(second) - mean(first)) / pooled spread, of two values each; 0 where all agree."""
    n, m = len(first), len(second)
    difference = float(second.mean() - first.mean())
    spread = np.sqrt(((n - 1) * first.var(ddof=1) + (m - 1) * second.var(ddof=1)) / (n + m - 2))
    if spread <= 1e-12 * max(abs(float(first.mean())), abs(float(second.mean())), 1e-12):
        value = 0.0 if abs(difference) <= 1e-12 else float(np.copysign(np.inf, difference))
        return ConfidenceInterval(value, value, value)
    value = difference / float(spread)
    error = np.sqrt((n + m) / (n * m) + value**2 / (2 * (n + m)))
    reach = NormalDist().inv_cdf(0.5 + confidence / 2) * float(error)
    return ConfidenceInterval(value, value - reach, value + reach)


def false_discovery_adjusted(p_values: Sequence[float]) -> list[float]:
    """P-values of several tests, adjusted (Benjamini and Hochberg 1995); NaN stays NaN.

    Of those that are below a level, at most that share is expected to be chance.
    """
    given = np.asarray(p_values, np.float64)
    known = np.flatnonzero(np.isfinite(given))
    order = known[np.argsort(given[known], kind="stable")]
    adjusted = np.full(len(given), np.nan)
    scaled = given[order] * len(order) / np.arange(1, len(order) + 1)
    adjusted[order] = np.minimum(np.minimum.accumulate(scaled[::-1])[::-1], 1.0)
    return [float(value) for value in adjusted]


def share_differences(
    first: Any, second: Any, groups: Sequence[slice], *, rng: np.random.Generator,
    resamples: int = 1000, confidence: float = 0.95,
) -> list[ConfidenceInterval]:  # fmt: skip
    """share in `second` less share in `first` of each value, with intervals over episodes.

    An episode that both have is one draw for both: what they share varies in neither. Resamples
    are Poisson's (each episode so many times, 1 in the mean), which shares cannot tell from
    drawing with replacement. One in which a sample has no rows has no shares, and does not count.
    With fewer than two episodes in a sample there is no interval: NaN. Nor is there a difference
    where a sample has no rows.

    Args:
        first, second: scipy sparse (E, V) rows of each episode of either, by value.
        groups: the values of one question each, whose shares sum to 1.
    """
    episodes = first.shape[0]
    value = _shares(first.sum(axis=0)[None], groups), _shares(second.sum(axis=0)[None], groups)
    at = (value[1] - value[0])[0]
    if min(np.count_nonzero(sample.sum(axis=1)) for sample in (first, second)) < 2:
        return [ConfidenceInterval(float(one), float("nan"), float("nan")) for one in at]
    draws = []
    for start in range(0, resamples, _RESAMPLES_AT_ONCE):
        times = rng.poisson(1.0, (min(_RESAMPLES_AT_ONCE, resamples - start), episodes))
        weights = times.astype(np.float64)
        draws.append(_shares(weights @ second, groups) - _shares(weights @ first, groups))
    tail = (1 - confidence) / 2
    low, high = np.nanquantile(np.concatenate(draws), [tail, 1 - tail], axis=0)
    return [
        ConfidenceInterval(float(one), float(least), float(most))
        for one, least, most in zip(at, low, high, strict=True)
    ]


def _shares(rows: Any, groups: Sequence[slice]) -> F64:
    """Divide rows (R, V) by the totals of their groups; NaN for a sample without rows."""
    rows = np.asarray(rows, np.float64)
    shares: F64 = np.full(rows.shape, np.nan)
    for group in groups:
        total = rows[:, group].sum(axis=1, keepdims=True)
        np.divide(rows[:, group], total, out=shares[:, group], where=total > 0)
    return shares
