"""Packed rows: their layout, and how rows of a file are read by number.

A row is one float32 vector, the same for the panel of logs and the fresh ring:

    [ observation | next_observation | action | reward | discount ]

One gather of packed rows costs about two thirds of gathering five columns. `reward` is the n-step
return sum(gamma^k r_k), `next_observation` the one n steps later, and `discount` is gamma^n * (not
terminated), so the target is `reward + discount * max Q(next_observation)` whatever n a row has.
Truncation is not termination: such a row bootstraps, with the n that it reached.

Memory does not grow with the file: a memory map counts every page it touched as the process's own,
and reads at random when cold. So rows are read in ascending runs with `pread`, and their pages are
released.
"""

from __future__ import annotations

import os
from types import TracebackType
from typing import Self

import numpy as np

from restock.arrays import F32, Ints
from restock.errors import PanelError

# Raised when packing changes, of a row or of what stands beside it; part of a panel's id.
PACKING_VERSION = 5


SCALARS = ("action", "reward", "discount")


def row_width(observation_size: int) -> int:
    """Return the number of floats in a packed row."""
    return 2 * observation_size + len(SCALARS)


def row_columns(observation_size: int) -> dict[str, slice]:
    """Return the columns of each part of a packed row: `rows[:, columns["reward"]]`."""
    size = observation_size
    columns = {"observation": slice(0, size), "next_observation": slice(size, 2 * size)}
    for place, name in enumerate(SCALARS):
        columns[name] = slice(2 * size + place, 2 * size + place + 1)
    return columns


GOLDEN = 0x9E3779B97F4A7C15  # 2**64 over the golden ratio: the step between splitmix64's states


_GAP_BYTES = 1 << 16  # rows further apart than this are read by calls of their own
_SCRATCH_BYTES = 1 << 22


class RowFile:
    """Rows (n, W) float32 of a memory-mapped array's file.

    Args:
        rows: `Panel.rows`; only its file, offset and shape are used.

    Raises:
        PanelError: not a memory map, or its file cannot be opened.
    """

    def __init__(self, rows: F32) -> None:
        if not isinstance(rows, np.memmap) or rows.filename is None or rows.ndim != 2:
            raise PanelError("rows that are read in chunks must be a memory-mapped (n, W) array")
        self.count, self.width = rows.shape
        self._offset = int(rows.offset)
        self._stride = 4 * self.width
        self._path = str(rows.filename)
        try:
            self._fd = os.open(self._path, os.O_RDONLY)
        except OSError as error:
            raise PanelError(f"cannot be read: {error.strerror}", where=self._path) from error
        scratch_rows = max(_SCRATCH_BYTES // self._stride, 1)
        self._scratch: F32 = np.empty((scratch_rows, self.width), np.float32)
        # What the kernel would read ahead by itself are other rows than the next chunk's.
        _advise(self._fd, 0, 0, "POSIX_FADV_RANDOM")

    def read(self, rows: Ints, out: F32) -> None:
        """Read rows (n,), ascending, into `out` (n, W).

        Raises:
            PanelError: the file is shorter than it was.
        """
        if not len(rows):
            return
        steps = np.diff(rows)
        cuts = np.flatnonzero(steps > max(_GAP_BYTES // self._stride, 1)) + 1
        broken = np.concatenate([[0], np.cumsum(steps != 1)])  # breaks before each row
        begins = np.concatenate([[0], cuts])
        for begin, end in zip(begins.tolist(), [*cuts.tolist(), len(rows)], strict=True):
            while begin < end:
                first = int(rows[begin])
                upto = int(np.searchsorted(rows[begin:end], first + len(self._scratch))) + begin
                span = int(rows[upto - 1]) - first + 1
                if broken[begin] == broken[upto - 1]:  # every row between, once
                    self._read_span(first, out[begin:upto])
                else:
                    self._read_span(first, self._scratch[:span])
                    np.take(
                        self._scratch,
                        rows[begin:upto] - first,
                        axis=0,
                        out=out[begin:upto],
                        mode="clip",
                    )
                begin = upto
        self._advise_rows(rows, "POSIX_FADV_DONTNEED")

    def expect(self, rows: Ints) -> None:
        """Tell the operating system that these rows (n,), ascending, are read next."""
        if len(rows):
            self._advise_rows(rows, "POSIX_FADV_WILLNEED")

    def _read_span(self, first: int, out: F32) -> None:
        if not read_into(out, self._fd, self._offset + first * self._stride):
            raise PanelError(
                f"ends before row {first + len(out)} of {self.count}", where=self._path
            )

    def _advise_rows(self, rows: Ints, advice: str) -> None:
        # Of rows far apart the range between is not theirs to read or to give back.
        first, last = int(rows[0]), int(rows[-1])
        if last - first < 4 * len(rows):
            length = (last - first + 1) * self._stride
            _advise(self._fd, self._offset + first * self._stride, length, advice)

    def close(self) -> None:
        """Close the file."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def read_into(out: F32, file: int, at: int) -> bool:
    """Fill `out` with what a file has from byte `at` on; False where it ends before that."""
    rest = out.data.cast("B")
    while rest:
        got = os.preadv(file, [rest], at)
        if got <= 0:
            return False
        rest, at = rest[got:], at + got
    return True


def _advise(fd: int, offset: int, length: int, advice: str) -> None:
    """Call posix_fadvise if the system has it."""
    if hasattr(os, "posix_fadvise"):
        os.posix_fadvise(fd, offset, length, getattr(os, advice))
