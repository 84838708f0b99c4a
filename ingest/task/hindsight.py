"""Goals in hindsight: the place that a drive reached is its goal (arXiv:1707.01495).

They serve recordings without a goal topic. A drive is cut into missions, and the goal of each
mission is the place where it ended: where the robot stood still, where it turned back, or as far as
an episode may go. If the drive passed that place earlier, left it and came back, the mission ends
at the first pass, and the rest is cut again. The route is the driven path, thinned and without
loops.

Goal and route come from the future, by definition; nothing else here does. Every mission arrives by
construction, so that its success is no evidence about the driver.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from restock.arrays import F64, Bools, Ints
from restock.ingest.task.task import Task
from restock.toml import Checked

NO_MISSION = "goal: none in hindsight"  # why ticks without a mission are dropped
STANDING = f"{NO_MISSION}, standing still"
NOWHERE = f"{NO_MISSION}, nowhere far enough"

_SHORTEST = 3.0  # shortest distance from start to goal, in goal radii
_WAIT_S = 10.0  # a mission includes at most this much of the standing before its drive
_BACK = 0.6  # below this share of its farthest distance from the start, the robot turned back
_LIMIT = 0.9  # longest mission, as a share of the task's time limit

GoalSource = Literal["logged", "hindsight"]


class GoalRules(Checked, frozen=True):
    """The `[goal]` of a profile: where a route's goals come from."""

    source: GoalSource = "logged"  # "logged": from inputs.goal and inputs.plan
    still_s: Annotated[float, Meta(gt=0)] = 3.0  # a robot that stands this long has arrived
    longest_m: Annotated[float, Meta(gt=0)] = 10.0  # longest distance from start to goal


def shortest_m(task: Task) -> float:
    """Return the shortest distance from a mission's start to its goal."""
    return _SHORTEST * task.goal_radius_m


@dataclass(frozen=True)
class Missions:
    """A recording's M missions, and the mission of each of T ticks."""

    mission: Ints  # (T,) index of the mission; -1: none
    goals_m: F64  # (M, 2)
    routes_m: list[F64]  # each (P, 2), from the mission's start to its goal
    ended_at: list[str]  # (M,) why the mission ends there
    standing: Bools  # (T,) whether the robot stands still; False during a mission's drive
    driven_m: float
    shortest_m: float

    @property
    def problem(self) -> list[str]:
        """Return why each tick has no goal, (T,); "" if it has one."""
        without = np.where(self.mission < 0, NOWHERE, "")
        return [str(text) for text in np.where(self.standing, STANDING, without)]

    def __str__(self) -> str:
        if not len(self.goals_m):
            return (
                f"goals: none in hindsight, as the robot was never {self.shortest_m:g} m from "
                f"where it started ({self.driven_m:.1f} m driven)"
            )
        ends = Counter(self.ended_at).most_common()
        places = len(np.unique(self.goals_m, axis=0))
        return (
            f"goals: in hindsight, over {self.driven_m:.0f} m driven; missions {len(self.goals_m)}"
            f" ({', '.join(f'{why} {n}' for why, n in ends)}), places {places}; each mission"
            " arrives by construction, so no success is counted"
        )


def missions(
    rules: GoalRules, task: Task, xy_m: F64, stamp_ns: Ints, located: Bools, leg: Ints
) -> Missions:
    """Split a drive into missions.

    Args:
        rules: how long the robot stands at a goal, and the longest distance from start to goal.
        task: for its goal radius and time limit.
        xy_m: (T, 2) positions.
        stamp_ns: (T,) stamps of the ticks.
        located: (T,) whether the position is known; an unknown position does not end a drive.
        leg: (T,) a number that changes whenever the robot was carried or the clock was set; every
            mission lies within one leg.
    """
    at = np.flatnonzero(located)
    found = _MissionCutter(rules, task, xy_m[at], stamp_ns[at], leg[at]).missions()
    # Ticks without a position get the mission of the tick before.
    before = np.searchsorted(at, np.arange(len(stamp_ns)), "right") - 1
    mission = np.where(before >= 0, np.append(found.mission, -1)[before], -1)
    standing = (before >= 0) & np.append(found.standing, False)[before]
    return replace(found, mission=mission, standing=standing)


