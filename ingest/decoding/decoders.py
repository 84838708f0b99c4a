"""Decoders for each encoding of messages; ROS messages are decoded straight into columns.

ROS messages are CDR in either byte order, or ROS 1's serialisation. The first four bytes of a CDR
payload (the encapsulation header) define how the rest is laid out, and alignment is relative to the
byte after them. ROS 2 writes plain CDR ("00 01", little-endian). XCDR2 and parameter lists are
refused by name.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from restock.arrays import Ints
from restock.ingest.decoding.cdr_frame import (
    TOO_LONG,
    UNTERMINATED,
    BadRows,
    Columns,
    FixedField,
    FixedFields,
    Frame,
    Order,
    gather_sequences,
    spread,
    texts,
    uniform,
)
from restock.ingest.decoding.columns import (
    DTYPES,
    CannotDecode,
    Channel,
    FieldColumn,
    FieldType,
    Leaf,
    MessageBatch,
    MessageType,
    Ragged,
    join,
    offsets_of,
    take,
)
from restock.ingest.decoding.definitions import KEPT, TIMES, RosType, message_type
from restock.ingest.decoding.row_by_row import (
    Decoded,
    Decoder,
    JsonParser,
    JsonType,
    ParsedDecoder,
    Sample,
)


class Operation(Protocol):
    """Reads one or more fields of all messages of a frame into `out`."""

    def decode(self, frame: Frame, out: Columns) -> None: ...


@dataclass
class CdrPlan:
    """The operations of one message type, in the order of its serialisation."""

    operations: list[Operation]
    paths: dict[str, tuple[str, tuple[int | None, ...]]]  # wanted path -> kind, array lengths

    def decode(self, frame: Frame) -> Columns:
        """Decode the wanted fields of all messages, and move the cursor past the last field.

        Raises:
            BadRows: messages that end too early, or hold invalid text.
        """
        out: Columns = {}
        for operation in self.operations:
            operation.decode(frame, out)
        return out

    def empty(self) -> Columns:
        """Return columns without rows."""
        return {path: empty_column(kind, dims) for path, (kind, dims) in self.paths.items()}


def empty_column(kind: str, dims: tuple[int | None, ...]) -> FieldColumn:
    """Return a column without rows, of the shape that rows would have."""
    dtype = {"string": np.dtype(object), "time": np.dtype(np.int64)}.get(kind) or DTYPES[kind]
    column: FieldColumn = np.zeros(0, dtype)
    for length in reversed(dims):
        column = wrap(column, length, 0, offsets_of(np.zeros(0, np.int64)))
    return column


def wrap(column: FieldColumn, length: int | None, rows: int, offsets: Ints) -> FieldColumn:
    """Group elements into rows: arrays of a fixed `length` as an axis, sequences as Ragged."""
    if length is not None and not isinstance(column, Ragged):
        return column.reshape(rows, length, *column.shape[1:])
    return Ragged(column, offsets)


@dataclass
class Text:
    """A string: its length (CDR counts a terminating zero, ROS 1 has none), then its bytes."""

    path: str | None
    ros1: bool

    def decode(self, frame: Frame, out: Columns) -> None:
        """Decode the strings, or skip them without a `path`."""
        length = frame.read_uint32(1 if self.ros1 else 4)
        stop = frame.position + length
        frame.check_bounds(stop)
        start = frame.origin + frame.position
        if not self.ros1:
            # Some writers write an empty text as no bytes at all, not even its zero.
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
        """Gather the sequences, or skip them without a `path`."""
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
    """A sequence or fixed array of messages or texts; `inner` decodes each element."""

    inner: CdrPlan
    length: int | None  # length of a fixed array; None: a sequence
    ros1: bool

    @cached_property
    def _only_fixed(self) -> FixedFields | None:
        operations = self.inner.operations
        only = operations[0] if len(operations) == 1 else None
        return only if isinstance(only, FixedFields) else None

    def decode(self, frame: Frame, out: Columns) -> None:
        """Decode all elements of all messages, as far as possible at once."""
        count = self.length if self.length is not None else frame.read_uint32(1 if self.ros1 else 4)
        if not self.inner.operations:  # in ROS 1, elements without fields take no bytes
            return
        counts = spread(count, len(frame))
        # An element takes at least a byte: refuse impossible counts before allocating.
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
        """Gather all elements at once if they have one fixed size; return None if not."""
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
    """Reads elements of varying size: each must be read to know where the next one starts.

    The first two elements of every message are read one after the other. The rest are then guessed
    to be as long as the second, and read all at once. The guess is right for a message if each of
    its elements ends exactly where the next was assumed to start. In the other messages, elements
    are read one by one.
    """

    def __init__(self, inner: CdrPlan, frame: Frame, counts: Ints, offsets: Ints) -> None:
        self.inner, self.frame = inner, frame
        self.counts, self.offsets = counts, offsets
        self.position = spread(frame.position, len(frame)).copy()
        self.places: list[Ints] = []  # for each of `parts`, its elements' indices in the result
        self.parts: list[Columns] = []

    def read(self) -> Columns:
        """Read all elements in order, and move the frame's cursor past the last."""
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
        """Read the remaining elements by the guess; return the messages for which it was right."""
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


