"""Compare the rows in the ring with the steps that the twin returned."""

from typing import Any

import msgspec
import numpy as np
import pytest

from restock.ingest.profile.profile import load_profile
from restock.replay.sampling.ring import FreshRing
from restock.train.feed.collector import Collector, ring_conditions
from restock.train.twin.env.vector_env import WarehouseVectorEnv

ENVS, LONGEST = 3, 25


def make_collector(n_step: int) -> Collector:
    """Return a collector of short episodes that all end at the time limit."""
    profile = load_profile("warehouse_amr")
    task = msgspec.structs.replace(profile.task, time_limit_steps=LONGEST, bump_terminates=False)
    ring = FreshRing(
        500,
        ENVS,
        task.observation_size,
        discount=0.9,
        n_step=n_step,
        conditions=ring_conditions(profile.conditions),
    )
    env = WarehouseVectorEnv(ENVS, seed=1, task=task)
    collector = Collector(env, ring, profile.conditions, task, None)
    collector.reset(1)
    return collector


def test_truncated_episodes_bootstrap_at_last_step():
    """Compare three-step rows of the ring with the single steps of the twin."""
    made, rng = make_collector(n_step=3), np.random.default_rng(0)
    step_of: dict[tuple[int, int], tuple[Any, ...]] = {}
    for number in range(2 * LONGEST):
        before, action = made.observation.copy(), rng.integers(0, 9, ENVS)
        returned = made.start(action, np.ones(ENVS, np.float32))
        after, reward, terminated, truncated, info = returned
        assert not terminated.any()
        assert truncated.all() == truncated.any() == (number % LONGEST == LONGEST - 1)
        after = info["final_obs"] if truncated.any() else after  # before the reset
        for env in range(ENVS):
            step_of[env, number] = before[env], action[env], reward[env], after[env].copy()
        made.finish(env_steps=number * ENVS, gradient_steps=0, acting_step=0)
    ring, columns = made.ring, made.ring.columns
    assert len(ring) == len(step_of)
    slot_of = {
        packed[columns["observation"]].tobytes(): slot
        for slot, packed in enumerate(ring.rows[: len(ring)])
    }
    for (env, number), (observation, action, *_) in step_of.items():
        horizon = min(3, LONGEST - number % LONGEST)
        span = [step_of[env, number + ahead] for ahead in range(horizon)]
        slot = slot_of[observation.tobytes()]
        packed = ring.rows[slot]
        total = sum(0.9**ahead * step[2] for ahead, step in enumerate(span))
        assert packed[columns["reward"]][0] == pytest.approx(total, abs=1e-5)
        assert packed[columns["discount"]][0] == pytest.approx(0.9**horizon, rel=1e-6)
        assert packed[columns["action"]][0] == action
        np.testing.assert_array_equal(packed[columns["next_observation"]], span[-1][3])
        assert ring.meta["horizon"][slot] == horizon


def test_diverged_step_repeats_previous_row(monkeypatch):
    made = make_collector(n_step=1)
    simulation = made.env.simulation
    drive = simulation.drive

    def blow_up(command: Any) -> None:
        drive(command)
        simulation.diverged = np.array([True, False, False])

    for number in range(11):
        if number == 10:
            monkeypatch.setattr(simulation, "drive", blow_up)
        made.start(np.full(ENVS, number % 9), np.ones(ENVS, np.float32))
        ended = made.finish(env_steps=number * ENVS, gradient_steps=0, acting_step=0)
    assert [(episode.env, episode.steps) for episode in ended] == [(0, 11)]
    assert made.invalid_steps == 1
    ring = made.ring
    last, before = (
        np.flatnonzero(
            (ring.meta["episode"][: len(ring)] == ended[0].key)
            & (ring.meta["episode_step"][: len(ring)] == step)
        )
        for step in (10, 9)
    )
    np.testing.assert_array_equal(ring.rows[last], ring.rows[before])
