"""Forecast how many more missions (or hours) a gap needs, at the rates seen so far.

Two things are uncertain: the rate, which is estimated from a sample of episodes (Bayesian
bootstrap, Rubin 1981), and the yields of the coming missions (episodes drawn from that sample). The
interval includes both. If many missions are needed, the second is approximated by renewal theory's
normal distribution. A kind of mission that never yielded a row has no rate, only a bound.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from restock.arrays import F64, Ints

REPLICATES = 200
_SIMULATED = 2000  # up to this number of missions, each is drawn; more are approximated


@dataclass(frozen=True)
class Forecast:
    """How many missions or hours of one kind are needed to fill one gap."""

    episodes: int  # number of episodes from which the rate is estimated
    seen: int  # number of these episodes that contributed to the gap
    rate: float  # rows (or episodes) per mission or hour
    rate_low: float  # 95 % interval
    rate_high: float
    draws: F64  # (R,) missions or hours needed in R replicates; empty if `seen` is 0

    @property
    def known(self) -> bool:
        return self.seen > 0

    def quantile(self, share: float) -> float:
        """Return the missions or hours that suffice in this share of replicates; inf if unknown."""
        return float(np.quantile(self.draws, share)) if len(self.draws) else math.inf


def forecast(
    found: F64,
    amount: F64,
    missing: float,
    *,
    rng: np.random.Generator,
    replicates: int = REPLICATES,
) -> Forecast:
    """Forecast how many missions or hours will yield `missing` more rows (or episodes).

    `found` (E,) is what each past episode yielded, `amount` (E,) its missions (1) or hours.
    Episodes with amount 0 (for example of one step) or with yield NaN are ignored.
    """
    used = (amount > 0) & ~np.isnan(found)
    found, amount = found[used], amount[used]
    episodes, seen = len(found), int((found > 0).sum())
    nan = float("nan")
    if not seen:
        return Forecast(episodes, 0, 0.0 if episodes else nan, nan, nan, np.zeros(0))
    rate = float(found.sum() / amount.sum())
    amount = np.append(amount, amount.mean())
    rates, draws = np.zeros(replicates), np.zeros(replicates)
    found = np.append(found, 0.0)
    for index, weights in enumerate(_bootstrap_weights(episodes, rng, replicates)):
        each = float(weights @ found) / max(float(weights @ amount), 1e-300)
        rates[index], draws[index] = (
            each,
            _simulate_amount(found, amount, weights, each, missing, rng),
        )
    low, high = np.quantile(rates, [0.025, 0.975])
    return Forecast(episodes, seen, rate, float(low), float(high), draws)


def _simulate_amount(
    found: F64, amount: F64, weights: F64, rate: float, missing: float, rng: np.random.Generator
) -> float:
    """Simulate one replicate; return the missions or hours until the yield reaches `missing`."""
    if missing <= 0:
        return 0.0
    mean = float(weights @ found)
    episodes = missing / max(mean, 1e-300)
    if episodes > _SIMULATED:
        spread = math.sqrt(max(float(weights @ found**2) - mean**2, 0.0))
        return max(missing + spread * math.sqrt(episodes) * float(rng.normal()), 0.0) / rate
    total = spent = 0.0
    while True:
        drawn = _draw_episodes(weights, math.ceil(episodes * 1.5) + 8, rng)
        reached = total + np.cumsum(found[drawn])
        if reached[-1] >= missing:
            last = int(np.searchsorted(reached, missing))
            return spent + float(amount[drawn[: last + 1]].sum())
        total, spent = float(reached[-1]), spent + float(amount[drawn].sum())


def missions_to_see_one(without: int) -> int:
    """Return how many more missions are needed, at least, to see one event with probability 95 %.

    `without` missions have shown no event so far. The largest plausible rate is the exact
    (Clopper-Pearson) bound: at that rate, `without` missions show no event with probability 5 %, so
    that another `without` missions show one with probability 95 %.
    """
    return max(without, 1)


def probability_to_close(
    parts: list[tuple[F64, int]],
    missing: float,
    *,
    rng: np.random.Generator,
) -> float:
    """Return the probability that planned missions yield at least `missing`.

    `parts` are pairs: yields of past episodes (E,), and the number of planned missions.
    """
    total = np.zeros(REPLICATES)
    for sample, missions in parts:
        found = sample[~np.isnan(sample)]
        if not len(found) or not missions or not found.any():
            continue
        found = np.append(found, 0.0)
        for index, weights in enumerate(_bootstrap_weights(len(found) - 1, rng, REPLICATES)):
            if missions > _SIMULATED:
                mean = float(weights @ found)
                spread = math.sqrt(max(float(weights @ found**2) - mean**2, 0.0))
                chance = spread * math.sqrt(missions) * float(rng.normal())
                total[index] += missions * mean + chance
            else:
                total[index] += found[_draw_episodes(weights, missions, rng)].sum()
    return float((total >= missing).mean())


def _bootstrap_weights(episodes: int, rng: np.random.Generator, count: int) -> Iterator[F64]:
    """Yield the weights (E + 1,) of E episodes and an additional one, for each replicate.

    The additional episode has half the weight and yield 0: even if every one of a few episodes had
    a yield, the next may have none.
    """
    prior = np.append(np.ones(episodes), 0.5)
    return (rng.dirichlet(prior) for _ in range(count))


def _draw_episodes(weights: F64, size: int, rng: np.random.Generator) -> Ints:
    """Draw `size` episodes with replacement, in proportion to weights (E,)."""
    steps = np.cumsum(weights)
    drawn = np.searchsorted(steps, rng.random(size) * steps[-1], side="right")
    return np.asarray(np.minimum(drawn, len(weights) - 1), np.int64)
