"""Which rows make a batch: exact quotas per stratum, by one vectorised draw.

A multinomial draw gives a stratum of quota 12 between 2 and 27 rows of a batch; here it gets 12
of 12, and a share of 0.003 of a batch is met over time, because the rounding is carried on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.errors import MixtureError
from restock.replay.layout import F32, F64, Ints

BLOCK = 64  # batches drawn at a time


class Quotas:
    """Shares to whole rows per batch by largest remainder, the rounding carried to the next."""

    def __init__(self, shares: Sequence[float] | F64, batch_size: int) -> None:
        given = np.asarray(shares, np.float64)
        if batch_size < 1:
            raise MixtureError(f"batch_size must be at least 1, got {batch_size}")
        if given.ndim != 1 or not len(given) or not np.isfinite(given).all() or (given < 0).any():
            raise MixtureError(f"shares must be finite and not negative, got {shares!r}")
        if abs(given.sum() - 1.0) > 1e-6:
            raise MixtureError(f"shares must sum to 1, got {given.sum():.6g}")
        self.shares: F64 = given / given.sum()
        self.batch_size = batch_size
        self._mean: list[float] = (self.shares * batch_size).tolist()
        self._carry = [0.0] * len(self._mean)

    @property
    def carry(self) -> F64:
        """Rows that each stratum is still owed, (S,)."""
        return np.array(self._carry)

    @carry.setter
    def carry(self, owed: F64) -> None:
        self._carry = np.asarray(owed, np.float64).tolist()

    def next(self) -> Ints:
        """Rows per stratum of the next batch, (S,); they sum to the batch size."""
        if len(self.shares) == 1:
            return np.array([self.batch_size], np.int64)
        # Plain floats: for a handful of strata numpy's calls cost more than the work.
        owed = [mean + carry for mean, carry in zip(self._mean, self._carry, strict=True)]
        quota = [int(part) if part > 0 else 0 for part in owed]
        rest = [part - whole for part, whole in zip(owed, quota, strict=True)]
        short = self.batch_size - sum(quota)
        if short > 0:
            for index in sorted(range(len(rest)), key=rest.__getitem__, reverse=True)[:short]:
                quota[index] += 1
                rest[index] -= 1.0
        for _ in range(-short):  # strata in debt can leave the others owed a row too many
            index = min((i for i, q in enumerate(quota) if q), key=rest.__getitem__)
            quota[index] -= 1
            rest[index] += 1.0
        self._carry = rest
        return np.array(quota, np.int64)


class QuotaSampler:
    """Exact quotas per batch over strata of rows.

    Batches are drawn BLOCK at a time and handed out one by one, which takes the cost of a draw from
    about that of the gather to a tenth of it; what is drawn ahead is part of `state_dict`.

    Args:
        stratum_rows: the row numbers of each stratum, S arrays (n_s,). Strata may be empty where
            their share is 0.
        shares: of each stratum, (S,), summing to 1.
        batch_size: rows per draw.
        rng: the generator of the draws; its state is part of `state_dict`.
        weights: importance weight of each row number, or None for ones.
        replacement: False goes through each stratum in shuffled order before any row repeats
            (within a stratum, rows differ by at most one draw).

    Raises:
        MixtureError: shares that are no distribution, or a share on an empty stratum.
    """

    def __init__(
        self,
        stratum_rows: Sequence[NDArray[Any]],
        shares: Sequence[float] | F64,
        batch_size: int,
        rng: np.random.Generator,
        *,
        weights: F32 | None = None,
        replacement: bool = True,
    ) -> None:
        if len(stratum_rows) != len(shares):
            raise MixtureError(f"{len(stratum_rows)} strata but {len(shares)} shares")
        self.quotas = Quotas(shares, batch_size)
        self.sizes: Ints = np.array([len(rows) for rows in stratum_rows], np.int64)
        for stratum in np.flatnonzero((self.quotas.shares > 0) & (self.sizes == 0)).tolist():
            raise MixtureError(
                f"stratum {stratum} has a share of {shares[stratum]:g} and no rows",
                remedy="give it share 0, or let `restock mix` redistribute it",
            )
        self._members = [np.array(rows, np.int64) for rows in stratum_rows]
        last = max((int(rows.max(initial=-1)) for rows in self._members), default=-1)
        self.weights: F32 = np.ones(last + 1, np.float32) if weights is None else weights
        self.rng = rng
        self.replacement = replacement
        self._cursor: Ints = np.zeros(len(self.sizes), np.int64)
        if not replacement:
            for members in self._members:
                self.rng.shuffle(members)
        self._ahead_rows: Ints = np.zeros((0, batch_size), np.int64)
        self._ahead_strata: Ints = np.zeros((0, batch_size), np.int64)
        self._next = 0  # of those drawn ahead

    @property
    def batch_size(self) -> int:
        return self.quotas.batch_size

    @property
    def shares(self) -> F64:
        return self.quotas.shares

    def draw(self) -> tuple[Ints, Ints]:
        """Row numbers (B,) and the stratum of each (B,), strata in order."""
        if self._next == len(self._ahead_rows):
            self._draw_block()
        self._next += 1
        return self._ahead_rows[self._next - 1], self._ahead_strata[self._next - 1]

    def _draw_block(self) -> None:
        quota = np.stack([self.quotas.next() for _ in range(BLOCK)])  # (BLOCK, S)
        strata = np.tile(np.arange(len(self.sizes)), BLOCK)
        stratum = np.repeat(strata, quota.ravel())  # (BLOCK * B,) batch by batch
        drawn = np.empty(len(stratum), np.int64)
        # All that a stratum gives to the block is taken at once, and dealt out in order.
        taken = [self._take(s, count) for s, count in enumerate(quota.sum(axis=0).tolist())]
        drawn[np.argsort(stratum.astype(np.int16), kind="stable")] = np.concatenate(taken)
        self._ahead_rows = drawn.reshape(BLOCK, -1)
        self._ahead_strata = stratum.reshape(BLOCK, -1)
        self._next = 0

    def _take(self, stratum: int, count: int) -> Ints:
        """The next `count` rows of a stratum."""
        members, size = self._members[stratum], int(self.sizes[stratum])
        if self.replacement:
            return members[(self.rng.random(count) * size).astype(np.int64)]
        parts = [np.empty(0, np.int64)]
        while count:
            at = int(self._cursor[stratum])
            if at == size:  # all have had their turn
                self.rng.shuffle(members)
                at = 0
            some = min(count, size - at)
            parts.append(members[at : at + some].copy())
            self._cursor[stratum] = at + some
            count -= some
        return np.concatenate(parts)

    def state_dict(self) -> dict[str, Any]:
        """Carried rounding, what is drawn ahead, orders, the generator: arrays and JSON values."""
        state: dict[str, Any] = {
            "carry": self.quotas.carry.copy(),
            "sizes": self.sizes.copy(),
            "ahead_rows": self._ahead_rows[self._next :].copy(),
            "ahead_strata": self._ahead_strata[self._next :].copy(),
            "rng": self.rng.bit_generator.state,
        }
        if not self.replacement:
            order = np.concatenate(self._members)
            state |= {"cursor": self._cursor.copy(), "order": order}
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Raises MixtureError when the state is of a sampler over other strata."""
        if (
            not np.array_equal(state["sizes"], self.sizes)
            or ("order" in state) == self.replacement
            or state["ahead_rows"].shape[1:] != (self.batch_size,)
        ):
            raise MixtureError(
                "the saved sampler drew from other strata, or batches of another size",
                remedy="resume with the panel and the settings the run began with",
            )
        self.quotas.carry = np.array(state["carry"], np.float64)
        self._ahead_rows = np.array(state["ahead_rows"], np.int64)
        self._ahead_strata = np.array(state["ahead_strata"], np.int64)
        self._next = 0
        self.rng.bit_generator.state = state["rng"]
        if not self.replacement:
            self._cursor = np.array(state["cursor"], np.int64)
            ends = np.cumsum(self.sizes)[:-1]
            self._members = [part.copy() for part in np.split(np.array(state["order"]), ends)]


def uniform_sampler(rows: int, batch_size: int, rng: np.random.Generator) -> QuotaSampler:
    """Every row with the same probability: one stratum of all rows."""
    return QuotaSampler([np.arange(rows)], [1.0], batch_size, rng)
