"""Which way a floor's walls run: floors and boxes are straight along their axes, maps need not be.

Directions that differ by a right angle count as one: of angles a_i with weights w_i, the main one
is the argument of the sum of w_i exp(4 i a_i), divided by four.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from restock.arrays import F64
from restock.train.twin.floors.occupancy_grid import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
    into_frame,
    out_of_frame,
)

AGREEING = 0.25  # of the weight, less than this says nothing
MIN_TURN_RAD = np.deg2rad(3.0)
_SUB = 3  # points a cell and axis that a turned cell is looked up at


def main_direction(angles_rad: F64, weights: F64) -> float:
    """The main direction in (-pi/4, pi/4], 0 where they do not agree on one."""
    total = float(weights.sum())
    if total <= 0:
        return 0.0
    sum_ = complex((weights * np.exp(4j * angles_rad)).sum())
    return float(np.angle(sum_) / 4) if abs(sum_) >= AGREEING * total else 0.0


def walls_direction(grid: OccupancyGrid) -> float:
    """The direction of a grid's walls against its axes."""
    walls = ndimage.gaussian_filter((grid.occupancy == OCCUPIED).astype(np.float32), 1.5)
    across_x, across_y = np.gradient(walls)
    return main_direction(np.arctan2(across_y, across_x), np.hypot(across_x, across_y))


def along_walls(grid: OccupancyGrid) -> tuple[OccupancyGrid, float]:
    """The grid with its axes along its walls, and by how much it was turned (rad).

    A turned cell is occupied where any part of it was, so that no wall gets a hole.
    """
    known = grid.occupancy != UNKNOWN
    if not known.any():
        return grid, 0.0
    columns, rows = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    part = grid.cut(int(columns[0]), int(columns[-1]) + 1, int(rows[0]), int(rows[-1]) + 1)
    turn = walls_direction(part)
    if abs(turn) < MIN_TURN_RAD:
        return grid, 0.0
    cell_m, size = part.cell_m, np.array(part.occupancy.shape) * part.cell_m
    corners = np.array([[0.0, 0.0], [1, 0], [0, 1], [1, 1]]) * size
    turned = into_frame(corners, (0.0, 0.0, turn))
    low, high = turned.min(axis=0), turned.max(axis=0)
    shape = np.ceil((high - low) / cell_m).astype(int)
    occupied, free = np.zeros((2, *shape), np.int16)
    indices = np.indices(tuple(shape), sparse=True)
    for dx in range(_SUB):
        for dy in range(_SUB):
            x, y = (
                np.broadcast_to(low[axis] + (indices[axis] + (d + 0.5) / _SUB) * cell_m, shape)
                for axis, d in enumerate((dx, dy))
            )
            places = out_of_frame(np.stack([x.ravel(), y.ravel()], axis=-1), (0.0, 0.0, turn))
            cells = np.floor(places / cell_m).astype(np.int64)
            inside = ((cells >= 0) & (cells < part.occupancy.shape)).all(axis=1)
            found = np.full(len(cells), UNKNOWN, np.int8)
            found[inside] = part.occupancy[tuple(cells[inside].T)]
            occupied += (found == OCCUPIED).reshape(shape)
            free += (found == FREE).reshape(shape)
    occupancy = np.full(tuple(shape), UNKNOWN, np.int8)
    occupancy[free > _SUB * _SUB / 2] = FREE
    occupancy[occupied > 0] = OCCUPIED
    corner = out_of_frame(out_of_frame(low[None], (0.0, 0.0, turn)), part.origin)[0]
    origin = (float(corner[0]), float(corner[1]), part.origin[2] + turn)
    return OccupancyGrid(occupancy, cell_m, origin, grid.frame), turn
