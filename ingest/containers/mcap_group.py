"""What a group of MCAP chunks holds: decompressed into memory that is used again, and located."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from itertools import cycle
from typing import ClassVar, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from restock.ingest.containers.formats import mcap_chunk
from restock.ingest.containers.formats.mcap_chunk import (
    BadChunk,
    Chunk,
    Indexed,
    Messages,
    Positions,
)
from restock.ingest.containers.formats.mcap_records import FileBytes
from restock.ingest.containers.storage import Damage, Integrity
from restock.ingest.decoding.messages import MessageBatch

_Part: TypeAlias = tuple[Chunk, int, int]  # a chunk, and where it lies: first byte, bytes
_Room: TypeAlias = tuple[Chunk, int, bytes | None]  # its bytes; of the cut one, what it still holds
_Outcome: TypeAlias = tuple[Chunk, BadChunk | None]  # what is wrong with it

AHEAD = 1  # groups that are decompressed, each on a thread, while the one before is decoded


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


class _Inflated(NamedTuple):
    """What some chunks hold, where each lies in it, and what became of each."""

    buffer: NDArray[np.uint8]
    parts: list[_Part]
    outcomes: list[_Outcome]


class ChunkReader:
    """Reads the chunks of one file. `cut` is the one in which the file ends, if it ends so.

    `ahead` is of the process: one that reads recordings beside others of its kind sets it False.
    """

    ahead: ClassVar[bool] = True

    def __init__(self, file: FileBytes, checks: Checks, cut: Chunk | None) -> None:
        self.walked: dict[int, Positions] = {}  # chunk.at -> its messages, where it has no index
        self._file, self._checks, self._cut = file, checks, cut
        self._scratch = _no_scratch()

    def inflate(self, chunk: Chunk) -> bytes:
        """One chunk's records; nothing where they cannot be read."""
        if chunk is self._cut:
            return mcap_chunk.inflate_partly(chunk, self._file)
        try:
            data = mcap_chunk.inflate(chunk, self._file[chunk.start : chunk.stop])
        except BadChunk as bad:
            self._checks.lost(chunk, bad)
            return b""
        self._checks.read(chunk)
        return data

    def begin_in(self, chunk: Chunk, channels: set[int]) -> tuple[set[int], bytes]:
        """Return which of these channels have messages in a chunk, as far as that is known without
        walking it, and its records before the first messages of all of them: unchecked."""
        if walked := self.walked.get(chunk.at):
            first = {n: int(walked[n].min()) for n in walked.keys() & channels}
        else:
            held = {n for n, count in chunk.counts().items() if count} & channels
            first = {n: mcap_chunk.first_offset(self._file[slice(*chunk.index[n])]) for n in held}
        if not first:
            return set(), b""
        return {*first}, mcap_chunk.inflate_partly(chunk, self._file, max(first.values()))

    def walk(self, chunk: Chunk) -> Positions:
        """Where a chunk's messages are, by walking it; remembered, as it is needed again."""
        if chunk.at not in self.walked:
            self.walked[chunk.at] = self._walk_part(chunk, self.inflate(chunk))
        return self.walked[chunk.at]

    def read(
        self, groups: Iterable[list[Chunk]], wanted: set[int], *, ahead: bool = False
    ) -> Iterator[tuple[int, MessageBatch]]:
        """The messages of these channels, group by group; a batch is valid until the next.

        With `ahead`, another thread reads and decompresses the next group meanwhile; what is wrong
        with it is noted, or raised, in its turn.
        """
        works = (partial(self._inflate_group, *self._plausible(group)) for group in groups)
        for inflated in _ahead(works) if ahead else (work(0) for work in works):
            for chunk, bad in inflated.outcomes:
                if bad is None:
                    self._checks.read(chunk)
                else:
                    self._checks.lost(chunk, bad)
            yield from self._messages(inflated.buffer, inflated.parts, wanted)
        self._scratch = _no_scratch()  # the file stays open while rows are made

    def _messages(
        self, buffer: NDArray[np.uint8], parts: list[_Part], wanted: set[int]
    ) -> Iterator[tuple[int, MessageBatch]]:
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

    def _plausible(self, group: list[Chunk]) -> tuple[list[_Room], list[_Outcome]]:
        """The room that these chunks need, and which are refused."""
        rooms: list[_Room] = []
        refused: list[_Outcome] = []
        for chunk in group:
            if chunk is self._cut:
                torn = mcap_chunk.inflate_partly(chunk, self._file)
                rooms.append((chunk, len(torn), torn))
                continue
            try:
                mcap_chunk.refuse_implausible(chunk)
            except BadChunk as bad:
                refused.append((chunk, bad))
            else:
                rooms.append((chunk, chunk.size, None))
        return rooms, refused

    def _inflate_group(self, rooms: list[_Room], refused: list[_Outcome], place: int) -> _Inflated:
        """What these chunks hold, in one of the memories that are used again; without bad ones."""
        needed = sum(size for _, size, _ in rooms)
        if len(self._scratch[place]) < needed:
            self._scratch[place] = np.empty(needed, np.uint8)
        scratch, outcomes = self._scratch[place], [*refused]
        parts: list[_Part] = []
        at = 0
        for chunk, size, torn in rooms:
            room = scratch[at : at + size]
            if torn is not None:
                room[:] = np.frombuffer(torn, np.uint8)
            else:
                try:
                    stored = self._file.large(chunk.start, chunk.stop)
                    mcap_chunk.inflate_into(chunk, stored, room)
                except BadChunk as bad:
                    outcomes.append((chunk, bad))
                    continue
                outcomes.append((chunk, None))
            if size:
                parts.append((chunk, at, size))
                at += size
        return _Inflated(scratch[:at], parts, outcomes)

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


def _no_scratch() -> list[NDArray[np.uint8]]:
    return [np.zeros(0, np.uint8) for _ in range(AHEAD + 1)]


def _ahead(works: Iterable[Callable[[int], _Inflated]]) -> Iterator[_Inflated]:
    """What these works give, in their order: the next AHEAD are done while one is used. Each gets
    the number of a memory that no other of them has."""
    pool = ThreadPoolExecutor(AHEAD, thread_name_prefix="inflate")
    waiting: deque[Future[_Inflated]] = deque()
    try:
        for place, work in zip(cycle(range(AHEAD + 1)), works):
            waiting.append(pool.submit(work, place))
            if len(waiting) > AHEAD:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


def batch_of(buffer: NDArray[np.uint8], parts: list[Messages]) -> MessageBatch:
    """Messages from several places of one buffer, as one batch."""
    return MessageBatch(
        buffer,
        np.concatenate([part.start for part in parts]),
        np.concatenate([part.stop for part in parts]),
        np.concatenate([part.log_time_ns for part in parts]),
        np.concatenate([part.publish_time_ns for part in parts]),
    )
