"""The twin of a run, and what it is to drive: its orders and arms, checked."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F32
from restock.ingest.profile.profile import Profile
from restock.ingest.task.signals import Signals
from restock.ingest.task.task import Task
from restock.replay.fleet.missions_file import MissionOrder, read_missions
from restock.train.dqn.config import PracticeConfig, TrainConfig
from restock.train.feed.practice import Practice
from restock.train.twin.env.episode_queue import MissionArms, MissionOrders
from restock.train.twin.env.interface import Info, Step, Twin
from restock.train.twin.floors.floors import open_floors
from restock.train.twin.floors.planner import planners
from restock.train.twin.physics.perturbation import Schedule, find_perturbation

MISSIONS = "env.missions"


def mission_orders(config: TrainConfig) -> tuple[MissionOrder, ...]:
    """Read the missions that a share of the episodes follows; none if the config names none.

    Raises:
        ConfigError: their file cannot be read, or says something else.
    """
    missions = config.env.missions
    return read_missions(missions).missions if isinstance(missions, str) else missions or ()


def mission_arms(config: TrainConfig) -> MissionArms:
    """Make the arms of a run's missions.

    Raises:
        ConfigError: an order that the floors cannot hold, or `practice.by` that says nothing.
    """
    floors, ordered = open_floors(config.env.layouts), mission_orders(config)
    routes = planners(floors)
    perturbation = find_perturbation(config.env.perturbation, where="env.perturbation")
    return MissionArms(
        floors,
        routes,
        config.env.conditions,
        by=config.practice.by,
        schedule=perturbation if isinstance(perturbation, Schedule) else None,
        orders=MissionOrders(ordered, floors, routes, where=MISSIONS) if ordered else None,
        orders_share=config.env.missions_share,
    )


def check_missions(config: TrainConfig, profile: Profile) -> None:
    """Refuse missions that the twin cannot drive, before anything is written.

    Raises:
        ConfigError: an order, arm or floor of practice that the floors cannot hold.
    """
    if not mission_orders(config) and config.practice == PracticeConfig():
        return
    Practice(config.practice, mission_arms(config).arms, goal=profile.task.goal != "none")


def make_twin(
    config: TrainConfig,
    profile: Profile,
    num_envs: int,
    nthread: int = 1,
    layouts: str | None = None,
) -> Twin:
    """Make the warehouse as training uses it, on other floors if `layouts` names them."""
    if not config.env.twin:
        return NoTwin(profile.task)
    from restock.train.twin.env.vector_env import WarehouseVectorEnv

    twin: Twin = WarehouseVectorEnv(
        num_envs,
        perturbation=find_perturbation(config.env.perturbation, where="env.perturbation"),
        conditions=config.env.conditions,
        seed=config.seed,
        nthread=nthread,
        task=profile.task,
        robot=profile.robot,
        layouts=layouts or config.env.layouts,
        # Evaluation has its own floors and fixed episodes.
        missions=() if layouts is not None else mission_orders(config),
        missions_share=config.env.missions_share,
        nav_command=profile.inputs.nav_command is not None,
    )
    return twin


class NoTwin:
    """A placeholder for the twin of a run on the logs alone; it cannot be driven in."""

    num_envs = 1

    def __init__(self, task: Task) -> None:
        self._observation: F32 = np.zeros((1, task.observation_size), np.float32)

    @property
    def signals(self) -> Signals:
        return {}

    def set_episodes(self, specs: Iterable[Any], /) -> None:
        raise RuntimeError("a run on the logs alone does not drive")

    def reset(self, *, seed: int | None = None) -> tuple[F32, Info]:
        return self._observation, {}

    def step(self, actions: NDArray[Any], /) -> Step:
        raise RuntimeError("a run on the logs alone does not drive")

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any], /) -> None:
        pass


__all__ = ["NoTwin", "check_missions", "make_twin", "mission_orders"]
