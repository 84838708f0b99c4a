"""Compare tracked people with the truth in the twin."""

import msgspec
import numpy as np

from restock.ingest.profile.profile import load_profile
from restock.ingest.task.task import TRACK_SIGNALS
from restock.train.evaluation.evaluate import fixed_episodes
from restock.train.twin.env.drivers import Operator
from restock.train.twin.env.vector_env import WarehouseVectorEnv

TASK = msgspec.structs.replace(load_profile("warehouse_amr").task, tracks=2)


def environment(kind: str) -> WarehouseVectorEnv:
    env = WarehouseVectorEnv(4, task=TASK, seed=3)
    env.set_episodes(fixed_episodes([kind], 40, 500))
    env.reset(seed=3)
    return env


def test_tracks_follow_walking_people():
    env, driver = environment("near_collision"), Operator(epsilon=0.0)
    traffic, off, speeds = env.simulation.traffic, [], []
    for _ in range(120):
        env.step(driver.choose(env))
        x, y, vx, vy, _ = (env.signals[name] for name in TRACK_SIGNALS)
        pose = env.simulation.middle(env.simulation.pose())
        cos, sin = np.cos(pose[:, 2:]), np.sin(pose[:, 2:])
        at = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1) + pose[:, None, :2]
        gap = np.linalg.norm(at[:, :, None] - traffic.position_m[:, None], axis=-1).min(axis=2)
        off += gap[np.isfinite(x)].tolist()
        speeds += np.hypot(vx, vy)[np.isfinite(x)].tolist()
    assert len(off) > 50
    assert np.mean(np.array(off) < 0.5) > 0.8
    assert np.percentile(speeds, 95) < 1.6


def test_few_tracks_without_people():
    env, driver, shown = environment("nominal"), Operator(epsilon=0.0), 0
    for _ in range(150):
        env.step(driver.choose(env))
        shown += int(np.isfinite(env.signals["track_x_m"]).sum())
    assert shown < 6


def test_restored_environment_keeps_tracks():
    original, restored = environment("near_collision"), environment("near_collision")
    rng = np.random.default_rng(0)
    for _ in range(40):
        original.step(rng.integers(0, 3, 4))
    restored.load_state_dict(original.state_dict())
    for _ in range(15):
        actions = rng.integers(0, 3, 4)
        seen, *_ = original.step(actions)
        again, *_ = restored.step(actions)
        np.testing.assert_array_equal(seen, again)
    assert len(original.sensing.tracker.tracks)  # type: ignore[union-attr]
