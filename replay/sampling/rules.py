"""The rules by which rows are drawn within a stratum, and the table of them.

`within` of a mixture names a row of `RULES`. The check of a mixture, the samplers, the buffers of
other libraries, `restock mix` and the report use this table; a rule of your own is one file with a
subclass of `StratumDraws`, and a row here. Rules work with places, 0 to n - 1 within their stratum;
the sampler knows which row of the panel each is.

`Per` is proportional PER (Schaul et al. 2016, arXiv:1511.05952). A sum tree is exact and slow in
Python. Here the sums are taken once for a block of batches, in one pass, and the whole block is
drawn from them: the distribution drawn from is the one at the start of the block, and the weights
are those of that distribution.
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
    """The rows of one stratum, as a rule gets them.

    `column(NAME)` gives a column of `Panel.meta` for these rows, (n,): `logged_ns`, `zone`, ….
    """

    numbers: Ints  # (n,) of the panel
    rng: np.random.Generator  # the sampler's own: for what a rule shuffles before the first draw
    prioritised: Prioritised  # the mixture's [prioritised]
    panel_column: Callable[[str], NDArray[Any]]

    def __len__(self) -> int:
        return len(self.numbers)

    def column(self, name: str) -> NDArray[Any]:
        """Return a column of the panel's `meta` for these rows, (n,)."""
        return self.panel_column(name)[self.numbers]


class StratumDraws(Stateful):
    """Draws from the rows of one stratum; a rule is a subclass.

    `STATE` names the attributes that decide the draws to come: a checkpoint keeps them.
    """

    def draw(self, count: int, rng: np.random.Generator, batches: int) -> tuple[Ints, F32 | None]:
        """Return the places (count,) of the next rows and their importance weights; None: ones.

        All that a stratum gives to several batches is drawn at once; `batches` is how many were
        handed out before.
        """
        raise NotImplementedError

    def give_back(self, places: Ints) -> None:
        """Take back rows (n,) that were drawn ahead and not handed out, as the shares changed."""

    def update(self, places: Ints, td_abs: F32) -> None:
        """Take the |TD error| (n,) of rows (n,) that were just learnt from."""


class Uniform(StratumDraws):
    """Draws all rows with equal probability, with replacement."""

    def __init__(self, rows: StratumRows) -> None:
        self._size = len(rows)

    def draw(self, count: int, rng: np.random.Generator, batches: int) -> tuple[Ints, F32 | None]:
        return uniform_places(rng.random(count), self._size), None


def uniform_places(at: F64, size: int) -> Ints:
    """Return the places (n,) among `size` rows that numbers (n,) in [0, 1) fall on."""
    return (at * size).astype(np.int64)


class InTurns(StratumDraws):
    """Draws each row once, in shuffled order, before any is drawn again."""

    STATE: ClassVar[tuple[str, ...]] = ("_order", "_cursor", "_returned")

    def __init__(self, rows: StratumRows) -> None:
        self._order: Ints = np.arange(len(rows))
        rows.rng.shuffle(self._order)
        self._cursor = 0
        self._returned: Ints = np.empty(0, np.int64)  # drawn ahead and given back: next ones

    def draw(self, count: int, rng: np.random.Generator, batches: int) -> tuple[Ints, F32 | None]:
        parts, self._returned = [self._returned[:count]], self._returned[count:]
        count -= len(parts[0])
        while count:
            if self._cursor == len(self._order):  # all have had their turn
                rng.shuffle(self._order)
                self._cursor = 0
            some = min(count, len(self._order) - self._cursor)
            parts.append(self._order[self._cursor : self._cursor + some].copy())
            self._cursor += some
            count -= some
        return np.concatenate(parts), None

    def give_back(self, places: Ints) -> None:
        self._returned = np.concatenate([places, self._returned])


CHUNK = 16  # rows whose priorities are summed first: a chunk is found, then the row in it
BETA_BATCHES = 100_000  # batches after which the exponent of the weights is 1
EPSILON = 1e-3  # added to |TD|
MEAN_OF = 32_768  # priorities, at least, that give the mean weight of a stratum

_Fraction = Annotated[float, Meta(ge=0, le=1)]


