"""Computes every signal at every tick of the control clock from the latest message of each input.

That includes the goal and plan in force, and the signals that follow from them. If a tick is
unusable (an input is stale, a plan is for another goal, a value is not finite), the reason is
kept, so that everything left out can be counted.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import isnan, nan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F32, F64, Bools, Ints
from restock.ingest.containers.storage import Fields
from restock.ingest.profile.tables import CLOUD, Input
from restock.ingest.steps.align import NS, LatestMessages, Samples
from restock.ingest.steps.aligned_inputs import AlignedInputs
from restock.ingest.steps.frames import motion_at
from restock.ingest.steps.needs import (
    BEAMS,
    BLIND,
    CLOSE,
    FINE,
    SECTORS,
    UNAIMED,
    scan_reduction,
)
from restock.ingest.task.hindsight import missions
from restock.ingest.task.schema import Perturbed
from restock.ingest.task.surroundings import (
    MOTION,
    PLAN_PARTS,
    SCANNED,
    RouteView,
    came_nearer,
    pad_plans,
    plan_distances_m,
    returns_on_plan,
    steps_remembered,
    view_route,
    with_unseen,
)
from restock.ingest.task.task import (
    OBSERVED,
    TRACK_SIGNALS,
    Signals,
    Task,
    clearance_ahead,
    localised_velocity,
)
from restock.ingest.task.task_sql import Past, observed_in_log
from restock.ingest.task.tracks import SECTORS as FINE_SECTORS
from restock.ingest.task.tracks import Tracker

# Larger numbers are faults, whatever the signal's unit. A position above this limit would not even
# resolve centimetres when stored as float32.
LARGEST = 1e6
TOO_LARGE = "beyond a million"
_CHUNK = 4096  # ticks processed at a time: bounds memory for recordings of any length


@dataclass(frozen=True)
class Routing:
    """The goals and plans of a recording, and those in force at each of T ticks.

    A tick without a plan has look-ahead points straight ahead of the robot, and 0 m remaining.
    """

    goals_m: F64  # (G, 2)
    plans_m: Sequence[F64]  # each (P, 2), map frame
    goal: Ints  # (T,) index of the goal, equal for goals at the same place; -1: none
    plan: Ints  # (T,) index of the plan; -1: none
    order: Ints  # (T,) index of the goal's message: the same goal may be ordered again

    @classmethod
    def none(cls, ticks: int) -> Routing:
        """Return a routing without any goal or plan."""
        nowhere = np.full(ticks, -1, np.int64)
        return cls(np.zeros((0, 2)), [], nowhere, nowhere, nowhere)

    def view(self, task: Task, plan: Ints, pose: Signals) -> RouteView:
        """View plans at `plan_distances_m` from N poses; `plan` (N,): index of each pose's plan."""
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
        """Compute the route's signals at N steps, given the index of each step's goal and plan."""
        seen = self.view(task, plan, now)
        distance = np.zeros(len(goal))
        aimed = np.flatnonzero(goal >= 0)
        position = np.stack([now["pose_x_m"], now["pose_y_m"]], axis=-1)
        distance[aimed] = np.linalg.norm(self.goals_m[goal[aimed]] - position[aimed], axis=-1)
        # Copies, so that the array of all look-ahead points can be freed.
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
        """Return by how much each step's plan became shorter from `now` to `after`, (N,).

        Without a plan, return how far the robot moved forward, along the mean of both headings.
        """
        shorter: F64 = now["route_remaining_m"] - self.view(task, plan, after).remaining_m
        turn = after["pose_yaw_rad"] - now["pose_yaw_rad"]
        heading = now["pose_yaw_rad"] + ((turn + np.pi) % (2 * np.pi) - np.pi) / 2
        forward = np.cos(heading) * (after["pose_x_m"] - now["pose_x_m"])
        forward = forward + np.sin(heading) * (after["pose_y_m"] - now["pose_y_m"])
        return np.where(plan >= 0, shorter, forward)


