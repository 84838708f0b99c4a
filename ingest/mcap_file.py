"""MCAP: a file walked record by record, its chunks read whole.

The summary at a file's end is taken for what it says about channels and counts, never for where
things are: the walk over the data section is cheap (a few records a chunk) and finds all there is
in a file with a wrong summary, or none. See https://mcap.dev/spec.
"""

from __future__ import annotations

import mmap
import zlib
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.errors import RecordingError
from restock.ingest import mcap_chunk
from restock.ingest.columns import Batch
from restock.ingest.mcap_chunk import BadChunk, Chunk, Messages
from restock.ingest.mcap_records import MAGIC, PREFIX, Malformed, Op, parse, walk
from restock.ingest.storage import Channel, Damage, Integrity

GROUP_BYTES = 8 << 20  # of chunks decoded together: enough to amortise numpy's calls


@dataclass
class _Contents:
    """What the walk over the file found."""

    profile: str = ""
    chunks: list[Chunk] = field(default_factory=list)
    loose: dict[int, list[int]] = field(default_factory=dict)  # channel -> messages outside chunks
    schemas: dict[int, Any] = field(default_factory=dict)
    channels: dict[int, Any] = field(default_factory=dict)
    statistics: dict[str, Any] | None = None
    data_end: tuple[int, int] | None = None  # position and CRC of the data section
    cut: Malformed | None = None
    cut_chunk: Chunk | None = None


