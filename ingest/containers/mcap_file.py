"""Reads MCAP files a few chunks at a time; a damaged chunk costs only its own messages."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from restock.errors import RecordingError
from restock.ingest.containers import chunks, mcap_records
from restock.ingest.containers.chunks import BadChunk, FileBytes
from restock.ingest.containers.mcap_contents import ROSBAG2, Contents, resume, survey
from restock.ingest.containers.mcap_records import (
    LATEST_NS,
    MAGIC,
    PREFIX,
    Chunk,
    Definitions,
    Indexed,
    Op,
    Positions,
)
from restock.ingest.containers.storage import (
    NOT_KEPT,
    Container,
    Integrity,
    Metadata,
    Storage,
    Watch,
    custom_data,
    no_progress,
)
from restock.ingest.decoding.columns import Channel, MessageBatch

_Part: TypeAlias = tuple[Chunk, int, int]  # a chunk, its first byte in the buffer, its size
_Room: TypeAlias = tuple[Chunk, int, bytes | None]  # a chunk, its size, its content if it is cut


class ChunkReader:
    """Reads the chunks of one file. `cut` is the chunk that is cut short, if there is one."""

    def __init__(self, file: FileBytes, owner: Storage, cut: Chunk | None) -> None:
        self.walked: dict[int, Positions] = {}  # chunk.at -> messages of chunks that were walked
        self.verified = self.unchecked = 0  # chunks and data sections read, with and without a CRC
        self._file, self._owner, self._cut = file, owner, cut
        self._scratch = np.zeros(0, np.uint8)  # reused for every group

    def inflate(self, chunk: Chunk) -> bytes:
        """Return one chunk's records; empty if they cannot be read."""
        if chunk is self._cut:
            return chunks.inflate_partly(chunk, self._file)
        try:
            data = chunks.inflate(chunk, self._file[chunk.start : chunk.stop])
        except BadChunk as bad:
            self._record_loss(chunk, bad)
            return b""
        self._count_read(chunk)
        return data

    def _record_loss(self, chunk: Chunk, why: BadChunk) -> None:
        self._owner.damaged(f"chunk at byte {chunk.at:,} is lost: {why}", chunk.counts())

    def _count_read(self, chunk: Chunk) -> None:
        """Count a chunk as verified by its CRC, or as unchecked if it has none."""
        self.verified += bool(chunk.crc)
        self.unchecked += not chunk.crc

    def walk(self, chunk: Chunk) -> Positions:
        """Find a chunk's messages by walking it, and keep their positions."""
        if chunk.at not in self.walked:
            self.walked[chunk.at] = self._walk_part(chunk, self.inflate(chunk))
        return self.walked[chunk.at]

    def read(
        self, groups: Iterable[list[Chunk]], wanted: set[int]
    ) -> Iterator[tuple[int, MessageBatch]]:
        """Yield `wanted` channels' messages, group by group; each batch is valid until the next."""
        for group in groups:
            buffer, parts = self._inflate_group(group)
            whole = self._find_by_index(parts, buffer, wanted)
            located = (
                [whole] if whole is not None else [self._locate(p, buffer, wanted) for p in parts]
            )
            for channel in sorted(set().union(*located)):
                yield channel, _join([at[channel] for at in located if channel in at])
        self._scratch = np.zeros(0, np.uint8)  # free this memory: the file stays open

    def _find_by_index(
        self, parts: list[_Part], buffer: NDArray[np.uint8], wanted: set[int]
    ) -> dict[int, MessageBatch] | None:
        """Find messages of chunks by the chunks' indexes; None if one is missing or wrong."""
        entries: dict[int, list[Indexed]] = {}
        for chunk, base, size in parts:
            if not chunk.index or chunk.at in self.walked:
                return None
            for channel in chunk.index.keys() & wanted:
                start, stop = chunk.index[channel]
                one = Indexed(base, size, self._file[start:stop])
                entries.setdefault(channel, []).append(one)
        located = {}
        for channel, indexed in entries.items():
            messages = mcap_records.indexed_messages(buffer, indexed, channel)
            if messages is None:
                return None
            if len(messages):
                located[channel] = messages
        return located

    def _inflate_group(self, group: list[Chunk]) -> tuple[NDArray[np.uint8], list[_Part]]:
        """Decompress chunks into one buffer; leave out bad ones."""
        rooms: list[_Room] = []
        for chunk in group:
            if chunk is self._cut:
                held = chunks.inflate_partly(chunk, self._file)
                rooms.append((chunk, len(held), held))
                continue
            try:
                chunks.refuse_implausible(chunk)
                rooms.append((chunk, chunk.size, None))
            except BadChunk as bad:
                self._record_loss(chunk, bad)
        needed = sum(size for _, size, _ in rooms)
        if len(self._scratch) < needed:
            self._scratch = np.empty(needed, np.uint8)
        parts, at = list[_Part](), 0
        for chunk, size, torn in rooms:
            room = self._scratch[at : at + size]
            if torn is not None:
                room[:] = np.frombuffer(torn, np.uint8)
            else:
                try:
                    stored = self._file.large(chunk.start, chunk.stop)
                    chunks.inflate_into(chunk, stored, room)
                except BadChunk as bad:
                    self._record_loss(chunk, bad)
                    continue
                self._count_read(chunk)
            if size:
                parts.append((chunk, at, size))
                at += size
        return self._scratch[:at], parts

    def _locate(
        self, part: _Part, buffer: NDArray[np.uint8], wanted: set[int]
    ) -> dict[int, MessageBatch]:
        """Find a chunk's messages by its index, or by a walk if the index is missing or wrong."""
        located = self._find_by_index([part], buffer, wanted)
        if located is not None:
            return located
        chunk, base, size = part
        if chunk.index and chunk.at not in self.walked:
            self._owner.notes.append(
                f"chunk at byte {chunk.at:,}: its message index is wrong: read message by message"
            )
        positions = self._walk_part(chunk, buffer[base : base + size].data)
        return {
            channel: mcap_records.messages_at(buffer, at + base)
            for channel, at in positions.items()
            if channel in wanted
        }

    def _walk_part(self, chunk: Chunk, part: bytes | memoryview) -> Positions:
        if chunk.at in self.walked:
            return self.walked[chunk.at]
        positions, cut = mcap_records.walked_messages(part)
        if cut and chunk is not self._cut:
            self._owner.damaged(f"chunk at byte {chunk.at:,}: {cut}")
        return positions


