"""The logged rows of a run, and fixed rows per condition that critic and labels are measured on.

`Probe` holds a few rows per condition, fixed for the whole run. Batches change with the policy and
the mixture; the probe does not. So TD error by condition and the distance between the two networks'
values can be compared over a run and between runs, as long as their probe hashes agree.

`LogFidelity` checks whether logged rows match their labels and their next observations. A critic's
errors do not show every fault of its replay: it can memorise rows with wrong labels or wrong next
observations like any others. Two measures per condition of the logs show them:

- *agreement*: the share of its rows that a linear discriminant (Fisher 1936), fitted to fresh steps
  of known condition, assigns to it. Fresh steps are those of the evaluation and of the ring,
  because the evaluation of a good policy may contain few steps of a rare condition;
- *unexplained*: the share of the variance of its next observations that a linear model of
  observation and action, fitted on half of the rows, leaves unexplained on the other half. Above 1,
  the mean would be a better guess.
"""

from __future__ import annotations

import hashlib
import warnings
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import torch
from numpy.typing import NDArray
from torch import Tensor

from restock.arrays import F32, F64, Bools, Ints
from restock.ingest.task.schema import GOLDEN, splitmix64
from restock.replay.mixture.share_controller import PlannedDraws
from restock.replay.panel.logged_sampler import LoggedSampler, sampler_by_shares, sampler_for
from restock.replay.sampling.ring import FreshRing
from restock.train.dqn.learner import Learner, value_lag

if TYPE_CHECKING:
    from restock.replay.panel.panel import Panel

_UNPLANNED = PlannedDraws()
_IN_MEMORY_BYTES = 4 << 30  # larger panels stay memory-mapped


@dataclass(frozen=True)
class Coded:
    """A column with few distinct values, as a code per row into `names`."""

    codes: NDArray[np.int32]  # (n,)
    names: list[str]

    @classmethod
    def of(cls, column: pa.ChunkedArray) -> Coded:
        encoded = column.combine_chunks().dictionary_encode()
        if isinstance(encoded, pa.ChunkedArray):
            encoded = encoded.combine_chunks()
        codes = encoded.indices.fill_null(len(encoded.dictionary))
        names = [*encoded.dictionary.to_pylist(), "unknown"]
        return cls(np.asarray(codes, np.int32), names)

    def name(self, row: int) -> str:
        return str(self.names[self.codes[row]])

    def known(self, row: int) -> str | None:
        """Return the text of a row, or None if the column has none."""
        code = self.codes[row]
        return str(self.names[code]) if code < len(self.names) - 1 else None


