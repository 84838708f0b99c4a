"""Evaluate a run: its policy and reference drivers on the same episodes.

Every policy drives the same seeded episodes, clean and under each perturbation; blocked aisles are
split by how much of the aisle is blocked. Seeds differ from those that training drew its
episodes from and from those that chose the checkpoint.

The references are scripted drivers that do not explore. The planner drives as a robot without
learning would. The operator gets the true pallets, people and wet floor from the simulation, so it
is an upper bound.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import msgspec
import pyarrow as pa

from restock.errors import ConfigError, RunError, quoted
from restock.ingest.task.robot import Limiter, Limits
from restock.process import interrupts_raised
from restock.toml import read_toml, typed
from restock.train.dqn.config import LAST_SEED, TrainConfig, parse_config
from restock.train.dqn.network import torch_threads
from restock.train.evaluation.evaluate import EpisodeResult, run_episodes
from restock.train.evaluation.policies import (
    CLONED,
    GreedyPolicy,
    cloned_panel,
    is_cloned,
    load_agent,
    load_cloned,
    load_policy,
)
from restock.train.run.kept_evaluations import (
    LIMITED,
    CloneQuality,
    add_evaluation,
    read_clones,
    shown_evaluation,
    summary_rows,
)
from restock.train.run.run import PolicyOrigin, Run
from restock.train.run.run_profile import profile_of_run
from restock.train.run.run_tables import EVAL_EPISODES
from restock.train.twin.env.interface import Policy
from restock.train.twin.floors.floors import layouts_of_split, open_floors
from restock.train.twin.missions import DEFAULT_CONDITIONS, KINDS
from restock.train.twin.physics.episode import EpisodeSpec, refuse_unfit, unfit_kinds
from restock.train.twin.physics.perturbation import (
    PERTURBATIONS,
    Perturbation,
    Schedule,
    find_perturbation,
    schedule_error,
)

if TYPE_CHECKING:
    from restock.train.twin.env.vector_env import WarehouseVectorEnv

REFERENCES = ("planner", "operator", "random")
FIRST_SEED = 10_000


def wrong_seed(seed: int, count: int = 1) -> str | None:
    """Explain why the `count` seeds from `seed` on are not all valid; None if they are."""
    if 0 <= seed <= LAST_SEED + 1 - count:
        return None
    last = f" ({count:,} seeds from there on)" if count > 1 else ""
    return f"must be from 0 to {LAST_SEED + 1 - count}{last}, got {seed}"


def reference(name: str, seed: int = 0) -> Policy:
    """Make the reference driver of this name.

    Raises:
        ConfigError: no reference has this name.
    """
    from restock.train.twin.env.drivers import Operator, PlannerFollower, RandomPolicy

    if name == "planner":
        return PlannerFollower(epsilon=0.0, seed=seed)
    if name == "operator":
        return Operator(epsilon=0.0, seed=seed)
    if name == "random":
        return RandomPolicy(seed=seed)
    raise ConfigError(
        f"there is no policy named {name!r}",
        where="drivers",
        remedy=f"choose from {', '.join(REFERENCES)}",
    )


CLEAN = "none"
POLICIES = ("agent", "planner", "random")
_PATHS = ", cloned:DRIVER, onnx:FILE, run:DIRECTORY"


@dataclass(frozen=True)
class EvaluationPlan:
    """A checked request for an evaluation."""

    run: Run
    config: TrainConfig
    policies: tuple[str, ...]
    perturbations: dict[str, Perturbation | None]  # by requested name or file; None: unperturbed
    episodes: Mapping[str, int]  # kind of episode -> number of episodes
    first_seed: int = FIRST_SEED
    num_envs: int = 32
    nthread: int = 0  # threads of the twin; 0: one per core
    layouts: str = "default"
    limits: Limits | None = None  # if set, all policies drive all episodes once more, limited
    left_out: dict[str, list[str]] = field(default_factory=dict)  # kind -> floors without room
    loaded: dict[str, Policy] = field(default_factory=dict)  # policies of runs and files, by name

    @property
    def kinds(self) -> tuple[str, ...]:
        """Return the requested kinds of episodes that every floor has room for."""
        return tuple(k for k in KINDS if k in self.episodes and k not in self.left_out)

    @property
    def specs(self) -> list[EpisodeSpec]:
        """Return the episodes to drive under each perturbation, with their kinds interleaved."""
        most = max(self.episodes[kind] for kind in self.kinds)
        return [
            EpisodeSpec(kind, self.first_seed + at)
            for at in range(most)
            for kind in self.kinds
            if at < self.episodes[kind]
        ]

    @property
    def warnings(self) -> list[str]:
        """Warn if episodes were also used to select the kept policy: their results are too good."""
        chosen = self.config.evaluation
        last = self.first_seed + max(self.episodes.values())
        if "agent" not in self.policies or not (
            chosen.seed < last and self.first_seed < chosen.seed + chosen.episodes
        ):
            return []
        return [
            f"seeds {self.first_seed} to {last - 1} are among those that selected the run's "
            f"policy ({chosen.seed} to {chosen.seed + chosen.episodes - 1}): its success is "
            "overestimated"
        ]

    @property
    def origins(self) -> dict[str, PolicyOrigin]:
        """Return, for each policy that comes from a run, the step at which the run saved it."""
        own = {n: p.origin for n, p in self.loaded.items() if isinstance(p, GreedyPolicy)}
        return {name: origin for name, origin in own.items() if origin is not None}

    @property
    def total(self) -> int:
        """Return the number of episodes to drive."""
        episodes = len(self.specs)
        drivers = len(self.policies) * (1 if self.limits is None else 2)
        return drivers * len(self.perturbations) * episodes


def plan_evaluation(
    path: Path,
    *,
    policies: Sequence[str] = POLICIES,
    perturbations: Sequence[str] = (CLEAN,),
    episodes: int | str | Mapping[str, int] = 20,
    first_seed: int = FIRST_SEED,
    layouts: str | None = None,
    limiter: str | None = None,
) -> EvaluationPlan:
    """Check a request; the arguments are those of `evaluate`.

    Raises:
        RunError: there is no such run, or it has no policy yet.
        ConfigError: a policy or perturbation does not exist, the floors have no room for any kind
            of episode, there are no episodes, or generators do not accept a seed.
    """
    run = Run.open(path)
    config = parse_config(run.document["config"], where=str(path / "config.json"))
    refuse_unknown("policies", policies, where="--policies")
    refuse_unknown("perturbations", perturbations, where="--perturbations")
    of_kind = episodes_of_kind(episodes)
    if wrong := wrong_seed(first_seed, max(of_kind.values())):
        raise ConfigError(wrong, where="--seed")
    layouts = layouts or layouts_of_split(config.env.layouts, "test")
    floors = open_floors(layouts)
    plan = EvaluationPlan(
        run,
        config,
        tuple(dict.fromkeys(policies)),
        {name: _perturb(name) for name in perturbations},
        of_kind,
        first_seed,
        layouts=layouts,
        limits=None if limiter is None else _limits(run, limiter),
        left_out=unfit_kinds(floors),
    )
    if not plan.kinds:
        refuse_unfit(floors, list(of_kind))
    for name in plan.policies:
        if is_cloned(name):
            cloned_panel(run, name)
        elif name == "agent" or _is_path("policies", name):
            plan.loaded[name] = make_policy(name, plan)  # so that errors come before driving
    return plan


def refuse_unknown(
    what: Literal["policies", "perturbations"], names: Sequence[str], *, where: str
) -> None:
    """Raise ConfigError if `restock eval` does not accept a name, or there are no names."""
    if what == "policies":
        choices, paths = ["agent", *REFERENCES, CLONED], _PATHS
    else:
        choices = [CLEAN, *(name for name in PERTURBATIONS if name != "nominal")]
        paths = ", FILE.toml"
    unknown = [name for name in names if name not in choices and not _is_path(what, name)]
    if unknown or not names:
        raise ConfigError(
            f"there is no {', '.join(map(repr, unknown))}" if unknown else "names nothing",
            where=where,
            remedy=f"choose from {', '.join(choices)}{paths}",
        )
    if what == "perturbations":
        for name in names:
            _perturb(name)


def episodes_of_kind(requested: int | str | Mapping[str, int]) -> dict[str, int]:
    """Return the number of episodes per kind, from one number for all or from `kind=N,kind=N`.

    Raises:
        ConfigError: there is no such kind, or a number is below 1 or not a number.
    """
    where = "--episodes"
    if isinstance(requested, str):
        parts = [part.partition("=") for part in requested.split(",") if part.strip()]
        named = any(sign for _, sign, _ in parts)
        try:
            found = {kind.strip(): int(count) for kind, _, count in parts} if named else None
            requested = int(requested) if found is None else found
        except ValueError:
            raise ConfigError(
                f"{requested!r} is neither a number nor kind=number,…",
                where=where,
                remedy="write 20, or nominal=1000,wheel_slip=300",
            ) from None
        if found is not None and len(found) < len(parts):
            kinds = [kind.strip() for kind, _, _ in parts]
            twice = next(kind for kind in kinds if kinds.count(kind) > 1)
            raise ConfigError(f"names {twice!r} twice", where=where, remedy="name each kind once")
    if isinstance(requested, int):
        requested = dict.fromkeys(KINDS, requested)
    if unknown := [kind for kind in requested if kind not in KINDS]:
        remedy = f"choose from {', '.join(KINDS)}"
        raise ConfigError(f"there is no kind {unknown[0]!r}", where=where, remedy=remedy)
    least = min(requested.values(), default=0)
    if least < 1:
        raise ConfigError(f"must be at least 1, got {least}", where=where)
    return dict(requested)


def _is_path(what: str, name: str) -> bool:
    if what == "policies":
        kind, _, path = name.partition(":")
        return kind in ("onnx", "run", CLONED) and bool(path)
    return name.endswith(".toml")


def make_policy(name: str, plan: EvaluationPlan) -> Policy:
    """Make a named policy: the run's own, a reference, a clone, or that of a file or other run."""
    if name in plan.loaded:
        return plan.loaded[name]
    if name == "agent":
        return load_agent(plan.run)
    if is_cloned(name):
        return load_cloned(plan.run, name, seed=plan.first_seed)
    named = load_policy(name, profile_of_run(plan.run).task)
    return reference(name, plan.first_seed) if named is None else named


