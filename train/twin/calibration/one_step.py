"""One step of the twin from each logged step: what it would have observed and earned.

The twin is put into the logged state (pose, motion, and what its base controller made of the
commands before), drives the logged action for one control period, and the task's own functions
turn what it then senses into observation and reward. Without sensor noise, and without what is not
on the map: pallets, people and patches of the log are unknown to it.

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

from restock.arrays import F32, F64, Bools, Ints
from restock.ingest.steps.routing import Routing
from restock.ingest.task.signals import Signals, localised_velocity, wrap_angle
from restock.ingest.task.task import Task, clearance_ahead, observe, reward_parts
from restock.replay.store.store import Store
from restock.train.twin.calibration.logged_steps import (
    LoggedSteps,
    observations,
    previous_action,
    rows_of,
    sector_clearance,
)
from restock.train.twin.calibration.open_loop import (
    OpenLoopResult,
    OpenLoopStart,
    drive_open_loop,
    see_sectors,
)
from restock.train.twin.calibration.segments import POSE
from restock.train.twin.calibration.twin_gap import GapConfig
from restock.train.twin.floors.layout import Warehouse
from restock.train.twin.physics.perturbation import Perturbation
from restock.train.twin.physics.simulation import Simulation

PAST = 5  # control periods of commands before the step: longer than any latency and ramp
AGREES = 0.05  # of a clearance entry: about what noise and a pallet here and there make
SAME_M = 1e-3  # what remains of a plan is stored as float32
SPACING_M = 0.02  # points nearer to each other than this give no direction
ROUTE = (
    *("waypoint_near_x_m", "waypoint_near_y_m", "waypoint_far_x_m", "waypoint_far_y_m"),
    "route_remaining_m",
)


@dataclass(frozen=True)
class StepResult:
    """What followed n steps, in the log or in a twin."""

    observation: F32  # (n, D) at t + 1
    reward: F64  # (n,)
    terms: dict[str, F64]  # reward by term, (n,) each


@dataclass(frozen=True)
class OneStep:
    """n steps of a log and of P twins."""

    rows: Ints  # (n,) of the logged steps
    now: F32  # (n, D) the logged observation at t
    logged: StepResult
    twins: dict[str, StepResult]
    valid: Bools  # (n,) no twin diverged
    lidar: bool  # the floor is the twin's: otherwise lidar entries are the log's own
    unexplained: int  # logged rewards that their terms do not add up to


def one_step(
    store: Store,
    steps: LoggedSteps,
    plans: PlanMemory,
    rows: Ints,
    twins: dict[str, Perturbation],
    warehouse: Warehouse | None,
    config: GapConfig,
) -> OneStep:
    """Compare `rows` (n,), which must be followed by a known step.

    `warehouse` is the floor of the log; without one the floor is empty, and what the lidar sees is
    not compared.

    Raises:
        ConfigError: a timestep or control period that the twin cannot keep.
    """
    task = steps.task
    observed, next_observed = observations(store, steps.transition_id[rows], task.observation_size)
    now, after = rows_of(steps.now, rows), rows_of(steps.after, rows)
    now["sector_clearance_m"] = sector_clearance(task, observed)
    after["sector_clearance_m"] = sector_clearance(task, next_observed)
    action, before = steps.action[rows], previous_action(task, observed)

    def terms(then: Signals, progress_m: F64) -> dict[str, F64]:
        parts = reward_parts(task, now, then, progress_m, action, before)
        return {name: np.asarray(value, np.float64) for name, value in parts.items()}

    logged = StepResult(next_observed, steps.reward[rows], terms(after, steps.progress_m[rows]))
    adds_up = np.abs(sum(logged.terms.values()) - logged.reward) < 1e-3
    pose = np.stack([now[name] for name in POSE], axis=-1)
    start = OpenLoopStart(pose, now, steps.commands(rows, 0, 1), past=steps.commands(rows, PAST, 0))
    driven = drive_open_loop(
        task, start, list(twins.values()), robot=steps.robot,
        warehouse=warehouse, timestep_s=config.timestep_s, nthread=config.nthread,
    )  # fmt: skip
    results = {}
    for number, name in enumerate(twins):
        twin = after | _sensed(driven, number)
        _localise(task.control_period_s, now, after, twin)
        if warehouse is None:
            twin["sector_clearance_m"] = after["sector_clearance_m"]
        if task.lidar:
            twin["clearance_m"] = np.asarray(twin["sector_clearance_m"]).min(axis=1)
        twin |= plans.seen_after(steps, rows, twin)
        moved = twin["route_remaining_m"] - after["route_remaining_m"]
        twin["goal_distance_m"] = np.maximum(after["goal_distance_m"] + moved, 0.0)
        twin["clearance_ahead_m"] = clearance_ahead(
            task, twin["sector_clearance_m"], twin["waypoint_near_x_m"], twin["waypoint_near_y_m"]
        )
        parts = terms(twin, plans.progress_m(steps, rows, twin))
        reward = np.asarray(sum(parts.values()))
        results[name] = StepResult(observe(task, twin, now, action), reward, parts)
    return OneStep(
        rows=rows,
        now=observed,
        logged=logged,
        twins=results,
        valid=np.logical_not(driven.diverged.any(axis=0)),
        lidar=warehouse is not None,
        unexplained=int((~adds_up).sum()),
    )


def _sensed(driven: OpenLoopResult, twin: int) -> Signals:
    """What one twin senses at the end, by the names of the signals."""
    sensed = {name: values[twin, :, -1] for name, values in driven.signals.items()}
    sensed["sector_clearance_m"] = driven.sector_clearance_m[twin]
    return sensed | {"bumped": driven.bumped[twin]}


def _localise(period_s: float, now: Signals, after: Signals, twin: Signals) -> None:
    """The twin's pose as localisation would report it: as old as the log's, and speeds from it."""
    elapsed_s = (after["pose_stamp_ns"] - now["pose_stamp_ns"]) * 1e-9
    share = np.clip(elapsed_s / period_s, 0.0, 2.0)
    for name in ("pose_x_m", "pose_y_m"):
        twin[name] = now[name] + share * (twin[name] - now[name])
    turn = wrap_angle(twin["pose_yaw_rad"] - now["pose_yaw_rad"])
    twin["pose_yaw_rad"] = wrap_angle(now["pose_yaw_rad"] + share * turn)
    forward, lateral = localised_velocity(twin, now)
    twin["localised_speed_mps"], twin["localised_lateral_mps"] = forward, lateral


def agreement(steps: LoggedSteps, store: Store, rows: Ints, warehouse: Warehouse) -> float:
    """How far what the lidar logged at `rows` (n,) is from what it sees on this floor, in [0, 1].

    The median over the rows of the mean difference of the observation's clearance entries, which
    run from 0 (touching) to 1 (nothing within range). Below `AGREES` the floor is the log's.
    """
    task = steps.task
    observed, _ = observations(store, steps.transition_id[rows], task.observation_size)
    simulation = Simulation(max(len(rows), 1), task, warehouse, 0.01, 1, robot=steps.robot)
    poses = np.stack([steps.now[name][rows] for name in POSE], axis=-1)
    for env, pose in enumerate(poses):
        simulation.place_robot(env, *map(float, pose))
    simulation.batch.forward(np.arange(simulation.num_envs))
    expected, logged = (
        np.sqrt(np.clip(clearance / task.range_max_m, 0, 1))
        for clearance in (see_sectors(simulation)[: len(rows)], sector_clearance(task, observed))
    )
    return float(np.median(np.abs(expected - logged).mean(axis=1)))


@dataclass(frozen=True)
class PlanMemory:
    """The plans of N logged steps."""

    task: Task
    routing: Routing  # `plan` (N,) is what was in force at t
    next_plan: Ints  # (N,) at t + 1
    error_m: float  # of what remains, seen on the rebuilt plans from the logged poses, median

    def seen_after(self, steps: LoggedSteps, rows: Ints, pose: Signals) -> dict[str, F64]:
        """The route's signals at t + 1 from other poses (n,), for `rows` (n,).

        The logged ones, and what the rebuilt plan says of the difference between the two poses:
        where that is small, so is what was not rebuilt exactly.
        """
        after = rows_of(steps.after, rows)
        moved = self._view(self.next_plan[rows], pose)
        logged = self._view(self.next_plan[rows], after)
        return {name: after[name] + moved[name] - logged[name] for name in ROUTE}

    def progress_m(self, steps: LoggedSteps, rows: Ints, pose: Signals) -> F64:
        """How much shorter the plan in force at t would have become, had it ended at `pose`."""
        plan = self.routing.plan[rows]
        now, after = rows_of(steps.now, rows), rows_of(steps.after, rows)
        moved = self.routing.progress_m(self.task, plan, now, pose)
        logged = self.routing.progress_m(self.task, plan, now, after)
        return np.asarray(steps.progress_m[rows] + moved - logged, np.float64)

    def _view(self, plan: Ints, pose: Signals) -> dict[str, F64]:
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
