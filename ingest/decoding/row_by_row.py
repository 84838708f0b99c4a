"""Decodes JSON and protobuf: parses messages one by one, then puts their values into columns.

The fields of JSON messages come from a JSON Schema; where the schema is missing or does not define
a value, the channel's first messages do. JSON does not distinguish 0 from 0.0: a number without a
schema is float64, unless there are integers that only int64 represents. A message that lacks a
wanted field, or has another kind of value there, counts as undecodable. A null instead of a number
becomes NaN.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from restock.ingest.decoding.columns import (
    DEEPEST,
    DTYPES,
    MAX_FIELDS,
    CannotDecode,
    FieldColumn,
    FieldType,
    Leaf,
    Many,
    MessageBatch,
    MessageType,
    Ragged,
    join,
    offsets_of,
)

BYTES_AT_ONCE = 1 << 20  # of payloads that exist as parsed objects at the same time


@dataclass(frozen=True)
class Decoded:
    """A decoded batch: columns of the good rows, and why the others failed."""

    rows: NDArray[np.intp]  # (G,) good rows of the batch
    fields: dict[str, FieldColumn]  # (G, …) each
    bad: dict[str, int]  # reason -> messages


class Decoder(Protocol):
    """Decodes some fields of one channel's messages, a batch at a time."""

    def empty(self) -> dict[str, FieldColumn]:
        """Return columns without rows."""
        ...

    def decode(self, batch: MessageBatch) -> Decoded:
        """Decode a batch to columns; count messages that cannot be decoded, by reason."""
        ...


class Unparsable(Exception):
    """A message that does not fit its type. Its reason quotes no values, so it can be counted."""


class Parser(Protocol):
    """Parser of one message format, message by message. Every method raises Unparsable."""

    def parse(self, payload: bytes) -> Any:
        """Parse one message."""
        ...

    def member(self, message: Any, field: FieldType) -> Any:
        """Return the value of one field; for a repeated field, a sized iterable."""
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
        """Return columns without rows."""
        return self._columns([])

    def decode(self, batch: MessageBatch) -> Decoded:
        """Decode a batch to columns; count messages that cannot be decoded, by reason."""
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
            except Unparsable:  # it is unknown which message it was: take them one by one
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
    """Group flat values into nested rows, from the innermost repetition to the outermost."""
    for length, counts in reversed(levels):
        if length is not None and not isinstance(column, Ragged):
            column = column.reshape(len(counts), length, *column.shape[1:])
        else:
            column = Ragged(column, offsets_of(np.asarray(counts, np.int64)))
    return column


def objects(values: Sequence[Any]) -> NDArray[Any]:
    """Return texts as an object array, (N,)."""
    array = np.empty(len(values), object)
    array[:] = values
    return array


LARGEST = 64 << 20  # bytes of a message; as objects it takes some thirty times that
MAX_SCHEMA = 4 << 20
EXACT = 1 << 53  # up to here float64 holds every integer

# An object with exactly these two members, seconds and nanoseconds, is a time or a duration.
TIMES = (("sec", "nsec"), ("sec", "nanosec"), ("secs", "nsecs"), ("seconds", "nanos"))
_KINDS = {"boolean": "bool", "integer": "int64", "number": "float64", "string": "string"}

Sample = Callable[[], Iterable[bytes]]


@dataclass
class Node:
    """What is known about the values at one path of the messages."""

    seen: Counter[str] = field(default_factory=Counter)  # values by JSON Schema's kind, except null
    members: dict[str, Node] = field(default_factory=dict)  # values of objects' members, by name
    items: Node | None = None  # values in arrays
    declared: bool = False  # the schema defines it, whatever the messages have
    widest: int = 0  # largest magnitude of the integers seen

    @property
    def kind(self) -> str | None:
        """Return the kind of most values here, so that one odd message does not decide."""
        seen = self.seen
        if seen["number"] and seen["integer"]:
            seen = seen + Counter(number=seen["integer"]) - Counter(integer=seen["integer"])
        return max(seen, key=lambda kind: seen[kind]) if seen else None


