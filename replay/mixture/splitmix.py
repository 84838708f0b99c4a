"""splitmix64: a mixing of 64-bit numbers that is the same on every machine."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

GOLDEN = 0x9E3779B97F4A7C15  # 2**64 over the golden ratio: the step between its states


def splitmix64(states: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """The outputs of states, elementwise (Steele, Lea and Flood, OOPSLA 2014)."""
    mixed = (states ^ (states >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    result: NDArray[np.uint64] = mixed ^ (mixed >> np.uint64(31))
    return result
