"""Columns of messages: arrays and ragged arrays by field, and how they grow batch by batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Ints

# The number of messages to come is the file's claim: no more than this is allocated for them.
# Memory that is allocated and not yet written to costs nothing.
AHEAD_BYTES = 32 << 20


@dataclass(frozen=True)
class Ragged:
    """Rows of different lengths: row i is `values[offsets[i]:offsets[i + 1]]`.

    `values` is an array (total, …), or Ragged again where a sequence holds sequences
    (`status[].values[].key`). `offsets` is (N + 1,) int64 and starts at 0.
    """

    values: NDArray[Any] | Ragged
    offsets: Ints  # (N + 1,)

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def __getitem__(self, row: int) -> NDArray[Any] | Ragged:
        """Return one row's values (an array), or one row's rows (Ragged)."""
        index = range(len(self))[row]
        return cut(self.values, int(self.offsets[index]), int(self.offsets[index + 1]))

    @property
    def lengths(self) -> Ints:
        """Return how many values each row holds, (N,)."""
        return np.diff(self.offsets)

    def take(self, rows: NDArray[np.intp]) -> Ragged:
        """Select rows, in this order."""
        lengths = self.lengths[rows]
        offsets = offsets_of(lengths)
        # Element j of the output comes from where its row starts, plus its place in the row.
        source = np.repeat(self.offsets[:-1][rows] - offsets[:-1], lengths) + np.arange(offsets[-1])
        return Ragged(take(self.values, source), offsets)


FieldColumn: TypeAlias = "NDArray[Any] | Ragged"  # leading axis: the message


def offsets_of(lengths: NDArray[Any]) -> Ints:
    """Lengths (N,) to offsets (N + 1,)."""
    offsets = np.zeros(len(lengths) + 1, np.int64)
    np.cumsum(lengths, out=offsets[1:])
    return offsets


def cut(column: FieldColumn, start: int, stop: int) -> FieldColumn:
    """Return rows `start` to `stop` of a column."""
    if isinstance(column, Ragged):
        low, high = int(column.offsets[start]), int(column.offsets[stop])
        return Ragged(cut(column.values, low, high), column.offsets[start : stop + 1] - low)
    return column[start:stop]


def take(column: FieldColumn, rows: NDArray[Any]) -> FieldColumn:
    """Select rows of a column, in this order."""
    return column.take(rows) if isinstance(column, Ragged) else column[rows]


def join(columns: Sequence[FieldColumn]) -> FieldColumn:
    """Columns of the same field, one after the other."""
    if len(columns) == 1:
        return columns[0]
    ragged = [column for column in columns if isinstance(column, Ragged)]
    if not ragged:
        return np.concatenate([column for column in columns if not isinstance(column, Ragged)])
    return Ragged(
        join([column.values for column in ragged]),
        offsets_of(np.concatenate([column.lengths for column in ragged])),
    )


def equal(left: FieldColumn, right: FieldColumn) -> bool:
    """Return whether two columns have the same values (NaN equals NaN), shapes and types."""
    if isinstance(left, Ragged) or isinstance(right, Ragged):
        return (
            isinstance(left, Ragged)
            and isinstance(right, Ragged)
            and np.array_equal(left.offsets, right.offsets)
            and equal(left.values, right.values)
        )
    if left.dtype != right.dtype or left.shape != right.shape:
        return False
    return np.array_equal(left, right, equal_nan=left.dtype.kind == "f")


def gather(buffer: NDArray[np.uint8], at: Ints, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Gather one value of `dtype` (also a structure or array) at each byte position, (N, …).

    Positions must fit. All bytes of a value are moved at once, whatever its fields.
    """
    size = dtype.itemsize
    if not len(at) or not size:
        return np.zeros(len(at), dtype)
    raw = np.dtype((np.void, size))
    everywhere: NDArray[Any] = np.ndarray((len(buffer) - size + 1,), raw, buffer, strides=(1,))
    values = everywhere[at]  # numpy moves opaque values as they are: faster than structures
    if dtype.subdtype:
        base, shape = dtype.subdtype
        return values.view(base).reshape(len(at), *shape)
    return np.ndarray((len(at),), dtype, values)  # `view` first checks every field, slowly


@dataclass(frozen=True)
class TopicColumns:
    """The decoded messages of one topic, in the order of their log time."""

    log_time_ns: Ints  # (N,) when the recorder received it
    publish_time_ns: Ints  # (N,) when the sender sent it; the log time where that is not kept
    fields: dict[str, FieldColumn] = field(default_factory=dict)  # by field path
    lap: Ints | None = None  # (N,) how often log time had gone far back before each; None: never

    def __len__(self) -> int:
        return len(self.log_time_ns)

    def laps(self) -> int:
        """Count how often log time goes far back in the file."""
        return 0 if self.lap is None else int(self.lap.max(initial=0))

    def gaps_s(self) -> F64:
        """Return the seconds from each message to the next; none where log time goes far back."""
        if self.lap is None:
            return np.asarray(np.diff(self.log_time_ns) * 1e-9, np.float64)
        laps = [self.log_time_ns[self.lap == lap] for lap in range(self.laps() + 1)]
        return np.concatenate([np.diff(lap) for lap in laps]) * 1e-9

    def times(self, start: int, stop: int) -> TopicColumns:
        """When messages `start` to `stop` came, without their fields, copied."""
        return TopicColumns(
            self.log_time_ns[start:stop].copy(), self.publish_time_ns[start:stop].copy()
        )


class GrowingArray:
    """An array (N, …) that grows at its end, with room set aside for what is expected."""

    def __init__(self, empty: NDArray[Any]) -> None:
        self._room, self._size = empty[:0], 0

    def __len__(self) -> int:
        return self._size

    def add(self, part: FieldColumn, expected: int) -> None:
        """Copy a part in; `expected` is how many rows there will be in the end, as far as known."""
        assert not isinstance(part, Ragged)
        size = self._size + len(part)
        if size > len(self._room):
            row_bytes = max(part.nbytes // max(len(part), 1), 1)
            ahead = min(expected, size + max(AHEAD_BYTES // row_bytes, self._size))
            room = np.empty((max(size, ahead), *self._room.shape[1:]), self._room.dtype)
            room[: self._size] = self._room[: self._size]
            self._room = room
        self._room[self._size : size] = part
        self._size = size

    def column(self) -> NDArray[Any]:
        """Return the whole column, (N, …)."""
        return self._room[: self._size]


class GrowingRagged:
    """A ragged column as it grows."""

    def __init__(self, empty: Ragged) -> None:
        self._values = growing(empty.values)
        self._offsets = GrowingArray(np.zeros(0, np.int64))
        self._offsets.add(np.zeros(1, np.int64), 1)

    def __len__(self) -> int:
        return len(self._offsets) - 1

    def add(self, part: FieldColumn, expected: int) -> None:
        """Copy a part in, as `GrowingArray.add` does."""
        assert isinstance(part, Ragged)
        before, rows = len(self._values), len(self) + len(part)
        inside = int(part.offsets[-1]) + before
        # As many values in the rows to come as in those so far, and a few more.
        share = -(-inside * max(expected, rows) * 33 // (32 * max(rows, 1)))
        self._values.add(part.values, share)
        self._offsets.add(part.offsets[1:] + before, expected + 1)

    def column(self) -> Ragged:
        """Return the whole column."""
        return Ragged(self._values.column(), self._offsets.column())


def growing(empty: FieldColumn) -> GrowingArray | GrowingRagged:
    """Make a growing column of the same kind as this empty one."""
    return GrowingRagged(empty) if isinstance(empty, Ragged) else GrowingArray(empty)
