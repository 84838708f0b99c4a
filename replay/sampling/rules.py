"""The rules by which rows are drawn within a stratum, and the table `RULES` of them.

`within` of a mixture is a key of `RULES`. The check of a mixture, the samplers, the buffers of
other libraries, `restock mix` and the report use this table. To add a rule, write a file with a
subclass of `StratumDraws` and add an entry here. Rules work with places, 0 to n - 1 within their
stratum; the sampler maps places to rows of the panel.

`Per` is proportional PER (Schaul et al. 2016, arXiv:1511.05952). A sum tree is exact, but slow in
Python. Here the priorities are summed once, and a whole block of batches is drawn from these sums:
draws and weights follow the priorities at the start of the block.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from restock import native
from restock.arrays import F32, F64, Bools, Ints
from restock.state import Stateful
from restock.toml import Checked


@dataclass(frozen=True)
class StratumRows:
    """The rows of one stratum, as passed to a rule.

    `column(NAME)` returns a column of `Panel.meta` for these rows, (n,): `logged_ns`, `zone`, ….
    """

    numbers: Ints  # (n,) row numbers in the panel
    rng: np.random.Generator  # the sampler's generator, for shuffling before the first draw
    prioritised: Prioritised  # the mixture's table [prioritised]
    panel_column: Callable[[str], NDArray[Any]]

    def __len__(self) -> int:
        return len(self.numbers)

    def column(self, name: str) -> NDArray[Any]:
        """Return a column of the panel's `meta` for these rows, (n,)."""
        return self.panel_column(name)[self.numbers]


class StratumDraws(Stateful):
    """Draws from the rows of one stratum; each rule is a subclass. Places number its rows from 0.

    `STATE` names the attributes that later draws depend on; a checkpoint keeps them.
    """

    def draw(self, count: int, rng: np.random.Generator, batches: int) -> tuple[Ints, F32 | None]:
        """Return the places (count,) of the next rows and their importance weights (None: all 1).

        One call draws the stratum's rows for several batches. `batches` is the number of batches
        that the sampler returned before.
        """
        raise NotImplementedError

    def give_back(self, places: Ints) -> None:
        """Take back rows (n,) that were drawn ahead but not used because the shares changed."""

    def update(self, places: Ints, td_abs: F32) -> None:
        """Take the |TD error| (n,) of rows (n,) that were just used in an update."""


class Uniform(StratumDraws):
    """Draws all rows with equal probability, with replacement."""

    def __init__(self, rows: StratumRows) -> None:
        self._size = len(rows)

    def draw(self, count: int, rng: np.random.Generator, batches: int) -> tuple[Ints, F32 | None]:
        return uniform_places(rng.random(count), self._size), None


def uniform_places(at: F64, size: int) -> Ints:
    """Map numbers (n,) in [0, 1) to places (n,) among `size` rows."""
    return (at * size).astype(np.int64)


class InTurns(StratumDraws):
    """Draws each row once, in shuffled order, before any is drawn again."""

    STATE: ClassVar[tuple[str, ...]] = ("_order", "_cursor", "_returned")

    def __init__(self, rows: StratumRows) -> None:
        self._order: Ints = np.arange(len(rows))
        rows.rng.shuffle(self._order)
        self._cursor = 0
        self._returned: Ints = np.empty(0, np.int64)  # rows given back, to be drawn next

    def draw(self, count: int, rng: np.random.Generator, batches: int) -> tuple[Ints, F32 | None]:
        parts, self._returned = [self._returned[:count]], self._returned[count:]
        count -= len(parts[0])
        while count:
            if self._cursor == len(self._order):  # all rows have been drawn
                rng.shuffle(self._order)
                self._cursor = 0
            some = min(count, len(self._order) - self._cursor)
            parts.append(self._order[self._cursor : self._cursor + some].copy())
            self._cursor += some
            count -= some
        return np.concatenate(parts), None

    def give_back(self, places: Ints) -> None:
        self._returned = np.concatenate([places, self._returned])


CHUNK = 16  # rows whose priorities are summed: a search finds a chunk, then the row in it
BETA_BATCHES = 100_000  # batches after which the exponent of the weights is 1
EPSILON = 1e-3  # added to |TD error|
MEAN_OF = 32_768  # in a larger stratum, the mean weight is estimated from at least so many rows

_Fraction = Annotated[float, Meta(ge=0, le=1)]


class Prioritised(Checked, frozen=True):
    """Parameters of `within = "per"` (arXiv:1511.05952)."""

    per_alpha: _Fraction = 0.6  # exponent of |TD|
    per_beta: _Fraction = 0.4  # exponent of the importance weights at the start; grows to 1

    def beta_after(self, batches: int) -> float:
        """Return the exponent of the weights after `batches`; it grows linearly to 1."""
        return min(1.0, self.per_beta + (1.0 - self.per_beta) * batches / BETA_BATCHES)


