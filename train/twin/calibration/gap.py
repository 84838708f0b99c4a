"""The gap between the twin and a store's logs, per condition, before and after calibration.

Two things are measured. Paths: logged commands are driven again open loop (`path_gap`). Steps: the
twin drives one control period from each logged state, and the task's observations and rewards are
compared. Each statistic is a row with its interval over episodes, and verdicts are computed from
the rows (`twin_gap`). `TwinGap.not_done` lists what a store's signals do not allow.

For a step, the twin is put into the logged state (pose, motion, and the state of the base
controller after the commands before) and drives the logged action for one control period. It has no
sensor noise, and none of the log's pallets, people and slippery patches.

A store keeps no plans, but every row has two points of its plan (the look-ahead points) and the
plan's remaining length. These points lie on the plan, with a known length from each to its end. So
the rows that were driven under one plan restore most of it: from 1 m ahead of its first row to
2.2 m ahead of its last row. This is enough for a pose near the logged one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from restock.arrays import F32, F64, Bools, Ints
from restock.errors import StoreError
from restock.ingest.profile.profile import load_profile
from restock.ingest.steps.filling import Routing
from restock.ingest.task.surroundings import PLAN_PARTS
from restock.ingest.task.task import (
    OBSERVED,
    TRACK_SIGNALS,
    Signals,
    Task,
    clearance_ahead,
    localised_velocity,
    observe,
    reward_parts,
    wrap_angle,
)
from restock.replay.store.store import Store
from restock.stats import NOT_KNOWN, ConfidenceInterval, clustered_quantiles, clustered_ratio
from restock.train.twin.calibration.fit_solver import pose_is_odometry
from restock.train.twin.calibration.logged_steps import (
    NOMINAL,
    LoggedSteps,
    logged_steps,
    observations,
    previous_action,
    rows_of,
    sector_clearance,
)
from restock.train.twin.calibration.open_loop import (
    POSE,
    OpenLoopResult,
    OpenLoopStart,
    drive_open_loop,
    see_sectors,
)
from restock.train.twin.calibration.path_gap import (
    QUANTITIES,
    PathGap,
    path_gap,
)
from restock.train.twin.calibration.twin_gap import (
    GapConfig,
    Rows,
    TrustLimits,
    TwinGap,
    Verdict,
    trust_verdict,
)
from restock.train.twin.floors.layout import Warehouse, default_warehouse
from restock.train.twin.physics.perturbation import Perturbation
from restock.train.twin.physics.simulation import Simulation

PAST = 5  # commands before the step that are replayed: longer than any latency and ramp
AGREES = 0.05  # largest `agreement` if the floor is the log's: from noise and a few pallets
SAME_M = 1e-3  # tolerance of a plan's remaining length, which is stored as float32
SPACING_M = 0.02  # spacing of a rebuilt plan's points: closer points give no direction
ROUTE = (
    *("waypoint_near_x_m", "waypoint_near_y_m", "waypoint_far_x_m", "waypoint_far_y_m"),
    "route_remaining_m",
)


@dataclass(frozen=True)
class StepResult:
    """Observations and rewards of n steps, in the log or in a twin."""

    observation: F32  # (n, D) at t + 1
    reward: F64  # (n,)
    terms: dict[str, F64]  # reward by term, (n,) each


@dataclass(frozen=True)
class OneStep:
    """n separate steps, as logged and as each twin drove them from the logged states."""

    rows: Ints  # (n,) indices of the steps in the `LoggedSteps`
    now: F32  # (n, D) the logged observation at t
    logged: StepResult
    twins: dict[str, StepResult]
    valid: Bools  # (n,) no twin diverged
    lidar: bool  # the floor is known; if not, lidar entries are copied from the log
    unexplained: int  # number of logged rewards that are not the sum of their terms


def one_step(
    store: Store,
    steps: LoggedSteps,
    plans: PlanMemory,
    rows: Ints,
    twins: dict[str, Perturbation],
    warehouse: Warehouse | None,
    config: GapConfig,
) -> OneStep:
    """Drive one step of each twin from each of `rows` (n,), whose next logged step must be known.

    `warehouse` is the floor of the log. If it is None, the floor is empty, and lidar readings are
    not compared.

    Raises:
        ConfigError: the twin cannot keep the timestep or control period.
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

    logged_terms = terms(after, steps.progress_m[rows])
    summed = np.asarray(sum(logged_terms.values()))
    # Custom reward terms may need earlier steps, so only the built-in terms are compared.
    earned = summed if task.reward_terms else steps.reward[rows]
    logged = StepResult(next_observed, earned, logged_terms)
    adds_up = np.abs(summed - earned) < 1e-3
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
        twin |= {name: np.full((len(rows), task.tracks or 0), np.nan) for name in TRACK_SIGNALS}
        own = len(task.observed or ())
        twin[OBSERVED] = np.zeros((len(rows), own))
        seen = observe(task, twin, now, action)
        # Entries that need earlier steps are copied from the log, so they are not compared.
        first = task.observation_size - 6 * (task.tracks or 0) - own
        seen[:, first:] = next_observed[:, first:]
        results[name] = StepResult(seen, reward, parts)
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
    """Return the signals of one twin at the end of the drive, by name."""
    sensed = {name: values[twin, :, -1] for name, values in driven.signals.items()}
    sensed["sector_clearance_m"] = driven.sector_clearance_m[twin]
    return sensed | {"bumped": driven.bumped[twin]}


