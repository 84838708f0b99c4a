"""Which rows make a batch: exact quotas per stratum, by one vectorised draw.

A multinomial draw gives a stratum of quota 12 between 2 and 27 rows of a batch; here it gets 12
of 12, and a share of 0.003 of a batch is met over time, because the rounding is carried on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from restock.errors import MixtureError
from restock.replay.layout import F32, F64, Ints


class Sampler(Protocol):
    """Draws the rows of a batch."""

    def draw(self) -> tuple[Ints, Ints]:
        """Row numbers (B,) and the stratum of each (B,)."""

    def state_dict(self) -> dict[str, Any]:
        """All that decides the draws to come: numpy arrays and plain JSON values."""

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on exactly as the sampler whose `state_dict` this is would have."""


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
        self.carry: F64 = np.zeros(len(given))

    def next(self) -> Ints:
        """Rows per stratum of the next batch, (S,); they sum to the batch size."""
        owed = self.shares * self.batch_size + self.carry
        quota = np.floor(np.maximum(owed, 0.0)).astype(np.int64)
        short = self.batch_size - int(quota.sum())
        if short > 0:
            quota[np.argsort(quota - owed, kind="stable")[:short]] += 1
        for _ in range(-short):  # strata in debt can leave the others owed a row too many
            over = np.where(quota > 0, quota - owed, -np.inf)
            quota[int(np.argmax(over))] -= 1
        self.carry = owed - quota
        return quota


class QuotaSampler:
    """Exact quotas per batch over strata of rows.

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
        self.starts: Ints = np.concatenate([[0], np.cumsum(self.sizes)[:-1]]).astype(np.int64)
        self.rows: Ints = np.concatenate([np.asarray(rows, np.int64) for rows in stratum_rows])
        self.weights: F32 = (
            np.ones(int(self.rows.max(initial=-1)) + 1, np.float32) if weights is None else weights
        )
        self.rng = rng
        self.replacement = replacement
        self._cursor: Ints = np.zeros(len(self.sizes), np.int64)
        self._order: Ints = self.rows.copy()
        if not replacement:
            for stratum in range(len(self.sizes)):
                self._shuffle(stratum)

    @property
    def batch_size(self) -> int:
        return self.quotas.batch_size

    @property
    def shares(self) -> F64:
        return self.quotas.shares

    def draw(self) -> tuple[Ints, Ints]:
        """Row numbers (B,) and the stratum of each (B,), strata in order."""
        quota = self.quotas.next()
        stratum = np.repeat(np.arange(len(quota)), quota)
        if self.replacement:
            within = (self.rng.random(len(stratum)) * self.sizes[stratum]).astype(np.int64)
            return self.rows[self.starts[stratum] + within], stratum
        return self._draw_shuffled(quota, stratum), stratum

    def _draw_shuffled(self, quota: Ints, stratum: Ints) -> Ints:
        first = np.cumsum(quota) - quota  # where each stratum begins in the batch
        place = self._cursor[stratum] + np.arange(len(stratum)) - first[stratum]
        ends = self._cursor + quota
        wraps = np.flatnonzero(ends > self.sizes)
        if not len(wraps):
            self._cursor = ends
            return self._order[self.starts[stratum] + place]
        drawn = np.empty(len(stratum), np.int64)
        calm = ~np.isin(stratum, wraps)
        drawn[calm] = self._order[self.starts[stratum[calm]] + place[calm]]
        self._cursor = np.where(ends > self.sizes, self._cursor, ends)
        for index in wraps.tolist():
            begin = int(first[index])
            count = int(quota[index])
            drawn[begin : begin + count] = self._go_round(index, count)
        return drawn

    def _go_round(self, stratum: int, count: int) -> Ints:
        """The next `count` rows of a stratum whose shuffled order runs out on the way."""
        start, size = int(self.starts[stratum]), int(self.sizes[stratum])
        parts = []
        while count:
            if self._cursor[stratum] == size:
                self._shuffle(stratum)
                self._cursor[stratum] = 0
            at = int(self._cursor[stratum])
            taken = min(count, size - at)
            parts.append(self._order[start + at : start + at + taken].copy())
            self._cursor[stratum] += taken
            count -= taken
        return np.concatenate(parts)

    def _shuffle(self, stratum: int) -> None:
        start, size = int(self.starts[stratum]), int(self.sizes[stratum])
        self._order[start : start + size] = self.rng.permutation(self.rows[start : start + size])

    def state_dict(self) -> dict[str, Any]:
        """Carried rounding, shuffled orders and the generator: arrays and plain JSON values."""
        state: dict[str, Any] = {
            "carry": self.quotas.carry.copy(),
            "sizes": self.sizes.copy(),
            "rng": self.rng.bit_generator.state,
        }
        if not self.replacement:
            state |= {"cursor": self._cursor.copy(), "order": self._order.copy()}
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Raises MixtureError when the state is of a sampler over other strata."""
        if not np.array_equal(state["sizes"], self.sizes) or (
            ("order" in state) == self.replacement
        ):
            raise MixtureError(
                "the saved sampler drew from other strata",
                remedy="resume with the panel and the settings the run began with",
            )
        self.quotas.carry = np.array(state["carry"], np.float64)
        self.rng.bit_generator.state = state["rng"]
        if not self.replacement:
            self._cursor = np.array(state["cursor"], np.int64)
            self._order = np.array(state["order"], np.int64)


def uniform_sampler(rows: int, batch_size: int, rng: np.random.Generator) -> QuotaSampler:
    """Every row with the same probability: one stratum of all rows."""
    return QuotaSampler([np.arange(rows)], [1.0], batch_size, rng)
