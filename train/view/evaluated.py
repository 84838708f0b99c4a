"""An episode of a run's evaluation as a moment: driven again, to be looked at beside a logged one.

An episode follows from its spec, so that what `restock eval` recorded can be driven again with the
policy that is kept. One whose outcome is not the recorded one is refused: it would be another.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from restock.arrays import F32, F64, Ints
from restock.errors import ConfigError, RunError
from restock.replay.trace.moment import NS, Moment, Seen
from restock.train.evaluation.eval_run import (
    CLEAN,
    EvaluationPlan,
    make_policy,
    plan_evaluation,
)
from restock.train.evaluation.evaluate import Stepper
from restock.train.evaluation.film import differing_fields, drive_row, scene_state
from restock.train.run.kept_evaluations import read_evaluations
from restock.train.run.run_profile import profile_of_run
from restock.train.twin.env.interface import Step
from restock.train.view.mcap_view import Critic
from restock.words import quoted

if TYPE_CHECKING:
    from restock.train.twin.env.vector_env import WarehouseVectorEnv

_MAX_SEEDS = 8  # that an error names


@dataclass(frozen=True)
class Evaluated:
    """An episode of T steps, from its first on."""

    moment: Moment
    outcome: dict[str, Any]  # as the evaluation recorded it
    racks_m: list[tuple[float, float, float, float]]  # x and y from, x and y to
    others: list[dict[str, Any]]  # T: people, forklifts and pallets there, [x, y, yaw] of each


@dataclass(frozen=True)
class Beside:
    """An episode of an evaluation beside a logged one, and what the critic says along it."""

    evaluated: Evaluated
    critic: Critic | None


def evaluated_moment(run: Path, name: str, *, begins_ns: int) -> Evaluated:
    """Drive an episode of the agent's evaluation on unperturbed missions again.

    Args:
        run: whose evaluation; its kept policy drives.
        name: CONDITION/SEED.
        begins_ns: the log time that its first step is given.

    Raises:
        ConfigError: no such episode was recorded, or `name` is none.
        RunError: no such run or policy, or driven again the episode is not the recorded one.
    """
    plan = plan_evaluation(run, policies=("agent",))
    row = _recorded(plan, name)
    task = profile_of_run(plan.run).task
    steps: list[dict[str, Any]] = []
    others: list[dict[str, Any]] = []
    plans: list[F64] = []
    goals: list[tuple[float, float] | None] = []
    racks: list[tuple[float, float, float, float]] = []
    period_ns = round(task.control_period_s * NS)

    def watched(env: WarehouseVectorEnv) -> Stepper:
        def step(observation: F32, action: Ints) -> Step:
            before = {column: values[0] for column, values in env.signals.items()}
            way, goal = env.navigation.plans_m[0], env.navigation.goals_m[0]
            same = bool(plans) and np.array_equal(plans[-1], way)
            plans.append(plans[-1] if same else np.array(way, np.float64))
            known = bool(np.isfinite(goal).all())
            goals.append((float(goal[0]), float(goal[1])) if known else None)
            others.append(scene_state(env, len(others) * task.control_period_s))
            if not racks:
                racks.extend((r.x_min, r.y_min, r.x_max, r.y_max) for r in env.floor_of(0).racks)
            made = env.step(action)
            after, reward, terminated, _, info = made
            commands = ("command_speed_mps", "command_yaw_rate_radps")
            steps.append(
                before
                | {command: info["signals"][command][0] for command in commands}
                | {
                    **{"transition_id": len(steps), "stamp_ns": len(steps) * period_ns},
                    **{"action": int(info.get("action", action)[0]), "reward": float(reward[0])},
                    **{"observation": observation[0], "next_observation": after[0]},
                    **{"terminated": bool(terminated[0]), "behaviour_policy": row["version"]},
                    **{"condition": "", "conditions": None},  # the twin is not labelled
                    "true_condition": str(info["true_condition"][0]),
                }
            )
            return made

        return step

    result = drive_row(plan, row, watched)
    if differing := differing_fields(row, result):
        raise RunError(
            f"episode {name} driven again has another {', '.join(differing)} than recorded",
            where=str(run),
            remedy=f"`restock eval {quoted(run)}` drives its evaluation again",
        )
    stamps = np.array([one["stamp_ns"] for one in steps], np.int64)
    ways = [way if len(way) else None for way in plans]
    seen = Seen(stamps, [None] * len(steps), ways, goals)
    window = begins_ns, begins_ns + period_ns * len(steps)
    return Evaluated(Moment(steps[0], steps, task, begins_ns, window, seen), row, racks, others)


def _recorded(plan: EvaluationPlan, name: str) -> dict[str, Any]:
    """Return the row of the evaluation that `name` means."""
    version = make_policy("agent", plan).version
    rows: list[dict[str, Any]] = [
        row
        for row in read_evaluations(plan.run.path).to_pylist()
        if (row["policy"], row["version"], row["perturbation"], row["layouts"])
        == ("agent", version, CLEAN, plan.layouts)
    ]
    condition, _, seed = name.rpartition("/")
    for row in rows:
        if row["condition"] == condition and str(row["episode_seed"]) == seed:
            return row
    of: dict[str, list[int]] = {}
    for row in rows:
        of.setdefault(row["condition"], []).append(row["episode_seed"])
    known = "; ".join(
        f"{condition}/{', '.join(map(str, sorted(seeds)[:_MAX_SEEDS]))}"
        + (" …" if len(seeds) > _MAX_SEEDS else "")
        for condition, seeds in of.items()
    )
    raise ConfigError(
        f"{name!r} is not an episode that policy {version} drove in the evaluation of "
        f"{plan.run.path}",
        where="--beside",
        remedy=f"give CONDITION/SEED of one: {known}"
        if known
        else f"run `restock eval {quoted(plan.run.path)}` first",
    )


__all__ = ["Beside", "Evaluated", "evaluated_moment"]
