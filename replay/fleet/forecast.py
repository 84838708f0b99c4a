"""How many more missions (or hours) a gap takes, forecast at the rates seen so far.

Two things are unknown: the rate, of which there is a sample of episodes (a Bayesian bootstrap,
Rubin 1981), and which of the coming missions will be rich ones (draws of episodes from it). Both
are in the interval. Where many missions are needed, the second is the normal one of renewal theory.
A kind of mission that never yielded a row has no rate: only a bound.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from restock.arrays import F64, Ints

REPLICATES = 200
_SIMULATED = 2000  # expected missions up to which they are drawn one by one


@dataclass(frozen=True)
class Forecast:
    """Of one kind of mission for one gap; amounts are missions or hours."""

    episodes: int  # that the rate is of
    seen: int  # of them had any
    rate: float  # rows (or episodes) for each
    rate_low: float  # 95 % interval
    rate_high: float
    draws: F64  # (R,) amounts that were needed in replicates; empty where nothing was ever seen

    @property
    def known(self) -> bool:
        return self.seen > 0

    def quantile(self, share: float) -> float:
        """Return the amount that is enough in this share of the replicates; inf without draws."""
        return float(np.quantile(self.draws, share)) if len(self.draws) else math.inf


def forecast(
    found: F64,
    amount: F64,
    missing: float,
    *,
    rng: np.random.Generator,
    replicates: int = REPLICATES,
) -> Forecast:
    """Forecast from the yields of episodes (E,), each of so many missions or hours (E,).

    Episodes of no length (of one step, say) count as none, and so do those without a yield (NaN).
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
    for index, weights in enumerate(_replicates(episodes, rng, replicates)):
        each = float(weights @ found) / max(float(weights @ amount), 1e-300)
        rates[index], draws[index] = each, _needed(found, amount, weights, each, missing, rng)
    low, high = np.quantile(rates, [0.025, 0.975])
    return Forecast(episodes, seen, rate, float(low), float(high), draws)


def _needed(
    found: F64, amount: F64, weights: F64, rate: float, missing: float, rng: np.random.Generator
) -> float:
    """Return the amount after which `missing` is reached, in one replicate."""
    if missing <= 0:
        return 0.0
    mean = float(weights @ found)
    episodes = missing / max(mean, 1e-300)
    if episodes > _SIMULATED:
        spread = math.sqrt(max(float(weights @ found**2) - mean**2, 0.0))
        return max(missing + spread * math.sqrt(episodes) * float(rng.normal()), 0.0) / rate
    total = spent = 0.0
    while True:
        drawn = _drawn(weights, math.ceil(episodes * 1.5) + 8, rng)
        reached = total + np.cumsum(found[drawn])
        if reached[-1] >= missing:
            last = int(np.searchsorted(reached, missing))
            return spent + float(amount[drawn[: last + 1]].sum())
        total, spent = float(reached[-1]), spent + float(amount[drawn].sum())


def missions_to_see_one(without: int) -> int:
    """Return the missions that would show, with 95 %, what `without` missions did not, at best.

    At best means at the highest rate that is still plausible: the exact (Clopper-Pearson) bound at
    which `without` missions show none with 5 %. As many again then show one with 95 %.
    """
    return max(without, 1)


def probability_to_close(
    parts: list[tuple[F64, int]],
    missing: float,
    *,
    rng: np.random.Generator,
) -> float:
    """Return the probability that planned missions yield what is missing.

    `parts` are pairs of yields (E,) and a number of missions.
    """
    total = np.zeros(REPLICATES)
    for sample, missions in parts:
        found = sample[~np.isnan(sample)]
        if not len(found) or not missions or not found.any():
            continue
        found = np.append(found, 0.0)
        for index, weights in enumerate(_replicates(len(found) - 1, rng, REPLICATES)):
            if missions > _SIMULATED:
                mean = float(weights @ found)
                spread = math.sqrt(max(float(weights @ found**2) - mean**2, 0.0))
                chance = spread * math.sqrt(missions) * float(rng.normal())
                total[index] += missions * mean + chance
            else:
                total[index] += found[_drawn(weights, missions, rng)].sum()
    return float((total >= missing).mean())


def _replicates(episodes: int, rng: np.random.Generator, count: int) -> Iterator[F64]:
    """Yield the weights of E episodes and one more, (E + 1,), in each replicate.

    The additional one, of half a weight, yields nothing: even if each of a few episodes did, the
    next may not.
    """
    prior = np.append(np.ones(episodes), 0.5)
    return (rng.dirichlet(prior) for _ in range(count))


def _drawn(weights: F64, size: int, rng: np.random.Generator) -> Ints:
    """Return so many drawn episodes, each with its weight (E,)."""
    steps = np.cumsum(weights)
    drawn = np.searchsorted(steps, rng.random(size) * steps[-1], side="right")
    return np.asarray(np.minimum(drawn, len(weights) - 1), np.int64)
