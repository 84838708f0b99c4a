"""Messages parsed one by one, then laid out in columns: for formats without a columnar decoder.

ROS messages go this way through `rosbags` where the columnar decoder gives up, and as its
reference in the tests; JSON and protobuf always do.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces.typing import Typesdict
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_typestore
from rosbags.typesys.base import normalize_fieldname

from restock.ingest.decoding.columns import FieldColumn, Ragged, join, offsets_of
from restock.ingest.decoding.definitions import RosType
from restock.ingest.decoding.field_paths import DTYPES, CannotDecode, FieldType, Leaf
from restock.ingest.decoding.messages import MessageBatch

BYTES_AT_ONCE = 1 << 20  # of payloads that are parsed, and so objects, at the same time


@dataclass(frozen=True)
class Decoded:
    """Decoded batch: columns of the good rows, and why the others failed."""

    rows: NDArray[np.intp]  # (G,) of the batch
    fields: dict[str, FieldColumn]  # (G, …) each
    bad: dict[str, int]  # reason -> messages


class Decoder(Protocol):
    """Some fields of one channel's messages, a batch at a time."""

    def empty(self) -> dict[str, FieldColumn]:
        """Columns without a row."""
        ...

    def decode(self, batch: MessageBatch) -> Decoded:
        """Decode a batch to columns, counting messages that do not decode by reason."""
        ...


class Unparsable(Exception):
    """A message that is not what it should be; the reason names no value of it."""


class Parser(Protocol):
    """Parser of one message format, message by message. Every method raises Unparsable."""

    def parse(self, payload: bytes) -> Any:
        """Parse one message."""
        ...

    def member(self, message: Any, field: FieldType) -> Any:
        """Return the value of one field; that of a repeated field has a length and is iterable."""
        ...

    def stamp_ns(self, value: Any) -> int:
        """Convert a time or a duration to nanoseconds."""
        ...

    def array(self, values: Sequence[Any], leaf: Leaf) -> NDArray[Any]:
        """Return the values of a leaf that has one value per message, (N,)."""
        ...

    def concatenate(self, values: Sequence[Any], leaf: Leaf) -> NDArray[Any]:
        """Concatenate the values of a leaf that has several per message."""
        ...


class ParsedDecoder:
    """Decodes messages through a parser."""

    def __init__(self, parser: Parser, leaves: Sequence[Leaf]) -> None:
        self._parser, self._leaves = parser, tuple(leaves)

    def empty(self) -> dict[str, FieldColumn]:
        """Columns without a row."""
        return self._columns([])

    def decode(self, batch: MessageBatch) -> Decoded:
        """Decode a batch to columns, counting messages that do not decode by reason."""
        parts, rows, bad = [self.empty()], list[int](), Counter[str]()
        for some in _slices(batch):
            messages, good = list[Any](), list[int]()
            for row in some:
                payload = batch.buffer[batch.start[row] : batch.stop[row]].tobytes()
                try:
                    messages.append(self._parser.parse(payload))
                    good.append(row)
                except Unparsable as reason:
                    bad[str(reason)] += 1
            try:
                parts.append(self._columns(messages))
                rows += good
            except Unparsable:  # whose it was is not known: one by one
                for row, message in zip(good, messages, strict=True):
                    try:
                        parts.append(self._columns([message]))
                        rows.append(row)
                    except Unparsable as reason:
                        bad[str(reason)] += 1
        fields = {leaf.path: join([part[leaf.path] for part in parts]) for leaf in self._leaves}
        return Decoded(np.asarray(rows, np.intp), fields, bad)

    def _columns(self, messages: list[Any]) -> dict[str, FieldColumn]:
        return {leaf.path: column_of(messages, leaf, self._parser) for leaf in self._leaves}


def _slices(batch: MessageBatch) -> Iterator[range]:
    """Yield the batch's rows, about BYTES_AT_ONCE at a time."""
    lengths = (batch.stop - batch.start).tolist()
    start = size = 0
    for row, length in enumerate(lengths):
        size += length
        if size >= BYTES_AT_ONCE:
            yield range(start, row + 1)
            start, size = row + 1, 0
    if start < len(lengths):
        yield range(start, len(lengths))


