"""What a group of MCAP chunks holds: decompressed into memory that is used again, and located."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from restock.ingest.containers import mcap_chunk
from restock.ingest.containers.mcap_chunk import BadChunk, Chunk, Indexed, Messages, Positions
from restock.ingest.containers.mcap_records import FileBytes
from restock.ingest.containers.storage import Damage, Integrity
from restock.ingest.decoding.messages import MessageBatch

_Part: TypeAlias = tuple[Chunk, int, int]  # a chunk, and where it lies: first byte, bytes


@dataclass
class Checks:
    """The state of a file's integrity so far."""

    damage: list[Damage] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    verified: int = 0  # chunks and data sections that a CRC confirms
    unchecked: int = 0  # … that carry none

    @property
    def integrity(self) -> Integrity:
        """Whether checksums confirm what was read so far."""
        if self.damage:
            return "damaged"
        return "verified" if self.verified and not self.unchecked else "unverified"

    def damaged(self, what: str, messages: dict[int, int]) -> None:
        """Note damage, once."""
        if all(item.what != what for item in self.damage):
            self.damage.append(Damage(what, messages))

    def lost(self, chunk: Chunk, why: BadChunk) -> None:
        """A chunk that cannot be read."""
        self.damaged(f"chunk at byte {chunk.at:,} is lost: {why}", chunk.counts())

    def read(self, chunk: Chunk) -> None:
        """A chunk whose CRC matches, or that has none."""
        self.verified += bool(chunk.crc)
        self.unchecked += not chunk.crc


class ChunkReader:
    """Reads the chunks of one file. `cut` is the one in which the file ends, if it ends so."""

    def __init__(self, file: FileBytes, checks: Checks, cut: Chunk | None) -> None:
        self.walked: dict[int, Positions] = {}  # chunk.at -> its messages, where it has no index
        self._file, self._checks, self._cut = file, checks, cut
        self._scratch = np.zeros(0, np.uint8)

    def inflate(self, chunk: Chunk) -> bytes:
        """One chunk's records; nothing where they cannot be read."""
        if chunk is self._cut:
            return mcap_chunk.inflate_partly(chunk, self._file)
        try:
            data = mcap_chunk.inflate(chunk, self._file)
        except BadChunk as bad:
            self._checks.lost(chunk, bad)
            return b""
        self._checks.read(chunk)
        return data

    def walk(self, chunk: Chunk) -> Positions:
        """Where a chunk's messages are, by walking it; remembered, as it is needed again."""
        if chunk.at not in self.walked:
            self.walked[chunk.at] = self._walk_part(chunk, self.inflate(chunk))
        return self.walked[chunk.at]

    def read(self, group: list[Chunk], wanted: set[int]) -> Iterator[tuple[int, MessageBatch]]:
        """The messages of these channels in some chunks; a batch is valid until the next."""
        buffer, parts = self._inflate_group(group)
        whole = self._by_index(parts, buffer, wanted)
        located = [whole] if whole is not None else [self._locate(p, buffer, wanted) for p in parts]
        for channel in sorted(set().union(*located)):
            yield channel, batch_of(buffer, [at[channel] for at in located if channel in at])

    def _by_index(
        self,
        parts: list[_Part],
        buffer: NDArray[np.uint8],
        wanted: set[int],
    ) -> dict[int, Messages] | None:
        """Where the messages of some chunks are, by their indexes; None where one is wrong."""
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
            messages = mcap_chunk.indexed_messages(buffer, indexed, channel)
            if messages is None:
                return None
            if len(messages):
                located[channel] = messages
        return located

    def _inflate_group(self, group: list[Chunk]) -> tuple[NDArray[np.uint8], list[_Part]]:
        """What these chunks hold, in memory that is used again, and where; without bad ones."""
        cut, torn = self._cut, b""
        if cut is not None and cut in group:
            torn = mcap_chunk.inflate_partly(cut, self._file)
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
            self._checks.lost(chunk, bad)
            return False
        return True

    def _inflate_into(self, chunk: Chunk, room: NDArray[np.uint8]) -> bool:
        """Fill the room with the chunk's records, if they can be read."""
        try:
            mcap_chunk.inflate_into(chunk, self._file, room)
        except BadChunk as bad:
            self._checks.lost(chunk, bad)
            return False
        self._checks.read(chunk)
        return True

    def _locate(
        self, part: _Part, buffer: NDArray[np.uint8], wanted: set[int]
    ) -> dict[int, Messages]:
        """Where a chunk's messages are: by its index, or by walking it where that is wrong."""
        located = self._by_index([part], buffer, wanted)
        if located is not None:
            return located
        chunk, base, size = part
        if chunk.index and chunk.at not in self.walked:
            self._checks.notes.append(
                f"chunk at byte {chunk.at:,}: its message index is wrong; walked"
            )
        positions = self._walk_part(chunk, buffer[base : base + size].data)
        return {
            channel: mcap_chunk.messages_at(buffer, at + base)
            for channel, at in positions.items()
            if channel in wanted
        }

    def _walk_part(self, chunk: Chunk, part: bytes | memoryview) -> Positions:
        if chunk.at in self.walked:
            return self.walked[chunk.at]
        positions, cut = mcap_chunk.walked_messages(part)
        if cut and chunk is not self._cut:
            self._checks.damaged(f"chunk at byte {chunk.at:,}: {cut}", {})
        return positions


def batch_of(buffer: NDArray[np.uint8], parts: list[Messages]) -> MessageBatch:
    """Messages from several places of one buffer, as one batch."""
    return MessageBatch(
        buffer,
        np.concatenate([part.start for part in parts]),
        np.concatenate([part.stop for part in parts]),
        np.concatenate([part.log_time_ns for part in parts]),
        np.concatenate([part.publish_time_ns for part in parts]),
    )