def _limits(run: Run, named: str) -> Limits:
    """Return the limits of a run's robot, from its profile or from a TOML file.

    Raises:
        ConfigError: there is no such file, or it has no usable `[limiter]`.
    """
    profile = profile_of_run(run)
    given = profile.limiter
    if named != "profile":
        document = read_toml(Path(named), remedy='give "profile", or a TOML file with a [limiter]')
        if "limiter" not in document:
            raise ConfigError("has no [limiter]", where=named)
        given = typed(document["limiter"], Limiter, where=named, prefix="limiter")
    return Limits.of(profile.task, profile.robot, given)


def _perturb(name: str) -> Perturbation | None:
    """Return the perturbation of this name or file; None for "none".

    Raises:
        ConfigError: there is no such name or file, or it is a schedule, or for another timestep
            than the evaluation's.
    """
    if name == CLEAN:
        return None
    perturbation = find_perturbation(name, where="--perturbations")
    if isinstance(perturbation, Schedule):
        raise schedule_error(name)
    if perturbation.timestep_s != Perturbation().timestep_s:
        raise ConfigError(
            f"is for a timestep of {perturbation.timestep_s:g} s, but the evaluation runs at "
            f"{Perturbation().timestep_s:g} s",
            where=name,
            remedy="effective parameters depend on the timestep: fit them at the evaluation's",
        )
    return perturbation