class _Compiler:
    """Walks a definition and collects its operations."""

    def __init__(self, message: RosType, wanted: Collection[str], ros1: bool) -> None:
        self.message, self.wanted, self.ros1 = message, wanted, ros1

    def plan(self, name: str, prefix: str) -> CdrPlan:
        """Compile the plan of a message whose fields' paths start with `prefix`."""
        plan = CdrPlan([], {})
        fixed: list[FixedField] = []
        self._message(name, prefix, plan, fixed)
        self._close(plan, fixed)
        return plan

    def _close(self, plan: CdrPlan, fixed: list[FixedField]) -> None:
        if fixed:
            plan.operations.append(FixedFields(list(fixed)))
            fixed.clear()

    def _message(self, name: str, prefix: str, plan: CdrPlan, fixed: list[FixedField]) -> None:
        fields = self.message.fields_of(name)
        if not fields and not self.ros1:  # C has no empty structure, so ROS 2 gives it a byte
            fixed.append(FixedField(np.dtype(np.uint8), None, 1, None))
        for part in fields:
            self._field(part, prefix + part.name, plan, fixed)

    def _field(self, part: FieldType, path: str, plan: CdrPlan, fixed: list[FixedField]) -> None:
        wanted = self._wanted(path)
        if part.base and part.base != "string":
            dtype = DTYPES[part.base]
            if part.many is None or part.many.length is not None:
                count = part.many.length if part.many else None
                fixed.append(FixedField(dtype, count, 1 if self.ros1 else dtype.itemsize, wanted))
                self._note(plan, wanted, part.base, () if count is None else (count,))
                return
            self._close(plan, fixed)
            plan.operations.append(Primitives(dtype, wanted, self.ros1))
            self._note(plan, wanted, part.base, (None,))
        elif part.many:
            self._repeat(part, path, plan, fixed)
        elif part.base:
            self._close(plan, fixed)
            plan.operations.append(Text(wanted, self.ros1))
            self._note(plan, wanted, "string", ())
        elif part.message in TIMES:
            self._time(str(part.message), path, plan, fixed)
        else:
            self._message(str(part.message), path + ".", plan, fixed)

    def _repeat(self, part: FieldType, path: str, plan: CdrPlan, fixed: list[FixedField]) -> None:
        length = part.many.length if part.many else None
        self._close(plan, fixed)
        if part.base:
            wanted = self._wanted(path)
            inner = CdrPlan([Text(wanted, self.ros1)], {})
            self._note(inner, wanted, "string", ())
        elif part.message in TIMES:
            inner, inner_fixed = CdrPlan([], {}), list[FixedField]()
            self._time(str(part.message), path, inner, inner_fixed)
            self._close(inner, inner_fixed)
        else:
            inner = self.plan(str(part.message), path + "[].")
        if inner.operations or length is None:
            plan.operations.append(Repeat(inner, length, self.ros1))
        for inner_path, (kind, dims) in inner.paths.items():
            plan.paths[inner_path] = (kind, (length, *dims))

    def _time(self, name: str, path: str, plan: CdrPlan, fixed: list[FixedField]) -> None:
        """Add a time's two fields, which become one value in ns."""
        fields = self.message.fields_of(name)
        bases = [field.base for field in fields]
        if len(fields) != 2 or not all(base in ("int32", "uint32") for base in bases):
            raise CannotDecode(f"{name} is not the standard definition of a time")
        wanted, align = self._wanted(path), 1 if self.ros1 else 4
        for part, one in zip(("sec", "nanosec"), fields, strict=True):
            fixed.append(FixedField(DTYPES[str(one.base)], None, align, wanted, part))
        self._note(plan, wanted, "time", ())

    def _wanted(self, path: str) -> str | None:
        return path if path in self.wanted else None

    def _note(
        self, plan: CdrPlan, wanted: str | None, kind: str, dims: tuple[int | None, ...]
    ) -> None:
        if wanted is not None:
            plan.paths[wanted] = (kind, dims)


