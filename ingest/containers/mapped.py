"""A file mapped into memory, of which only what is being read stays there."""

from __future__ import annotations

import mmap

FORGET_BYTES = 64 << 20  # read this much, then let go of it


def forget(file: mmap.mmap, start: int = 0, stop: int | None = None) -> None:
    """Let go of the pages of file[start:stop]; reading them again brings them back.

    Until then each page that was read counts as this process' memory, whatever the system's
    cache does with it: a large recording would look like a leak, and hit a limit like one.
    """
    if not hasattr(mmap, "MADV_DONTNEED"):  # no such advice on this system
        return
    low = -(-start // mmap.PAGESIZE) * mmap.PAGESIZE
    high = len(file) if stop is None else min(stop // mmap.PAGESIZE * mmap.PAGESIZE, len(file))
    if low < high:
        file.madvise(mmap.MADV_DONTNEED, low, high - low)


__all__ = ["FORGET_BYTES", "forget"]