class Prioritised(Checked, frozen=True):
    """Numbers of `within = "per"` (arXiv:1511.05952)."""

    per_alpha: _Fraction = 0.6  # exponent of |TD|
    per_beta: _Fraction = 0.4  # exponent of the importance weights at the start; grows to 1

    def beta_after(self, batches: int) -> float:
        """Return the exponent of the weights after so many batches: it grows linearly to 1."""
        return min(1.0, self.per_beta + (1.0 - self.per_beta) * batches / BETA_BATCHES)


class Per(StratumDraws):
    """Draws rows by priority (|TD| + epsilon) ** alpha, with weights (n P) ** -beta of mean 1.

    Schaul et al. divide weights by the largest. Here they have mean 1 over what a stratum draws, so
    that the quotas stay the shares of the gradient, and one row of a tiny priority cannot shrink
    every other's step.

    A row that was not drawn yet has the largest priority that its stratum has had, so that every
    row is seen. The rows are filled up to a multiple of CHUNK with priorities of 0, which are never
    drawn.
    """

    STATE: ClassVar[tuple[str, ...]] = ("_priority", "_new", "_any_new", "_largest", "_stale_new")

    def __init__(self, rows: StratumRows) -> None:
        self.numbers = rows.prioritised
        self.size = len(rows)
        self._largest = float(self._raised(np.ones(1, np.float32))[0])
        self._priority: F32 = np.zeros(-(-self.size // CHUNK) * CHUNK, np.float32)
        self._priority[: self.size] = self._largest
        self._new: Bools = np.ones(self.size, np.bool_)  # not drawn yet
        self._any_new = True
        self._stale_new = False  # the largest priority grew since rows not drawn yet were given it

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
        """Draw in proportion to the priorities as they are now.

        The range of sums is cut into `count` equal parts with one draw in each (Schaul et al.,
        appendix B.2.1), dealt in random order: a row's expected draws are exactly in proportion.
        """
        self._any_new = self._any_new and bool(self._new.any())
        if self._stale_new and self._any_new:
            np.copyto(self.priority, np.float32(self._largest), where=self._new)
        self._stale_new = False
        # einsum adds in the same order whatever the number of threads; BLAS may not.
        sums: F32 = np.einsum("ij->i", self._priority.reshape(-1, CHUNK))
        places = self._search(sums, rng.random(count))
        places = places[rng.permutation(count)]
        beta = self.numbers.beta_after(batches)
        if beta == 0:
            return places, None
        total = float(sums.sum(dtype=np.float64))
        return places, _weights(self._priority[places], self.priority, total, beta)

    def _search(self, sums: F32, within: F64) -> Ints:
        """Find the place that each of `within` (n,), in [0, 1) of its part, falls on."""
        ends = np.cumsum(sums, dtype=np.float64)
        at = (np.arange(len(within)) + within) * (ends[-1] / len(within))  # ascending
        places: Ints = np.empty(len(at), np.int64)
        find = native.compiled.find_places if native.IS_USED else find_places
        find(self._priority.reshape(-1, CHUNK), sums, ends, at, places)
        return np.minimum(places, self.size - 1, out=places)


def find_places(priority: F32, sums: F32, ends: F64, at: F64, out: Ints) -> None:
    """Find places as the compiled function of that name does, in NumPy."""
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
    """Return (n P) ** -beta over its mean under P, of rows of priority `drawn` (n,).

    Of many rows the mean is that of some, evenly spaced: a power of each would cost as much as all
    else together.
    """
    some = np.ascontiguousarray(priority[:: max(len(priority) // MEAN_OF, 1)])
    mean = 1.0 if beta == 1.0 else float((some ** np.float32(1.0 - beta)).mean(dtype=np.float64))
    scale = total / (len(priority) * mean)
    return np.asarray(scale * drawn ** np.float32(-beta), np.float32)


@dataclass(frozen=True)
class Rule:
    """A rule of the table: what draws by it, and what others need to know of it."""

    draws: Callable[[StratumRows], StratumDraws]
    doc: str  # how rows are drawn, for reports
    follows_td: bool = False  # draws depend on the TD errors of what was learnt
    has_weights: bool = False  # rows come with importance weights


RULES: dict[str, Rule] = {
    "uniform": Rule(Uniform, "uniformly, with replacement"),
    "without_replacement": Rule(InTurns, "without replacement"),
    "per": Rule(Per, "by TD error (PER)", follows_td=True, has_weights=True),
}


def follow_td(names: Iterable[str]) -> bool:
    """Return whether draws by any of these rules follow TD errors."""
    return any(RULES[name].follows_td for name in names)
