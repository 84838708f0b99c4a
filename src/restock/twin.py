"""The warehouse in MuJoCo: drive it, record it, fit it to logs, measure how far it is."""

from __future__ import annotations

from typing import TYPE_CHECKING

from restock.public import lazy

if TYPE_CHECKING:
    from restock.train.twin.calibration.fit import FitConfig as FitConfig
    from restock.train.twin.calibration.fit import fit as fit
    from restock.train.twin.calibration.fit_solver import position_gap_m as position_gap_m
    from restock.train.twin.calibration.fitted_twin import write_fit as write_fit
    from restock.train.twin.calibration.gap import measure_gap as measure_gap
    from restock.train.twin.calibration.logged_steps import logged_steps as logged_steps
    from restock.train.twin.calibration.open_loop import log_segments as log_segments
    from restock.train.twin.calibration.open_loop import replay_segments as replay_segments
    from restock.train.twin.calibration.twin_gap import GapConfig as GapConfig
    from restock.train.twin.calibration.twin_gap import write_gap as write_gap
    from restock.train.twin.drivers.policies import PlannerFollower as PlannerFollower
    from restock.train.twin.drivers.policies import RandomPolicy as RandomPolicy
    from restock.train.twin.env.vector_env import WarehouseEnv as WarehouseEnv
    from restock.train.twin.env.vector_env import WarehouseVectorEnv as WarehouseVectorEnv
    from restock.train.twin.floors.floors import open_floors as open_floors
    from restock.train.twin.physics.episode import EpisodeSpec as EpisodeSpec
    from restock.train.twin.physics.episode import draw_episode as draw_episode
    from restock.train.twin.physics.perturbation import Perturbation as Perturbation
    from restock.train.twin.physics.perturbation import Schedule as Schedule
    from restock.train.twin.physics.perturbation import load_perturbation as load_perturbation
    from restock.train.twin.recording.recorder import RecordingPlan as RecordingPlan
    from restock.train.twin.recording.recorder import record as record
else:
    __getattr__, __dir__, __all__ = lazy(
        __name__,
        {
            "restock.train.twin.calibration.fit": ["FitConfig", "fit"],
            "restock.train.twin.calibration.fit_solver": ["position_gap_m"],
            "restock.train.twin.calibration.fitted_twin": ["write_fit"],
            "restock.train.twin.calibration.gap": ["measure_gap"],
            "restock.train.twin.calibration.logged_steps": ["logged_steps"],
            "restock.train.twin.calibration.open_loop": ["log_segments", "replay_segments"],
            "restock.train.twin.calibration.twin_gap": ["GapConfig", "write_gap"],
            "restock.train.twin.drivers.policies": ["PlannerFollower", "RandomPolicy"],
            "restock.train.twin.env.vector_env": ["WarehouseEnv", "WarehouseVectorEnv"],
            "restock.train.twin.floors.floors": ["open_floors"],
            "restock.train.twin.physics.episode": ["EpisodeSpec", "draw_episode"],
            "restock.train.twin.physics.perturbation": [
                "Perturbation",
                "Schedule",
                "load_perturbation",
            ],
            "restock.train.twin.recording.recorder": ["RecordingPlan", "record"],
        },
    )
