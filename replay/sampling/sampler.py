"""Which rows make a batch: exact quotas per stratum, by one vectorised draw.

A multinomial draw gives a stratum of quota 12 between 2 and 27 rows of a batch; here it gets 12
of 12, and a share of 0.003 of a batch is met over time, because the rounding is carried on.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F32, F64, Ints
from restock.errors import MixtureError
from restock.replay.sampling.quotas import Quotas
from restock.state import Stateful

BLOCK = 64  # batches drawn at a time


def checked_errors(td_abs: NDArray[Any], rows: NDArray[Any]) -> F32:
    """|TD error| (n,) of rows (n,): what a priority or a share can follow.

    Raises:
        MixtureError: one that is negative or not finite, or not one a row.
    """
    errors = np.asarray(td_abs, np.float32)
    if errors.shape != np.shape(rows):
        raise MixtureError(
            f"TD errors of shape {errors.shape} for rows of shape {np.shape(rows)}",
            remedy="give one for each row that was drawn, in their order",
        )
    low, high = float(errors.min(initial=0.0)), float(errors.max(initial=0.0))  # pass NaN on
    if not math.isfinite(low + high):
        raise MixtureError(
            f"{int((~np.isfinite(errors)).sum())} TD errors are not finite",
            remedy="training has diverged: lower the learning rate, or slow the target down",
        )
    if low < 0:
        raise MixtureError(
            f"{int((errors < 0).sum())} TD errors are negative, the least {low:g}",
            remedy="give their absolute values",
        )
    return errors


class Sampler(Protocol):
    """What draws the rows of batches. `QuotaSampler`, `PrioritySampler` and `ChunkedSampler`."""

    @property
    def batch_size(self) -> int: ...

    @property
    def shares(self) -> F64:
        """Of each stratum, (S,)."""

    @property
    def drawn_weights(self) -> F32 | None:
        """Importance weights (B,) that the batch last drawn needs; None for ones."""

    def draw(self) -> tuple[Ints, Ints]:
        """Row numbers (B,) and the stratum of each (B,)."""

    def update(self, rows: Ints, td_abs: NDArray[Any]) -> None:
        """|TD error| (n,) of rows (n,) that were just learnt from."""

    def set_shares(self, shares: Sequence[float] | F64) -> None:
        """Other shares from the next batch on."""

    def set_batch_size(self, batch_size: int) -> None:
        """Batches of another size from the next one on."""

    def state_dict(self) -> dict[str, Any]:
        """All that decides the draws to come: arrays and JSON values."""

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Puts the draws to come where `state_dict` found them."""


