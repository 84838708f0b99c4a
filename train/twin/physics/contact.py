"""Contact in the twin: which geoms touch which, and the floor's friction.

The parameters of wheels are measured, not guessed: stiff wheel contacts chatter when they slide and
then do not converge with the timestep; these soft ones do (see docs/twin.md).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from restock.arrays import F64, Bools, Ints
from restock.train.twin.floors.layout import NO_PATCH, PATCHES

FLOOR_FRICTION = 0.8
FLOOR = [FLOOR_FRICTION, 0.005, 0.0001]  # sliding, torsion (m), rolling (m)
SLIPPERY_BELOW = 0.3  # friction under which a wheel counts as on a patch
SOFT = {"solref": [0.02, 1], "solimp": [0, 0.95, 0.004, 0.5, 2]}  # wheels and casters

# Of geoms: lidar rays end at the first alone, and what stays hidden lies beyond the last.
OBSTACLE_GROUP, ROBOT_GROUP, FLOOR_GROUP, DRAWN_GROUP = 0, 1, 2, 3


def _mask(kind: int, touches: int) -> dict[str, int]:
    return {"contype": kind, "conaffinity": touches}


# What rolls touches the floor alone; the robot's outline touches all that stands and moves about.
FLOOR_MASK, ROLLING_MASK = _mask(1, 0), _mask(0, 1)
OBSTACLE_MASK, CHASSIS_MASK = _mask(2, 0), _mask(0, 2)
NO_MASK = _mask(0, 0)


class FloorFriction:
    """Friction under the wheels of N robots: the floor's, less on patches, and under worn tyres.

    Friction is looked up at the wheels' places and written into the batch's geoms.
    """

    def __init__(self, geom_friction: F64, wheel_geoms: Sequence[int], wheels_m: F64) -> None:
        """`geom_friction` (N, geoms, 3) is the batch's; wheels stand at `wheels_m` (W, 2)."""
        self._written, self._geoms, self._wheels_m = geom_friction, wheel_geoms, wheels_m
        count = len(geom_friction)
        self.patches = np.tile(NO_PATCH, (count, PATCHES, 1)).astype(np.float64)
        self.base = np.full(count, FLOOR_FRICTION)  # of the floor, where no patch lies
        self.left = np.ones(count)  # times it, under the wheels on the left
        self._has_patches = np.zeros(count, np.bool_)

    @property
    def icy(self) -> Ints:
        """Return the environments that have patches."""
        return np.flatnonzero(self._has_patches)

    def lay(self, env: int, patches: F64) -> None:
        """Lay the patches (PATCHES, 5) of an episode."""
        self.patches[env] = patches
        self._has_patches[env] = (patches[:, 2] > 0).any()

    def set_floor(self, env: int, friction: float) -> None:
        """Set the floor's friction coefficient outside patches."""
        self.base[env] = friction
        for wheel, geom in enumerate(self._geoms):
            left = self.left[env] if wheel % 2 == 0 else 1.0
            self._written[env, geom, 0] = friction * left

    def write(self, ids: Ints, pose: F64) -> Bools:
        """Write the friction under the wheels of `ids` at poses (n, 3).

        Returns which wheels (n, W) stand on a patch.
        """
        friction = self._under(ids, pose)
        for wheel, geom in enumerate(self._geoms):
            left = self.left[ids] if wheel % 2 == 0 else 1.0
            self._written[ids, geom, 0] = friction[:, wheel] * left
        return self._slippery(ids, friction)

    def on_patch(self, pose: F64) -> Bools:
        """Return whose wheel stands on a slippery patch, (N,), at poses (N, 3)."""
        stands = np.zeros(len(pose), np.bool_)
        icy = self.icy
        if len(icy):
            stands[icy] = self._slippery(icy, self._under(icy, pose[icy])).any(axis=1)
        return stands

    def _under(self, ids: Ints, pose: F64) -> F64:
        return friction_at(self._wheel_points(pose), self.patches[ids], self.base[ids])

    def _slippery(self, ids: Ints, friction: F64) -> Bools:
        """Return which wheels (n, W) stand on a patch, by their friction and the floor's."""
        least = np.minimum(SLIPPERY_BELOW, self.base[ids, None] - 1e-9)
        return np.asarray(friction < least, np.bool_)

    def _wheel_points(self, pose: F64) -> F64:
        """Return where the wheels of robots at poses (n, 3) stand, (n, W, 2)."""
        cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        ahead, across = np.stack([cos, sin], axis=-1), np.stack([-sin, cos], axis=-1)
        x, y = self._wheels_m[:, 0, None], self._wheels_m[:, 1, None]
        points: F64 = pose[:, None, :2] + across[:, None] * y
        return points if len(self._wheels_m) == 2 else points + ahead[:, None] * x


def friction_at(points_m: F64, patches: F64, base: F64) -> F64:
    """Return the friction (N, K) at points (N, K, 2), from patches (N, P, 5) and base (N,).

    A patch row is x, y, half x, half y (metres) and its friction coefficient. Where patches overlap
    the slipperiest counts.
    """
    gap = np.abs(points_m[:, :, None, :] - patches[:, None, :, 0:2])  # (N, K, P, 2)
    inside = (gap <= patches[:, None, :, 2:4]).all(axis=-1)
    slippery = np.where(inside, patches[:, None, :, 4], np.inf).min(axis=-1)
    friction: F64 = np.minimum(slippery, base[:, None])
    return friction