def settings(plan: EvaluationPlan) -> dict[str, Any]:
    """Return the settings of an evaluation for the JSON output."""
    return {
        "run": str(plan.run.path),
        "policies": list(plan.policies),
        "trained": {name: origin.document for name, origin in plan.origins.items()},
        "perturbations": {
            name: msgspec.to_builtins(perturbation or Perturbation())
            for name, perturbation in plan.perturbations.items()
        },
        "episodes_per_kind": dict(plan.episodes),
        "first_seed": plan.first_seed,
        "layouts": plan.layouts,
        "limiter": None if plan.limits is None else msgspec.to_builtins(plan.limits),
        "kinds": list(plan.kinds),
        "left_out": plan.left_out,
    }


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
    """Drive a run's policy and the references through the same episodes, as `restock eval` does.

    Returns a row per policy, perturbation and condition: success, return, bumps per km,
    closest approach to people and time lost against the planner, with 95 % intervals over episodes.
    The episodes are written to the run's `eval/episodes.parquet`.

    Args:
        policies: agent (the run's own), planner, operator, random, cloned (the way the logs were
            driven), `cloned:DRIVER`, `onnx:FILE` or `run:DIRECTORY`.
        perturbations: none, friction, latency, payload, wheels, sensors, or a TOML file.
        episodes: number of each kind, or per kind: `{"nominal": 1000, "wheel_slip": 300}`.
        layouts: floors to drive on; None: the run's own, but test instead of training floors.
        limiter: "profile" for the profile's `[limiter]`, or a TOML file with one: every policy
            drives once more with this limiter, as `limited:NAME`.

    Raises:
        RunError: there is no such run, or it has no policy yet.
        ConfigError: there is no such policy or perturbation, or the floors have no room.
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
    """Drive all episodes, add them to the run's `eval/episodes.parquet`, and return their rows."""
    env = evaluation_env(plan)
    # All perturbations share a policy's queue: environments idle only at the end of the queue.
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
        driven = run_policy(plan, env, driver, [spec for _, spec in episodes], progress)
        for (perturbation, _), result in zip(episodes, driven, strict=True):
            results.setdefault((policy, perturbation), []).append(result)
    table = episodes_table(results, plan, versions)
    added: list[dict[str, Any]] = add_evaluation(plan.run.path, table).to_pylist()
    return added


