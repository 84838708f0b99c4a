"""Rows drawn in proportion to their priority, within each stratum.

Rules:

- `Per`: proportional prioritised replay (Schaul et al. 2016, arXiv:1511.05952), with importance
  weights against the change of distribution;
- `Lap`: loss-adjusted prioritised replay (Fujimoto et al. 2020, arXiv:2007.06049): priorities have
  a floor, the loss is Huber's with the same threshold, and no weights are needed.

A sum tree is exact and slow in Python. Here the sums are taken once for a block of batches, in one
pass, and the whole block is drawn from them: the distribution drawn from is the one at the start of
the block, and the weights are those of that distribution.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from restock.errors import MixtureError
from restock.replay.mixture.packed_row import F32, F64, Bools, Ints

CHUNK = 16  # rows whose priorities are summed first: a chunk is found, then the row in it


@dataclass(frozen=True)
class Per:
    """priority = (|TD| + epsilon) ** alpha; weights (n P) ** -beta, of mean 1 in each stratum.

    Schaul et al. divide weights by the largest. Here they have mean 1 over what a stratum draws, so
    that the quotas stay the shares of the gradient, and one row of a tiny priority cannot shrink
    every other's step. beta grows linearly from `beta` to 1 over `beta_batches`.
    """

    alpha: float = 0.6
    beta: float = 0.4
    beta_batches: int = 100_000
    epsilon: float = 1e-3
    floor: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        _check_alpha(self.alpha)
        if not 0 <= self.beta <= 1 or self.beta_batches < 1:
            raise MixtureError(
                f"PER: beta must be in [0, 1] and beta_batches above 0, got {self.beta:g}"
                f" and {self.beta_batches}"
            )
        if not self.epsilon > 0:
            raise MixtureError(f"PER: epsilon must be above 0, got {self.epsilon:g}")

    def beta_after(self, batches: int) -> float:
        """The exponent of the weights once so many batches are drawn."""
        return min(1.0, self.beta + (1.0 - self.beta) * batches / self.beta_batches)


@dataclass(frozen=True)
class Lap:
    """priority = max(|TD|, floor) ** alpha; no weights. `floor` is the Huber loss's threshold."""

    alpha: float = 0.4
    floor: float = 1.0
    epsilon: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        _check_alpha(self.alpha)
        if not self.floor > 0:
            raise MixtureError(f"LAP: floor must be above 0, got {self.floor:g}")

    def beta_after(self, batches: int) -> float:
        """No weights, whenever."""
        return 0.0


Rule = Per | Lap


class Exponents:
    """The numbers of S rules side by side: priority = max(|TD| + epsilon, floor) ** alpha."""

    def __init__(self, rules: Sequence[Rule | None]) -> None:
        def each(name: str) -> F32:
            return np.array([getattr(rule, name, 0.0) for rule in rules], np.float32)

        self.epsilon, self.floor, self.alpha = each("epsilon"), each("floor"), each("alpha")
        self._alike = len(set(rules)) == 1

    def priority(self, td_abs: F32, stratum: NDArray[Any]) -> F32:
        """(n,), above 0, of |TD| (n,) of rows of these strata (n,)."""
        of: Any = 0 if self._alike else stratum
        raised: F32 = np.maximum(td_abs + self.epsilon[of], self.floor[of])
        raised **= self.alpha[of]
        return raised


def _check_alpha(alpha: float) -> None:
    if not 0 <= alpha <= 1:
        raise MixtureError(f"alpha must be in [0, 1], got {alpha:g}")


