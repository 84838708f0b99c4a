"""The guard: fine-tuning that unlearns a condition is stopped, or taken back to the best policy.

A mean over conditions hides the one that is being forgotten, and a rare one is forgotten silently.
So every evaluation is compared with the kept one condition by condition.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from restock.train.dqn.config import GuardConfig
from restock.train.dqn.learner import Learner
from restock.train.evaluation.evaluate import Score
from restock.train.run import checkpoint
from restock.train.run.run import Run
from restock.train.session import Session


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
    watched = config.conditions or tuple(best.success)
    return [
        Fall(name, best.success[name], now.success[name])
        for name in watched
        if name in best.success and best.success[name] - now.success[name] >= config.margin - 1e-9
    ]


def enforce(session: Session, fallen: Sequence[Fall]) -> str:
    """A condition was unlearnt: go back to the kept policy, or stop. Returns the action taken."""
    config, progress = session.config.guard, session.progress
    goes_back = config.action == "rollback" and progress.rollbacks < config.rollbacks
    action = "rollback" if goes_back else "stop"
    rows = [{**session.steps, **asdict(fall), "action": action} for fall in fallen]
    session.run.append("guard", rows)
    if goes_back:
        _roll_back(session.learner, session.run)
        progress.rollbacks += 1
    else:
        progress.stopped = True
    session.run.flush(everything=False)
    return action


def _roll_back(learner: Learner, run: Run) -> None:
    """Put the kept policy into all networks and forget the optimizer's moments.

    The ring, the twin and every generator go on: experience of the worse policy is experience.
    """
    weights: dict[str, Any] = checkpoint.load(run.best)["network"]
    learner.take_over(weights)


__all__ = ["Fall", "enforce", "falls"]
