"""Check the twin of a robot without a lidar."""

import msgspec
import numpy as np
import pytest

from restock.ingest.profile.profile import load_profile
from restock.ingest.task.conditions import signals_named
from restock.ingest.task.task import LIDAR_SIGNALS
from restock.train.feed.collector import conditions_in_twin
from restock.train.twin.env.drivers import PlannerFollower
from restock.train.twin.env.navigation import PathFollower
from restock.train.twin.env.vector_env import WarehouseVectorEnv

PROFILE = load_profile("warehouse_amr")
SEES = PROFILE.task
BLIND = msgspec.structs.replace(SEES, sectors=0)
STEPS = 12


def drive(task):
    """Return observations, rewards, tight clearances and the environment of a fixed drive."""
    env = WarehouseVectorEnv(2, task=task, seed=3, nav_command=False)
    observation, _ = env.reset(seed=3)
    seen, earned, tight, over = [observation], [], [], []
    for step in range(STEPS):
        observation, reward, terminated, truncated, _ = env.step(np.array([2, 1 + step % 3]))
        seen.append(observation)
        earned.append(reward)
        over.append(terminated | truncated)  # the signals are then of the next episode
        tight.append(env.signals["clearance_m"] < task.rewards.tight_clearance_m)
    env.close()
    went_on = ~np.array(over)
    return np.array(seen), np.array(earned)[went_on], np.array(tight)[went_on], env


def test_drive_without_lidar_omits_lidar_entries():
    lidar, paid, tight, _ = drive(SEES)
    blind, earned, never, env = drive(BLIND)
    kept = [i for i, name in enumerate(SEES.observation_names) if not name.endswith("deg")]
    assert blind.shape[-1] == env.single_observation_space.shape[0] == len(kept)
    np.testing.assert_array_equal(blind, lidar[..., kept])
    assert tight.any()
    assert not never.any()
    assert earned - paid == pytest.approx(-SEES.rewards.tight * tight, abs=1e-6)
    for name in LIDAR_SIGNALS - {"sector_clearance_m"}:
        assert np.isnan(env.signals[name]).all(), name
    assert env.signals["sector_clearance_m"].shape == (2, 0)


def test_planner_without_lidar_follows_its_plan():
    env = WarehouseVectorEnv(2, task=BLIND, seed=3)
    observation, _ = env.reset(seed=3)
    planner = PlannerFollower(epsilon=0.0)
    before = env.signals["route_remaining_m"].copy()
    for _ in range(15):
        observation, *_ = env.step(planner.act(env, observation)[0])
    assert (env.signals["route_remaining_m"] < before).all()
    assert np.isinf(PathFollower(BLIND).front(env.signals)).all()
    assert np.isfinite(env.signals["nav_speed_mps"]).all()
    env.close()


def test_twin_without_lidar_drops_lidar_conditions():
    evaluated, lost = conditions_in_twin(PROFILE.conditions, PROFILE.signals, lidar=False)
    assert lost == signals_named(PROFILE.conditions) != {}
    assert [one.name for one in evaluated] == ["wheel_slip"]
    assert conditions_in_twin(PROFILE.conditions, PROFILE.signals) == (PROFILE.conditions, {})
