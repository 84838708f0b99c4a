"""ROS 1 bags: the messages of each chunk, read once, in the order of the file.

`rosbags` reads the index; here its sizes are checked and chunks inflated. A bag that was cut short
has no index: what it holds is found by walking its chunks, which carry their own definitions.
"""

from __future__ import annotations

import bz2
import io
import struct
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import lz4.frame
import numpy as np
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag1,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.rosbag1 import Reader, ReaderError
from rosbags.rosbag1.reader import Chunk, Header, IndexData, RecordType, normalize
from rosbags.typesys.msg import normalize_msgtype

from restock.arrays import Ints
from restock.errors import RecordingError
from restock.ingest.containers.storage import (
    Container,
    Damage,
    Extra,
    Integrity,
    Metadata,
    Packed,
    Watch,
    most_bytes,
    unwatched,
)
from restock.ingest.decoding.columns import Channel, MessageBatch

# Of chunks that are read again: who proposes a profile reads topic after topic, and bz2 is slow.
KEPT_BYTES = 128 << 20

# What reading a damaged bag raises, here and in rosbags.
BROKEN = (
    *(ReaderError, AssertionError, ValueError, KeyError, IndexError, struct.error),
    *(OSError, EOFError, RuntimeError, OverflowError),
)

_KNOWN = frozenset(int(kind) for kind in RecordType)
_MESSAGE, _CONNECTION = bytes([RecordType.MSGDATA]), bytes([RecordType.CONNECTION])


@dataclass
class Walked:
    """Content of the chunks of a bag without an index."""

    counts: dict[int, Counter[int]] = field(default_factory=dict)  # by position and connection
    spans: list[tuple[int, int]] = field(default_factory=list)
    stop: int = 0  # of what was read


def walk(
    data: bytes, named: dict[int, tuple[dict[bytes, bytes], dict[bytes, bytes]]] | None = None
) -> tuple[dict[int, list[tuple[int, int, int]]], int | None]:
    """Start, end and stamp of every message of a chunk, by connection; and where it is damaged.

    `named` gets the connections that it defines, as the fields of a record's header and data.
    """
    found: dict[int, list[tuple[int, int, int]]] = {}
    at, end = 0, len(data)
    while at < end:
        start = at + 4 + int.from_bytes(data[at : at + 4], "little")
        stop = start + 4 + int.from_bytes(data[start : start + 4], "little")
        if start + 4 > end or stop > end:
            return found, at
        fields = _fields(data, at + 4, start)
        kind = fields.get(b"op", b"")
        if kind == _MESSAGE and len(fields.get(b"conn", b"")) == 4 == len(fields[b"time"]) // 2:
            seconds, nanoseconds = struct.unpack("<II", fields[b"time"])
            channel = int.from_bytes(fields[b"conn"], "little")
            rows = found.setdefault(channel, [])
            rows.append((start + 4, stop, seconds * 1_000_000_000 + nanoseconds))
        elif kind != _CONNECTION:
            return found, at
        elif named is not None:
            channel = int.from_bytes(fields.get(b"conn", b""), "little")
            named.setdefault(channel, (fields, _fields(data, start + 4, stop)))
        at = stop
    return found, None


def _fields(data: bytes, at: int, stop: int) -> dict[bytes, bytes]:
    """Parse the fields of a record's header."""
    fields = {b"time": b""}
    while at < stop:
        end = at + 4 + int.from_bytes(data[at : at + 4], "little")
        name, _, value = data[at + 4 : min(end, stop)].partition(b"=")
        fields[name] = value
        at = end
    return fields


