"""The scripted drivers that a policy is measured against: the planner, the operator, a random one.

The planner drives as a robot without learning would. The operator sees pallets, people and wet
floor as they are, so it is an upper bound for a driver that knows everything. Neither explores.
"""

from __future__ import annotations

from restock.errors import ConfigError
from restock.train.dqn.config import LAST_SEED
from restock.train.twin.env.interface import Policy

REFERENCES = ("planner", "operator", "random")
FIRST_SEED = 10_000


def wrong_seed(seed: int, count: int = 1) -> str | None:
    """Return what is wrong with a seed, or with the first of `count` in a row; None: nothing."""
    if 0 <= seed <= LAST_SEED + 1 - count:
        return None
    last = f" ({count:,} seeds from there on)" if count > 1 else ""
    return f"must be from 0 to {LAST_SEED + 1 - count}{last}, got {seed}"


def reference(name: str, seed: int = 0) -> Policy:
    """Make a reference driver by its name.

    Raises:
        ConfigError: there is none of the name.
    """
    from restock.train.twin.drivers.operator_policy import Operator
    from restock.train.twin.drivers.policies import PlannerFollower, RandomPolicy

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


__all__ = ["FIRST_SEED", "REFERENCES", "reference", "wrong_seed"]
