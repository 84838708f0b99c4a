"""Which policy drives first: candidates made of what was learnt offline, on held-out logs.

What was learnt offline may drive worse than whoever drove in the logs. The candidates are the
policy as it is, filtered more or less, the teacher's clone alone, and each led by what the
navigation stack proposes. Of those that the logs' weights reach to the end of episodes (the gate
in `off_policy/estimators.py`) the one with the largest lower bound drives until online updates
begin: high confidence policy improvement (Thomas, Theocharous and Ghavamzadeh 2015), by the
weighted doubly robust estimator. Where the weights reach no candidate's end nothing is known of any
of them, and the one that is nearest to whoever drove in the logs begins: what navigation proposes.

Episodes that met a condition count half, however few they are: logs are mostly of the easy ones.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from restock.ingest.task.conditions import NOMINAL
from restock.ingest.task.task import Task
from restock.stats import cluster_counts, percentiles
from restock.train.dqn.behaviour import FilteredNetwork, PolicyNetwork
from restock.train.dqn.config import OfflineStartConfig, TrainConfig
from restock.train.dqn.fitted_q import fitted_q, soft_greedy
from restock.train.dqn.learner import Learner
from restock.train.dqn.network import clone
from restock.train.dqn.start_policy import StartPolicy, start_network
from restock.train.evaluation.off_policy.dataset import OpeDataset
from restock.train.evaluation.off_policy.estimators import (
    EssGate,
    OpeEpisodes,
    doubly_robust,
    fitted,
    once,
)
from restock.train.evaluation.ope import (
    ALL,
    OpeConfig,
    behaviour_probability,
    measures_of,
    padded_episodes,
)

_RESAMPLES = 2_000
# Of the greedy policies made soft: as little as scripted drivers explore by. The more, the more a
# step weighs at which a driver acted at random.
_EPSILON = 0.02
RARE = "rare"  # an episode that met any condition
LEARNT = "as learnt"


@dataclass(frozen=True)
class Candidate:
    """A policy that might drive first; `start` None: what was learnt, as it is."""

    name: str
    start: StartPolicy | None
    network: PolicyNetwork


def choose_start(
    learner: Learner,
    task: Task,
    dataset: OpeDataset,
    config: TrainConfig,
    between: Callable[[], None] = lambda: None,
) -> tuple[StartPolicy | None, list[dict[str, Any]]]:
    """What drives first (None: what was learnt, as it is), and what every candidate is worth.

    That is rows of the run's table `offline_start`: a candidate x all, nominal and rare episodes.
    `between` is called before every update of its models; what it raises ends the choice, and
    leaves the learner as it was.

    Raises:
        RunError: no episode is held out.
    """
    known = dataset.evaluation.rows.observation[:, -3].mean() > 0.5
    policy = clone(learner.policy).to("cpu")
    some = candidates(policy, task, config.offline_start, proposed=bool(known))
    ope = OpeConfig(epsilon=_EPSILON, seed=config.seed)
    measure = measures_of(task, dataset)[-1]
    gamma = config.loss.discount if measure == "return" else 1.0
    training = dataset.training.measured(measure)
    evaluation = dataset.evaluation.measured(measure)
    probability, estimated = behaviour_probability(dataset, policy.actions, ope, between)
    if measure == "success":
        probability = probability[~dataset.evaluation.bumped_before]
    gate = EssGate(ope.ess_share, ope.ess_episodes)
    rows: list[dict[str, Any]] = []
    for candidate in some:
        q = fitted_q(
            training.rows,
            soft_greedy(candidate.network, training.rows.next_observation, ope.epsilon),
            discount=gamma,
            bounds=None if measure == "return" else (0.0, 1.0),
            config=ope.model,
            seed=ope.seed,
            between=between,
        )
        episodes = padded_episodes(
            candidate.network, q, evaluation, probability, gamma, ope.epsilon
        )
        nominal = evaluation.condition == NOMINAL
        parts = {NOMINAL: episodes.select(nominal), RARE: episodes.select(~nominal)}
        shared = {"candidate": candidate.name, "measure": measure, "estimated_share": estimated}
        rows += [shared | answer for answer in estimates(parts, gate, seed=ope.seed)]
    name = chosen_of(rows)
    (best,) = (candidate for candidate in some if candidate.name == name)
    return best.start, [{**row, "chosen": row["candidate"] == name} for row in rows]


def chosen_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """The candidate that drives first, by its rows over all conditions; the first of several."""
    of_all = [row for row in rows if row["condition"] == ALL]
    known = [row for row in of_all if row["refused"] is None]
    if known:
        return str(max(known, key=lambda row: row["low"])["candidate"])
    names = [str(row["candidate"]) for row in of_all]
    followed = StartPolicy(proposed=True).name
    return followed if followed in names else names[0]


def candidates(
    policy: PolicyNetwork, task: Task, config: OfflineStartConfig, *, proposed: bool
) -> list[Candidate]:
    """What may drive first; what was learnt comes first, and wins where others are no better.

    Filters need a behaviour network in `policy`, proposals (`proposed`) ones that are known.
    """
    starts = []
    if isinstance(policy, FilteredNetwork):
        starts = [StartPolicy(ratio) for ratio in config.ratios]
        starts += [StartPolicy(ratio, proposed=True) for ratio in config.ratios if ratio < 1]
    starts += [StartPolicy(), StartPolicy(proposed=True)]
    # Kept in single precision.
    in_force = round(float(policy.ratio), 6) if isinstance(policy, FilteredNetwork) else None
    others = [
        start
        for start in starts
        if (proposed or not start.proposed) and start != StartPolicy(in_force)
    ]
    return [
        Candidate(LEARNT, None, policy),
        *(
            Candidate(start.name, start, start_network(start, policy, task.scaled_actions))
            for start in others
        ),
    ]


def estimates(
    parts: Mapping[str, OpeEpisodes], gate: EssGate, *, seed: int
) -> list[dict[str, Any]]:
    """The mean over the parts, then each of them that has episodes, with a 95 % interval."""
    rng = np.random.default_rng([seed, 13])
    rows: list[dict[str, Any]] = []
    drawn = []
    for name, part in parts.items():
        if not len(part):
            continue
        ess, reach = gate.measure(part)
        near = part.until(reach)
        drawn.append(doubly_robust(near, cluster_counts(len(part), _RESAMPLES, rng)))
        low, high = percentiles(drawn[-1], 0.95)
        rows.append(
            {
                "condition": name,
                "value": float(doubly_robust(near, once(len(part)))[0]),
                "low": low,
                "high": high,
                "refused": gate.refusal(part),
                "model": float(fitted(part, once(len(part)))[0]),
                "episodes": len(part),
                "ess": ess,
                "reach": reach,
            }
        )
    low, high = percentiles(np.mean(drawn, axis=0), 0.95)
    mean = {
        "condition": ALL,
        "value": float(np.mean([row["value"] for row in rows])),
        "low": low,
        "high": high,
        "refused": next((row["refused"] for row in rows if row["refused"]), None),
        "model": float(np.mean([row["model"] for row in rows])),
        "episodes": sum(row["episodes"] for row in rows),
        "ess": min(row["ess"] for row in rows),
        "reach": min(row["reach"] for row in rows),
    }
    return [mean, *rows]


__all__ = ["Candidate", "candidates", "choose_start", "chosen_of", "estimates"]
