"""MCAP chunks: bounded decompression, the places of messages, and definitions."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias

import lz4.frame
import numpy as np
import zstandard
from numpy.typing import NDArray

from restock.arrays import Ints
from restock.ingest.containers.formats.compression import most_bytes
from restock.ingest.containers.formats.mcap_records import (
    PREFIX,
    Buffer,
    Malformed,
    Op,
    crc32,
    parse,
    walk,
)
from restock.ingest.decoding.columns import gather
from restock.ingest.decoding.messages import Channel

# A chunk's uncompressed size is the file's claim: beyond this it is refused, not allocated.
MAX_CHUNK = 4 << 30
LATEST_NS = 2**63 - 1
STEP = 1 << 12  # of damaged data at a time: damage costs no more than what is near it

_DECODERS: dict[str, Callable[[], Any]] = {
    "zstd": lambda: zstandard.ZstdDecompressor().decompressobj(),
    "lz4": lz4.frame.LZ4FrameDecompressor,
}
_DAMAGED = (zstandard.ZstdError, RuntimeError, EOFError, OSError)

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


Positions: TypeAlias = dict[int, Ints]  # of message records, by channel


class BadChunk(Exception):
    """A chunk whose content cannot be read."""


@dataclass(frozen=True)
class Chunk:
    """Place of a chunk in the file, with the fields of its record and its message index."""

    at: int  # of its record in the file
    start: int  # of its (compressed) records
    stop: int
    size: int  # uncompressed
    crc: int  # of the uncompressed records; 0: unchecked
    compression: str
    span_ns: tuple[int, int]
    index: dict[int, tuple[int, int]] = field(default_factory=dict)  # channel -> entries in file

    def counts(self) -> dict[int, int]:
        """Count messages per channel by the message index."""
        return {
            channel: (stop - start) // _INDEX.itemsize
            for channel, (start, stop) in self.index.items()
        }


@dataclass
class Messages:
    """Messages of one channel in one buffer."""

    start: Ints
    stop: Ints
    log_time_ns: Ints
    publish_time_ns: Ints

    def __len__(self) -> int:
        return len(self.start)


def refuse_implausible(chunk: Chunk) -> None:
    """Check the size that a chunk claims, before as much is allocated.

    Raises:
        BadChunk: it is more than its stored bytes can hold.
    """
    stored = chunk.stop - chunk.start
    if chunk.size > min(most_bytes(stored), MAX_CHUNK):
        raise BadChunk(f"{stored:,} bytes that claim to hold {chunk.size:,}")


def inflate(chunk: Chunk, stored: bytes) -> bytes:
    """Decompress a chunk's stored bytes and check them against its CRC.

    Raises:
        BadChunk: unknown compression, an implausible size, damaged data or a wrong CRC.
    """
    refuse_implausible(chunk)
    data = _decompress(chunk.compression, stored, chunk.size)
    if len(data) != chunk.size:
        raise BadChunk(f"{len(data):,} bytes uncompressed, where it claims {chunk.size:,}")
    _check(chunk, data)
    return data


def inflate_into(chunk: Chunk, stored: bytes, room: NDArray[np.uint8]) -> None:
    """Decompress into `room`, which has the chunk's size: reusing memory costs less.

    Raises:
        BadChunk: as `inflate`.
    """
    if chunk.compression == "zstd" and _unpack(stored, room):
        _check(chunk, room.data)
    else:  # which names what is wrong with it
        room[:] = np.frombuffer(inflate(chunk, stored), np.uint8)


def _unpack(stored: bytes, room: NDArray[np.uint8]) -> bool:
    """Decompress zstd data that fills the room exactly; False where it does not."""
    try:
        with zstandard.ZstdDecompressor().stream_reader(stored) as reader:
            at = 0
            while at < len(room) and (count := reader.readinto(room.data[at:])):
                at += count
            return at == len(room) and not reader.read(1)
    except zstandard.ZstdError:
        return False


def _check(chunk: Chunk, data: bytes | memoryview) -> None:
    if chunk.crc and crc32(data) != chunk.crc:
        raise BadChunk("its CRC does not match")


def inflate_partly(chunk: Chunk, file: Buffer, limit: int = MAX_CHUNK) -> bytes:
    """Return a chunk's first records, unchecked, up to `limit` bytes or the damage."""
    limit = min(limit, chunk.size, most_bytes(chunk.stop - chunk.start))
    if chunk.compression == "":
        return file[chunk.start : min(chunk.start + limit, chunk.stop)]
    if chunk.compression not in _DECODERS:
        return b""
    decoder, parts, size = _DECODERS[chunk.compression](), list[bytes](), 0
    with suppress(*_DAMAGED):
        for position in range(chunk.start, chunk.stop, STEP):
            parts.append(decoder.decompress(file[position : min(position + STEP, chunk.stop)]))
            size += len(parts[-1])
            if size >= limit:
                break
    return b"".join(parts)[:limit]


def _decompress(compression: str, stored: bytes, size: int) -> bytes:
    if compression == "":
        return stored
    try:
        if compression == "zstd":
            if zstandard.frame_content_size(stored) > size:
                raise BadChunk("it would decompress to more than it claims")
            return zstandard.ZstdDecompressor().decompress(stored, max_output_size=size)
        if compression == "lz4":
            data: bytes = lz4.frame.LZ4FrameDecompressor().decompress(stored, max_length=size + 1)
            return data
    except _DAMAGED as error:
        raise BadChunk(f"its {compression} data is damaged ({error})") from error
    raise BadChunk(f"compression {compression!r} is not supported")


@dataclass(frozen=True)
class Indexed:
    """A channel's index entries in one chunk, which lies at buffer[base:base + size]."""

    base: int
    size: int
    entries: bytes


