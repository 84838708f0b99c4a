"""Field paths of messages: what any message format's definition comes down to.

A field path names a value inside a message: `twist.twist.linear.x`, `ranges`, `header.stamp`
(nanoseconds), `poses[].pose.position.x` (one value per element of a sequence), `name` or `name[]`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from restock.errors import RecordingError, visible

DEEPEST = 24  # nested messages; real ones reach 6
MAX_FIELDS = 20_000
MAX_WHY = 300  # it may quote a definition

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

    def __init__(self, why: str) -> None:
        super().__init__(visible(why if len(why) <= MAX_WHY else f"{why[:MAX_WHY]}…"))


@dataclass(frozen=True)
class Many:
    """A field that repeats: a fixed array of `length`, or a sequence where that is None."""

    length: int | None


@dataclass(frozen=True)
class FieldType:
    """A field: a primitive (`base`) or a message (`message`), alone or repeated."""

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


class MessageType(ABC):
    """A message type with everything it is made of.

    `source` is where its definition comes from: "embedded", a distribution's name, "inferred".
    `times` are the messages that stand for a moment or a duration: read as nanoseconds.
    """

    name: str
    source: str
    times: Sequence[str] = ()
    recursive = False  # whether a message may hold messages of its own type

    @abstractmethod
    def fields_of(self, name: str) -> Sequence[FieldType]:
        """Return the fields of a message of this type's family.

        Raises:
            CannotDecode: it is not defined, or uses something unsupported.
        """

    def leaves(self) -> list[Leaf]:
        """Return every field path of the type, in the order of its definition.

        Inside a message that holds its own type the paths have no end: there they are left out
        (`leaf` still finds each).

        Raises:
            CannotDecode: it nests too deeply, or has too many fields.
        """
        return list(self._leaves(self.name, "", (), (self.name,), [0]))

    def _leaves(
        self,
        name: str,
        prefix: str,
        steps: tuple[FieldType, ...],
        within: tuple[str, ...],
        count: list[int],
    ) -> Iterator[Leaf]:
        if len(within) > DEEPEST:
            raise CannotDecode(f"{self.name} nests deeper than {DEEPEST} messages")
        for field in self.fields_of(name):
            count[0] += 1
            if count[0] > MAX_FIELDS:
                raise CannotDecode(f"{self.name} has more than {MAX_FIELDS:,} fields")
            path = prefix + field.name
            through = (*steps, field)
            if field.base:
                yield Leaf(path, through, field.base)
            elif field.message in self.times:
                yield Leaf(path, through, "time")
            elif field.message and not (self.recursive and field.message in within):
                inner = path + ("[]." if field.many else ".")
                inside = (*within, field.message)
                yield from self._leaves(field.message, inner, through, inside, count)

    def leaf(self, path: str) -> Leaf:
        """Resolve one field path.

        Raises:
            RecordingError: the type has no such field; names those it has.
        """
        name, steps = self.name, list[FieldType]()
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
            if last and field.message in self.times:
                return Leaf(path, tuple(steps), "time")
            if field.message is None:
                raise _no_field(self.name, path, f"{part} is a {field.base}, it has no fields")
            name = field.message
        inside = ", ".join(field.name for field in self.fields_of(name))
        raise _no_field(self.name, path, f"it is a message: name one of its fields ({inside})")


def _no_field(kind: str, path: str, remedy: str) -> RecordingError:
    return RecordingError(f"{kind} has no value at {path!r}", remedy=remedy)
