"""ROS 1 bags: `rosbags` reads their index; each chunk is read once, in the order of the file."""

from __future__ import annotations

import bz2
import io
import struct
from collections.abc import Collection, Iterator
from pathlib import Path

import lz4.frame
import numpy as np
from rosbags.rosbag1 import Reader, ReaderError
from rosbags.rosbag1.reader import Chunk, Header, IndexData, RecordType

from restock.errors import RecordingError
from restock.ingest.containers.storage import Damage, Extra, Integrity
from restock.ingest.decoding.messages import Channel, MessageBatch

# A chunk's size is the file's claim: what decompresses to more than both is refused.
PLAUSIBLE_SIZE = 64 << 20
PLAUSIBLE_RATIO = 1000

_BROKEN = (
    *(ReaderError, AssertionError, ValueError, KeyError, IndexError, struct.error),
    *(OSError, EOFError, RuntimeError, OverflowError),
)


class Ros1File:
    """One ROS 1 bag of format 2.0, read only. The format has no checksums: never verified.

    Raises:
        RecordingError: it cannot be opened; a bag that was cut short has no index.
    """

    def __init__(self, path: Path) -> None:
        self.integrity: Integrity = "unverified"
        self.damage: list[Damage] = []
        self.notes: list[str] = []
        self.extras: list[Extra] = []
        self._reader = _Bag(path)
        try:
            self._reader.open()
        except _BROKEN as error:
            raise RecordingError(
                f"ROS 1 bag cannot be read: {error}",
                where=str(path),
                remedy="`rosbag reindex` repairs a bag whose recording was cut short",
            ) from error
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
        self.counts = {item.id: item.msgcount for item in self._reader.connections}
        stamps = [
            (index[0].time, index[-1].time) for index in self._reader.indexes.values() if index
        ]
        self.span_ns = (
            (min(low for low, _ in stamps), max(high for _, high in stamps)) if stamps else None
        )

    def batches(self, channels: Collection[int]) -> Iterator[tuple[int, MessageBatch]]:
        """Chunk by chunk; a chunk that is damaged costs only its own messages."""
        places: dict[int, dict[int, list[int]]] = {}  # chunk -> channel -> offsets in it
        for channel in channels:
            for entry in self._reader.indexes.get(channel, []):
                places.setdefault(entry.chunk_pos, {}).setdefault(channel, []).append(entry.offset)
        for position in sorted(places):
            wanted = places[position]
            try:
                data = self._reader.inflated(position)
                batches = [(channel, _batch(data, channel, at)) for channel, at in wanted.items()]
            except _BROKEN as error:
                self.integrity = "damaged"
                what = f"chunk at byte {position:,} is lost: {error}"
                counts = {channel: len(offsets) for channel, offsets in wanted.items()}
                self.damage.append(Damage(what, counts))
                continue
            yield from batches

    def close(self) -> None:
        """Close the file."""
        self._reader.close()


def _batch(data: bytes, channel: int, offsets: list[int]) -> MessageBatch:
    """The messages of one connection whose records are at these offsets of a chunk."""
    file = io.BytesIO(data)
    start, stop, stamps = list[int](), list[int](), list[int]()
    for offset in sorted(offsets):
        file.seek(offset)
        header = Header.read(file)
        while header.get_uint8("op") == RecordType.CONNECTION:  # some stand before their message
            file.seek(_uint32(file), io.SEEK_CUR)
            header = Header.read(file)
        if header.get_uint8("op") != RecordType.MSGDATA or header.get_uint32("conn") != channel:
            raise ReaderError("its index is wrong")
        length, at = _uint32(file), file.tell()
        if at + length > len(data):
            raise ReaderError("a message reaches beyond it")
        start.append(at)
        stop.append(at + length)
        stamps.append(header.get_time("time"))
    times = np.asarray(stamps, np.int64)
    bounds = np.asarray(start, np.int64), np.asarray(stop, np.int64)
    return MessageBatch(np.frombuffer(data, np.uint8), *bounds, times, times)


def _uint32(file: io.BytesIO) -> int:
    return int.from_bytes(file.read(4), "little")


class _Bag(Reader):
    """rosbags' reader, which trusts the sizes in a bag, with these checked."""

    def __init__(self, path: Path) -> None:
        super().__init__(_BoundedPath(path))  # type: ignore[arg-type]
        self._size = path.stat().st_size
        self._entries = 0
        self._chunks: dict[int, tuple[str, int]] = {}  # position -> compression, size inside

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

    def inflated(self, position: int) -> bytes:
        """A chunk's records."""
        assert self.bio
        chunk = self.chunks[position]
        compression, size = self._chunks[position]
        if chunk.datasize > self._size:
            raise ReaderError("it is longer than the bag")
        if size > max(PLAUSIBLE_SIZE, PLAUSIBLE_RATIO * chunk.datasize):
            raise ReaderError(f"{chunk.datasize:,} bytes that claim to hold {size:,}")
        self.bio.seek(chunk.datapos)
        stored = self.bio.read(chunk.datasize)
        if compression == "none":
            data = stored
        elif compression == "bz2":
            data = bz2.BZ2Decompressor().decompress(stored, max_length=size + 1)
        else:
            data = lz4.frame.LZ4FrameDecompressor().decompress(stored, max_length=size + 1)
        if len(data) != size:
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