def same_goals(goals_m: F64, moved_m: float) -> Ints:
    """Return for each goal (G, 2) the index of the first in its run of equal goals, (G,).

    Goals are equal if they are at most `moved_m` apart.
    """
    first = np.arange(len(goals_m), dtype=np.int64)
    for index in range(1, len(goals_m)):
        if np.linalg.norm(goals_m[index] - goals_m[first[index - 1]]) <= moved_m:
            first[index] = first[index - 1]
    return first


def plan_problems(plans_m: Sequence[F64]) -> list[str]:
    """Return why each plan is unusable for any goal; "" if the plan is usable."""
    problems = []
    for plan in plans_m:
        if not len(plan):
            problems.append("empty")
        else:
            sane = (np.abs(plan) <= LARGEST).all()  # False for NaN
            problems.append("" if sane else "not finite")
    return problems


def plan_ends(plans_m: Sequence[F64]) -> F64:
    """Return the last point of each of P plans, (P, 2); NaN for an empty plan."""
    ends = np.full((len(plans_m), 2), np.nan)
    for index, plan in enumerate(plans_m):
        if len(plan):
            ends[index] = plan[-1]
    return ends


GOAL_MOVED_M = 0.01  # a goal farther from the last one is a new goal
PLAN_GOAL_TOLERANCE_M = 0.5  # a plan that ends farther from the goal is for another goal
# Text for notes: what replaces a field of the IMU in messages without an estimate of it.
NO_ESTIMATE = {
    "angular_velocity": ": gyro yaw rate taken from the wheels",
    "linear_acceleration": ": acceleration 0",
}