def _join(parts: list[MessageBatch]) -> MessageBatch:
    """Join messages from several places of one buffer into one batch."""
    if len(parts) == 1:
        return parts[0]
    return MessageBatch(
        parts[0].buffer,
        np.concatenate([part.start for part in parts]),
        np.concatenate([part.stop for part in parts]),
        np.concatenate([part.log_time_ns for part in parts]),
        np.concatenate([part.publish_time_ns for part in parts]),
    )


GROUP_BYTES = 8 << 20  # of chunks read together: enough to amortise NumPy's calls


class McapFile(Storage):
    """An MCAP file, chunked or not, with or without summary, statistics and message index.

    `watch` is called with the progress of opening, which takes long if the file has no statistics
    and messages must be counted.

    Raises:
        RecordingError: it is not an MCAP file, or is cut short (unless `salvage`).
    """

    def __init__(self, path: Path, *, salvage: bool = False, watch: Watch = no_progress) -> None:
        super().__init__()
        self.path, self._watch = path, watch
        self._file = FileBytes(path)
        if self._file[: len(MAGIC)] != MAGIC:
            raise RecordingError("not an MCAP file: its first bytes are wrong", where=str(path))
        self._contents = survey(self._file, watch)
        for what in self._contents.damaged:
            self.damaged(what)
        self._refuse_cut(salvage)
        self.extras = self._contents.extras
        self.metadata = _metadata(self._contents, path, self.notes)
        if self._contents.unnamed:
            self.notes.append(f"{self._contents.unnamed:,} more attachments and metadata records")
        self._chunks = ChunkReader(self._file, self, self._contents.cut_chunk)
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
        self.damaged(what)
        for lost in resume(self._file, self._contents):
            self.damaged(lost)
        if self._contents.cut_chunk:
            self._contents.chunks.append(self._contents.cut_chunk)

    # -- contents ---------------------------------------------------------------------

    def _count(self) -> dict[int, int]:
        """Count messages per channel: from the statistics if there are any, else by walking chunks.

        Without statistics, only the walk reveals a missing message index.
        """
        contents = self._contents
        claimed = contents.claimed_counts()
        counts = contents.indexed_counts()
        if claimed is not None:
            if any(count > counts[number] for number, count in claimed.items()):
                contents.distrust_index()  # the index leaves messages out, so walk the chunks
                return claimed
            more = {number for number, count in counts.items() if count > claimed.get(number, 0)}
            if more:
                self.notes.append("its statistics count fewer messages than it holds")
            return {**claimed, **{number: counts[number] for number in more}}
        contents.distrust_index()
        counts = contents.indexed_counts()
        for done, chunk in enumerate(contents.chunks):
            self._watch("counting messages, chunks", done, len(contents.chunks))
            for number, positions in self._chunks.walk(chunk).items():
                counts[number] += len(positions)
        return counts

    def _channels(self) -> dict[int, Channel]:
        """Return the channels that the file defines.

        If the summary's CRC matches, its definitions are used. Otherwise the data's are used, and
        the summary's only for what the data does not define; a difference counts as damage.
        """
        contents, copies = self._contents, self._contents.copies
        needed = {channel for channel, count in self.counts.items() if count}
        proven = copies if contents.summary_proven else Definitions()
        known = contents.definitions.overridden_by(proven)
        for at, chunk in enumerate(contents.chunks):
            if not (lacking := known.lacking(needed)):
                break
            without_them = at and chunk.index and not lacking & chunk.index.keys()
            if without_them and not copies.lacking(lacking):
                continue  # the chunk has no message of the channels that are still to be defined
            records = self._chunks.inflate(chunk)
            known = mcap_records.definitions_in(records).overridden_by(known)
        if not contents.summary_proven:
            for what in known.differing(copies):
                self.damaged(
                    f"its summary and its data define {what} differently: the data's is used"
                )
            known = copies.overridden_by(known)
        for number in needed - known.channels.keys():
            what = f"{self.counts[number]} messages of channel {number}, which the file never names"
            self.damaged(what, {number: self.counts[number]})
        return known.named()

    def _span(self) -> tuple[int, int] | None:
        contents = self._contents
        # A chunk without messages has the span 0 to 0.
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
        """Return whether checksums confirm what was read so far."""
        if self.damage:
            return "damaged"
        read = self._chunks
        return "verified" if read.verified and not read.unchecked else "unverified"

    def _check_loose(self) -> None:
        """Check messages outside chunks with the CRC of the whole data section."""
        position, crc = self._contents.data_end
        if not crc:
            self._chunks.unchecked += 1
            return
        if self._file.crc(0, position) == crc:
            self._chunks.verified += 1
        else:
            self.damaged("the CRC of its data section does not match")

    # -- reading ---------------------------------------------------------------------------

    def batches(self, channels: Collection[int]) -> Iterator[tuple[int, MessageBatch]]:
        """Yield messages outside chunks first, then those in chunks.

        About 8 MiB are read at a time. A batch is valid until the next one: its buffer is reused.
        """
        wanted = set(channels)
        loose = wanted & self._contents.loose.keys()
        if loose:
            self._check_loose()
        yield from self._loose(loose)
        yield from self._chunks.read(self._groups(wanted), wanted)

    def _loose(self, channels: Collection[int]) -> Iterator[tuple[int, MessageBatch]]:
        """Yield channels' messages outside chunks, about 8 MiB of the file at a time."""
        places = {c: np.asarray(self._contents.loose[c], np.int64) for c in sorted(channels)}
        if not places:
            return
        end = max(int(at[-1]) for at in places.values()) + 1
        for start in range(min(int(at[0]) for at in places.values()), end, GROUP_BYTES):
            stop = start + GROUP_BYTES
            some = {
                channel: at[low:high]
                for channel, at in places.items()
                for low, high in [np.searchsorted(at, (start, stop)).tolist()]
                if low < high
            }
            ends = [_record_end(self._file, int(at[-1])) for at in some.values()]
            buffer = np.frombuffer(self._file[start : max(ends, default=start)], np.uint8)
            for channel, at in some.items():
                yield channel, mcap_records.messages_at(buffer, at - start)

    def _groups(self, wanted: set[int]) -> Iterator[list[Chunk]]:
        """Yield the chunks that contain these channels, in groups that grow to about 8 MiB.

        The first group is a single chunk, as some callers need only a few messages.
        """
        group: list[Chunk] = []
        size = most = 0
        for chunk in self._contents.chunks:
            known = self._chunks.walked.get(chunk.at, chunk.index)
            if known and not known.keys() & wanted:
                continue
            group.append(chunk)
            size += chunk.size
            if size >= most:
                yield group
                most = min(2 * size, GROUP_BYTES)
                group, size = [], 0
        if group:
            yield group

    def close(self) -> None:
        """Close the file; the arrays that were read from it stay valid."""
        self._contents.loose.clear()
        self._file.close()


