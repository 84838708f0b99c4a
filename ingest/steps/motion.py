"""Speeds from poses, where a robot has no odometry: the slope of the poses just before a tick.

A straight line is fitted to the poses of the last `window_s` up to the latest one at the tick, none
later. What it says is the motion in the middle of that window, half of it ago: a longer window
takes off more of the localiser's noise, and says later what happened. Poses that arrive together
span too little time for a speed: the one before the window then belongs to it. A tick without poses
that are far enough apart in time has no speed, nor has one with a jump in its window: the robot
cannot have driven so far, so the localiser found it elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Bools, Ints
from restock.ingest.steps.frames import Tree
from restock.ingest.task.signals import wrap_angle

SCATTER_M = 0.05  # between two poses: less is no jump
_CHUNK = 4096  # ticks at a time: bounds memory


@dataclass(frozen=True)
class PoseSeries:
    """The poses of one stretch of a recording, in the order of their stamps."""

    stamp_ns: Ints  # (N,) ascending
    x_m: F64
    y_m: F64
    yaw_rad: F64

    @classmethod
    def of(cls, stamp_ns: Ints, x_m: F64, y_m: F64, yaw_rad: F64) -> PoseSeries:
        """Keep the finite poses; of equal stamps the last."""
        keep = np.isfinite(x_m) & np.isfinite(y_m) & np.isfinite(yaw_rad)
        keep[:-1] &= np.diff(stamp_ns) > 0
        return cls(stamp_ns[keep], x_m[keep], y_m[keep], yaw_rad[keep])

    @classmethod
    def joined(cls, parts: Sequence[PoseSeries]) -> PoseSeries:
        """Stretches that follow one another, as one."""
        return cls.of(
            *(np.concatenate([getattr(part, name) for part in parts]) for name in _COLUMNS)
        )

    def __len__(self) -> int:
        return len(self.stamp_ns)


_COLUMNS = ("stamp_ns", "x_m", "y_m", "yaw_rad")


def poses_along(tree: Tree) -> list[PoseSeries]:
    """Return every pose of a tree's base in its fixed frame, by segment."""
    times = tree.times(tree.frames.base)
    at = tree.place(tree.frames.base, times)
    x, y = (np.where(at.problem == "", column, np.nan) for column in at.translation_m.T[:2])
    ends = np.cumsum([len(stamps) for stamps in times])[:-1]
    parts = zip(times, *(np.split(column, ends) for column in (x, y, at.yaw_rad)), strict=True)
    return [PoseSeries.of(*part) for part in parts]


@dataclass(frozen=True)
class Motion:
    """Speeds at T ticks, in the body frame of the middle of each window."""

    forward_mps: F64
    lateral_mps: F64
    yaw_rate_radps: F64
    problem: NDArray[Any]  # (T,) why there is none, or ""


def motion_at(
    poses: PoseSeries,
    tick_ns: Ints,
    window_s: float,
    max_jump_m: float,
    fastest_mps: float = math.inf,
) -> Motion:
    """Compute the motion at ticks (T,) by the poses of the `window_s` before each one's latest.

    A step of more than `max_jump_m` is a jump, and so is one that a robot of `fastest_mps` does not
    drive in the time of the step and a window more: stamps jitter, and it may be faster than asked.
    """
    count = len(tick_ns)
    out = Motion(np.zeros(count), np.zeros(count), np.zeros(count), np.full(count, "", object))
    end = np.searchsorted(poses.stamp_ns, tick_ns, "right")
    latest = np.maximum(end - 1, 0)
    if not len(poses):
        out.problem[:] = "no pose yet"
        return out
    window_ns, latest_ns = round(window_s * 1e9), poses.stamp_ns[latest]
    begin = np.searchsorted(poses.stamp_ns, latest_ns - window_ns)
    together = latest_ns - poses.stamp_ns[begin] < window_ns // 2
    earlier = np.maximum(begin - 1, 0)
    together &= latest_ns - poses.stamp_ns[earlier] <= 2 * window_ns
    begin = np.where(end > 0, np.where(together, earlier, begin), end)
    few = (end == 0) | (latest_ns - poses.stamp_ns[begin] < window_ns // 2)
    out.problem[few] = f"no pose from {window_s / 2:g} to {2 * window_s:g} s before the last one"
    reach_m = fastest_mps * (np.diff(poses.stamp_ns) * 1e-9 + window_s) + SCATTER_M
    steps_m = np.hypot(np.diff(poses.x_m), np.diff(poses.y_m))
    jumps = steps_m > np.minimum(reach_m, max_jump_m)
    before = np.concatenate([[0], np.cumsum(jumps)])  # jumps up to each pose
    jumped = ~few & (before[latest] > before[np.minimum(begin, len(poses) - 1)])
    out.problem[jumped] = f"a pose jump within {window_s:g} s"
    turned = np.concatenate([[0.0], np.cumsum(wrap_angle(np.diff(poses.yaw_rad)))])
    heading = poses.yaw_rad[:1] + turned  # without the wrap
    usable = np.flatnonzero(~few & ~jumped)
    for start in range(0, len(usable), _CHUNK):
        rows = usable[start : start + _CHUNK]
        _fill(out, rows, poses, heading, begin[rows], end[rows])
    return out


def _fill(out: Motion, rows: Ints, poses: PoseSeries, heading: F64, begin: Ints, end: Ints) -> None:
    """Fit the slopes of the poses from `begin` to before `end`, into these rows."""
    most = int((end - begin).max())
    at = begin[:, None] + np.arange(most)  # (R, P)
    inside: Bools = at < end[:, None]
    at = np.minimum(at, len(poses) - 1)
    weight = inside / inside.sum(axis=1, keepdims=True)
    since = (poses.stamp_ns[at] - poses.stamp_ns[end - 1][:, None]) * 1e-9
    since -= (since * weight).sum(axis=1, keepdims=True)
    spread = (since**2 * weight).sum(axis=1)

    def slope(values: F64) -> F64:
        column = values[at] - values[end - 1][:, None]
        return np.asarray((since * column * weight).sum(axis=1) / spread, np.float64)

    vx, vy = slope(poses.x_m), slope(poses.y_m)
    ahead = (heading[at] * weight).sum(axis=1)
    cos, sin = np.cos(ahead), np.sin(ahead)
    out.forward_mps[rows] = cos * vx + sin * vy
    out.lateral_mps[rows] = cos * vy - sin * vx
    out.yaw_rate_radps[rows] = slope(heading)