def indexed_messages(
    buffer: NDArray[np.uint8], parts: Sequence[Indexed], channel: int
) -> Messages | None:
    """Find a channel's messages by its index entries in some chunks, which lie in this order.

    None where the index does not fit the chunks: then they are to be walked.
    """
    if any(len(part.entries) % _INDEX.itemsize for part in parts):
        return None
    offset = np.frombuffer(b"".join(part.entries for part in parts), _INDEX)["offset"]
    if not len(offset):
        empty = np.zeros(0, np.int64)
        return Messages(empty, empty, empty, empty)
    counts = [len(part.entries) // _INDEX.itemsize for part in parts]
    base = np.repeat(np.array([part.base for part in parts], np.int64), counts)
    size = np.repeat(np.array([part.size for part in parts], np.int64), counts)
    room = np.maximum(size - HEAD_SIZE, 0).astype(np.uint64)
    if (offset > room).any() or (size < HEAD_SIZE).any():
        return None
    # File order: entries are sorted by time. Chunk by chunk, so `base` and `size` stay right.
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
    messages = _messages(at, head)
    return None if (messages.stop > base + size).any() else messages


def first_offset(entries: bytes) -> int:
    """Return where the first message of some index entries, one at least, lies in its chunk."""
    return int(np.frombuffer(entries, _INDEX, len(entries) // _INDEX.itemsize)["offset"].min())


def _stamps(values: NDArray[np.uint64]) -> Ints:
    """Convert unsigned 64-bit times to int64; times after 2262 become the largest int64."""
    stamps: Ints = np.minimum(values, np.uint64(LATEST_NS)).astype(np.int64)
    return stamps


def walked_messages(part: bytes | memoryview) -> tuple[Positions, str | None]:
    """Find where message records start in an uncompressed chunk, per channel, and what is cut."""
    places: list[int] = []
    note = places.append
    length_at = struct.Struct("<xQ").unpack_from  # after the opcode
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


def messages_at(buffer: NDArray[np.uint8], at: Ints) -> Messages:
    """Return the messages whose records start at these (walked) positions."""
    return _messages(at, gather(buffer, at, _HEAD))


def _messages(at: Ints, head: NDArray[np.void]) -> Messages:
    return Messages(
        at + HEAD_SIZE,
        at + PREFIX + head["length"].astype(np.int64),
        _stamps(head["log_time"]),
        _stamps(head["publish_time"]),
    )


class SchemaRecord(NamedTuple):
    """Definition of the messages of some channels."""

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
    raw: dict[tuple[int, int], bytes] = field(default_factory=dict)  # records, by opcode and id

    def take(self, opcode: int, buffer: Buffer, at: int, stop: int) -> None:
        """Add the record whose content is buffer[at:stop], if it is a schema or a channel."""
        if opcode == Op.SCHEMA:
            record = parse(Op.SCHEMA, buffer, at, stop)
            low, high = record["data"]
            text = bytes(buffer[low:high])
            self.schemas[record["id"]] = SchemaRecord(record["name"], record["encoding"], text)
            self.raw[opcode, record["id"]] = bytes(buffer[at - PREFIX : stop])
        elif opcode == Op.CHANNEL:
            record = parse(Op.CHANNEL, buffer, at, stop)
            self.channels[record["id"]] = ChannelRecord(
                record["topic"],
                record["message_encoding"],
                record["schema_id"],
                dict(record["metadata"]).get("offered_qos_profiles", ""),
            )
            self.raw[opcode, record["id"]] = bytes(buffer[at - PREFIX : stop])

    def beneath(self, other: Definitions) -> Definitions:
        """Return both; where both define an id, what `other` says."""
        return Definitions(self.schemas | other.schemas, self.channels | other.channels)

    def as_in(self, other: Definitions) -> Definitions:
        """Return what defines the same ids: as `other` does, for those that it has."""
        return Definitions(
            {number: other.schemas.get(number, own) for number, own in self.schemas.items()},
            {number: other.channels.get(number, own) for number, own in self.channels.items()},
        )

    def lacking(self, channels: set[int]) -> set[int]:
        """Return those of these channels that are not defined, or whose schemas are not."""
        known = self.schemas.keys() | {0}
        return {
            number
            for number in channels
            if number not in self.channels or self.channels[number].schema_id not in known
        }

    def repeated_in(self, records: bytes, channels: set[int]) -> Definitions:
        """Return the definitions of these channels whose exact records are among `records`.

        Searching for bytes takes a hundredth of the time of walking.
        """
        channels = channels & self.channels.keys()
        schemas = {self.channels[n].schema_id for n in channels} & self.schemas.keys()
        return Definitions(
            {n: self.schemas[n] for n in schemas if self.raw[Op.SCHEMA, n] in records},
            {n: self.channels[n] for n in channels if self.raw[Op.CHANNEL, n] in records},
        )

    def differing(self, other: Definitions) -> list[str]:
        """Return what both define, but differently."""
        schemas = self.schemas.keys() & other.schemas.keys()
        channels = self.channels.keys() & other.channels.keys()
        return [
            *(f"schema {n}" for n in sorted(schemas) if self.schemas[n] != other.schemas[n]),
            *(f"channel {n}" for n in sorted(channels) if self.channels[n] != other.channels[n]),
        ]

    def named(self) -> dict[int, Channel]:
        """Return every channel with its schema; without one, its messages have no type."""
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


def definitions_in(records: bytes) -> Definitions:
    """Return the schemas and channels of an uncompressed chunk, up to what is cut."""
    found = Definitions()
    with suppress(Malformed):
        for opcode, at, stop in walk(records, 0, len(records)):
            found.take(opcode, records, at, stop)
    return found
