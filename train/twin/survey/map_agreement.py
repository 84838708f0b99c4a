"""How far two maps of one place agree on its walls, and a lidar's returns with those of a map."""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from restock.arrays import F64
from restock.train.twin.floors.occupancy_grid import (
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
    out_of_frame,
)
from restock.train.twin.floors.placed import MIN_RETURNS, NEAR_M
from restock.train.twin.survey.logged_drives import RETURNS, WITHIN_M
from restock.train.twin.survey.scans import PlacedScans


def walls_agreement(made: OccupancyGrid, known: OccupancyGrid) -> float | None:
    """Intersection over union of the occupied cells of two maps, within one cell.

    A cell counts as shared where the other map has an occupied cell within one cell (of the coarser
    of both, diagonals too). Of `known` only what lies where `made` knows something, or next to it,
    counts. None where one of them has no walls there.
    """
    near_m = 1.5 * max(made.cell_m, known.cell_m)
    mine, theirs = _walls(made), _walls(known)
    seen = ndimage.binary_dilation(made.occupancy != UNKNOWN, np.ones((3, 3), np.bool_))
    cells, inside = made.cells_at(theirs)
    inside[inside] = seen[tuple(cells[inside].T)]
    theirs = theirs[inside]
    if not len(mine) or not len(theirs):
        return None
    # Cells may differ in size, and walls are lines: each counts by its length.
    a, b = made.cell_m, known.cell_m
    shared_mine = float((cKDTree(theirs).query(mine)[0] <= near_m).sum()) * a
    shared_theirs = float((cKDTree(mine).query(theirs)[0] <= near_m).sum()) * b
    shared = (shared_mine + shared_theirs) / 2
    alone = len(mine) * a - shared_mine + len(theirs) * b - shared_theirs
    return shared / (shared + alone)


def returns_on_walls(scans: PlacedScans, grid: OccupancyGrid) -> float | None:
    """The share of a lidar's returns that lie within NEAR_M of an occupied cell of a map.

    Returns farther than `WITHIN_M` from the lidar do not count: an error of the pose's yaw moves
    them. None where there are too few to say.
    """
    nearby = [
        hit[np.hypot(*(hit - origin).T) < WITHIN_M]
        for origin, hit in zip(scans.origin_m, scans.hit_m, strict=True)
    ]
    returns = np.concatenate([np.zeros((0, 2)), *nearby])
    walls = _walls(grid)
    if len(returns) < MIN_RETURNS or not len(walls):
        return None
    apart = cKDTree(walls).query(returns[:: len(returns) // RETURNS + 1])[0]
    return float((apart <= NEAR_M + grid.cell_m / 2).mean())


def _walls(grid: OccupancyGrid) -> F64:
    """The middles (N, 2) of the occupied cells, in the map's frame."""
    cells = np.argwhere(grid.occupancy == OCCUPIED)
    return out_of_frame(np.asarray((cells + 0.5) * grid.cell_m, np.float64), grid.origin)
