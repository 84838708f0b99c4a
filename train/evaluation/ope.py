"""Off-policy evaluation: estimate a policy's value from logs of other drivers, before it drives.

The evaluated policy is the greedy one made soft: with probability `epsilon` it acts at random. A
deterministic policy would disagree with every long episode at some step, so all weights would be 0.

There are two estimators, over n logged episodes padded to T steps:

- fitted Q evaluation (`restock.train.dqn.fitted_q`; Le et al. 2019, arXiv:1903.08738) is the mean
  of the fitted model's V(s_0). It needs no importance weights, but is as wrong as the model;
- per-decision weighted importance sampling (Precup, Sutton and Singh 2000) weights each reward by
  how much likelier the evaluated policy was to get that far. It needs no model and is consistent.

The more two policies differ, the more unequal weights become with every step, until one episode
outweighs all others. If the effective sample size is below a given share of the episodes, the
weighted estimate is refused, so that a number from one episode is not taken for one from a hundred.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.arrays import F64, Bools
from restock.files import write_table
from restock.ingest.task.task import Task
from restock.stats import cluster_counts, percentiles
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
from restock.train.evaluation.ope_dataset import (
    Measure,
    OpeDataset,
    OpeSteps,
    load_ope_dataset,
)
from restock.train.evaluation.policies import GreedyPolicy, load_agent
from restock.train.run.run import Run
from restock.train.run.run_profile import profile_of_run, run_panel
from restock.train.run.run_tables import TABLES

FQE, PDWIS, LOGGED = "fqe", "pdwis", "logged"
_TINY = 1e-300


@dataclass(frozen=True)
class OpeEpisodes:
    """n logged episodes with importance ratios, padded to T steps with `ratio` 1 and `reward` 0."""

    ratio: F64  # (n, T) probability of the action under the evaluated / the behaviour policy
    reward: F64  # (n, T)
    start_value: F64  # (n,) the fitted model's value of the first observation
    discount: float

    def __len__(self) -> int:
        return len(self.ratio)

    def select(self, episodes: Bools) -> OpeEpisodes:
        """Select some of the episodes."""
        return replace(
            self,
            ratio=self.ratio[episodes],
            reward=self.reward[episodes],
            start_value=self.start_value[episodes],
        )

    @property
    def discounts(self) -> F64:
        """Return the discount of each step, (T,)."""
        return np.asarray(self.discount ** np.arange(self.reward.shape[1]), np.float64)


def once(episodes: int) -> F64:
    """Return bootstrap counts (1, n) in which every episode counts once."""
    return np.ones((1, episodes))


def relative_weights(ratio: F64) -> F64:
    """Return the product of ratios up to each step, (n, T), with a maximum of 1 at each step."""
    with np.errstate(divide="ignore"):  # the log of 0 is -inf
        logs: F64 = np.cumsum(np.log(ratio), axis=1)
    most = logs.max(axis=0, initial=-np.inf)
    return np.exp(logs - np.where(np.isfinite(most), most, 0.0))


def per_decision(logged: OpeEpisodes, counts: F64) -> F64:
    """Return per-decision weighted importance sampling estimates (B,), for resamples (B, n)."""
    weight = relative_weights(logged.ratio)
    means = counts @ (weight * logged.reward) / np.maximum(counts @ weight, _TINY)  # (B, T)
    return np.asarray(means @ logged.discounts, np.float64)


def fitted(logged: OpeEpisodes, counts: F64) -> F64:
    """Return the model's mean value of first observations, (B,), for resamples `counts` (B, n)."""
    return np.asarray(counts @ logged.start_value / counts.sum(axis=1), np.float64)


def observed(logged: OpeEpisodes, counts: F64) -> F64:
    """Return the behaviour policies' own mean return, (B,), for resamples `counts` (B, n)."""
    return np.asarray(counts @ (logged.reward @ logged.discounts) / counts.sum(axis=1), np.float64)


