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
from restock.replay.sampling.quotas import Quotas
from restock.replay.sampling.row_file import RowFile
from restock.replay.sampling.sampler import another_sampler
from restock.state import Stateful

CHUNK_ROWS = 16_384
MEMORY_BYTES = 512 << 20


class ChunkedSampler(Stateful):
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

    SAME: ClassVar[tuple[str, ...]] = ("sizes",)
    STATE: ClassVar[tuple[str, ...]] = ("quotas", "rng", "buffers")

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
        if len(stratum_rows) != len(shares):
            raise MixtureError(f"{len(stratum_rows)} strata but {len(shares)} shares")
        if chunk_rows < 1:
            raise MixtureError(f"chunk_rows must be at least 1, got {chunk_rows}")
        self.sizes: Ints = np.array([len(members) for members in stratum_rows], np.int64)
        self.quotas = Quotas(shares, batch_size, self.sizes)
        self.rng = rng
        self._file = RowFile(rows)
        row_bytes = 4 * self._file.width + 16  # with its number and its place in the order
        room = _share_out(self.sizes, memory_bytes // row_bytes)
        for stratum, (size, part) in enumerate(zip(self.sizes, room, strict=True)):
            if part < min(size, 2 * chunk_rows):
                raise MixtureError(
                    f"{memory_bytes:,} bytes leave stratum {stratum} a buffer of {part:,} rows,"
                    f" less than two chunks of {chunk_rows:,}",
                    remedy="give it more memory, or read in smaller chunks",
                )
        self.buffers = [
            _Buffer(self._file, np.sort(np.asarray(members, np.int64)), part, chunk_rows)
            for members, part in zip(stratum_rows, room.tolist(), strict=True)
        ]
        self._slots: list[tuple[_Buffer, Ints]] = []  # of the batch last drawn

    @property
    def batch_size(self) -> int:
        return self.quotas.batch_size

    @property
    def shares(self) -> F64:
        return self.quotas.shares

    @property
    def drawn_weights(self) -> F32 | None:
        """Importance weights that the batch last drawn needs: none, its rows are drawn alike."""
        return None

    def draw(self) -> tuple[Ints, Ints]:
        """Row numbers (B,) and the stratum of each (B,), strata in order."""
        quota = self.quotas.next()
        self._slots = []
        parts = []
        for stratum in np.flatnonzero(quota).tolist():
            buffer, left = self.buffers[stratum], int(quota[stratum])
            # What one stratum has of a batch may be more than lies in its buffer.
            if left > buffer.chunk_rows:
                raise MixtureError(
                    f"a batch takes {left:,} rows of stratum {stratum}, more than a chunk of"
                    f" {buffer.chunk_rows:,}",
                    remedy="read in larger chunks",
                )
            slots = buffer.take(left, self.rng)
            parts.append(buffer.numbers[slots])
            self._slots.append((buffer, slots))
        return np.concatenate(parts), np.repeat(np.arange(len(quota)), quota)

    def gather(self, out: F32) -> None:
        """The packed rows of the batch last drawn into `out` (B, W)."""
        begin = 0
        for buffer, slots in self._slots:
            np.take(buffer.rows, slots, axis=0, out=out[begin : begin + len(slots)], mode="clip")
            begin += len(slots)

    def update(self, rows: Ints, td_abs: NDArray[Any]) -> None:
        """|TD error| (n,) of rows (n,) that were just learnt from: changes nothing here."""

    def set_shares(self, shares: Sequence[float] | F64) -> None:
        """Other shares (S,) from the next batch on.

        Raises:
            MixtureError: shares that are no distribution, or a share on an empty stratum.
        """
        self.quotas.set_shares(shares)

    def set_batch_size(self, batch_size: int) -> None:
        """Batches of another size from the next one on."""
        self.quotas.set_batch_size(batch_size)

    def close(self) -> None:
        """Close the panel's file."""
        self._file.close()

    def restored(self) -> None:
        """The rows of the batch last drawn are not in the buffers any more."""
        self._slots = []

    def mismatch(self, name: str, value: Any) -> MixtureError:
        """Of a state of a sampler over other strata."""
        return another_sampler()


class _Buffer(Stateful):
    """A stratum's shuffle buffer: `capacity` rows, filled up a chunk at a time.

    `order` names the slots that hold rows to be drawn, the first `filled` of it, in random order;
    the slots behind are free.
    """

    SAME: ClassVar[tuple[str, ...]] = ("capacity", "chunk_rows")
    STATE: ClassVar[tuple[str, ...]] = ("numbers", "_order", "_filled", "_chunks", "_loaded")

    def __init__(self, file: RowFile, members: Ints, capacity: int, chunk_rows: int) -> None:
        self._file, self._members = file, members  # ascending
        self.capacity = capacity
        self.whole = capacity >= len(members)  # it is all in memory
        self.chunk_rows = chunk_rows
        self.rows: F32 = np.empty((capacity, file.width), np.float32)
        self.numbers: Ints = np.full(capacity, -1, np.int64)  # of the row in each slot
        self._order: Ints = np.arange(capacity)
        self._filled = 0
        self._chunks: Ints = np.empty(0, np.int64)  # of this epoch, still to be read
        self._loaded = False

    def take(self, count: int, rng: np.random.Generator) -> Ints:
        """The slots of the next rows, (count,): their rows stay there until the next `take`."""
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
            self.numbers[:] = self._members
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
        while len(self._chunks) and self._filled + len(members := self._chunk(0)) <= upto:
            slots = np.sort(self._order[self._filled : self._filled + len(members)])
            staged = np.empty((len(members), self.rows.shape[1]), np.float32)
            self._file.read(members, staged)
            self.rows[slots] = staged
            self.numbers[slots] = members
            self._order[self._filled : self._filled + len(members)] = slots
            self._filled += len(members)
            self._chunks = self._chunks[1:]
            if len(self._chunks):
                self._file.expect(self._chunk(0))
        rng.shuffle(self._order[: self._filled])

    def _chunk(self, index: int) -> Ints:
        begin = int(self._chunks[index]) * self.chunk_rows
        return self._members[begin : begin + self.chunk_rows]

    def mismatch(self, name: str, value: Any) -> MixtureError:
        """Of a state of another memory, or other chunks."""
        return MixtureError(
            f"the saved buffer's {name} was {value}, this one's is {getattr(self, name)}",
            remedy="resume with the memory and the chunks the run began with",
        )

    def restored(self) -> None:
        """Read the buffer's rows again."""
        # Rows that were drawn already need not be read again.
        waiting = np.arange(self.capacity) if self.whole else self._order[: self._filled]
        waiting = waiting[self.numbers[waiting] >= 0]
        waiting = waiting[np.argsort(self.numbers[waiting], kind="stable")]
        for begin in range(0, len(waiting), self.chunk_rows):
            slots = waiting[begin : begin + self.chunk_rows]
            staged = np.empty((len(slots), self.rows.shape[1]), np.float32)
            self._file.read(self.numbers[slots], staged)
            self.rows[slots] = staged


def _share_out(sizes: Ints, rows: int) -> Ints:
    """Buffers (S,) of strata of `sizes`: the small ones whole, the others alike."""
    room = np.zeros(len(sizes), np.int64)
    left = rows
    for done, stratum in enumerate(np.argsort(sizes, kind="stable").tolist()):
        room[stratum] = min(int(sizes[stratum]), left // (len(sizes) - done))
        left -= int(room[stratum])
    return room


__all__ = ["CHUNK_ROWS", "MEMORY_BYTES", "ChunkedSampler"]
