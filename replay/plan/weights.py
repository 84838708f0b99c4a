"""Importance weights that offset the boost of strata, and the effective sizes that result.

A stratum that gets a share s of the draws and has n of N rows is drawn s N / n times as often as it
occurs. A row selected by outcome is weighted back to the density of rows of the same state with
other outcomes, which preserves P(s'|s, a). A row selected by state is weighted back to its natural
density, if the mixture corrects it. So a weight depends on only two strata of a row: its own, and
the one that its state alone would give. A density ratio adds a factor of state and action.

Suppose that a stratum selected by outcome (slip) is boosted b times. Full correction removes the
boost, also that of states in which the outcome is likely. But states and actions may be drawn as
often as desired; only the distribution of their outcomes must not change. With a density ratio,
rows of any outcome are therefore weighted to their natural density times

    r(s, a) = q(s, a) / p(s, a) = sum over outcomes k of P(k | s, a) b_k

This is the ratio of the density at which the quotas draw the state and action to the density at
which they occur. P(k | s, a) is estimated by logistic regression: density ratio estimation by
classification (Bickel, Brückner and Scheffer, JMLR 10, 2009; Sugiyama, Suzuki and Kanamori, Density
Ratio Estimation in Machine Learning, 2012, chapter 4). r is clipped from above, and weights are
normalised over the draws (self-normalised importance sampling). As r depends only on state and
action, a poor fit changes which states are boosted, but not the outcomes that the critic sees in
each.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import duckdb
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.arrays import F32, F64, Ints
from restock.replay.mixture.mixture import CorrectionRule
from restock.replay.plan.candidates import any_order, matrix, stored_view

BATCH_ROWS = 4_096  # observations in memory at a time
COLUMNS = 16  # features in memory at a time
FIT_ROWS = 20_000  # largest number of rows per outcome that the model is fitted to, chosen by id
PENALTY = 1e-3  # L2 penalty on the weights of standardised features


class Corrected(Protocol):
    """A stratum's timing and correction."""

    @property
    def timing(self) -> str: ...

    @property
    def correction(self) -> str: ...


