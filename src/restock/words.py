"""Numbers and nouns in sentences."""

from __future__ import annotations


def plural(number: int, noun: str) -> str:
    """`gap` of 1, else `gaps`."""
    return noun if number == 1 else f"{noun}s"


def counted(number: int, noun: str) -> str:
    """`1 gap`, `1,200 gaps`."""
    return f"{number:,} {plural(number, noun)}"
