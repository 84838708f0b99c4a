"""Batches by quota between strata, and in proportion to priorities within each.

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
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from restock import native
from restock.arrays import F32, F64, Bools, Ints
from restock.errors import MixtureError
from restock.replay.mixture.mixture import Prioritised, Within
from restock.replay.sampling.sampler import QuotaSampler, Sampler, checked_errors
from restock.state import Stateful

# Of batches drawn from one state of the priorities. A block draws at most a sixteenth of the rows,
# so that few come again before what was learnt of them counts; many rows cost more to sum.
FEWEST, MOST = 8, 128
CHUNK = 16  # rows whose priorities are summed first: a chunk is found, then the row in it
MEAN_OF = 32_768  # priorities, at least, that give the mean weight of a stratum


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


class Priorities(Stateful):
    """The priorities of the rows of S strata, and draws in proportion.

    Rows lie stratum by stratum, each stratum's filled up to a multiple of CHUNK with rows of
    priority 0 that are never drawn. A row that was not drawn yet has the largest priority that its
    stratum has had, so that every row is seen.

    Args:
        rules: of each stratum, (S,); the rows of one that has None have no priority.

    Raises:
        MixtureError: a row in two strata.
    """

    STATE: ClassVar[tuple[str, ...]] = ("_priority", "_new", "_any_new", "_largest", "_stale_new")

    def __init__(self, stratum_rows: Sequence[NDArray[Any]], rules: Sequence[Rule | None]) -> None:
        self.rules = tuple(rules)
        self._some_unruled = None in self.rules
        self.exponents = Exponents(rules)
        joined = np.concatenate([np.asarray(rows, np.int64) for rows in stratum_rows])
        if len(np.unique(joined)) != len(joined):
            raise MixtureError(
                "a row is in two strata", remedy="strata drawn by priority must be disjoint"
            )
        ruled = [rule is not None for rule in rules]
        self.sizes: Ints = np.array(
            [
                len(rows) if has_rule else 0
                for rows, has_rule in zip(stratum_rows, ruled, strict=True)
            ]
        )
        self._room = room = -(-self.sizes // CHUNK) * CHUNK  # places of each stratum
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
            MixtureError: a TD error that is negative or not finite, or not one a row.
        """
        place, errors = self._place[rows], checked_errors(td_abs, rows)
        if self._some_unruled:
            place, errors = place[place >= 0], errors[place >= 0]
        stratum: Any = self._stratum[place] if len(self.rules) > 1 else 0
        priority = self.exponents.priority(errors, stratum)
        largest = float(priority.max(initial=0.0))
        self._priority[place] = priority
        if self._any_new:
            self._new[place] = False
        if largest > self._largest.min() and (priority > self._largest[stratum]).any():
            np.maximum.at(self._largest, self._stratum[place], priority)
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
            for first, room, largest in zip(self._first, self._room, self._largest, strict=True):
                places = slice(first, first + room)
                np.copyto(self._priority[places], largest, where=self._new[places])
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
                priorities = self._priority[first : first + size]
                total = float(chunks.sum(dtype=np.float64))
                weights.append(_weights(self._priority[place], priorities, total, beta))
                weighted = True
            else:
                weights.append(np.ones(count, np.float32))
        return np.concatenate(drawn), np.concatenate(weights) if weighted else None

    def _search(self, chunks: F32, first: int, size: int, within: F64) -> Ints:
        """Which member of the stratum at `first` each of `within` (n,), in [0, 1), falls on."""
        ends = np.cumsum(chunks, dtype=np.float64)
        at = (np.arange(len(within)) + within) * (ends[-1] / len(within))  # ascending
        priority = self._priority[first : first + len(chunks) * CHUNK].reshape(-1, CHUNK)
        place: Ints = np.empty(len(at), np.int64)
        find = native.compiled.find_places if native.is_used() else find_places
        find(priority, chunks, ends, at, place)
        return np.minimum(place, size - 1, out=place)


def find_places(priority: F32, sums: F32, ends: F64, at: F64, out: Ints) -> None:
    """The compiled function of that name, in NumPy: the same places."""
    chunk = np.minimum(np.searchsorted(ends, at, "right"), len(ends) - 1)
    rest = (at - (ends[chunk] - sums[chunk])).astype(np.float32)
    upto = np.ascontiguousarray(priority[chunk].T)  # (CHUNK, n)
    # Not by a product with ones: BLAS would wake its threads, which costs more than the sums.
    for before, here in itertools.pairwise(upto):
        here += before
    # As many of the chunk's members are passed as sums up to them are at or below the rest.
    np.add.reduce(upto[:-1] <= rest, axis=0, dtype=np.int8, out=out)
    out += chunk * CHUNK


