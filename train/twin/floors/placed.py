"""Whether poses are in a floor's frame: most of them lie on its free ground.

Odometry begins anew with each start of a robot, and so may a map that is made on the way:
recordings of one place may each have a frame of their own.
"""

from __future__ import annotations

from restock.arrays import F64, Bools
from restock.train.twin.floors.layout import Warehouse
from restock.train.twin.floors.occupancy_grid import into_frame

PLACED = 0.8  # of the poses, on free ground


def on_free_ground(floor: Warehouse, places_m: F64) -> Bools:
    """Which places (N, 2), in a floor's own frame, lie on it and in none of its racks, (N,)."""
    x, y = places_m.T
    free: Bools = (x >= 0) & (x <= floor.width_m) & (y >= 0) & (y <= floor.depth_m)
    for rack in floor.racks:
        free &= ~((rack.x_min <= x) & (x <= rack.x_max) & (rack.y_min <= y) & (y <= rack.y_max))
    return free


def placed_on(floor: Warehouse, places_m: F64) -> bool:
    """Whether places (N, 2) in the frame of logs are those of a robot on this floor."""
    if not len(places_m):
        return False
    on = on_free_ground(floor, into_frame(places_m, floor.map_origin))
    return float(on.mean()) >= PLACED


__all__ = ["PLACED", "on_free_ground", "placed_on"]
