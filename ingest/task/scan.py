"""Lidar scans to clearance per sector, for logs and twin alike."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from restock.toml import Checked


class Body(Checked, frozen=True):
    """The robot's rectangular outline and where its lidar sits, in the base frame (x forward)."""

    length_m: Annotated[float, Meta(gt=0)]
    width_m: Annotated[float, Meta(gt=0)]
    lidar_x_m: float = 0.0  # of the lidar, ahead of the outline's centre
    lidar_yaw_rad: float = 0.0  # angle of the scan's zero to the robot's forward axis


@dataclass(frozen=True)
class SectorMap:
    """Which beam belongs to which sector, and how far the body reaches along each beam.

    Sector 0 starts straight behind (-pi) and sectors go counter-clockwise, so that the robot's
    forward axis lies between sectors K/2 - 1 and K/2. Built once per lidar geometry.
    """

    sectors: int
    order: NDArray[np.intp]  # (B,) beams sorted by sector
    starts: NDArray[np.intp]  # (filled,) first position of each non-empty sector in `order`
    filled: NDArray[np.intp]  # (filled,) the sectors that have beams
    reach_m: NDArray[np.float64]  # (B,) from the lidar to the outline along the beam

    @classmethod
    def build(cls, bearings_rad: NDArray[Any], sectors: int, body: Body) -> SectorMap:
        """Bearings (B,) of the beams in the lidar's own frame."""
        bearing = (np.asarray(bearings_rad, np.float64) + body.lidar_yaw_rad + np.pi) % (2 * np.pi)
        sector = np.minimum((bearing * (sectors / (2 * np.pi))).astype(np.intp), sectors - 1)
        order = np.argsort(sector, kind="stable")
        filled, starts = np.unique(sector[order], return_index=True)
        reach = outline_reach(bearing - np.pi, body)
        return cls(sectors, order, starts, filled, reach)

    def clearance(
        self, ranges_m: NDArray[Any], range_min_m: float, range_max_m: float
    ) -> NDArray[np.float64]:
        """Ranges (N, B) to clearance per sector (N, K), in [0, range_max_m].

        inf, NaN, and readings below `range_min_m` (the driver's "no valid return") or above
        `range_max_m` count as free up to `range_max_m`; so does a sector without beams.
        """
        with np.errstate(invalid="ignore"):  # a damaged range may be a NaN that signals
            ranges = np.asarray(ranges_m, np.float64)
        valid = (ranges >= range_min_m) & (ranges <= range_max_m)  # False for NaN and inf
        near = ranges - self.reach_m
        np.copyto(near, range_max_m, where=~valid)
        clearance = np.full((len(ranges), self.sectors), float(range_max_m))
        if len(self.filled):
            if (self.order[1:] < self.order[:-1]).any():
                near = near[:, self.order]
            nearest = np.minimum.reduceat(near, self.starts, axis=1)
            clearance[:, self.filled] = np.maximum(nearest, 0.0)
        return clearance


def outline_reach(bearings_rad: NDArray[np.float64], body: Body) -> NDArray[np.float64]:
    """From the lidar to the body's outline along each bearing (B,), in metres."""
    cos, sin = np.cos(bearings_rad), np.sin(bearings_rad)
    ahead = np.where(
        cos >= 0, body.length_m / 2 - body.lidar_x_m, body.length_m / 2 + body.lidar_x_m
    )
    with np.errstate(divide="ignore", over="ignore"):  # along an axis the other side is far
        return np.minimum(np.maximum(ahead, 0.0) / np.abs(cos), (body.width_m / 2) / np.abs(sin))
