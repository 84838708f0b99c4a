"""Contact in the twin: which geoms touch which, and how much friction the floor has where.

The parameters of wheels are measured, not guessed: stiff wheel contacts chatter when they slide and
then do not converge with the timestep; these soft ones do (see docs/twin.md).
"""

from __future__ import annotations

import numpy as np

from restock.arrays import F64

FLOOR_FRICTION = 0.8
FLOOR = [FLOOR_FRICTION, 0.005, 0.0001]  # sliding, torsion (m), rolling (m)
PATCHES = 4  # at most, an episode: parts of the floor with a friction of their own
SLIPPERY_BELOW = 0.3  # friction under which a wheel counts as on a patch
NO_PATCH = (1e6, 1e6, 0.0, 0.0, 1.0)  # x, y, half x, half y, friction
SOFT = {"solref": [0.02, 1], "solimp": [0, 0.95, 0.004, 0.5, 2]}  # wheels and casters

# Of geoms: lidar rays end at the first alone, and what stays hidden lies beyond the last.
OBSTACLE_GROUP, ROBOT_GROUP, FLOOR_GROUP, DRAWN_GROUP = 0, 1, 2, 3


def _mask(kind: int, touches: int) -> dict[str, int]:
    return {"contype": kind, "conaffinity": touches}


# What rolls touches the floor alone; the robot's outline touches all that stands and moves about.
FLOOR_MASK, ROLLING_MASK = _mask(1, 0), _mask(0, 1)
OBSTACLE_MASK, CHASSIS_MASK = _mask(2, 0), _mask(0, 2)
NO_MASK = _mask(0, 0)


def friction_at(points_m: F64, patches: F64, base: F64) -> F64:
    """Friction (N, K) under points (N, K, 2), from patches (N, P, 5) and base (N,).

    A patch row is x, y, half x, half y (metres) and its friction coefficient. Where patches overlap
    the slipperiest counts.
    """
    gap = np.abs(points_m[:, :, None, :] - patches[:, None, :, 0:2])  # (N, K, P, 2)
    inside = (gap <= patches[:, None, :, 2:4]).all(axis=-1)
    slippery = np.where(inside, patches[:, None, :, 4], np.inf).min(axis=-1)
    friction: F64 = np.minimum(slippery, base[:, None])
    return friction