class Bag(Reader):
    """rosbags' reader, which trusts the sizes in a bag, with these checked."""

    def __init__(self, path: Path) -> None:
        super().__init__(_BoundedPath(path))  # type: ignore[arg-type]
        self._size = path.stat().st_size
        self._entries = 0
        self._chunks: dict[int, tuple[str, int]] = {}  # position -> compression, size inside
        self._cut: set[int] = set()  # chunks of which the file ends before they do
        self._read: set[int] = set()
        self._kept: dict[int, bytes] = {}

    def read_chunk(self) -> Chunk:
        assert self.bio
        position = self.bio.tell()
        if position in self._chunks:
            raise ReaderError("two chunks at the same position")
        header = Header.read(self.bio, RecordType.CHUNK)
        self._chunks[position] = header.get_string("compression"), header.get_uint32("size")
        self.bio.seek(position)
        return super().read_chunk()

    def read_index_data(self, pos: int, indexes: dict[int, list[IndexData]]) -> None:
        assert self.bio
        start = self.bio.tell()
        super().read_index_data(pos, indexes)
        # Index records that lie over each other could hold more than the file has bytes.
        self._entries += self.bio.tell() - start
        if self._entries > self._size:
            raise ReaderError("its index is larger than the bag")

    def open_without_index(self, watch: Watch) -> Walked:
        """Find what its chunks hold, up to where the file makes no sense.

        Raises:
            ReaderError: it is no bag of format 2.0.
        """
        self.bio = self.path.open("rb")
        if self.bio.readline() != b"#ROSBAG V2.0\n":
            raise ReaderError("File magic is invalid.")
        walked = Walked()
        named: dict[int, tuple[dict[bytes, bytes], dict[bytes, bytes]]] = {}
        while (at := self.bio.tell()) < self._size:
            watch("looking through the file, bytes", at, self._size)
            try:
                header = Header.read(self.bio)
                kind = header.get_uint8("op")
                if kind != RecordType.CHUNK:
                    data = self.bio.tell()
                    length = int.from_bytes(self.bio.read(4), "little")
                    if data + 4 + length > self._size or kind not in _KNOWN:
                        break
                    self.bio.seek(length, 1)
                    walked.stop = self.bio.tell()
                    continue
                self.bio.seek(at)
                chunk = self.read_chunk()
            except BROKEN:
                break
            stop = chunk.datapos + chunk.datasize
            if stop > self._size:
                self._cut.add(at)
            self.chunks[at] = chunk
            try:
                found, _ = walk(self.inflated(at), named)
            except BROKEN:  # said when it is read
                found = {}
            walked.counts[at] = Counter({key: len(rows) for key, rows in found.items()})
            times = [time for rows in found.values() for _, _, time in rows]
            walked.spans += [(min(times), max(times))] if times else []
            walked.stop = min(stop, self._size)
            self.bio.seek(walked.stop)
        self._read.clear()  # who reads a bag once keeps nothing of it
        self.connections = [self._connection(key, *one) for key, one in sorted(named.items())]
        return walked

    def _connection(
        self, key: int, outer: dict[bytes, bytes], inner: dict[bytes, bytes]
    ) -> Connection:
        """Build a connection from its definition in a chunk."""
        texts = {
            name: (inner.get(name) or outer.get(name) or b"").decode(errors="replace")
            for name in (b"topic", b"type", b"md5sum", b"message_definition")
        }
        return Connection(
            key,
            normalize(outer.get(b"topic", b"").decode(errors="replace") or texts[b"topic"]),
            normalize_msgtype(texts[b"type"]),
            MessageDefinition(MessageDefinitionFormat.MSG, texts[b"message_definition"]),
            texts[b"md5sum"],
            0,
            ConnectionExtRosbag1(None, None),
            self,
        )

    def packed(self) -> list[Packed]:
        """Return the chunks by their compression."""
        by: dict[str, list[int]] = {}
        for position, (compression, _) in self._chunks.items():
            by.setdefault("" if compression == "none" else compression, []).append(position)
        return [
            Packed(
                name,
                len(some),
                sum(self.chunks[one].datasize for one in some if one in self.chunks),
                sum(self._chunks[one][1] for one in some),
            )
            for name, some in by.items()
        ]

    def inflated(self, position: int) -> bytes:
        """Decompress a chunk's records; from the second time on they are kept if there is room."""
        if (kept := self._kept.get(position)) is not None:
            return kept
        data = self._inflated(position)
        room = KEPT_BYTES - sum(map(len, self._kept.values()))
        if position in self._read and len(data) <= room and self._chunks[position][0] == "bz2":
            self._kept[position] = data
        self._read.add(position)
        return data

    def _inflated(self, position: int) -> bytes:
        assert self.bio
        chunk = self.chunks[position]
        compression, size = self._chunks[position]
        cut = position in self._cut
        if chunk.datasize > self._size and not cut:
            raise ReaderError("it is longer than the bag")
        if size > most_bytes(chunk.datasize):
            raise ReaderError(f"{chunk.datasize:,} bytes that claim to hold {size:,}")
        self.bio.seek(chunk.datapos)
        stored = self.bio.read(chunk.datasize)
        if compression == "none":
            data = stored
        elif compression == "bz2":
            data = bz2.BZ2Decompressor().decompress(stored, max_length=size + 1)
        else:
            data = lz4.frame.LZ4FrameDecompressor().decompress(stored, max_length=size + 1)
        if len(data) != size and not (cut and len(data) < size):
            raise ReaderError(f"{len(data):,} bytes, where it claims {size:,}")
        return bytes(data)