class RowWeights:
    """Weights of the rows of one source, with mean 1 over the draws.

    Args:
        code: (N,) each row's stratum, never -1.
        state_code: (N,) each row's stratum by its state alone, -1 for none.
        strata: (S,) timing and correction of each stratum.
        outcome: (N, S) the probability of each "density_ratio" stratum given a row's state and
            action (0 for the other strata), or None.
        natural: (S,) natural share of each stratum, if the rows are a selection (an archive, a
            cap); None: in proportion to the stratum's rows.
    """

    def __init__(
        self,
        code: NDArray[np.int16],
        state_code: NDArray[np.int16],
        strata: Sequence[Corrected],
        rule: CorrectionRule,
        outcome: F32 | None = None,
        natural: F64 | None = None,
    ) -> None:
        size = len(strata)
        self.strata, self.rule, self.outcome = list(strata), rule, outcome
        self.rows = np.bincount(code, minlength=size)
        self._occurs = self.rows if natural is None else np.where(self.rows > 0, natural, 0.0)
        # Cells of the table `_table`; state code -1 (none) is its last column.
        self._cell = code.astype(np.int32) * (size + 1) + state_code % (size + 1)
        self._in_cell = np.bincount(self._cell, minlength=size * (size + 1)).reshape(size, size + 1)

    def boost(self, shares: F64) -> F64:
        """Return each stratum's drawn share over its natural share, (S,); 1 if it has no rows."""
        ones = np.ones(len(shares))
        drawn = shares * self._occurs.sum()
        return np.asarray(np.divide(drawn, self._occurs, out=ones, where=self._occurs > 0))

    def compute(self, shares: F64) -> F32:
        """Return the weights (N,) under these shares (S,)."""
        boost = self.boost(shares)
        table, state_aim = self._table(boost)
        drawn = np.divide(shares, self.rows, out=np.zeros(len(shares)), where=self.rows > 0)
        if self.outcome is None:
            table /= max(float((drawn[:, None] * self._in_cell * table).sum()), 1e-12)
            return np.asarray(table.ravel()[self._cell], np.float32)
        size = len(self.strata)
        weight = table.ravel()[self._cell]
        aim = state_aim[self._cell % (size + 1)]
        weight = weight * density_ratio(self.outcome, boost, aim, self.rule.clip)
        total = (drawn[self._cell // (size + 1)] * weight).sum()
        return np.asarray(weight / max(float(total), 1e-12), np.float32)

    def _table(self, boost: F64) -> tuple[F64, F64]:
        """Return weights by row's and state's stratum (S, S + 1), and target densities (S + 1,).

        A target density is that of states in a stratum, as a multiple of their natural density.
        """
        corrected = np.array([stratum.correction != "none" for stratum in self.strata])
        # States stay boosted if their stratum has no correction; else their density is natural.
        aim = np.where(corrected | (boost == 0), 1.0, boost)
        state_aim = np.append(aim, 1.0)
        table = np.ones((len(self.strata), len(self.strata) + 1))
        for index, stratum in enumerate(self.strata):
            if stratum.correction == "none" or boost[index] == 0:
                continue
            to = state_aim if stratum.timing == "post" else np.ones(len(state_aim))
            weight = to / boost[index]
            by_ratio = stratum.correction == "density_ratio" and stratum.timing == "pre"
            if stratum.correction == "clipped" or by_ratio:
                weight = np.clip(weight, 1 / self.rule.clip, self.rule.clip)
            table[index] = weight
        return table, state_aim


def importance_weights(
    code: NDArray[np.int16],
    state_code: NDArray[np.int16],
    strata: Sequence[Corrected],
    shares: F64,
    rule: CorrectionRule,
    outcome: F32 | None = None,
    natural: F64 | None = None,
) -> F32:
    """Return weights (N,) of the rows of one source; see `RowWeights`."""
    return RowWeights(code, state_code, strata, rule, outcome, natural).compute(shares)


def rows_represented(code: NDArray[np.int16], size: int, natural: F64 | None) -> F64:
    """Return how many rows of an unselected sample each row represents, (N,), with mean 1."""
    if natural is None:
        return np.ones(len(code))
    rows = np.bincount(code, minlength=size)
    occurs = np.where(rows > 0, natural, 0.0)
    each = occurs * len(code) / max(float(occurs.sum()), 1e-12) / np.maximum(rows, 1)
    return np.asarray(each[code], np.float64)


def effective_shares(code: NDArray[np.int16], weights: F32, shares: F64) -> F64:
    """Compute each stratum's share of the gradient after weighting, (S,)."""
    rows = np.maximum(np.bincount(code, minlength=len(shares)), 1)
    total = shares * np.bincount(code, weights=weights, minlength=len(shares)) / rows
    return np.asarray(total / max(total.sum(), 1e-12), np.float64)


def effective_count(sizes: NDArray[Any]) -> float:
    """Return the effective number of groups of these sizes, (sum n)^2 / sum n^2; 0 if empty."""
    total = float((np.asarray(sizes, np.float64) ** 2).sum())
    return float(np.asarray(sizes).sum()) ** 2 / total if total > 0 else 0.0


class WeightsInForce:
    """The weights of a panel's rows under shares that change during a run.

    Args:
        code: (n,) each row's stratum in 0..K * S - 1; strata of source k begin at k * S.
        state_code: (n,) each row's stratum by its state alone, in 0..S - 1; -1 for none.
        strata: (K * S,) timing and correction of each stratum.
        sources: K, the number of stores of the panel.
        outcome: (n, S) as in `RowWeights`, or None.
        natural: for each source, (S,) or None as in `RowWeights`; (): None for all.
    """

    def __init__(
        self,
        code: NDArray[np.int16],
        state_code: NDArray[np.int16],
        strata: Sequence[Corrected],
        sources: int,
        rule: CorrectionRule,
        outcome: F32 | None,
        natural: Sequence[F64 | None] = (),
    ) -> None:
        self._size = len(strata) // sources
        self._parts = []
        for number in range(sources):
            at = np.flatnonzero(code // self._size == number)
            span = slice(number * self._size, (number + 1) * self._size)
            of_source = code[at] - number * self._size
            probability = None if outcome is None else outcome[at]
            occurs = natural[number] if natural else None
            of_rows = RowWeights(of_source, state_code[at], strata[span], rule, probability, occurs)
            self._parts.append((at, span, of_rows))
        self._weight: F32 = np.ones(len(code), np.float32)

    def set_shares(self, shares: F64) -> None:
        """Compute the weights for shares (K * S,), with mean 1 over the draws of each source."""
        for at, span, weights in self._parts:
            total = shares[span].sum()
            if len(at) and total > 0:
                self._weight[at] = weights.compute(shares[span] / total)

    def of(self, rows: NDArray[Any]) -> F32:
        """Return the weights (n,) of rows (n,) under the shares of the last `set_shares`."""
        weight: F32 = self._weight[rows]
        return weight


@dataclass(frozen=True)
class RatioFit:
    """How well states and actions predict outcomes. Losses are on rows held out from the fit."""

    source: str
    strata: tuple[str, ...]
    rows: int  # number of rows that the model was fitted to
    log_loss: float  # nats per row
    base_log_loss: float  # loss if the frequencies of outcomes alone are the prediction


def density_ratio(outcome: F32, boost: F64, state_aim: F64, clip: float) -> F64:
    """Return the ratio of drawn to target density of each row's (s, a), (N,), at most `clip`.

    `outcome` (N, S) is P(k | s, a) of the estimated strata k, and 0 for others. `boost` (S,) is
    each stratum's drawn share over its natural share. `state_aim` (N,) is the target density of
    each row's state; rows of other outcomes are drawn at this density.
    """
    drawn = outcome @ boost + (1.0 - outcome.sum(axis=1)) * state_aim
    ratio = np.divide(drawn, state_aim, out=np.ones(len(drawn)), where=state_aim > 0)
    return np.asarray(np.minimum(ratio, clip), np.float64)


class OutcomeModel:
    """Multinomial logistic regression of an outcome (0: any other) on standardised features.

    Args:
        features: (n, D).
        outcome: (n,) in 0..outcomes - 1.
        weight: (n,) how many rows each row represents; None: all 1.
    """

    def __init__(
        self, features: NDArray[Any], outcome: Ints, outcomes: int, weight: F64 | None = None
    ) -> None:
        from scipy.optimize import minimize  # imported here because it is slow and rarely needed
        from scipy.special import log_softmax

        weight = np.ones(len(features)) if weight is None else weight / weight.mean()
        self.mean, spread = _moments(features, weight)
        self.scale = np.where(spread > 1e-9, spread, 1.0)
        self.outcomes = outcomes
        x = self._design(features)
        chosen = np.eye(outcomes)[outcome]

        def loss(flat: F64) -> tuple[float, F64]:
            theta = flat.reshape(x.shape[1], outcomes)
            log_p = log_softmax(x @ theta, axis=1)
            value = -(weight * log_p[np.arange(len(x)), outcome]).mean()
            gradient = x.T @ (weight[:, None] * (np.exp(log_p) - chosen)) / len(x)
            penalised = theta.copy()
            penalised[0] = 0.0  # no penalty on intercepts
            value += 0.5 * PENALTY * float((penalised**2).sum())
            return float(value), (gradient + PENALTY * penalised).ravel()

        start = np.zeros((x.shape[1], outcomes))
        share = np.bincount(outcome, weights=weight, minlength=outcomes) / weight.sum()
        start[0] = np.log(np.maximum(share, 1e-6))
        fitted = minimize(
            loss, start.ravel(), jac=True, method="L-BFGS-B", options={"maxiter": 200}
        )
        self.theta: F64 = fitted.x.reshape(x.shape[1], outcomes)

    def probability(self, features: NDArray[Any]) -> F64:
        """Return the probability of each outcome in each row, (n, outcomes)."""
        from scipy.special import softmax

        return np.asarray(softmax(self._design(features) @ self.theta, axis=1), np.float64)

    def _design(self, features: NDArray[Any]) -> F64:
        design = np.ones((len(features), features.shape[1] + 1))
        scaled = design[:, 1:]
        np.subtract(features, self.mean, out=scaled)
        scaled /= self.scale
        # Clip features: predictions far outside the fitted observations must not be overconfident.
        np.clip(scaled, -5.0, 5.0, out=scaled)
        return design


def _moments(features: NDArray[Any], weight: F64) -> tuple[F64, F64]:
    """Compute the weighted mean and standard deviation of each column, (D,) each.

    A few columns are converted to float64 at a time: a copy of all columns would need more memory
    than anything else in building a panel.
    """
    mean, spread = np.zeros(features.shape[1]), np.zeros(features.shape[1])
    for begin in range(0, len(mean), COLUMNS):
        some = np.asarray(features[:, begin : begin + COLUMNS], np.float64)
        at = slice(begin, begin + some.shape[1])
        mean[at] = np.average(some, axis=0, weights=weight)
        spread[at] = np.sqrt(np.average((some - mean[at]) ** 2, axis=0, weights=weight))
    return mean, spread


@dataclass(frozen=True)
class RatioRows:
    """The rows of one source over which a density ratio is estimated, (n,) each."""

    transition_id: Ints
    action: Ints
    state_code: NDArray[np.int16]  # index of the stratum by the row's state alone, -1 for none
    code: NDArray[np.int16]  # index of the row's stratum
    order: NDArray[np.uint64]  # hashes of ids; rows with the smallest are used for the fit
    rows_represented: F64  # see the function `rows_represented`


def estimate_outcomes(
    connection: duckdb.DuckDBPyConnection,
    rows: RatioRows,
    estimated: Ints,
    names: tuple[str, ...],
    source: str,
) -> tuple[F32, RatioFit]:
    """Estimate P(k | s, a) (n, K) for the strata `estimated` (K,); also return the fit's quality.

    Features are the observation, the action, and the stratum by the state alone.
    """
    label = np.zeros(len(rows.code), np.int64)
    for place, stratum in enumerate(estimated.tolist(), start=1):
        label[rows.code == stratum] = place
    parts, weights = [], []
    for outcome in range(len(estimated) + 1):
        members = np.flatnonzero(label == outcome)
        some = members[np.argsort(rows.order[members], kind="stable")[:FIT_ROWS]]
        parts.append(some)
        weights.append(rows.rows_represented[some] * (len(members) / max(len(some), 1)))
    chosen, weight = np.concatenate(parts), np.concatenate(weights)
    actions, states = int(rows.action.max()) + 1, np.unique(rows.state_code)

    def features(observation: NDArray[Any], at: Ints) -> NDArray[Any]:
        acted = np.eye(actions)[rows.action[at]]
        state = (rows.state_code[at][:, None] == states[None, :]).astype(np.float64)
        return np.concatenate([observation, acted, state], axis=1)

    held_out = rows.order[chosen] % np.uint64(5) == 0  # a fifth, to validate the fit
    if held_out.all() or not held_out.any():
        held_out = np.zeros(len(chosen), np.bool_)
    last = np.argsort(held_out, kind="stable")  # held-out rows last: both parts are slices
    chosen, weight = chosen[last], weight[last]
    split = len(chosen) - int(held_out.sum())
    x, y = np.empty((len(chosen), 0), np.float32), label[chosen]
    place_of = {int(row): place for place, row in enumerate(chosen.tolist())}
    for observation, at in _observations(connection, rows.transition_id, chosen):
        made = features(observation, at)
        if not x.shape[1]:
            x = np.zeros((len(chosen), made.shape[1]), np.float32)  # exact: the store has float32
        x[[place_of[int(row)] for row in at]] = made
    model = OutcomeModel(x[:split], y[:split], len(estimated) + 1, weight[:split])
    validation = slice(split if split < len(x) else 0, None)
    base = (
        np.bincount(label, rows.rows_represented, len(estimated) + 1) / rows.rows_represented.sum()
    )
    fit = RatioFit(
        source,
        names,
        split,
        _log_loss(model.probability(x[validation]), y[validation], weight[validation]),
        _log_loss(np.tile(base, (len(y[validation]), 1)), y[validation], weight[validation]),
    )
    del x
    outcome_of = np.zeros((len(rows.code), len(estimated)), np.float32)
    everything = np.arange(len(rows.code))
    for observation, at in _observations(connection, rows.transition_id, everything):
        outcome_of[at] = model.probability(features(observation, at))[:, 1:]
    return outcome_of, fit


def _log_loss(probability: F64, outcome: Ints, weight: F64) -> float:
    taken = np.maximum(probability[np.arange(len(outcome)), outcome], 1e-12)
    return float(-(weight * np.log(taken)).sum() / weight.sum())


def _observations(
    connection: duckdb.DuckDBPyConnection, ids: Ints, at: Ints
) -> Iterator[tuple[NDArray[np.float32], Ints]]:
    """Yield batches of observations (m, D) of the rows `at`, with their row numbers (m,)."""
    order = np.argsort(ids[at])
    wanted = ids[at][order]
    query = f"SELECT transition_id, observation FROM {stored_view(connection)}"
    with any_order(connection):
        # Match ids in Python: a join in DuckDB would keep rows in memory.
        for batch in connection.sql(query).to_arrow_reader(BATCH_ROWS):
            these = batch.column("transition_id").to_numpy()
            place = np.minimum(np.searchsorted(wanted, these), len(wanted) - 1)
            found = np.flatnonzero(wanted[place] == these)
            if not len(found):
                continue
            column = batch.column("observation")
            if len(found) < len(column):  # rows of other tasks may have another size: drop them
                column = column.take(pa.array(found))
            yield matrix(column, len(column[0])), at[order[place[found]]]
