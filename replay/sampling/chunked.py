"""Batches from a panel larger than memory: shuffled chunks through shuffle buffers, by quota.

A cold file read at random gives some ten thousand rows a second, in chunks of thousands of rows
some million. So each stratum's rows, in the order of the file, are cut into chunks; chunks are read
in shuffled order into the stratum's buffer, from which rows are drawn at random.

What an epoch is: a stratum's chunks are read once each, in an order drawn for every epoch, and
each row is drawn once; the buffer is drawn empty before the next epoch's first chunk is read. So
within a stratum any two rows' draws differ by at most one. Strata have epochs of their own: a
boosted one goes round more often. Quotas are exact in every batch, as everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F32, F64, Ints
from restock.errors import MixtureError
from restock.replay.sampling.packed_rows import RowFile
from restock.replay.sampling.rules import StratumDraws
from restock.replay.sampling.sampler import BlockSampler, Quotas

CHUNK_ROWS = 16_384
MEMORY_BYTES = 512 << 20


class ChunkedSampler(BlockSampler):
    """Exact quotas per batch over strata of a panel that need not fit in memory.

    Args:
        rows: `Panel.rows` (n, W), memory-mapped.
        stratum_rows: the row numbers of each stratum, S arrays (n_s,).
        shares: of each stratum, (S,), summing to 1.
        batch_size: rows per draw.
        rng: the generator of the draws; its state is part of `state_dict`.
        chunk_rows: read at a time; 4 to 64 thousand is fast.
        memory_bytes: of all buffers together. Strata that fit in their part are held whole.

    `draw` and `gather` go together: the rows of a batch are in the buffer, not in the panel.

    Raises:
        MixtureError: shares that are no distribution or on an empty stratum, or too little memory
            for buffers of two chunks.
        PanelError: `rows` is not memory-mapped.
    """

    def __init__(
        self,
        rows: F32,
        stratum_rows: Sequence[NDArray[Any]],
        shares: Sequence[float] | F64,
        batch_size: int,
        rng: np.random.Generator,
        *,
        chunk_rows: int = CHUNK_ROWS,
        memory_bytes: int = MEMORY_BYTES,
    ) -> None:
        members = [np.sort(np.asarray(rows, np.int64)) for rows in stratum_rows]
        sizes = np.array([len(rows) for rows in members], np.int64)
        self._file = RowFile(rows)
        row_bytes = 4 * self._file.width + 16  # with its number and its place in the order
        room = _share_out(sizes, memory_bytes // row_bytes)
        for stratum, (size, part) in enumerate(zip(sizes, room, strict=True)):
            if part < min(size, 2 * chunk_rows):
                raise MixtureError(
                    f"{memory_bytes:,} bytes leave stratum {stratum} a buffer of {part:,} rows,"
                    f" less than two chunks of {chunk_rows:,}",
                    remedy="give it more memory, or read in smaller chunks",
                )
        self._buffers = [
            _Buffer(self._file, numbers, part, chunk_rows)
            for numbers, part in zip(members, room.tolist(), strict=True)
        ]
        super().__init__(
            self._buffers,
            members,
            Quotas(shares, batch_size, sizes),
            rng,
            within=["chunked"] * len(members),
            block=1,
        )

    def _draw_block(self) -> None:
        for buffer in self._buffers:
            buffer.slots = buffer.slots[:0]
        super()._draw_block()

    def gather(self, out: F32) -> None:
        """Copy the packed rows of the batch last drawn into `out` (B, W)."""
        begin = 0
        for buffer in self._buffers:
            end = begin + len(buffer.slots)
            np.take(buffer.rows, buffer.slots, axis=0, out=out[begin:end], mode="clip")
            begin = end

    def close(self) -> None:
        """Close the panel's file."""
        self._file.close()


