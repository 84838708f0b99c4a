"""Columns that grow batch by batch. Rows are copied in, so nothing of a batch is kept alive."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.ingest.decoding.columns import I64, FieldColumn, Ragged

# How many messages come is the file's word: no more than this is set aside for those to come.
# Memory that is set aside and not yet written to costs nothing.
AHEAD_BYTES = 32 << 20


class GrowingArray:
    """An array (N, …) that grows at its end, with room set aside for what is expected."""

    def __init__(self, empty: NDArray[Any]) -> None:
        self._room, self._size = empty[:0], 0

    def __len__(self) -> int:
        return self._size

    def add(self, part: NDArray[Any], expected: int) -> None:
        """Copy a part in; `expected` is how many rows there will be in the end, as far as known."""
        size = self._size + len(part)
        if size > len(self._room):
            row_bytes = max(part.nbytes // max(len(part), 1), 1)
            ahead = min(expected, size + max(AHEAD_BYTES // row_bytes, self._size))
            room = np.empty((max(size, ahead), *self._room.shape[1:]), self._room.dtype)
            room[: self._size] = self._room[: self._size]
            self._room = room
        self._room[self._size : size] = part
        self._size = size

    def array(self) -> NDArray[Any]:
        """All of it, (N, …)."""
        return self._room[: self._size]


class GrowingColumn:
    """A field of a topic's messages as it grows; the like of the empty column it starts from."""

    def __init__(self, empty: FieldColumn) -> None:
        self._values: GrowingArray | GrowingColumn
        self._offsets: GrowingArray | None = None
        if isinstance(empty, Ragged):
            self._values = GrowingColumn(empty.values)
            self._offsets = GrowingArray(np.zeros(0, np.int64))
            self._offsets.add(np.zeros(1, np.int64), 1)
        else:
            self._values = GrowingArray(empty)

    def __len__(self) -> int:
        return len(self._values) if self._offsets is None else len(self._offsets) - 1

    def add(self, part: FieldColumn, expected: int) -> None:
        """Copy a part in; `expected` is how many rows there will be in the end, as far as known."""
        if isinstance(self._values, GrowingColumn) or isinstance(part, Ragged):
            self._add_ragged(part, expected)
        else:
            self._values.add(part, expected)

    def _add_ragged(self, part: FieldColumn, expected: int) -> None:
        assert isinstance(part, Ragged)
        assert self._offsets is not None
        before, rows = len(self._values), len(self) + len(part)
        inside = part.offsets[-1] + before
        # As many values in the rows to come as in those there are, and a few more.
        share = -(-int(inside) * max(expected, rows) * 33 // (32 * max(rows, 1)))
        values: Any = part.values
        self._values.add(values, share)
        self._offsets.add(part.offsets[1:] + before, expected + 1)

    def column(self) -> FieldColumn:
        """All of it, (N, …) or Ragged."""
        if self._offsets is None:
            assert isinstance(self._values, GrowingArray)
            return self._values.array()
        inner = self._values
        values = inner.array() if isinstance(inner, GrowingArray) else inner.column()
        offsets: I64 = self._offsets.array()
        return Ragged(values, offsets)


__all__ = ["GrowingArray", "GrowingColumn"]