class _MissionCutter:
    """Cuts a drive into missions, leg by leg; within a leg the robot was not carried."""

    def __init__(self, rules: GoalRules, task: Task, xy_m: F64, stamp_ns: Ints, leg: Ints) -> None:
        self.rules, self.radius_m = rules, task.goal_radius_m
        self.xy_m = xy_m
        self.at_s = np.cumsum(np.maximum(np.diff(stamp_ns, prepend=stamp_ns[:1]), 0)) * 1e-9
        self.leg = leg
        self.shortest_m = shortest_m(task)
        self.longest_s = _LIMIT * task.time_limit_steps * task.control_period_s
        self.standing = self._standing()  # `_add` clears the ticks of each mission
        self.mission = np.full(len(xy_m), -1, np.int64)
        self.goals: list[F64] = []
        self.routes: list[F64] = []
        self.ended_at: list[str] = []

    def missions(self) -> Missions:
        starts = np.flatnonzero(np.diff(self.leg, prepend=self.leg[:1] - 1))
        stops = np.append(starts, len(self.leg))[1:] - 1
        for first, last in zip(starts, stops, strict=True):
            end = "end of the recording" if last == len(self.leg) - 1 else "carried off"
            self._cut_leg(int(first), int(last), end)
        return Missions(
            self.mission,
            np.array(self.goals).reshape(-1, 2),
            self.routes,
            self.ended_at,
            self.standing,
            driven_m(self.xy_m, self.leg, self.radius_m / 2),
            self.shortest_m,
        )

    def _cut_leg(self, first: int, last: int, end: str) -> None:
        """Add the missions of one leg, between the places where the robot stood still."""
        changes = np.flatnonzero(np.diff(self.standing[first : last + 1].astype(np.int8)))
        stood = first
        bounds = [first, *(changes + first + 1).tolist(), last + 1]
        for begin, stop in pairwise(bounds):
            if self.standing[begin]:
                if self.mission[begin] >= 0:  # a reached goal stays in force at rest
                    self.mission[begin:stop] = self.mission[begin]
                stood = begin + 1 if self.mission[begin] >= 0 else begin
                continue
            arrives = stop <= last
            # The drive begins up to _WAIT_S before the robot sets off, as it may turn in place.
            since = np.searchsorted(self.at_s, self.at_s[begin] - _WAIT_S, "left")
            start = min(max(stood, int(since)), begin)
            self._cut_drive(start, stop if arrives else last, "stood still" if arrives else end)

    def _cut_drive(self, start: int, stop: int, end: str) -> None:
        """Add the missions of a drive without a stop, from tick `start` to tick `stop`."""
        while start < stop:
            late = np.searchsorted(self.at_s, self.at_s[start] + self.longest_s, "right") - 1
            reach = min(stop, max(int(late), start + 1))
            away = np.hypot(*(self.xy_m[start : reach + 1] - self.xy_m[start]).T)
            if (over := np.flatnonzero(away > self.rules.longest_m)).size:
                away = away[: max(int(over[0]), 2)]
                reach = start + len(away) - 1
            farthest = np.maximum.accumulate(away)
            back = np.flatnonzero((farthest >= self.shortest_m) & (away < _BACK * farthest))
            if len(back):
                goal, why = start + int(away[: back[0]].argmax()), "turned back"
            elif reach == stop:
                goal, why = stop, end
            else:
                goal, why = self._way_point(start, away)
            if away[goal - start] < self.shortest_m:
                start = max(goal, start + 1)  # too near to be a goal
                continue
            start = self._add(start, goal, why, last=goal == stop)

    def _way_point(self, start: int, away: F64) -> tuple[int, str]:
        """Return the goal's tick if the drive goes on: the last tick far enough from the start."""
        far = np.flatnonzero(away >= self.shortest_m)
        return start + (int(far[-1]) if len(far) else len(away) - 1), "far enough"

    def _add(self, start: int, end: int, why: str, *, last: bool) -> int:
        """Add the mission that ends at tick `end`; return the tick at which the next one starts."""
        goal = self._place(self.xy_m[end])
        gap = np.hypot(*(self.xy_m[start : end + 1] - goal).T)
        arrival = start + int(np.flatnonzero(gap <= self.radius_m)[0])
        if (gap[arrival - start :] > self.shortest_m).any():  # the robot left again: end at arrival
            end, why, last = arrival, "came back later", False
        number = len(self.goals)
        self.goals.append(goal)
        self.routes.append(route_of(self.xy_m[start : end + 1], goal, self.radius_m / 2))
        self.ended_at.append(why)
        # If the drive goes on, the next goal is in force as soon as this one is reached.
        self.mission[start : (end if last else arrival) + 1] = number
        self.standing[start:end] = False
        return end if last else max(arrival, start + 1)

    def _place(self, goal: F64) -> F64:
        """Return the goal of an earlier mission at the same place, if any, or else this goal."""
        if self.goals:
            gap = np.hypot(*(np.array(self.goals) - goal).T)
            if gap.min() <= self.radius_m / 2:
                return self.goals[int(gap.argmin())]
        return goal

    def _standing(self) -> Bools:
        """Return at which ticks (T,) the robot stays in its place for `still_s` or longer.

        Judged by position, so that turning in place counts as standing.
        """
        count = len(self.at_s)
        until = np.searchsorted(self.at_s, self.at_s + self.rules.still_s, "left")  # (T,)
        ended = np.minimum(until, count - 1)
        still = (until < count) & (self.leg[ended] == self.leg)
        for ahead in range(1, int((ended - np.arange(count)).max(initial=0)) + 1):
            then = np.minimum(np.arange(count) + ahead, ended)
            still &= np.hypot(*(self.xy_m[then] - self.xy_m).T) <= self.radius_m / 2
        edges = np.zeros(count + 1, np.int64)
        np.add.at(edges, np.flatnonzero(still), 1)
        np.add.at(edges, ended[still] + 1, -1)
        return np.cumsum(edges)[:count] > 0


def driven_m(xy_m: F64, leg: Ints, band_m: float) -> float:
    """Return the distance driven, in steps of more than `band_m`, so that noise does not count."""
    driven, last = 0.0, (math.nan, math.nan, -1)
    for x, y, number in zip(xy_m[:, 0].tolist(), xy_m[:, 1].tolist(), leg.tolist(), strict=True):
        step = math.hypot(x - last[0], y - last[1])
        if number != last[2]:
            last = (x, y, number)
        elif step > band_m:
            driven, last = driven + step, (x, y, number)
    return driven


def route_of(driven_m: F64, goal_m: F64, spacing_m: float) -> F64:
    """Thin the driven path (N, 2) to a route (P, 2) of points about `spacing_m` apart.

    If the path comes back to a point, the loop between is left out.
    """
    points, index = [driven_m[0]], 0
    while index < len(driven_m) - 1:
        near = np.hypot(*(driven_m[index:] - driven_m[index]).T) <= spacing_m
        index += int(np.flatnonzero(near)[-1]) + 1
        if index < len(driven_m):
            points.append(driven_m[index])
    return np.array([*points, goal_m])
