"""Parses MCAP records, and finds messages and definitions in chunks. See https://mcap.dev/spec.

One table has the fields of all records, and one parser reads them, never beyond their record.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from enum import IntEnum
from functools import lru_cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from restock.arrays import Ints
from restock.ingest.containers.chunks import Buffer, StoredChunk
from restock.ingest.decoding.columns import Channel, MessageBatch, gather

MAGIC = b"\x89MCAP0\r\n"
MAX_KEPT = 64 << 10  # largest definition, in bytes, that is cached for other files
PREFIX = 9  # bytes before a record's content: opcode (1), length of the content (8)


class Malformed(Exception):
    """Bytes that are a cut-short record or none at all. `at` is their position in the buffer."""

    def __init__(self, what: str, at: int) -> None:
        super().__init__(what)
        self.what, self.at = what, at


class Op(IntEnum):
    """Opcodes of records. Readers skip others."""

    HEADER = 0x01
    FOOTER = 0x02
    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06
    MESSAGE_INDEX = 0x07
    CHUNK_INDEX = 0x08
    ATTACHMENT = 0x09
    ATTACHMENT_INDEX = 0x0A
    STATISTICS = 0x0B
    METADATA = 0x0C
    METADATA_INDEX = 0x0D
    SUMMARY_OFFSET = 0x0E
    DATA_END = 0x0F


# Name and kind of each field. Fields of the kinds "span32", "span64" and "rest" are not copied:
# their value is the position (start, stop) in the buffer.
FIELDS: dict[Op, tuple[tuple[str, str], ...]] = {
    Op.HEADER: (("profile", "text"), ("library", "text")),
    Op.FOOTER: (("summary_start", "Q"), ("summary_offset_start", "Q"), ("summary_crc", "I")),
    Op.SCHEMA: (("id", "H"), ("name", "text"), ("encoding", "text"), ("data", "span32")),
    Op.CHANNEL: (
        ("id", "H"),
        ("schema_id", "H"),
        ("topic", "text"),
        ("message_encoding", "text"),
        ("metadata", "texts"),
    ),
    Op.MESSAGE: (
        ("channel_id", "H"),
        ("sequence", "I"),
        ("log_time", "Q"),
        ("publish_time", "Q"),
        ("data", "rest"),
    ),
    Op.CHUNK: (
        ("message_start_time", "Q"),
        ("message_end_time", "Q"),
        ("uncompressed_size", "Q"),
        ("uncompressed_crc", "I"),
        ("compression", "text"),
        ("records", "span64"),
    ),
    Op.MESSAGE_INDEX: (("channel_id", "H"), ("records", "span32")),
    Op.CHUNK_INDEX: (
        ("message_start_time", "Q"),
        ("message_end_time", "Q"),
        ("chunk_start_offset", "Q"),
        ("chunk_length", "Q"),
        ("message_index_offsets", "HQ"),
        ("message_index_length", "Q"),
        ("compression", "text"),
        ("compressed_size", "Q"),
        ("uncompressed_size", "Q"),
    ),
    Op.ATTACHMENT: (
        ("log_time", "Q"),
        ("create_time", "Q"),
        ("name", "text"),
        ("media_type", "text"),
        ("data", "span64"),
        ("crc", "I"),
    ),
    Op.ATTACHMENT_INDEX: (
        ("offset", "Q"),
        ("length", "Q"),
        ("log_time", "Q"),
        ("create_time", "Q"),
        ("data_size", "Q"),
        ("name", "text"),
        ("media_type", "text"),
    ),
    Op.STATISTICS: (
        ("message_count", "Q"),
        ("schema_count", "H"),
        ("channel_count", "I"),
        ("attachment_count", "I"),
        ("metadata_count", "I"),
        ("chunk_count", "I"),
        ("message_start_time", "Q"),
        ("message_end_time", "Q"),
        ("channel_message_counts", "HQ"),
    ),
    Op.METADATA: (("name", "text"), ("metadata", "texts")),
    Op.METADATA_INDEX: (("offset", "Q"), ("length", "Q"), ("name", "text")),
    Op.SUMMARY_OFFSET: (("group_opcode", "B"), ("group_start", "Q"), ("group_length", "Q")),
    Op.DATA_END: (("data_section_crc", "I"),),
}


def walk(buffer: Buffer, start: int, stop: int) -> Iterator[tuple[int, int, int]]:
    """Yield each record's opcode and the (start, stop) of its content, from `start` to `stop`.

    Raises:
        Malformed: a record has opcode 0, or ends beyond `stop`; the records before it were whole.
    """
    unpack = struct.Struct("<BQ").unpack
    position = start
    while position < stop:
        if position + PREFIX > stop:
            raise Malformed("cut within a record's first bytes", position)
        opcode, length = unpack(buffer[position : position + PREFIX])
        if not opcode:
            raise Malformed("opcode 0, which no record has: zeros, or noise", position)
        end = position + PREFIX + length
        if end > stop:
            raise Malformed(
                f"a record of {length:,} bytes, {end - stop:,} more than there are", position
            )
        yield opcode, position + PREFIX, end
        position = end


def parse(op: Op, buffer: Buffer, start: int, stop: int) -> dict[str, Any]:
    """Parse the record whose content is buffer[start:stop], ignoring bytes after its fields.

    Raises:
        Malformed: a field reaches beyond the record.
    """
    cursor = _Cursor(buffer, start, stop)
    return {name: cursor.read(kind) for name, kind in FIELDS[op]}


_SIZES = {"B": 1, "H": 2, "I": 4, "Q": 8}


class _Cursor:
    """Reads fields one after the other, never beyond `stop`."""

    HEAD = 4096  # bytes read at once: reading a file field by field would be slow

    def __init__(self, buffer: Buffer, start: int, stop: int) -> None:
        self.buffer, self.start, self.position, self.stop = buffer, start, start, stop
        self.head = bytes(buffer[start : min(start + self.HEAD, stop)])

    def read(self, kind: str) -> Any:
        if kind in _SIZES:
            return self._number(kind)
        if kind == "text":
            return self._text()
        if kind == "rest":
            return self._span(self.stop - self.position)
        if kind in ("span32", "span64"):
            return self._span(self._number("I" if kind == "span32" else "Q"))
        return self._pairs(kind)

    def _pairs(self, kind: str) -> dict[Any, Any]:
        start, stop = self._span(self._number("I"))
        inner = _Cursor(self.buffer, start, stop)
        key, value = ("text", "text") if kind == "texts" else (kind[0], kind[1])
        pairs = {}
        while inner.position < stop:
            name = inner.read(key)
            pairs[name] = inner.read(value)
        return pairs

    def _number(self, kind: str) -> int:
        return int.from_bytes(self._next(_SIZES[kind]), "little")

    def _text(self) -> str:
        return self._next(self._number("I")).decode("utf-8", errors="backslashreplace")

    def _next(self, length: int) -> bytes:
        start, stop = self._span(length)
        if stop - self.start <= len(self.head):
            return self.head[start - self.start : stop - self.start]
        return bytes(self.buffer[start:stop])

    def _span(self, length: int) -> tuple[int, int]:
        start = self.position
        if start + length > self.stop:
            raise Malformed(f"a field of {length:,} bytes reaches beyond its record", start)
        self.position = start + length
        return start, self.position


LATEST_NS = 2**63 - 1

_HEAD = np.dtype(  # a message record up to its data
    [
        ("op", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
HEAD_SIZE = _HEAD.itemsize  # 31
_START = np.dtype([("op", "u1"), ("length", "<u8"), ("channel", "<u2")])
_INDEX = np.dtype([("log_time", "<u8"), ("offset", "<u8")])


Positions: TypeAlias = dict[int, Ints]  # channel id -> positions of its message records


@dataclass(frozen=True)
class Chunk(StoredChunk):
    """A chunk's position, the log times that it spans, and its message index."""

    span_ns: tuple[int, int]
    index: dict[int, tuple[int, int]] = field(default_factory=dict)  # channel id -> start, stop

    def counts(self) -> dict[int, int]:
        """Count messages per channel with the message index."""
        return {
            channel: (stop - start) // _INDEX.itemsize
            for channel, (start, stop) in self.index.items()
        }