@dataclass(eq=False)
class JsonType(MessageType):
    """The type of one channel's JSON messages.

    Raises:
        CannotDecode: its schema is not valid.
    """

    name: str
    source: str  # "embedded", or "inferred" without a schema
    schema: bytes
    sample: Sample  # the channel's first messages
    _root: Node = field(init=False)
    _fields: dict[str, list[FieldType]] | None = None
    times = tuple(f"{{{first}, {second}}}" for first, second in TIMES)

    def __post_init__(self) -> None:
        self._root = _Schema(self.schema).root() if self.schema else Node()

    def fields_of(self, name: str) -> Sequence[FieldType]:
        if self._fields is None:
            root = self._root
            if not _is_complete(root):
                for payload in self.sample():
                    try:
                        _observe(root, parse(payload), 0)
                    except Unparsable:
                        continue  # a bad message is counted when it is read
            self._fields = {}
            _Fields(self._fields).add(self.name, root)
        return self._fields.get(name, [])


def parse(payload: bytes) -> dict[str, Any]:
    """Parse one message.

    Raises:
        Unparsable: not JSON, nested too deeply, too large, or not an object.
    """
    if len(payload) > LARGEST:
        raise Unparsable(f"JSON of more than {LARGEST:,} bytes")
    try:
        try:
            value = msgspec.json.decode(payload)
        except msgspec.DecodeError:
            # NaN and Infinity are not in the standard, but Python writes and reads them.
            if b"NaN" not in payload and b"Infinity" not in payload:
                raise
            value = json.loads(payload)
    except RecursionError:
        raise Unparsable("JSON that nests too deeply") from None
    except ValueError:
        raise Unparsable("not JSON") from None
    if not isinstance(value, dict):
        raise Unparsable("JSON that is not an object")
    return value


class _Schema:
    """Reads a JSON Schema, as far as it defines which fields there are and their kinds."""

    def __init__(self, text: bytes) -> None:
        if len(text) > MAX_SCHEMA:
            raise CannotDecode(f"its definition of {len(text):,} bytes is too long")
        try:
            self._document = msgspec.json.decode(text)
        except (ValueError, RecursionError) as error:
            raise CannotDecode(f"its definition cannot be parsed: {error}") from error
        self._count = 0

    def root(self) -> Node:
        return self._node(self._document, 0, frozenset({"#"}))

    def _node(self, schema: Any, depth: int, within: frozenset[str]) -> Node:
        self._count += 1
        if self._count > MAX_FIELDS:
            raise CannotDecode(f"its definition has more than {MAX_FIELDS:,} fields")
        if isinstance(schema, dict) and isinstance(target := schema.get("$ref"), str):
            if target in within:  # the type contains itself: leave out its endless paths
                return Node(declared=True)
            return self._node(self._at(target), depth, within | {target})
        if not isinstance(schema, dict) or depth >= DEEPEST:
            return Node()
        named = schema.get("type")
        kinds = [kind for kind in (named if isinstance(named, list) else [named]) if kind]
        node = Node(Counter({kind for kind in kinds if isinstance(kind, str)} - {"null"}))
        if isinstance(members := schema.get("properties"), dict):
            node.seen = node.seen or Counter({"object"})
            node.members = {
                name: self._node(one, depth + 1, within) for name, one in members.items()
            }
        if node.seen["array"] and "items" in schema:
            node.items = self._node(schema["items"], depth + 1, within)
        # If several kinds are allowed, the messages decide.
        node.declared = len(node.seen) == 1
        node.seen = node.seen if node.declared else Counter()
        return node

    def _at(self, target: str) -> Any:
        """Follow a reference within the document; None for other references."""
        place = self._document if target.startswith("#") else None
        for part in target.split("/")[1:]:
            place = place.get(part) if isinstance(place, dict) else None
        return place


def _is_complete(node: Node) -> bool:
    """Return whether the schema defines everything, members and array items included."""
    if not node.declared or (node.kind == "object" and not node.members):
        return False
    if node.kind == "array" and (node.items is None or not _is_complete(node.items)):
        return False
    return all(map(_is_complete, node.members.values()))