class Per(StratumDraws):
    """Draws rows by priority (|TD| + epsilon) ** alpha, with weights (n P) ** -beta of mean 1.

    P is a row's priority over their sum. Schaul et al. divide weights by the largest one. With mean
    1, a stratum's share of the gradient is its quota, and a single row with a tiny priority cannot
    shrink the steps of all other rows.

    A row that has not been used yet has the largest priority so far in its stratum, so that every
    row gets drawn. Priorities are padded to a multiple of CHUNK with zeros, which are never drawn.
    """

    STATE: ClassVar[tuple[str, ...]] = ("_priority", "_new", "_any_new", "_largest", "_stale_new")

    def __init__(self, rows: StratumRows) -> None:
        self.numbers = rows.prioritised
        self.size = len(rows)
        self._largest = float(self._raised(np.ones(1, np.float32))[0])
        self._priority: F32 = np.zeros(-(-self.size // CHUNK) * CHUNK, np.float32)
        self._priority[: self.size] = self._largest
        self._new: Bools = np.ones(self.size, np.bool_)  # rows without a TD error so far
        self._any_new = True
        self._stale_new = False  # whether `_largest` grew since new rows got it as priority

    @property
    def priority(self) -> F32:
        """Return the current priorities of the rows, (n,)."""
        return self._priority[: self.size]

    def _raised(self, td_abs: F32) -> F32:
        raised: F32 = td_abs + np.float32(EPSILON)
        raised **= np.float32(self.numbers.per_alpha)
        return raised

    def update(self, places: Ints, td_abs: F32) -> None:
        priority = self._raised(td_abs)
        self._priority[places] = priority
        if self._any_new:
            self._new[places] = False
        largest = float(priority.max(initial=0.0))
        if largest > self._largest:
            self._largest, self._stale_new = largest, True

    def draw(self, count: int, rng: np.random.Generator, batches: int) -> tuple[Ints, F32 | None]:
        """Draw in proportion to the current priorities.

        The sum of priorities is divided into `count` equal parts with one draw in each (Schaul et
        al., appendix B.2.1). The draws are then shuffled. A row's expected number of draws is
        exactly proportional to its priority.
        """
        self._any_new = self._any_new and bool(self._new.any())
        if self._stale_new and self._any_new:
            np.copyto(self.priority, np.float32(self._largest), where=self._new)
        self._stale_new = False
        # Unlike BLAS, einsum adds in the same order for any number of threads.
        sums: F32 = np.einsum("ij->i", self._priority.reshape(-1, CHUNK))
        places = self._search(sums, rng.random(count))
        places = places[rng.permutation(count)]
        beta = self.numbers.beta_after(batches)
        if beta == 0:
            return places, None
        total = float(sums.sum(dtype=np.float64))
        return places, _weights(self._priority[places], self.priority, total, beta)

    def _search(self, sums: F32, within: F64) -> Ints:
        """Return a place in each of n equal parts of all priorities, at offsets `within` (n,)."""
        ends = np.cumsum(sums, dtype=np.float64)
        at = (np.arange(len(within)) + within) * (ends[-1] / len(within))  # ascending
        places: Ints = np.empty(len(at), np.int64)
        find = native.compiled.find_places if native.IS_USED else find_places
        find(self._priority.reshape(-1, CHUNK), sums, ends, at, places)
        return np.minimum(places, self.size - 1, out=places)


def find_places(priority: F32, sums: F32, ends: F64, at: F64, out: Ints) -> None:
    """Find places like the compiled function `find_places`, but in NumPy."""
    chunk = np.minimum(np.searchsorted(ends, at, "right"), len(ends) - 1)
    rest = (at - (ends[chunk] - sums[chunk])).astype(np.float32)
    upto = np.ascontiguousarray(priority[chunk].T)  # (CHUNK, n)
    # Sum in a loop: for a matrix product, BLAS would wake its threads, which costs more.
    for before, current in itertools.pairwise(upto):
        current += before
    # The place in the chunk is the number of cumulative sums that are at most `rest`.
    np.add.reduce(upto[:-1] <= rest, axis=0, dtype=np.int8, out=out)
    out += chunk * CHUNK


def _weights(drawn: F32, priority: F32, total: float, beta: float) -> F32:
    """Return (n P) ** -beta over its mean under P, for rows with priorities `drawn`.

    In a large stratum, the mean is estimated from evenly spaced rows: to raise every priority to a
    power would cost as much as everything else together.
    """
    some = np.ascontiguousarray(priority[:: max(len(priority) // MEAN_OF, 1)])
    mean = 1.0 if beta == 1.0 else float((some ** np.float32(1.0 - beta)).mean(dtype=np.float64))
    scale = total / (len(priority) * mean)
    return np.asarray(scale * drawn ** np.float32(-beta), np.float32)


@dataclass(frozen=True)
class Rule:
    """An entry of RULES: a class that draws, and what its callers need to know."""

    draws: Callable[[StratumRows], StratumDraws]
    doc: str  # how rows are drawn, for reports
    follows_td: bool = False  # draws depend on TD errors passed to `update`
    has_weights: bool = False  # draws come with importance weights


RULES: dict[str, Rule] = {
    "uniform": Rule(Uniform, "uniformly, with replacement"),
    "without_replacement": Rule(InTurns, "without replacement"),
    "per": Rule(Per, "by TD error (PER)", follows_td=True, has_weights=True),
}


def follow_td(names: Iterable[str]) -> bool:
    """Return whether any of these rules draws by TD errors."""
    return any(RULES[name].follows_td for name in names)
