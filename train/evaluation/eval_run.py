"""Evaluating a run: its policy beside scripted ones, on the same episodes.

Every policy drives the same seeded episodes, clean and under each perturbation; blocked aisles are
split by how much of the aisle is blocked. Seeds differ from those that training drew its
episodes from and from those that chose the checkpoint.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa

from restock.errors import RunError
from restock.interrupts import interrupts_raised
from restock.train.dqn.network import torch_threads
from restock.train.evaluation.evaluate import EpisodeResult, run_episodes
from restock.train.evaluation.evaluation_plan import (
    CLEAN,
    POLICIES,
    EvaluationPlan,
    make_policy,
    plan_evaluation,
)
from restock.train.evaluation.references import FIRST_SEED
from restock.train.run.kept_evaluations import (
    LIMITED,
    CloneQuality,
    add_evaluation,
    read_clones,
    shown_evaluation,
)
from restock.train.run.measures import summary_rows
from restock.train.run.run_profile import profile_of_run
from restock.train.run.run_tables import EVAL_EPISODES
from restock.words import quoted

Results = dict[tuple[str, str], list[EpisodeResult]]  # (policy, perturbation) -> episodes


@interrupts_raised
def evaluate(
    run: Path | str,
    *,
    policies: Sequence[str] = POLICIES,
    perturbations: Sequence[str] = (CLEAN,),
    episodes: int | str | Mapping[str, int] = 20,
    first_seed: int = FIRST_SEED,
    layouts: str | None = None,
    limiter: str | None = None,
) -> list[dict[str, Any]]:
    """Drive a run's policy and its references through the same episodes, as `restock eval`.

    Returns a row per policy, perturbation and condition: success, return, bumps per km,
    closest approach to people and time lost against the planner, with 95 % intervals over episodes.
    The episodes are kept in the run's `eval/episodes.parquet`.

    Args:
        policies: agent (the run's own), planner, operator, random, cloned (the way the logs were
            driven), `cloned:DRIVER`, `onnx:FILE` or `run:DIRECTORY`.
        perturbations: none, friction, latency, payload, wheels, sensors, or a TOML file.
        episodes: of each kind, or by kind: `{"nominal": 1000, "wheel_slip": 300}`.
        layouts: floors to drive on; None: the run's own, of training floors the test split.
        limiter: "profile", or a TOML file with a `[limiter]`: every policy drives once more with
            it in front, as `limited:NAME`.

    Raises:
        RunError: no such run, or it has no policy yet.
        ConfigError: no such policy or perturbation, or no floor with room for any episode.
    """
    plan = plan_evaluation(
        Path(run),
        policies=policies,
        perturbations=perturbations,
        episodes=episodes,
        first_seed=first_seed,
        layouts=layouts,
        limiter=limiter,
    )
    return summary_rows(drive_evaluation(plan))


def drive_evaluation(
    plan: EvaluationPlan, progress: Callable[[int], None] | None = None
) -> list[dict[str, Any]]:
    """Drive all episodes, and add them to the run's `eval/episodes.parquet`: those rows."""
    from restock.train.twin.env.vector_env import WarehouseVectorEnv
    from restock.train.twin.missions.registry import DEFAULT_CONDITIONS

    profile = profile_of_run(plan.run)
    task = profile.task
    env = WarehouseVectorEnv(
        plan.num_envs,
        nthread=plan.nthread,
        task=task,
        robot=profile.robot,
        seed=plan.first_seed,
        layouts=plan.layouts,
        conditions={kind: DEFAULT_CONDITIONS[kind] for kind in plan.kinds},
        nav_command=profile.inputs.nav_command is not None,
    )
    # One queue a policy, over all perturbations: few environments then wait for the last episodes.
    episodes = [
        (name, msgspec.structs.replace(spec, perturbation=perturbation))
        for name, perturbation in plan.perturbations.items()
        for spec in plan.specs
    ]
    results: Results = {}
    versions: dict[str, str] = {}
    limited = [] if plan.limits is None else [LIMITED + name for name in plan.policies]
    for policy in (*plan.policies, *limited):
        driver = make_policy(policy.removeprefix(LIMITED), plan)
        env.limits = plan.limits if policy in limited else None
        versions[policy] = driver.version
        if env.limits is not None:
            versions[policy] += f" limits {env.limits.hash}"
        with torch_threads(plan.config.threads):
            driven = run_episodes(
                env,
                driver,
                [spec for _, spec in episodes],
                control_period_s=task.control_period_s,
                time_limit_steps=task.time_limit_steps,
                goal=task.goal != "none",
                discount=plan.config.loss.discount,
                progress=progress,
            )
        for (perturbation, _), result in zip(episodes, driven, strict=True):
            results.setdefault((policy, perturbation), []).append(result)
    table = episodes_table(results, plan, versions)
    added: list[dict[str, Any]] = add_evaluation(plan.run.path, table).to_pylist()
    return added


def read_recorded(run: Path) -> tuple[list[dict[str, Any]], str]:
    """Return the episodes of a run's last evaluation, and a text that says which they are.

    Raises:
        RunError: nothing was driven, or the file is damaged.
    """
    table, text = shown_evaluation(run)
    if not table.num_rows:
        raise RunError(
            "has no recorded evaluation",
            where=str(run),
            remedy=f"run `restock eval {quoted(run)}` (without --no-drive)",
        )
    return table.to_pylist(), text


def clones_driven(plan: EvaluationPlan) -> list[CloneQuality]:
    """Return how good the clones among the policies are; empty before they were driven."""
    return [one for one in read_clones(plan.run.path) if one.policy in plan.policies]


def episodes_table(results: Results, plan: EvaluationPlan, versions: Mapping[str, str]) -> pa.Table:
    """Make the table of episodes, one row each."""
    origins = {name: origin.env_steps for name, origin in plan.origins.items()}
    rows = [
        {
            "policy": policy,
            **result.row,
            "perturbation": perturbation,
            "end_x_m": result.end_x_m,
            "end_y_m": result.end_y_m,
            "limited_s": result.limited_s,
            "stopped_s": result.stopped_s,
            "failure": result.failure,
            "version": versions[policy],
            "trained_env_steps": origins.get(policy.removeprefix(LIMITED)),
            "layouts": plan.floors,
        }
        for (policy, perturbation), episodes in results.items()
        for result in episodes
    ]
    return pa.Table.from_pylist(rows, schema=EVAL_EPISODES)
