"""Shares that follow the error: group distributionally robust optimisation over strata.

Sagawa, Koh, Hashimoto and Liang, Distributionally Robust Neural Networks, ICLR 2020
(arXiv:1911.08731), algorithm 1: q_g <- q_g exp(eta loss_g), normalised. There the gradient step is
weighted by q; here q is the share of the draws, which is the same in expectation and wastes no
rows. The loss of a group is its mean |TD error|, in units of the groups' mean, so that eta means
the same whatever the scale of rewards. Floor and ceiling keep every group fed, and none from taking
all.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.errors import MixtureError
from restock.replay.mixture.mixture import Adaptive
from restock.replay.mixture.packed_row import F64, Ints
from restock.replay.mixture.shares import scaled_within


class GroupDro:
    """The shares (S,) of the strata of one source, and what their rows erred since the last step.

    `shares` begin as planned; a stratum of share 0 stays at 0.

    Raises:
        MixtureError: floors that sum to more than 1, or ceilings to less.
    """

    def __init__(self, rule: Adaptive, shares: F64, floor: F64, cap: F64) -> None:
        self.rule = rule
        drawn = shares > 0
        self.low: F64 = np.where(drawn, np.maximum(floor, rule.floor), 0.0)
        self.high: F64 = np.where(drawn, np.minimum(cap, rule.ceiling), 0.0)
        self.low = np.minimum(self.low, self.high)
        if self.low.sum() > 1 + 1e-9 or self.high.sum() < 1 - 1e-9:
            raise MixtureError(
                f"adaptive: {int(drawn.sum())} strata cannot share out 1 with floors that sum to"
                f" {self.low.sum():g} and ceilings that sum to {self.high.sum():g}",
                remedy="lower adaptive.floor, raise adaptive.ceiling, or drop [adaptive]",
            )
        self.shares: F64 = scaled_within(shares, self.low, self.high)
        self.td_abs: F64 = np.full(len(shares), np.nan)  # what the last step saw, (S,)
        self._sum: F64 = np.zeros(len(shares))
        self._rows: Ints = np.zeros(len(shares), np.int64)

    def observe(self, stratum: NDArray[Any], td_abs: NDArray[Any]) -> None:
        """|TD error| (n,) of rows of these strata (n,)."""
        self._sum += np.bincount(stratum, td_abs, minlength=len(self._sum))
        self._rows += np.bincount(stratum, minlength=len(self._rows))

    def step(self) -> F64:
        """Take one step; returns the new shares (S,). A stratum that was not drawn errs as all."""
        seen = self._rows > 0
        if seen.any():
            error = np.divide(self._sum, self._rows, out=np.zeros(len(seen)), where=seen)
            unit = max(float(error[seen].mean()), 1e-12)
            factor = np.exp(self.rule.step_size * np.where(seen, error / unit, 1.0))
            self.shares = scaled_within(self.shares * factor, self.low, self.high)
            self.td_abs = np.where(seen, error, np.nan)
        self._sum[:] = 0.0
        self._rows[:] = 0
        return self.shares

    def state_dict(self) -> dict[str, Any]:
        """Arrays, for a checkpoint."""
        return {
            "shares": self.shares.copy(),
            "td_abs": self.td_abs.copy(),
            "sum": self._sum.copy(),
            "rows": self._rows.copy(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Puts the shares where `state_dict` found them."""
        self.shares = np.array(state["shares"], np.float64)
        self.td_abs = np.array(state["td_abs"], np.float64)
        self._sum = np.array(state["sum"], np.float64)
        self._rows = np.array(state["rows"], np.int64)
