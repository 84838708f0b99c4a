"""True lidar ranges: what each beam of N robots hits first.

Beams are level, and all that is on a floor stands upright: boxes, and people, who are cylinders. So
ranges are found in the plane, by compiled code where there is some (`restock.native`), which asks
of each shape only the beams that may meet it. Without it MuJoCo casts the rays, all against all;
the distances are the same, to the rounding of the last bits.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from restock import native
from restock.arrays import F64, Ints
from restock.train.twin.physics.contact import OBSTACLE_GROUP
from restock.train.twin.physics.model import MOVING_HALF_M
from restock.train.twin.physics.scenery import Scenery

FAR_AWAY = (1e9, 1e9, 1.0, 0.0, 0.1, 0.1)  # of a shape that the beams pass over or under


class Lidar:
    """Beams of N lidars, `height_m` above the floor."""

    def __init__(self, batch: Any, scenery: Scenery, bearings_rad: F64, height_m: float) -> None:
        """`bearings_rad` (beams,) are from the robot's heading."""
        self.batch, self.scenery, self.height_m = batch, scenery, height_m
        self._beam = np.stack([np.cos(bearings_rad), np.sin(bearings_rad)], axis=-1)
        self._order = np.argsort(bearings_rad)
        self._bearing = np.ascontiguousarray(bearings_rad[self._order])
        self._groups = np.zeros(6, np.uint8)
        self._groups[OBSTACLE_GROUP] = 1
        standing = [self._in_plane(*boxes) for boxes in scenery.buildings]
        self._first = np.cumsum([0, *(len(boxes) for boxes in standing)])
        self._standing = np.concatenate(standing)
        self._half_m = MOVING_HALF_M[:, :2].copy()  # of pallets, people and forklifts
        self._half_m[scenery.handles.people, 1] = 0.0  # they are round

    def _in_plane(self, middle: F64, half: F64) -> F64:
        """Boxes (G, 4) that the plane of the beams cuts: x, y and half sizes."""
        cut = np.abs(middle[:, 2] - self.height_m) <= half[:, 2]
        return np.column_stack([middle[cut, :2], half[cut, :2]])

    def ranges(self, ids: Ints, place_m: F64, heading_rad: F64) -> F64:
        """Distances (n, beams) in metres from lidars at (n, 2); inf where nothing is hit."""
        cos, sin = np.cos(heading_rad), np.sin(heading_rad)
        rays = np.empty((len(ids), len(self._beam), 2))
        rays[..., 0] = cos[:, None] * self._beam[:, 0] - sin[:, None] * self._beam[:, 1]
        rays[..., 1] = sin[:, None] * self._beam[:, 0] + cos[:, None] * self._beam[:, 1]
        if not native.is_used():
            return self._cast(ids, place_m, rays)
        ranges = np.empty(rays.shape[:2])
        native.compiled.ranges(
            np.ravel(place_m),
            np.ascontiguousarray(heading_rad),
            rays.reshape(-1),
            self._bearing,
            self._order,
            self.scenery.floor[ids],
            self._first,
            self._standing.reshape(-1),
            self._moved(ids).reshape(-1),
            ranges.reshape(-1),
        )
        return ranges

    def _moved(self, ids: Ints) -> F64:
        """Pallets, people and forklifts (n, M, 6) as `compiled.ranges` takes them."""
        position, quat = self.scenery.position_m[ids], self.scenery.quat[ids]
        shapes = np.empty((*position.shape[:2], 6))
        shapes[..., :2] = position[..., :2]
        shapes[..., 2] = quat[..., 0] * quat[..., 0] - quat[..., 3] * quat[..., 3]
        shapes[..., 3] = 2 * (quat[..., 0] * quat[..., 3])
        shapes[..., 4:] = self._half_m
        above = np.abs(position[..., 2] - self.height_m) > MOVING_HALF_M[:, 2]
        shapes[above] = FAR_AWAY
        return shapes

    def _cast(self, ids: Ints, place_m: F64, rays: F64) -> F64:
        """By MuJoCo."""
        origin = np.full((len(ids), 1, 3), self.height_m)
        origin[:, 0, :2] = place_m
        level = np.zeros((*rays.shape[:2], 3))
        level[..., :2] = rays
        distance = self.batch.ray(origin, level, self._groups, ids=ids)[0]
        return np.where(distance < 0, np.inf, distance)


__all__ = ["Lidar"]
