"""The floor's friction, by place: a base value and patches that are slippery.

A patch is a rectangle of the floor with its own friction coefficient. Where patches overlap the
slipperiest counts. The map is looked up under each wheel's contact point.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

PATCHES = 4  # at most, an episode
SLIPPERY_BELOW = 0.3  # friction under which a wheel is said to be on a patch
NO_PATCH = (1e6, 1e6, 0.0, 0.0, 1.0)  # x, y, half x, half y, friction


def friction_at(points_m: F64, patches: F64, base: F64) -> F64:
    """Friction (N, K) under points (N, K, 2), from patches (N, P, 5) and base (N,).

    A patch row is x, y, half x, half y (metres) and its friction coefficient.
    """
    gap = np.abs(points_m[:, :, None, :] - patches[:, None, :, 0:2])  # (N, K, P, 2)
    inside = (gap <= patches[:, None, :, 2:4]).all(axis=-1)
    slippery = np.where(inside, patches[:, None, :, 4], np.inf).min(axis=-1)
    friction: F64 = np.minimum(slippery, base[:, None])
    return friction
