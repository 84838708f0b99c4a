"""`shared_rows` from what manifests keep of their rows' contents, one number a row.

DuckDB would count each content in a table of all of them, and hold lists many times over on the
way. Here the manifests are read twice, some at a time: first each content leaves a mark, and then
those whose mark was there already are kept, and sorted (`MetTwice`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

import duckdb
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.arrays import Bools, Ints

SHARED = ("shared_rows", "repeated_rows", "same_steps")  # the view, and what is made of it
CONTENT, ROWS = "distinctive_rows.content", "distinctive_rows"  # of the manifests
MARKED = 1 << 14  # numbers at a time
_ODD = np.uint64(0x9E3779B97F4A7C15)
_MIN_BITS, _MAX_BITS = 10, 34


def install_shared_rows(
    connection: duckdb.DuckDBPyConnection,
    manifests: Callable[[Sequence[str]], Iterable[pa.Table]],
    recordings: Mapping[str, str],
    rows: int,
) -> None:
    """Put a table in place of the connection's view `shared_rows`.

    `manifests` reads these columns of them, from the beginning each time; `recordings` names the
    recording of each ingest whose rows count, and `rows` how many these have.
    """
    observed = MetTwice(rows)
    for _, lists in _of_ingests(manifests(("ingest_id", CONTENT)), recordings):
        observed.add(lists.flatten().field("content").to_numpy())
    names: list[str] = []
    parts: dict[str, list[pa.Array]] = {"recording": [], "transition_id": [], "content": []}
    for of_ingests, lists in _of_ingests(manifests(("ingest_id", ROWS)), recordings):
        each = lists.flatten()  # structs
        at = np.flatnonzero(observed.maybe(each.field("content").to_numpy()))
        ends = np.cumsum(lists.value_lengths().fill_null(0).to_numpy())
        parts["recording"].append(np.searchsorted(ends, at, "right") + len(names))
        for name in ("transition_id", "content"):
            parts[name].append(each.field(name).to_numpy()[at])
        names += of_ingests
    del observed
    found = {
        name: np.concatenate([np.empty(0, np.int64), *several]) for name, several in parts.items()
    }
    kept = occurs_again(found["content"])
    recording = pa.array(names, pa.string()).take(pa.array(found.pop("recording")[kept]))
    shared = {"recording_id": recording} | {name: values[kept] for name, values in found.items()}
    # A table of its own: joins must know that it is the small side.
    connection.register("found_shared_rows", pa.table(shared))
    connection.execute(
        "CREATE TABLE stored_shared_rows AS FROM found_shared_rows;"
        " CREATE OR REPLACE VIEW shared_rows AS FROM stored_shared_rows"
    )
    connection.unregister("found_shared_rows")


class MetTwice:
    """Set of the numbers, out of up to `count`, that occur more than once, as a hash filter.

    First `add` all numbers, then ask for each again. It takes at least four bytes a number, mostly
    more, and does not store the numbers. Up to a quarter of the numbers that occur once are
    reported, too; none that occurs again is missed.
    """

    def __init__(self, count: int) -> None:
        bits = min(max(int(4 * count).bit_length(), _MIN_BITS), _MAX_BITS)
        self._shift = np.uint64(64 - bits)
        self._marks = np.zeros(1 << bits, np.uint8)  # bit 0: met, bit 1: met again
        self._last = np.zeros(MARKED << 4, np.int32)  # by a place's low bits, who was last there

    def add(self, values: NDArray[np.integer]) -> None:
        """Mark these 64-bit numbers, (n,)."""
        for part in _stretches(values):
            place = self._places(part)
            number = np.arange(len(part), dtype=np.int32)
            low = place & (len(self._last) - 1)
            self._last[low] = number
            # Of two of a stretch at one place, one at least is not the last there.
            again = self._marks[place].astype(np.bool_) | (self._last[low] != number)
            self._marks[place] |= 1
            self._marks[place[again]] = 3

    def maybe(self, values: NDArray[np.integer]) -> Bools:
        """Return whether each of these numbers, (n,), may occur more than once."""
        result = [self._marks[self._places(part)] == 3 for part in _stretches(values)]
        return np.concatenate([np.empty(0, np.bool_), *result])

    def _places(self, values: NDArray[np.integer]) -> Ints:
        mixed = values.view(np.uint64) * _ODD
        return np.asarray((mixed >> self._shift).view(np.int64))


def occurs_again(values: Ints) -> Bools:
    """Return which of these values (N,) occur more than once, (N,)."""
    in_order = np.sort(values)
    several = np.unique(in_order[1:][in_order[1:] == in_order[:-1]])
    if not len(several):
        return np.zeros(len(values), np.bool_)
    place = np.minimum(np.searchsorted(several, values), len(several) - 1)
    return np.asarray(several[place] == values, np.bool_)


def _of_ingests(
    manifests: Iterable[pa.Table], recordings: Mapping[str, str]
) -> Iterator[tuple[list[str], pa.Array]]:
    """Yield the recordings of the current ingests with the lists of their distinctive rows."""
    for table in manifests:
        for part in table.combine_chunks().to_batches():
            named = [recordings.get(ingest) for ingest in part.column("ingest_id").to_pylist()]
            kept = [place for place, name in enumerate(named) if name is not None]
            lists = part.column("distinctive_rows").take(pa.array(kept, pa.int64()))
            yield [name for name in named if name is not None], lists


def _stretches(values: NDArray[np.integer]) -> Iterator[NDArray[np.integer]]:
    for begin in range(0, len(values), MARKED):
        yield values[begin : begin + MARKED]
