"""Draw batches with exact quotas per stratum, vectorised.

A multinomial draw gives a stratum with quota 12 between 2 and 27 rows of a batch. Here it gets
exactly 12. A fractional quota is met over several batches, because the rounding error is carried
over.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F32, F64, Ints
from restock.errors import MixtureError
from restock.replay.sampling.rules import RULES, Prioritised, StratumRows, follow_td
from restock.state import Stateful

BLOCK = 64  # batches drawn at a time
# Limits of the block, in batches, if a rule draws by TD errors. A block then has a sixteenth of the
# rows: few rows are drawn twice before their new errors count, and summing priorities stays cheap.
MIN_BLOCK, MAX_BLOCK = 8, 128


def checked_errors(td_abs: NDArray[Any], rows: NDArray[Any]) -> F32:
    """Check |TD error| (n,) of rows (n,), and return it as float32.

    Raises:
        MixtureError: an error is negative or not finite, or there is not one per row.
    """
    errors = np.asarray(td_abs, np.float32)
    if errors.shape != np.shape(rows):
        raise MixtureError(
            f"TD errors of shape {errors.shape} for rows of shape {np.shape(rows)}",
            remedy="give one for each row that was drawn, in their order",
        )
    low, high = float(errors.min(initial=0.0)), float(errors.max(initial=0.0))  # NaN if any is
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


class Quotas(Stateful):
    """Turns shares into whole rows per batch by largest remainder, carrying the rounding error.

    If shares or the batch size change between batches, the carried rounding error is kept.

    Args:
        sizes: rows of each stratum (S,), to refuse shares of empty strata; None: no check.

    Raises:
        MixtureError: shares do not form a distribution, an empty stratum has a share, or the batch
            size is below 1.
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
        """Return how many rows each stratum is owed from earlier batches, (S,); may be negative."""
        return np.array(self._carry)

    @carry.setter
    def carry(self, owed: F64) -> None:
        self._carry = np.asarray(owed, np.float64).tolist()

    def checked(self, shares: Sequence[float] | F64) -> F64:
        """Check shares (S,), and return them scaled to sum to exactly 1."""
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
        # Do not scale shares twice: they must stay the same to the last bit.
        return given if abs(total - 1.0) < 1e-12 else np.asarray(given / total)

    def set_shares(self, shares: Sequence[float] | F64) -> None:
        """Set the shares (S,) from the next batch on; a stratum of share 0 loses its carry."""
        self.shares = self.checked(shares)
        self._mean = (self.shares * self.batch_size).tolist()
        drawn = self.shares > 0
        carry = np.where(drawn, self.carry, 0.0)
        self._carry = (carry - np.where(drawn, carry.sum() / drawn.sum(), 0.0)).tolist()

    def set_batch_size(self, batch_size: int) -> None:
        """Set the batch size from the next batch on."""
        if not isinstance(batch_size, int | np.integer) or batch_size < 1:
            raise MixtureError(f"batch_size must be an integer of at least 1, got {batch_size!r}")
        self.batch_size = int(batch_size)
        self._mean = (self.shares * batch_size).tolist()

    def restored(self) -> None:
        """Recompute the mean rows per batch from shares and batch size."""
        self._mean = (self.shares * self.batch_size).tolist()

    def next(self) -> Ints:
        """Return the rows per stratum of the next batch, (S,); they sum to the batch size."""
        first: Ints = self.take(1)[0]
        return first

    def take(self, batches: int) -> Ints:
        """Return the rows per stratum of the next batches, (n, S); each sums to the batch size."""
        if len(self.shares) == 1:
            return np.full((batches, 1), self.batch_size, np.int64)
        # Use lists: for a handful of strata, the overhead of NumPy calls dominates.
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
            for _ in range(-short):  # negative carries can make the others' sum too large
                index = min((i for i, q in enumerate(quota) if q), key=rest.__getitem__)
                quota[index] -= 1
                rest[index] += 1.0
            quotas.append(quota)
            carry = rest
        self._carry = carry
        return np.array(quotas, np.int64)

    def give_back(self, quotas: Ints) -> None:
        """Undo `take` for batches that were not handed out, (n, S)."""
        back = self.carry + quotas.sum(axis=0) - len(quotas) * np.array(self._mean)
        self._carry = back.tolist()