def effective_episodes(ratio: F64) -> F64:
    """Return the effective number of episodes at each step, (T,) (Kish 1965)."""
    weight = relative_weights(ratio)
    return np.asarray(
        weight.sum(axis=0) ** 2 / np.maximum((weight**2).sum(axis=0), _TINY), np.float64
    )


@dataclass(frozen=True)
class EssGate:
    """The effective sample size that weighted estimates need at every step."""

    share: float = 0.2  # least effective episodes, as a share of all
    episodes: float = 5.0

    def refusal(self, logged: OpeEpisodes) -> str | None:
        """Explain why weighted estimators are refused; None if they are not."""
        least, reach = self.measure(logged)
        if reach == logged.ratio.shape[1] and len(logged):
            return None
        if len(logged) < self.episodes:  # too few even if policy and logs fully agree
            noun = "episode" if len(logged) == 1 else "episodes"
            return f"{len(logged)} {noun}, and weights need at least {self.episodes:g}"
        return (
            f"the importance weights leave an effective sample of {least:.1f} of {len(logged)}"
            f" episodes, less than {max(self.episodes, self.share * len(logged)):.1f}: policy and"
            f" logs agree for {reach} of {logged.ratio.shape[1]} steps"
        )

    def measure(self, logged: OpeEpisodes) -> tuple[float, int]:
        """Return the lowest effective number of episodes, and the steps until it is too low."""
        if not len(logged):
            return 0.0, 0
        effective = effective_episodes(logged.ratio)
        short = np.flatnonzero(effective < max(self.episodes, self.share * len(logged)))
        reach = int(short[0]) if len(short) else len(effective)
        return float(effective.min(initial=np.inf)), reach


@dataclass(frozen=True)
class OpeEstimate:
    """One estimator's value with its interval, or the reason why it is refused."""

    estimator: str
    value: float | None  # None if refused
    low: float | None = None  # None with a single episode, and for FQE
    high: float | None = None
    refused: str | None = None  # the reason


def estimate(
    logged: OpeEpisodes,
    *,
    gate: EssGate = EssGate(),
    rng: np.random.Generator,
    resamples: int = 2000,
) -> list[OpeEstimate]:
    """Return every estimate, with a percentile bootstrap interval over whole episodes.

    The interval covers the choice of episodes. FQE has no interval: its value is that of a model,
    and an interval over episodes would ignore the model's errors.
    """
    refused = gate.refusal(logged)
    counts = cluster_counts(len(logged), resamples, rng)
    answers = []
    for name, estimator in ((LOGGED, observed), (FQE, fitted), (PDWIS, per_decision)):
        if name == PDWIS and refused is not None:
            answers.append(OpeEstimate(name, None, refused=refused))
            continue
        value = float(estimator(logged, once(len(logged)))[0])
        if name == FQE or len(logged) < 2:
            answers.append(OpeEstimate(name, value))
            continue
        interval = percentiles(estimator(logged, counts))
        answers.append(OpeEstimate(name, value, *interval))
    return answers


ALL = "all"
FILE = "off_policy.parquet"  # in RUN/eval


@dataclass(frozen=True)
class OpeConfig:
    """Settings of off-policy evaluation."""

    epsilon: float = 0.1  # probability of a random action, which makes the greedy policy soft
    seed: int = 0
    model: FittedQConfig = field(default_factory=FittedQConfig)


@dataclass(frozen=True)
class OpePlan:
    """A checked request for an off-policy evaluation of a run; nothing is fitted yet."""

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
    def notes(self) -> tuple[str, ...]:
        return notes_of(self.task, self.dataset, self.config)

    @property
    def updates(self) -> int:
        """Return the total number of updates of the models to fit."""
        model = self.config.model
        cloned = bool(self.dataset.evaluation.unlogged.any())
        return model.cloning_updates * cloned + (
            model.iterations * model.updates * len(self.measures)
        )

    def document(self) -> dict[str, Any]:
        """Return the plan as JSON values."""
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
            "notes": list(self.notes),
        }


