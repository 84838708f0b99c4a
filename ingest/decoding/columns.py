"""Messages of one channel: their fields, their serialised bytes, and the columns they become.

A field path names a value inside a message: `twist.twist.linear.x`, `ranges`, `header.stamp`
(nanoseconds), `poses[].pose.position.x` (one value per element of a sequence).
Names come from files, and go to terminals, tables and reports. Control characters in them are
therefore escaped (`visible`) when they are read.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Ints
from restock.errors import visible


@dataclass(frozen=True)
class Ragged:
    """Rows of different lengths: row i is `values[offsets[i]:offsets[i + 1]]`.

    `values` is an array (total, …), or Ragged again if a sequence contains sequences
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
        # A value comes from where its row starts in `self.values`, plus its index in the row.
        source = np.repeat(self.offsets[:-1][rows] - offsets[:-1], lengths) + np.arange(offsets[-1])
        return Ragged(take(self.values, source), offsets)


FieldColumn: TypeAlias = "NDArray[Any] | Ragged"  # leading axis: the message


def offsets_of(lengths: NDArray[Any]) -> Ints:
    """Turn lengths (N,) into offsets (N + 1,)."""
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
    """Concatenate columns of the same field."""
    if len(columns) == 1:
        return columns[0]
    ragged = [column for column in columns if isinstance(column, Ragged)]
    if not ragged:
        return np.concatenate([column for column in columns if not isinstance(column, Ragged)])
    return Ragged(
        join([column.values for column in ragged]),
        offsets_of(np.concatenate([column.lengths for column in ragged])),
    )


