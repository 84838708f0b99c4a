"""A run that kept a policy, as `restock train` leaves it, without the training."""

from pathlib import Path

import msgspec
import torch

from restock.ingest.profile.profile import load_profile
from restock.ingest.task.task import Task
from restock.replay.panel.panel import Panel
from restock.train.dqn.algorithm import DQN
from restock.train.dqn.config import LossConfig, NetworkConfig, TrainConfig
from restock.train.dqn.fitted_q import FittedQConfig
from restock.train.dqn.network import QNetwork
from restock.train.run import checkpoint
from restock.train.run.run import Run, panel_document

TASK = load_profile("warehouse_amr").task
NETWORK = NetworkConfig()
QUICK = FittedQConfig(iterations=2, updates=2, batch_size=32, hidden=(8,), cloning_updates=50)


def kept_network(settings: NetworkConfig = NETWORK, task: Task = TASK) -> QNetwork:
    """Return what `kept_run` keeps: random weights, seed 0."""
    generator = torch.Generator().manual_seed(0)
    return DQN(LossConfig()).make_network(
        settings, task.observation_size, len(task.actions), generator
    )


def kept_run(
    path: Path,
    network: NetworkConfig = NETWORK,
    panel: Panel | None = None,
    profile: str = "warehouse_amr",
) -> Path:
    """Write that network as the best of gradient step 7, as if it had learnt from the panel."""
    task = load_profile(profile).task
    config = msgspec.structs.replace(TrainConfig(), network=network, profile=profile)
    fed = None if panel is None else panel_document(panel)
    made = Run.create(path, {"config": msgspec.to_builtins(config), "panel": fed})
    made.best.parent.mkdir()
    checkpoint.save(
        made.best,
        {
            "network": dict(kept_network(network, task).state_dict()),
            "observation_size": task.observation_size,
            "actions": len(task.actions),
            "task_hash": task.hash,
            "env_steps": 0,
            "gradient_steps": 7,
            "score": {},
        },
    )
    return path