def _weights(drawn: F32, priority: F32, total: float, beta: float) -> F32:
    """(n P) ** -beta over its mean under P, of rows of priority `drawn` (n,) out of `priority`.

    Of many rows the mean is that of some, evenly spaced: a power of each would cost as much as all
    else together.
    """
    some = np.ascontiguousarray(priority[:: max(len(priority) // MEAN_OF, 1)])
    mean = 1.0 if beta == 1.0 else float((some ** np.float32(1.0 - beta)).mean(dtype=np.float64))
    scale = total / (len(priority) * mean)
    return np.asarray(scale * drawn ** np.float32(-beta), np.float32)


class PrioritySampler(QuotaSampler):
    """Exact quotas per batch over strata, each stratum's rows in proportion to their priority.

    Args:
        rule: `Per()` or `Lap()`, of all strata or of each, (S,). A stratum that has None is drawn
            from as `replacement` says.
        refresh_every: batches drawn from one state of the priorities; None: as many as a sixteenth
            of the rows make, within 8 and 128. 1 draws every batch from the priorities as they are.

    After each draw, `drawn_weights` (B,) are the importance weights of the distribution that the
    batch was really drawn from, and `update` takes the |TD errors| of what was learnt.

    Raises:
        MixtureError: as `QuotaSampler`, or a row in two strata.
    """

    SAME: ClassVar[tuple[str, ...]] = (*QuotaSampler.SAME, "_ruled")
    STATE: ClassVar[tuple[str, ...]] = (
        *QuotaSampler.STATE,
        *("_batches", "priorities", "_ahead_weights"),
    )

    def __init__(
        self,
        stratum_rows: Sequence[NDArray[Any]],
        shares: Sequence[float] | F64,
        batch_size: int,
        rng: np.random.Generator,
        *,
        rule: Rule | Sequence[Rule | None],
        refresh_every: int | None = None,
        weights: F32 | None = None,
        replacement: bool | Sequence[bool] = True,
    ) -> None:
        rules = [rule] * len(stratum_rows) if isinstance(rule, Per | Lap) else list(rule)
        if len(rules) != len(stratum_rows):
            raise MixtureError(f"{len(rules)} rules for {len(stratum_rows)} strata")
        given = [replacement] * len(rules) if isinstance(replacement, bool) else list(replacement)
        # By priority is with replacement.
        again = [replaced or rule is not None for replaced, rule in zip(given, rules, strict=True)]
        super().__init__(stratum_rows, shares, batch_size, rng, weights=weights, replacement=again)
        if refresh_every is None:
            some = int(self.sizes.sum()) // (16 * batch_size)
            refresh_every = min(max(some, FEWEST), MOST)
        if refresh_every < 1:
            raise MixtureError(f"refresh_every must be at least 1, got {refresh_every}")
        self.block = refresh_every
        self.priorities = Priorities(stratum_rows, rules)
        self._ruled: Bools = np.array([rule is not None for rule in rules], np.bool_)
        self._batches = 0  # handed out
        self._ahead_weights: F32 | None = None

    @property
    def drawn_weights(self) -> F32 | None:
        """Importance weights (B,) that the batch last drawn needs; None where the rule has none."""
        return None if self._ahead_weights is None else self._ahead_weights[self._next - 1]

    def draw(self) -> tuple[Ints, Ints]:
        """Row numbers (B,) and the stratum of each (B,), strata in order."""
        rows, strata = super().draw()
        self._batches += 1
        return rows, strata

    def update(self, rows: Ints, td_abs: NDArray[Any]) -> None:
        """|TD error| (n,) of rows (n,) just learnt from: their priorities from the next block on.

        Raises:
            MixtureError: a TD error that is negative or not finite, or not one a row.
        """
        self.priorities.update(rows, td_abs)

    def _take_all(self, counts: Ints, order: Ints) -> None:
        ruled = self._ruled
        rows, weights = self.priorities.draw(np.where(ruled, counts, 0), self._batches, self.rng)
        if not ruled.all():
            rows, weights = self._with_others(rows, weights, counts)
        drawn = np.empty(len(order), np.int64)
        drawn[order] = rows
        self._ahead_rows = drawn.reshape(self.block, -1)
        self._ahead_weights = None
        if weights is not None:
            dealt = np.empty(len(order), np.float32)
            dealt[order] = weights
            self._ahead_weights = dealt.reshape(self.block, -1)

    def _with_others(
        self, rows: Ints, weights: F32 | None, counts: Ints
    ) -> tuple[Ints, F32 | None]:
        """Rows by priority and those of strata without a rule, stratum by stratum."""
        by_priority = np.repeat(self._ruled, counts)
        every = np.empty(len(by_priority), np.int64)
        every[by_priority] = rows
        others = [
            self._take(stratum, int(counts[stratum]))
            for stratum in np.flatnonzero(~self._ruled).tolist()
        ]
        every[~by_priority] = np.concatenate(others)
        if weights is None:
            return every, None
        all_weights = np.ones(len(every), np.float32)
        all_weights[by_priority] = weights
        return every, all_weights

    def _hand_back(self) -> None:
        super()._hand_back()
        self._ahead_weights = None


def sampler_by_rules(
    within: Sequence[Within],
    stratum_rows: Sequence[NDArray[Any]],
    shares: F64,
    batch_size: int,
    rng: np.random.Generator,
    numbers: Prioritised,
    *,
    lap_floor: float = 1.0,
) -> Sampler:
    """The sampler for strata that are each drawn from by a rule (S,), the same one or not."""
    again = [rule != "without_replacement" for rule in within]
    if not any(rule in ("per", "lap") for rule in within):
        return QuotaSampler(stratum_rows, shares, batch_size, rng, replacement=again)
    per = Per(numbers.per_alpha, numbers.per_beta, numbers.per_beta_batches, numbers.per_epsilon)
    named: dict[Within, Rule] = {"per": per, "lap": Lap(numbers.lap_alpha, lap_floor)}
    rules = [named.get(rule) for rule in within]
    return PrioritySampler(stratum_rows, shares, batch_size, rng, rule=rules, replacement=again)