def column_of(messages: Sequence[Any], leaf: Leaf, parser: Parser) -> FieldColumn:
    """Return the values at a field path of parsed messages, (N, …) or Ragged.

    Raises:
        Unparsable: one of the messages has no such value.
    """
    values: list[Any] = list(messages)
    levels: list[tuple[int | None, list[int]]] = []
    for step in leaf.steps:
        values = [parser.member(value, step) for value in values]
        if step.many:
            levels.append((step.many.length, [len(value) for value in values]))
            if step is leaf.steps[-1] and leaf.kind in DTYPES:
                return _wrap(parser.concatenate(values, leaf), levels)
            values = [item for value in values for item in value]
    if leaf.kind == "time":
        try:
            stamps = np.array([parser.stamp_ns(value) for value in values], np.int64)
        except OverflowError:
            raise Unparsable(f"{leaf.path} is out of range for a date") from None
        return _wrap(stamps, levels)
    return _wrap(parser.array(values, leaf), levels)


def _wrap(column: FieldColumn, levels: list[tuple[int | None, list[int]]]) -> FieldColumn:
    """Flat values to their nesting, from the innermost repetition out."""
    for length, counts in reversed(levels):
        if length is not None and not isinstance(column, Ragged):
            column = column.reshape(len(counts), length, *column.shape[1:])
        else:
            column = Ragged(column, offsets_of(np.asarray(counts, np.int64)))
    return column


def objects(values: Sequence[Any]) -> NDArray[Any]:
    """Texts as an object array, (N,)."""
    array = np.empty(len(values), object)
    array[:] = values
    return array


class RowDecoder(ParsedDecoder):
    """Decodes each ROS message with rosbags' generated code."""

    def __init__(self, message: RosType, leaves: Sequence[Leaf], *, ros1: bool = False) -> None:
        super().__init__(_RosParser(message, ros1), leaves)


class _RosParser:
    def __init__(self, message: RosType, ros1: bool) -> None:
        self._name = message.name
        try:
            store = get_typestore(Stores.EMPTY)
            store.register(_family(message))
        except (TypesysError, SyntaxError, KeyError, RecursionError) as error:
            raise CannotDecode(f"its definition cannot be used: {error}") from error
        self._read = store.deserialize_ros1 if ros1 else store.deserialize_cdr

    def parse(self, payload: bytes) -> Any:
        try:
            return self._read(payload, self._name)
        except (SerdeError, IndexError, ValueError, KeyError) as error:
            raise Unparsable(str(error).split(":")[0]) from error

    def member(self, message: Any, field: FieldType) -> Any:
        return getattr(message, normalize_fieldname(field.name))

    def stamp_ns(self, value: Any) -> int:
        return int(value.sec * 1_000_000_000 + value.nanosec)

    def array(self, values: Sequence[Any], leaf: Leaf) -> NDArray[Any]:
        if leaf.kind == "string":
            return objects(values)
        if leaf.kind == "byte":  # an octet; rosbags gives it a sign
            return np.array(values, np.int8).view(np.uint8)
        return np.array(values, DTYPES[leaf.kind])

    def concatenate(self, values: Sequence[Any], leaf: Leaf) -> NDArray[Any]:
        dtype = DTYPES[leaf.kind]
        parts = [np.asarray(value, dtype) for value in values]
        return np.concatenate(parts) if parts else np.zeros(0, dtype)


def _family(message: RosType) -> Typesdict:
    """Return the type and those it contains: all that rosbags must compile."""
    wanted: list[str] = [message.name]
    family: Typesdict = {}
    while wanted:
        name = wanted.pop()
        if name not in family:
            fields = message.fields_of(name)
            family[name] = message.raw[name]
            wanted += [field.message for field in fields if field.message]
    return family
