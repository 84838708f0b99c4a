"""Labels from infos alone are those of the signals; metadata beside a buffer is a ring's."""

from typing import Any

import gymnasium
import numpy as np
import pyarrow as pa

import restock  # noqa: F401 - registers the environment
from restock.ingest.profile.profile import load_profile
from restock.ingest.task.conditions import label, primary
from restock.ingest.task.task import STORED_SIGNALS
from restock.replay.sampling.ring import FreshRing
from restock.train.libraries.mixed_feed import FreshMeta, InfoLabels
from restock.train.twin.env.drivers import PlannerFollower
from restock.train.twin.physics.episode import EpisodeSpec

CONDITIONS = load_profile("warehouse_amr").conditions


def test_labels_from_infos_equal_those_of_whole_episodes() -> None:
    made: Any = gymnasium.make("restock/Warehouse-v0").unwrapped
    kinds = ("blocked_aisle", "near_collision", "wheel_slip")
    made.vector.set_episodes([EpisodeSpec(kind, seed) for seed, kind in enumerate(kinds)])
    driver = PlannerFollower(epsilon=0.0)
    labels = InfoLabels(CONDITIONS, 1)
    tables = []
    for key in range(len(kinds)):
        observation, info = made.reset(seed=key)
        rows = [info["signals"]]
        ended = False
        while not ended:
            action, _ = driver.act(made.vector, observation[None])
            observation, _, over, cut, info = made.step(action[0])
            ended = over or cut
            labels.step(0, info, ended=ended, key=key)
            # The command of a step is known when it has been taken.
            for name in ("command_speed_mps", "command_yaw_rate_radps"):
                rows[-1] = rows[-1] | {name: info["signals"][name]}
            rows.append(info["signals"])
        tables.append(rows)
    found = labels.label(all_of_them=True)
    seen = set()
    for rows, labelled in zip(tables, found, strict=True):
        columns: dict[str, Any] = {
            "episode_index": np.zeros(len(rows), np.int64),
            "step_index": np.arange(len(rows)),
        }
        for signal in STORED_SIGNALS:
            columns[signal.name] = np.array([row[signal.name] for row in rows], signal.dtype)
        held = label(pa.table(columns), CONDITIONS)
        names = primary(held, labels.conditions)[:-1]
        assert [labels.names[code] for code in labelled.codes] == names
        seen |= set(names)
    assert len(seen) >= 3
    assert labels.unlabelled_episodes == 0


def test_episodes_without_signals_are_counted_not_labelled() -> None:
    labels = InfoLabels(CONDITIONS, 2)
    for ended in (False, True):
        labels.step(1, {}, ended=ended, key=7)
    assert labels.label(all_of_them=True) == []
    assert labels.unlabelled_episodes == 1


def test_metadata_beside_a_buffer_equals_a_single_step_ring() -> None:
    """Both are fed the same steps of two environments, and overwritten twice over."""
    names = ("slip", "nominal")
    ring = FreshRing(12, 2, 1, discount=0.9, conditions=names)
    meta = FreshMeta(12, 2, conditions=names, behaviour_policy="x")
    rng = np.random.default_rng(0)
    lengths: dict[int, int] = {}
    for step in range(15):
        ended = rng.random(2) < 0.3
        slots = (2 * step + np.arange(2)) % 12
        keys = meta.write(slots, np.arange(2), ended, env_step=2 * step, gradient_step=step)
        expected = ring.append(
            observation=np.zeros((2, 1)),
            action=np.zeros(2),
            reward=np.zeros(2),
            terminated=ended,
            truncated=np.zeros(2, np.bool_),
            next_observation=np.zeros((2, 1)),
            env_step=2 * step,
            gradient_step=step,
            policy_version=step,
        )
        np.testing.assert_array_equal(keys, expected)
        for key, over in zip(keys.tolist(), ended.tolist(), strict=True):
            lengths[key] = lengths.get(key, 0) + 1
            if over:
                codes = rng.integers(2, size=lengths[key])
                assert meta.set_labels(key, codes) == ring.set_labels(key, codes)
        for name in ("env_step", "gradient_step", "episode", "episode_step", "horizon"):
            np.testing.assert_array_equal(
                meta.meta[name][meta.filled], ring.meta[name][: len(ring)]
            )
        everywhere = np.arange(len(ring))
        np.testing.assert_array_equal(meta.condition(everywhere), ring.condition(everywhere))
        np.testing.assert_array_equal(meta.by_condition.counts, ring.by_condition.counts)
    assert len(meta) == len(ring) == 12
