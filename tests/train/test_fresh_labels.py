"""Compare labels from step infos with labels from whole episodes."""

from typing import Any

import gymnasium
import numpy as np
import pyarrow as pa

import restock  # noqa: F401 - registers the environment
from restock.ingest.profile.profile import load_profile
from restock.ingest.task.conditions import label, primary
from restock.ingest.task.task import STORED_SIGNALS
from restock.train.libraries.mixed_feed import FreshLabels
from restock.train.twin.env.drivers import PlannerFollower
from restock.train.twin.physics.episode import EpisodeSpec

CONDITIONS = load_profile("warehouse_amr").conditions


def test_labels_from_infos_match_episode_labels() -> None:
    made: Any = gymnasium.make("restock/Warehouse-v0").unwrapped
    kinds = ("blocked_aisle", "near_collision", "wheel_slip")
    made.vector.set_episodes([EpisodeSpec(kind, seed) for seed, kind in enumerate(kinds)])
    driver = PlannerFollower(epsilon=0.0)
    labels = FreshLabels(CONDITIONS, 1)
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
            # The command of a step is known after the step.
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


def test_episodes_without_signals_are_not_labelled() -> None:
    labels = FreshLabels(CONDITIONS, 2)
    assert labels.step(1, {}, ended=False, key=7)
    assert not labels.step(1, {}, ended=True, key=7)
    assert labels.label(all_of_them=True) == []