def evaluation_env(plan: EvaluationPlan) -> WarehouseVectorEnv:
    """Make the twin in which a plan's episodes are driven."""
    from restock.train.twin.env.vector_env import WarehouseVectorEnv

    profile = profile_of_run(plan.run)
    return WarehouseVectorEnv(
        plan.num_envs,
        nthread=plan.nthread,
        task=profile.task,
        robot=profile.robot,
        seed=plan.first_seed,
        layouts=plan.layouts,
        conditions={kind: DEFAULT_CONDITIONS[kind] for kind in plan.kinds},
        nav_command=profile.inputs.nav_command is not None,
    )


def run_policy(
    plan: EvaluationPlan,
    env: WarehouseVectorEnv,
    driver: Policy,
    specs: Sequence[EpisodeSpec],
    progress: Callable[[int], None] | None = None,
) -> list[EpisodeResult]:
    """Drive episodes with a policy in a plan's twin; return results in the order of `specs`."""
    with torch_threads(plan.config.threads):
        return run_episodes(
            env,
            driver,
            specs,
            control_period_s=env.task.control_period_s,
            time_limit_steps=env.task.time_limit_steps,
            goal=env.task.goal != "none",
            discount=plan.config.loss.discount,
            progress=progress,
        )


def read_recorded(run: Path) -> tuple[list[dict[str, Any]], str]:
    """Return the episodes of a run's last evaluation, and a text that describes them.

    Raises:
        RunError: there was no evaluation, or its file is damaged.
    """
    table, text = shown_evaluation(run)
    if not table.num_rows:
        raise RunError(
            "has no recorded evaluation",
            where=str(run),
            remedy=f"run `restock eval {quoted(run)}` to drive one",
        )
    return table.to_pylist(), text


def clones_driven(plan: EvaluationPlan) -> list[CloneQuality]:
    """Return the recorded quality of each clone among the plan's policies."""
    return [one for one in read_clones(plan.run.path) if one.policy in plan.policies]


def episodes_table(results: Results, plan: EvaluationPlan, versions: Mapping[str, str]) -> pa.Table:
    """Make the table of episodes, with one row per episode."""
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
            "layouts": plan.layouts,
        }
        for (policy, perturbation), episodes in results.items()
        for result in episodes
    ]
    return pa.Table.from_pylist(rows, schema=EVAL_EPISODES)
