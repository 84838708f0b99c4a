"""Poses from satellite fixes (NavSatFix, LocationFix): metres east and north of an origin.

Latitude, longitude and the origin go to earth-centred coordinates on the WGS84 ellipsoid (at height
0), and from there to the plane that touches it at the origin, x to the east and y to the north (REP
103; NIMA TR8350.2). Distances within 10 km of the origin are right to 5 mm at that height, and too
short by height / 6,371 km above it: 8 cm per km at 500 m.

A fix does not say where the robot faces. That is the heading of an IMU, where the profile names
one, else the direction of the last `track_m` that were driven: of what came before alone, held
while the robot stands, and turned about where it backs up.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Ints
from restock.ingest.decoding.columns import Ragged, TopicColumns

EQUATOR_M, FLATTENING = 6_378_137.0, 1 / 298.257223563  # WGS84
COVARIANCES = 9  # of a fix
MAX_STD_M = 5.0  # of a fix, where it says and the profile does not
TRACK_M = 1.0
_BLOCK, _SIDES = 64, 16
NO_FIX, UNCERTAIN, NOT_DRIVEN, NO_HEADING = (
    *("no fix", "fix too uncertain", "heading unknown until the robot has driven"),
    "no heading yet",
)


@dataclass(frozen=True)
class Fixes:
    """The fixes of one topic (N,), in the order of its messages, as they were recorded."""

    time_ns: Ints  # log time: what came before is by it
    latitude_deg: F64
    longitude_deg: F64
    status: F64 | None = None  # below 0: no fix (sensor_msgs/NavSatStatus)
    covariance_m2: F64 | None = None  # (N, 9) of east, north and up
    covariance_type: F64 | None = None  # 0: unknown
    yaw_rad: F64 | None = None  # of an IMU at each; NaN: not known. None: by the track

    def std_m(self) -> F64:
        """Return the standard deviation of east or north that each reports; NaN if it does not."""
        std = np.full(len(self.time_ns), np.nan)
        if self.covariance_m2 is not None:
            variance = self.covariance_m2[:, [0, 4]].max(axis=1)
            reported = variance > 0  # False for NaN
            if self.covariance_type is not None:
                reported &= self.covariance_type > 0
            std[reported] = np.sqrt(variance[reported])
        return std

    def problems(self, max_std_m: float) -> NDArray[Any]:
        """Why each is of no use (N,), or ""."""
        problem = np.full(len(self.time_ns), "", object)
        problem[self.std_m() > max_std_m] = UNCERTAIN
        sane = (np.abs(self.latitude_deg) <= 90) & (np.abs(self.longitude_deg) <= 360)
        sane &= (self.latitude_deg != 0) | (self.longitude_deg != 0)  # as receivers say: nothing
        if self.status is not None:
            sane &= self.status >= 0
        problem[~sane] = NO_FIX
        return problem

    def origin_deg(self, max_std_m: float = MAX_STD_M) -> tuple[float, float] | None:
        """Latitude and longitude of the first that is of use; None where none is."""
        good = np.flatnonzero(self.problems(max_std_m) == "")
        if not len(good):
            return None
        first = good[np.argmin(self.time_ns[good])]
        return float(self.latitude_deg[first]), float(self.longitude_deg[first])

    def poses(
        self,
        origin_deg: tuple[float, float] | None = None,
        max_std_m: float | None = None,
        track_m: float | None = None,
    ) -> FixedPoses:
        """Return their poses about the origin (None: the first of use)."""
        max_std_m, track_m = max_std_m or MAX_STD_M, track_m or TRACK_M
        problem = self.problems(max_std_m)
        x, y, yaw = np.full((3, len(problem)), np.nan)
        origin = origin_deg or self.origin_deg(max_std_m)
        good = np.flatnonzero(problem == "")
        if origin is not None:
            plane = local_plane_m(self.latitude_deg[good], self.longitude_deg[good], origin)
            x[good], y[good] = plane.T
        if self.yaw_rad is None:
            order = good[np.argsort(self.time_ns[good], kind="stable")]
            yaw[order] = track_yaw(x[order], y[order], track_m)
            problem[good[np.isnan(yaw[good])]] = NOT_DRIVEN
        else:
            yaw[good] = self.yaw_rad[good]
            problem[good[np.isnan(yaw[good])]] = NO_HEADING
        return FixedPoses(x, y, yaw, problem)


def fixes_of(columns: TopicColumns, fields: Mapping[str, str], yaw: F64 | None = None) -> Fixes:
    """Read a topic's fixes by the `fields` of the profile's input, with a heading at each."""
    named = {}
    for key, path in fields.items():
        column = columns.fields.get(path)
        if isinstance(column, Ragged) and key == "covariance_m2":  # no type fixes its length
            reported = np.flatnonzero(column.lengths == COVARIANCES)
            rows = np.full((len(column), COVARIANCES), np.nan)
            rows[reported] = np.asarray(column.take(reported).values).reshape(-1, COVARIANCES)
            column = rows
        if isinstance(column, np.ndarray):
            named[key] = np.asarray(column, np.float64)
    said = {key: named.get(key) for key in ("status", "covariance_m2", "covariance_type")}
    latitude, longitude = named["latitude_deg"], named["longitude_deg"]
    return Fixes(columns.log_time_ns, latitude, longitude, **said, yaw_rad=yaw)


@dataclass(frozen=True)
class FixedPoses:
    """Poses (N,) by fixes; NaN where there is none (a position may stand without a yaw)."""

    x_m: F64  # to the east
    y_m: F64  # to the north
    yaw_rad: F64  # from the east, counter-clockwise
    problem: NDArray[Any]  # (N,) why there is none, or ""


def local_plane_m(latitude_deg: F64, longitude_deg: F64, origin_deg: tuple[float, float]) -> F64:
    """Metres east and north (N, 2) of the origin, on the plane that touches WGS84 there."""
    phi, lam = np.radians(origin_deg)
    away = _earth_centred_m(latitude_deg, longitude_deg) - _earth_centred_m(
        np.array([origin_deg[0]]), np.array([origin_deg[1]])
    )
    east = np.array([-np.sin(lam), np.cos(lam), 0.0])
    north = np.array([-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)])
    return np.stack([away @ east, away @ north], axis=-1)


def _earth_centred_m(latitude_deg: F64, longitude_deg: F64) -> F64:
    """(N, 3) of points on the ellipsoid."""
    phi, lam = np.radians(latitude_deg), np.radians(longitude_deg)
    squared = FLATTENING * (2 - FLATTENING)  # of the eccentricity
    across = EQUATOR_M / np.sqrt(1 - squared * np.sin(phi) ** 2)
    return np.stack(
        [
            across * np.cos(phi) * np.cos(lam),
            across * np.cos(phi) * np.sin(lam),
            across * (1 - squared) * np.sin(phi),
        ],
        axis=-1,
    )


def track_yaw(x_m: F64, y_m: F64, track_m: float) -> F64:
    """Return the direction (N,) of the last `track_m` up to each position, in the order they came.

    From the latest earlier position that is so far away; where the robot has not been so far from
    where it is since, the direction before is held. NaN until it has driven so far.
    """
    yaw = np.full(len(x_m), np.nan)
    track = _Track(x_m, y_m, track_m)
    held, back = np.nan, 0  # nothing before `back` is looked at: it lies before the last turn
    for here in range(len(x_m)):
        far = track.latest_far(here, back)
        if far is not None:
            back = far
            held = float(np.arctan2(y_m[here] - y_m[back], x_m[here] - x_m[back]))
        yaw[here] = held
    return yaw


class _Track:
    """Positions (N,), of which the latest far one is found without a look at each before.

    A robot that stands for an hour leaves an hour of positions that are all near. So they lie in
    blocks, of twice as many at each level, each within an outline of a few sides: where none of
    its corners is far from here, no position in the block is.
    """

    def __init__(self, x_m: F64, y_m: F64, far_m: float) -> None:
        self._x, self._y, self._far_m = x_m, y_m, far_m
        self._corners: list[F64] = []  # of each level (blocks, _SIDES, 2)
        whole = len(x_m) // _BLOCK * _BLOCK
        angle = np.arange(_SIDES) * (2 * np.pi / _SIDES)
        sides = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        most = [
            (x_m[:whole] * cos + y_m[:whole] * sin).reshape(-1, _BLOCK).max(axis=1)
            for cos, sin in sides
        ]
        reach = np.stack(most, axis=1) + 1e-9 * far_m  # in the direction of each side; rounding
        between = angle[1] - angle[0]
        while len(reach):
            # A side meets the next one so far along it, counter-clockwise.
            along = (np.roll(reach, -1, axis=1) - reach * np.cos(between)) / np.sin(between)
            ahead = np.stack([-sides[:, 1], sides[:, 0]], axis=1)
            self._corners.append(reach[..., None] * sides + along[..., None] * ahead)
            reach = reach[: len(reach) // 2 * 2].reshape(-1, 2, _SIDES).max(axis=1)

    def latest_far(self, here: int, first: int) -> int | None:
        """Return the latest of `first` to `here` that is at least `far_m` away; None if none is."""
        block = here // _BLOCK
        found = self._far_within(block * _BLOCK, here + 1, here, first)
        while found is None and block * _BLOCK > first:  # the blocks before it are left
            level = (block & -block).bit_length() - 1  # of the largest that ends there
            far = self._may_be_far(level, (block >> level) - 1, here)
            while far and level:
                level -= 1
                far = self._may_be_far(level, (block >> level) - 1, here)
            block -= 1 << level
            if far:
                found = self._far_within(block * _BLOCK, (block + 1) * _BLOCK, here, first)
        return found

    def _may_be_far(self, level: int, block: int, here: int) -> bool:
        corners = self._corners[level][block]
        away = (corners[:, 0] - self._x[here]) ** 2 + (corners[:, 1] - self._y[here]) ** 2
        return bool(away.max() >= self._far_m**2)

    def _far_within(self, begin: int, end: int, here: int, first: int) -> int | None:
        begin = max(begin, first)
        rows = slice(begin, end)
        away = np.hypot(self._x[here] - self._x[rows], self._y[here] - self._y[rows])
        far = np.flatnonzero(away >= self._far_m)
        return begin + int(far[-1]) if len(far) else None


__all__ = ["MAX_STD_M", "TRACK_M", "FixedPoses", "Fixes", "fixes_of", "local_plane_m", "track_yaw"]
