"""Batches of ROS messages to columns: CDR in both byte orders, and ROS 1's serialisation.

The first four bytes of a payload (the encapsulation header) define how the rest is laid out;
alignment is relative to the byte after them. Of these layouts, ROS 2 writes plain CDR
("00 01", little-endian); XCDR2 and parameter lists are refused by name.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from restock.ingest.decoding.cdr_compile import compile_plan
from restock.ingest.decoding.cdr_frame import TOO_LONG, BadRows, Columns, Frame, Order
from restock.ingest.decoding.columns import FieldColumn, join, take
from restock.ingest.decoding.definitions import RosType
from restock.ingest.decoding.field_paths import Leaf
from restock.ingest.decoding.messages import MessageBatch
from restock.ingest.decoding.row_by_row import Decoded, RowDecoder

HEADER = 4  # bytes of the encapsulation header
PADDING = 3  # a payload is padded to a multiple of four
RESTARTS = 16  # with fewer rows each time, before the rest is decoded one by one

_ENCAPSULATIONS = {
    0x0002: "a parameter list (PL_CDR)",
    0x0003: "a parameter list (PL_CDR)",
    0x0006: "XCDR2",
    0x0007: "XCDR2",
    0x0008: "XCDR2 (delimited)",
    0x0009: "XCDR2 (delimited)",
    0x000A: "XCDR2 (parameter list)",
    0x000B: "XCDR2 (parameter list)",
}


class ColumnDecoder:
    """Decodes the wanted fields of one message type, whole batches at a time."""

    def __init__(self, message: RosType, leaves: Sequence[Leaf], *, ros1: bool = False) -> None:
        self._message, self._leaves, self._ros1 = message, tuple(leaves), ros1
        # `name[]` is asked for and `name` compiled: brackets at the end add nothing.
        self._paths = {leaf.path: leaf.path.removesuffix("[]") for leaf in leaves}
        self._plan = compile_plan(message, self._paths.values(), ros1=ros1)

    def empty(self) -> Columns:
        """Columns without a row."""
        return self._named(self._plan.empty())

    def decode(self, batch: MessageBatch) -> Decoded:
        """The batch's columns; a message that does not decode is counted, by reason."""
        if self._ros1:
            every = np.arange(len(batch))
            return self._join([self._decode_rows(batch, every, "<", 0)], Counter())
        small = np.nonzero(batch.stop - batch.start < HEADER)[0]
        bad = Counter({"mis-sized: shorter than its header": len(small)} if len(small) else {})
        rows = np.nonzero(batch.stop - batch.start >= HEADER)[0]
        start = batch.start[rows]
        kind = batch.buffer[start].astype(np.int64) << 8 | batch.buffer[start + 1]
        parts = []
        for value in np.unique(kind).tolist():
            chosen = rows[kind == value]
            if value in (0, 1):
                parts.append(self._decode_rows(batch, chosen, "<" if value else ">", HEADER))
            else:
                name = _ENCAPSULATIONS.get(value, "an unknown encapsulation")
                reason = f"serialised as {name}, {value >> 8:02x} {value & 255:02x}: not supported"
                bad[reason] = len(chosen)
        return self._join(parts, bad)

    def _decode_rows(
        self, batch: MessageBatch, rows: NDArray[np.intp], order: Order, header: int
    ) -> Decoded:
        bad = Counter[str]()
        for _ in range(RESTARTS):
            if not len(rows):
                return Decoded(rows, self.empty(), bad)
            origin = batch.start[rows] + header
            frame = Frame(batch.buffer, order, origin, batch.stop[rows] - origin, rows, 0)
            try:
                columns = self._plan.decode(frame)
                left = frame.end - frame.position
                if (left > (0 if self._ros1 else PADDING)).any():
                    raise BadRows(rows[left > (0 if self._ros1 else PADDING)], TOO_LONG)
            except BadRows as refused:
                refused_rows = np.unique(refused.rows)
                bad[refused.reason] += len(refused_rows)
                rows = np.setdiff1d(rows, refused_rows)
                continue
            return Decoded(rows, self._named(columns), bad)
        return self._one_by_one(batch, rows, bad)

    def _one_by_one(
        self, batch: MessageBatch, rows: NDArray[np.intp], bad: Counter[str]
    ) -> Decoded:
        """What is wrong differs from row to row: let every row fail for itself."""
        part = batch.select(rows)
        slow = RowDecoder(self._message, self._leaves, ros1=self._ros1).decode(part)
        return Decoded(rows[slow.rows], slow.fields, bad + Counter(slow.bad))

    def _join(self, parts: list[Decoded], bad: Counter[str]) -> Decoded:
        for part in parts:
            bad.update(part.bad)
        if not parts:
            return Decoded(np.zeros(0, np.intp), self.empty(), bad)
        if len(parts) == 1:
            return Decoded(parts[0].rows, parts[0].fields, bad)
        rows = np.concatenate([part.rows for part in parts])
        back = np.argsort(rows, kind="stable")
        fields = {
            path: take(join([part.fields[path] for part in parts]), back) for path in self._paths
        }
        return Decoded(rows[back], fields, bad)

    def _named(self, columns: Columns) -> dict[str, FieldColumn]:
        return {path: columns[compiled] for path, compiled in self._paths.items()}