class Filling:
    """Computation of all signals at T ticks; if a tick has several problems, the first is kept."""

    def __init__(self, aligned: AlignedInputs) -> None:
        self.aligned, self.inputs = aligned, aligned.inputs
        self.profile, self.task = aligned.profile, aligned.profile.task
        self.tick_ns = np.concatenate(aligned.ticks)
        lengths = [len(stamps) for stamps in aligned.ticks]
        self.segment = np.repeat(np.arange(len(lengths)), lengths)
        self.problem = np.full(len(self.tick_ns), "", object)
        self.route_problem = np.full(len(self.tick_ns), "", object)
        self.break_reason = np.full(len(self.tick_ns), "", object)  # why a tick does not follow
        self.signals: Signals = {"stamp_ns": self.tick_ns}
        self.routing = Routing.none(len(self.tick_ns))
        self.located = np.zeros(len(self.tick_ns), np.bool_)  # whether the pose is known
        self.scan_m = np.zeros((0, FINE_SECTORS))  # (T, FINE_SECTORS) if the task has tracks
        self.scan_stamp_ns = np.zeros(len(self.tick_ns), np.int64)
        self.notes: list[str] = []
        self.stand_ins: dict[str, str] = {}  # replacements of inputs that never have an estimate

    def fill(self, tracker: Tracker | None = None, past: Past | None = None) -> Signals:
        """Compute every signal, and fill the other attributes.

        On a running robot, `tracker` and `past` hold the state of the ticks before the last one.
        With them, tracks and the task's own observation entries are only those of the last tick.
        """
        self._fill_numbers(
            "command", speed_mps="command_speed_mps", yaw_rate_radps="command_yaw_rate_radps"
        )
        self._fill_pose()
        lateral_by_poses = self._fill_wheels()
        instead = {
            "gyro_yaw_rate_radps": self.signals["wheel_yaw_rate_radps"],
            "accel_x_mps2": np.zeros(len(self.tick_ns)),
        }
        if "imu" in self.inputs.by_name:
            self._fill_numbers(
                "imu", instead, yaw_rate_radps="gyro_yaw_rate_radps", accel_x_mps2="accel_x_mps2"
            )
            if self.inputs.no_estimate("imu", "yaw_rate_radps").all():
                self.stand_ins["imu"] = NO_ESTIMATE["angular_velocity"].removeprefix(": ")
        else:
            self.signals |= {name: column.copy() for name, column in instead.items()}
        self._fill_scans()
        self._fill_bumper()
        self._fill_nav_command()
        self.notes += [
            f"{name}: {count:,} of {len(self.inputs.topics[source.topic]):,} messages of"
            f" {source.topic} have no estimate of {field} ({how}){NO_ESTIMATE.get(field, '')}"
            for name, field, count, how in self.inputs.unestimated()
            if (source := self.inputs.by_name[name])
        ]
        if self.profile.goal_source == "hindsight":
            self._fill_route_in_hindsight()
        elif self.task.goal == "route":
            self._fill_route()
        signals, routing = self.signals, self.routing
        signals |= routing.signals(self.task, routing.goal, routing.plan, signals)
        self._find_breaks()
        before = np.arange(len(self.follows)) - self.follows  # index of the tick before or itself
        forward, lateral = localised_velocity(
            signals, {name: signals[name][before] for name in signals if name.startswith("pose_")}
        )
        if lateral_by_poses is not None:
            # Wheel speeds were computed from poses: other localised speeds would look like slip.
            forward, lateral = signals["wheel_speed_mps"].copy(), lateral_by_poses
        signals |= {"localised_speed_mps": forward, "localised_lateral_mps": lateral}
        scanned = {name: signals[name] for name in SCANNED}
        came = [
            came_nearer(
                self.task, *_with_earlier(scanned, rows, before, steps_remembered(self.task))
            )
            for rows in _chunks(len(before))
        ]
        signals["came_nearer_m"] = np.concatenate([np.zeros(0), *came])
        if self.task.tracks:
            signals |= self._tracks(signals, tracker)
        if self.task.observed:
            signals[OBSERVED] = self._observed(signals, past)
        return signals

    def _observed(self, signals: Signals, past: Past | None) -> F32:
        """Compute the task's own observation entries (T, E)."""
        if past is None:
            return observed_in_log(self.task, signals, self.follows)
        one, now = np.array([0]), {name: column[-1:] for name, column in signals.items()}
        if self.follows[-1]:
            past.step(now)
        else:
            past.begin(one, now)
        return np.repeat(past.now(one), len(self.tick_ns), axis=0)

    def _tracks(self, signals: Signals, tracker: Tracker | None) -> Signals:
        """Run the tracker over the ticks; it starts anew at a tick that follows no other."""
        count, one = len(self.tick_ns), np.array([0])
        ticks = range(count) if tracker is None else range(count - 1, count)
        tracker = tracker or Tracker(self.task)
        found = {name: np.full((count, self.task.tracks or 0), np.nan) for name in TRACK_SIGNALS}
        odometry = {name: signals[name] for name in (*MOTION, "wheel_speed_mps")}
        for tick in ticks:
            now = {name: column[[tick]] for name, column in odometry.items()}
            scan = self.scan_m[[tick]], self.scan_stamp_ns[[tick]]
            if self.follows[tick]:
                tracks = tracker.update(now, *scan)
            else:
                tracks = tracker.begin(one, now, *scan)
            for name, values in tracks.items():
                found[name][tick] = values[0]
        return found

    @property
    def follows(self) -> Bools:
        """Return whether each tick directly follows the one before and both are usable, (T,)."""
        return np.asarray(self.break_reason == "", np.bool_)

    def behaviour(self) -> list[tuple[str, str | None, float | None]]:
        """Return the behaviour policy at each tick: name, version, probability of the action."""
        default, by = self.profile.behaviour_policy, self.aligned.commanded_by()
        found = [
            (source or default, None, None) if text is None else parse_policy(text)
            for text, source in zip(self.texts("behaviour_policy"), by, strict=True)
        ]
        wrong = [chance is not None and isnan(chance) for _, _, chance in found]
        if any(wrong):
            self.notes.append(
                f"behaviour_policy: the probability at {sum(wrong):,} of {len(wrong):,} ticks is "
                "not in (0, 1], and is treated as unknown"
            )
        return [
            (name, version, None if bad else chance)
            for (name, version, chance), bad in zip(found, wrong, strict=True)
        ]

    def texts(self, name: str) -> list[str | None]:
        """Return the latest text of an input at each tick; None if missing or stale."""
        if name not in self.inputs.by_name:
            return [None] * len(self.tick_ns)
        texts, latest = self.inputs.texts(name), self.aligned.latest(name)
        rows = zip(latest.row, latest.fresh, strict=True)
        return [texts[row] if fresh else None for row, fresh in rows]

    def perturbed(self) -> Perturbed:
        """Return the simulator's parameters in force at each tick, and notes on unreadable ones."""
        if "perturbation" not in self.inputs.by_name:
            return Perturbed.unknown(len(self.tick_ns))
        latest = self.aligned.latest("perturbation")
        row = np.where(latest.fresh, latest.row, -1).astype(np.int64)
        return Perturbed.read(self.inputs.texts("perturbation"), row)

    def _find_breaks(self) -> None:
        reasons = self.break_reason
        reasons[:1] = "start of the recording"
        xy_m = np.stack([self.signals["pose_x_m"], self.signals["pose_y_m"]], axis=1)
        jump = self._too_far(xy_m)
        gap = np.diff(self.tick_ns) > round(self.profile.clock.max_gap_s * NS)
        unusable = (self.problem[1:] != "") | (self.problem[:-1] != "")
        for bad, reason in (
            (np.diff(self.segment) != 0, "clock jump"),
            (gap, "gap"),
            (unusable, "unusable step"),
            (jump, "pose jump"),
        ):
            reasons[1:][bad & (reasons[1:] == "")] = reason

    def _too_far(self, xy_m: F64) -> Bools:
        """Return which steps (N - 1,) between positions (N, 2) exceed `max_pose_jump_m`."""
        moved_m = np.hypot(*np.diff(xy_m, axis=0).T)
        return np.asarray(moved_m > self.profile.episodes.max_pose_jump_m, np.bool_)

    def _mark_invalid(self, bad: Bools, reason: str, *, route: bool = False) -> None:
        problems = self.route_problem if route else self.problem
        problems[bad & (problems == "")] = reason

    def _mark_reasons(self, name: str, reasons: NDArray[Any], *, route: bool = False) -> None:
        """Mark ticks as unusable for these reasons (T,); a tick with "" is not marked."""
        for reason in sorted(set(reasons) - {""}):
            text = f"{name}: {reason}" if name else reason
            self._mark_invalid(reasons == reason, text, route=route)

    def _latest_required(self, name: str, *, route: bool = False) -> LatestMessages:
        latest = self.aligned.latest(name)
        self._mark_invalid(~latest.known, f"{name}: not yet received", route=route)
        self._mark_invalid(~latest.fresh, f"{name}: stale", route=route)
        return latest

    def _fill_numbers(
        self, name: str, instead: Mapping[str, F64] | None = None, /, **signal_of: str
    ) -> None:
        """Set signals from fields of a required input; an unusable value becomes 0.

        `instead` replaces values without an estimate; if it is None, such ticks are unusable.
        """
        latest = self._latest_required(name)
        for key, signal in signal_of.items():
            values = self.inputs.numbers(name, key)
            column = values[latest.row] if len(values) else np.zeros(len(latest.row))
            if len(values):
                none = self.inputs.no_estimate(name, key)[latest.row] & latest.known
                if instead is not None:
                    column = np.where(none, instead[signal], column)
                elif none.any():
                    self._mark_invalid(none, f"{name}: no estimate")
            self._fill_signal(name, signal, column, latest.known)

    def _fill_signal(self, name: str, signal: str, values: F64, known: Bools) -> None:
        sane = np.abs(values) <= LARGEST  # False for NaN
        self._mark_invalid(~np.isfinite(values), f"{name}: not finite")
        self._mark_invalid(~sane, f"{name}: {TOO_LARGE if name == 'pose' else 'not finite'}")
        self.signals[signal] = np.where(sane & known, values, 0.0)

    def _fill_wheels(self) -> F64 | None:
        """Set the wheels' speeds; if they come from poses, return the sideways speed (T,)."""
        motion = self.profile.motion
        if motion is None:
            speeds = {"speed_mps": "wheel_speed_mps", "yaw_rate_radps": "wheel_yaw_rate_radps"}
            self._fill_numbers("wheels", **speeds)
            return None
        jump_m = self.profile.episodes.max_pose_jump_m
        fastest_mps = self.task.condition_limits["fastest_mps"]
        parts = [
            motion_at(poses, ticks, motion.window_s, jump_m, fastest_mps)
            for poses, ticks in zip(self.aligned.poses(), self.aligned.ticks, strict=True)
        ]
        for signal, name in (("speed_mps", "forward_mps"), ("yaw_rate_radps", "yaw_rate_radps")):
            column = np.concatenate([getattr(part, name) for part in parts])
            self._fill_signal("wheels", f"wheel_{signal}", column, np.ones(len(column), np.bool_))
        self._mark_reasons("wheels", np.concatenate([part.problem for part in parts]))
        return np.concatenate([part.lateral_mps for part in parts])

    def _fill_pose(self) -> None:
        if "pose" in self.inputs.by_name:
            latest = self.aligned.latest("pose")
            usable = latest.known & latest.fresh
            if self.inputs.by_name["pose"].by_fix and latest.known.any():
                problem = np.where(usable, self.inputs.fixed.problem[latest.row], "")
                self._mark_reasons("pose", problem)
                usable &= problem == ""
            self._fill_numbers("pose", x_m="pose_x_m", y_m="pose_y_m", yaw_rad="pose_yaw_rad")
            self.signals["pose_stamp_ns"] = self.tick_ns - latest.age_ns
            self.located = usable
            return
        tree = self.aligned.tree
        assert tree is not None  # a profile without [inputs.pose] must have [frames]
        at = tree.place(tree.frames.base, self.aligned.ticks)
        self._mark_reasons("pose", at.problem)
        x, y = (at.translation_m[:, :2] - self.inputs.origin_m).T
        for signal, values in (("x_m", x), ("y_m", y), ("yaw_rad", at.yaw_rad)):
            self._fill_signal("pose", f"pose_{signal}", values, at.problem == "")
        self.located = np.asarray(at.problem == "", np.bool_)
        self.signals["pose_stamp_ns"] = at.stamp_ns

    def _fill_scans(self) -> None:
        """Set the clearance; with several lidars, the smallest of all.

        Clearance is NaN for a task without a lidar. If the task has a lidar but the recording lacks
        scans, no tick is usable; `as_recorded` makes the task fit a recording without scans.
        """
        count = len(self.tick_ns)
        sectors = np.full((count, self.task.sectors), np.nan)
        if self.task.tracks:
            self.scan_m = np.full((count, FINE_SECTORS), np.inf)
        if "scan" not in self.inputs.by_name and self.task.lidar:
            self._mark_invalid(np.ones(count, np.bool_), "scan: not yet received")
        for name, source in self.profile.inputs.scans.items():
            if name in self.inputs.by_name:
                self._fill_scan(name, source, sectors)
        sectors = with_unseen(sectors, float(self.task.range_max_m))
        nearest = sectors.min(axis=1) if self.task.sectors else np.full(count, np.nan)
        self.signals |= {"sector_clearance_m": sectors, "clearance_m": nearest}

    def _fill_scan(self, name: str, source: Input, sectors: F64) -> None:
        """Lower the clearances `sectors` (T, K) to those of one lidar; NaN is not yet known."""
        latest, count = self._latest_required(name), len(self.tick_ns)
        fields: Fields = self.inputs.topics[source.topic].fields
        if SECTORS not in fields:  # scans were read, but not reduced to sectors
            fields = scan_reduction(self.task, source).apply(fields)
        if near := int(np.asarray(fields[CLOSE]).sum()):
            self.notes.append(
                f"{name}: {near:,} of {len(fields[CLOSE]):,} messages of {source.topic} have beams"
                " of -inf, too close to be measured: clearance 0 there"
            )
        fresh, rows = latest.fresh, latest.row[latest.fresh]
        if not len(rows):
            return
        beams = np.zeros(count, np.int64)
        beams[fresh] = np.asarray(fields[BEAMS])[rows]
        self._mark_invalid(fresh & (beams == 0), f"{name}: no beams")
        broken = "cut short, or has no x, y, z as floats"
        unaimed = broken if source.type == CLOUD else "unusable angles"
        for flag, reason in ((BLIND, "no beam has a valid range"), (UNAIMED, unaimed)):
            bad = np.zeros(count, np.bool_)
            bad[fresh] = np.asarray(fields[flag])[rows]
            self._mark_invalid(bad, f"{name}: {reason}")
        sectors[fresh] = np.fmin(sectors[fresh], np.asarray(fields[SECTORS])[rows])
        if self.task.tracks:
            self.scan_m[fresh] = np.minimum(self.scan_m[fresh], np.asarray(fields[FINE])[rows])
            stamp_ns = self.tick_ns - latest.age_ns
            self.scan_stamp_ns[fresh] = np.maximum(self.scan_stamp_ns, stamp_ns)[fresh]

    def _fill_bumper(self) -> None:
        bumped = [np.zeros(len(self.tick_ns), np.bool_)]
        source = self.inputs.by_name.get("bumper")
        if source is not None:
            if source.max_age_s is not None:  # None: the bumper publishes only when it changes
                self._latest_required("bumper")
            pressed = self.inputs.numbers("bumper", "pressed") > 0
            bumped = [
                pressed_since(segment.topics[source.topic], pressed, ticks)
                for segment, ticks in zip(self.aligned.segments, self.aligned.ticks, strict=True)
            ]
        self.signals["bumped"] = np.concatenate(bumped)

    def _fill_nav_command(self) -> None:
        """Set the command that navigation proposes; a tick without one stays usable."""
        count, name = len(self.tick_ns), "nav_command"
        unknown = np.full(count, np.nan)
        source = self.inputs.by_name.get(name)
        if source is None or not len(self.inputs.topics[source.topic]):
            self.signals |= {"nav_speed_mps": unknown, "nav_yaw_rate_radps": unknown.copy()}
            return
        latest = self.aligned.latest(name)
        keys = ("speed_mps", "yaw_rate_radps")
        values = np.stack([self.inputs.numbers(name, key)[latest.row] for key in keys])
        sane = (np.abs(values) <= LARGEST).all(axis=0)  # False for NaN
        known = latest.fresh & sane
        for key, column in zip(keys, values, strict=True):
            self.signals[f"nav_{key}"] = np.where(known, column, np.nan)
        reasons = {
            "not yet received": ~latest.known,
            "stale": latest.known & ~latest.fresh,
            "not finite": latest.fresh & ~sane,
        }
        counted = [f"{reason} {int(bad.sum()):,}" for reason, bad in reasons.items() if bad.any()]
        if counted:
            unknown_at = f"{int((~known).sum()):,} of {count:,} ticks"
            self.notes.append(f"{name}: unknown at {unknown_at} ({', '.join(counted)})")

    def _fill_route(self) -> None:
        latest = {name: self._latest_required(name, route=True) for name in ("goal", "plan")}
        goals, plans = self.inputs.goals, self.inputs.plans
        for name, one in latest.items():
            if name in self.inputs.placed:
                reasons = np.where(one.known, self.inputs.placed[name].problem[one.row], "")
                self._mark_reasons(name, reasons, route=True)
        goal, plan = (np.where(one.known, one.row, -1) for one in latest.values())
        if len(goals):
            goal = np.where(goal >= 0, same_goals(goals, GOAL_MOVED_M)[goal], -1)
            sane = (np.abs(goals[goal]) <= LARGEST).all(axis=1)
            self._mark_invalid((goal >= 0) & ~sane, "goal: not finite", route=True)
        if len(plans):
            reasons = np.where(plan >= 0, np.array(plan_problems(plans), object)[plan], "")
            self._mark_reasons("plan", reasons, route=True)
        usable = self.route_problem == ""
        if usable.any():
            away = np.linalg.norm(plan_ends(plans)[plan[usable]] - goals[goal[usable]], axis=-1)
            other = np.zeros(len(usable), np.bool_)
            other[usable] = away > PLAN_GOAL_TOLERANCE_M
            self._mark_invalid(other, "plan: for another goal", route=True)
        usable = self.route_problem == ""
        goal, plan = np.where(usable, goal, -1), np.where(usable, plan, -1)
        self.routing = Routing(goals, plans, goal, plan, latest["goal"].row.astype(np.int64))

    def _fill_route_in_hindsight(self) -> None:
        """Set goals and routes in hindsight; no other signals depend on later messages."""
        xy_m = np.stack([self.signals["pose_x_m"], self.signals["pose_y_m"]], axis=1)
        at = np.flatnonzero(self.located)
        carried = np.zeros(len(self.tick_ns), np.bool_)
        carried[at[1:]] = self._too_far(xy_m[at]) | (np.diff(self.segment[at]) != 0)
        rules, leg = self.profile.goal, np.cumsum(carried, dtype=np.int64)
        found = missions(rules, self.task, xy_m, self.tick_ns, self.located, leg)
        self._mark_reasons("", np.array(found.problem, object), route=True)
        self.routing = Routing(
            found.goals_m, found.routes_m, found.mission, found.mission, found.mission
        )
        self.notes.append(str(found))


