"""A floor where there is neither map nor lidar: the corridor that a robot drove in.

All that is known is that the robot fitted where it was: its outline and a margin around its way are
free, and whatever is beyond counts as a wall. So there is no way but those that were driven.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from restock.arrays import F64
from restock.train.twin.floors.occupancy_grid import (
    FREE,
    UNKNOWN,
    OccupancyGrid,
    into_frame,
    out_of_frame,
)
from restock.train.twin.survey.directions import main_direction
from restock.train.twin.survey.poses import JUMP_M, Poses

CELL_M = 0.05
MARGIN_M = 0.25  # around the circle in which the robot turns


def driven_corridor(poses: Poses, turn_m: float) -> OccupancyGrid:
    """The corridor, along the directions that were mostly driven.

    `turn_m` is what the robot needs around its middle to turn.
    """
    step = np.diff(poses.places_m, axis=0)
    length = np.hypot(*step.T)
    yaw = main_direction(np.arctan2(step[:, 1], step[:, 0]), length * (length <= JUMP_M))
    places = into_frame(poses.places_m, (0.0, 0.0, yaw))
    way = way_between(places)
    reach = turn_m + MARGIN_M
    low = way.min(axis=0) - reach - 2 * CELL_M
    cells = np.floor((way - low) / CELL_M).astype(np.int64)
    shape = cells.max(axis=0) + 2 + int(reach / CELL_M) + 2
    seen = np.zeros(tuple(shape), np.bool_)
    seen[tuple(cells.T)] = True
    free = ndimage.distance_transform_edt(~seen) * CELL_M <= reach
    corner = out_of_frame(low[None], (0.0, 0.0, yaw))[0]
    occupancy = np.where(free, np.int8(FREE), np.int8(UNKNOWN))
    return OccupancyGrid(occupancy, CELL_M, (float(corner[0]), float(corner[1]), yaw), poses.frame)


def way_between(places_m: F64) -> F64:
    """Places (N, 2) with points in between, no cell apart, where one drove from one to the next."""
    parts = [places_m]
    length = np.hypot(*np.diff(places_m, axis=0).T)
    for index in np.flatnonzero((length > CELL_M / 2) & (length <= JUMP_M)):
        start, end = places_m[index], places_m[index + 1]
        count = int(length[index] / (CELL_M / 2)) + 1
        share = np.arange(1, count)[:, None] / count
        parts.append(start + share * (end - start))
    return np.concatenate(parts)
