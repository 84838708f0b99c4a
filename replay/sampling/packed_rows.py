"""Packed rows: their layout.

A row is one float32 vector, the same for the panel of logs and the fresh ring:

    [ observation | next_observation | action | reward | discount ]

One gather of packed rows costs about two thirds of gathering five columns. `reward` is the n-step
return sum(gamma^k r_k), `next_observation` the one n steps later, and `discount` is gamma^n * (not
terminated), so the target is `reward + discount * max Q(next_observation)` whatever n a row has.
Truncation is not termination: such a row bootstraps, with the n that it reached.
"""

from __future__ import annotations

# Raised when packing changes, of a row or of what stands beside it; part of a panel's id.
PACKING_VERSION = 6


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
