"""Judging a policy on held-out logs before it drives: from networks and rows to a table.

What is judged is the greedy policy made soft: with chance `epsilon` it acts at random. A
deterministic one agrees with no long episode to its end, and weights would be of nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from restock.train.dqn.fitted_q import Fit, chances, cloned_behaviour, fitted_q, soft_greedy, values
from restock.train.dqn.network import Network, QNetwork
from restock.train.evaluation.ope_dataset import Evidence, Measure, Steps
from restock.train.evaluation.ope_estimators import Gate, Logged, estimate

F64 = NDArray[np.float64]
EVERY = "all"


class Judging(msgspec.Struct, frozen=True):
    """How a policy is judged."""

    epsilon: float = 0.1  # of the greedy policy made soft
    horizon: int | None = None  # steps that are weighted; None: all
    ess_share: float = 0.2  # of the episodes, that weights must be worth
    ess_episodes: float = 5.0  # … and at least so many
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.epsilon <= 1:
            raise ValueError(f"epsilon must be in [0, 1], got {self.epsilon:g}")
        if self.horizon is not None and self.horizon < 1:
            raise ValueError(f"horizon must be at least 1, got {self.horizon}")
        if not 0 <= self.ess_share <= 1:
            raise ValueError(f"ess_share must be in [0, 1], got {self.ess_share:g}")


@dataclass(frozen=True)
class _Behaviour:
    """The chance of each logged action, and how many had to be estimated."""

    probability: F64  # (N,)
    estimated: int


def judge(
    network: Network,
    evidence: Evidence,
    *,
    discount: float,
    measures: tuple[Measure, ...] = ("return", "success"),
    how: Judging = Judging(),  # noqa: B008  (frozen)
    fit: Fit = Fit(),  # noqa: B008  (frozen)
    progress: Callable[[int], None] | None = None,
) -> list[dict[str, Any]]:
    """Rows of `off_policy`: measure x condition of the episode x estimator."""
    found: list[dict[str, Any]] = []
    gate = Gate(how.ess_share, how.ess_episodes)
    behaviour = _behaviour(evidence, network.actions, fit, how.seed)
    for measure in measures:
        model, held = evidence.model.measured(measure), evidence.held.measured(measure)
        gamma = discount if measure == "return" else 1.0
        q = fitted_q(
            model.rows,
            soft_greedy(network, model.rows.next_observation, how.epsilon),
            discount=gamma,
            bounds=None if measure == "return" else (0.0, 1.0),
            fit=fit,
            seed=how.seed,
        )
        kept = ~evidence.held.bumped_before if measure == "success" else slice(None)
        logged = logged_episodes(network, q, held, behaviour.probability[kept], gamma, how.epsilon)
        for condition in (EVERY, *sorted(set(held.condition.tolist()))):
            part = logged if condition == EVERY else logged.of(held.condition == condition)
            least, reach = gate.measure(part.until(how.horizon))
            for answer in estimate(
                part, gate=gate, horizon=how.horizon, rng=np.random.default_rng([how.seed, 12])
            ):
                found.append(
                    {
                        "measure": measure,
                        "condition": condition,
                        "estimator": answer.estimator,
                        "value": answer.value,
                        "low": answer.low,
                        "high": answer.high,
                        "refused": answer.refused,
                        "episodes": len(part),
                        "ess": least,
                        "ess_steps": reach,
                        "steps": part.ratio.shape[1],
                        "horizon": how.horizon,
                        "epsilon": how.epsilon,
                        "discount": gamma,
                        "estimated_share": behaviour.estimated / max(len(evidence.held.rows), 1),
                    }
                )
        if progress is not None:
            progress(1)
    return found


def logged_episodes(
    network: Network,
    q: QNetwork,
    held: Steps,
    probability: F64,
    discount: float,
    epsilon: float,
) -> Logged:
    """Rows by episode (N,) to padded episodes, as policy and model see them."""
    rows = held.rows
    here, there = (
        soft_greedy(network, observation, epsilon)
        for observation in (rows.observation, rows.next_observation)
    )
    q_here, q_there = values(q, rows.observation), values(q, rows.next_observation)
    at = np.arange(len(rows))
    first = np.flatnonzero(np.diff(held.episode, prepend=-1))
    lengths = np.diff(np.append(first, len(rows)))
    step = at - np.repeat(first, lengths)
    shape = len(first), int(lengths.max())

    def padded(column: NDArray[Any], outside: float = 0.0) -> F64:
        matrix = np.full(shape, outside)
        matrix[held.episode, step] = column
        return matrix

    value = np.where(rows.terminated, 0.0, (there * q_there).sum(axis=1))
    return Logged(
        padded(here[at, rows.action] / probability, 1.0),
        padded(rows.reward),
        padded(q_here[at, rows.action]),
        padded(value),
        (here * q_here).sum(axis=1)[first],
        discount,
    )


def _behaviour(evidence: Evidence, actions: int, fit: Fit, seed: int) -> _Behaviour:
    """As logged; where the logs do not say, by cloning the behaviour of the model's rows."""
    held = evidence.held
    unknown = ~(held.probability > 0)
    probability = held.probability.copy()
    if unknown.any():
        rows = evidence.model.rows
        clone = cloned_behaviour(rows.observation, rows.action, actions, fit=fit, seed=seed)
        chance = chances(clone, held.rows.observation[unknown])
        probability[unknown] = chance[np.arange(len(chance)), held.rows.action[unknown]]
    return _Behaviour(probability, int(unknown.sum()))


__all__ = ["Judging", "judge", "logged_episodes"]
