"""Column operations of a message type: runs of fixed size, texts and sequences.

Every operation reads its field in all messages of a frame at once and moves their cursors past
it. Only wanted fields are materialised; the others are stepped over, so that the cursor's end
still shows whether the definition fits.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from restock.arrays import Ints
from restock.ingest.decoding.cdr_fixed_fields import FixedFields
from restock.ingest.decoding.cdr_frame import (
    UNTERMINATED,
    BadRows,
    Columns,
    Frame,
    gather_sequences,
    spread,
    texts,
    uniform,
)
from restock.ingest.decoding.columns import FieldColumn, Ragged, join, offsets_of, take
from restock.ingest.decoding.field_paths import DTYPES


class Operation(Protocol):
    """Reads one or more fields of all messages of a frame into `out`."""

    def decode(self, frame: Frame, out: Columns) -> None: ...


@dataclass
class CdrPlan:
    """The operations of one message type, in the order of its serialisation."""

    operations: list[Operation]
    paths: dict[str, tuple[str, tuple[int | None, ...]]]  # wanted -> kind, repetitions inside

    def decode(self, frame: Frame) -> Columns:
        """The wanted fields of all messages of the frame; its cursor is then past the last field.

        Raises:
            BadRows: messages that end too early, or hold invalid text.
        """
        out: Columns = {}
        for operation in self.operations:
            operation.decode(frame, out)
        return out

    def empty(self) -> Columns:
        """The columns of no message."""
        return {path: empty_column(kind, dims) for path, (kind, dims) in self.paths.items()}


def empty_column(kind: str, dims: tuple[int | None, ...]) -> FieldColumn:
    """A column without rows, of the shape that rows would have."""
    dtype = {"string": np.dtype(object), "time": np.dtype(np.int64)}.get(kind) or DTYPES[kind]
    column: FieldColumn = np.zeros(0, dtype)
    for length in reversed(dims):
        column = wrap(column, length, 0, offsets_of(np.zeros(0, np.int64)))
    return column


def wrap(column: FieldColumn, length: int | None, rows: int, offsets: Ints) -> FieldColumn:
    """Elements to rows: a fixed repetition of an array is a further axis, others are Ragged."""
    if length is not None and not isinstance(column, Ragged):
        return column.reshape(rows, length, *column.shape[1:])
    return Ragged(column, offsets)


@dataclass
class Text:
    """A string: its length (CDR counts a terminating zero, ROS 1 has none), then its bytes."""

    path: str | None
    ros1: bool

    def decode(self, frame: Frame, out: Columns) -> None:
        """Step over the strings, or decode them."""
        length = frame.read_uint32(1 if self.ros1 else 4)
        stop = frame.position + length
        frame.check_bounds(stop)
        start = frame.origin + frame.position
        if not self.ros1:
            # Some writers give an empty text no bytes at all, not even its zero.
            ends = frame.origin + stop - 1
            bad = (frame.buffer[np.maximum(ends, 0)] != 0) & (spread(length, len(frame)) > 0)
            if bad.any():
                raise BadRows(frame.rows[bad], UNTERMINATED)
            length = max(length - 1, 0) if isinstance(length, int) else np.maximum(length - 1, 0)
        if self.path is not None:
            out[self.path] = texts(frame, start, length)
        frame.position = stop


@dataclass
class Primitives:
    """A sequence of primitives."""

    dtype: np.dtype[Any]
    path: str | None
    ros1: bool

    def decode(self, frame: Frame, out: Columns) -> None:
        """Step over the sequences, or gather them."""
        count = frame.read_uint32(1 if self.ros1 else 4)
        size = self.dtype.itemsize
        if size > 4 and not self.ros1:
            # An empty sequence takes no padding.
            aligned = (frame.position + (size - 1)) & -size
            if isinstance(count, int):
                frame.position = aligned if count else frame.position
            else:
                frame.position = np.where(count > 0, aligned, frame.position)
        stop = frame.position + count * size
        frame.check_bounds(stop)
        if self.path is not None:
            boolean = self.dtype == np.bool_
            dtype = np.dtype(np.uint8) if boolean else self.dtype.newbyteorder(frame.order)
            at = frame.origin + frame.position
            sequences = gather_sequences(frame.buffer, at, count, dtype)
            if boolean and not isinstance(sequences.values, Ragged):
                sequences = Ragged(sequences.values != 0, sequences.offsets)
            out[self.path] = sequences
        frame.position = stop


@dataclass
class Repeat:
    """A sequence or fixed array of messages, or of texts: the inner plan, once per element."""

    inner: CdrPlan
    length: int | None  # of a fixed array
    ros1: bool

    @cached_property
    def _only_fixed(self) -> FixedFields | None:
        operations = self.inner.operations
        only = operations[0] if len(operations) == 1 else None
        return only if isinstance(only, FixedFields) else None

    def decode(self, frame: Frame, out: Columns) -> None:
        """All elements of all messages, as far as possible at once."""
        count = self.length if self.length is not None else frame.read_uint32(1 if self.ros1 else 4)
        if not self.inner.operations:  # ROS 1: messages without fields take no bytes
            return
        counts = spread(count, len(frame))
        # An element takes at least a byte: refuse counts that cannot be, before allocating.
        frame.check_bounds(frame.position + count)
        offsets = offsets_of(counts)
        if offsets[-1] == 0:
            elements = self.inner.empty()
        else:
            fixed = self._fixed(frame, counts, offsets)
            if fixed is None:
                fixed = _Elements(self.inner, frame, counts, offsets).read()
            elements = fixed
        for path, column in elements.items():
            out[path] = wrap(column, self.length, len(frame), offsets)

    def _fixed(self, frame: Frame, counts: Ints, offsets: Ints) -> Columns | None:
        """Elements of one fixed size lie at known places: one gather for all of them."""
        fields = self._only_fixed
        if fields is None:
            return None
        aligned = (frame.position + (fields.first_align - 1)) & -fields.first_align
        phase = uniform(aligned & fields.mask)
        stride = fields.stride(phase) if isinstance(phase, int) else None
        if stride is None or not isinstance(phase, int):
            return None
        stop = np.where(counts > 0, aligned + counts * stride, frame.position)
        frame.check_bounds(stop)
        within = np.arange(offsets[-1]) - np.repeat(offsets[:-1], counts)
        at = np.repeat(frame.origin + aligned, counts) + within * stride
        elements: Columns = {}
        fields.take(frame, at, fields.layouts[phase], elements)
        frame.position = uniform(stop)
        return elements


class _Elements:
    """Elements of varying size: where the next one starts is known when this one has been read.

    The first two of every message are read one after the other. The rest are then guessed to be
    as long as the second, and read all at once: a guess is right where every element ends just
    where the next was thought to start. Where it was wrong, elements are read one by one.
    """

    def __init__(self, inner: CdrPlan, frame: Frame, counts: Ints, offsets: Ints) -> None:
        self.inner, self.frame = inner, frame
        self.counts, self.offsets = counts, offsets
        self.position = spread(frame.position, len(frame)).copy()
        self.places: list[Ints] = []  # of the elements that were read, in the answer
        self.parts: list[Columns] = []

    def read(self) -> Columns:
        """All elements, in order; the frame's cursor is then past the last."""
        most = int(self.counts.max())
        left = self.counts.copy()
        step = 0
        while (rows := np.nonzero(left > 0)[0]).size:
            before = self.position[rows]
            self._read_one(rows, self.counts[rows] - left[rows])
            left[rows] -= 1
            step += 1
            if step == 2 and most > 4:
                stride = np.zeros(len(left), np.int64)
                stride[rows] = self.position[rows] - before
                left[self._guess(np.nonzero(left > 0)[0], left, stride)] = 0
        self.frame.position = uniform(self.position)
        place = np.concatenate(self.places)
        if len(self.parts) == 1 and (np.diff(place) == 1).all():
            return self.parts[0]
        back = np.argsort(place, kind="stable")
        return {
            path: take(join([part[path] for part in self.parts]), back) for path in self.parts[0]
        }

    def _read_one(self, rows: NDArray[np.intp], number: Ints) -> None:
        frame = self.frame.select(rows, uniform(self.position[rows]))
        self.parts.append(self.inner.decode(frame))
        self.places.append(self.offsets[rows] + number)
        self.position[rows] = frame.position

    def _guess(self, rows: NDArray[np.intp], left: Ints, stride: Ints) -> NDArray[np.intp]:
        """Read what is left of these messages by the guess; the rows where it was right."""
        no_rows = np.zeros(0, np.intp)
        if not rows.size:
            return no_rows
        counts = left[rows]
        starts = offsets_of(counts)
        within: Ints = np.arange(starts[-1]) - np.repeat(starts[:-1], counts)
        which = np.repeat(np.arange(len(rows)), counts)
        position = self.position[rows][which] + within * stride[rows][which]
        frame = self.frame.select(rows[which], position)
        try:
            columns = self.inner.decode(frame)
        except BadRows:
            return no_rows
        stop = spread(frame.position, len(position))
        right = np.ones(len(position), np.bool_)
        right[:-1] = (stop[:-1] == position[1:]) | (which[:-1] != which[1:])
        whole = np.logical_and.reduceat(right, starts[:-1])
        elements = np.nonzero(whole[which])[0]
        if not elements.size:
            return no_rows
        self.parts.append({path: take(column, elements) for path, column in columns.items()})
        place = self.offsets[rows][which] + (self.counts[rows] - counts)[which] + within
        self.places.append(place[elements])
        good: NDArray[np.intp] = rows[whole]
        self.position[good] = stop[starts[1:] - 1][whole]
        return good
