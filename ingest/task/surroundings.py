"""Surroundings of a robot, on logs and in the twin: clearance, view of the plan, and approaches.

A scan is reduced to the clearance of each sector of bearing: the distance from the body's outline
to the nearest return.

A plan is a polyline in the map frame, as a navigation stack publishes it (`nav_msgs/Path`), from
somewhere near the robot to its goal. Plans are padded to a common length by repeating their last
point, which adds segments of length 0 at the end.

To find what came nearer, and what lies on the plan, the nearest return of every sector is taken as
a point on the sector's middle bearing. With 36 sectors, that point is within .17 m of the return
at 2 m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from restock import native
from restock.arrays import F64, Bools
from restock.ingest.task.task import Body, Signals, Task

_AWAY_M = 1e-3  # shortest range, so that a return that is too close keeps its beam's direction
UNSEEN_SECTORS = 3  # widest gap of sectors that is filled with the nearer of its neighbours


@dataclass(frozen=True)
class SectorMap:
    """Map of beams to sectors, and the body's extent along each beam.

    Sector 0 starts straight behind (-pi) and sectors go counter-clockwise, so that the robot's
    forward axis lies between sectors K/2 - 1 and K/2. Built once per lidar geometry.
    """

    sectors: int
    order: NDArray[np.intp] | slice  # (B,) beams sorted by sector; a slice if they already are
    starts: NDArray[np.intp]  # (filled,) first position of each non-empty sector in `order`
    filled: NDArray[np.intp]  # (filled,) the sectors that have beams
    reach_m: NDArray[np.float64]  # (B,) distance from the lidar to the outline along the beam

    @classmethod
    def build(cls, bearings_rad: NDArray[Any], sectors: int, body: Body) -> SectorMap:
        """Build the map from the beams' bearings (B,) in the lidar's own frame."""
        bearing = (np.asarray(bearings_rad, np.float64) + body.lidar_yaw_rad + np.pi) % (2 * np.pi)
        sector = np.minimum((bearing * (sectors / (2 * np.pi))).astype(np.intp), sectors - 1)
        order = np.argsort(sector, kind="stable")
        filled, starts = np.unique(sector[order], return_index=True)
        reach = outline_reach(bearing - np.pi, body)
        in_order = bool((np.diff(order) > 0).all())
        return cls(sectors, slice(None) if in_order else order, starts, filled, reach)

    def clearance(
        self, ranges_m: NDArray[Any], range_min_m: float, range_max_m: float
    ) -> NDArray[np.float64]:
        """Reduce ranges (N, B) to clearance per sector (N, K), in [0, range_max_m].

        inf, NaN, and readings below `range_min_m` (the driver's "no valid return") or above
        `range_max_m` count as free up to `range_max_m`; so does a sector without beams. -inf means
        too close to measure (REP 117), so the clearance is 0.
        """
        with np.errstate(invalid="ignore"):  # a damaged range may be a signalling NaN
            ranges = np.asarray(ranges_m, np.float64)
        valid = returned(ranges, range_min_m, range_max_m)
        near = ranges - self.reach_m
        np.copyto(near, range_max_m, where=~valid)
        clearance = np.full((len(ranges), self.sectors), float(range_max_m))
        if len(self.filled):
            nearest = np.minimum.reduceat(near[:, self.order], self.starts, axis=1)
            clearance[:, self.filled] = np.maximum(nearest, 0.0)
        return clearance


@dataclass(frozen=True)
class MovedMap:
    """Map of beams to sectors for a lidar at another position than `[task.body]` gives.

    Sectors are seen from the body's lidar position, so a beam's sector depends on its range.
    """

    sectors: int
    body: Body
    from_m: tuple[float, float]  # how far this lidar is ahead and left of the body's lidar position
    ways: NDArray[np.float64]  # (2, B) cosines and sines of the beams, in the body's frame

    @classmethod
    def build(
        cls, bearings_rad: NDArray[Any], sectors: int, body: Body, at_m: tuple[float, float]
    ) -> MovedMap:
        """Build the map from bearings (B,) and position (x, y) of a lidar in the body's frame."""
        ways = np.stack([np.cos(bearings_rad), np.sin(bearings_rad)])
        return cls(sectors, body, (at_m[0] - body.lidar_x_m, at_m[1]), ways)

    def clearance(
        self, ranges_m: NDArray[Any], range_min_m: float, range_max_m: float
    ) -> NDArray[np.float64]:
        """Compute `SectorMap.clearance`, but NaN for sectors in which no beam ends (`with_unseen`).

        `range_min_m` is measured from this lidar, `range_max_m` from the body's lidar position.
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
    """Return which ranges are returns of an object: False for NaN and inf, True for -inf."""
    inside = (ranges_m >= range_min_m) | (ranges_m == -np.inf)
    return np.asarray(inside & (ranges_m <= range_max_m), np.bool_)


def with_unseen(clearance_m: NDArray[np.float64], range_max_m: float) -> NDArray[np.float64]:
    """Fill sectors in which no beam ends (NaN) in clearances (N, K).

    A gap of up to UNSEEN_SECTORS sectors is the shadow of a near object, seen by a lidar off the
    middle. It gets the clearance of the nearer of the two sectors beside it. A wider gap is outside
    the lidars' field of view, and free up to `range_max_m`, as a sector without beams is.
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
    with np.errstate(divide="ignore", over="ignore"):  # along an axis, one term is inf
        return np.minimum(np.maximum(ahead, 0.0) / np.abs(cos), (body.width_m / 2) / np.abs(sin))


ROUNDING = 1e-13  # tolerance of squared distances: relative, plus a tenth of it in m^2


@dataclass(frozen=True)
class RouteView:
    """What N robots see of their plans from their poses."""

    look_ahead_m: F64  # (N, L, 2) look-ahead points in the body frame (x forward, y left)
    remaining_m: F64  # (N,) arc length from the nearest point on the plan to its end
    offset_m: F64  # (N,) distance to that nearest point


def pad_plans(plans: Sequence[NDArray[Any]]) -> F64:
    """Pad plans of (P_i, 2) points to one array (N, max P, 2)."""
    longest = max((len(plan) for plan in plans), default=1)
    padded = np.empty((len(plans), max(longest, 2), 2))
    for row, plan in zip(padded, plans, strict=True):
        row[: len(plan)] = plan
        row[len(plan) :] = plan[-1]
    return padded


def view_route(
    plans_m: F64, pose_x_m: F64, pose_y_m: F64, pose_yaw_rad: F64, distances_m: Sequence[float]
) -> RouteView:
    """Find look-ahead points at `distances_m` along plans (N, P, 2), from poses (N,).

    A look-ahead point beyond the end of the plan is its end. Compiled code (`restock.native`), if
    in use, gives the same result as NumPy, to the last bit.
    """
    cos, sin = np.cos(pose_yaw_rad), np.sin(pose_yaw_rad)
    if native.IS_USED:
        return _view_compiled(plans_m, pose_x_m, pose_y_m, cos, sin, distances_m)
    # x and y are separate, contiguous arrays for speed: this runs at every step of the twin.
    x, y = np.ascontiguousarray(plans_m[..., 0]), np.ascontiguousarray(plans_m[..., 1])  # (N, P)
    start_x, start_y = x[:, :-1], y[:, :-1]
    step_x, step_y = x[:, 1:] - start_x, y[:, 1:] - start_y
    squared = step_x * step_x + step_y * step_y
    length = np.sqrt(squared)
    arc = np.zeros(x.shape)
    np.cumsum(length, axis=1, out=arc[:, 1:])

    off_x, off_y = pose_x_m[:, None] - start_x, pose_y_m[:, None] - start_y
    along = (off_x * step_x + off_y * step_y) / np.maximum(squared, 1e-12)
    along = np.minimum(np.maximum(along, 0.0), 1.0)
    gap_x, gap_y = off_x - along * step_x, off_y - along * step_y
    distance2 = gap_x * gap_x + gap_y * gap_y
    # If a plan passes the robot twice, equally near but for rounding, take the first pass.
    least = distance2.min(axis=1, keepdims=True)
    nearest = np.argmax(distance2 <= least + ROUNDING * (least + 0.1), axis=1)  # (N,), the first
    rows = np.arange(len(plans_m))
    position = arc[rows, nearest] + along[rows, nearest] * length[rows, nearest]
    total = arc[:, -1]

    body = np.empty((len(plans_m), len(distances_m), 2))
    for column, ahead in enumerate(distances_m):
        target = np.minimum(position + ahead, total)
        # The last vertex at or before the target, then the rest of the way along its segment.
        vertex = np.count_nonzero(arc[:, 1:] < target[:, None], axis=1)
        vertex = np.minimum(vertex, step_x.shape[1] - 1)
        part = (target - arc[rows, vertex]) / np.maximum(length[rows, vertex], 1e-9)
        part = np.minimum(np.maximum(part, 0.0), 1.0)
        ahead_x = start_x[rows, vertex] + part * step_x[rows, vertex] - pose_x_m
        ahead_y = start_y[rows, vertex] + part * step_y[rows, vertex] - pose_y_m
        body[:, column, 0] = cos * ahead_x + sin * ahead_y
        body[:, column, 1] = -sin * ahead_x + cos * ahead_y
    return RouteView(body, total - position, np.sqrt(distance2[rows, nearest]))


def _view_compiled(
    plans_m: F64, x_m: F64, y_m: F64, cos: F64, sin: F64, distances_m: Sequence[float]
) -> RouteView:
    count = len(plans_m)
    look_ahead_m = np.empty((count, len(distances_m), 2))
    remaining_m, offset_m = np.empty(count), np.empty(count)
    native.compiled.view_plans(
        np.ravel(plans_m),
        np.ascontiguousarray(x_m),
        np.ascontiguousarray(y_m),
        cos,
        sin,
        np.array(distances_m),
        look_ahead_m.reshape(-1),
        remaining_m,
        offset_m,
    )
    return RouteView(look_ahead_m, remaining_m, offset_m)


NEAR_M = 2.0  # largest clearance at which `came_nearer` looks for approaches
REMEMBERED_S = 1.0  # a return that was there within this time has not come nearer
FASTEST_MPS = 2.0  # fastest walk: a return that approaches faster was hidden before
MIN_S = 0.25  # shortest time assumed between two scans: a lidar may be slower than the steps
PLAN_PARTS = 3  # points per stretch of a plan: robot to near waypoint, near to far waypoint
GAP_WITHIN = 1.4  # part of the plan that `plan_gap_m` looks at: length in units of `near_m`
MOTION = (*("stamp_ns", "gyro_yaw_rate_radps"), *("localised_speed_mps", "localised_lateral_mps"))
SCANNED = (*MOTION, "sector_clearance_m")  # signals that `came_nearer` needs
_ROUNDING_M = 1e-6  # tolerance for clearances of `range_max_m`, which mean that nothing came back


def steps_remembered(task: Task) -> int:
    """Return the number of earlier steps that `came_nearer` looks at."""
    return max(round(REMEMBERED_S / task.control_period_s), 1)


def came_nearer(task: Task, now: Signals, earlier: Sequence[Signals]) -> F64:
    """Return how much nearer (m) something is than at every earlier step, (N,); 0 if nothing is.

    Each current return within NEAR_M is moved into the robot's frame at each earlier step, by the
    localised speed and the gyroscope. The return came nearer if, at all these steps, the lidar saw
    farther in its sector and both sectors beside it; the result is the smallest of the differences.
    So an edge that a beam hits only sometimes does not count. Neither does something that
    appears from behind a corner, as it is nearer by more than anybody walks. A step at which no
    beam of the three sectors returned shows nothing, and the return does not count. NaN without a
    lidar.

    Args:
        now: the signals SCANNED.
        earlier: the same of up to `steps_remembered` earlier steps, the last one first; before the
            start of an episode, its first step is repeated.
    """
    clearance, count = now["sector_clearance_m"], task.sectors
    if not count:
        return np.full(len(clearance), np.nan)
    elapsed_s = (now["stamp_ns"] - earlier[0]["stamp_ns"]) * 1e-9
    walked_m = FASTEST_MPS * np.maximum(elapsed_s, MIN_S)
    before = np.array([one["sector_clearance_m"] for one in earlier])
    motions = _motions([now, *earlier])
    if not native.IS_USED:
        return _came_by_numpy(task, clearance, before, motions, walked_m)
    sectors, came = _sectors(count, task.body), np.empty(len(clearance))
    native.compiled.find_came(  # equal to NumPy's result, to the last bit
        *(np.ravel(clearance), before.reshape(-1), motions.reshape(-1)),
        walked_m,
        *(sectors.cos, sectors.sin, sectors.reach_m, sectors.ends),
        came,
        (NEAR_M, task.range_max_m - _ROUNDING_M, task.body.lidar_x_m),
    )
    return came


def _came_by_numpy(task: Task, clearance: F64, before: F64, motions: F64, walked_m: F64) -> F64:
    count, sectors = task.sectors, _sectors(task.sectors, task.body)
    # If the lidar is slower than the steps, a scan is repeated, and shows no motion.
    reported = (clearance != before[0]).any(axis=1)
    row, sector = np.nonzero((clearance < NEAR_M) & reported[:, None])
    distance = (clearance + sectors.reach_m)[row, sector]
    lever = task.body.lidar_x_m  # points are seen from the lidar, the body turns about its middle
    x, y = distance * sectors.cos[sector] + lever, distance * sectors.sin[sector]
    came = np.full(len(row), np.inf)
    for scan, motion in zip(before, motions, strict=True):
        if not len(row):
            break
        moved_x, moved_y, cos, sin = motion[:, row]
        x, y = moved_x + cos * x - sin * y, moved_y + sin * x + cos * y
        x_of_lidar = x - lever
        place = np.searchsorted(sectors.ends, _turned(x_of_lidar, y), side="right")
        around = (place[:, None] + (-1, 0, 1)) % count
        seen = scan[row[:, None], around]
        farthest = task.range_max_m - _ROUNDING_M
        seen = np.where(seen < farthest, seen + sectors.reach_m[around], np.inf)
        farther = seen.min(axis=1)
        gain = np.where(np.isinf(farther), 0.0, farther - np.hypot(x_of_lidar, y))
        came = np.minimum(came, gain)
        left = came > 0
        row, x, y, came = row[left], x[left], y[left], came[left]
    walked = came <= walked_m[row]
    most = np.zeros(len(clearance))
    np.maximum.at(most, row[walked], came[walked])
    return most


def _motions(scans: Sequence[Signals]) -> F64:
    """Return the transform from each step's body frame to that of the step before, newest first.

    Each is x, y, cosine and sine of the turn: (steps - 1, 4, N).
    """
    stamp_ns, rate, forward, left = (np.array([scan[name] for scan in scans]) for name in MOTION)
    elapsed_s = (stamp_ns[:-1] - stamp_ns[1:]) * 1e-9
    turn = elapsed_s * (rate[:-1] + rate[1:]) / 2
    forward, left = elapsed_s * forward[:-1], elapsed_s * left[:-1]
    half_cos, half_sin = np.cos(turn / 2), np.sin(turn / 2)  # motion is along the mean heading
    motions = np.empty((len(turn), 4, turn.shape[1]))
    motions[:, 0] = forward * half_cos - left * half_sin
    motions[:, 1] = forward * half_sin + left * half_cos
    motions[:, 2], motions[:, 3] = np.cos(turn), np.sin(turn)
    return motions


def plan_distances_m(task: Task) -> tuple[float, ...]:
    """Return distances along the plan, from its nearest point, for `returns_on_plan`."""
    parts = [part / PLAN_PARTS for part in range(1, PLAN_PARTS)]
    near = (task.near_m * part for part in parts)
    beyond = (task.near_m + (task.far_m - task.near_m) * part for part in parts)
    return (0.0, *near, task.near_m, *beyond, task.far_m)


def returns_on_plan(task: Task, clearance_m: F64, plan_m: F64) -> tuple[F64, F64]:
    """Find lidar returns on and beside the plan.

    `plan_m` (N, L, 2) are the plan's points at `plan_distances_m`, in the body frame; the plan is
    the line through them.

    Returns:
        way_m: distance along the plan to the first return within half the body's width of it, (N,).
        gap_m: distance from the plan just ahead (`GAP_WITHIN` of `near_m`) to the nearest return,
            (N,).
        Both are `range_max_m` if there is no return, or the task has no goal and thus no plan, and
        NaN without a lidar.
    """
    none = np.full(len(clearance_m), float(task.range_max_m) if task.sectors else np.nan)
    if task.goal == "none" or not task.sectors:
        return none, none.copy()
    x, y = sector_returns(task, clearance_m)
    limits = (
        float(task.range_max_m),
        float(task.range_max_m**2),
        (task.body.width_m / 2) ** 2,
        GAP_WITHIN * task.near_m,
    )
    if native.IS_USED:  # equal to NumPy's result, to the last bit
        way_m, gap_m = np.empty(len(none)), np.empty(len(none))
        native.compiled.find_returns(
            *(np.ravel(x), np.ravel(y), np.ravel(clearance_m), np.ravel(plan_m)),
            *(way_m, gap_m, limits),
        )
        return way_m, gap_m
    range_m, range2, on_plan2, ahead_m = limits
    off2 = np.full(clearance_m.shape, np.inf)  # squared distance of each return from the plan
    along_m = np.zeros(clearance_m.shape)  # distance along the plan to its point nearest a return
    passed = np.zeros((len(none), 1))
    for begin, end in pairwise(np.moveaxis(plan_m, 1, 0)):
        line_x, line_y = (end - begin)[:, :1], (end - begin)[:, 1:]
        length2 = np.maximum(line_x**2 + line_y**2, 1e-12)
        off_x, off_y = x - begin[:, :1], y - begin[:, 1:]
        part = np.clip((off_x * line_x + off_y * line_y) / length2, 0.0, 1.0)
        aside2 = (off_x - part * line_x) ** 2 + (off_y - part * line_y) ** 2
        nearer = aside2 < off2
        off2 = np.where(nearer, aside2, off2)
        along_m = np.where(nearer, passed + part * np.sqrt(length2), along_m)
        passed = passed + np.sqrt(length2)
    seen = clearance_m < range_m
    way_m = np.where(seen & (off2 <= on_plan2), along_m, range_m).min(axis=1)
    gap_m = np.sqrt(np.where(seen & (along_m <= ahead_m), off2, range2).min(axis=1))
    return way_m, np.minimum(gap_m, range_m)


def sector_returns(task: Task, clearance_m: F64) -> tuple[F64, F64]:
    """Return body-frame x and y (N, K) of each sector's nearest return, from clearances (N, K)."""
    sectors = _sectors(task.sectors, task.body)
    distance = clearance_m + sectors.reach_m
    return distance * sectors.cos + task.body.lidar_x_m, distance * sectors.sin


class _Sectors(NamedTuple):
    cos: F64  # (K,) cosine of each sector's middle bearing
    sin: F64
    reach_m: F64  # (K,) extent of the body in that direction
    ends: F64  # (K - 1,) end of each sector but the last, as `_turned` values


@lru_cache(maxsize=64)
def _sectors(count: int, body: Body) -> _Sectors:
    width_rad = 2 * np.pi / count
    bearing = np.asarray((np.arange(count) + 0.5) * width_rad - np.pi, np.float64)
    ends = np.arange(1, count) * width_rad - np.pi
    return _Sectors(
        np.cos(bearing),
        np.sin(bearing),
        np.asarray(outline_reach(bearing, body), np.float64),
        _turned(np.cos(ends), np.sin(ends)),
    )


def _turned(x: F64, y: F64) -> F64:
    """Return a value that grows with the bearing of points: -2 at -pi, 0 ahead, and 2 at pi.

    Unlike an arctangent, it is rounded the same on every machine.
    """
    far = np.abs(x) + np.abs(y)
    part = y / np.where(far > 0, far, 1.0)
    return np.where(x >= 0, part, np.where(y >= 0, 2.0 - part, -2.0 - part))
