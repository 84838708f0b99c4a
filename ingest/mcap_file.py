"""MCAP files, read a few chunks at a time; a damaged chunk costs only its own messages."""

from __future__ import annotations

import mmap
import zlib
from collections.abc import Collection, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from restock.errors import RecordingError
from restock.ingest import mcap_chunk
from restock.ingest.columns import Batch
from restock.ingest.mapped import FORGET_BYTES, forget
from restock.ingest.mcap_chunk import LATEST_NS, BadChunk, Chunk, Indexed, Messages, Positions
from restock.ingest.mcap_contents import survey
from restock.ingest.mcap_records import MAGIC
from restock.ingest.mcap_salvage import resume
from restock.ingest.storage import Channel, Damage, Integrity

GROUP_BYTES = 8 << 20  # of chunks decoded together: enough to amortise numpy's calls

_Part: TypeAlias = tuple[Chunk, int, int]  # a chunk, and where it lies: first byte, bytes


class McapFile:
    """One MCAP file, chunked or not, with or without summary, statistics and message index.

    Raises:
        RecordingError: no MCAP file, or cut short and not to be salvaged.
    """

    def __init__(self, path: Path, *, salvage: bool = False) -> None:
        self.path = path
        self.damage: list[Damage] = []
        self.notes: list[str] = []
        self._unchecked = self._verified = 0  # chunks and data sections that were read
        with path.open("rb") as file:
            self._file = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        if self._file[: len(MAGIC)] != MAGIC:
            raise RecordingError("not an MCAP file: its first bytes are wrong", where=str(path))
        self._buffer: NDArray[np.uint8] = np.frombuffer(self._file, np.uint8)
        self._scratch = np.zeros(0, np.uint8)
        self._contents = survey(self._file)
        self.profile = self._contents.profile
        for what in self._contents.damaged:
            self._damaged(what, {})
        self._refuse_cut(salvage)
        self.extras = self._contents.extras
        if self._contents.unnamed:
            self.notes.append(f"{self._contents.unnamed:,} more attachments and metadata records")
        self._walked: dict[int, Positions] = {}  # chunk.at -> its messages, where there is no index
        self.counts = self._count()
        self.channels = self._channels()
        self.span_ns = self._span()

    def _refuse_cut(self, salvage: bool) -> None:
        cut = self._contents.cut
        if cut is None:
            return
        what = f"cut short or damaged at byte {cut.at:,} of {len(self._file):,}: {cut.what}"
        if not salvage:
            raise RecordingError(
                what, where=str(self.path), remedy="`--salvage` reads what can still be read of it"
            )
        self._damaged(what, {})
        for lost in resume(self._file, self._contents):
            self._damaged(lost, {})
        if self._contents.cut_chunk:
            self._contents.chunks.append(self._contents.cut_chunk)

    # -- what is there ---------------------------------------------------------------------

    def _count(self) -> dict[int, int]:
        """By the statistics where there are any, else by the index, else by walking chunks."""
        contents = self._contents
        claimed = contents.claimed_counts()
        found = contents.indexed_counts()
        if claimed is not None:
            indexed = all(chunk.index for chunk in contents.chunks)
            if indexed and any(count > found.get(number, 0) for number, count in claimed.items()):
                contents.distrust_index()  # it leaves messages out; look for them
                return claimed
            more = {number for number, count in found.items() if count > claimed.get(number, 0)}
            if more:
                self.notes.append("its statistics count fewer messages than it holds")
            return {**claimed, **{number: found[number] for number in more}}
        for chunk in contents.chunks:
            if not chunk.index:
                for number, positions in self._walk_chunk(chunk).items():
                    found[number] = found.get(number, 0) + len(positions)
        return found

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
        # A chunk without messages says 0 to 0.
        spans = [chunk.span_ns for chunk in contents.chunks if any(chunk.span_ns)]
        for _, messages in self._loose(contents.loose):
            stamps = messages.log_time_ns
            spans.append((int(stamps.min()), int(stamps.max())))
        if not spans or not any(self.counts.values()):
            return None
        low, high = min(low for low, _ in spans), max(high for _, high in spans)
        return min(low, LATEST_NS), min(high, LATEST_NS)

    # -- integrity -------------------------------------------------------------------------

    @property
    def integrity(self) -> Integrity:
        """Whether checksums vouch for what was read so far."""
        if self.damage:
            return "damaged"
        return "verified" if self._verified and not self._unchecked else "unverified"

    def _damaged(self, what: str, messages: dict[int, int]) -> None:
        if all(item.what != what for item in self.damage):
            self.damage.append(Damage(what, messages))

    def _check_loose(self) -> None:
        """Messages outside chunks are vouched for by the CRC of the whole data section."""
        position, crc = self._contents.data_end
        if not crc:
            self._unchecked += 1
            return
        found = 0
        for start in range(0, position, FORGET_BYTES):
            stop = min(start + FORGET_BYTES, position)
            found = zlib.crc32(self._buffer[start:stop].data, found)
            forget(self._file, start, stop)
        if found == crc:
            self._verified += 1
        else:
            self._damaged("the CRC of its data section does not match", {})

    def _inflate(self, chunk: Chunk) -> bytes:
        if chunk is self._contents.cut_chunk:
            return mcap_chunk.inflate_what_is_there(chunk, self._file)
        try:
            data = mcap_chunk.inflate(chunk, self._file)
        except BadChunk as bad:
            self._lost(chunk, bad)
            return b""
        self._count_checked(chunk)
        return data

    def _lost(self, chunk: Chunk, why: BadChunk) -> None:
        self._damaged(f"chunk at byte {chunk.at:,} is lost: {why}", chunk.counts())

    def _count_checked(self, chunk: Chunk) -> None:
        self._verified += bool(chunk.crc)
        self._unchecked += not chunk.crc

    # -- reading ---------------------------------------------------------------------------

    def batches(self, channels: Collection[int]) -> Iterator[tuple[int, Batch]]:
        """Loose messages first, then groups of chunks of about 8 MiB.

        A batch is valid until the next one is asked for: its buffer is used again.
        """
        wanted = set(channels)
        loose = wanted & self._contents.loose.keys()
        if loose:
            self._check_loose()
        for channel, found in self._loose(loose):
            yield channel, _batch(self._buffer, [found])
        for group in self._groups(wanted):
            yield from self._read_group(group, wanted)
            forget(self._file, group[0].at, group[-1].stop)

    def _loose(self, channels: Collection[int]) -> Iterator[tuple[int, Messages]]:
        """These channels' messages outside chunks, from about 8 MiB of the file at a time."""
        places = {c: np.asarray(self._contents.loose[c], np.int64) for c in sorted(channels)}
        if not places:
            return
        end = max(int(at[-1]) for at in places.values()) + 1
        for start in range(min(int(at[0]) for at in places.values()), end, GROUP_BYTES):
            stop = start + GROUP_BYTES
            for channel, at in places.items():
                low, high = np.searchsorted(at, (start, stop)).tolist()
                if low < high:
                    yield channel, mcap_chunk.messages_at(self._buffer, at[low:high])
            forget(self._file, start, stop)

    def _groups(self, wanted: set[int]) -> Iterator[list[Chunk]]:
        group: list[Chunk] = []
        size = 0
        for chunk in self._contents.chunks:
            known = self._walked.get(chunk.at, chunk.index)
            if known and not known.keys() & wanted:
                continue
            group.append(chunk)
            size += chunk.size
            if size >= GROUP_BYTES:
                yield group
                group, size = [], 0
        if group:
            yield group

    def _read_group(self, group: list[Chunk], wanted: set[int]) -> Iterator[tuple[int, Batch]]:
        buffer, parts = self._inflate_group(group)
        whole = self._by_index(parts, buffer, wanted)
        if whole is not None:
            for channel in sorted(whole):
                yield channel, _batch(buffer, [whole[channel]])
            return
        found: dict[int, list[Messages]] = {}
        for part in parts:
            for channel, messages in self._locate(part, buffer, wanted):
                if len(messages):
                    found.setdefault(channel, []).append(messages)
        for channel in sorted(found):
            yield channel, _batch(buffer, found[channel])

    def _by_index(
        self,
        parts: list[_Part],
        buffer: NDArray[np.uint8],
        wanted: set[int],
    ) -> dict[int, Messages] | None:
        """Where the messages of some chunks are, if the index of each says so, and rightly."""
        entries: dict[int, list[Indexed]] = {}
        for chunk, base, size in parts:
            if not chunk.index or chunk.at in self._walked:
                return None
            for channel in chunk.index.keys() & wanted:
                start, stop = chunk.index[channel]
                one = Indexed(base, size, self._file[start:stop])
                entries.setdefault(channel, []).append(one)
        found = {}
        for channel, indexed in entries.items():
            messages = mcap_chunk.indexed_messages(buffer, indexed, channel)
            if messages is None:
                return None
            if len(messages):
                found[channel] = messages
        return found

    def _inflate_group(self, group: list[Chunk]) -> tuple[NDArray[np.uint8], list[_Part]]:
        """What these chunks hold, in memory that is used again, and where; without bad ones."""
        cut = self._contents.cut_chunk
        torn = b""
        if cut is not None and cut in group:
            torn = mcap_chunk.inflate_what_is_there(cut, self._file)
        rooms = [
            (chunk, len(torn) if chunk is cut else chunk.size)
            for chunk in group
            if chunk is cut or self._plausible(chunk)
        ]
        size = sum(size for _, size in rooms)
        if len(self._scratch) < size:
            self._scratch = np.empty(size, np.uint8)
        parts = []
        at = 0
        for chunk, size in rooms:
            room = self._scratch[at : at + size]
            if chunk is cut:
                room[:] = np.frombuffer(torn, np.uint8)
            elif not self._inflate_into(chunk, room):
                continue
            if size:
                parts.append((chunk, at, size))
                at += size
        return self._scratch[:at], parts

    def _plausible(self, chunk: Chunk) -> bool:
        try:
            mcap_chunk.refuse_implausible(chunk)
        except BadChunk as bad:
            self._lost(chunk, bad)
            return False
        return True

    def _inflate_into(self, chunk: Chunk, room: NDArray[np.uint8]) -> bool:
        """Fill the room with the chunk's records, if they can be had."""
        try:
            mcap_chunk.inflate_into(chunk, self._file, room)
        except BadChunk as bad:
            self._lost(chunk, bad)
            return False
        self._count_checked(chunk)
        return True

    def _locate(
        self, part: _Part, buffer: NDArray[np.uint8], wanted: set[int]
    ) -> Iterator[tuple[int, Messages]]:
        chunk, base, size = part
        if chunk.index and chunk.at not in self._walked:
            located = {}
            for channel in chunk.index.keys() & wanted:
                start, stop = chunk.index[channel]
                one = Indexed(base, size, self._file[start:stop])
                located[channel] = mcap_chunk.indexed_messages(buffer, [one], channel)
            whole = {channel: at for channel, at in located.items() if at is not None}
            if len(whole) == len(located):
                yield from whole.items()
                return
            self.notes.append(f"chunk at byte {chunk.at:,}: its message index is wrong; walked")
        for channel, positions in self._walk_part(chunk, buffer[base : base + size].data).items():
            if channel in wanted:
                yield channel, mcap_chunk.messages_at(buffer, positions + base)

    def _walk_chunk(self, chunk: Chunk) -> Positions:
        """Where a chunk's messages are, by walking it; remembered, as it is needed again."""
        if chunk.at not in self._walked:
            self._walked[chunk.at] = self._walk_part(chunk, self._inflate(chunk))
        return self._walked[chunk.at]

    def _walk_part(self, chunk: Chunk, part: bytes | memoryview) -> Positions:
        if chunk.at in self._walked:
            return self._walked[chunk.at]
        positions, cut = mcap_chunk.walked_messages(part)
        if cut and chunk is not self._contents.cut_chunk:
            self._damaged(f"chunk at byte {chunk.at:,}: {cut}", {})
        return positions

    def close(self) -> None:
        """Let go of the file; the arrays that were read from it stay valid."""
        self._contents.loose.clear()
        del self._buffer
        with suppress(BufferError):  # a batch still looks into it: closed when that goes
            self._file.close()


def _batch(buffer: NDArray[np.uint8], parts: list[Messages]) -> Batch:
    return Batch(
        buffer,
        np.concatenate([part.start for part in parts]),
        np.concatenate([part.stop for part in parts]),
        np.concatenate([part.log_time_ns for part in parts]),
        np.concatenate([part.publish_time_ns for part in parts]),
    )
