"""Stable-Baselines3's DQN trained on a mixture, for the contract of its buffer."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pyarrow.parquet as pq
import pytest

import restock  # noqa: F401 - registers the environment
from restock.ingest.profile.profile import load_profile
from restock.replay.panel.panel import Panel
from support.panels import panel_of
from support.stores import recording_transitions, write_store

TASK = load_profile("warehouse_amr").task
MIXTURE = """
discount = 0.99
n_step = {n_step}
correction = {{pre = "none", post = "{post}"}}
[[strata]]
name = "wheel_slip"
share = 0.25
[each_condition]
share = "natural"
"""


def make_store(folder: Path) -> Path:
    """Make a store of two recordings of the warehouse's task."""
    recordings = [recording_transitions(index, task=TASK) for index in (1, 2)]
    return write_store(folder / "store", recordings, task=TASK)


def make_panel(store: Path, out: Path, *, n_step: int = 1, post: str = "none") -> Panel:
    """Make a panel of a quarter wheel slip; `post` corrects what is known only afterwards."""
    return panel_of(store, MIXTURE.format(n_step=n_step, post=post), out)


def run_tables(run: Path) -> dict[str, list[dict[str, Any]]]:
    """Every table of a run's directory, as rows."""
    return {path.stem: pq.read_table(path).to_pylist() for path in run.glob("*.parquet")}


@dataclass
class TrainedBuffer:
    """A buffer after some updates on logs alone, and more on logs and fresh rows, half and half."""

    algorithm: Any
    buffer: Any
    run: Path
    panel: Panel
    store: Path
    env_steps: int  # as the library counts them
    updates: int
    offline_updates: int
    batch_size: int = 64

    @property
    def feed(self) -> Any:
        return self.buffer.feed

    def slots_of(self, episode: int) -> np.ndarray:
        """Where the rows of a fresh episode are."""
        ring = self.feed.ring
        return np.flatnonzero(ring.meta["episode"][: len(ring)] == episode)

    @property
    def tables(self) -> dict[str, list[dict[str, Any]]]:
        return run_tables(self.run)


def sb3_envs(count: int, **arguments: Any) -> Any:
    """Stable-Baselines3's vector of warehouses."""
    from stable_baselines3.common.vec_env import DummyVecEnv

    return DummyVecEnv([lambda: gymnasium.make("restock/Warehouse-v0", **arguments)] * count)


def sb3_model(algorithm: str, env: Any, buffer: dict[str, Any], **options: Any) -> Any:
    """Return an algorithm of Stable-Baselines3 with a mixture as its buffer, by these settings."""
    sb3 = pytest.importorskip("stable_baselines3")
    from restock.train.libraries.sb3_buffer import MixtureReplayBuffer

    mixture = {"replay_buffer_class": MixtureReplayBuffer, "replay_buffer_kwargs": buffer}
    return getattr(sb3, algorithm)("MlpPolicy", env, seed=0, device="cpu", **mixture, **options)


def trained_sb3(folder: Path, steps: int = 520) -> TrainedBuffer:
    """Return a DQN after 40 updates on logs and some hundred environment steps."""
    pytest.importorskip("stable_baselines3")
    from restock.train.libraries.sb3_buffer import dqn_critic

    store = make_store(folder)
    panel = make_panel(store, folder / "panel", n_step=3)
    fed = {"panel": panel.path, "run": folder / "run", "logs_share": 0.5, "n_step": 3}
    model = sb3_model(
        "DQN",
        sb3_envs(2),
        {**fed, "audit_share": 0.2, "log_every": 60},
        buffer_size=1000,
        learning_starts=40,
        train_freq=4,
        batch_size=64,
        policy_kwargs={"net_arch": [32]},
    )
    buffer = model.replay_buffer
    buffer.critic = dqn_critic(model)
    model.learn(0)  # sets up the logger; then the logs alone
    model.train(40, batch_size=64)
    model.learn(steps, reset_num_timesteps=False)
    buffer.close()
    counts = model.num_timesteps, model._n_updates
    return TrainedBuffer(model, buffer, folder / "run", panel, store, *counts, 40)
