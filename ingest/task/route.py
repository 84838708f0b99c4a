"""Position of a robot along its plan: look-ahead points and what remains, for logs and twin.

A plan is a polyline in the map frame, as a navigation stack publishes it (`nav_msgs/Path`), from
somewhere near the robot to its goal. Plans are padded to a common length by repeating their last
point, which adds segments of no length at the end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock import native
from restock.arrays import F64

ROUNDING = 1e-13  # of squared distances, relative; near 0 a tenth of it in m^2


@dataclass(frozen=True)
class RouteView:
    """View of its plan for a robot at a pose."""

    look_ahead_m: F64  # (N, L, 2) look-ahead points in the body frame (x forward, y left)
    remaining_m: F64  # (N,) arc length from the nearest point on the plan to its end
    offset_m: F64  # (N,) distance to that nearest point


def pad_plans(plans: Sequence[NDArray[Any]]) -> F64:
    """Plans of (P_i, 2) points each to one array (N, max P, 2)."""
    longest = max((len(plan) for plan in plans), default=1)
    padded = np.empty((len(plans), max(longest, 2), 2))
    for row, plan in zip(padded, plans, strict=True):
        row[: len(plan)] = plan
        row[len(plan) :] = plan[-1]
    return padded


def view_route(
    plans_m: F64, pose_x_m: F64, pose_y_m: F64, pose_yaw_rad: F64, distances_m: Sequence[float]
) -> RouteView:
    """Plans (N, P, 2) and poses (N,) to look-ahead points at `distances_m` along the plan.

    A look-ahead point beyond the end of the plan is its end. Compiled code, where there is some
    (`restock.native`), does what NumPy does without it, to the last bit.
    """
    cos, sin = np.cos(pose_yaw_rad), np.sin(pose_yaw_rad)
    if native.is_used():
        return _view_compiled(plans_m, pose_x_m, pose_y_m, cos, sin, distances_m)
    # Coordinate by coordinate on contiguous arrays: this runs at every step of the twin.
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
    # Where a plan comes by twice it is at the first time, whatever rounding makes of the two.
    least = distance2.min(axis=1, keepdims=True)
    nearest = np.argmax(distance2 <= least + ROUNDING * (least + 0.1), axis=1)  # (N,), the first
    rows = np.arange(len(plans_m))
    here = arc[rows, nearest] + along[rows, nearest] * length[rows, nearest]
    total = arc[:, -1]

    body = np.empty((len(plans_m), len(distances_m), 2))
    for column, ahead in enumerate(distances_m):
        target = np.minimum(here + ahead, total)
        # The last vertex at or before the target, then the rest of the way along its segment.
        vertex = np.count_nonzero(arc[:, 1:] < target[:, None], axis=1)
        vertex = np.minimum(vertex, step_x.shape[1] - 1)
        part = (target - arc[rows, vertex]) / np.maximum(length[rows, vertex], 1e-9)
        part = np.minimum(np.maximum(part, 0.0), 1.0)
        ahead_x = start_x[rows, vertex] + part * step_x[rows, vertex] - pose_x_m
        ahead_y = start_y[rows, vertex] + part * step_y[rows, vertex] - pose_y_m
        body[:, column, 0] = cos * ahead_x + sin * ahead_y
        body[:, column, 1] = -sin * ahead_x + cos * ahead_y
    return RouteView(body, total - here, np.sqrt(distance2[rows, nearest]))


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
