"""The plans that were in force, rebuilt from what the robot saw of them.

A store keeps no plans, but every row keeps two points of its plan (the look-ahead points) and how
much of it remained. In the map frame those points lie on the plan, each with a known length to its
end, so the rows that were driven under one plan give back most of it: from 1 m ahead of where it
was first seen to 2.2 m ahead of where it was last seen. That is what another pose, a little beside
the logged one, sees of the plan.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.ingest.steps.routing import Routing
from restock.ingest.task.signals import Columns
from restock.ingest.task.task import Task
from restock.train.twin.calibration.logged_steps import LoggedSteps

F64 = NDArray[np.float64]
Ints = NDArray[np.int64]

SAME_M = 1e-3  # what remains of a plan is stored as float32
SPACING_M = 0.02  # points nearer to each other than this give no direction
ROUTE = (
    *("waypoint_near_x_m", "waypoint_near_y_m", "waypoint_far_x_m", "waypoint_far_y_m"),
    "route_remaining_m",
)


@dataclass(frozen=True)
class PlanMemory:
    """The plans of N logged steps."""

    task: Task
    routing: Routing  # `plan` (N,) is what was in force at t
    next_plan: Ints  # (N,) at t + 1
    error_m: float  # of what remains, seen on the rebuilt plans from the logged poses, median

    def seen_after(self, steps: LoggedSteps, rows: Ints, pose: Columns) -> dict[str, F64]:
        """The route's signals at t + 1 from other poses (n,), for `rows` (n,).

        The logged ones, and what the rebuilt plan says of the difference between the two poses:
        where that is small, so is what was not rebuilt exactly.
        """
        after = {name: column[rows] for name, column in steps.after.items()}
        moved = self._view(self.next_plan[rows], pose)
        logged = self._view(self.next_plan[rows], after)
        return {name: after[name] + moved[name] - logged[name] for name in ROUTE}

    def progress_m(self, steps: LoggedSteps, rows: Ints, pose: Columns) -> F64:
        """How much shorter the plan in force at t would have become, had it ended at `pose`."""
        plan = self.routing.plan[rows]
        now, after = ({n: c[rows] for n, c in side.items()} for side in (steps.now, steps.after))
        moved = self.routing.progress_m(self.task, plan, now, pose)
        logged = self.routing.progress_m(self.task, plan, now, after)
        return np.asarray(steps.progress_m[rows] + moved - logged, np.float64)

    def _view(self, plan: Ints, pose: Columns) -> dict[str, F64]:
        seen = self.routing.view(self.task, plan, pose)
        near, far = seen.look_ahead_m[:, 0], seen.look_ahead_m[:, 1]
        values = (near[:, 0], near[:, 1], far[:, 0], far[:, 1], seen.remaining_m)
        return dict(zip(ROUTE, values, strict=True))


def rebuild_plans(steps: LoggedSteps) -> PlanMemory:
    """The plans of all rows; none where the task has no route."""
    count = len(steps)
    if steps.task.goal != "route":
        nowhere = np.full(count, -1, np.int64)
        return PlanMemory(steps.task, Routing.none(count), nowhere, 0.0)
    now, after = steps.now["route_remaining_m"], steps.after["route_remaining_m"]
    kept = np.abs(now - steps.progress_m - after) < SAME_M  # the same plan at t + 1
    starts = steps.begins | ~np.append(False, kept[:-1])
    plan = np.cumsum(starts) - 1
    first = np.append(np.flatnonzero(starts), count)
    plans = [_rebuild(steps, a, b) for a, b in pairwise(first.tolist())]
    empty = np.full(count, -1, np.int64)
    routing = Routing(np.zeros((0, 2)), plans, empty, plan.astype(np.int64), empty)
    goes_on = np.append(~steps.begins[1:], False)
    next_plan = np.where(goes_on, np.append(plan[1:], plan[-1:]), plan).astype(np.int64)
    seen = routing.view(steps.task, routing.plan, steps.now)
    error = float(np.median(np.abs(seen.remaining_m - now)))
    return PlanMemory(steps.task, routing, next_plan, error)


def _rebuild(steps: LoggedSteps, begin: int, end: int) -> F64:
    """The polyline (P, 2) of rows [begin, end) that saw one plan."""
    rows = slice(begin, end)
    x, y = steps.now["pose_x_m"][rows], steps.now["pose_y_m"][rows]
    yaw, remaining = steps.now["pose_yaw_rad"][rows], steps.now["route_remaining_m"][rows]
    points: list[NDArray[Any]] = [np.array([[x[0], y[0]]])]  # plans begin at the robot
    left: list[NDArray[Any]] = [remaining[:1]]
    for name, ahead in (("near", steps.task.near_m), ("far", steps.task.far_m)):
        bx, by = (steps.now[f"waypoint_{name}_{axis}_m"][rows] for axis in "xy")
        on_map = [x + np.cos(yaw) * bx - np.sin(yaw) * by, y + np.sin(yaw) * bx + np.cos(yaw) * by]
        points.append(np.stack(on_map, axis=-1))
        left.append(np.maximum(remaining - ahead, 0.0))
    point, to_go = np.concatenate(points), np.concatenate(left)
    order = np.argsort(-to_go, kind="stable")
    kept = [order[0]]
    for index in order[1:]:
        if to_go[kept[-1]] - to_go[index] >= SPACING_M:
            kept.append(index)
    line, rest = point[kept], float(to_go[kept[-1]])
    if len(line) == 1:
        ahead_of = np.array([np.cos(yaw[0]), np.sin(yaw[0])])
        return np.stack([line[0], line[0] + ahead_of * max(rest, SPACING_M)])
    if rest > 0:  # not seen to its end: straight on, for the length that remains
        way = line[-1] - line[-2]
        way = way / max(float(np.hypot(*way)), 1e-9)
        line = np.concatenate([line, (line[-1] + way * rest)[None]])
    return np.asarray(line, np.float64)
