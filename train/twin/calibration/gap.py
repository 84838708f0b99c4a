"""The gap between the twin and a store's logs, per condition, before and after calibration.

Paths: logged commands driven again open loop (`path_gap`). Steps: one control period from each
logged state, through the task's own observation and reward (`one_step`). Verdicts: `trust`.
What a store's signals do not allow is said in `Gap.not_done`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from restock.errors import ConfigError, StoreError
from restock.replay.store.store import Store
from restock.stats import NOT_KNOWN, ConfidenceInterval
from restock.train.twin.calibration.gap_rows import (
    Rows,
    estimate,
    observation_rows,
    path_rows,
    reward_rows,
)
from restock.train.twin.calibration.logged_steps import NOMINAL, LoggedSteps, logged_steps
from restock.train.twin.calibration.one_step import AGREES, OneStep, agreement, one_step
from restock.train.twin.calibration.path_gap import PathGap, measured_noise, path_gap
from restock.train.twin.calibration.plan_memory import PlanMemory, rebuild_plans
from restock.train.twin.calibration.trust import UNTRUSTED, Limits, Verdict, judge
from restock.train.twin.floors.layout import Warehouse, default_warehouse
from restock.train.twin.physics.perturbation import Perturbation

BEFORE, AFTER = "nominal", "calibrated"
HORIZONS_S = (1.0, 3.0, 6.0)
_LOOKED_AT = 200  # nominal rows whose lidar says whether the floor is the twin's


@dataclass(frozen=True)
class GapPlan:
    """How the gap is measured."""

    horizons_s: tuple[float, ...] = HORIZONS_S
    most: int = 400  # segments a condition and horizon; steps: five times as many
    limits: Limits = field(default_factory=Limits)
    seed: int = 0
    timestep_s: float = 0.01
    nthread: int = 1

    def __post_init__(self) -> None:
        if not self.horizons_s or min(self.horizons_s) <= 0:
            raise ConfigError("horizons must be above 0 s", where="gap")
        if self.limits.horizon_s not in self.horizons_s:
            raise ConfigError(
                f"the horizon that trust is judged at, {self.limits.horizon_s:g} s, is not driven",
                where="gap",
                remedy="make it one of the horizons",
            )
        if self.most < 1:
            raise ConfigError(f"most must be 1 or more, got {self.most}", where="gap")


@dataclass(frozen=True)
class Gap:
    """What was measured. Rows are plain values; statistics carry 95 % intervals over episodes."""

    about: dict[str, Any]  # store, version, task, twins, noise, counts
    paths: Rows  # condition, horizon_s, quantity, unit, source, segments, episodes, median, p90 …
    observations: Rows  # condition, component, source, steps, mean_gap, low, high
    rewards: Rows  # condition, term, source, steps, mean_gap, low, high, bias, spread
    verdicts: tuple[Verdict, ...]
    not_done: tuple[str, ...]

    @property
    def untrusted(self) -> list[str]:
        """The conditions in which the twin should not be trusted."""
        return [found.condition for found in self.verdicts if found.verdict == UNTRUSTED]

    def document(self) -> dict[str, Any]:
        """As JSON has it."""
        return {
            "about": self.about,
            "untrusted": self.untrusted,
            "verdicts": [asdict(found) for found in self.verdicts],
            "not_done": list(self.not_done),
            "paths": self.paths,
            "observations": self.observations,
            "rewards": self.rewards,
        }


def measure_gap(
    store: Store,
    calibrated: Perturbation | None = None,
    plan: GapPlan | None = None,
    *,
    warehouse: Warehouse | None = None,
    task_hash: str | None = None,
    notes: tuple[str, ...] = (),
    tell: Callable[[str], None] = lambda _: None,
) -> Gap:
    """Measure the gap of the nominal twin, and of a calibrated one beside it.

    `warehouse` is the floor that the log may have been driven on (default: the twin's own); what
    the lidar sees is compared only where the two agree. `notes` are said beside what was not done.

    Raises:
        ConfigError: a horizon that is not some control periods, or a control period that the twin
            cannot keep.
        StoreError: no rows, rows of several tasks and no `task_hash`, or no row that is followed
            by another.
    """
    plan, warehouse = plan or GapPlan(), warehouse or default_warehouse()
    twins = {BEFORE: Perturbation()} | ({AFTER: calibrated} if calibrated is not None else {})
    best = list(twins)[-1]
    steps = logged_steps(store, task_hash)
    if not steps.followed.any():
        raise StoreError("no step is followed by another", where=str(store.path))
    noise = measured_noise(steps, twins[best])
    paths = []
    for horizon in plan.horizons_s:
        tell(f"driving segments of {horizon:g} s again")
        paths.append(
            path_gap(
                steps, horizon, twins, noise,
                most=plan.most, seed=plan.seed, timestep_s=plan.timestep_s, nthread=plan.nthread,
            )
        )  # fmt: skip
    tell("one step from each logged state")
    rng = np.random.default_rng([plan.seed, 2])
    differs = _floor_differs(store, steps, warehouse, rng)
    plans = rebuild_plans(steps)
    rows, chosen = _steps_to_compare(steps, 5 * plan.most, rng)
    stepped = one_step(
        store, steps, plans, rows, twins,
        warehouse=None if differs > AGREES else warehouse,
        timestep_s=plan.timestep_s, nthread=plan.nthread,
    )  # fmt: skip
    moved = path_rows(paths, rng)
    observed = observation_rows(steps, stepped, chosen, rng)
    earned, ratios = reward_rows(steps, stepped, chosen, rng)
    about = {
        "store": str(store.path),
        "store_version": store.version,
        "task_hash": steps.task.hash,
        "rows": len(steps),
        "episodes": len(np.unique(steps.episode_id)),
        "judged": best,
        "twins": {name: msgspec.to_builtins(twin) for name, twin in twins.items()},
        "noise": asdict(noise),
        "limits": asdict(plan.limits),
        "floor": warehouse.name,
        "floor_difference": differs,
        "left_out": {f"{found.horizon_s:g} s": found.left_out for found in paths},
        "steps_compared": len(rows),
        "steps_left_out": int((~steps.followed).sum()),
        "plan_error_m": plans.error_m,
    }
    verdicts = _verdicts(steps, plan.limits, best, moved, ratios)
    said = _not_done(steps, twins, stepped, plans, differs, noise.drift_m, calibrated, paths)
    return Gap(about, moved, observed, earned, verdicts, (*said, *notes))


def _floor_differs(
    store: Store, steps: LoggedSteps, warehouse: Warehouse, rng: np.random.Generator
) -> float:
    rows = np.flatnonzero(steps.conditions[NOMINAL])
    if not len(rows):
        return 1.0
    looked_at = np.sort(rng.permutation(rows)[:_LOOKED_AT])
    return agreement(steps, store, looked_at, warehouse)


def _steps_to_compare(
    steps: LoggedSteps, most: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], dict[str, NDArray[np.bool_]]]:
    """Rows, and condition -> which of them count for it: at most `most` each, drawn evenly."""
    masks = {}
    for name, holds in steps.conditions.items():
        mask, members = np.zeros(len(steps), np.bool_), np.flatnonzero(holds & steps.followed)
        mask[rng.permutation(members)[:most]] = True
        masks[name] = mask
    rows = np.flatnonzero(np.any(list(masks.values()), axis=0))
    return rows, {name: mask[rows] for name, mask in masks.items()}


def _verdicts(
    steps: LoggedSteps,
    limits: Limits,
    best: str,
    moved: Rows,
    ratios: Mapping[tuple[str, str], ConfidenceInterval],
) -> tuple[Verdict, ...]:
    at = {
        row["condition"]: row
        for row in moved
        if (row["horizon_s"], row["quantity"], row["source"])
        == (limits.horizon_s, "position", best)
    }
    verdicts = []
    for condition in steps.conditions:
        row = at.get(condition)
        p90 = NOT_KNOWN if row is None else estimate(row, "p90")
        verdicts.append(
            judge(
                condition,
                limits=limits,
                segments=row["segments"] if row else 0,
                episodes=row["episodes"] if row else 0,
                position_p90=p90,
                reward_ratio=ratios.get((condition, best), NOT_KNOWN),
            )
        )
    return tuple(verdicts)


def _not_done(
    steps: LoggedSteps,
    twins: Mapping[str, Perturbation],
    stepped: OneStep,
    plans: PlanMemory,
    differs: float,
    drift_m: float,
    calibrated: Perturbation | None,
    paths: list[PathGap],
) -> tuple[str, ...]:
    said = []
    if calibrated is None:
        said.append("No gap after calibration: no fitted perturbation was given.")
    if differs > AGREES:
        said.append(
            "What the lidar sees was not compared: the log was driven on another floor than the"
            f" twin's (their clearances differ by {differs:.2f} in the median, {AGREES:g} is the"
            " most). Steps were driven on an empty floor: clearances in their rewards are the log's"
            " own, and nothing is bumped into."
        )
    if steps.task.goal != "route":
        said.append(
            "Waypoints and distance to a goal were not compared: the log has no goal and no plan;"
            " progress is forward motion."
        )
    if not drift_m and any(twin.localisation_drift_m for twin in twins.values()):
        said.append(
            "The pose never disagrees with the wheels, so it is their odometry: the gap is to"
            " that, slip cannot show in it, and there is no floor of localisation noise."
        )
    for path in paths:
        if not len(path.episode_id):
            said.append(f"No stretch of {path.horizon_s:g} s could be driven again.")
    last_steps = int((~steps.followed).sum())
    if last_steps:
        said.append(f"{last_steps} last steps of episodes have no step after them to compare with.")
    if stepped.unexplained:
        said.append(
            f"The rewards of {stepped.unexplained} steps are not the sum of their terms by this"
            " version's task: their gaps by term are of the terms as recomputed."
        )
    if not stepped.valid.all():
        said.append(f"{int((~stepped.valid).sum())} steps were left out: the physics broke.")
    said.append(
        "Pallets, people and slippery patches of the log are not known to the replay: it drives on"
        " the floor alone, dry."
    )
    return tuple(said)