@dataclass(frozen=True)
class Logs:
    """The logged rows that a run draws from, with the columns that are recorded about them."""

    rows: Tensor  # (n, W) float32
    strata: list[str]
    timings: list[str]  # pre | post, of each stratum
    stratum_rows: list[Ints]  # the rows of each stratum
    shares: NDArray[np.float64]  # (S,) share of each stratum in the drawn rows
    weights: F32 | None  # (n,) importance weights, or None if all are 1
    as_of_ns: int  # time up to which the ages of rows are counted
    transition_id: Ints  # (n,)
    stamp_ns: Ints  # (n,) when rows were logged; not when measured, which may be simulated time
    condition: Coded
    behaviour_policy: Coded
    behaviour_version: Coded
    episode: Coded

    perturbation: Coded | None = None  # the twin's perturbation; null for rows from hardware
    panel: Panel | None = None  # the panel that the rows are from
    planned: PlannedDraws = _UNPLANNED  # the draws that the run plans

    @classmethod
    def of_panel(
        cls,
        panel: Panel,
        planned: PlannedDraws = _UNPLANNED,
        *,
        as_of_ns: int | None = None,
    ) -> Logs:
        """Read a panel's rows into memory (memory-mapped if it is larger than 4 GiB).

        Ages of rows are counted to `as_of_ns`, the start of training; None: to the newest row.
        """
        rows = np.asarray(panel.rows)
        if rows.nbytes <= _IN_MEMORY_BYTES:
            rows = np.array(rows)
        with warnings.catch_warnings():  # a read-only map is fine: nothing writes to it
            warnings.filterwarnings("ignore", message="The given NumPy array is not writable")
            tensor = torch.from_numpy(rows)
        weights = panel.weights
        meta = panel.meta
        return cls(
            rows=tensor,
            strata=[stratum.name for stratum in panel.strata],
            timings=[stratum.timing for stratum in panel.strata],
            stratum_rows=panel.stratum_rows(),
            shares=np.array([stratum.share for stratum in panel.strata]),
            weights=None if np.all(weights == 1) else weights,
            as_of_ns=panel.header.newest_ns if as_of_ns is None else as_of_ns,
            transition_id=np.asarray(meta["transition_id"], np.int64),
            stamp_ns=np.asarray(meta["logged_ns"], np.int64),
            condition=Coded.of(meta["condition"]),
            behaviour_policy=Coded.of(meta["behaviour_policy"]),
            behaviour_version=Coded.of(meta["behaviour_version"]),
            episode=Coded.of(meta["episode_id"]),
            perturbation=Coded.of(meta["perturbation"]),
            panel=panel,
            planned=planned,
        )

    def __len__(self) -> int:
        return len(self.rows)

    def sampler(
        self,
        batch_size: int,
        logs_share: float | None,
        seed: int,
        fresh: Bools | None = None,
    ) -> LoggedSampler:
        """Make the logged rows' sampler: by the panel's mixture, or by `shares` without a panel.

        `fresh` (S,) is whether rows of a ring can be in each stratum; None: there is no ring.

        Raises:
            MixtureError: see `sampler_for`.
        """
        if self.panel is None:
            return sampler_by_shares(
                self.rows.numpy(),
                self.strata,
                self.stratum_rows,
                self.shares,
                batch_size,
                seed=seed,
                logs_share=logs_share or 0.0,
                weights=self.weights,
            )
        return sampler_for(
            self.panel,
            batch_size,
            seed=seed,
            planned=self.planned,
            logs_share=logs_share,
            fresh=fresh,
        )


@dataclass(frozen=True)
class Probe:
    """Rows (n, W) float32, sorted by condition: c's rows are `rows[bounds[c] : bounds[c + 1]]`."""

    rows: Tensor
    conditions: list[str]
    bounds: list[int]
    source: str  # logs | fresh
    hash: str  # of the rows' bytes, 16 hex digits

    @classmethod
    def of_logs(cls, logs: Logs, per_condition: int) -> Probe | None:
        """Choose logged rows: the `per_condition` rows of each condition with the lowest hashes."""
        codes, names = logs.condition.codes, logs.condition.names
        return cls._choose(codes, names, logs.transition_id, per_condition, logs.rows, "logs")

    @classmethod
    def of_ring(cls, ring: FreshRing, per_condition: int) -> Probe | None:
        """Choose and copy labelled rows of the ring, for a run without logs."""
        count = len(ring)
        codes = ring.by_condition.stratum[:count].astype(np.int32)
        key = (ring.meta["episode"][:count] << 20) | ring.meta["episode_step"][:count]
        rows = torch.from_numpy(ring.rows[:count])
        return cls._choose(codes, list(ring.conditions), key, per_condition, rows, "fresh")

    @classmethod
    def _choose(
        cls,
        codes: NDArray[Any],
        names: list[str],
        key: NDArray[np.int64],
        per_condition: int,
        rows: Tensor,
        source: str,
    ) -> Probe | None:
        chosen: list[NDArray[np.int64]] = []
        kept, bounds = [], [0]
        for code, name in enumerate(names):
            members = np.flatnonzero(codes == code)
            if not len(members) or not per_condition:
                continue
            order = np.argsort(_scramble(key[members]), kind="stable")[:per_condition]
            chosen.append(members[order])
            kept.append(name)
            bounds.append(bounds[-1] + len(order))
        if not chosen:
            return None
        picked = rows[torch.from_numpy(np.concatenate(chosen))].clone()
        digest = hashlib.blake2b(picked.numpy().tobytes(), digest_size=8).hexdigest()
        return cls(picked, kept, bounds, source, digest)

    def measure(self, learner: Learner) -> tuple[list[dict[str, Any]], float]:
        """Return rows of the table `probe`, one per condition, and the values' lag in all rows."""
        td, q, slow = learner.td_error(self.rows.to(learner.device))
        action = self.rows[:, -3].long().to(learner.device)
        chosen = q.gather(1, action.unsqueeze(1)).squeeze(1)
        rows = []
        for index, name in enumerate(self.conditions):
            part = slice(self.bounds[index], self.bounds[index + 1])
            rows.append(
                {
                    "source": self.source,
                    "condition": name,
                    "rows": part.stop - part.start,
                    "td_abs_mean": float(td[part].abs().mean()),
                    "q_mean": float(chosen[part].mean()),
                    "q_lag": value_lag(q[part], slow[part]),
                    "probe_hash": self.hash,
                }
            )
        return rows, value_lag(q, slow)


