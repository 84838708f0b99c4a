"""Other libraries' DQNs trained on a mixture, for the contract of their buffers."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

import restock  # noqa: F401 - registers the environment
from restock.ingest.profile.profile import load_profile
from restock.replay.panel.panel import Panel
from support.panels import panel_of
from support.stores import recording_transitions, write_store

TASK = load_profile("warehouse_amr").task
DISCOUNT = 0.99
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

    library: str
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
        fresh = self.feed.fresh
        filled = getattr(fresh, "filled", np.arange(fresh.capacity) < len(fresh))
        return np.flatnonzero(filled & (fresh.meta["episode"] == episode))

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
    return TrainedBuffer(
        "stable-baselines3", model, buffer, folder / "run", panel, store, *counts, 40
    )


def tianshou_dqn(n_step: int = 1) -> Any:
    """Tianshou's DQN for the warehouse."""
    from tianshou.algorithm import DQN
    from tianshou.algorithm.modelfree.dqn import DiscreteQLearningPolicy
    from tianshou.algorithm.optim import AdamOptimizerFactory
    from tianshou.utils.net.common import Net

    torch.manual_seed(0)
    actions = gymnasium.spaces.Discrete(len(TASK.actions))
    net = Net(
        state_shape=(TASK.observation_size,), action_shape=len(TASK.actions), hidden_sizes=[32]
    )
    return DQN(
        policy=DiscreteQLearningPolicy(model=net, action_space=actions, eps_training=0.5),
        optim=AdamOptimizerFactory(lr=1e-3),
        gamma=DISCOUNT,
        n_step_return_horizon=n_step,
        target_update_freq=20,
    )


def trained_tianshou(folder: Path) -> TrainedBuffer:
    """Return a DQN after 30 updates on logs, and some on logs and 500 fresh steps."""
    pytest.importorskip("tianshou")
    from tianshou.algorithm.algorithm_base import policy_within_training_step
    from tianshou.data import Collector, CollectStats
    from tianshou.env import DummyVectorEnv
    from tianshou.trainer import OffPolicyTrainerParams

    from restock.train.libraries.tianshou_buffer import MixtureVectorReplayBuffer

    store = make_store(folder)
    panel = make_panel(store, folder / "panel", post="full")
    envs = DummyVectorEnv([lambda: gymnasium.make("restock/Warehouse-v0")] * 2)
    envs.seed(0)
    buffer = MixtureVectorReplayBuffer(
        1000, 2, panel=panel, run=folder / "run", logs_share=0.5, audit_share=0.3, log_every=25
    )
    algorithm = tianshou_dqn()
    with policy_within_training_step(algorithm.policy):
        for _ in range(30):
            algorithm.update(buffer, 64)
    collector = Collector[CollectStats](algorithm, envs, buffer, exploration_noise=True)
    collector.reset()
    stats = algorithm.run_training(
        OffPolicyTrainerParams(
            training_collector=collector,
            max_epochs=1,
            epoch_num_steps=504,
            collection_step_num_env_steps=24,
            update_step_num_gradient_steps_per_sample=0.1,
            batch_size=64,
            show_progress=False,
            verbose=False,
        )
    )
    buffer.close()
    # Two gradient steps a collection.
    counts = stats.train_step, 2 * stats.update_step + 30
    return TrainedBuffer("tianshou", algorithm, buffer, folder / "run", panel, store, *counts, 30)
