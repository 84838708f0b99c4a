"""Load saved Stable-Baselines3 models, to act and to continue training."""

import shutil
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from support.library_buffers import make_panel, make_store, run_tables, sb3_model

from restock.errors import RunError

sb3 = pytest.importorskip("stable_baselines3")

from stable_baselines3.common.vec_env import DummyVecEnv  # noqa: E402

from restock.train.libraries.sb3_buffer import dqn_critic  # noqa: E402

BATCH = 32
# Observation bytes -> (episode, step) pairs; a loaded model repeats the episodes of its seed.
Places = dict[bytes, set[tuple[int, int]]]


class RecordingEnv(gymnasium.Wrapper):
    """Wrapper that records the episode and step of each observation, keyed by its bytes."""

    def __init__(self, place: Places) -> None:
        super().__init__(gymnasium.make("restock/Warehouse-v0"))
        self.place, self.episode, self.at = place, 0, 0

    def _keep(self, observation: Any) -> None:
        of = self.place.setdefault(np.asarray(observation, np.float32).tobytes(), set())
        of.add((self.episode, self.at))
        self.at += 1

    def reset(self, **options: Any) -> Any:
        result = self.env.reset(**options)
        self.episode, self.at = self.episode + 1, 0
        self._keep(result[0])
        return result

    def step(self, action: Any) -> Any:
        result = self.env.step(action)
        self._keep(result[0])
        return result


@pytest.fixture
def place() -> Places:
    return {}


@pytest.fixture
def saved(tmp_path: Path, place: Places) -> Any:
    """Return a DQN that was saved with its buffer in the middle of an episode."""
    panel = make_panel(make_store(tmp_path), tmp_path / "panel", n_step=3)
    fed = {"panel": str(panel.path), "run": str(tmp_path / "run"), "n_step": 3, "log_every": 10}
    model = sb3_model(
        "DQN",
        DummyVecEnv([lambda: RecordingEnv(place)]),
        fed,
        buffer_size=1000,
        learning_starts=20,
        batch_size=BATCH,
        policy_kwargs={"net_arch": [16]},
    )
    model.replay_buffer.critic = dqn_critic(model)
    model.learn(104)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    return model


def content(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def test_loaded_model_predicts_without_its_panel(saved, tmp_path):
    saved.replay_buffer.close()
    before, observation = content(tmp_path / "run"), saved.env.reset()
    shutil.rmtree(tmp_path / "panel")
    for env in (None, saved.env):
        model = sb3.DQN.load(tmp_path / "model", env=env, device="cpu")
        np.testing.assert_array_equal(
            model.predict(observation, deterministic=True)[0],
            saved.predict(observation, deterministic=True)[0],
        )
        model.replay_buffer.close()
    assert content(tmp_path / "run") == before


def test_training_without_saved_buffer_is_rejected(saved: Any, tmp_path: Path) -> None:
    saved.replay_buffer.close()
    before = content(tmp_path / "run")
    model = sb3.DQN.load(tmp_path / "model", env=saved.env, device="cpu")
    with pytest.raises(RunError, match=r"already exists\n.*load_replay_buffer"):
        model.learn(10)
    assert content(tmp_path / "run") == before


def test_training_continues_in_the_saved_run(saved: Any, tmp_path: Path, place: Places) -> None:
    saved.learn(60, reset_num_timesteps=False)  # after the buffer was saved
    saved.replay_buffer.close()
    model = sb3.DQN.load(tmp_path / "model", env=saved.env, device="cpu")
    model.load_replay_buffer(tmp_path / "buffer")
    model.replay_buffer.critic = dqn_critic(model)
    feed, ring = model.replay_buffer.feed, model.replay_buffer.ring
    assert (feed.env_steps, feed.batches) == (104, model._n_updates)
    model.learn(40, reset_num_timesteps=False)
    model.replay_buffer.close()
    assert (feed.env_steps, feed.batches) == (144, model._n_updates)
    tables = run_tables(tmp_path / "run")
    assert sum(row["updates"] for row in tables["progress"]) == feed.batches
    assert sum(row["drawn_rows"] for row in tables["strata"]) == BATCH * feed.batches
    assert [row["env_steps"] for row in tables["episodes"]] == sorted(
        row["env_steps"] for row in tables["episodes"]
    )
    seconds = [row["wall_s"] for row in tables["progress"]]
    assert seconds == sorted(seconds)
    # Two n-step rows were incomplete when the buffer was saved, and two are now.
    assert len(ring) == 144 - 2 - 2
    for row, horizon in zip(ring.rows, ring.meta["horizon"][: len(ring)], strict=False):
        begin = place[row[ring.columns["observation"]].tobytes()]
        end = place[row[ring.columns["next_observation"]].tobytes()]
        assert end & {(episode, step + horizon) for episode, step in begin}
