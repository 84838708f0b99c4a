"""Importance weights against the boost of strata, and what they leave of a sample.

A stratum that gets a share s of the draws and holds n of N rows is drawn s N / n times as often as
it occurs. A row chosen on its outcome is weighted back to the density of the rows of the same state
whose outcome was another, which keeps P(s'|s, a) what it was; a row chosen on its state, where that
is asked for, to its natural density. So a weight depends on two strata of a row alone: its own, and
the one its state would put it in. A density ratio adds a factor of the state and action, see
`replay.density_ratio`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from restock.replay.mixture.mixture import CorrectionRule
from restock.replay.mixture.packed_row import F32, F64
from restock.replay.panel.density_ratio import density_ratio


class Corrected(Protocol):
    """What weights must know of a stratum."""

    @property
    def timing(self) -> str: ...

    @property
    def correction(self) -> str: ...


class RowWeights:
    """Weights of the rows of one source, of mean 1 over what the shares draw.

    Args:
        code: (N,) each row's stratum, never -1.
        state_code: (N,) the one its state alone gives, -1 for none.
        strata: (S,) whose timing and correction decide.
        outcome: (N, S) the probability of each "density_ratio" stratum given a row's state and
            action (0 for the other strata), or None.
    """

    def __init__(
        self,
        code: NDArray[np.int16],
        state_code: NDArray[np.int16],
        strata: Sequence[Corrected],
        rule: CorrectionRule,
        outcome: F32 | None = None,
    ) -> None:
        size = len(strata)
        self.strata, self.rule, self.outcome = list(strata), rule, outcome
        self.rows = np.bincount(code, minlength=size)
        # State -1 is the last column.
        self._cell = code.astype(np.int32) * (size + 1) + state_code % (size + 1)
        self._in_cell = np.bincount(self._cell, minlength=size * (size + 1)).reshape(size, size + 1)

    def boost(self, shares: F64) -> F64:
        """How much oftener each stratum is drawn than it occurs, (S,); 1 where it has no rows."""
        total = self.rows.sum()
        ones = np.ones(len(shares))
        return np.asarray(np.divide(shares * total, self.rows, out=ones, where=self.rows > 0))

    def under(self, shares: F64) -> F32:
        """The weights (N,) under these shares (S,)."""
        boost = self.boost(shares)
        table, state_aim = self._table(boost)
        drawn = boost / max(int(self.rows.sum()), 1)
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
        """Weights by stratum and state's stratum (S, S + 1), and a state's density (S + 1,)."""
        corrected = np.array([stratum.correction != "none" for stratum in self.strata])
        # The density at which rows of a state are to be drawn: boosted, or as they occur.
        aim = np.where(corrected | (boost == 0), 1.0, boost)
        state_aim = np.append(aim, 1.0)
        table = np.ones((len(self.strata), len(self.strata) + 1))
        for index, stratum in enumerate(self.strata):
            if stratum.correction == "none" or boost[index] == 0:
                continue
            to = state_aim if stratum.timing == "post" else np.ones(len(state_aim))
            weight = to / boost[index]
            by_ratio = stratum.correction == "density_ratio" and stratum.timing == "pre"
            if stratum.correction == "beta":
                weight = weight**self.rule.beta
            elif stratum.correction == "clipped" or by_ratio:
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
) -> F32:
    """Weights (N,) of the rows of one source, see `RowWeights`."""
    return RowWeights(code, state_code, strata, rule, outcome).under(shares)


def effective_shares(code: NDArray[np.int16], weights: F32, shares: F64) -> F64:
    """Shares of the gradient after weights, (S,)."""
    rows = np.maximum(np.bincount(code, minlength=len(shares)), 1)
    total = shares * np.bincount(code, weights=weights, minlength=len(shares)) / rows
    return np.asarray(total / max(total.sum(), 1e-12), np.float64)


def effective_count(sizes: NDArray[Any]) -> float:
    """(sum n)^2 / sum n^2: how many equal groups these would be worth."""
    total = float((np.asarray(sizes, np.float64) ** 2).sum())
    return float(np.asarray(sizes).sum()) ** 2 / total if total > 0 else 0.0


class WeightsInForce:
    """The weights of a panel's rows while its shares move: `of(rows)` under the last `set_shares`.

    Args:
        code: (n,) the stratum of each row, over all sources: those of source k are k * S and on.
        state_code: (n,) the stratum its state gives, within its source.
        strata: (K * S,) timing and correction of each.
        sources: K, stores that the panel is from.
        outcome: (n, S) as `RowWeights` has it, or None.
    """

    def __init__(
        self,
        code: NDArray[np.int16],
        state_code: NDArray[np.int16],
        strata: Sequence[Corrected],
        sources: int,
        rule: CorrectionRule,
        outcome: F32 | None,
    ) -> None:
        self._size = len(strata) // sources
        self._parts = []
        for number in range(sources):
            at = np.flatnonzero(code // self._size == number)
            span = slice(number * self._size, (number + 1) * self._size)
            of_source = code[at] - number * self._size
            probability = None if outcome is None else outcome[at]
            self._parts.append(
                (at, span, RowWeights(of_source, state_code[at], strata[span], rule, probability))
            )
        self._weight: F32 = np.ones(len(code), np.float32)

    def set_shares(self, shares: F64) -> None:
        """Weights under these shares (K * S,) from now on, of mean 1 in each source."""
        for at, span, weights in self._parts:
            total = shares[span].sum()
            if len(at) and total > 0:
                self._weight[at] = weights.under(shares[span] / total)

    def of(self, rows: NDArray[Any]) -> F32:
        """The weights (n,) of rows (n,)."""
        weight: F32 = self._weight[rows]
        return weight
