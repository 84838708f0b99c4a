"""How much compressed bytes may claim to hold: what claims more is an attack, or an accident."""

from __future__ import annotations

RATIO = 1000
CHUNK = 64 << 20  # of a few bytes: as much is nothing to fear
FILE = 256 << 20


def most_bytes(stored: int, at_least: int = CHUNK) -> int:
    """The most that `stored` compressed bytes may hold."""
    return max(at_least, RATIO * stored)


__all__ = ["CHUNK", "FILE", "most_bytes"]