class _Buffer(StratumDraws):
    """A stratum's shuffle buffer: `capacity` rows, filled up a chunk at a time.

    `order` names the slots that hold rows to be drawn, the first `filled` of it, in random order;
    the slots behind are free.
    """

    SAME: ClassVar[tuple[str, ...]] = ("capacity", "chunk_rows")
    STATE: ClassVar[tuple[str, ...]] = ("places", "_order", "_filled", "_chunks", "_loaded")

    def __init__(self, file: RowFile, members: Ints, capacity: int, chunk_rows: int) -> None:
        self._file, self._members = file, members  # ascending
        self.capacity = capacity
        self.whole = capacity >= len(members)  # it is all in memory
        self.chunk_rows = chunk_rows
        self.rows: F32 = np.empty((capacity, file.width), np.float32)
        self.places: Ints = np.full(capacity, -1, np.int64)  # in the stratum, of each slot's row
        self.slots: Ints = np.empty(0, np.int64)  # of the batch last drawn
        self._order: Ints = np.arange(capacity)
        self._filled = 0
        self._chunks: Ints = np.empty(0, np.int64)  # of this epoch, still to be read
        self._loaded = False

    def draw(self, count: int, rng: np.random.Generator, batches: int) -> tuple[Ints, None]:
        """Draw rows that stay in their slots until the next draw."""
        # What one stratum has of a batch may be more than lies in its buffer.
        if count > self.chunk_rows:
            raise MixtureError(
                f"a batch takes {count:,} rows of a stratum, more than a chunk of"
                f" {self.chunk_rows:,}",
                remedy="read in larger chunks",
            )
        self.slots = self._take(count, rng)
        return self.places[self.slots], None

    def _take(self, count: int, rng: np.random.Generator) -> Ints:
        if self.whole:
            return self._take_whole(count, rng)
        if len(self._chunks) and self.capacity - self._filled >= self.chunk_rows:
            self._fill(self.capacity, rng)
        last = self._pop(min(count, self._filled))
        if len(last) == count:
            return last
        # The epoch ends within the batch. The slots just taken must not be overwritten yet.
        self._order = np.concatenate([self._order[len(last) :], last])
        self._chunks = rng.permutation(-(-len(self._members) // self.chunk_rows))
        self._fill(self.capacity - len(last), rng)
        return np.concatenate([last, self._pop(count - len(last))])

    def _pop(self, count: int) -> Ints:
        self._filled -= count
        return self._order[self._filled : self._filled + count].copy()

    def _take_whole(self, count: int, rng: np.random.Generator) -> Ints:
        if not self._loaded:
            self._file.read(self._members, self.rows)
            self.places[:] = np.arange(len(self._members))
            self._loaded = True
        parts = []
        while count:
            if self._filled == 0:
                rng.shuffle(self._order)
                self._filled = self.capacity
            some = min(count, self._filled)
            self._filled -= some
            parts.append(self._order[self._filled : self._filled + some].copy())
            count -= some
        return np.concatenate(parts)

    def _fill(self, upto: int, rng: np.random.Generator) -> None:
        """Read what fits of this epoch's chunks, and shuffle all that is to be drawn."""
        while len(self._chunks) and self._filled + len(places := self._chunk(0)) <= upto:
            members = self._members[places]
            slots = np.sort(self._order[self._filled : self._filled + len(members)])
            staged = np.empty((len(members), self.rows.shape[1]), np.float32)
            self._file.read(members, staged)
            self.rows[slots] = staged
            self.places[slots] = places
            self._order[self._filled : self._filled + len(members)] = slots
            self._filled += len(members)
            self._chunks = self._chunks[1:]
            if len(self._chunks):
                self._file.expect(self._members[self._chunk(0)])
        rng.shuffle(self._order[: self._filled])

    def _chunk(self, index: int) -> Ints:
        begin = int(self._chunks[index]) * self.chunk_rows
        return np.arange(begin, min(begin + self.chunk_rows, len(self._members)))

    def mismatch(self, name: str, value: Any) -> MixtureError:
        """Return the error for a saved state with another memory limit or other chunks."""
        return MixtureError(
            f"the saved buffer's {name} was {value}, this one's is {getattr(self, name)}",
            remedy="resume with the memory and the chunks the run began with",
        )

    def restored(self) -> None:
        """Read the buffer's rows again."""
        # Rows that were drawn already need not be read again.
        waiting = np.arange(self.capacity) if self.whole else self._order[: self._filled]
        waiting = waiting[self.places[waiting] >= 0]
        waiting = waiting[np.argsort(self.places[waiting], kind="stable")]
        for begin in range(0, len(waiting), self.chunk_rows):
            slots = waiting[begin : begin + self.chunk_rows]
            staged = np.empty((len(slots), self.rows.shape[1]), np.float32)
            self._file.read(self._members[self.places[slots]], staged)
            self.rows[slots] = staged


def _share_out(sizes: Ints, rows: int) -> Ints:
    """Return buffer sizes (S,) of strata of `sizes`: small ones whole, the others equal."""
    room = np.zeros(len(sizes), np.int64)
    left = rows
    for done, stratum in enumerate(np.argsort(sizes, kind="stable").tolist()):
        room[stratum] = min(int(sizes[stratum]), left // (len(sizes) - done))
        left -= int(room[stratum])
    return room
