"""The warehouse in MuJoCo: drive it, record it, fit it to logs, measure how far it is."""

from __future__ import annotations

from typing import TYPE_CHECKING

from restock.public import lazy

if TYPE_CHECKING:
    from restock.train.twin.env.drivers import PlannerFollower as PlannerFollower
    from restock.train.twin.env.vector_env import WarehouseEnv as WarehouseEnv
    from restock.train.twin.env.vector_env import WarehouseVectorEnv as WarehouseVectorEnv
    from restock.train.twin.physics.episode import EpisodeSpec as EpisodeSpec
    from restock.train.twin.physics.episode import draw_episode as draw_episode
    from restock.train.twin.physics.perturbation import Perturbation as Perturbation
    from restock.train.twin.physics.perturbation import Schedule as Schedule
    from restock.train.twin.physics.perturbation import load_perturbation as load_perturbation
    from restock.train.twin.recording.recorder import RecordingPlan as RecordingPlan
    from restock.train.twin.recording.recorder import record as record
else:
    __getattr__, __dir__, __all__ = lazy(__name__)
