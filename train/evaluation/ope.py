"""Off-policy evaluation: what a policy is worth, from logs of others, before it drives itself.

What is evaluated is the greedy policy made soft: with probability `epsilon` it acts at random. A
deterministic one agrees with no long episode to its end, and its weights would all be zero.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pyarrow as pa
from msgspec import Meta
from numpy.typing import NDArray

from restock.arrays import F64
from restock.files import write_table
from restock.ingest.task.task import Task
from restock.toml import Checked
from restock.train.dqn.behaviour import PolicyNetwork
from restock.train.dqn.config import TrainConfig, parse_config
from restock.train.dqn.fitted_q import (
    FittedQConfig,
    cloned_behaviour,
    cloned_probabilities,
    fitted_q,
    soft_greedy,
    values,
)
from restock.train.dqn.network import QNetwork, torch_threads
from restock.train.evaluation.off_policy.dataset import (
    Measure,
    OpeDataset,
    OpeSteps,
    load_ope_dataset,
)
from restock.train.evaluation.off_policy.estimators import EssGate, OpeEpisodes, estimate
from restock.train.evaluation.policies import GreedyPolicy, load_agent
from restock.train.run.kept_policy import PolicyOrigin
from restock.train.run.run import Run
from restock.train.run.run_profile import profile_of_run, run_panel
from restock.train.run.run_tables import TABLES

ALL = "all"
FILE = "off_policy.parquet"  # in RUN/eval


class OpeConfig(Checked, frozen=True):
    """Settings of off-policy evaluation.

    Raises:
        ValueError: a value out of its range.
    """

    epsilon: Annotated[float, Meta(ge=0, le=1)] = 0.1  # of the greedy policy made soft
    horizon: Annotated[int, Meta(ge=1)] | None = None  # steps that are weighted; None: all
    ess_share: Annotated[float, Meta(ge=0, le=1)] = 0.2  # of the episodes, that weights must reach
    ess_episodes: float = 5.0  # … and at least this many
    seed: int = 0
    model: FittedQConfig = FittedQConfig()


@dataclass(frozen=True)
class OpeResult:
    """The rows of `off_policy`, and notes on the logs."""

    rows: list[dict[str, Any]]
    notes: tuple[str, ...]
    version: str  # of the policy
    origin: PolicyOrigin | None = None


@dataclass(frozen=True)
class OpePlan:
    """What the off-policy evaluation of a run needs: nothing is fitted yet."""

    path: Path
    policy: GreedyPolicy
    trained: TrainConfig
    task: Task
    dataset: OpeDataset
    config: OpeConfig

    @property
    def measures(self) -> tuple[Measure, ...]:
        return measures_of(self.task, self.dataset)

    @property
    def updates(self) -> int:
        """Number of updates of all models."""
        model = self.config.model
        cloned = bool(self.dataset.evaluation.unlogged.any())
        return model.cloning_updates * cloned + (
            model.iterations * model.updates * len(self.measures)
        )

    def document(self) -> dict[str, Any]:
        """Return what would be evaluated, as JSON."""
        evaluated = self.dataset.evaluation
        return {
            "run": str(self.path),
            "policy": self.policy.version,
            "trained": None if self.policy.origin is None else self.policy.origin.document,
            "measures": list(self.measures),
            "episodes": len(np.unique(evaluated.episode)),
            "rows": len(evaluated.rows),
            "fitted_rows": len(self.dataset.training.rows),
            "updates": self.updates,
            "epsilon": self.config.epsilon,
            "horizon": self.config.horizon,
            "notes": list(notes_of(self.task, self.dataset, self.config)),
        }


def plan_off_policy(path: Path, logs: str | None, config: OpeConfig) -> OpePlan:
    """Read and check the run and the logs of an evaluation; raises as these do."""
    run = Run.open(path)
    trained = parse_config(run.document["config"], where=str(path / "config.json"))
    agent = load_agent(run)
    task = profile_of_run(run).task
    dataset = load_ope_dataset(run_panel(run.document), task, logs, seed=config.seed)
    return OpePlan(path, agent, trained, task, dataset, config)


def evaluate_run_off_policy(
    path: Path | str,
    logs: str | None,
    config: OpeConfig = OpeConfig(),  # noqa: B008  (frozen)
    progress: Callable[[int], None] | None = None,
    *,
    write: bool = True,
) -> OpeResult:
    """Evaluate the policy of a run, and write `RUN/eval/off_policy.parquet`.

    Args:
        path: the run.
        logs: a store, or a panel whose held-out episodes count; default the run's own panel.
        progress: called with 1 before every update of its models.
        write: whether to write the file.

    Raises:
        RunError: no such run, no policy yet, or no episode that it did not learn from.
        StoreError, PanelError: no such logs.
    """
    return evaluate_planned(plan_off_policy(Path(path), logs, config), progress, write=write)


def evaluate_planned(
    plan: OpePlan, progress: Callable[[int], None] | None = None, *, write: bool = True
) -> OpeResult:
    """Evaluate as `evaluate_run_off_policy` does."""
    with torch_threads(plan.trained.threads):
        rows = evaluate_off_policy(
            plan.policy.network,
            plan.dataset,
            discount=plan.trained.loss.discount,
            measures=plan.measures,
            config=plan.config,
            between=(lambda: None) if progress is None else (lambda: progress(1)),
        )
    if write:
        origin = plan.policy.origin
        names = ("env_steps", "gradient_steps")
        clocks = {name: None if origin is None else getattr(origin, name) for name in names}
        table = pa.Table.from_pylist([{**clocks, **row} for row in rows], TABLES["off_policy"])
        write_table(table, plan.path / "eval" / FILE)
    notes = notes_of(plan.task, plan.dataset, plan.config)
    return OpeResult(rows, notes, plan.policy.version, plan.policy.origin)


def notes_of(task: Task, dataset: OpeDataset, config: OpeConfig) -> tuple[str, ...]:
    """Return notes on the logs, and on the model fitted to them."""
    return dataset.notes + _beyond_the_model(task, dataset.evaluation, config.model.iterations)


def _beyond_the_model(task: Task, steps: OpeSteps, reach: int) -> tuple[str, ...]:
    """Warn of episodes that may take more steps than the model looks ahead."""
    if task.time_limit_steps <= reach:
        return ()
    lengths = np.bincount(steps.episode)
    return (
        f"the fitted model looks {reach:,} steps ahead, but an episode may take"
        f" {task.time_limit_steps:,} ({int((lengths > reach).sum()):,} of {len(lengths):,} held-out"
        " episodes are longer): its values leave out what comes later, such as a goal that is"
        " reached then",
    )


def measures_of(task: Task, dataset: OpeDataset) -> tuple[Measure, ...]:
    """Return what can be measured on logs: no success without goals, or with goals in hindsight."""
    logged = task.goal == "route" and not dataset.hindsight
    return ("return", "success") if logged else ("return",)


def evaluate_off_policy(
    network: PolicyNetwork,
    dataset: OpeDataset,
    *,
    discount: float,
    measures: tuple[Measure, ...] = ("return", "success"),
    config: OpeConfig = OpeConfig(),  # noqa: B008  (frozen)
    between: Callable[[], None] = lambda: None,
) -> list[dict[str, Any]]:
    """Rows of `off_policy`: measure x condition of the episode x estimator.

    `between` is called before every update of its models; what it raises ends the evaluation.
    """
    results: list[dict[str, Any]] = []
    gate = EssGate(config.ess_share, config.ess_episodes)
    probability, estimated = behaviour_probability(dataset, network.actions, config, between)
    for measure in measures:
        training = dataset.training.measured(measure)
        evaluation = dataset.evaluation.measured(measure)
        gamma = discount if measure == "return" else 1.0
        q = fitted_q(
            training.rows,
            soft_greedy(network, training.rows.next_observation, config.epsilon),
            discount=gamma,
            bounds=None if measure == "return" else (0.0, 1.0),
            config=config.model,
            seed=config.seed,
            between=between,
        )
        kept = ~dataset.evaluation.bumped_before if measure == "success" else slice(None)
        episodes = padded_episodes(network, q, evaluation, probability[kept], gamma, config.epsilon)
        for condition in (ALL, *sorted(set(evaluation.condition.tolist()))):
            part = episodes
            if condition != ALL:
                part = episodes.select(evaluation.condition == condition)
            ess, ess_steps = gate.measure(part.until(config.horizon))
            shared = {
                "measure": measure,
                "condition": condition,
                "episodes": len(part),
                "ess": ess,
                "ess_steps": ess_steps,
                "steps": part.ratio.shape[1],
                "horizon": config.horizon,
                "epsilon": config.epsilon,
                "discount": gamma,
                "estimated_share": estimated,
            }
            rng = np.random.default_rng([config.seed, 12])
            results += [
                {
                    **shared,
                    "estimator": answer.estimator,
                    "value": answer.value,
                    "low": answer.low,
                    "high": answer.high,
                    "refused": answer.refused,
                }
                for answer in estimate(part, gate=gate, horizon=config.horizon, rng=rng)
            ]
    return results


def padded_episodes(
    network: PolicyNetwork,
    q: QNetwork,
    steps: OpeSteps,
    probability: F64,
    discount: float,
    epsilon: float,
) -> OpeEpisodes:
    """Rows by episode (N,) to padded episodes, as policy and model see them."""
    rows = steps.rows
    policy = soft_greedy(network, rows.observation, epsilon)
    at = np.arange(len(rows))
    first = np.flatnonzero(np.diff(steps.episode, prepend=-1))
    lengths = np.diff(np.append(first, len(rows)))
    step = at - np.repeat(first, lengths)
    shape = len(first), int(lengths.max())

    def padded(column: NDArray[Any], outside: float = 0.0) -> F64:
        matrix = np.full(shape, outside)
        matrix[steps.episode, step] = column
        return matrix

    return OpeEpisodes(
        padded(policy[at, rows.action] / probability, 1.0),
        padded(rows.reward),
        (policy[first] * values(q, rows.observation[first])).sum(axis=1),
        discount,
    )


def behaviour_probability(
    dataset: OpeDataset,
    actions: int,
    config: OpeConfig,
    between: Callable[[], None] = lambda: None,
) -> tuple[F64, float]:
    """Return the probability of each logged action (N,), and the share that had to be estimated.

    As logged; where the logs do not say, by cloning the behaviour of the training rows.
    """
    steps = dataset.evaluation
    unknown = steps.unlogged
    probability = steps.probability.copy()
    if unknown.any():
        rows = dataset.training.rows
        clone = cloned_behaviour(
            rows.observation,
            rows.action,
            actions,
            config=config.model,
            seed=config.seed,
            between=between,
        )
        cloned = cloned_probabilities(clone, steps.rows.observation[unknown])
        probability[unknown] = cloned[np.arange(len(cloned)), steps.rows.action[unknown]]
    return probability, int(unknown.sum()) / max(len(steps.rows), 1)


__all__ = [
    "OpeConfig",
    "OpeResult",
    "evaluate_off_policy",
    "evaluate_run_off_policy",
    "measures_of",
    "notes_of",
    "padded_episodes",
]
