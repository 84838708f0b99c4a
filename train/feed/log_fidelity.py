"""Whether logged rows are what their labels say, and follow from one another.

A critic's errors do not show every fault of its replay: rows whose labels are wrong, or whose next
observations are not what followed, may be memorised like any others. Two questions to the
rows themselves do, for each condition of the logs:

- *agreement*: how many of its rows a linear discriminant (Fisher 1936), trained on the conditions
  and observations of fresh steps, assigns to it: those of the evaluation and those of the ring,
  for a good policy's evaluation may show few of a rare condition, and not those that logs have;
- *unexplained*: how much of the variance of its next observations a linear model of observation
  and action, fitted on half of the logs' rows, leaves unexplained on the other half. Above 1, the
  mean would be a better guess.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64
from restock.train.feed.logs import Logs
from restock.train.feed.probe import Probe

ROWS = 512  # of each condition, chosen by hash
_MIN_ROWS = 50  # of a condition, to count
_SHRINKAGE = 0.05  # of the covariance towards its diagonal's mean
_RIDGE = 1.0  # on standardised features


class LogFidelity:
    """Rows of each condition of a run's logs.

    `unexplained` holds a condition's share of variance, >= 0; conditions of few rows are left out.
    """

    def __init__(self, rows: Probe, observation_size: int) -> None:
        self._names, self._bounds = rows.conditions, rows.bounds
        packed = np.asarray(rows.rows.numpy(), np.float64)
        self._observation = packed[:, :observation_size]
        self.unexplained = self._unexplained(
            packed[:, observation_size : 2 * observation_size], packed[:, 2 * observation_size]
        )

    @classmethod
    def of(cls, logs: Logs, observation_size: int) -> LogFidelity | None:
        """None where there is no row."""
        rows = Probe.of_logs(logs, ROWS)
        return cls(rows, observation_size) if rows is not None else None

    def agreement(self, *fresh: Probe) -> dict[str, float]:
        """The share of each condition's rows that fresh steps of known condition confirm."""
        size = self._observation.shape[1]
        steps: dict[str, list[F64]] = {}
        for probe in fresh:
            observation = np.asarray(probe.rows.numpy(), np.float64)[:, :size]
            for name, (begin, end) in zip(probe.conditions, pairwise(probe.bounds), strict=True):
                steps.setdefault(name, []).append(observation[begin:end])
        every = {name: np.concatenate(parts) for name, parts in sorted(steps.items())}
        names = [name for name, rows in every.items() if len(rows) >= _MIN_ROWS]
        if len(names) < 2:
            return {}
        parts = [every[name] for name in names]
        predicted = discriminant(parts, self._observation)
        return {
            name: float(np.mean(predicted[part] == names.index(name)))
            for name, part in self._parts()
            if name in names
        }

    def _unexplained(self, next_observation: F64, action: F64) -> dict[str, float]:
        """`next_observation` (n, D) are next observations, `action` (n,) indices."""
        taken = np.eye(int(action.max()) + 1)[action.astype(np.int64)]
        features = _standard(np.concatenate([self._observation, taken], axis=1))
        features = np.concatenate([features, np.ones((len(features), 1))], axis=1)
        target = _standard(next_observation)
        fit = np.arange(len(features)) % 2 == 0  # rows of a condition are in the order of a hash
        x, y = features[fit], target[fit]
        weights = np.linalg.solve(x.T @ x + _RIDGE * np.eye(x.shape[1]), x.T @ y)
        error = (target - features @ weights) ** 2
        shares = {}
        for name, part in self._parts():
            tested = np.arange(part.start, part.stop)
            tested = tested[~fit[part]]
            spread = ((target[tested] - target[tested].mean(axis=0)) ** 2).sum()
            if spread > 0:
                shares[name] = float(error[tested].sum() / spread)
        return shares

    def _parts(self) -> list[tuple[str, slice]]:
        return [
            (name, slice(self._bounds[index], self._bounds[index + 1]))
            for index, name in enumerate(self._names)
            if self._bounds[index + 1] - self._bounds[index] >= _MIN_ROWS
        ]


def discriminant(classes: list[F64], rows: F64) -> NDArray[np.int64]:
    """Which class each of `rows` (m, D) most likely is of, (m,), all classes being equally likely.

    `classes` are rows (n_k, D) of each; their covariance is taken to be the same.
    """
    means = np.stack([part.mean(axis=0) for part in classes])
    within = [np.cov(part, rowvar=False) for part in classes]
    covariance = np.mean(within, axis=0)
    covariance = (1 - _SHRINKAGE) * covariance
    covariance += _SHRINKAGE * np.eye(len(covariance)) * np.trace(covariance) / len(covariance)
    direction = np.linalg.solve(covariance, means.T)  # (D, K)
    score = rows @ direction - 0.5 * np.einsum("kd,dk->k", means, direction)
    return np.asarray(score.argmax(axis=1), np.int64)


def _standard(values: F64) -> F64:
    spread = values.std(axis=0)
    return np.asarray((values - values.mean(axis=0)) / np.where(spread > 1e-9, spread, 1.0))


__all__ = ["LogFidelity", "discriminant"]
