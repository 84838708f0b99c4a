"""What a run is to drive: its orders and arms, checked, and how a reference driver does on them."""

from __future__ import annotations

from restock.errors import ConfigError
from restock.ingest.profile.profile import Profile
from restock.replay.fleet.missions_file import MissionOrder, read_missions
from restock.replay.panel.panel import Panel
from restock.train.dqn.config import PracticeConfig, TrainConfig
from restock.train.evaluation.logged_ways import EVERY, logged_missions
from restock.train.feed.practice import Practice
from restock.train.twin.env.episode_queue import MissionArms, MissionOrders
from restock.train.twin.floors.floors import open_floors
from restock.train.twin.floors.planner import planners
from restock.train.twin.physics.episode import EpisodeSpec
from restock.train.twin.physics.perturbation import Schedule, find_perturbation

MISSIONS = "env.missions"


def mission_orders(config: TrainConfig) -> tuple[MissionOrder, ...]:
    """The missions that a share of the episodes follows; none where the config names none.

    Raises:
        ConfigError: their file cannot be read, or says something else.
    """
    missions = config.env.missions
    return read_missions(missions).missions if isinstance(missions, str) else missions or ()


def ways_to_evaluate(
    config: TrainConfig, layouts: str, panel: Panel | None
) -> list[EpisodeSpec] | None:
    """The ways of its logs that a run's evaluations drive on these floors; None: drawn missions.

    Raises:
        ConfigError: ways are asked for, and there are no logs, no goal, or none of them can be
            driven.
    """
    chosen, kinds = config.evaluation, list(config.env.conditions)
    if chosen.missions == "drawn" or not config.env.twin:
        return None
    floors = open_floors(layouts)
    why = None
    if panel is None:
        why = "the run does not learn from logs"
    elif panel.task.goal == "none":
        why = "the task has no goal"
    if panel is None or why is not None:
        raise ConfigError(
            str(why), where="evaluation.missions", remedy='leave it out, or set "drawn"'
        )
    every = chosen.missions == EVERY
    specs = logged_missions(panel, floors, kinds, every=every).specs
    fitting = [kind for kind in kinds if kind in specs]
    most = min(max(len(specs[kind]) for kind in fitting), chosen.episodes)
    return [specs[kind][at] for at in range(most) for kind in fitting if at < len(specs[kind])]


def mission_arms(config: TrainConfig) -> MissionArms:
    """The arms that a run's missions are of.

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
    """What the twin is to drive is refused now, before anything is written, if it cannot be.

    Raises:
        ConfigError: an order, arm or floor of practice that the floors cannot hold.
    """
    if not mission_orders(config) and config.practice == PracticeConfig():
        return
    Practice(config.practice, mission_arms(config).arms, goal=profile.task.goal != "none")


__all__ = ["check_missions", "mission_arms", "mission_orders"]
