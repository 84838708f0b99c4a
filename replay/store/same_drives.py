"""Find recordings that have the same rows, or are of the same drive.

Rows are compared by hashes of their contents, which manifests store. Drives are compared by the
commands and wheel speeds of each step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import duckdb
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.arrays import Bools, Ints

SHARED = ("shared_rows", "repeated_rows", "same_steps")  # the view, and macros that use it
CONTENT, ROWS = "distinctive_rows.content", "distinctive_rows"  # columns of the manifests
MARKED = 1 << 14  # numbers processed at a time
_ODD = np.uint64(0x9E3779B97F4A7C15)
_MIN_BITS, _MAX_BITS = 10, 34


def install_shared_rows(
    connection: duckdb.DuckDBPyConnection,
    manifests: Callable[[Sequence[str]], Iterable[pa.Table]],
    recordings: Mapping[str, str],
    rows: int,
) -> None:
    """Replace the connection's view `shared_rows` by a table computed from manifests.

    `manifests(columns)` reads columns of all manifests, and is called twice. `recordings` maps
    ingests to recordings, and others are ignored; `rows` counts the rows of the ingests in it.
    """
    repeats = RepeatFilter(rows)
    for _, _, rows_of in _distinctive_rows(manifests(("ingest_id", CONTENT)), recordings):
        repeats.add(rows_of.field("content").to_numpy())
    names: list[str] = []
    parts: dict[str, list[Ints]] = {"recording": [], "transition_id": [], "content": []}
    for ids, recording, rows_of in _distinctive_rows(manifests(("ingest_id", ROWS)), recordings):
        at = np.flatnonzero(repeats.may_repeat(rows_of.field("content").to_numpy()))
        parts["recording"].append(recording[at] + len(names))
        for name in ("transition_id", "content"):
            parts[name].append(rows_of.field(name).to_numpy()[at])
        names += ids
    del repeats
    found = {
        name: np.concatenate([np.empty(0, np.int64), *several]) for name, several in parts.items()
    }
    kept = occurs_again(found["content"])
    ids_of_rows = _take_names(names, found.pop("recording")[kept])
    shared = {"recording_id": ids_of_rows} | {name: values[kept] for name, values in found.items()}
    # Copy to a DuckDB table, so that DuckDB knows that it is the small side of joins.
    connection.register("found_shared_rows", pa.table(shared))
    connection.execute(
        "CREATE TABLE stored_shared_rows AS FROM found_shared_rows;"
        " CREATE OR REPLACE VIEW shared_rows AS FROM stored_shared_rows"
    )
    connection.unregister("found_shared_rows")


class RepeatFilter:
    """Hash filter that finds which of up to `count` numbers occur more than once.

    First `add` all numbers, then call `may_repeat` with each. The filter takes four to eight bytes
    per number, and does not store the numbers. It reports all numbers that occur more than once,
    and up to a quarter of those that occur once.
    """

    def __init__(self, count: int) -> None:
        bits = min(max(int(4 * count).bit_length(), _MIN_BITS), _MAX_BITS)
        self._shift = np.uint64(64 - bits)
        self._marks = np.zeros(1 << bits, np.uint8)  # per hash value: bit 0 seen, bit 1 seen again
        self._last = np.zeros(MARKED << 4, np.int32)  # low bits of a hash -> last index with them

    def add(self, values: NDArray[np.integer]) -> None:
        """Mark these 64-bit numbers, (n,)."""
        for part in _split(values):
            place = self._places(part)
            number = np.arange(len(part), dtype=np.int32)
            low = place & (len(self._last) - 1)
            self._last[low] = number
            # Of two numbers in a part with the same hash value, at most one is the last in `_last`.
            again = self._marks[place].astype(np.bool_) | (self._last[low] != number)
            self._marks[place] |= 1
            self._marks[place[again]] = 3

    def may_repeat(self, values: NDArray[np.integer]) -> Bools:
        """Return whether each of these numbers, (n,), may occur more than once."""
        result = [self._marks[self._places(part)] == 3 for part in _split(values)]
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


def _distinctive_rows(
    manifests: Iterable[pa.Table], recordings: Mapping[str, str]
) -> Iterator[tuple[list[str], Ints, pa.StructArray]]:
    """Yield, per batch, recording ids, each row's index into them (n,), and distinctive rows (n,).

    Rows of ingests that are not in `recordings` are left out.
    """
    for table in manifests:
        for part in table.combine_chunks().to_batches():
            ingests = part.column("ingest_id").to_pylist()
            names = [recordings.get(ingest, "") for ingest in ingests]
            lists = part.column("distinctive_rows")
            ends = np.asarray(lists.offsets)
            ingest = np.repeat(np.arange(len(names)), np.diff(ends))
            each = lists.values.slice(ends[0], ends[-1] - ends[0])
            if "" in names:
                current = np.array(names, np.str_)[ingest] != ""
                ingest, each = ingest[current], each.filter(pa.array(current))
            yield names, ingest, each


def _take_names(names: Sequence[str], which: Ints) -> pa.DictionaryArray:
    """Return names by index, without `take`, as pyarrow.compute is slow to import."""
    return pa.DictionaryArray.from_arrays(pa.array(which, pa.int32()), pa.array(names, pa.string()))


def _split(values: NDArray[np.integer]) -> Iterator[NDArray[np.integer]]:
    for begin in range(0, len(values), MARKED):
        yield values[begin : begin + MARKED]


N = TypeVar("N", bound=np.generic)
MIN_ROWS = 2
MIN_SHARE = 0.1  # least share of the smaller recording's distinctive rows that both have
WITHIN_NS = 100_000_000  # most that the time shift of a match deviates from the pair's median
FEW = 5  # if at most so many recordings share a content, all their pairs are compared
_BATCH_ROWS = 100_000
_NAMED = "SELECT DISTINCT recording_id, hash(recording_id) FROM transitions"
_MOVING = """
    SELECT
        hash(recording_id) AS recording,
        stamp_ns,
        hash(
            round(command_speed_mps, 3),
            round(command_yaw_rate_radps, 3),
            round(wheel_speed_mps, 4),
            round(wheel_yaw_rate_radps, 4)
        ) AS content
    FROM transitions
    WHERE wheel_speed_mps <> 0 OR wheel_yaw_rate_radps <> 0
