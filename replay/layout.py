"""How a transition is packed: one float32 row, the same for the panel of logs and the fresh ring.

    [ observation | next_observation | action | reward | discount ]

One gather of packed rows costs about two thirds of gathering five columns. `reward` is the n-step
return sum(gamma^k r_k), `next_observation` the one n steps later, and `discount` is
gamma^n * (not terminated), so the target is `reward + discount * max Q(next_observation)` whatever
n a row has. Truncation is no termination: such a row bootstraps, with the n it got to.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Raised when the meaning of a packed row changes; part of a panel's id.
PACKING_VERSION = 1

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

SCALARS = ("action", "reward", "discount")


def row_width(observation_size: int) -> int:
    """Floats in a packed row."""
    return 2 * observation_size + len(SCALARS)


def row_columns(observation_size: int) -> dict[str, slice]:
    """Where each part of a packed row is: `rows[:, columns["reward"]]`."""
    size = observation_size
    columns = {"observation": slice(0, size), "next_observation": slice(size, 2 * size)}
    for place, name in enumerate(SCALARS):
        columns[name] = slice(2 * size + place, 2 * size + place + 1)
    return columns


def n_step_horizon(continues: Bools, n_step: int) -> Ints:
    """How many steps each row's return spans, (N,) in 1..n_step.

    `continues[i]` (N,) says that row i + 1 is the step after row i of the same episode (so it is
    False where the episode ends, where a step is missing, and on the last row).
    """
    horizon = np.ones(len(continues), np.int64)
    unbroken = np.ones(len(continues), np.bool_)
    for ahead in range(1, min(n_step, len(continues) + 1)):
        # Row i reaches i + ahead if it reached i + ahead - 1 and that one continues.
        step = np.zeros(len(continues), np.bool_)
        step[: len(continues) - ahead + 1] = continues[ahead - 1 :]
        unbroken &= step
        horizon += unbroken
    return horizon


def n_step_return(reward: F32, horizon: Ints, discount: float) -> F64:
    """sum(gamma^k r[i + k]) for k below horizon[i], (N,)."""
    total = np.asarray(reward, np.float64).copy()
    for ahead in range(1, int(horizon.max(initial=1))):
        reach = np.flatnonzero(horizon > ahead)
        total[reach] += discount**ahead * reward[reach + ahead]
    return total
