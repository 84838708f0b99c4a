"""The file of packed rows while it is written: part by part, in any order, in bounded memory.

Rows are put into blocks. A block that is full is hashed and written by other threads, while the
next ones are filled.
"""

from __future__ import annotations

import itertools
import os
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F32, Ints
from restock.errors import PanelError
from restock.replay.panel.seal import FileRecord, Leaves
from restock.replay.sampling.row_file import read_into

BLOCK_ROWS = 512  # of packed rows, written together
HELD_BYTES = 128 << 20  # of blocks that are not full, in memory at a time
WRITERS = 2  # threads
WAITING_BYTES = 32 << 20  # of blocks that are being written, in memory at a time


class Values(NamedTuple):
    """What rows (m,) have in some of their columns."""

    columns: slice
    held: NDArray[Any]  # (m, c), or (n, c) with `of`
    of: Ints | None = None  # (m,) which of these each row has


class PackedFile:
    """Rows (n, W) float32 of a file, put there part by part, in any order, each part once.

    Blocks are written when they are full; those that wait for the rest of their rows are held, and
    where they are too many, written as they are and read again. Use it as a context: leaving it
    waits for what is being written.
    """

    def __init__(self, path: Path, rows: int, width: int, *, parts: int) -> None:
        self._rows, self._width, self._parts = rows, width, parts
        self._path = path
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666)
        self._put: Ints = np.zeros(-(-rows // BLOCK_ROWS), np.int64)  # parts of rows, of each block
        self._held: dict[int, F32] = {}
        self._leaves = Leaves(4 * rows * width, 4 * BLOCK_ROWS * width)
        self._writers = ThreadPoolExecutor(WRITERS, "restock-pack")
        self._writing: dict[int, Future[None]] = {}  # by block, the oldest first

    def __enter__(self) -> PackedFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._writers.shutdown(cancel_futures=True)
        os.close(self._file)

    def finish(self) -> FileRecord:
        """Wait for what is being written; size and checksums of the file.

        Raises:
            PanelError: a part of a row was not put.
        """
        self._wait(at_most=0)
        if int(self._put.sum()) != self._rows * self._parts:
            raise PanelError("the source changed while it was read", where=str(self._path.parent))
        return self._leaves.record(self._path)

    def put(self, rows: Ints, *values: Values) -> None:
        """Write some columns of some rows (m,).

        Raises OSError where the file cannot be written.
        """
        if (np.diff(rows) < 0).any():
            order = np.argsort(rows, kind="stable")
            rows = rows[order]
            values = tuple(
                value._replace(of=order if value.of is None else value.of[order])
                for value in values
            )
        block = rows // BLOCK_ROWS
        into = _Stretches(rows)
        out_of = [None if value.of is None else _Stretches(value.of) for value in values]
        for begin, end in itertools.pairwise([0, *np.flatnonzero(np.diff(block)) + 1, len(rows)]):
            if begin == end:
                continue
            number = int(block[begin])
            packed = self._block(number)
            to = into(begin, end, number * BLOCK_ROWS)
            for value, of in zip(values, out_of, strict=True):
                held = slice(begin, end) if of is None else of(begin, end)
                packed[to, value.columns] = value.held[held]
            self._put[number] += end - begin
            if self._put[number] == len(packed) * self._parts:
                self._write(number)
        while len(self._held) * self._block_bytes > HELD_BYTES:
            self._write(next(iter(self._held)))

    @property
    def _block_bytes(self) -> int:
        return 4 * BLOCK_ROWS * self._width

    def _block(self, number: int) -> F32:
        if (held := self._held.get(number)) is None:
            count = min(BLOCK_ROWS, self._rows - number * BLOCK_ROWS)
            held = np.empty((count, self._width), "<f4")
            if self._put[number]:
                if (writing := self._writing.pop(number, None)) is not None:
                    writing.result()
                if not read_into(held, self._file, number * self._block_bytes):
                    raise PanelError("what was written of it is gone", where=str(self._path))
            self._held[number] = held
        return held

    def _write(self, number: int) -> None:
        held = self._held.pop(number)
        self._wait(at_most=max(WAITING_BYTES // self._block_bytes, WRITERS))
        whole = bool(self._put[number] == len(held) * self._parts)
        self._writing[number] = self._writers.submit(self._store, number, held, whole)

    def _wait(self, at_most: int) -> None:
        """Until no more are being written. Raises their errors."""
        while len(self._writing) > at_most:
            self._writing.pop(next(iter(self._writing))).result()

    def _store(self, number: int, held: F32, whole: bool) -> None:
        rest = held.data.cast("B")
        if whole:
            self._leaves.add(number, rest)
        place = number * self._block_bytes
        while rest:  # a full disk is an OSError; what is written short goes on
            written = os.pwrite(self._file, rest, place)
            rest, place = rest[written:], place + written


class _Stretches:
    """Parts of a list of row numbers (m,), as slices if the numbers are consecutive.

    Slices copy faster.
    """

    def __init__(self, rows: Ints) -> None:
        self._rows = rows
        self._breaks = np.append(0, np.cumsum(np.diff(rows) != 1))  # up to each

    def __call__(self, begin: int, end: int, base: int = 0) -> Ints | slice:
        """Return the row numbers [begin, end) less `base`."""
        if self._breaks[begin] != self._breaks[end - 1]:
            return self._rows[begin:end] - base
        first = int(self._rows[begin]) - base
        return slice(first, first + end - begin)