class QuotaSampler(Stateful):
    """Exact quotas per batch over strata of rows, each stratum's rows alike.

    Batches are drawn BLOCK at a time and handed out one by one, which takes the cost of a draw from
    about that of the gather to a tenth of it; what is drawn ahead is part of `state_dict`.

    Args:
        stratum_rows: the row numbers of each stratum, S arrays (n_s,). Strata may be empty where
            their share is 0.
        shares: of each stratum, (S,), summing to 1.
        batch_size: rows per draw.
        rng: the generator of the draws; its state is part of `state_dict`.
        weights: importance weight of each row number, or None for ones.
        replacement: False goes through a stratum in shuffled order before any row repeats
            (within it, rows differ by at most one draw); for all strata or for each, (S,).

    Raises:
        MixtureError: shares that are no distribution, or a share on an empty stratum.
    """

    SAME: ClassVar[tuple[str, ...]] = ("sizes", "_turns")
    STATE: ClassVar[tuple[str, ...]] = (
        *("quotas", "rng", "_orders", "_cursor", "_returned"),
        *("_ahead_rows", "_ahead_strata", "_next"),
    )
    block = BLOCK

    def __init__(
        self,
        stratum_rows: Sequence[NDArray[Any]],
        shares: Sequence[float] | F64,
        batch_size: int,
        rng: np.random.Generator,
        *,
        weights: F32 | None = None,
        replacement: bool | Sequence[bool] = True,
    ) -> None:
        if len(stratum_rows) != len(shares):
            raise MixtureError(f"{len(stratum_rows)} strata but {len(shares)} shares")
        self.sizes: Ints = np.array([len(rows) for rows in stratum_rows], np.int64)
        self.quotas = Quotas(shares, batch_size, self.sizes)
        self._members = [np.array(rows, np.int64) for rows in stratum_rows]
        last = max((int(rows.max(initial=-1)) for rows in self._members), default=-1)
        self.weights: F32 = np.ones(last + 1, np.float32) if weights is None else weights
        self.rng = rng
        again = replacement
        self._again = [again] * len(shares) if isinstance(again, bool) else list(again)
        if len(self._again) != len(shares):
            raise MixtureError(f"{len(self._again)} rules for {len(shares)} strata")
        self._turns = [stratum for stratum, repeats in enumerate(self._again) if not repeats]
        self._cursor: Ints = np.zeros(len(self.sizes), np.int64)
        for stratum in self._turns:
            self.rng.shuffle(self._members[stratum])
        # Rows whose turn came and that were not handed out, because the shares changed: next ones.
        self._returned = [np.empty(0, np.int64) for _ in self._members]
        self._ahead_rows: Ints = np.zeros((0, batch_size), np.int64)
        self._ahead_strata: Ints = np.zeros((0, batch_size), np.int64)
        self._next = 0  # of those drawn ahead

    @property
    def batch_size(self) -> int:
        return self.quotas.batch_size

    @property
    def shares(self) -> F64:
        return self.quotas.shares

    @property
    def drawn_weights(self) -> F32 | None:
        """Importance weights that the batch last drawn needs: none, its rows are drawn alike."""
        return None

    def draw(self) -> tuple[Ints, Ints]:
        """Row numbers (B,) and the stratum of each (B,), strata in order."""
        if self._next == len(self._ahead_rows):
            self._draw_block()
        self._next += 1
        return self._ahead_rows[self._next - 1], self._ahead_strata[self._next - 1]

    def update(self, rows: Ints, td_abs: NDArray[Any]) -> None:
        """|TD error| (n,) of rows (n,) that were just learnt from: changes nothing here."""

    def set_shares(self, shares: Sequence[float] | F64) -> None:
        """Other shares (S,) from the next batch on; what was drawn ahead goes back.

        Raises:
            MixtureError: shares that are no distribution, or a share on an empty stratum.
        """
        given = self.quotas.checked(shares)
        if not np.array_equal(given, self.quotas.shares):
            self._hand_back()
            self.quotas.set_shares(given)

    def set_batch_size(self, batch_size: int) -> None:
        """Batches of another size from the next one on; what was drawn ahead goes back."""
        if batch_size != self.batch_size:
            self._hand_back()
            self.quotas.set_batch_size(batch_size)
            self._ahead_rows = np.zeros((0, batch_size), np.int64)
            self._ahead_strata = np.zeros((0, batch_size), np.int64)

    def _draw_block(self) -> None:
        strata = len(self.sizes)
        quota = self.quotas.take(self.block)  # (block, S)
        stratum = np.repeat(np.tile(np.arange(strata), self.block), quota.ravel())
        # All that a stratum gives to the block is taken at once, and dealt out in order.
        self._take_all(quota.sum(axis=0), _by_stratum(quota))
        self._ahead_strata = stratum.reshape(self.block, -1)  # batch by batch
        self._next = 0

    def _take_all(self, counts: Ints, order: Ints) -> None:
        """Take `counts` (S,) rows of the strata; those are dealt to places `order` of the block."""
        drawn = np.empty(len(order), np.int64)
        taken = [self._take(stratum, count) for stratum, count in enumerate(counts.tolist())]
        drawn[order] = np.concatenate(taken)
        self._ahead_rows = drawn.reshape(self.block, -1)

    def _take(self, stratum: int, count: int) -> Ints:
        """The next `count` rows of a stratum."""
        members, size = self._members[stratum], int(self.sizes[stratum])
        if self._again[stratum]:
            return members[(self.rng.random(count) * size).astype(np.int64)]
        back = self._returned[stratum]
        parts, self._returned[stratum] = [back[:count]], back[count:]
        count -= len(parts[0])
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

    def _hand_back(self) -> None:
        """Forget what is drawn ahead: quotas are owed again, rows that had their turn are next."""
        rows, strata = self._ahead_rows[self._next :], self._ahead_strata[self._next :]
        quota = np.stack([(strata == s).sum(axis=1) for s in range(len(self.sizes))], axis=1)
        self.quotas.give_back(quota)
        for stratum in self._turns:
            back = self._returned[stratum]
            self._returned[stratum] = np.concatenate([rows[strata == stratum], back])
        self._ahead_rows, self._ahead_strata = rows[:0], strata[:0]
        self._next = 0

    @property
    def _orders(self) -> list[Ints]:
        """The rows of each stratum that is gone through in turns, in their order."""
        return [self._members[stratum] for stratum in self._turns]

    @_orders.setter
    def _orders(self, orders: list[Ints]) -> None:
        for stratum, order in zip(self._turns, orders, strict=True):
            self._members[stratum] = order

    def mismatch(self, name: str, value: Any) -> MixtureError:
        """Of a state of a sampler over other strata."""
        return another_sampler()


def another_sampler() -> MixtureError:
    """The saved state is not of this sampler."""
    return MixtureError(
        "the saved sampler drew from other strata, or by another rule",
        remedy="resume with the panel and the settings the run began with",
    )


def _by_stratum(quota: Ints) -> Ints:
    """The places of a block's rows, which lie batch by batch, stratum by stratum: (rows,)."""
    begins = np.cumsum(quota).reshape(quota.shape) - quota  # of a batch's rows of a stratum
    counts = quota.T.ravel()
    return np.repeat(begins.T.ravel() - np.cumsum(counts) + counts, counts) + np.arange(
        counts.sum()
    )


def uniform_sampler(rows: int, batch_size: int, rng: np.random.Generator) -> QuotaSampler:
    """Every row with the same probability: one stratum of all rows."""
    return QuotaSampler([np.arange(rows)], [1.0], batch_size, rng)


__all__ = ["BLOCK", "QuotaSampler", "Quotas", "Sampler", "another_sampler", "uniform_sampler"]
