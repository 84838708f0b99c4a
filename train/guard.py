"""The guard: fine-tuning that unlearns a condition is stopped, or taken back to the best policy.

A mean over conditions hides the one that is being forgotten, and a rare one is forgotten silently.
So every evaluation is compared with the kept one condition by condition.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from restock.train.dqn import checkpoint
from restock.train.dqn.config import GuardConfig
from restock.train.dqn.learner import Learner
from restock.train.evaluation.evaluate import Score
from restock.train.run.run import Run


@dataclass(frozen=True)
class Fall:
    """A condition whose success fell by the margin or more: a row of the run's `guard`."""

    condition: str
    best: float  # success of the kept policy
    now: float


def falls(now: Score, best: Score | None, config: GuardConfig) -> list[Fall]:
    """The conditions in which `now` is worse than the kept policy by the margin or more."""
    if best is None or config.margin is None:
        return []
    asked = config.conditions or tuple(best.success)
    return [
        Fall(name, best.success[name], now.success[name])
        for name in asked
        if name in best.success and best.success[name] - now.success[name] >= config.margin - 1e-9
    ]


def roll_back(learner: Learner, run: Run) -> None:
    """Put the kept policy into all networks and forget the optimizer's moments.

    The ring, the twin and every generator go on: experience of the worse policy is experience.
    """
    weights: dict[str, Any] = checkpoint.load(run.best)["network"]
    for network in (learner.network, learner.target_network, learner.policy_network):
        network.load_state_dict(weights)
    learner.optimizer.state.clear()


__all__ = ["Fall", "falls", "roll_back"]