def _scramble(key: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Hash ids (splitmix64), so that which rows are chosen does not depend on their order."""
    return splitmix64(key.astype(np.uint64) + np.uint64(GOLDEN))


PROBE_ROWS = 64  # rows per condition of a probe, fixed for the whole run
ROWS = 512  # rows per condition that fidelity is measured on, chosen by hash
_MIN_ROWS = 50  # conditions with fewer rows are left out
_SHRINKAGE = 0.05  # part of the discriminant's covariance that is replaced by the mean variance
_RIDGE = 1.0  # L2 penalty of the linear model on standardised features


class LogFidelity:
    """Measures of a run's logged rows, by condition: see the top of this file.

    `unexplained` is a share of variance, >= 0. Conditions with few rows are left out.
    """

    def __init__(self, rows: Probe, observation_size: int) -> None:
        self._names, self._bounds = rows.conditions, rows.bounds
        packed = np.asarray(rows.rows.numpy(), np.float64)
        self._observation = packed[:, :observation_size]
        self.unexplained = self._unexplained_shares(
            packed[:, observation_size : 2 * observation_size], packed[:, 2 * observation_size]
        )

    @classmethod
    def of(cls, logs: Logs, observation_size: int) -> LogFidelity | None:
        """Measure a run's logs; None if they have no row."""
        rows = Probe.of_logs(logs, ROWS)
        return cls(rows, observation_size) if rows is not None else None

    def agreement(self, *fresh: Probe) -> dict[str, float]:
        """Return each condition's agreement; empty if `fresh` has fewer than two conditions."""
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

    def _unexplained_shares(self, next_observation: F64, action: F64) -> dict[str, float]:
        """Return the unexplained share of variance of `next_observation` (n, D), by condition."""
        taken = np.eye(int(action.max()) + 1)[action.astype(np.int64)]
        features = _standardise(np.concatenate([self._observation, taken], axis=1))
        features = np.concatenate([features, np.ones((len(features), 1))], axis=1)
        target = _standardise(next_observation)
        fit = np.arange(len(features)) % 2 == 0  # a random half, as rows are ordered by hash
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
    """Return the most likely class (m,) of each of `rows` (m, D), if all have equal priors.

    `classes` are rows (n_k, D) of each class. The classes are assumed to have the same covariance.
    """
    means = np.stack([part.mean(axis=0) for part in classes])
    within = [np.cov(part, rowvar=False) for part in classes]
    covariance = np.mean(within, axis=0)
    covariance = (1 - _SHRINKAGE) * covariance
    covariance += _SHRINKAGE * np.eye(len(covariance)) * np.trace(covariance) / len(covariance)
    direction = np.linalg.solve(covariance, means.T)  # (D, K)
    score = rows @ direction - 0.5 * np.einsum("kd,dk->k", means, direction)
    return np.asarray(score.argmax(axis=1), np.int64)


def _standardise(values: F64) -> F64:
    spread = values.std(axis=0)
    return np.asarray((values - values.mean(axis=0)) / np.where(spread > 1e-9, spread, 1.0))