@lru_cache(KEPT)
def compile_plan(message: RosType, wanted: frozenset[str], *, ros1: bool = False) -> CdrPlan:
    """Compile the plan that reads these leaf paths of a message type (as `Leaf.path` gives them).

    A plan keeps nothing of the messages that it reads, so many recordings share one.

    Raises:
        CannotDecode: the type uses something unsupported.
    """
    return _Compiler(message, wanted, ros1).plan(message.name, "")


HEADER = 4  # bytes of the encapsulation header
PADDING = 3  # most bytes after the last field: payloads are padded to a multiple of four
RESTARTS = 16  # attempts, each without the rows that failed, before the rows are halved

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
    """Decodes the wanted fields of one message type, a whole batch at a time."""

    def __init__(self, message: RosType, leaves: Sequence[Leaf], *, ros1: bool = False) -> None:
        self._ros1 = ros1
        self._paths = [leaf.path for leaf in leaves]
        self._plan = compile_plan(message, frozenset(self._paths), ros1=ros1)

    def empty(self) -> Columns:
        """Return columns without rows."""
        return self._plan.empty()

    def decode(self, batch: MessageBatch) -> Decoded:
        """Decode a batch to columns; count messages that cannot be decoded, by reason."""
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
            return Decoded(rows, columns, bad)
        halves = np.array_split(rows, 2)
        return self._join([self._decode_rows(batch, h, order, header) for h in halves], bad)

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


READABLE = ("cdr", "ros1", "json", "protobuf")
SAMPLE_BYTES = 4 << 20  # bytes of the first messages, from which fields are inferred
SAMPLE_MESSAGES = 1000


def type_of(channel: Channel, distro: str, payloads: Sample) -> MessageType:
    """Return the type of a channel's messages; `payloads` yields them, to infer types of JSON.

    Raises:
        CannotDecode: the encoding or the type is not supported.
    """
    if channel.encoding not in READABLE:
        raise CannotDecode(f"messages encoded as {channel.encoding!r} are not supported")
    if channel.encoding in ("cdr", "ros1"):
        return message_type(channel, distro)
    if channel.encoding == "protobuf":
        if channel.definition_format != "protobuf":
            raise CannotDecode("protobuf messages without a protobuf definition are not supported")
        # Imported here: it takes a while, and few recordings need it.
        from restock.ingest.decoding.protobuf_messages import protobuf_type

        return protobuf_type(channel.type, channel.definition)
    schema = channel.definition if channel.definition_format == "jsonschema" else b""
    return JsonType(
        channel.type or "JSON",
        "embedded" if schema else "inferred",
        schema,
        lambda: _first(payloads()),
    )


def _first(payloads: Iterable[bytes]) -> list[bytes]:
    some, size = list[bytes](), 0
    for payload in payloads:
        some.append(payload)
        size += len(payload)
        if size >= SAMPLE_BYTES or len(some) >= SAMPLE_MESSAGES:
            break
    return some


def decoder_of(channel: Channel, kind: MessageType, leaves: Sequence[Leaf]) -> Decoder:
    """Create the decoder for some fields of a channel's messages.

    Raises:
        CannotDecode: the type uses something unsupported.
    """
    if isinstance(kind, RosType):
        return ColumnDecoder(kind, leaves, ros1=channel.encoding == "ros1")
    if isinstance(kind, JsonType):
        return ParsedDecoder(JsonParser(), leaves)
    from restock.ingest.decoding.protobuf_messages import ProtobufParser, ProtobufType

    if not isinstance(kind, ProtobufType):
        raise TypeError(f"no decoder for {type(kind).__name__}")
    return ParsedDecoder(ProtobufParser(kind), leaves)