def _observe(node: Node, value: Any, depth: int) -> None:
    """Count the kind of a value, and of the values inside it."""
    if depth > DEEPEST or value is None or (node.declared and not node.seen):
        return
    if isinstance(value, dict):
        kind = "object"
        for name, inner in value.items():
            if len(node.members) >= MAX_FIELDS:
                raise CannotDecode(f"its messages have more than {MAX_FIELDS:,} fields")
            _observe(node.members.setdefault(name, Node()), inner, depth + 1)
    elif isinstance(value, list):
        kind = "array"
        node.items = node.items or Node()
        for inner in value:
            _observe(node.items, inner, depth + 1)
    elif isinstance(value, bool):
        kind = "boolean"
    elif isinstance(value, int):
        kind, node.widest = "integer", max(node.widest, abs(value))
    else:
        kind = "string" if isinstance(value, str) else "number"
    if not node.declared:
        node.seen[kind] += 1


class _Fields:
    """Turns nodes into fields. A node without a known kind gives no field."""

    def __init__(self, fields: dict[str, list[FieldType]]) -> None:
        self._fields = fields
        self._count = 0

    def add(self, name: str, node: Node) -> None:
        fields = []
        for member, inner in node.members.items():
            self._count += 1
            if self._count > MAX_FIELDS:
                raise CannotDecode(f"its messages have more than {MAX_FIELDS:,} fields")
            # Leave out names with dots or brackets, which would be ambiguous in a path.
            if member and member.isprintable() and "." not in member and "[]" not in member:
                made = self._field(f"{name}.{member}", member, inner, None)
                fields += [made] if made else []
        self._fields[name] = fields

    def _field(self, path: str, name: str, node: Node, many: Many | None) -> FieldType | None:
        if node.kind == "array" and node.items and many is None:
            return self._field(path + "[]", name, node.items, Many(None))
        if node.kind == "object":
            message = _time_message(node) or path
            self.add(message, node)
            return FieldType(name, None, message, many)
        base = _base_kind(node)
        return FieldType(name, base, None, many) if base else None


def _time_message(node: Node) -> str | None:
    for names, kind in zip(TIMES, JsonType.times, strict=True):
        integers = all(
            inner.seen["integer"] > inner.seen["number"] for inner in node.members.values()
        )
        if integers and node.members.keys() == set(names):
            return kind
    return None


def _base_kind(node: Node) -> str | None:
    if node.kind == "integer" and not node.declared:
        return "int64" if EXACT < node.widest < 1 << 63 else "float64"
    return _KINDS.get(node.kind or "")


class JsonParser:
    """Parses JSON messages and reads their values."""

    def parse(self, payload: bytes) -> Any:
        return parse(payload)

    def member(self, message: Any, field: FieldType) -> Any:
        if not isinstance(message, dict) or field.name not in message:
            raise Unparsable(f"field {field.name!r} is missing")
        value = message[field.name]
        if field.many and not isinstance(value, list):
            raise Unparsable(f"{field.name!r} is not an array")
        return value

    def stamp_ns(self, value: Any) -> int:
        for first, second in TIMES if isinstance(value, dict) else ():
            if first in value and second in value:
                parts = value[first], value[second]
                if all(type(part) is int for part in parts):
                    return int(parts[0] * 1_000_000_000 + parts[1])
        raise Unparsable("not a valid time")

    def array(self, values: Sequence[Any], leaf: Leaf) -> NDArray[Any]:
        kinds = set(map(type, values))
        if leaf.kind == "string" and kinds <= {str}:
            return objects(values)
        if leaf.kind == "float64" and kinds <= {int, float, type(None)}:
            if type(None) in kinds:
                values = [math.nan if value is None else value for value in values]
        elif not (leaf.kind == "bool" and kinds <= {bool}) and not (
            leaf.kind == "int64" and kinds <= {int}
        ):
            raise Unparsable(f"{leaf.path} is not a {leaf.kind}")
        try:
            return np.array(values, DTYPES[leaf.kind])
        except OverflowError:
            raise Unparsable(f"{leaf.path} is out of range for {leaf.kind}") from None

    def concatenate(self, values: Sequence[Any], leaf: Leaf) -> NDArray[Any]:
        return self.array(list(chain.from_iterable(values)), leaf)
