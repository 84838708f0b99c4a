"""Shares to whole rows per batch: exact in every batch, and met over time."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from restock.arrays import F64, Ints
from restock.errors import MixtureError
from restock.state import Stateful


class Quotas(Stateful):
    """Shares to whole rows per batch by largest remainder, the rounding carried to the next.

    Shares and batch size may change between batches; what a stratum is owed stays owed.

    Args:
        sizes: rows of each stratum (S,), where a share on an empty one is to be refused.

    Raises:
        MixtureError: shares that are no distribution or on an empty stratum, or a batch of no rows.
    """

    STATE: ClassVar[tuple[str, ...]] = ("shares", "batch_size", "_carry")

    def __init__(
        self, shares: Sequence[float] | F64, batch_size: int, sizes: Ints | None = None
    ) -> None:
        self._strata = len(shares) if sizes is None else len(sizes)
        self._empty = np.zeros(self._strata, np.bool_) if sizes is None else sizes == 0
        self.shares: F64 = np.empty(0)
        self.batch_size = 0
        self._mean: list[float] = []
        self._carry: list[float] = [0.0] * len(shares)
        self.set_shares(shares)
        self.set_batch_size(batch_size)

    @property
    def carry(self) -> F64:
        """Rows that each stratum is still owed, (S,)."""
        return np.array(self._carry)

    @carry.setter
    def carry(self, owed: F64) -> None:
        self._carry = np.asarray(owed, np.float64).tolist()

    def checked(self, shares: Sequence[float] | F64) -> F64:
        """Shares (S,) as `set_shares` would take them, summing to 1."""
        given = np.asarray(shares, np.float64)
        if given.ndim != 1 or not len(given) or not np.isfinite(given).all() or (given < 0).any():
            raise MixtureError(f"shares must be finite and not negative, got {shares!r}")
        if abs(given.sum() - 1.0) > 1e-6:
            raise MixtureError(f"shares must sum to 1, got {given.sum():.6g}")
        if len(given) != self._strata:
            raise MixtureError(f"{len(given)} shares for {self._strata} strata")
        for stratum in np.flatnonzero((given > 0) & self._empty).tolist():
            raise MixtureError(
                f"stratum {stratum} has a share of {given[stratum]:g} and no rows",
                remedy="give it share 0, or let `restock mix` redistribute it",
            )
        total = given.sum()
        # Shares that were made to sum to 1 before stay the same to the last bit.
        return given if abs(total - 1.0) < 1e-12 else np.asarray(given / total)

    def set_shares(self, shares: Sequence[float] | F64) -> None:
        """Other shares (S,) from the next batch on; a stratum of share 0 is owed nothing."""
        self.shares = self.checked(shares)
        self._mean = (self.shares * self.batch_size).tolist()
        drawn = self.shares > 0
        carry = np.where(drawn, self.carry, 0.0)
        self._carry = (carry - np.where(drawn, carry.sum() / drawn.sum(), 0.0)).tolist()

    def set_batch_size(self, batch_size: int) -> None:
        """Another size from the next batch on."""
        if not isinstance(batch_size, int | np.integer) or batch_size < 1:
            raise MixtureError(f"batch_size must be an integer of at least 1, got {batch_size!r}")
        self.batch_size = int(batch_size)
        self._mean = (self.shares * batch_size).tolist()

    def restored(self) -> None:
        """What follows from shares and batch size."""
        self._mean = (self.shares * self.batch_size).tolist()

    def next(self) -> Ints:
        """Rows per stratum of the next batch, (S,); they sum to the batch size."""
        first: Ints = self.take(1)[0]
        return first

    def take(self, batches: int) -> Ints:
        """Rows per stratum of the next batches, (n, S); each sums to the batch size."""
        if len(self.shares) == 1:
            return np.full((batches, 1), self.batch_size, np.int64)
        # Plain lists: for a handful of strata numpy's calls cost more than the work.
        mean, size, carry = self._mean, self.batch_size, self._carry
        strata = range(len(mean))
        quotas = []
        for _ in range(batches):
            owed = list(map(operator.add, mean, carry))
            quota = [int(part) if part > 0 else 0 for part in owed]
            rest = list(map(operator.sub, owed, quota))
            short = size - sum(quota)
            if short > 0:
                for index in sorted(strata, key=rest.__getitem__, reverse=True)[:short]:
                    quota[index] += 1
                    rest[index] -= 1.0
            for _ in range(-short):  # strata in debt can leave the others owed a row too many
                index = min((i for i, q in enumerate(quota) if q), key=rest.__getitem__)
                quota[index] -= 1
                rest[index] += 1.0
            quotas.append(quota)
            carry = rest
        self._carry = carry
        return np.array(quotas, np.int64)

    def give_back(self, quotas: Ints) -> None:
        """Batches that were not handed out after all, (n, S): their strata are owed them again."""
        back = self.carry + quotas.sum(axis=0) - len(quotas) * np.array(self._mean)
        self._carry = back.tolist()
