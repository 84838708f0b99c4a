"""Decide whether a mean difference is above a limit, at any time while pairs come in.

A gambler bets that the mean is above a value c. After each difference x the wealth is multiplied by
1 + bet * (x - c), with a bet that is chosen before x is seen. If the mean is c or less, no bet
makes the wealth grow on average, so the probability that it ever reaches 1/error is at most `error`
(Ville's inequality). It may therefore be checked after every pair, and driving may stop once it
does.

Source: Waudby-Smith and Ramdas, "Estimating means of bounded random variables by betting",
arXiv:2010.09686. The bets are theirs, for the alternative that matters here: that both policies
are equally good.
"""

from __future__ import annotations

import math

import numpy as np

from restock.arrays import F64

NOT_WORSE, WORSE, NOT_SHOWN = "not worse", "worse", "not shown"  # verdicts on a limit
CANDIDATES = 400  # [-bound, bound] is cut into so many intervals; bets are made on each border
PRIOR_PAIRS = 50  # the assumed variance counts as much as this many pairs
CAUTION = 0.8  # share of the fastest-growing bet: fewer worse policies then pass by chance
MAX_STAKE = 0.9  # share of the wealth that a bet may lose


class ConfidenceSequence:
    """Bounds on the mean of differences within ±bound that hold for every number of pairs at once.

    Attributes:
        low, high: the bounds after each pair, lists of n. The probability that the mean is below
            any `low` is at most `error_low`; that it is above any `high`, at most `error_high`.
        above_at: number of pairs after which the mean was shown to be above `limit`, or None.
        below_at: number of pairs after which it was shown to be below `limit`, or None.
    """

    def __init__(
        self,
        bound: float,
        limit: float,
        *,
        variance: float,
        error_low: float = 0.05,
        error_high: float = 0.05,
    ) -> None:
        self.bound, self.limit = bound, limit
        grid = np.linspace(-bound, bound, CANDIDATES + 1)
        self.candidates: F64 = np.unique(np.append(grid, limit))
        self._limit_at = int(np.searchsorted(self.candidates, limit))
        self._variance = variance
        self._needed = math.log(1 / error_low), math.log(1 / error_high)
        self._wealth = np.zeros((2, len(self.candidates)))  # log wealth of bets on above, on below
        self._most = np.zeros_like(self._wealth)  # largest `_wealth` so far
        self.pairs, self._sum, self._squares = 0, 0.0, 0.0
        self.low: list[float] = []
        self.high: list[float] = []
        self.above_at: int | None = None
        self.below_at: int | None = None

    @property
    def mean(self) -> float | None:
        """Return the mean difference so far; None before the first pair."""
        return self._sum / self.pairs if self.pairs else None

    def add(self, difference: float) -> None:
        """Add one difference."""
        above, below = bets(
            self.candidates,
            self.pairs,
            self._sum,
            self._squares,
            bound=self.bound,
            variance=self._variance,
        )
        step = difference - self.candidates
        self._wealth[0] += np.log1p(above * step)
        self._wealth[1] += np.log1p(-below * step)
        np.maximum(self._most, self._wealth, out=self._most)
        self.pairs += 1
        self._sum += difference
        self._squares += difference**2
        not_below = self._most[0] < self._needed[0]  # candidates not shown to be below the mean
        not_above = self._most[1] < self._needed[1]
        self.low.append(float(self.candidates[not_below][0]) if not_below.any() else self.bound)
        self.high.append(float(self.candidates[not_above][-1]) if not_above.any() else -self.bound)
        if self.above_at is None and not not_below[self._limit_at]:
            self.above_at = self.pairs
        if self.below_at is None and not not_above[self._limit_at]:
            self.below_at = self.pairs


def bets(
    at: F64, pairs: int, total: F64 | float, squares: F64 | float, *, bound: float, variance: float
) -> tuple[F64, F64]:
    """Return the next bets that the mean is above, and below, each value `at`.

    The bet that makes wealth grow fastest is about gain / (spread + gain**2), where gain is the
    mean less the value. The mean is estimated from the differences so far and `PRIOR_PAIRS` zeros,
    but as at least half a negative value (when betting on below, at most half a positive one).

    Args:
        at: values, of any shape.
        pairs: number of differences so far.
        total, squares: sum of the differences, and of their squares; must broadcast with `at`.
        bound: the largest possible difference.
        variance: variance that is assumed before the first difference.
    """
    mean = total / (PRIOR_PAIRS + pairs)
    spread = (PRIOR_PAIRS * variance + squares) / (PRIOR_PAIRS + pairs)
    gain = np.maximum(np.maximum(mean, np.minimum(at / 2, 0.0)) - at, 0.0)
    above = np.minimum(CAUTION * gain / (spread + gain**2), MAX_STAKE / (bound + at + 1e-9))
    gain = np.maximum(at - np.minimum(mean, np.maximum(at / 2, 0.0)), 0.0)
    below = np.minimum(CAUTION * gain / (spread + gain**2), MAX_STAKE / (bound - at + 1e-9))
    return above, below


def pairs_needed(bound: float, limit: float, *, variance: float, error: float = 0.05) -> int:
    """Return how many pairs without a difference show that the mean is above `limit` < 0."""
    sequence = ConfidenceSequence(bound, limit, variance=variance, error_low=error)
    while sequence.above_at is None:
        sequence.add(0.0)
    return sequence.above_at
