"""Where along its plan a robot is: look-ahead points and what remains, for logs and twin alike.

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

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class RouteView:
    """What a robot at a pose sees of its plan."""

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

    A look-ahead point beyond the end of the plan is its end.
    """
    position = np.stack([pose_x_m, pose_y_m], axis=-1)[:, None, :]  # (N, 1, 2)
    start = plans_m[:, :-1]  # (N, P-1, 2)
    step = plans_m[:, 1:] - start
    squared = np.einsum("npd,npd->np", step, step)
    length = np.sqrt(squared)
    arc = np.concatenate([np.zeros((len(plans_m), 1)), np.cumsum(length, axis=1)], axis=1)

    along = np.einsum("npd,npd->np", position - start, step) / np.maximum(squared, 1e-12)
    along = np.clip(along, 0.0, 1.0)
    gap = position - (start + along[..., None] * step)
    distance2 = np.einsum("npd,npd->np", gap, gap)
    nearest = np.argmin(distance2, axis=1)  # (N,)
    rows = np.arange(len(plans_m))
    here = arc[rows, nearest] + along[rows, nearest] * length[rows, nearest]
    total = arc[:, -1]

    points = np.empty((len(plans_m), len(distances_m), 2))
    for column, ahead in enumerate(distances_m):
        target = np.minimum(here + ahead, total)
        # The last vertex at or before the target, then the rest of the way along its segment.
        vertex = np.clip((arc[:, 1:] < target[:, None]).sum(axis=1), 0, step.shape[1] - 1)
        part = (target - arc[rows, vertex]) / np.maximum(length[rows, vertex], 1e-9)
        points[:, column] = start[rows, vertex] + np.clip(part, 0, 1)[:, None] * step[rows, vertex]

    delta = points - position
    cos, sin = np.cos(pose_yaw_rad)[:, None], np.sin(pose_yaw_rad)[:, None]
    body = np.stack(
        [
            cos * delta[..., 0] + sin * delta[..., 1],
            -sin * delta[..., 0] + cos * delta[..., 1],
        ],
        axis=-1,
    )
    return RouteView(body, total - here, np.sqrt(distance2[rows, nearest]))