class QuotaSampler(Stateful):
    """Draws batches with exact quotas per stratum, and rows within a stratum by a rule of RULES.

    A block of batches is drawn at a time, and `draw` returns them one by one. A draw then costs a
    tenth of what gathering its rows costs; drawing batch by batch would cost about as much as
    gathering. Batches drawn ahead are part of `state_dict`.

    Args:
        stratum_rows: the row numbers of each stratum, S arrays (n_s,). Strata may be empty if
            their share is 0.
        shares: shares of the strata, (S,), summing to 1.
        batch_size: rows per batch.
        rng: the generator of the draws; its state is part of `state_dict`.
        within: the rule of all strata, or one rule per stratum, (S,).
        prioritised: parameters of the rule "per".
        column: returns a column of the panel's `meta`, for rules that use one.
        block: batches drawn at a time. None: 64, or if a rule draws by TD errors, a sixteenth of
            the rows, at least 8 and at most 128 batches. 1 draws every batch from the current
            priorities.

    Raises:
        MixtureError: shares do not form a distribution, or an empty stratum has a share.
    """

    SAME: ClassVar[tuple[str, ...]] = ("sizes", "within")
    STATE: ClassVar[tuple[str, ...]] = (
        *("quotas", "rng", "draws", "_batches", "_next"),
        *("_ahead_rows", "_ahead_places", "_ahead_strata", "_ahead_weights"),
    )

    def __init__(
        self,
        stratum_rows: Sequence[NDArray[Any]],
        shares: Sequence[float] | F64,
        batch_size: int,
        rng: np.random.Generator,
        *,
        within: str | Sequence[str] = "uniform",
        prioritised: Prioritised | None = None,
        column: Callable[[str], NDArray[Any]] = lambda name: np.empty(0),
        block: int | None = None,
    ) -> None:
        self._rows = [np.asarray(rows, np.int64) for rows in stratum_rows]
        self.sizes: Ints = np.array([len(rows) for rows in self._rows], np.int64)
        self.within = [within] * len(self.sizes) if isinstance(within, str) else list(within)
        self.quotas, self.rng = Quotas(shares, batch_size, self.sizes), rng
        self.follows_td = follow_td(self.within)
        if block is None:
            block = BLOCK
            if self.follows_td:
                block = min(max(int(self.sizes.sum()) // (16 * batch_size), MIN_BLOCK), MAX_BLOCK)
        self.block = block
        numbers = prioritised or Prioritised()
        self.draws = [
            RULES[name].draws(StratumRows(rows, rng, numbers, column))
            for name, rows in zip(self.within, self._rows, strict=True)
        ]
        self._batches = 0  # number of batches that `draw` returned
        self._next = 0  # index of the next batch in the block
        none: Ints = np.zeros((0, self.batch_size), np.int64)
        self._ahead_rows, self._ahead_strata = none, none
        self._ahead_places = none  # places of the rows within their strata
        self._ahead_weights: F32 | None = None
        self._learnt: list[tuple[Ints, F32]] = []  # rows and |TD errors| since the last block
        if self.follows_td:
            self._index_rows()

    @property
    def batch_size(self) -> int:
        return self.quotas.batch_size

    @property
    def shares(self) -> F64:
        return self.quotas.shares

    @property
    def drawn_weights(self) -> F32 | None:
        """Return the importance weights (B,) of the batch last drawn; None: all 1."""
        return None if self._ahead_weights is None else self._ahead_weights[self._next - 1]

    def draw(self) -> tuple[Ints, Ints]:
        """Return row numbers (B,) and the stratum of each row (B,), in order of strata."""
        if self._next == len(self._ahead_rows):
            self._draw_block()
        self._next += 1
        self._batches += 1
        return self._ahead_rows[self._next - 1], self._ahead_strata[self._next - 1]

    def update(self, rows: Ints, td_abs: NDArray[Any]) -> None:
        """Take the |TD error| (n,) of rows (n,) just used in an update, for the next block.

        Raises:
            MixtureError: a rule draws by TD errors, and an error is negative or not finite, or
                there is not one per row.
        """
        if self.follows_td:
            self._learnt.append((np.array(rows), checked_errors(td_abs, rows).copy()))

    def set_shares(self, shares: Sequence[float] | F64) -> None:
        """Set the shares (S,) from the next batch on; batches drawn ahead are undone.

        Raises:
            MixtureError: shares do not form a distribution, or an empty stratum has a share.
        """
        given = self.quotas.checked(shares)
        if not np.array_equal(given, self.quotas.shares):
            self._undo_ahead()
            self.quotas.set_shares(given)

    def set_batch_size(self, batch_size: int) -> None:
        """Set the batch size from the next batch on; batches drawn ahead are undone."""
        if batch_size != self.batch_size:
            self._undo_ahead()
            self.quotas.set_batch_size(batch_size)
            none: Ints = np.zeros((0, batch_size), np.int64)
            self._ahead_rows, self._ahead_places, self._ahead_strata = none, none, none

    def _draw_block(self) -> None:
        self._pass_on_errors()
        quota = self.quotas.take(self.block)  # (block, S)
        strata = np.tile(np.arange(len(self.sizes)), self.block)
        # Draw each stratum's rows for the whole block at once, then distribute them to batches.
        rows, places, weights = self._draw_all(quota.sum(axis=0))
        order = _block_positions(quota)
        self._ahead_rows = _scatter(rows, order).reshape(self.block, -1)
        self._ahead_places = _scatter(places, order).reshape(self.block, -1)
        self._ahead_strata = np.repeat(strata, quota.ravel()).reshape(self.block, -1)
        self._ahead_weights = None
        if weights is not None:
            self._ahead_weights = _scatter(weights, order).reshape(self.block, -1)
        self._next = 0

    def _draw_all(self, counts: Ints) -> tuple[Ints, Ints, F32 | None]:
        """Draw `counts` (S,) rows, stratum by stratum; return row numbers, places and weights."""
        rows, places, weights = [], [], []
        for stratum, count in enumerate(counts.tolist()):
            if not count:
                continue
            drawn, weight = self.draws[stratum].draw(count, self.rng, self._batches)
            rows.append(self._rows[stratum][drawn])
            places.append(drawn)
            weights.append(weight)
        joined = None
        if any(weight is not None for weight in weights):
            ones = (np.ones(len(some), np.float32) for some in rows)
            pairs = zip(weights, ones, strict=True)
            joined = np.concatenate([one if weight is None else weight for weight, one in pairs])
        return np.concatenate(rows), np.concatenate(places), joined

    def _undo_ahead(self) -> None:
        """Undo batches drawn ahead: restore the quotas' carry, and give rows back to the rules."""
        places, strata = self._ahead_places[self._next :], self._ahead_strata[self._next :]
        quota = np.stack([(strata == s).sum(axis=1) for s in range(len(self.sizes))], axis=1)
        self.quotas.give_back(quota)
        for stratum, draws in enumerate(self.draws):
            if quota[:, stratum].any():
                draws.give_back(places[strata == stratum])
        none = places[:0]
        self._ahead_rows, self._ahead_places, self._ahead_strata = none, none, none
        self._ahead_weights = None
        self._next = 0

    def _index_rows(self) -> None:
        """Make arrays from row number to stratum and place, for `update`."""
        last = max((int(rows.max(initial=-1)) for rows in self._rows), default=-1)
        self._stratum = np.zeros(last + 1, np.int16)
        self._place = np.zeros(last + 1, np.int32)
        for stratum, rows in enumerate(self._rows):
            self._stratum[rows] = stratum
            self._place[rows] = np.arange(len(rows))

    def state_dict(self) -> dict[str, Any]:
        """Return all state that later draws depend on, as arrays and JSON values."""
        self._pass_on_errors()
        return super().state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the state, so that later draws are the same as after `state_dict`."""
        self._learnt.clear()
        super().load_state_dict(state)

    def _pass_on_errors(self) -> None:
        """Pass all new TD errors to the rules at once: a call per batch would cost more."""
        if not self._learnt:
            return
        rows, errors = map(np.concatenate, zip(*self._learnt, strict=True))
        self._learnt.clear()
        places, stratum = self._place[rows].astype(np.int64), self._stratum[rows]
        for index, draws in enumerate(self.draws):
            inside = stratum == index
            if inside.any():
                draws.update(places[inside], errors[inside])

    def mismatch(self, name: str, value: Any) -> MixtureError:
        """Return the error for the state of a sampler over other strata."""
        return MixtureError(
            "the saved sampler drew from other strata, or by another rule",
            remedy="resume with the panel and the settings the run began with",
        )


def _scatter(values: NDArray[Any], order: Ints) -> NDArray[Any]:
    dealt = np.empty(len(order), values.dtype)
    dealt[order] = values
    return dealt


def _block_positions(quota: Ints) -> Ints:
    """Return the position in the block of each drawn row, (rows,).

    Rows are drawn stratum by stratum. In a block, they are in order of batches, then of strata.
    """
    begins = np.cumsum(quota).reshape(quota.shape) - quota  # (batches, S) first position in block
    counts = quota.T.ravel()
    return np.repeat(begins.T.ravel() - np.cumsum(counts) + counts, counts) + np.arange(
        counts.sum()
    )


def uniform_sampler(rows: int, batch_size: int, rng: np.random.Generator) -> QuotaSampler:
    """Return a sampler that draws every row with the same probability: one stratum of all rows."""
    return QuotaSampler([np.arange(rows)], [1.0], batch_size, rng)