class _BoundedPath:
    """A file of which no more can be read than it has."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __str__(self) -> str:
        return str(self._path)

    def exists(self) -> bool:
        return self._path.exists()

    def open(self, mode: str) -> io.BufferedReader:
        return _BoundedFile(io.FileIO(self._path, mode), self._path.stat().st_size)


class _BoundedFile(io.BufferedReader):
    def __init__(self, raw: io.RawIOBase, size: int) -> None:
        super().__init__(raw)
        self._size = size

    def read(self, size: int | None = -1) -> bytes:
        left = max(self._size - self.tell(), 0)
        return super().read(left if size is None or size < 0 else min(size, left))


# Whose places are remembered, of 24 bytes: who proposes a profile reads topic after topic, and
# walking a chunk takes longer than inflating it.
MAX_REMEMBERED = 1 << 20  # messages
# Start, end and stamp of a chunk's messages (N, 3), by connection; and where it is damaged.
_Places: TypeAlias = tuple[dict[int, Ints], int | None]


class Ros1File:
    """A ROS 1 bag of format 2.0, read only. The format has no checksums, so it is never verified.

    Raises:
        RecordingError: it cannot be opened; a bag that was cut short has no index, and is read
            only with `salvage`.
    """

    from_ros2 = False

    def __init__(self, path: Path, *, salvage: bool = False, watch: Watch = unwatched) -> None:
        self.integrity: Integrity = "unverified"
        self.damage: list[Damage] = []
        self.notes: list[str] = []
        self.extras: list[Extra] = []
        self.metadata: list[Metadata] = []  # the format has no place for it
        self.packed: list[Packed] = []
        self._places: dict[int, _Places] = {}  # by the position of the chunk
        self._room = MAX_REMEMBERED
        self._reader = Bag(path)
        try:
            self._reader.open()
            walked = None
        except BROKEN as error:
            if not salvage:
                raise RecordingError(
                    f"ROS 1 bag cannot be read: {error}",
                    where=str(path),
                    remedy="`--salvage` reads what can still be read of it; or `rosbag reindex`"
                    " repairs a bag whose recording was cut short",
                ) from error
            self._reader = Bag(path)
            walked = self._salvaged(path, error, watch)
        self.channels = {
            connection.id: Channel(
                connection.id,
                connection.topic,
                connection.msgtype,
                "ros1",
                "ros1msg",
                connection.msgdef.data.encode(),
            )
            for connection in self._reader.connections
        }
        self.packed = self._reader.packed()
        # Messages of each channel in each chunk.
        self._counts = self._by_index() if walked is None else walked.counts
        self.counts = dict.fromkeys(self.channels, 0)
        for counts in self._counts.values():
            for channel in counts.keys() & self.channels.keys():
                self.counts[channel] += counts[channel]
        stamps = [
            (info.start_time, info.end_time - 1)
            for info in self._reader.chunk_infos
            if info.connection_counts
        ] + [(index[0].time, index[-1].time) for index in self._reader.indexes.values() if index]
        stamps += [] if walked is None else walked.spans
        self.span_ns = (
            (min(low for low, _ in stamps), max(high for _, high in stamps)) if stamps else None
        )

    def _salvaged(self, path: Path, error: Exception, watch: Watch) -> Walked:
        """Read the chunks of a bag that has no index.

        Raises:
            RecordingError: nothing.
        """
        try:
            walked = self._reader.open_without_index(watch)
        except BROKEN as broken:
            raise RecordingError(f"ROS 1 bag cannot be read: {broken}", where=str(path)) from broken
        if not walked.counts:
            self._reader.close()
            raise RecordingError(
                f"ROS 1 bag cannot be read: {error}; and no chunk of it is whole enough to read",
                where=str(path),
                remedy="copy or record it again: nothing in it can be salvaged",
            ) from error
        self.integrity = "damaged"
        size = path.stat().st_size
        beyond = f"; nothing after byte {walked.stop:,} of {size:,}" if walked.stop < size else ""
        self.damage.append(
            Damage(
                f"no index ({error}): read chunk by chunk{beyond}; the number of lost messages is "
                "not known"
            )
        )
        return walked

    def _by_index(self) -> dict[int, Counter[int]]:
        """Count messages per chunk and channel by the bag's two indexes.

        A chunk on which they differ is walked.
        """
        counts = {position: Counter[int]() for position in self._reader.chunks}
        for channel, index in self._reader.indexes.items():
            for entry in index:
                counts[entry.chunk_pos][channel] += 1
        for info in self._reader.chunk_infos:
            claimed = Counter(info.connection_counts)
            if counts[info.pos] != claimed or claimed.keys() - self.channels.keys():
                self.notes.append(
                    f"chunk at byte {info.pos:,}: its indexes contradict each other: read message "
                    "by message"
                )
                try:
                    found, _ = walk(self._reader.inflated(info.pos))
                    counts[info.pos] = Counter({key: len(rows) for key, rows in found.items()})
                except BROKEN:  # said when it is read
                    counts[info.pos] |= claimed
        return counts

    def batches(self, channels: Collection[int]) -> Iterator[tuple[int, MessageBatch]]:
        """Yield the messages chunk by chunk, by what each holds, whatever the index says.

        A damaged chunk costs only its own messages.
        """
        wanted = set(channels)
        for position in sorted(self._reader.chunks):
            if position in self._places and not wanted & self._places[position][0].keys():
                continue
            counts = {key: self._counts[position][key] for key in sorted(self.channels)}
            try:
                data = self._reader.inflated(position)
            except BROKEN as error:
                lost = {key: count for key, count in counts.items() if count}
                self._damaged(f"chunk at byte {position:,} is lost: {error}", lost)
                continue
            found, cut = self._walked(position, data)
            for key, rows in found.items():
                if key in wanted:
                    yield key, _batch(data, rows)
                elif key not in self.channels:
                    what = f"{len(rows)} messages of connection {key}, which the bag never names"
                    self._damaged(f"chunk at byte {position:,}: {what}", {key: len(rows)})
            if cut is not None:
                fewer = {key: count - len(found.get(key, ())) for key, count in counts.items()}
                lost = {key: count for key, count in fewer.items() if count > 0}
                self._damaged(f"chunk at byte {position:,}: damaged at its byte {cut:,}", lost)

    def _walked(self, position: int, data: bytes) -> _Places:
        """Walk a chunk, or remember where its messages are."""
        if position in self._places:
            return self._places[position]
        found, cut = walk(data)
        places = {key: np.array(rows, np.int64) for key, rows in found.items()}
        self._room -= sum(map(len, places.values()))
        if self._room >= 0:
            self._places[position] = places, cut
        return places, cut

    def _damaged(self, what: str, messages: dict[int, int]) -> None:
        self.integrity = "damaged"
        if all(item.what != what for item in self.damage):
            self.damage.append(Damage(what, messages))

    def close(self) -> None:
        """Close the file."""
        self._reader.close()


def _batch(data: bytes, places: Ints) -> MessageBatch:
    """Build a batch of the messages at these places of a chunk."""
    start, stop, times = places.T
    return MessageBatch(np.frombuffer(data, np.uint8), start, stop, times, times)


CONTAINER = Container(
    name="ros1",
    endings=(".bag",),
    claims=lambda head: head.startswith(b"#ROSBAG V"),
    open=Ros1File,
    format="ros1",
    bag_format="ros1",
)
