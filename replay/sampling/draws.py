"""How the rows of one stratum are drawn: what a rule implements, and the two plain rules.

Rules work with places, 0 to n - 1 within their stratum; the sampler knows which row of the panel
each is. `restock.replay.sampling.rules` has the table of all rules.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F32, F64, Ints
from restock.state import Stateful

if TYPE_CHECKING:
    from restock.replay.sampling.per import Prioritised


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


__all__ = ["InTurns", "StratumDraws", "StratumRows", "Uniform", "uniform_places"]