class McapFile:
    """One MCAP file, chunked or not, with or without summary, statistics and message index.

    Raises:
        RecordingError: no MCAP file, or cut short and not to be salvaged.
    """

    def __init__(self, path: Path, *, salvage: bool = False) -> None:
        self.path, self.salvage = path, salvage
        self.damage: list[Damage] = []
        self.notes: list[str] = []
        with path.open("rb") as file:
            self._file = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        if self._file[: len(MAGIC)] != MAGIC:
            raise RecordingError("not an MCAP file: its first bytes are wrong", where=str(path))
        self._buffer: NDArray[np.uint8] = np.frombuffer(self._file, np.uint8)
        self._contents = self._walk()
        self.profile = self._contents.profile
        self._walked: dict[int, dict[int, list[int]]] = {}  # chunk.at -> positions, if unindexed
        self._refuse_cut()
        self._unchecked = self._verified = 0  # chunks and loose sections that were read
        self.counts = self._count()
        self.channels = self._channels()
        self.span_ns = self._span()

    # -- what is there ---------------------------------------------------------------------

    def _walk(self) -> _Contents:
        contents = _Contents()
        end = len(self._file)
        finished = False
        try:
            for opcode, at, stop in walk(self._file, len(MAGIC), end):
                if opcode == Op.FOOTER:
                    finished = self._file[stop : stop + len(MAGIC)] == MAGIC
                    break
                try:
                    self._take(contents, opcode, at, stop)
                except Malformed as bad:
                    self._damaged(f"the record at byte {at - PREFIX:,} is damaged: {bad.what}", {})
        except Malformed as cut:
            contents.cut = cut
            contents.cut_chunk = self._cut_chunk(cut.at, end)
        if not finished and contents.cut is None:
            contents.cut = Malformed("its footer is missing", end)
        return contents

    def _take(self, contents: _Contents, opcode: int, at: int, stop: int) -> None:
        if opcode == Op.MESSAGE and stop - at >= mcap_chunk.HEAD_SIZE - PREFIX:
            channel = int.from_bytes(self._file[at : at + 2], "little")
            contents.loose.setdefault(channel, []).append(at - PREFIX)
        elif opcode == Op.CHUNK:
            contents.chunks.append(self._chunk(at, stop))
        elif opcode == Op.MESSAGE_INDEX and contents.chunks:
            index = parse(Op.MESSAGE_INDEX, self._file, at, stop)
            contents.chunks[-1].index[index["channel_id"]] = index["records"]
        elif opcode == Op.SCHEMA:
            schema = parse(Op.SCHEMA, self._file, at, stop)
            low, high = schema["data"]
            contents.schemas[schema["id"]] = {**schema, "data": self._file[low:high]}
        elif opcode == Op.CHANNEL:
            named = parse(Op.CHANNEL, self._file, at, stop)
            contents.channels[named["id"]] = named
        elif opcode == Op.STATISTICS:
            contents.statistics = parse(Op.STATISTICS, self._file, at, stop)
        elif opcode == Op.DATA_END:
            crc = parse(Op.DATA_END, self._file, at, stop)["data_section_crc"]
            contents.data_end = (at - PREFIX, crc)
        elif opcode == Op.HEADER and not contents.profile:
            contents.profile = parse(Op.HEADER, self._file, at, stop)["profile"]

    def _chunk(self, at: int, stop: int) -> Chunk:
        record = parse(Op.CHUNK, self._file, at, stop)
        return Chunk(
            at,
            record["records"][0],
            record["records"][1],
            record["uncompressed_size"],
            record["uncompressed_crc"],
            record["compression"],
            (record["message_start_time"], record["message_end_time"]),
        )

    def _cut_chunk(self, at: int, end: int) -> Chunk | None:
        """The chunk in which the file ends, with what there is of its records."""
        if at + PREFIX > end or self._file[at] != Op.CHUNK:
            return None
        head = self._file[at + PREFIX : end]
        with suppress(Malformed):
            # Its records field reaches beyond the file: read the fields before it.
            fields = parse_chunk_head(head)
            start = at + PREFIX + fields.pop("length")
            return Chunk(at, start, end, **fields)
        return None

    def _refuse_cut(self) -> None:
        cut = self._contents.cut
        if cut is None:
            return
        what = f"cut short or damaged at byte {cut.at:,} of {len(self._file):,}: {cut.what}"
        if not self.salvage:
            raise RecordingError(
                what, where=str(self.path), remedy="`--salvage` reads up to the last whole record"
            )
        self.damage.append(Damage(what))
        if self._contents.cut_chunk:
            self._contents.chunks.append(self._contents.cut_chunk)

    @property
    def integrity(self) -> Integrity:
        """Whether checksums vouch for what was read so far."""
        if self.damage:
            return "damaged"
        return "verified" if self._verified and not self._unchecked else "unverified"

    def _check_loose(self) -> None:
        """Messages outside chunks are vouched for by the CRC of the whole data section."""
        position, crc = self._contents.data_end or (0, 0)
        if not crc:
            self._unchecked += 1
        elif zlib.crc32(self._buffer[:position].data) == crc:
            self._verified += 1
        else:
            self._damaged("the CRC of its data section does not match", {})

    def _count(self) -> dict[int, int]:
        contents = self._contents
        found = {channel: len(positions) for channel, positions in contents.loose.items()}
        for chunk in contents.chunks:
            counts = chunk.counts() if chunk.indexed else self._walk_chunk(chunk)
            for channel, count in counts.items():
                found[channel] = found.get(channel, 0) + count
        if contents.statistics is None or contents.cut is not None:
            return found
        claimed: dict[int, int] = contents.statistics["channel_message_counts"]
        total = contents.statistics["message_count"]
        if sum(claimed.values()) != total:
            return found  # statistics without counts per channel (they are optional)
        if any(claimed.get(channel, 0) > count for channel, count in found.items()) or any(
            channel not in found and count for channel, count in claimed.items()
        ):
            # The index lists less than the statistics count: look into every chunk.
            found = {channel: len(positions) for channel, positions in contents.loose.items()}
            for chunk in contents.chunks:
                for channel, count in self._walk_chunk(chunk).items():
                    found[channel] = found.get(channel, 0) + count
        if any(count > claimed.get(channel, 0) for channel, count in found.items()):
            self.notes.append("its statistics count fewer messages than it holds")
        return {
            channel: max(found.get(channel, 0), claimed.get(channel, 0))
            for channel in found.keys() | claimed.keys()
        }

    def _walk_chunk(self, chunk: Chunk) -> dict[int, int]:
        """Counts per channel of a chunk that must be walked; remembers the positions."""
        if chunk.at not in self._walked:
            data = self._inflate(chunk)
            self._walked[chunk.at], cut = mcap_chunk.walked_messages(data, 0, len(data))
            if cut and chunk is not self._contents.cut_chunk:
                self._damaged(f"chunk at byte {chunk.at:,}: {cut.what}", {})
        return {channel: len(at) for channel, at in self._walked[chunk.at].items()}

    def _inflate(self, chunk: Chunk) -> bytes:
        if chunk is self._contents.cut_chunk:
            return mcap_chunk.inflate_what_is_there(chunk, self._file)
        try:
            data = mcap_chunk.inflate(chunk, self._file)
            self._verified += bool(chunk.crc)
            self._unchecked += not chunk.crc
            return data
        except BadChunk as bad:
            self._damaged(f"chunk at byte {chunk.at:,} is lost: {bad}", chunk.counts())
            return b""

    def _damaged(self, what: str, messages: dict[int, int]) -> None:
        if all(item.what != what for item in self.damage):
            self.damage.append(Damage(what, messages))

    def _channels(self) -> dict[int, Channel]:
        contents = self._contents
        needed = {channel for channel, count in self.counts.items() if count}
        schemas, channels = contents.schemas, contents.channels
        for chunk in contents.chunks:
            if needed <= channels.keys() and all(
                channels[channel]["schema_id"] in schemas.keys() | {0} for channel in needed
            ):
                break
            data = self._inflate(chunk)
            more_schemas, more_channels = mcap_chunk.definitions(data, 0, len(data))
            schemas = {**more_schemas, **schemas}
            channels = {**more_channels, **channels}
        found = {}
        for number, channel in channels.items():
            schema = schemas.get(channel["schema_id"], {})
            found[number] = Channel(
                number,
                channel["topic"],
                schema.get("name", ""),
                channel["message_encoding"],
                schema.get("encoding", ""),
                schema.get("data", b""),
            )
        for number in needed - found.keys():
            what = f"{self.counts[number]} messages of channel {number}, which the file never names"
            self._damaged(what, {number: self.counts[number]})
        return found

    def _span(self) -> tuple[int, int] | None:
        contents = self._contents
        spans = [c.span_ns for c in contents.chunks if any(c.counts().values())]
        for chunk in contents.chunks:
            if not chunk.indexed and any(self._walk_chunk(chunk).values()):
                spans.append(chunk.span_ns)
        for positions in contents.loose.values():
            stamps = mcap_chunk.messages_at(self._buffer, positions).log_time_ns
            spans.append((int(stamps.min()), int(stamps.max())))
        if not spans:
            return None
        return min(low for low, _ in spans), max(high for _, high in spans)

    # -- reading ---------------------------------------------------------------------------

    def batches(self, channels: Collection[int]) -> Iterator[tuple[int, Batch]]:
        """Loose messages first, then groups of chunks of about 8 MiB."""
        wanted = set(channels)
        loose = sorted(wanted & self._contents.loose.keys())
        if loose:
            self._check_loose()
        for channel in loose:
            found = mcap_chunk.messages_at(self._buffer, self._contents.loose[channel])
            yield channel, _batch(self._buffer, [found])
        for group in self._groups(wanted):
            yield from self._read_group(group, wanted)

    def _groups(self, wanted: set[int]) -> Iterator[list[Chunk]]:
        group: list[Chunk] = []
        size = 0
        for chunk in self._contents.chunks:
            if chunk.at in self._walked:
                has = self._walked[chunk.at].keys() & wanted
            else:
                has = chunk.index.keys() & wanted
            if not has and (chunk.indexed or chunk.at in self._walked):
                continue
            group.append(chunk)
            size += chunk.size
            if size >= GROUP_BYTES:
                yield group
                group, size = [], 0
        if group:
            yield group

    def _read_group(self, group: list[Chunk], wanted: set[int]) -> Iterator[tuple[int, Batch]]:
        parts = [self._inflate(chunk) for chunk in group]
        buffer = np.frombuffer(parts[0] if len(parts) == 1 else b"".join(parts), np.uint8)
        found: dict[int, list[Messages]] = {}
        base = 0
        for chunk, part in zip(group, parts, strict=True):
            if part:
                for channel, messages in self._locate(chunk, part, buffer, base, wanted):
                    if len(messages):
                        found.setdefault(channel, []).append(messages)
            base += len(part)
        for channel in sorted(found):
            yield channel, _batch(buffer, found[channel])

    def _locate(
        self, chunk: Chunk, part: bytes, buffer: NDArray[np.uint8], base: int, wanted: set[int]
    ) -> Iterator[tuple[int, Messages]]:
        if chunk.at not in self._walked:
            located = {}
            for channel, (start, stop) in chunk.index.items():
                if channel in wanted:
                    entries = self._file[start:stop]
                    located[channel] = mcap_chunk.indexed_messages(
                        buffer, base, len(part), entries, channel
                    )
            whole = {channel: at for channel, at in located.items() if at is not None}
            if len(whole) == len(located):
                yield from whole.items()
                return
            self.notes.append(f"chunk at byte {chunk.at:,}: its message index is wrong; walked")
            self._walk_chunk(chunk)
        for channel, positions in self._walked[chunk.at].items():
            if channel in wanted:
                at = np.asarray(positions, np.int64) + base
                yield channel, mcap_chunk.messages_at(buffer, at)

    def close(self) -> None:
        """Let go of the file; the arrays that were read from it stay valid."""
        self._contents.loose.clear()
        del self._buffer
        with suppress(BufferError):  # a batch still looks into it: closed when that goes
            self._file.close()


def parse_chunk_head(head: bytes) -> dict[str, Any]:
    """The fields of a chunk record before its records, and how many bytes they take."""
    if len(head) < 32:
        raise Malformed("cut within a chunk's first bytes", 0)
    compression_size = int.from_bytes(head[28:32], "little")
    length = 32 + compression_size + 8
    if length > len(head):
        raise Malformed("cut within a chunk's first bytes", 0)
    number = [int.from_bytes(head[at : at + 8], "little") for at in (0, 8, 16)]
    return {
        "length": length,
        "span_ns": (number[0], number[1]),
        "size": number[2],
        "crc": int.from_bytes(head[24:28], "little"),
        "compression": head[32 : 32 + compression_size].decode("utf-8", "backslashreplace"),
    }


def _batch(buffer: NDArray[np.uint8], parts: list[Messages]) -> Batch:
    return Batch(
        buffer,
        np.concatenate([part.start for part in parts]),
        np.concatenate([part.stop for part in parts]),
        np.concatenate([part.log_time_ns for part in parts]),
        np.concatenate([part.publish_time_ns for part in parts]),
    )
