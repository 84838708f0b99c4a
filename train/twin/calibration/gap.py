"""The gap between the twin and a store's logs, per condition, before and after calibration.

Paths: logged commands driven again open loop (`path_gap`). Steps: one control period from each
logged state, through the task's own observation and reward (`one_step`). Each statistic is a row
with its interval over episodes; verdicts are made of them (`twin_gap`). What a store's signals do
not allow is listed in `TwinGap.not_done`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from restock.arrays import Bools, Ints
from restock.errors import StoreError
from restock.ingest.profile.profile import load_profile
from restock.ingest.task.robot import Robot
from restock.replay.store.store import Store
from restock.stats import NOT_KNOWN, ConfidenceInterval, clustered_quantiles, clustered_ratio
from restock.train.twin.calibration.logged_steps import NOMINAL, LoggedSteps, logged_steps
from restock.train.twin.calibration.one_step import (
    AGREES,
    OneStep,
    agreement,
    one_step,
    rebuild_plans,
)
from restock.train.twin.calibration.path_gap import (
    QUANTITIES,
    PathGap,
    measured_noise,
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

BEFORE, AFTER, PERSISTENCE = "nominal", "calibrated", "persistence"
_FLOOR_ROWS = 200  # nominal rows whose lidar says whether the floor is the twin's


def measure_gap(
    store: Store,
    calibrated: Perturbation | None = None,
    config: GapConfig | None = None,
    *,
    warehouse: Warehouse | None = None,
    task_hash: str | None = None,
    robot: Robot | None = None,
    notes: tuple[str, ...] = (),
    on_progress: Callable[[str], None] | None = None,
) -> TwinGap:
    """Measure the gap of the nominal twin, and of a calibrated one beside it.

    `warehouse` is the floor that the log may have been driven on (default: the twin's own); what
    the lidar sees is compared only where the two agree. `robot` is whose logs they are (default:
    that of the store's own profile). `notes` are listed beside what was not done.

    Raises:
        ConfigError: a horizon that is not some control periods, or a control period that the twin
            cannot keep.
        StoreError: no rows, rows of several tasks and no `task_hash`, or no row that is followed
            by another.
    """
    config, warehouse = config or GapConfig(), warehouse or default_warehouse()
    report = on_progress or (lambda text: None)
    twins = {BEFORE: Perturbation()} | ({AFTER: calibrated} if calibrated is not None else {})
    judged = list(twins)[-1]
    steps = logged_steps(store, task_hash, robot=robot)
    if not steps.followed.any():
        raise StoreError("no step is followed by another", where=str(store.path))
    noise = measured_noise(steps, twins[judged])
    paths = []
    for horizon in config.horizons_s:
        report(f"driving segments of {horizon:g} s again")
        paths.append(path_gap(steps, horizon, twins, noise, config))
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
        "noise": asdict(noise),
        "limits": msgspec.structs.asdict(config.limits),
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
        not_done=(
            *_not_done(steps, twins, stepped, difference, noise.drift_m, paths),
            *notes,
        ),
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
    """Rows, and condition -> which of them count for it: at most `most` each, drawn evenly."""
    masks = {}
    for name, holds in steps.conditions.items():
        mask, members = np.zeros(len(steps), np.bool_), np.flatnonzero(holds & steps.followed)
        mask[rng.permutation(members)[:most]] = True
        masks[name] = mask
    rows = np.flatnonzero(np.any(list(masks.values()), axis=0))
    return rows, {name: mask[rows] for name, mask in masks.items()}


def _path_rows(paths: list[PathGap], rng: np.random.Generator) -> Iterator[dict[str, Any]]:
    """Median and 90th percentile of every quantity, by condition, horizon and source."""
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
    """Mean absolute gap of every component that the twin could get wrong."""
    sources = {name: result.observation for name, result in stepped.twins.items()}
    sources |= {PERSISTENCE: stepped.now}
    # The action that was applied, and what the log's own navigation proposed.
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
    """Gaps by term, and by (condition, source) the whole gap over the reward's own spread.

    The spread is the distance of a step's reward from the median, taken to be a step's cost at
    least: standing still earns the same at every step, and next to that any gap is large.
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
    """An interval as values of a row; NaN as None."""
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
    steps: LoggedSteps, twins: Mapping[str, Perturbation], stepped: OneStep,
    difference: float, drift_m: float, paths: list[PathGap],
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
            "What the lidar sees was not compared: the log was driven on another floor than the"
            f" twin's (their clearances differ by {difference:.2f} in the median, {AGREES:g} is the"
            " most). Steps were driven on an empty floor: clearances in their rewards are the "
            "log's own, and there are no obstacles."
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
    if not drift_m and any(twin.localisation_drift_m for twin in twins.values()):
        yield (
            "The pose always agrees with the wheels, so it is wheel odometry: the gap is measured "
            "against that, slip is not visible, and localisation noise cannot be estimated."
        )
    for path in paths:
        if not len(path.episode_id):
            yield f"No stretch of {path.horizon_s:g} s could be driven again."
    last_steps = int((~steps.followed).sum())
    if last_steps:
        yield f"{last_steps} last steps of episodes have no step after them to compare with."
    if stepped.unexplained:
        yield (
            f"The rewards of {stepped.unexplained} steps are not the sum of their terms by this"
            " version's task: their gaps by term are of the terms as recomputed."
        )
    if not stepped.valid.all():
        yield f"{int((~stepped.valid).sum())} steps were left out: the physics broke."
    yield (
        "Pallets, people and slippery patches of the log are not in the replay: it drives on an "
        "empty, dry floor."
    )