def own(column: FieldColumn) -> FieldColumn:
    """Copy a column, so that it keeps no buffer in memory that it is a view of."""
    if isinstance(column, Ragged):
        return Ragged(own(column.values), column.offsets.copy())
    return column.copy()


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

    The values must lie within the buffer. Each is copied as a block, not field by field.
    """
    size = dtype.itemsize
    if not len(at) or not size:
        return np.zeros(len(at), dtype)
    raw = np.dtype((np.void, size))
    everywhere: NDArray[Any] = np.ndarray((len(buffer) - size + 1,), raw, buffer, strides=(1,))
    values = everywhere[at]  # numpy copies opaque values faster than structures
    if dtype.subdtype:
        base, shape = dtype.subdtype
        return values.view(base).reshape(len(at), *shape)
    return np.ndarray((len(at),), dtype, values)  # not by `view`, which checks every field


@dataclass(frozen=True)
class TopicColumns:
    """The decoded messages of one topic, in the order of their log time."""

    log_time_ns: Ints  # (N,) when the recorder received it
    publish_time_ns: Ints  # (N,) when the sender sent it; the log time if unknown
    fields: dict[str, FieldColumn] = field(default_factory=dict)  # by field path
    lap: Ints | None = None  # (N,) how often log time jumped far back before; None: never

    def __len__(self) -> int:
        return len(self.log_time_ns)

    def laps(self) -> int:
        """Count how often log time goes far back in the file."""
        return 0 if self.lap is None else int(self.lap.max(initial=0))

    def gaps_s(self) -> F64:
        """Return the seconds from each message to the next, except at jumps far back."""
        if self.lap is None:
            return np.asarray(np.diff(self.log_time_ns) * 1e-9, np.float64)
        laps = [self.log_time_ns[self.lap == lap] for lap in range(self.laps() + 1)]
        return np.concatenate([np.diff(lap) for lap in laps]) * 1e-9


DEEPEST = 24  # deepest nesting of messages; real types reach 6
MAX_FIELDS = 20_000
MAX_WHY = 300  # characters of a reason, which may quote a definition

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
    """A repeated field: a fixed array of `length`, or a sequence if that is None."""

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
    """A resolved field path: the fields along it, and the kind of value at its end."""

    path: str
    steps: tuple[FieldType, ...]
    kind: str  # key of DTYPES, "string" or "time"

    @property
    def dims(self) -> tuple[int | None, ...]:
        """Return the length of each repetition along the path, outermost first; None: sequence."""
        return tuple(step.many.length for step in self.steps if step.many)


class MessageType(ABC):
    """A message type, with the messages that it contains.

    `source` is where its definition comes from: "embedded", a distribution's name, "inferred".
    `times` names the messages that are a time or a duration, which are read as nanoseconds.
    """

    name: str
    source: str
    times: Sequence[str] = ()
    recursive = False  # whether a message may contain messages of its own type

    @abstractmethod
    def fields_of(self, name: str) -> Sequence[FieldType]:
        """Return the fields of a message: of this type, or of one inside it.

        Raises:
            CannotDecode: it is not defined, or uses something unsupported.
        """

    def leaves(self) -> list[Leaf]:
        """Return every field path of the type, in the order of its definition.

        Raises:
            CannotDecode: it nests too deeply, or has too many fields.
        """
        return [*self.by_path.values()]

    @cached_property
    def by_path(self) -> dict[str, Leaf]:
        """Return the leaves by path, computed once, as many recordings share a type.

        A message that contains its own type has endless paths: those that repeat it are left out.

        Raises:
            CannotDecode: as `leaves`.
        """
        every = self._leaves(self.name, "", (), (self.name,), [0])
        return {leaf.path: leaf for leaf in every}

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
        for member in self.fields_of(name):
            count[0] += 1
            if count[0] > MAX_FIELDS:
                raise CannotDecode(f"{self.name} has more than {MAX_FIELDS:,} fields")
            path = prefix + member.name
            through = (*steps, member)
            if member.base:
                yield Leaf(path, through, member.base)
            elif member.message in self.times:
                yield Leaf(path, through, "time")
            elif member.message and not (self.recursive and member.message in within):
                inner = path + ("[]." if member.many else ".")
                inside = (*within, member.message)
                yield from self._leaves(member.message, inner, through, inside, count)


def suggest_fields(path: str, paths: list[str]) -> str:
    """Return an error text for a missing field path that suggests similar paths."""
    unbracketed = {known.replace("[]", ""): known for known in paths}
    ends = {known.split(".")[-1]: known for known in paths}
    near = [
        unbracketed[name] for name in get_close_matches(path.replace("[]", ""), unbracketed, n=3)
    ]
    near = near or [ends[name] for name in get_close_matches(path.split(".")[-1], ends, n=3)]
    problem = f"no field {path!r}"
    if near:
        return f"{problem}: did you mean {' or '.join(repr(name) for name in near)}?"
    shown = ", ".join(paths[:12]) + (f" and {len(paths) - 12} more" if len(paths) > 12 else "")
    return f"{problem}: the fields are {shown}"


_SHORT_NAME = re.compile(r"(\w+)/(\w+)")


@dataclass(frozen=True)
class Channel:
    """A stream of messages of one type in one file.

    Some writers omit the `msg` in the name of a ROS type. `type` always has it.
    """

    id: int
    topic: str
    type: str  # "nav_msgs/msg/Odometry"
    encoding: str  # of the messages: "cdr", "json", "protobuf", "ros1", …
    definition_format: str = ""  # "ros2msg", "ros2idl", "ros1msg", "jsonschema", "protobuf" or ""
    definition: bytes = b""
    qos: str = ""  # profiles that its publishers offered, as the file has them (YAML)

    def __post_init__(self) -> None:
        for name in ("topic", "type", "encoding", "definition_format"):
            object.__setattr__(self, name, visible(getattr(self, name)))
        if short := _SHORT_NAME.fullmatch(self.type):
            object.__setattr__(self, "type", "/msg/".join(short.groups()))


@dataclass(frozen=True)
class MessageBatch:
    """Serialised messages of one channel: slices of one buffer, in file order."""

    buffer: NDArray[np.uint8]
    start: Ints  # (N,) first byte of each payload in `buffer`
    stop: Ints  # (N,) one past its last byte
    log_time_ns: Ints  # (N,)
    publish_time_ns: Ints  # (N,)

    def __len__(self) -> int:
        return len(self.start)

    def select(self, rows: NDArray[np.intp]) -> MessageBatch:
        """Select messages; they share the buffer."""
        return MessageBatch(
            self.buffer,
            self.start[rows],
            self.stop[rows],
            self.log_time_ns[rows],
            self.publish_time_ns[rows],
        )

    @property
    def size_bytes(self) -> int:
        """Return the total size of the payloads."""
        return int((self.stop - self.start).sum())

    def payloads(self) -> list[bytes]:
        """Return the bytes of each message."""
        view = self.buffer.data
        bounds = zip(self.start.tolist(), self.stop.tolist(), strict=True)
        return [bytes(view[start:stop]) for start, stop in bounds]

    @classmethod
    def of(cls, payloads: Sequence[bytes], log_time_ns: Any, publish_time_ns: Any) -> MessageBatch:
        """Build a batch from payloads."""
        offsets = offsets_of(np.fromiter(map(len, payloads), np.int64, len(payloads)))
        return cls(
            np.frombuffer(b"".join(payloads), np.uint8),
            offsets[:-1],
            offsets[1:],
            np.asarray(log_time_ns, np.int64),
            np.asarray(publish_time_ns, np.int64),
        )


class PendingBatch:
    """Messages of one channel that wait to be decoded together with later ones."""

    def __init__(self) -> None:
        self._payloads = list[bytes]()
        self._log_time_ns, self._publish_time_ns = list[Ints](), list[Ints]()
        self.size_bytes = 0

    def __len__(self) -> int:
        return len(self._payloads)

    def add(self, payloads: Sequence[bytes], log_time_ns: Ints, publish_time_ns: Ints) -> None:
        """Add messages, in file order."""
        self._payloads += payloads
        self._log_time_ns.append(log_time_ns)
        self._publish_time_ns.append(publish_time_ns)
        self.size_bytes += sum(map(len, payloads))

    def batch(self) -> MessageBatch:
        """Return all of them as one batch."""
        log, publish = np.concatenate(self._log_time_ns), np.concatenate(self._publish_time_ns)
        return MessageBatch.of(self._payloads, log, publish)