def _chunks(steps: int) -> Iterator[Ints]:
    """Yield step indices in chunks, as intermediate arrays of scans take much memory."""
    for start in range(0, steps, _CHUNK):
        yield np.arange(start, min(start + _CHUNK, steps))


def _with_earlier(
    signals: Signals, rows: Ints, before: Ints, count: int
) -> tuple[Signals, list[Signals]]:
    """Return the signals of steps `rows` (n,), and of each of `count` steps before, newest first.

    `before` (T,) is the index of the step before, or of the step itself if it follows no other.
    """
    at = [rows]
    for _ in range(count):
        at.append(before[at[-1]])
    now, *earlier = ({name: column[one] for name, column in signals.items()} for one in at)
    return now, earlier


def pressed_since(bumper: Samples, pressed: Bools, tick_ns: Ints) -> Bools:
    """Return whether the bumper is pressed at each tick, or was since the tick before, (T,)."""
    if not len(bumper.row) or not len(tick_ns):
        return np.zeros(len(tick_ns), np.bool_)
    counts = np.concatenate([[0], np.cumsum(pressed[bumper.row])])
    upto = counts[np.searchsorted(bumper.stamp_ns, tick_ns, "right")]
    since = np.diff(upto, prepend=upto[:1])
    latest = bumper.hold(tick_ns, None)
    return (since > 0) | (pressed[latest.row] & latest.known)


@lru_cache(maxsize=1024)
def parse_policy(text: str) -> tuple[str, str | None, float | None]:
    """Parse a policy's name, version and probability; text that is not JSON is the name alone.

    The JSON's keys are `policy`, `version` and `probability`. An invalid probability, such as -3,
    becomes NaN.
    """
    try:
        message = json.loads(text)
    except (ValueError, RecursionError):  # a ValueError: not JSON, or a number of too many digits
        return text.strip() or "unknown", None, None
    if not isinstance(message, dict):
        return str(message), None, None
    name, version, chance = (message.get(key) for key in ("policy", "version", "probability"))
    if chance is not None:
        is_number = isinstance(chance, int | float) and not isinstance(chance, bool)
        # A probability that was summed in float32 may be a little above 1.
        chance = min(float(chance), 1.0) if is_number and 0 < chance < 1 + 1e-6 else nan
    return (
        "unknown" if name is None else str(name),
        None if version is None else str(version),
        chance,
    )
