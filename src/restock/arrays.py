"""Arrays by the type of their entries, and a mixing of their numbers.

Their shapes stand in comments, where they are declared.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Ints = NDArray[np.int64]
Codes = NDArray[np.signedinteger[Any]]  # indices of texts in a dictionary; -1: no text
Bools = NDArray[np.bool_]


def splitmix64(states: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Mix 64-bit numbers, alike on every machine (Steele, Lea and Flood, OOPSLA 2014)."""
    mixed = (states ^ (states >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    result: NDArray[np.uint64] = mixed ^ (mixed >> np.uint64(31))
    return result


__all__ = ["F32", "F64", "Bools", "Codes", "Ints", "splitmix64"]
