"""Reads ROS 1 bags, chunk by chunk in file order.

One walk over the records outside chunks finds the chunks, and at the end of the file the
connections and the number of messages per chunk. The index's offsets of messages are not used. A
bag that was cut short lacks that end: its chunks, which also define the connections, are walked.
See http://wiki.ros.org/Bags/Format/2.0.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
from rosbags.rosbag1.reader import RecordType, normalize
from rosbags.typesys.msg import normalize_msgtype

from restock.arrays import Ints
from restock.errors import RecordingError
from restock.ingest.containers.chunks import (
    BadChunk,
    Buffer,
    FileBytes,
    StoredChunk,
    inflate,
    inflate_partly,
)
from restock.ingest.containers.storage import Container, Storage, Watch, no_progress
from restock.ingest.decoding.columns import Channel, MessageBatch

MAGIC = b"#ROSBAG V2.0\n"
MAX_HEADER = 64 << 10  # bytes of a record's header
INDEX_ENTRY = 12  # bytes per message in a chunk's index
# Limit in bytes of decompressed chunks kept: bz2 is slow, and proposals read topic by topic.
KEPT_BYTES = 128 << 20
# Number of messages whose positions are kept, 24 bytes each, so that their chunks are walked only
# once: a walk takes longer than decompression.
MAX_REMEMBERED = 1 << 20

_KNOWN = frozenset(map(int, RecordType))
Fields: TypeAlias = dict[bytes, bytes]  # of a record's header


class Walked(NamedTuple):
    """The contents of a chunk."""

    places: dict[int, Ints]  # connection -> start, stop and log time of its messages, (N, 3)
    cut: int | None  # offset of the damage
    connections: dict[int, tuple[Fields, Fields]]  # id -> header's fields, data's fields


def records(buffer: Buffer, start: int) -> Iterator[tuple[int, Fields, int, int]]:
    """Yield each record's position, header fields, and the start and stop of its data.

    The data of the last record may end beyond the buffer.
    """
    at, end = start, len(buffer)
    while at < end:
        data = at + 4 + int.from_bytes(buffer[at : at + 4], "little") + 4
        if data > min(end, at + MAX_HEADER):
            return
        stop = data + int.from_bytes(buffer[data - 4 : data], "little")
        yield at, fields_in(buffer[at + 4 : data - 4]), data, stop
        at = stop


def fields_in(header: bytes) -> Fields:
    """Parse `name=value` fields, each preceded by its length."""
    fields, at = Fields(), 0
    while at < len(header):
        stop = at + 4 + int.from_bytes(header[at : at + 4], "little")
        name, _, value = header[at + 4 : stop].partition(b"=")
        fields[name] = value
        at = stop
    return fields


def walk(data: bytes) -> Walked:
    """Find the messages of a chunk, and the connections that it defines."""
    rows: dict[int, list[tuple[int, int, int]]] = {}
    connections: dict[int, tuple[Fields, Fields]] = {}
    whole = 0  # end of the last whole record
    for _, fields, start, stop in records(data, 0):
        kind, time = _kind(fields), fields.get(b"time", b"")
        if stop > len(data) or kind not in (RecordType.MSGDATA, RecordType.CONNECTION):
            break
        connection = _number(fields, b"conn")
        if kind == RecordType.CONNECTION:
            connections.setdefault(connection, (fields, fields_in(data[start:stop])))
        elif len(time) == 8 and len(fields.get(b"conn", b"")) == 4:
            rows.setdefault(connection, []).append((start, stop, _time_ns(time)))
        else:
            break
        whole = stop
    places = {key: np.array(some, np.int64) for key, some in rows.items()}
    return Walked(places, whole if whole < len(data) else None, connections)


def _kind(fields: Fields) -> int:
    return _number(fields, b"op")


def _number(fields: Fields, name: bytes) -> int:
    return int.from_bytes(fields.get(name, b""), "little")


def _time_ns(time: bytes) -> int:
    seconds, nanoseconds = struct.unpack("<II", time)
    return int(seconds * 1_000_000_000 + nanoseconds)


class Ros1File(Storage):
    """A ROS 1 bag of format 2.0, read only. The format has no checksums, so it is never verified.

    Raises:
        RecordingError: it is not such a bag, or is cut short or damaged (unless `salvage`).
    """

    def __init__(self, path: Path, *, salvage: bool = False, watch: Watch = no_progress) -> None:
        super().__init__()
        self._file = FileBytes(path)
        self._chunks: dict[int, StoredChunk] = {}  # by position in the file
        # Chunk -> messages per connection: as claimed by the bag's index, and by the chunk's index.
        self._claimed: dict[int, Counter[int]] = {}
        self._indexed: dict[int, Counter[int]] = {}
        self._spans = list[tuple[int, int]]()
        self._index_at, self._expected = 0, (0, 0)  # index position; number of connections, chunks
        self._connections: dict[int, tuple[Fields, Fields]] = {}
        self._walks: dict[int, Walked] = {}
        self._room = MAX_REMEMBERED
        self._kept: dict[int, bytes] = {}
        try:
            self._open(salvage, watch)
        except BaseException:
            self.close()
            raise

    def _open(self, salvage: bool, watch: Watch) -> None:
        where = str(self._file.path)
        problem = self._survey(watch)
        if problem and not salvage:
            raise RecordingError(
                f"ROS 1 bag cannot be read: {problem}",
                where=where,
                remedy="`--salvage` reads what can still be read of it; or `rosbag reindex`"
                " repairs a bag whose recording was cut short",
            )
        if problem and not self._chunks:
            raise RecordingError(
                f"ROS 1 bag cannot be read: {problem}; and there is no chunk to read",
                where=where,
                remedy="copy or record it again: nothing in it can be salvaged",
            )
        if problem:
            self.damaged(
                f"{problem}: read chunk by chunk; the number of lost messages is not known"
            )
        self._counts = {}
        for done, at in enumerate(sorted(self._chunks)):
            watch("counting messages, chunks", done, len(self._chunks))
            self._counts[at] = self._count(at)
        self.channels = {key: _channel(key, *one) for key, one in self._connections.items()}
        self.counts = {
            key: sum(counts[key] for counts in self._counts.values()) for key in self.channels
        }
        lows, highs = zip(*self._spans, strict=True) if self._spans else ((), ())
        self.span_ns = (min(lows), max(highs)) if lows else None

    def _survey(self, watch: Watch) -> str | None:
        """Find chunks, counts and connections; return the problem if the bag is not whole."""
        file, end = self._file, len(self._file)
        if file[: len(MAGIC)] != MAGIC:
            return "it is not of format 2.0"
        cut = stop = self._take_records(len(MAGIC), watch)
        if stop < self._index_at < end:  # damaged, but the index at the end lists all chunks
            stop = self._take_records(self._index_at, watch)
            for at in sorted(one for one in self._claimed if cut <= one < self._index_at):
                place, fields, data, after = next(records(file, at), (at, Fields(), end, end))
                if cut <= at and after <= self._index_at and _kind(fields) == RecordType.CHUNK:
                    self._take_chunk(place, fields, data, after)
                    cut = after
                else:
                    what = f"chunk at byte {at:,} is lost: its record is damaged"
                    self.damaged(what, self._claimed[at])
        if stop < end or any(chunk.stop == end for chunk in self._chunks.values()):
            return f"no index; damaged, or cut short, at byte {stop:,} of {end:,}"
        whole = self._index_at and self._expected == (len(self._connections), len(self._claimed))
        return None if whole else "no index, or not all of it"

    def _take_records(self, start: int, watch: Watch) -> int:
        """Process records from `start` on; return where they stop, at damage or the file's end."""
        stop, chunk = start, -1
        for at, fields, data, after in records(self._file, start):
            watch("looking through the file, bytes", at, len(self._file))
            kind = _kind(fields)
            if kind == RecordType.CHUNK:
                self._take_chunk(chunk := at, fields, data, after)
            elif after > len(self._file) or kind not in _KNOWN:
                break
            elif kind == RecordType.BAGHEADER:
                self._index_at = _number(fields, b"index_pos")
                self._expected = _number(fields, b"conn_count"), _number(fields, b"chunk_count")
            elif kind == RecordType.IDXDATA and chunk >= 0:
                self._indexed[chunk][_number(fields, b"conn")] += (after - data) // INDEX_ENTRY
            elif kind == RecordType.CONNECTION:
                connection = fields, fields_in(self._file[data:after])
                self._connections[_number(fields, b"conn")] = connection
            elif kind == RecordType.CHUNK_INFO:
                self._take_info(fields, self._file[data:after])
            stop = min(after, len(self._file))
        return stop

    def _take_chunk(self, at: int, fields: Fields, data: int, after: int) -> None:
        form = fields.get(b"compression", b"").decode(errors="replace")
        size, stop = _number(fields, b"size"), min(after, len(self._file))
        self._chunks[at] = StoredChunk(at, data, stop, size, 0, "" if form == "none" else form)
        self._indexed[at] = Counter()

    def _take_info(self, fields: Fields, content: bytes) -> None:
        """Take in a chunk info record: the chunk's span, and pairs of connection and count."""
        pairs = np.frombuffer(content[: len(content) // 8 * 8], "<u4").reshape(-1, 2).tolist()
        self._claimed[_number(fields, b"chunk_pos")] = Counter(dict(pairs))
        low, high = (fields.get(name, b"") for name in (b"start_time", b"end_time"))
        if pairs and len(low) == len(high) == 8:
            self._spans.append((_time_ns(low), _time_ns(high)))

    def _count(self, at: int) -> Counter[int]:
        """Count a chunk's messages per connection; walk it unless the bag's counts agree."""
        claimed, indexed = self._claimed.get(at), self._indexed[at]
        if claimed is not None:
            if claimed == indexed and claimed.keys() <= self._connections.keys():
                return claimed
            self.notes.append(
                f"chunk at byte {at:,}: its index is damaged or wrong: read message by message"
            )
        try:
            walked = self._walk(at, self._inflate(at))
        except BadChunk:  # recorded as damage when the chunk is read
            return indexed | (claimed or Counter())
        for key, one in walked.connections.items():
            self._connections.setdefault(key, one)
        stamps = [column[:, 2] for column in walked.places.values()]
        self._spans += [(int(one.min()), int(one.max())) for one in stamps]
        return Counter({key: len(rows) for key, rows in walked.places.items()})

    def _inflate(self, at: int) -> bytes:
        """Decompress a chunk's records.

        Raises:
            BadChunk: they are damaged.
        """
        if at in self._kept:
            return self._kept[at]
        chunk = self._chunks[at]
        if chunk.stop == len(self._file):  # the file ends within it
            return inflate_partly(chunk, self._file)
        data = inflate(chunk, self._file.large(chunk.start, chunk.stop))
        if (
            chunk.compression == "bz2"
            and sum(map(len, self._kept.values())) + len(data) < KEPT_BYTES
        ):
            self._kept[at] = data
        return data

    def _walk(self, at: int, data: bytes) -> Walked:
        """Return a chunk's contents: cached, or from a walk."""
        if at not in self._walks:
            walked = walk(data)
            self._room -= sum(map(len, walked.places.values()))
            if self._room < 0:
                return walked
            self._walks[at] = walked
        return self._walks[at]

    def batches(self, channels: Collection[int]) -> Iterator[tuple[int, MessageBatch]]:
        """Yield the messages found by walking each chunk, whatever the index says.

        A damaged chunk costs only its own messages.
        """
        wanted = set(channels)
        for at in sorted(self._chunks):
            if at in self._walks and not wanted & self._walks[at].places.keys():
                continue
            counts = {key: self._counts[at][key] for key in sorted(self.channels)}
            try:
                data = self._inflate(at)
            except BadChunk as bad:
                lost = {key: count for key, count in counts.items() if count}
                self.damaged(f"chunk at byte {at:,} is lost: {bad}", lost)
                continue
            walked = self._walk(at, data)
            for key, places in walked.places.items():
                if key in wanted:
                    start, stop, times = places.T
                    buffer = np.frombuffer(data, np.uint8)
                    yield key, MessageBatch(buffer, start, stop, times, times)
                elif key not in self.channels:
                    what = f"{len(places)} messages of connection {key}, which the bag never names"
                    self.damaged(f"chunk at byte {at:,}: {what}", {key: len(places)})
            if walked.cut is not None:
                fewer = {key: n - len(walked.places.get(key, ())) for key, n in counts.items()}
                lost = {key: count for key, count in fewer.items() if count > 0}
                self.damaged(f"chunk at byte {at:,}: damaged at its byte {walked.cut:,}", lost)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _channel(number: int, outer: Fields, inner: Fields) -> Channel:
    """Build a channel from the fields of a connection record's header and data."""
    topic, kind = (
        one.decode(errors="replace") for one in (outer.get(b"topic", b""), inner.get(b"type", b""))
    )
    definition = inner.get(b"message_definition", b"")
    name = normalize(topic) if topic else ""
    return Channel(number, name, normalize_msgtype(kind), "ros1", "ros1msg", definition)


CONTAINER = Container(
    name="ros1",
    endings=(".bag",),
    claims=lambda head: head.startswith(b"#ROSBAG V"),
    open=Ros1File,
    format="ros1",
    bag_format="ros1",
)
