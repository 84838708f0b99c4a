"""Goal and plan in force at each tick, and the signals that follow from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from restock.arrays import F64, Ints
from restock.ingest.task.route import RouteView, pad_plans, view_route
from restock.ingest.task.signals import Signals
from restock.ingest.task.surroundings import PLAN_PARTS, plan_distances_m, returns_on_plan
from restock.ingest.task.task import Task, clearance_ahead

# A number beyond this, in any unit that a signal has, is a fault: of a position, a store's float32
# could not tell centimetres apart.
LARGEST = 1e6
TOO_LARGE = "beyond a million"
_CHUNK = 4096  # poses at a time: bounds memory whatever the recording's length


@dataclass(frozen=True)
class Routing:
    """The goals and plans of a recording, and which are in force at each of T ticks.

    Without any, the way is straight ahead: look-ahead points on the robot's forward axis, and
    nothing remaining.
    """

    goals_m: F64  # (G, 2)
    plans_m: Sequence[F64]  # each (P, 2), map frame
    goal: Ints  # (T,) index of a goal, the same for the same place; -1 is none
    plan: Ints  # (T,) index of a plan; -1 is none
    order: Ints  # (T,) the message with it: a goal may be ordered again

    @classmethod
    def none(cls, ticks: int) -> Routing:
        """Return a routing without any goal or plan."""
        nowhere = np.full(ticks, -1, np.int64)
        return cls(np.zeros((0, 2)), [], nowhere, nowhere, nowhere)

    def view(self, task: Task, plan: Ints, pose: Signals) -> RouteView:
        """Along plan `plan[i]` from pose i to `plan_distances_m`, for N poses."""
        count, at_m = len(plan), plan_distances_m(task)
        ahead = np.zeros((count, len(at_m), 2))
        ahead[:, :, 0] = at_m
        remaining, offset = np.zeros(count), np.zeros(count)
        planned = np.flatnonzero(plan >= 0)
        for start in range(0, len(planned), _CHUNK):
            rows = planned[start : start + _CHUNK]
            used, inverse = np.unique(plan[rows], return_inverse=True)
            padded = pad_plans([self.plans_m[index] for index in used])[inverse]
            x, y, yaw = (pose[name][rows] for name in ("pose_x_m", "pose_y_m", "pose_yaw_rad"))
            seen = view_route(padded, x, y, yaw, at_m)
            ahead[rows], offset[rows] = seen.look_ahead_m, seen.offset_m
            remaining[rows] = seen.remaining_m
        return RouteView(ahead, remaining, offset)

    def signals(self, task: Task, goal: Ints, plan: Ints, now: Signals) -> Signals:
        """Compute the route's signals for N steps with `goal[i]` and `plan[i]` in force."""
        seen = self.view(task, plan, now)
        distance = np.zeros(len(goal))
        aimed = np.flatnonzero(goal >= 0)
        position = np.stack([now["pose_x_m"], now["pose_y_m"]], axis=-1)
        distance[aimed] = np.linalg.norm(self.goals_m[goal[aimed]] - position[aimed], axis=-1)
        # Copies: of the points between them nothing is kept.
        near, far = (seen.look_ahead_m[:, part * PLAN_PARTS].T.copy() for part in (1, 2))
        way_m, gap_m = returns_on_plan(task, now["sector_clearance_m"], seen.look_ahead_m)
        return {
            "waypoint_near_x_m": near[0],
            "waypoint_near_y_m": near[1],
            "waypoint_far_x_m": far[0],
            "waypoint_far_y_m": far[1],
            "route_remaining_m": seen.remaining_m,
            "goal_distance_m": distance,
            "clearance_ahead_m": clearance_ahead(task, now["sector_clearance_m"], near[0], near[1]),
            "plan_return_m": way_m,
            "plan_gap_m": gap_m,
        }

    def progress_m(self, task: Task, plan: Ints, now: Signals, after: Signals) -> F64:
        """Return how much shorter plan `plan[i]` became from `now` to `after`.

        Without a plan, how far the robot moved forward (along the mean of its two headings).
        """
        shorter: F64 = now["route_remaining_m"] - self.view(task, plan, after).remaining_m
        turn = after["pose_yaw_rad"] - now["pose_yaw_rad"]
        heading = now["pose_yaw_rad"] + ((turn + np.pi) % (2 * np.pi) - np.pi) / 2
        forward = np.cos(heading) * (after["pose_x_m"] - now["pose_x_m"])
        forward = forward + np.sin(heading) * (after["pose_y_m"] - now["pose_y_m"])
        return np.where(plan >= 0, shorter, forward)


def same_goals(goals_m: F64, moved_m: float) -> Ints:
    """Goals (G, 2) in the order they came -> for each the first of its run of equal goals (G,)."""
    first = np.arange(len(goals_m), dtype=np.int64)
    for index in range(1, len(goals_m)):
        if np.linalg.norm(goals_m[index] - goals_m[first[index - 1]]) <= moved_m:
            first[index] = first[index - 1]
    return first


def plan_problems(plans_m: Sequence[F64]) -> list[str]:
    """Describe what is wrong with each plan by itself; "" if nothing is."""
    problems = []
    for plan in plans_m:
        if not len(plan):
            problems.append("empty")
        else:
            sane = (np.abs(plan) <= LARGEST).all()  # False for NaN
            problems.append("" if sane else "not finite")
    return problems


def plan_ends(plans_m: Sequence[F64]) -> F64:
    """Return the last point of each plan (P, 2); NaN if it has none."""
    ends = np.full((len(plans_m), 2), np.nan)
    for index, plan in enumerate(plans_m):
        if len(plan):
            ends[index] = plan[-1]
    return ends
