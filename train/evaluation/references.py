"""The scripted drivers that a policy is measured against: the planner, the operator, a random one.

The planner is what a robot without learning would do; the operator sees pallets, people and wet
floor as they are, so it is what somebody who knew everything would reach; neither explores here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from restock.errors import ConfigError
from restock.ingest.task.robot import Robot
from restock.ingest.task.task import Task
from restock.train.evaluation.evaluate import EpisodeResult, fixed_episodes, run_episodes
from restock.train.twin.env.interface import Policy
from restock.train.twin.floors.layout import DEFAULT
from restock.train.twin.physics.episode import KINDS

REFERENCES = ("planner", "operator", "random")
FIRST_SEED = 10_000


def reference(name: str, seed: int = 0) -> Policy:
    """A reference by its name.

    Raises:
        ConfigError: there is none of the name.
    """
    from restock.train.twin.env.operator_policy import Operator
    from restock.train.twin.env.policies import PlannerFollower, RandomPolicy

    if name == "planner":
        return PlannerFollower(epsilon=0.0, seed=seed)
    if name == "operator":
        return Operator(epsilon=0.0, seed=seed)
    if name == "random":
        return RandomPolicy(seed=seed)
    raise ConfigError(
        f"there is no {name!r}", where="drivers", remedy=f"choose from {', '.join(REFERENCES)}"
    )


def drive_references(
    task: Task,
    names: Sequence[str] = ("planner", "operator"),
    *,
    robot: Robot | None = None,
    kinds: Sequence[str] = KINDS,
    episodes: int = 20,
    first_seed: int = FIRST_SEED,
    layouts: str = DEFAULT,
    discount: float | None = None,
    nthread: int = 1,
    progress: Callable[[int], None] | None = None,
) -> dict[str, list[EpisodeResult]]:
    """How each reference ends the same episodes, `episodes` of every kind: those of `restock eval`.

    Args:
        robot: whose task it is; None: the twin's own.
        discount: of one step, for `discounted_return`.

    Raises:
        ConfigError: no such driver or kind, or a floor without room for a kind.
    """
    from restock.train.twin.env.vector_env import WarehouseVectorEnv

    drivers = {name: reference(name, first_seed) for name in names}
    specs = fixed_episodes(list(kinds), episodes, first_seed)
    env = WarehouseVectorEnv(
        min(32, len(specs)),
        nthread=nthread,
        task=task,
        robot=robot,
        seed=first_seed,
        layouts=layouts,
        conditions=dict.fromkeys(kinds, 1.0),
    )
    return {
        name: run_episodes(
            env,
            driver,
            specs,
            control_period_s=task.control_period_s,
            time_limit_steps=task.time_limit_steps,
            goal=task.goal != "none",
            discount=discount,
            progress=progress,
        )
        for name, driver in drivers.items()
    }


__all__ = ["FIRST_SEED", "REFERENCES", "drive_references", "reference"]
