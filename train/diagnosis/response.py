"""How one quantity answers to another: by how much, how late, and how much it leaves unexplained.

`y(t) = sum over lags k of h_k x(t - k)`, by least squares over the rows. The gain is the sum of h,
the delay its centre of mass in steps: of a robot that answers to its commands by a ramp, a step
late, some have followed after one step and all after two. Commands resemble their neighbours in
time, so a single correlation peaks broadly; the lags fitted together do not. Sampling error is
that of a bootstrap over whole episodes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Bools, Ints
from restock.stats import ConfidenceInterval, cluster_counts, for_few_clusters, percentiles

RESAMPLES = 200
MIN_CLUSTERS = 5
_RIDGE = 1e-4  # of the mean diagonal: lags that the rows do not tell apart


@dataclass(frozen=True)
class Response:
    """A fitted response, with its R bootstrap draws."""

    rows: int
    clusters: int
    gain: float
    delay: float  # steps
    unexplained: float  # of y's mean square
    gains: F64  # (R,)
    delays: F64  # (R,)
    unexplained_draws: F64  # (R,)


def fit_response(
    x: F64, y: F64, cluster: Ints, lags: Ints, rng: np.random.Generator
) -> Response | None:
    """The response of y (n,) to x (n, L) at `lags` (L,); None where too little is known.

    Rows with a value that is not finite are left out.
    """
    known = np.isfinite(y) & np.isfinite(x).all(axis=1)
    x, y = x[known], y[known]
    place = np.unique(cluster[known], return_inverse=True)[1].reshape(-1)
    clusters = int(place.max(initial=-1)) + 1
    if clusters < MIN_CLUSTERS or not (y**2).sum() or not (x**2).sum():
        return None
    joint = np.concatenate([x, y[:, None]], axis=1)
    width = joint.shape[1]
    moments = np.stack(
        [
            np.bincount(place, joint[:, i] * joint[:, j], clusters)
            for i in range(width)
            for j in range(width)
        ],
        axis=1,
    )  # (C, W * W)
    counts = np.concatenate([np.ones((1, clusters)), cluster_counts(clusters, RESAMPLES, rng)])
    drawn = (counts @ moments).reshape(-1, width, width)
    xx, xy, yy = drawn[:, :-1, :-1], drawn[:, :-1, -1], drawn[:, -1, -1]
    ridge = _RIDGE * np.trace(xx, axis1=1, axis2=2) / (width - 1)
    ridge = np.where(ridge > 0.0, ridge, ridge[0])  # a draw may have only clusters without a change
    h = np.linalg.solve(xx + ridge[:, None, None] * np.eye(width - 1), xy[..., None])[..., 0]
    gain = h.sum(axis=1)
    safe = np.where(np.abs(gain) > 1e-9, gain, 1e-9)
    delay = (h * lags).sum(axis=1) / safe
    left = yy - 2 * (h * xy).sum(axis=1) + np.einsum("ri,rij,rj->r", h, xx, h)
    unexplained = np.clip(left / np.maximum(yy, 1e-12), 0.0, None)
    return Response(
        len(y), clusters, float(gain[0]), float(delay[0]), float(unexplained[0]),
        gain[1:], delay[1:], unexplained[1:],
    )  # fmt: skip


def ratio_of(above: F64, below: F64, at: tuple[float, float], clusters: int) -> ConfidenceInterval:
    """A ratio of two statistics with independent draws (R,) each, and the values `at`.

    `clusters` are those of the one that has fewer.
    """
    bottom = np.where(np.abs(below) > 1e-9, below, np.nan)
    return interval_of(at[0] / at[1] if at[1] else float("nan"), above / bottom, clusters)


def difference_of(
    first: F64, second: F64, at: tuple[float, float], clusters: int
) -> ConfidenceInterval:
    """A difference of two statistics with independent draws (R,) each, and the values `at`.

    `clusters` are those of the one that has fewer.
    """
    return interval_of(at[0] - at[1], first - second, clusters)


def interval_of(value: float, draws: NDArray[np.float64], clusters: int) -> ConfidenceInterval:
    """That of a statistic with draws (R,) over so many clusters; NaN where it is not known."""
    finite = draws[np.isfinite(draws)]
    if not len(finite) or not np.isfinite(value):
        return ConfidenceInterval(value, float("nan"), float("nan"))
    return for_few_clusters(ConfidenceInterval(value, *percentiles(finite)), clusters)


def lagged(x: F64, before: list[tuple[Ints, Bools]]) -> F64:
    """x (N,) at each of L lags, (N, L); NaN where the row of that lag is not known."""
    return np.stack([np.where(known, x[row], np.nan) for row, known in before], axis=1)


__all__ = ["Response", "difference_of", "fit_response", "interval_of", "lagged", "ratio_of"]