"""


@dataclass(frozen=True)
class MovingRows:
    """Rows in which the robot moves, in any order."""

    names: list[str]  # ids of recordings, (R,) ascending
    recording: NDArray[np.int32]  # (N,) index into `names`
    content: NDArray[np.uint64]  # (N,) hash of command and wheel speeds
    stamp_ns: Ints  # (N,)


def install_same_drives(connection: duckdb.DuckDBPyConnection) -> None:
    """Create the table `same_drives` over the connection's `transitions`."""
    connection.register("same_drives", same_drives(_moving_rows(connection)))


def same_drives(rows: MovingRows) -> pa.Table:
    """Find pairs of recordings that share MIN_ROWS distinctive rows, and a share of MIN_SHARE.

    Columns: `recording_id`; `same_as`, the id that sorts later; `later_s`, the median time from a
    row to the same row of `same_as`; `rows`, the number whose time is within WITHIN_NS of it; and
    `share`, `rows` as a share of the smaller recording's distinctive rows. If a content is in more
    than FEW recordings, only pairs with the first are compared: all pairs would be too many.
    """
    recording, content, stamp, distinctive = _distinctive(rows)
    first, second = (np.concatenate(parts) for parts in zip(*_pairs(content), strict=True))
    count = max(len(rows.names), 1)
    pair = recording[first].astype(np.int64) * count + recording[second]
    later = stamp[second] - stamp[first]
    # Many pairs share a few rows by chance: drop these pairs before sorting.
    keys, each = np.unique(pair, return_counts=True)
    least = np.maximum(MIN_SHARE * _smaller(keys, count, distinctive), MIN_ROWS)
    kept = np.isin(pair, keys[each >= least])
    pair, later = pair[kept], later[kept]
    order = np.lexsort((later, pair))
    pair, later = pair[order], later[order]
    keys, begin, each = np.unique(pair, return_index=True, return_counts=True)
    shift = later[begin + (each - 1) // 2]
    near = np.abs(later - np.repeat(shift, each)) <= WITHIN_NS
    same = np.add.reduceat(near, begin, dtype=np.int64) if len(begin) else each
    share = same / np.maximum(_smaller(keys, count, distinctive), 1)
    reported = (same >= MIN_ROWS) & (share >= MIN_SHARE)
    return pa.table(
        {
            "recording_id": _take_names(rows.names, keys[reported] // count),
            "same_as": _take_names(rows.names, keys[reported] % count),
            "rows": same[reported],
            "share": share[reported],
            "later_s": shift[reported] / 1e9,
        }
    )


def _moving_rows(connection: duckdb.DuckDBPyConnection) -> MovingRows:
    named = sorted(connection.sql(_NAMED).fetchall())
    hashes = np.array([number for _, number in named], np.uint64)
    order = np.argsort(hashes).astype(np.int32)
    recording, content, stamp = [], [], []
    for batch in connection.sql(_MOVING).to_arrow_reader(_BATCH_ROWS):
        numbers = batch.column("recording").to_numpy()
        recording.append(order[np.searchsorted(hashes, numbers, sorter=order)])
        # Copies: a column of DuckDB's batch would keep the whole batch in memory.
        content.append(batch.column("content").to_numpy().copy())
        stamp.append(batch.column("stamp_ns").to_numpy().copy())
    return MovingRows(
        [name for name, _ in named],
        _join(recording, np.int32),
        _join(content, np.uint64),
        _join(stamp, np.int64),
    )


def _join(parts: list[NDArray[N]], kind: type[N]) -> NDArray[N]:
    """Concatenate the parts and free them."""
    whole = np.concatenate([np.empty(0, kind), *parts])
    parts.clear()
    return whole


def _distinctive(
    rows: MovingRows,
) -> tuple[NDArray[np.int32], NDArray[np.uint64], Ints, Ints]:
    """Find rows whose content occurs once in their recording, and possibly in other recordings.

    Return their recording, content and stamp (M,), sorted by content and recording. Also return
    the number of rows per recording (R,) whose content occurs only once in it.
    """
    repeats = RepeatFilter(len(rows.content))
    repeats.add(rows.content)
    again = repeats.may_repeat(rows.content)
    del repeats
    alone = np.bincount(rows.recording[~again], minlength=len(rows.names))
    rows = MovingRows(rows.names, rows.recording[again], rows.content[again], rows.stamp_ns[again])
    order = np.argsort(rows.content, kind="stable")
    content, recording = rows.content[order], rows.recording[order]
    alike = content[1:] == content[:-1]
    if (alike & (recording[1:] < recording[:-1])).any():  # a recording in several files
        order = np.lexsort((rows.recording, rows.content))
        content, recording = rows.content[order], rows.recording[order]
    begins = np.concatenate([[True], ~alike | (recording[1:] != recording[:-1]), [True]])
    single = begins[1:] & begins[:-1] if len(order) else np.empty(0, np.bool_)
    recording, content, stamp = recording[single], content[single], rows.stamp_ns[order[single]]
    return recording, content, stamp, alone + np.bincount(recording, minlength=len(alone))


def _pairs(content: NDArray[np.uint64]) -> Iterator[tuple[Ints, Ints]]:
    """Yield pairs of indices of rows with equal content; `content` (M,) is ascending."""
    begins = np.flatnonzero(np.concatenate([[True], content[1:] != content[:-1]]))
    begins = begins if len(content) else np.empty(0, np.int64)
    size = np.diff(begins, append=len(content))
    begins, size = begins[size > 1], size[size > 1]
    yield np.repeat(begins, size - 1), _ranges(begins + 1, size - 1)
    begins, size = begins[size <= FEW], size[size <= FEW]
    for one in range(1, FEW - 1):
        for other in range(one + 1, FEW):
            inside = begins[size > other]
            yield inside + one, inside + other


def _ranges(begin: Ints, length: Ints) -> Ints:
    """Concatenate the ranges begin, begin + 1, … of these lengths."""
    ends = np.cumsum(length)
    places: Ints = np.repeat(begin - (ends - length), length)
    places += np.arange(len(places))
    return places


def _smaller(keys: Ints, count: int, distinctive: Ints) -> Ints:
    least: Ints = np.minimum(distinctive[keys // count], distinctive[keys % count])
    return least
