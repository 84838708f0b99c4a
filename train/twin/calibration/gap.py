"""The gap between the twin and a store's logs, per condition, before and after calibration.

Two things are measured. Paths: logged commands are driven again open loop (`path_gap`). Steps: the
twin drives one control period from each logged state, and the task's observations and rewards are
compared. Each statistic is a row with its interval over episodes, and verdicts are computed from
the rows (`twin_gap`). `TwinGap.not_done` lists what a store's signals do not allow.

For a step, the twin is put into the logged state (pose, motion, and the state of the base
controller after the commands before) and drives the logged action for one control period. It has no
sensor noise, and its floor is empty: a store keeps neither racks nor the log's pallets, people and
slippery patches. So lidar readings are not compared, and clearances in rewards are the log's own.

A store keeps no plans either, but every row has two points of its plan (the look-ahead points) and
the plan's remaining length. After one step, the twin is within centimetres of the logged pose. So
the logged points are looked at from the twin's pose, and the remaining length differs by as much as
the twin is ahead of the log toward the nearer point.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from restock.arrays import F32, F64, Bools, Ints
from restock.errors import StoreError
from restock.ingest.profile.profile import load_profile
from restock.ingest.task.task import (
    OBSERVED,
    TRACK_SIGNALS,
    Signals,
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
    LoggedSteps,
    logged_steps,
    observations,
    previous_action,
    rows_of,
    sector_clearance,
)
from restock.train.twin.calibration.open_loop import (
    POSE,
    OpenLoopStart,
    drive_open_loop,
    empty_floor,
    warmup_steps,
)
from restock.train.twin.calibration.path_gap import (
    QUANTITIES,
    PathGap,
    draw_per_condition,
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
from restock.train.twin.physics.perturbation import Perturbation


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
    unexplained: int  # number of logged rewards that are not the sum of their terms


def one_step(
    store: Store,
    steps: LoggedSteps,
    rows: Ints,
    twins: dict[str, Perturbation],
    config: GapConfig,
) -> OneStep:
    """Drive one step of each twin from each of `rows` (n,), whose next logged step must be known.

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
    past = steps.commands(rows, warmup_steps(task), 0)
    start = OpenLoopStart(pose, now, steps.commands(rows, 0, 1), past)
    driven = drive_open_loop(
        task, start, list(twins.values()), robot=steps.robot,
        timestep_s=config.timestep_s, nthread=config.nthread,
    )  # fmt: skip
    results = {}
    for number, name in enumerate(twins):
        twin = after | {signal: values[number, :, -1] for signal, values in driven.signals.items()}
        twin["bumped"] = np.zeros(len(rows), np.bool_)
        _localise(task.control_period_s, now, after, twin)
        _look_at_route(after, twin)
        twin["clearance_ahead_m"] = clearance_ahead(
            task, twin["sector_clearance_m"], twin["waypoint_near_x_m"], twin["waypoint_near_y_m"]
        )
        parts = terms(twin, steps.progress_m[rows] + _ahead_m(now, after, twin))
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
        unexplained=int((~adds_up).sum()),
    )


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


def _look_at_route(after: Signals, twin: Signals) -> None:
    """Replace the twin's signals of the route at t + 1 by those seen from its pose, in place."""
    cos, sin = np.cos(twin["pose_yaw_rad"]), np.sin(twin["pose_yaw_rad"])
    for point in ("near", "far"):
        x, y = _on_map(after, point)
        x, y = x - twin["pose_x_m"], y - twin["pose_y_m"]
        twin[f"waypoint_{point}_x_m"] = cos * x + sin * y
        twin[f"waypoint_{point}_y_m"] = cos * y - sin * x
    ahead_m = _ahead_m(after, after, twin)
    twin["route_remaining_m"] = after["route_remaining_m"] - ahead_m
    twin["goal_distance_m"] = np.maximum(after["goal_distance_m"] - ahead_m, 0.0)


def _ahead_m(seen: Signals, after: Signals, twin: Signals) -> F64:
    """Return how far (n,) the twin is ahead of the log, along the plan of the signals `seen`."""
    x, y = _on_map(seen, "near")
    x, y = x - after["pose_x_m"], y - after["pose_y_m"]
    moved_x, moved_y = twin["pose_x_m"] - after["pose_x_m"], twin["pose_y_m"] - after["pose_y_m"]
    return np.asarray((x * moved_x + y * moved_y) / np.maximum(np.hypot(x, y), 1e-9), np.float64)


def _on_map(seen: Signals, point: str) -> tuple[F64, F64]:
    """Return x and y (n,) of a look-ahead point, `near` or `far`, on the map."""
    cos, sin = np.cos(seen["pose_yaw_rad"]), np.sin(seen["pose_yaw_rad"])
    x, y = seen[f"waypoint_{point}_x_m"], seen[f"waypoint_{point}_y_m"]
    return seen["pose_x_m"] + cos * x - sin * y, seen["pose_y_m"] + sin * x + cos * y


BEFORE, AFTER, PERSISTENCE = "nominal", "calibrated", "persistence"


def measure_gap(
    store: Store,
    calibrated: Perturbation | None = None,
    config: GapConfig | None = None,
    *,
    task_hash: str | None = None,
    on_progress: Callable[[str], None] | None = None,
) -> TwinGap:
    """Measure the gap of the nominal twin and, if given, of a calibrated one.

    Raises:
        ConfigError: a horizon is not a multiple of the control period, or the twin cannot keep the
            control period.
        StoreError: there are no rows, there are rows of several tasks but no `task_hash`, or no row
            has a next step.
    """
    config = config or GapConfig()
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
    followed = {name: holds & steps.followed for name, holds in steps.conditions.items()}
    drawn = draw_per_condition(followed, 5 * config.max_segments, rng)
    rows = np.flatnonzero(np.any(list(drawn.values()), axis=0))
    chosen = {name: mask[rows] for name, mask in drawn.items()}
    stepped = one_step(store, steps, rows, twins, config)
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
        "floor": empty_floor().name,
        "left_out": {f"{path.horizon_s:g} s": path.left_out for path in paths},
        "steps_compared": len(rows),
        "steps_left_out": int((~steps.followed).sum()),
    }
    return TwinGap(
        about=about,
        paths=path_rows,
        observations=observation_rows,
        rewards=reward_rows,
        verdicts=_verdicts(steps, config.limits, judged, path_rows, ratios),
        not_done=tuple(_not_done(store, steps, twins, stepped, paths)),
    )


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
    # The log's own: the applied action, the navigation stack's proposals and the lidar's readings.
    left_out = ["previous_action_", "nav_", "clearance_", "closing_"]
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
    paths: list[PathGap],
) -> Iterator[str]:  # fmt: skip
    if AFTER not in twins:
        yield "No gap after calibration: no fitted perturbation was given."
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
        "The replay drives on an empty, dry floor: racks, pallets, people and slippery patches of "
        "the log are not in it. Lidar readings were not compared, and clearances in rewards are "
        "the log's own."
    )
