"""A lidar in a square room with round things in it."""

import numpy as np
from numpy.typing import NDArray

Disc = tuple[float, float, float]  # x, y, radius


def ranges_in_room(
    bearings: NDArray[np.float64],
    pose: tuple[float, float, float],
    discs: list[Disc],
    walls_m: float,
) -> NDArray[np.float64]:
    """Return the ranges (1, B) of a robot at (x, y, yaw) in a room of half-width `walls_m`."""
    x, y, yaw = pose
    rays = np.stack([np.cos(bearings + yaw), np.sin(bearings + yaw)], axis=-1)
    with np.errstate(divide="ignore"):
        reach = np.where(rays > 0, walls_m - np.array([x, y]), walls_m + np.array([x, y]))
        found: NDArray[np.float64] = (reach / np.abs(rays)).min(axis=1)
    for cx, cy, radius in discs:
        to = np.array([cx - x, cy - y])
        along = rays @ to
        off2 = (to**2).sum() - along**2
        near = along - np.sqrt(np.maximum(radius**2 - off2, 0.0))
        found = np.where((off2 < radius**2) & (along > 0), np.minimum(found, near), found)
    return found[None]
