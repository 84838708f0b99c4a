"""Message definitions: from the text in a recording, or a named distribution's, to field paths.

A field path names a value inside a message: `twist.twist.linear.x`, `ranges`, `header.stamp`
(nanoseconds), `poses[].pose.position.x` (one value per element of a sequence), `name` or `name[]`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import (
    Stores,
    TypesysError,
    get_types_from_idl,
    get_types_from_msg,
    get_typestore,
)
from rosbags.typesys.msg import normalize_msgtype

from restock.errors import RecordingError
from restock.ingest.storage import Channel

DEFAULT_DISTRO = "humble"
DEEPEST = 24  # nested messages; real ones reach 6
MOST_FIELDS = 20_000
LONGEST_DEFINITION = 4 << 20
LONGEST_ARRAY = 1 << 20

EMPTY = "structure_needs_at_least_one_member"  # stands in a message without fields
TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
DTYPES: dict[str, np.dtype[Any]] = {
    "bool": np.dtype(np.bool_),
    "byte": np.dtype(np.uint8),
    "octet": np.dtype(np.uint8),
    "char": np.dtype(np.uint8),
    "int8": np.dtype(np.int8),
    "uint8": np.dtype(np.uint8),
    "int16": np.dtype(np.int16),
    "uint16": np.dtype(np.uint16),
    "int32": np.dtype(np.int32),
    "uint32": np.dtype(np.uint32),
    "int64": np.dtype(np.int64),
    "uint64": np.dtype(np.uint64),
    "float32": np.dtype(np.float32),
    "float64": np.dtype(np.float64),
}


class CannotDecode(Exception):
    """A type that cannot be decoded, and why: the topic is skipped, the recording is not."""


@dataclass(frozen=True)
class Many:
    """A field that repeats: a fixed array of `length`, or a sequence where that is None."""

    length: int | None


@dataclass(frozen=True)
class FieldType:
    """One field: a primitive (`base`) or a message (`message`), alone or repeated."""

    name: str
    base: str | None  # key of DTYPES, or "string"
    message: str | None  # full name
    many: Many | None


@dataclass(frozen=True)
class Leaf:
    """A field path, resolved: the fields it goes through and what is at its end."""

    path: str
    steps: tuple[FieldType, ...]
    kind: str  # key of DTYPES, "string" or "time"

    @property
    def dims(self) -> tuple[int | None, ...]:
        """Per repetition along the path, outermost first: its fixed length, or None."""
        return tuple(step.many.length for step in self.steps if step.many)


@dataclass(frozen=True)
class MessageType:
    """A message type with everything it is made of."""

    name: str
    source: str  # "embedded" or the distribution's name
    raw: dict[str, Any]  # rosbags' Typesdict, which the row-wise decoder registers

    def fields_of(self, name: str) -> list[FieldType]:
        """The fields of a message of this type's family.

        Raises:
            CannotDecode: it is not defined, or uses something that cannot be read.
        """
        if name not in self.raw:
            raise CannotDecode(f"{name} is not defined in the recording or in {self.source!r}")
        fields = [_field(field, description) for field, description in self.raw[name][1]]
        return [] if [field.name for field in fields] == [EMPTY] else fields

    def leaves(self) -> list[Leaf]:
        """Every field path of the type, in the order of its serialisation."""
        return list(self._leaves(self.name, "", (), 0, [0]))

    def _leaves(
        self, name: str, prefix: str, steps: tuple[FieldType, ...], depth: int, count: list[int]
    ) -> Iterator[Leaf]:
        if depth > DEEPEST:
            raise CannotDecode(f"{self.name} nests deeper than {DEEPEST} messages")
        for field in self.fields_of(name):
            count[0] += 1
            if count[0] > MOST_FIELDS:
                raise CannotDecode(f"{self.name} has more than {MOST_FIELDS:,} fields")
            path = prefix + field.name
            here = (*steps, field)
            if field.base:
                yield Leaf(path, here, field.base)
            elif field.message in TIMES:
                yield Leaf(path, here, "time")
            elif field.message:
                inner = path + ("[]." if field.many else ".")
                yield from self._leaves(field.message, inner, here, depth + 1, count)

    def leaf(self, path: str) -> Leaf:
        """One field path.

        Raises:
            RecordingError: the type has no such field; says which there are.
        """
        name, steps = self.name, []
        parts = path.split(".")
        for place, part in enumerate(parts):
            fields = {field.name: field for field in self.fields_of(name)}
            field = fields.get(part.removesuffix("[]"))
            last = place == len(parts) - 1
            if field is None or (part.endswith("[]") and not field.many):
                raise _no_field(self.name, path, f"{name} has {', '.join(fields) or 'no fields'}")
            if field.many and not last and not part.endswith("[]"):
                raise _no_field(self.name, path, f"{part} repeats: write {part}[]")
            steps.append(field)
            if last and field.base:
                return Leaf(path, tuple(steps), field.base)
            if last and field.message in TIMES:
                return Leaf(path, tuple(steps), "time")
            if field.message is None:
                raise _no_field(self.name, path, f"{part} is a {field.base}, it has no fields")
            name = field.message
        inside = ", ".join(field.name for field in self.fields_of(name))
        raise _no_field(self.name, path, f"it is a message: name one of its fields ({inside})")


def _no_field(kind: str, path: str, remedy: str) -> RecordingError:
    return RecordingError(f"{kind} has no value at {path!r}", remedy=remedy)


def _field(name: str, description: Any) -> FieldType:
    node, rest = description
    many = None
    if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        (node, rest), length = rest
        fixed = description[0] == Nodetype.ARRAY
        if fixed and not 0 < length <= LONGEST_ARRAY:
            raise CannotDecode(f"{name} is an array of {length:,}")
        many = Many(length if fixed else None)
    if node == Nodetype.NAME:
        return FieldType(name, None, str(rest), many)
    base = str(rest[0])
    if base != "string" and base not in DTYPES:
        raise CannotDecode(f"{name} is a {base}, which is not read")
    return FieldType(name, base, None, many)


def distro_types(distro: str) -> dict[str, Any]:
    """A distribution's message definitions.

    Raises:
        RecordingError: no distribution of that name.
    """
    return dict(_distro_store(distro).fielddefs)


@cache
def _distro_store(distro: str) -> Any:
    names = {store.value.removeprefix("ros2_"): store for store in Stores}
    if distro not in names:
        raise RecordingError(
            f"no type store named {distro!r}",
            remedy=f"there are {', '.join(sorted(names.keys() - {'empty', 'latest'}))}",
        )
    return get_typestore(names[distro])


def message_type(channel: Channel, distro: str) -> MessageType:
    """The type of a channel's messages.

    Raises:
        CannotDecode: a service or action event, a type that nobody defines, or a definition
            that cannot be parsed.
    """
    name = normalize_msgtype(channel.type) if channel.type else ""
    for part, word in (("/srv/", "service"), ("/action/", "action")):
        if part in name:
            raise CannotDecode(f"{word} events are not read")
    types = distro_types(distro)
    # An empty definition is that of a message without fields, or was left out by the writer.
    embedded = channel.definition_format in ("ros2msg", "ros2idl", "ros1msg")
    if embedded and (channel.definition or name not in types):
        if len(channel.definition) > LONGEST_DEFINITION:
            raise CannotDecode(f"its definition has {len(channel.definition):,} bytes")
        return _embedded(name, channel.definition_format, channel.definition, distro)
    if name not in types:
        raise CannotDecode(
            f"unknown type {channel.type or '(unnamed)'}: not defined in the recording"
            f" nor in {distro!r}"
        )
    return _from_distro(name, distro)


@cache
def _from_distro(name: str, distro: str) -> MessageType:
    found = MessageType(name, distro, distro_types(distro))
    found.leaves()  # refuses what cannot be read
    return found


@cache
def _embedded(name: str, form: str, definition: bytes, distro: str) -> MessageType:
    try:
        text = definition.decode()
        types: dict[str, Any] = {}
        rule = "=" * 80 + "\n"
        if form != "ros2idl":
            types.update(get_types_from_msg(text, name))
        elif text.startswith(f"{rule}IDL: "):
            for part in text.split(rule)[1:]:
                types.update(get_types_from_idl(part.split("\n", 1)[1]))
        else:
            types.update(get_types_from_idl(text))
    except (TypesysError, UnicodeDecodeError, RecursionError, ValueError, IndexError) as error:
        raise CannotDecode(f"its definition cannot be parsed: {_first_line(error)}") from error
    if form == "ros1msg":  # time and duration are primitives there
        types = {**distro_types("ros1_noetic"), **types}
    source = "embedded"
    missing = _named(types) - types.keys()
    if missing:  # some writers leave out the messages inside; their sizes will tell if they differ
        types = {**distro_types(distro), **types}
        source = f"embedded, and {distro}"
    found = MessageType(name, source, types)
    found.leaves()  # refuses what cannot be read
    return found


def _named(types: dict[str, Any]) -> set[str]:
    """The messages that fields of these types are made of."""
    fields = [_field(*item) for _, items in types.values() for item in items]
    return {field.message for field in fields if field.message}


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