def metadata_of(path: Path) -> list[Metadata] | None:
    """Return the metadata of an MCAP file, reading nothing else; None if it is cut short."""
    file = FileBytes(path)
    try:
        contents = survey(file, only=(Op.METADATA,))
    finally:
        file.close()
    return None if contents.cut else _metadata(contents, path, [])


def _metadata(contents: Contents, path: Path, notes: list[str]) -> list[Metadata]:
    """Return metadata records' entries and rosbag2's custom_data; add problems to `notes`."""
    kept, left_out = contents.metadata, contents.left_out
    try:
        custom, more = custom_data(contents.rosbag2, path.name, kept)
        kept, left_out = [*kept, custom], left_out + more
    except ValueError as problem:
        notes.append(f"its metadata record {ROSBAG2!r}: {problem}")
    if left_out:
        notes.append(f"{left_out:,} entries of its metadata: {NOT_KEPT}")
    return kept


def _record_end(file: FileBytes, at: int) -> int:
    return at + PREFIX + int.from_bytes(file[at + 1 : at + PREFIX], "little")


CONTAINER = Container(
    name="mcap",
    endings=(".mcap",),
    claims=lambda head: head.startswith(MAGIC),
    open=McapFile,
    format="mcap",
    bag_format="rosbag2-mcap",
)
