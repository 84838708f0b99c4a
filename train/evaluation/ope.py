"""Off-policy evaluation: estimate from logs of others what a policy is worth, before it drives.

What is evaluated is the greedy policy made soft: with probability `epsilon` it acts at random. A
deterministic one agrees with no long episode to its end, and its weights would all be zero.

Two estimators, over n logged episodes padded to T steps:

- fitted Q evaluation (`restock.train.dqn.fitted_q`; Le et al. 2019, arXiv:1903.08738): the mean of
  the fitted model's V(s_0). No importance weights, and as wrong as the model is;
- per-decision weighted importance sampling (Precup, Sutton and Singh 2000): each reward counts by
  how much likelier the evaluated policy was to get that far. No model; consistent.

The weights of two policies that differ grow apart with every step, until one episode outweighs all
others. If the effective sample size is below a stated share of the episodes, the weighted estimate
is refused: a number from one episode is not printed as if it were from a hundred.
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
    """Logged episodes for the evaluated policy, padded with `ratio` 1 and `reward` 0."""

    ratio: F64  # (n, T) probability of the action, evaluated policy / behaviour policy
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
    """Return counts that take every episode once, (1, n)."""
    return np.ones((1, episodes))


def relative_weights(ratio: F64) -> F64:
    """Return products of ratios up to each step (n, T), scaled so that each step's largest is 1."""
    with np.errstate(divide="ignore"):  # -inf for 0
        logs: F64 = np.cumsum(np.log(ratio), axis=1)
    most = logs.max(axis=0, initial=-np.inf)
    return np.exp(logs - np.where(np.isfinite(most), most, 0.0))


def per_decision(logged: OpeEpisodes, counts: F64) -> F64:
    """Estimate by per-decision weighted importance sampling; `counts` (B, n) -> (B,)."""
    weight = relative_weights(logged.ratio)
    means = counts @ (weight * logged.reward) / np.maximum(counts @ weight, _TINY)  # (B, T)
    return np.asarray(means @ logged.discounts, np.float64)


def fitted(logged: OpeEpisodes, counts: F64) -> F64:
    """Return the model's mean value of the starts; `counts` (B, n) -> (B,)."""
    return np.asarray(counts @ logged.start_value / counts.sum(axis=1), np.float64)


def observed(logged: OpeEpisodes, counts: F64) -> F64:
    """Return what the behaviour policies achieved themselves; `counts` (B, n) -> (B,)."""
    return np.asarray(counts @ (logged.reward @ logged.discounts) / counts.sum(axis=1), np.float64)


def effective_episodes(ratio: F64) -> F64:
    """Return the effective number of episodes at each step, (T,) (Kish 1965)."""
    weight = relative_weights(ratio)
    return np.asarray(
        weight.sum(axis=0) ** 2 / np.maximum((weight**2).sum(axis=0), _TINY), np.float64
    )


@dataclass(frozen=True)
class EssGate:
    """The effective sample size that weighted estimates need at every step to be shown."""

    share: float = 0.2  # of the episodes
    episodes: float = 5.0

    def refusal(self, logged: OpeEpisodes) -> str | None:
        """Return why weighted estimators are refused, or None."""
        least, reach = self.measure(logged)
        if reach == logged.ratio.shape[1] and len(logged):
            return None
        if len(logged) < self.episodes:  # refused even if policy and logs agree to the end
            noun = "episode" if len(logged) == 1 else "episodes"
            return f"{len(logged)} {noun}, and weights need at least {self.episodes:g}"
        return (
            f"the importance weights leave an effective sample of {least:.1f} of {len(logged)}"
            f" episodes, less than {max(self.episodes, self.share * len(logged)):.1f}: policy and"
            f" logs agree for {reach} of {logged.ratio.shape[1]} steps"
        )

    def measure(self, logged: OpeEpisodes) -> tuple[float, int]:
        """Return the lowest effective number of episodes, and how many first steps have enough."""
        if not len(logged):
            return 0.0, 0
        effective = effective_episodes(logged.ratio)
        short = np.flatnonzero(effective < max(self.episodes, self.share * len(logged)))
        reach = int(short[0]) if len(short) else len(effective)
        return float(effective.min(initial=np.inf)), reach


@dataclass(frozen=True)
class OpeEstimate:
    """One estimator's answer: a value with its interval, or why there is none."""

    estimator: str
    value: float | None
    low: float | None = None  # None: a single episode has no interval, nor has FQE
    high: float | None = None
    refused: str | None = None


def estimate(
    logged: OpeEpisodes,
    *,
    gate: EssGate = EssGate(),
    rng: np.random.Generator,
    resamples: int = 2000,
) -> list[OpeEstimate]:
    """Return every estimate, with a percentile bootstrap interval over whole episodes.

    The interval covers what other episodes would have changed. FQE has none: it is a model's value
    on the starts, and an interval over them would leave out what is wrong with the model.
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

    epsilon: float = 0.1  # probability of a random action: the greedy policy made soft
    seed: int = 0
    model: FittedQConfig = field(default_factory=FittedQConfig)


@dataclass(frozen=True)
class OpePlan:
    """What the off-policy evaluation of a run needs; nothing is fitted yet."""

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
        """Return the number of updates of all models."""
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
            "notes": list(self.notes),
        }


def plan_off_policy(path: Path, logs: str | None, config: OpeConfig) -> OpePlan:
    """Read and check the run and the logs of an evaluation.

    Args:
        path: the run.
        logs: a store, or a panel whose held-out episodes count; default the run's own panel.

    Raises:
        RunError: no such run, no policy yet, or no episode that it did not learn from.
        StoreError, PanelError: no such logs.
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
    """Evaluate the policy of a run; write `RUN/eval/off_policy.parquet`, and return its rows.

    `progress` is called with 1 before every update of its models.
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
    config: OpeConfig = OpeConfig(),
    between: Callable[[], None] = lambda: None,
) -> list[dict[str, Any]]:
    """Return the rows of `off_policy`: measure x condition of the episode x estimator.

    `between` is called before every update of its models; what it raises ends the evaluation.
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
                "horizon": None,  # all of them are weighted
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
    """Pad rows by episode (N,) to episodes (n, T), as policy and model see them."""
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