def plan_off_policy(path: Path, logs: str | None, config: OpeConfig) -> OpePlan:
    """Read and check the run and the logs of an evaluation.

    Args:
        path: the run.
        logs: a store, or a panel whose held-out episodes are used; None: the run's own panel.

    Raises:
        RunError: there is no such run, it has no policy yet, or it learned from all episodes.
        StoreError, PanelError: the logs are missing or damaged.
    """
    run = Run.open(path)
    trained = parse_config(run.document["config"], where=str(path / "config.json"))
    agent = load_agent(run)
    task = profile_of_run(run).task
    dataset = load_ope_dataset(run_panel(run.document), task, logs, seed=config.seed)
    return OpePlan(path, agent, trained, task, dataset, config)


def evaluate_planned(
    plan: OpePlan, progress: Callable[[int], None] | None = None
) -> list[dict[str, Any]]:
    """Evaluate the policy of a run, write `RUN/eval/off_policy.parquet`, and return its rows.

    `progress` is called with 1 before every update of the models.
    """
    with torch_threads(plan.trained.threads):
        rows = evaluate_off_policy(
            plan.policy.network,
            plan.dataset,
            discount=plan.trained.loss.discount,
            measures=plan.measures,
            config=plan.config,
            between=(lambda: None) if progress is None else (lambda: progress(1)),
        )
    names = ("env_steps", "gradient_steps")
    clocks = {name: getattr(plan.policy.origin, name, None) for name in names}
    table = pa.Table.from_pylist([{**clocks, **row} for row in rows], TABLES["off_policy"])
    write_table(table, plan.path / "eval" / FILE)
    return rows


def notes_of(task: Task, dataset: OpeDataset, config: OpeConfig) -> tuple[str, ...]:
    """Return notes on the logs, and on the model fitted to them."""
    return dataset.notes + _warn_of_long_episodes(task, dataset.evaluation, config.model.iterations)


def _warn_of_long_episodes(task: Task, steps: OpeSteps, reach: int) -> tuple[str, ...]:
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
    """Return the measures to estimate: no success if goals are missing or were set in hindsight."""
    logged = task.goal == "route" and not dataset.hindsight
    return ("return", "success") if logged else ("return",)


def evaluate_off_policy(
    network: PolicyNetwork,
    dataset: OpeDataset,
    *,
    discount: float,
    measures: tuple[Measure, ...] = ("return", "success"),
    config: OpeConfig = OpeConfig(),
    between: Callable[[], None] = lambda: None,
) -> list[dict[str, Any]]:
    """Return the rows of the table `off_policy`: one per measure, episode condition and estimator.

    `between` is called before every update of the models; if it raises, the evaluation ends.
    """
    results: list[dict[str, Any]] = []
    gate = EssGate()
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
            ess, ess_steps = gate.measure(part)
            shared = {
                "measure": measure,
                "condition": condition,
                "episodes": len(part),
                "ess": ess,
                "ess_steps": ess_steps,
                "steps": part.ratio.shape[1],
                "horizon": None,  # None: all steps are weighted
                "epsilon": config.epsilon,
                "discount": gamma,
                "estimated_share": estimated,
            }
            rng = np.random.default_rng([config.seed, 12])
            results += [shared | asdict(one) for one in estimate(part, gate=gate, rng=rng)]
    return results


def padded_episodes(
    network: PolicyNetwork,
    q: QNetwork,
    steps: OpeSteps,
    probability: F64,
    discount: float,
    epsilon: float,
) -> OpeEpisodes:
    """Arrange N rows as padded episodes (n, T), with the policy's ratios and the model's values."""
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

    Probabilities that were not logged are estimated by cloning the behaviour of the training rows.
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