def _localise(period_s: float, now: Signals, after: Signals, twin: Signals) -> None:
    """Replace the twin's pose by what localisation would report, in place.

    The pose is made as old as the logged one, and the localised speeds are computed from it.
    """
    elapsed_s = (after["pose_stamp_ns"] - now["pose_stamp_ns"]) * 1e-9
    share = np.clip(elapsed_s / period_s, 0.0, 2.0)
    for name in ("pose_x_m", "pose_y_m"):
        twin[name] = now[name] + share * (twin[name] - now[name])
    turn = wrap_angle(twin["pose_yaw_rad"] - now["pose_yaw_rad"])
    twin["pose_yaw_rad"] = wrap_angle(now["pose_yaw_rad"] + share * turn)
    forward, lateral = localised_velocity(twin, now)
    twin["localised_speed_mps"], twin["localised_lateral_mps"] = forward, lateral


def agreement(steps: LoggedSteps, store: Store, rows: Ints, warehouse: Warehouse) -> float:
    """Return how far the lidar at `rows` (n,) differs from what it would see on this floor, 0 to 1.

    It is the median over the rows of the mean difference of the observation's clearance entries,
    which go from 0 (touching) to 1 (nothing within range). Up to `AGREES` it is the log's floor.
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
    routing: Routing  # its `plan` (N,) is the index of the plan at t
    next_plan: Ints  # (N,) the index at t + 1
    error_m: float  # median error of the remaining length on the rebuilt plans

    def seen_after(self, steps: LoggedSteps, rows: Ints, pose: Signals) -> dict[str, F64]:
        """Return the route's signals at t + 1 as seen from other poses (n,), for `rows` (n,).

        They are the logged signals plus the difference between the two poses on the rebuilt plan.
        If the poses are close, the errors of the rebuilt plan cancel.
        """
        after = rows_of(steps.after, rows)
        moved = self._view(self.next_plan[rows], pose)
        logged = self._view(self.next_plan[rows], after)
        return {name: after[name] + moved[name] - logged[name] for name in ROUTE}

    def progress_m(self, steps: LoggedSteps, rows: Ints, pose: Signals) -> F64:
        """Return the progress along the plan of time t if the step had ended at `pose`."""
        plan = self.routing.plan[rows]
        now, after = rows_of(steps.now, rows), rows_of(steps.after, rows)
        moved = self.routing.progress_m(self.task, plan, now, pose)
        logged = self.routing.progress_m(self.task, plan, now, after)
        return np.asarray(steps.progress_m[rows] + moved - logged, np.float64)

    def _view(self, plan: Ints, pose: Signals) -> dict[str, F64]:
        seen = self.routing.view(self.task, plan, pose)
        near, far = (seen.look_ahead_m[:, part * PLAN_PARTS] for part in (1, 2))
        values = (near[:, 0], near[:, 1], far[:, 0], far[:, 1], seen.remaining_m)
        return dict(zip(ROUTE, values, strict=True))


def rebuild_plans(steps: LoggedSteps) -> PlanMemory:
    """Rebuild the plans of all rows; without a route in the task, return no plans."""
    count = len(steps)
    if steps.task.goal != "route":
        nowhere = np.full(count, -1, np.int64)
        return PlanMemory(steps.task, Routing.none(count), nowhere, 0.0)
    now, after = steps.now["route_remaining_m"], steps.after["route_remaining_m"]
    kept = np.abs(now - steps.progress_m - after) < SAME_M  # plan is the same at t + 1
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
    """Rebuild the polyline (P, 2) of the plan that rows [begin, end) have in common."""
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
    if rest > 0:  # the plan's end was never seen: continue straight for the rest
        way = line[-1] - line[-2]
        way = way / max(float(np.hypot(*way)), 1e-9)
        line = np.concatenate([line, (line[-1] + way * rest)[None]])
    return np.asarray(line, np.float64)


BEFORE, AFTER, PERSISTENCE = "nominal", "calibrated", "persistence"
_FLOOR_ROWS = 200  # nominal rows whose lidar is compared with the twin's floor


def measure_gap(
    store: Store,
    calibrated: Perturbation | None = None,
    config: GapConfig | None = None,
    *,
    task_hash: str | None = None,
    on_progress: Callable[[str], None] | None = None,
) -> TwinGap:
    """Measure the gap of the nominal twin and, if given, of a calibrated one.

    Lidar readings are compared only if the log was driven on the twin's default floor.

    Raises:
        ConfigError: a horizon is not a multiple of the control period, or the twin cannot keep the
            control period.
        StoreError: there are no rows, there are rows of several tasks but no `task_hash`, or no row
            has a next step.
    """
    config, warehouse = config or GapConfig(), default_warehouse()
    report = on_progress or (lambda text: None)
    twins = {BEFORE: Perturbation()} | ({AFTER: calibrated} if calibrated is not None else {})
    judged = list(twins)[-1]
    steps = logged_steps(store, task_hash)
    if not steps.followed.any():
        raise StoreError("no step is followed by another", where=str(store.path))
    paths = []
    for horizon in config.horizons_s:
        report(f"driving segments of {horizon:g} s again")
        paths.append(path_gap(steps, horizon, twins, config))
    report("one step from each logged state")
    rng = np.random.default_rng([config.seed, 2])
    difference = _floor_difference(store, steps, warehouse, rng)
    plans = rebuild_plans(steps)
    rows, chosen = _steps_to_compare(steps, 5 * config.max_segments, rng)
    known_floor = None if difference > AGREES else warehouse
    stepped = one_step(store, steps, plans, rows, twins, known_floor, config)
    path_rows = list(_path_rows(paths, rng))
    observation_rows = list(_observation_rows(steps, stepped, chosen, rng))
    reward_rows, ratios = _reward_rows(steps, stepped, chosen, rng)
    about = {
        "store": str(store.path),
        "store_version": store.version,
        "task_hash": steps.task.hash,
        "rows": len(steps),
        "episodes": len(np.unique(steps.episode_id)),
        "judged": judged,
        "twins": {name: msgspec.to_builtins(twin) for name, twin in twins.items()},
        "limits": asdict(config.limits),
        "robot": "the twin's stand-in" if steps.robot is None else "the profile's own",
        "floor": warehouse.name,
        "floor_difference": difference,
        "left_out": {f"{path.horizon_s:g} s": path.left_out for path in paths},
        "steps_compared": len(rows),
        "steps_left_out": int((~steps.followed).sum()),
        "plan_error_m": plans.error_m,
    }
    return TwinGap(
        about=about,
        paths=path_rows,
        observations=observation_rows,
        rewards=reward_rows,
        verdicts=_verdicts(steps, config.limits, judged, path_rows, ratios),
        not_done=tuple(_not_done(store, steps, twins, stepped, difference, paths)),
    )


def _floor_difference(
    store: Store, steps: LoggedSteps, warehouse: Warehouse, rng: np.random.Generator
) -> float:
    rows = np.flatnonzero(steps.conditions[NOMINAL])
    if not len(rows) or not steps.task.lidar:
        return 1.0
    return agreement(steps, store, np.sort(rng.permutation(rows)[:_FLOOR_ROWS]), warehouse)


def _steps_to_compare(
    steps: LoggedSteps, most: int, rng: np.random.Generator
) -> tuple[Ints, dict[str, Bools]]:
    """Draw at most `most` rows per condition; return the rows, and a mask of them by condition."""
    masks = {}
    for name, holds in steps.conditions.items():
        mask, members = np.zeros(len(steps), np.bool_), np.flatnonzero(holds & steps.followed)
        mask[rng.permutation(members)[:most]] = True
        masks[name] = mask
    rows = np.flatnonzero(np.any(list(masks.values()), axis=0))
    return rows, {name: mask[rows] for name, mask in masks.items()}


def _path_rows(paths: list[PathGap], rng: np.random.Generator) -> Iterator[dict[str, Any]]:
    """Yield the median and 90th percentile of each quantity, by condition, horizon and source."""
    for path in paths:
        for condition, mask in path.holds.items():
            for (source, quantity), values in path.gaps.items():
                known = mask & np.isfinite(values)
                episode = path.episode_id[known]
                median, p90 = clustered_quantiles(values[known], episode, (0.5, 0.9), rng=rng)
                yield {
                    "condition": condition,
                    "horizon_s": path.horizon_s,
                    "quantity": quantity,
                    "unit": QUANTITIES[quantity],
                    "source": source,
                    "segments": int(known.sum()),
                    "episodes": len(np.unique(episode)),
                    **_columns("median", median),
                    **_columns("p90", p90),
                }


def _observation_rows(
    steps: LoggedSteps, stepped: OneStep, chosen: Mapping[str, Bools], rng: np.random.Generator
) -> Iterator[dict[str, Any]]:
    """Yield the mean absolute gap of each observation component that depends on the twin."""
    sources = {name: result.observation for name, result in stepped.twins.items()}
    sources |= {PERSISTENCE: stepped.now}
    # The applied action and the navigation stack's proposals are copied from the log.
    left_out = ["previous_action_", "nav_"]
    left_out += [] if stepped.lidar else ["clearance_", "closing_"]
    left_out += [] if steps.task.goal == "route" else ["near_", "far_", "goal_"]
    for column, component in enumerate(steps.task.observation_names):
        if component.startswith(tuple(left_out)):
            continue
        for condition, mask in chosen.items():
            rows = mask & stepped.valid
            episode = steps.episode_id[stepped.rows[rows]]
            for source, values in sources.items():
                off = np.abs(values[rows, column] - stepped.logged.observation[rows, column])
                yield {
                    "condition": condition,
                    "component": component,
                    "source": source,
                    "steps": int(rows.sum()),
                    **_columns("mean_gap", _mean(off, episode, rng)),
                }


def _reward_rows(
    steps: LoggedSteps, stepped: OneStep, chosen: Mapping[str, Bools], rng: np.random.Generator
) -> tuple[Rows, dict[tuple[str, str], ConfidenceInterval]]:
    """Return the gaps by term, and the ratio of the reward's gap to its spread.

    The ratio is by condition and source. The spread is the mean distance of a step's reward from
    the median, but at least the cost of a step: a standing robot's rewards are all equal, so any
    gap would be large compared with their spread.
    """
    rows_by_term, ratios = [], {}
    least = abs(steps.task.rewards.step)
    for condition, mask in chosen.items():
        rows = mask & stepped.valid
        episode = steps.episode_id[stepped.rows[rows]]
        logged_terms = {"reward": stepped.logged.reward, **stepped.logged.terms}
        for source, result in stepped.twins.items():
            for term, values in {"reward": result.reward, **result.terms}.items():
                logged = logged_terms[term][rows]
                off = values[rows] - logged
                spread = np.abs(logged - np.median(logged)) if len(logged) else logged
                mean = _mean(np.abs(off), episode, rng)
                if term == "reward":
                    ratios[condition, source] = clustered_ratio(
                        np.abs(off), np.maximum(spread, least), episode, rng=rng
                    )
                rows_by_term.append(
                    {
                        "condition": condition,
                        "term": term,
                        "source": source,
                        "steps": int(rows.sum()),
                        **_columns("mean_gap", mean),
                        "bias": float(off.mean()) if len(off) else None,
                        "logged_mean": float(logged.mean()) if len(logged) else None,
                        "logged_spread": float(spread.mean()) if len(spread) else None,
                    }
                )
    return rows_by_term, ratios


def _mean(
    values: NDArray[Any], episode: NDArray[Any], rng: np.random.Generator
) -> ConfidenceInterval:
    return clustered_ratio(values, np.ones(len(values)), episode, rng=rng)


def _columns(name: str, interval: ConfidenceInterval) -> dict[str, float | None]:
    """Return an interval as the values of a row, with None for NaN."""
    values = {name: interval.value, f"{name}_low": interval.low, f"{name}_high": interval.high}
    return {key: None if np.isnan(value) else value for key, value in values.items()}


def _verdicts(
    steps: LoggedSteps,
    limits: TrustLimits,
    judged: str,
    path_rows: Rows,
    ratios: Mapping[tuple[str, str], ConfidenceInterval],
) -> tuple[Verdict, ...]:
    key = (limits.horizon_s, "position", judged)
    at = {
        row["condition"]: row
        for row in path_rows
        if (row["horizon_s"], row["quantity"], row["source"]) == key
    }
    verdicts = []
    for condition in steps.conditions:
        row = at.get(condition, {})
        ends = [row.get(f"p90{end}") for end in ("", "_low", "_high")]
        verdicts.append(
            trust_verdict(
                condition,
                limits=limits,
                segments=row.get("segments", 0),
                episodes=row.get("episodes", 0),
                position_p90=ConfidenceInterval(
                    *(float("nan") if value is None else float(value) for value in ends)
                ),
                reward_ratio=ratios.get((condition, judged), NOT_KNOWN),
            )
        )
    return tuple(verdicts)


def _not_done(
    store: Store, steps: LoggedSteps, twins: Mapping[str, Perturbation], stepped: OneStep,
    difference: float, paths: list[PathGap],
) -> Iterator[str]:  # fmt: skip
    if AFTER not in twins:
        yield "No gap after calibration: no fitted perturbation was given."
    if not steps.task.lidar:
        yield (
            "Steps were driven on an empty floor, without obstacles: the robot has no lidar, so "
            "its floor is not known."
        )
    elif difference > AGREES:
        yield (
            "Lidar readings were not compared: the log was driven on another floor than the "
            f"twin's (their clearances differ by {difference:.2f} in the median, {AGREES:g} is "
            "the limit). Steps were driven on an empty floor: clearances in their rewards are "
            "the log's own, and there are no obstacles."
        )
    if steps.robot is None and steps.task.body != load_profile("warehouse_amr").task.body:
        yield (
            "The robot driven is the twin's own, with the outline of the log's robot: the profile "
            "has no [robot] (docs/robot.md)."
        )
    if steps.task.goal != "route":
        yield (
            "Waypoints and distance to a goal were not compared: the log has no goal and no plan;"
            " progress is forward motion."
        )
    if pose_is_odometry(store, np.unique(steps.recording_id).tolist()):
        yield (
            "The pose is wheel odometry: the gap is measured against that, and slip is not visible."
        )
    for path in paths:
        if not len(path.episode_id):
            yield f"No segment of {path.horizon_s:g} s could be driven again."
    if stepped.unexplained:
        yield (
            f"The rewards of {stepped.unexplained} steps are not the sum of their terms by this "
            "version's task: their gaps by term use recomputed terms."
        )
    if not stepped.valid.all():
        yield f"{int((~stepped.valid).sum())} steps were left out: the physics diverged."
    yield (
        "Pallets, people and slippery patches of the log are not in the replay: it drives on an "
        "empty, dry floor."
    )