class Priorities:
    """The priorities of the rows of S strata, and draws in proportion.

    Rows lie stratum by stratum, each stratum's filled up to a multiple of CHUNK with rows of
    priority 0 that are never drawn. A row that was not drawn yet has the largest priority that its
    stratum has had, so that every row is seen.

    Args:
        rules: of each stratum, (S,); the rows of one that has None have no priority.

    Raises:
        MixtureError: a row in two strata.
    """

    def __init__(self, stratum_rows: Sequence[NDArray[Any]], rules: Sequence[Rule | None]) -> None:
        self.rules = tuple(rules)
        self.exponents = Exponents(rules)
        joined = np.concatenate([np.asarray(rows, np.int64) for rows in stratum_rows])
        if len(np.unique(joined)) != len(joined):
            raise MixtureError(
                "a row is in two strata", remedy="strata drawn by priority must be disjoint"
            )
        ruled = [rule is not None for rule in rules]
        self.sizes: Ints = np.array(
            [len(rows) if own else 0 for rows, own in zip(stratum_rows, ruled, strict=True)]
        )
        room = -(-self.sizes // CHUNK) * CHUNK
        self._first: Ints = np.concatenate([[0], np.cumsum(room)])[:-1].astype(np.int64)
        self._stratum = np.repeat(np.arange(len(room), dtype=np.int16), room)  # of each place
        self._rows: Ints = np.full(int(room.sum()), -1, np.int64)
        self._place = np.full(int(joined.max(initial=-1)) + 1, -1, np.int32)
        for stratum in np.flatnonzero(self.sizes).tolist():
            first, rows = int(self._first[stratum]), np.asarray(stratum_rows[stratum], np.int64)
            self._rows[first : first + len(rows)] = rows
            self._place[rows] = first + np.arange(len(rows))
        self._filled = np.flatnonzero(self._rows >= 0)
        self._largest: F32 = self.exponents.priority(
            np.ones(len(room), np.float32), np.arange(len(room))
        )
        self._priority: F32 = np.zeros(len(self._rows), np.float32)
        self._priority[self._filled] = self._largest[self._stratum[self._filled]]
        self._new: Bools = self._rows >= 0  # not drawn yet
        self._any_new = True
        self._stale_new = False  # a largest priority grew since rows not drawn yet were given it

    def of(self, rows: Ints) -> F32:
        """The priorities of rows (n,) of strata that have a rule, as they are now."""
        return self._priority[self._place[rows]]

    def update(self, rows: Ints, td_abs: NDArray[Any]) -> None:
        """New |TD error| (n,) of rows (n,); those of strata without a rule are left alone.

        Raises:
            MixtureError: a TD error that is not finite.
        """
        place, errors = self._place[rows], np.asarray(td_abs, np.float32)
        if None in self.rules:
            place, errors = place[place >= 0], errors[place >= 0]
        stratum = self._stratum[place]
        priority = self.exponents.priority(errors, stratum)
        largest = priority.max(initial=0.0)
        if not np.isfinite(largest):  # max passes NaN on
            raise MixtureError(
                f"{int((~np.isfinite(errors)).sum())} TD errors are not finite",
                remedy="training has diverged: lower the learning rate, or slow the target down",
            )
        self._priority[place] = priority
        if self._any_new:
            self._new[place] = False
        if largest > self._largest.min() and (priority > self._largest[stratum]).any():
            np.maximum.at(self._largest, stratum, priority)
            self._stale_new = True

    def draw(self, counts: Ints, batches: int, rng: np.random.Generator) -> tuple[Ints, F32 | None]:
        """`counts` (S,) rows of each stratum, in proportion to the priorities as they are now.

        Those of strata without a rule must be 0.

        Each stratum's range of sums is cut into `counts` equal parts with one draw in each (Schaul
        et al., appendix B.2.1), dealt in random order: a row's expected draws are exactly in
        proportion.

        Returns row numbers (counts.sum(),), stratum by stratum, and their weights, None for ones.
        """
        self._any_new = self._any_new and bool(self._new.any())
        if self._stale_new and self._any_new:
            self._priority[self._new] = self._largest[self._stratum[self._new]]
        self._stale_new = False
        # einsum adds in the same order whatever the number of threads; BLAS may not.
        sums: F32 = np.einsum("ij->i", self._priority.reshape(-1, CHUNK))
        drawn, weights = [np.empty(0, np.int64)], [np.empty(0, np.float32)]
        weighted = False
        for stratum in np.flatnonzero(counts).tolist():
            count, size = int(counts[stratum]), int(self.sizes[stratum])
            first = int(self._first[stratum])
            chunks = sums[first // CHUNK : -(-(first + size) // CHUNK)]
            place = first + self._search(chunks, first, size, rng.random(count))
            place = place[rng.permutation(count)]
            drawn.append(self._rows[place])
            rule = self.rules[stratum]
            beta = 0.0 if rule is None else rule.beta_after(batches)
            if beta > 0:
                own = self._priority[first : first + size]
                total = float(chunks.sum(dtype=np.float64))
                weights.append(_weights(self._priority[place], own, total, beta))
                weighted = True
            else:
                weights.append(np.ones(count, np.float32))
        return np.concatenate(drawn), np.concatenate(weights) if weighted else None

    def _search(self, chunks: F32, first: int, size: int, within: F64) -> Ints:
        """Which member of the stratum at `first` each of `within` (n,), in [0, 1), falls on."""
        ends = np.cumsum(chunks, dtype=np.float64)
        at = (np.arange(len(within)) + within) * (ends[-1] / len(within))  # ascending
        chunk = np.minimum(np.searchsorted(ends, at, "right"), len(chunks) - 1)
        rest = (at - (ends[chunk] - chunks[chunk])).astype(np.float32)
        inside = self._priority[first : first + len(chunks) * CHUNK].reshape(-1, CHUNK)[chunk]
        upto = np.ascontiguousarray(inside.T)  # (CHUNK, n)
        # Not by a product with ones: BLAS would wake its threads, which costs more than the sums.
        for before, here in itertools.pairwise(upto):
            here += before
        # As many of the chunk's members are passed as sums up to them are at or below the rest.
        member = np.add.reduce(upto[:-1] <= rest, axis=0, dtype=np.int8)
        place: Ints = chunk * CHUNK + member
        return np.minimum(place, size - 1)

    def state_dict(self) -> dict[str, Any]:
        """Arrays and JSON values."""
        return {
            "priority": self._priority[self._filled],
            "new": self._new[self._filled],
            "largest": self._largest.copy(),
            "stale_new": self._stale_new,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Puts the priorities where `state_dict` found them."""
        self._priority[self._filled] = state["priority"]
        self._new[self._filled] = state["new"]
        self._largest = np.array(state["largest"], np.float32)
        self._any_new, self._stale_new = True, bool(state["stale_new"])


def _weights(drawn: F32, priority: F32, total: float, beta: float) -> F32:
    """(n P) ** -beta over its mean under P, of rows of priority `drawn` (n,) out of `priority`."""
    if beta == 1.0:
        mean = float(len(priority))
    else:
        mean = float((priority ** np.float32(1.0 - beta)).sum(dtype=np.float64))
    return np.asarray(total / mean * drawn ** np.float32(-beta), np.float32)