@dataclass(frozen=True)
class Indexed:
    """A channel's index entries in one chunk, which lies at buffer[base:base + size]."""

    base: int
    size: int
    entries: bytes


def indexed_messages(
    buffer: NDArray[np.uint8], parts: Sequence[Indexed], channel: int
) -> MessageBatch | None:
    """Find a channel's messages with its index entries in chunks, given in buffer order.

    None if the index does not fit the chunks, which must then be walked.
    """
    if any(len(part.entries) % _INDEX.itemsize for part in parts):
        return None
    offset = np.frombuffer(b"".join(part.entries for part in parts), _INDEX)["offset"]
    counts = [len(part.entries) // _INDEX.itemsize for part in parts]
    base = np.repeat(np.array([part.base for part in parts], np.int64), counts)
    size = np.repeat(np.array([part.size for part in parts], np.int64), counts)
    room = np.maximum(size - HEAD_SIZE, 0).astype(np.uint64)
    if (offset > room).any() or (size < HEAD_SIZE).any():
        return None
    # Sort by place in the file. Parts are in buffer order, so `base` and `size` still match.
    at = np.sort(offset.astype(np.int64) + base)
    head = gather(buffer, at, _HEAD)
    length = head["length"]
    if (
        (head["op"] != Op.MESSAGE).any()
        or (head["channel"] != channel).any()
        or (length > size.astype(np.uint64)).any()
        or (length < HEAD_SIZE - PREFIX).any()
    ):
        return None
    messages = _messages(buffer, at, head)
    return None if (messages.stop > base + size).any() else messages


def _to_int64_times(values: NDArray[np.uint64]) -> Ints:
    """Convert unsigned 64-bit times to int64; times after 2262 become the largest int64."""
    stamps: Ints = np.minimum(values, np.uint64(LATEST_NS)).astype(np.int64)
    return stamps


def walked_messages(part: bytes | memoryview) -> tuple[Positions, str | None]:
    """Walk an uncompressed chunk; return positions of message records, and where it is cut."""
    places: list[int] = []
    note = places.append
    length_at = struct.Struct("<xQ").unpack_from  # the length field, after the opcode
    position, end = 0, len(part)
    last = end - (PREFIX + 2)
    while position <= last and part[position]:  # no record has opcode 0
        note(position)
        position += PREFIX + length_at(part, position)[0]
    if position > end:  # the last record is not whole
        position = places.pop()
    cut = None
    if position < end and not part[position]:
        cut = f"zeros or noise, {end - position:,} bytes before its end"
    elif (
        position != end
        and position + PREFIX + int.from_bytes(part[position + 1 : position + PREFIX], "little")
        != end
    ):
        cut = f"cut within a record, {end - position:,} bytes before its end"
    at = np.array(places, np.int64)
    head = gather(np.frombuffer(part, np.uint8), at, _START)
    at = at[(head["op"] == Op.MESSAGE) & (head["length"] >= HEAD_SIZE - PREFIX)]
    numbers = gather(np.frombuffer(part, np.uint8), at, _START)["channel"]
    return {number: at[numbers == number] for number in np.unique(numbers).tolist()}, cut


def messages_at(buffer: NDArray[np.uint8], at: Ints) -> MessageBatch:
    """Return the messages whose records start at these positions, which a walk found."""
    return _messages(buffer, at, gather(buffer, at, _HEAD))


def _messages(buffer: NDArray[np.uint8], at: Ints, head: NDArray[np.void]) -> MessageBatch:
    return MessageBatch(
        buffer,
        at + HEAD_SIZE,
        at + PREFIX + head["length"].astype(np.int64),
        _to_int64_times(head["log_time"]),
        _to_int64_times(head["publish_time"]),
    )


class SchemaRecord(NamedTuple):
    """The definition of the messages of some channels."""

    name: str = ""
    encoding: str = ""
    data: bytes = b""


class ChannelRecord(NamedTuple):
    """A topic, and how its messages are encoded."""

    topic: str
    encoding: str
    schema_id: int  # 0: none
    qos: str = ""


@dataclass
class Definitions:
    """The schemas and channels of a file or of a chunk, by id."""

    schemas: dict[int, SchemaRecord] = field(default_factory=dict)
    channels: dict[int, ChannelRecord] = field(default_factory=dict)

    def take(self, opcode: int, buffer: Buffer, at: int, stop: int) -> None:
        """Add the record whose content is buffer[at:stop], if it is a schema or a channel."""
        if opcode not in (Op.SCHEMA, Op.CHANNEL):
            return
        raw = bytes(buffer[at - PREFIX : stop])
        # Cached, as all recordings of a robot have the same definitions.
        try:
            cached = len(raw) < MAX_KEPT
            number, record = (_parse_definition if cached else _parse_definition.__wrapped__)(raw)
        except Malformed as bad:
            raise Malformed(bad.what, at - PREFIX + bad.at) from None
        if isinstance(record, SchemaRecord):
            self.schemas[number] = record
        else:
            self.channels[number] = record

    def overridden_by(self, other: Definitions) -> Definitions:
        """Return the definitions of both; `other`'s if both define an id."""
        return Definitions(self.schemas | other.schemas, self.channels | other.channels)

    def lacking(self, channels: set[int]) -> set[int]:
        """Return the channels that are not defined, or whose schemas are not."""
        known = self.schemas.keys() | {0}
        return {
            number
            for number in channels
            if number not in self.channels or self.channels[number].schema_id not in known
        }

    def differing(self, other: Definitions) -> list[str]:
        """Return schemas and channels that `other` defines differently, such as "schema 3"."""
        schemas = self.schemas.keys() & other.schemas.keys()
        channels = self.channels.keys() & other.channels.keys()
        return [
            *(f"schema {n}" for n in sorted(schemas) if self.schemas[n] != other.schemas[n]),
            *(f"channel {n}" for n in sorted(channels) if self.channels[n] != other.channels[n]),
        ]

    def named(self) -> dict[int, Channel]:
        """Return every channel, described with its schema; a channel without one has no type."""
        return {
            number: Channel(
                number,
                channel.topic,
                (schema := self.schemas.get(channel.schema_id, SchemaRecord())).name,
                channel.encoding,
                schema.encoding,
                schema.data,
                channel.qos,
            )
            for number, channel in self.channels.items()
        }


@lru_cache(1024)
def _parse_definition(raw: bytes) -> tuple[int, SchemaRecord | ChannelRecord]:
    """Parse a schema or channel record; return its id and definition."""
    found = parse(Op(raw[0]), raw, PREFIX, len(raw))
    if raw[0] == Op.SCHEMA:
        low, high = found["data"]
        return found["id"], SchemaRecord(found["name"], found["encoding"], raw[low:high])
    qos = found["metadata"].get("offered_qos_profiles", "")
    return found["id"], ChannelRecord(
        found["topic"], found["message_encoding"], found["schema_id"], qos
    )


def definitions_in(records: bytes) -> Definitions:
    """Return the schemas and channels of an uncompressed chunk, up to damage."""
    found = Definitions()
    with suppress(Malformed):
        for opcode, at, stop in walk(records, 0, len(records)):
            found.take(opcode, records, at, stop)
    return found
