"""Lidar scans to clearance per sector, for logs and twin alike."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from restock.arrays import F64, Bools
from restock.toml import Checked


class Body(Checked, frozen=True):
    """The robot's rectangular outline and where its lidar sits, in the base frame (x forward)."""

    length_m: Annotated[float, Meta(gt=0)]
    width_m: Annotated[float, Meta(gt=0)]
    lidar_x_m: float = 0.0  # of the lidar, ahead of the outline's centre
    lidar_yaw_rad: float = 0.0  # angle of the scan's zero to the robot's forward axis


_AWAY_M = 1e-3  # along a beam, so that what is too close is in that beam's direction
UNSEEN_SECTORS = 3  # at most, that are taken to lie behind what is beside them


@dataclass(frozen=True)
class SectorMap:
    """Map of beams to sectors, and how far the body reaches along each beam.

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
        """Return bearings (B,) of the beams in the lidar's own frame."""
        bearing = (np.asarray(bearings_rad, np.float64) + body.lidar_yaw_rad + np.pi) % (2 * np.pi)
        sector = np.minimum((bearing * (sectors / (2 * np.pi))).astype(np.intp), sectors - 1)
        order = np.argsort(sector, kind="stable")
        filled, starts = np.unique(sector[order], return_index=True)
        reach = outline_reach(bearing - np.pi, body)
        return cls(sectors, order, starts, filled, reach)

    def clearance(
        self, ranges_m: NDArray[Any], range_min_m: float, range_max_m: float
    ) -> NDArray[np.float64]:
        """Reduce ranges (N, B) to clearance per sector (N, K), in [0, range_max_m].

        inf, NaN, and readings below `range_min_m` (the driver's "no valid return") or above
        `range_max_m` count as free up to `range_max_m`; so does a sector without beams. -inf is
        too close to be measured (REP 117): clearance 0.
        """
        with np.errstate(invalid="ignore"):  # a damaged range may be a NaN that signals
            ranges = np.asarray(ranges_m, np.float64)
        valid = returned(ranges, range_min_m, range_max_m)
        near = ranges - self.reach_m
        np.copyto(near, range_max_m, where=~valid)
        clearance = np.full((len(ranges), self.sectors), float(range_max_m))
        if len(self.filled):
            if (self.order[1:] < self.order[:-1]).any():
                near = near[:, self.order]
            nearest = np.minimum.reduceat(near, self.starts, axis=1)
            clearance[:, self.filled] = np.maximum(nearest, 0.0)
        return clearance


@dataclass(frozen=True)
class MovedMap:
    """Map of beams to sectors for a lidar that is not where the body has its own.

    Where its beams end is seen from the body's place, so a beam's sector depends on its range.
    """

    sectors: int
    body: Body
    from_m: tuple[float, float]  # of this lidar, ahead and left of the body's own
    ways: NDArray[np.float64]  # (2, B) of the beams: cosines and sines, in the body's frame

    @classmethod
    def build(
        cls, bearings_rad: NDArray[Any], sectors: int, body: Body, at_m: tuple[float, float]
    ) -> MovedMap:
        """Return bearings (B,) of the beams in the body's frame, from a place in it (x, y)."""
        ways = np.stack([np.cos(bearings_rad), np.sin(bearings_rad)])
        return cls(sectors, body, (at_m[0] - body.lidar_x_m, at_m[1]), ways)

    def clearance(
        self, ranges_m: NDArray[Any], range_min_m: float, range_max_m: float
    ) -> NDArray[np.float64]:
        """Compute `SectorMap.clearance`, but NaN for sectors in which no beam ends (`with_unseen`).

        `range_min_m` is from this lidar, `range_max_m` from the body's own.
        """
        with np.errstate(invalid="ignore"):
            ranges = np.asarray(ranges_m, np.float64)
        farthest_m = range_max_m + float(np.hypot(*self.from_m))
        valid = returned(ranges, range_min_m, farthest_m)
        close = np.isneginf(ranges)
        reached = np.where(valid, np.maximum(ranges, max(range_min_m, _AWAY_M)), farthest_m)
        x, y = (reached * way + start for way, start in zip(self.ways, self.from_m, strict=True))
        bearing = np.arctan2(y, x)
        near = np.clip(np.hypot(x, y) - outline_reach(bearing, self.body), 0.0, range_max_m)
        np.copyto(near, range_max_m, where=~valid)
        np.copyto(near, 0.0, where=close)
        turn = (bearing + np.pi) * (self.sectors / (2 * np.pi))
        sector = np.minimum(turn.astype(np.intp), self.sectors - 1)
        clearance = np.full((len(ranges), self.sectors), np.inf)
        row = np.broadcast_to(np.arange(len(ranges))[:, None], sector.shape)
        np.minimum.at(clearance, (row, sector), near)
        clearance[np.isinf(clearance)] = np.nan
        return clearance


def returned(ranges_m: F64, range_min_m: float, range_max_m: float) -> Bools:
    """Return which ranges mean that something is there: False for NaN and inf, True for -inf."""
    inside = (ranges_m >= range_min_m) | np.isneginf(ranges_m)
    return np.asarray(inside & (ranges_m <= range_max_m), np.bool_)


def with_unseen(clearance_m: NDArray[np.float64], range_max_m: float) -> NDArray[np.float64]:
    """Fill sectors without a beam's end, NaN, in clearances (N, K).

    What lies behind a near thing, as a lidar beside the middle sees it, is as near as the nearer of
    the sectors on either side, over up to UNSEEN_SECTORS. More are beyond the lidars' view: free up
    to `range_max_m`, as a sector without beams is.
    """
    rows = np.flatnonzero(np.isnan(clearance_m).any(axis=1))
    if not len(rows):
        return clearance_m
    filled, some = clearance_m.copy(), clearance_m[rows]
    unseen, beside = np.isnan(some), []
    for way in (1, -1):
        far, value = np.full(unseen.shape, UNSEEN_SECTORS + 1), np.full(unseen.shape, np.nan)
        for step in range(UNSEEN_SECTORS, 0, -1):
            there = np.roll(some, way * step, axis=1)
            known = ~np.isnan(there)
            far[known], value[known] = step, there[known]
        beside.append((far, value))
    (before, low), (after, high) = beside
    short = unseen & (before + after - 1 <= UNSEEN_SECTORS)
    free = np.where(unseen, range_max_m, some)
    filled[rows] = np.where(short, np.fmin(low, high), free)
    return filled


def outline_reach(bearings_rad: NDArray[np.float64], body: Body) -> NDArray[np.float64]:
    """Return the distance from the lidar to the outline along each bearing (B,), in metres."""
    cos, sin = np.cos(bearings_rad), np.sin(bearings_rad)
    ahead = np.where(
        cos >= 0, body.length_m / 2 - body.lidar_x_m, body.length_m / 2 + body.lidar_x_m
    )
    with np.errstate(divide="ignore", over="ignore"):  # along an axis the other side is far
        return np.minimum(np.maximum(ahead, 0.0) / np.abs(cos), (body.width_m / 2) / np.abs(sin))
