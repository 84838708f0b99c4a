"""Estimators of what a policy is worth, from episodes that other policies drove.

Two estimators, over n logged episodes padded to T steps:

- fitted Q evaluation (`restock.train.dqn.fitted_q`; Le et al. 2019, arXiv:1903.08738): the mean of
  the fitted model's V(s_0). No importance weights, and as wrong as the model is;
- per-decision weighted importance sampling (Precup, Sutton and Singh 2000): each reward counts by
  how much likelier the evaluated policy was to get that far. No model; consistent.

The weights of two policies that differ grow apart with every step, until one episode outweighs all
others. If the effective sample size is below a stated share of the episodes, the weighted estimate
is refused: a number from one episode is not printed as if it were from a hundred.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from restock.arrays import F64, Bools
from restock.stats import cluster_counts, percentiles

FQE, PDWIS, LOGGED = "fqe", "pdwis", "logged"
_TINY = 1e-300


@dataclass(frozen=True)
class OpeEpisodes:
    """Logged episodes as the evaluated policy sees them; after the end `ratio` is 1, `reward` 0."""

    ratio: F64  # (n, T) probability of the action, evaluated policy / behaviour policy
    reward: F64  # (n, T)
    start_value: F64  # (n,) the fitted model's value of the first observation
    discount: float

    def __len__(self) -> int:
        return len(self.ratio)

    def select(self, episodes: Bools) -> OpeEpisodes:
        """Select some of the episodes."""
        return replace(
            self,
            ratio=self.ratio[episodes],
            reward=self.reward[episodes],
            start_value=self.start_value[episodes],
        )

    def until(self, horizon: int | None) -> OpeEpisodes:
        """Return the first `horizon` steps; importance sampling then sees no later reward."""
        return replace(self, ratio=self.ratio[:, :horizon], reward=self.reward[:, :horizon])

    @property
    def discounts(self) -> F64:
        """The discount of each step, (T,)."""
        return np.asarray(self.discount ** np.arange(self.reward.shape[1]), np.float64)


def once(episodes: int) -> F64:
    """Every episode counted once: (1, n)."""
    return np.ones((1, episodes))


def log_weights(ratio: F64) -> F64:
    """Return the log of each episode's product of ratios up to each step, (n, T); -inf for 0."""
    with np.errstate(divide="ignore"):
        return np.cumsum(np.log(ratio), axis=1)


def relative_weights(ratio: F64) -> F64:
    """Products of ratios up to each step (n, T), the largest of each step 1: only shares count."""
    logs = log_weights(ratio)
    most = logs.max(axis=0, initial=-np.inf)
    return np.exp(logs - np.where(np.isfinite(most), most, 0.0))


def per_decision(logged: OpeEpisodes, counts: F64, *, weighted: bool = True) -> F64:
    """Estimate by per-decision importance sampling; `counts` (B, n) of each episode -> (B,).

    Unweighted it is unbiased, and its variance grows with every step; weighted it is consistent.
    """
    weight = relative_weights(logged.ratio) if weighted else np.exp(log_weights(logged.ratio))
    total = counts @ weight if weighted else counts.sum(axis=1, keepdims=True)
    means = counts @ (weight * logged.reward) / np.maximum(total, _TINY)  # (B, T)
    return np.asarray(means @ logged.discounts, np.float64)


def fitted(logged: OpeEpisodes, counts: F64) -> F64:
    """Return the model's mean value of the starts; `counts` (B, n) -> (B,)."""
    return np.asarray(counts @ logged.start_value / counts.sum(axis=1), np.float64)


def observed(logged: OpeEpisodes, counts: F64) -> F64:
    """Return what the behaviour policies achieved themselves; `counts` (B, n) -> (B,)."""
    return np.asarray(counts @ (logged.reward @ logged.discounts) / counts.sum(axis=1), np.float64)


def effective_episodes(ratio: F64) -> F64:
    """Return the effective number of episodes at each step, (T,) (Kish 1965)."""
    weight = relative_weights(ratio)
    return np.asarray(
        weight.sum(axis=0) ** 2 / np.maximum((weight**2).sum(axis=0), _TINY), np.float64
    )


@dataclass(frozen=True)
class EssGate:
    """What importance weights must be worth, at every step, for their estimates to be shown."""

    share: float = 0.2  # of the episodes
    episodes: float = 5.0

    def refusal(self, logged: OpeEpisodes) -> str | None:
        """Why the estimators that weigh are refused, or None."""
        least, reach = self.measure(logged)
        if reach == logged.ratio.shape[1] and len(logged):
            return None
        if len(logged) < self.episodes:  # refused even if policy and logs agree to the end
            noun = "episode" if len(logged) == 1 else "episodes"
            return f"{len(logged)} {noun}, and weights take at least {self.episodes:g}"
        return (
            f"the importance weights leave an effective sample of {least:.1f} of {len(logged)}"
            f" episodes, less than {max(self.episodes, self.share * len(logged)):.1f}: policy and"
            f" logs agree for {reach} of {logged.ratio.shape[1]} steps"
        )

    def measure(self, logged: OpeEpisodes) -> tuple[float, int]:
        """Return the least effective number of episodes, and how many first steps have enough."""
        if not len(logged):
            return 0.0, 0
        effective = effective_episodes(logged.ratio)
        short = np.flatnonzero(effective < max(self.episodes, self.share * len(logged)))
        reach = int(short[0]) if len(short) else len(effective)
        return float(effective.min(initial=np.inf)), reach


@dataclass(frozen=True)
class OpeEstimate:
    """One estimator's answer: a value with its interval, or why there is none."""

    estimator: str
    value: float | None
    low: float | None = None  # None: a single episode has no interval, nor has FQE
    high: float | None = None
    refused: str | None = None


def estimate(
    logged: OpeEpisodes,
    *,
    gate: EssGate = EssGate(),
    horizon: int | None = None,
    rng: np.random.Generator,
    resamples: int = 2000,
    confidence: float = 0.95,
) -> list[OpeEstimate]:
    """Every estimator, with a percentile bootstrap interval over whole episodes.

    The interval holds what other episodes would have changed. FQE has none: it is the model's word
    on the starts, and an interval over them would leave out what is wrong with the model.
    """
    near = logged.until(horizon)
    refused = gate.refusal(near)
    counts = cluster_counts(len(logged), resamples, rng)
    answers = []
    for name, of, estimator in (
        (LOGGED, logged, observed),
        (FQE, logged, fitted),
        (PDWIS, near, per_decision),
    ):
        if name == PDWIS and refused is not None:
            answers.append(OpeEstimate(name, None, refused=refused))
            continue
        value = float(estimator(of, once(len(logged)))[0])
        if name == FQE or len(logged) < 2:
            answers.append(OpeEstimate(name, value))
            continue
        interval = percentiles(estimator(of, counts), confidence)
        answers.append(OpeEstimate(name, value, *interval))
    return answers


__all__ = [
    "EssGate",
    "OpeEpisodes",
    "OpeEstimate",
    "estimate",
    "fitted",
    "per_decision",
]
