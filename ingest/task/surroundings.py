"""What two scans say of the surroundings: who came nearer, and what lies on the plan.

Of every sector the nearest return is taken as a point on the sector's middle bearing: with 36
sectors it is within .17 m of where it is at 2 m. For logs and twin alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise

import numpy as np

from restock.arrays import F64, Ints
from restock.ingest.task.scan import Body, outline_reach
from restock.ingest.task.signals import Signals
from restock.ingest.task.task import Task

NEAR_M = 2.0  # of clearance, for who comes nearer
REMEMBERED_S = 1.0  # what was seen that long ago was there already
FASTEST_MPS = 2.0  # that anybody walks: a return that comes faster was hidden before
LEAST_S = 0.25  # of such a walk: a lidar may be slower than the steps
PLAN_PARTS = 3  # between two look-ahead points, and to the first
GAP_WITHIN = 1.4  # of `near_m`: the plan just ahead
# The signals that it takes.
SCANNED = (
    *("stamp_ns", "gyro_yaw_rate_radps", "sector_clearance_m"),
    *("localised_speed_mps", "localised_lateral_mps"),
)


def steps_remembered(task: Task) -> int:
    """How many steps before its own `came_nearer` looks at."""
    return max(round(REMEMBERED_S / task.control_period_s), 1)


def came_nearer(task: Task, now: Signals, earlier: Sequence[Signals]) -> F64:
    """How far (m) something came nearer since the step before, (N,); 0 where nothing did.

    A return of now within NEAR_M is put where the robot was at each of the steps before, by the
    localised and the gyroscope's motion. Where the lidar saw farther at all of them, in that sector
    and both beside it, it has come; the smallest of these ways is how far. So the edge that a beam
    now hits and now misses does not come, nor does what it came upon behind a corner, which is too
    far to have walked. Where no beam of the three sectors came back nothing is known. NaN without a
    lidar.

    Args:
        now: the signals SCANNED.
        earlier: those of the steps before, the last one first, `steps_remembered` of them or fewer;
            where an episode has none that early, its first again.
    """
    clearance, count = now["sector_clearance_m"], task.sectors
    if not count:
        return np.full(len(clearance), np.nan)
    bearing, reach = _sectors(count, task.body)
    # The same scan again, of a lidar slower than the steps, tells nothing.
    told = (clearance != earlier[0]["sector_clearance_m"]).any(axis=1)
    row, sector = np.nonzero((clearance < NEAR_M) & told[:, None])
    distance = (clearance + reach)[row, sector]
    lever = task.body.lidar_x_m  # points are of the lidar, turns about the middle of the body
    x, y = distance * np.cos(bearing[sector]) + lever, distance * np.sin(bearing[sector])
    came = np.full(len(row), np.inf)
    after = now
    for before in earlier:
        if not len(row):
            break
        x, y = _seen_from(before, after, row, x, y)
        x_of_lidar = x - lever
        place = ((np.arctan2(y, x_of_lidar) + np.pi) * (count / (2 * np.pi))).astype(np.intp)
        around = (np.minimum(place, count - 1)[:, None] + (-1, 0, 1)) % count
        seen = before["sector_clearance_m"][row[:, None], around]
        seen = np.where(seen < task.range_max_m - 1e-6, seen + reach[around], np.inf)
        farther = seen.min(axis=1)
        gain = np.where(np.isinf(farther), 0.0, farther - np.hypot(x_of_lidar, y))
        came = np.minimum(came, gain)
        left = came > 0
        row, x, y, came = row[left], x[left], y[left], came[left]
        after = before
    elapsed_s = (now["stamp_ns"] - earlier[0]["stamp_ns"]) * 1e-9
    walked = came <= FASTEST_MPS * np.maximum(elapsed_s, LEAST_S)[row]
    most = np.zeros(len(clearance))
    np.maximum.at(most, row[walked], came[walked])
    return most


def _seen_from(before: Signals, after: Signals, row: Ints, x: F64, y: F64) -> tuple[F64, F64]:
    """Points (n,) of these rows in the body frame of `after`, in that of the step before."""
    elapsed_s = (after["stamp_ns"] - before["stamp_ns"]) * 1e-9
    turn = elapsed_s * (after["gyro_yaw_rate_radps"] + before["gyro_yaw_rate_radps"]) / 2
    forward, left = (
        elapsed_s * after[name] for name in ("localised_speed_mps", "localised_lateral_mps")
    )
    half_cos, half_sin = np.cos(turn / 2), np.sin(turn / 2)  # motion is along the mean heading
    moved_x, moved_y = forward * half_cos - left * half_sin, forward * half_sin + left * half_cos
    cos, sin = np.cos(turn)[row], np.sin(turn)[row]
    return moved_x[row] + cos * x - sin * y, moved_y[row] + sin * x + cos * y


def plan_distances_m(task: Task) -> tuple[float, ...]:
    """Where along the plan it is looked at for returns, from the point nearest to the robot on."""
    parts = [part / PLAN_PARTS for part in range(1, PLAN_PARTS)]
    near = (task.near_m * part for part in parts)
    beyond = (task.near_m + (task.far_m - task.near_m) * part for part in parts)
    return (0.0, *near, task.near_m, *beyond, task.far_m)


def returns_on_plan(task: Task, clearance_m: F64, plan_m: F64) -> tuple[F64, F64]:
    """What lies on the plan and how far off its middle, of points of it `plan_m` (N, L, 2).

    The points are those at `plan_distances_m`, in the body frame, and the plan the line over them.

    Returns:
        way_m: along the plan to the first lidar return within half the body's width of it, (N,).
        gap_m: from the plan just ahead (`GAP_WITHIN` of `near_m`) to the return nearest to it,
            (N,).
        Both are `range_max_m` where there is none. A task without a goal has no plan, and nothing
        is on it. NaN without a lidar.
    """
    none = np.full(len(clearance_m), float(task.range_max_m) if task.sectors else np.nan)
    if task.goal == "none" or not task.sectors:
        return none, none.copy()
    x, y = sector_returns(task, clearance_m)
    off2 = np.full(clearance_m.shape, np.inf)  # of each return from the plan, squared
    along_m = np.zeros(clearance_m.shape)  # the plan, to where it is nearest
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
    seen = clearance_m < task.range_max_m
    on_it = seen & (off2 <= (task.body.width_m / 2) ** 2)
    ahead = seen & (along_m <= GAP_WITHIN * task.near_m)
    way_m = np.where(on_it, along_m, task.range_max_m).min(axis=1)
    gap_m = np.sqrt(np.where(ahead, off2, task.range_max_m**2).min(axis=1))
    return way_m, np.minimum(gap_m, task.range_max_m)


def sector_returns(task: Task, clearance_m: F64) -> tuple[F64, F64]:
    """x and y (N, K) in the body frame of each sector's nearest return, of clearances (N, K)."""
    bearing, reach = _sectors(task.sectors, task.body)
    distance = clearance_m + reach
    return distance * np.cos(bearing) + task.body.lidar_x_m, distance * np.sin(bearing)


@lru_cache(maxsize=64)
def _sectors(count: int, body: Body) -> tuple[F64, F64]:
    """The middle bearing of each sector (K,), and how far the body reaches that way."""
    bearing = np.asarray((np.arange(count) + 0.5) * (2 * np.pi / count) - np.pi, np.float64)
    return bearing, outline_reach(bearing, body)
