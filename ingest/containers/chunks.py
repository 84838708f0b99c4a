"""Reads a file's bytes and compressed chunks, within limits whatever the file claims."""

from __future__ import annotations

import bz2
import os
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias, overload

import lz4.frame
import numpy as np
import zstandard
from numpy.typing import NDArray

from restock.errors import RecordingError
from restock.ingest.containers.storage import max_plausible_bytes

Buffer: TypeAlias = "bytes | FileBytes"


def _fastest_crc32() -> Callable[..., int]:
    """Return the fastest CRC-32 function: `isal`'s, nine times as fast, if it is installed."""
    try:
        from isal import isal_zlib
    except ImportError:
        return zlib.crc32
    fast: Callable[..., int] = isal_zlib.crc32
    return fast


crc32 = _fastest_crc32()  # arguments: data, and the CRC of the data before it (default: 0)


class FileBytes:
    """A file's bytes, read on access.

    It is not mapped into memory: if a mapped file shrinks, reading it kills the process.
    """

    WINDOW = 16 << 10  # bytes read at least, as callers read field by field
    PIECE = 8 << 20  # bytes searched or checked at a time

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = path.open("rb", buffering=0)
        self._size = path.stat().st_size
        self._window, self._from = b"", 0

    def __len__(self) -> int:
        return self._size

    @overload
    def __getitem__(self, key: int) -> int: ...
    @overload
    def __getitem__(self, key: slice) -> bytes: ...
    def __getitem__(self, key: int | slice) -> int | bytes:
        """Return the byte at an index, or the bytes of a slice, as `bytes` does.

        Raises:
            RecordingError: the file is shorter than it was when it was opened.
        """
        if isinstance(key, int):
            if not 0 <= key < self._size:
                raise IndexError(key)
            return self._read(key, key + 1)[0]
        start, stop = key.start or 0, key.stop
        at = start - self._from
        if at >= 0 and stop is not None and start <= stop <= self._from + len(self._window):
            return self._window[at : stop - self._from]
        return self._read(*key.indices(self._size)[:2])

    def _read(self, start: int, stop: int) -> bytes:
        if stop - start > self.WINDOW:
            return self.large(start, stop)
        self._window = self.large(start, start + self.WINDOW)
        self._from = start
        return self._window[: max(stop - start, 0)]

    def large(self, start: int, stop: int) -> bytes:
        """Read a large slice that is needed once.

        Raises:
            RecordingError: the file is shorter than it was when it was opened.
        """
        stop = min(stop, self._size)
        parts, left = list[bytes](), stop - start
        while left > 0:
            part = os.pread(self._file.fileno(), left, stop - left)
            if not part:
                raise RecordingError(
                    f"it shrank while it was read: it had {self._size:,} bytes when it was "
                    f"opened, and has {self.path.stat().st_size:,} now",
                    where=str(self.path),
                    remedy="read it when nothing writes to it, or read a copy",
                )
            parts.append(part)
            left -= len(part)
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def crc(self, start: int, stop: int) -> int:
        """Return the CRC-32 of the bytes from `start` to `stop`."""
        crc = 0
        for at in range(start, stop, self.PIECE):
            crc = crc32(self[at : min(at + self.PIECE, stop)], crc)
        return crc

    def find(self, what: bytes, start: int) -> int:
        """Return the position of the next occurrence from `start` on; -1 if there is none."""
        for at in range(start, self._size, self.PIECE):
            found = self[at : at + self.PIECE + len(what) - 1].find(what)
            if found >= 0:
                return at + found
        return -1

    def close(self) -> None:
        """Close the file."""
        self._file.close()


# Limit of the uncompressed size that a chunk may claim, checked before memory is allocated.
MAX_CHUNK = 4 << 30
STEP = 1 << 12  # bytes of damaged data decompressed at a time: only data near the damage is lost

_DECODERS: dict[str, Callable[[], Any]] = {
    "zstd": lambda: zstandard.ZstdDecompressor().decompressobj(),
    "lz4": lz4.frame.LZ4FrameDecompressor,
    "bz2": bz2.BZ2Decompressor,
}
_DAMAGED = (zstandard.ZstdError, RuntimeError, EOFError, OSError)


class BadChunk(Exception):
    """A chunk whose content cannot be read."""


@dataclass(frozen=True)
class StoredChunk:
    """The position of a chunk in the file, and what its record claims."""

    at: int  # position of its record
    start: int  # position of its (compressed) content
    stop: int
    size: int  # bytes, uncompressed
    crc: int  # of the uncompressed records; 0: unchecked
    compression: str  # "" for none


def refuse_implausible(chunk: StoredChunk) -> None:
    """Check the uncompressed size that a chunk claims, before memory for it is allocated.

    Raises:
        BadChunk: its stored bytes cannot hold that much.
    """
    stored = chunk.stop - chunk.start
    if chunk.size > min(max_plausible_bytes(stored), MAX_CHUNK):
        raise BadChunk(f"{stored:,} bytes that claim to hold {chunk.size:,}")


def inflate(chunk: StoredChunk, stored: bytes) -> bytes:
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


def inflate_into(chunk: StoredChunk, stored: bytes, room: NDArray[np.uint8]) -> None:
    """Decompress a chunk into memory of its size, `room`: reusing that is faster than allocating.

    Raises:
        BadChunk: as `inflate`.
    """
    if chunk.compression == "zstd" and _unpack(stored, room):
        _check(chunk, room.data)
    else:  # `inflate` raises with the reason if the chunk is bad
        room[:] = np.frombuffer(inflate(chunk, stored), np.uint8)


def _unpack(stored: bytes, room: NDArray[np.uint8]) -> bool:
    """Decompress zstd data into `room`; return whether it fills it exactly."""
    try:
        with zstandard.ZstdDecompressor().stream_reader(stored) as reader:
            at = 0
            while at < len(room) and (count := reader.readinto(room.data[at:])):
                at += count
            return at == len(room) and not reader.read(1)
    except zstandard.ZstdError:
        return False


def _check(chunk: StoredChunk, data: bytes | memoryview) -> None:
    if chunk.crc and crc32(data) != chunk.crc:
        raise BadChunk("its CRC does not match")


def inflate_partly(chunk: StoredChunk, file: Buffer) -> bytes:
    """Return a damaged chunk's records up to the damage, without a check of their CRC."""
    limit = min(MAX_CHUNK, chunk.size, max_plausible_bytes(chunk.stop - chunk.start))
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
        if compression in _DECODERS:
            data: bytes = _DECODERS[compression]().decompress(stored, max_length=size + 1)
            return data
    except _DAMAGED as error:
        raise BadChunk(f"its {compression} data is damaged ({error})") from error
    raise BadChunk(f"compression {compression!r} is not supported")
