"""MCAP's records: one table of their fields and one bounded parser. See https://mcap.dev/spec."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Iterator
from enum import IntEnum
from pathlib import Path
from typing import Any, TypeAlias, overload

from restock.errors import RecordingError

MAGIC = b"\x89MCAP0\r\n"
Buffer: TypeAlias = "bytes | FileBytes"
PREFIX = 9  # every record: opcode (1 byte), length of its content (8 bytes)


def _fastest_crc32() -> Callable[..., int]:
    """Return the fastest CRC-32 function: `isal`'s, nine times as fast, if it is installed."""
    try:
        from isal import isal_zlib
    except ImportError:
        return zlib.crc32
    fast: Callable[..., int] = isal_zlib.crc32
    return fast


crc32 = _fastest_crc32()  # (data, CRC of what came before = 0)


class FileBytes:
    """A file's bytes, read where they are asked for.

    It is not mapped into memory: where a file that is mapped shrinks, reading it kills the process.
    """

    WINDOW = 16 << 10  # bytes kept of the last small read: fields are read one by one
    PIECE = 8 << 20  # searched or checked at a time

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
        """Return a byte or a slice, as bytes do.

        Raises:
            RecordingError: the file is shorter than it was when it was opened.
        """
        if isinstance(key, int):
            if not 0 <= key < self._size:
                raise IndexError(key)
            return self._read(key, key + 1)[0]
        start, stop, _ = key.indices(self._size)
        return self._read(start, stop)

    def _read(self, start: int, stop: int) -> bytes:
        at = start - self._from
        if at >= 0 and stop - self._from <= len(self._window):
            return self._window[at : stop - self._from]
        if stop - start > self.WINDOW:
            return self._read_file(start, stop)
        self._window = self._read_file(start, min(start + self.WINDOW, self._size))
        self._from = start
        return self._window[: max(stop - start, 0)]

    def large(self, start: int, stop: int) -> bytes:
        """Read a large slice that is needed once; safe to call from several threads.

        Raises:
            RecordingError: the file is shorter than it was when it was opened.
        """
        return self._read_file(start, min(stop, self._size))

    def _read_file(self, start: int, stop: int) -> bytes:
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
        """Return where these bytes occur next, from `start` on; -1 if they do not."""
        for at in range(start, self._size, self.PIECE):
            found = self[at : at + self.PIECE + len(what) - 1].find(what)
            if found >= 0:
                return at + found
        return -1

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class Malformed(Exception):
    """A record that claims to hold more than there is. `at` is its position in the buffer."""

    def __init__(self, what: str, at: int) -> None:
        super().__init__(what)
        self.what, self.at = what, at


class Op(IntEnum):
    """Opcodes. Others are to be skipped."""

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


# name and kind of each field. "span32"/"span64"/"rest" are (start, stop) in the buffer: not copied.
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
        Malformed: a record has opcode 0, or ends beyond `stop`; whatever came before it was whole.
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
    """Parse the record whose content is buffer[start:stop]. Bytes after its fields are padding.

    Raises:
        Malformed: a field reaches beyond the record.
    """
    cursor = _Cursor(buffer, start, stop)
    return {name: cursor.read(kind) for name, kind in FIELDS[op]}


class _Cursor:
    """Reads fields one after the other, never beyond `stop`."""

    def __init__(self, buffer: Buffer, start: int, stop: int) -> None:
        self.buffer, self.position, self.stop = buffer, start, stop

    def read(self, kind: str) -> Any:
        if kind in ("B", "H", "I", "Q"):
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
        start, stop = self._span(struct.calcsize("<" + kind))
        return int.from_bytes(self.buffer[start:stop], "little")

    def _text(self) -> str:
        start, stop = self._span(self._number("I"))
        return bytes(self.buffer[start:stop]).decode("utf-8", errors="backslashreplace")

    def _span(self, length: int) -> tuple[int, int]:
        start = self.position
        if start + length > self.stop:
            raise Malformed(f"a field of {length:,} bytes reaches beyond its record", start)
        self.position = start + length
        return start, self.position
