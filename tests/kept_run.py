"""A run that kept a policy, as `restock train` leaves it, without the training."""

from __future__ import annotations

from pathlib import Path

import msgspec
import torch

from restock.ingest.profile import load_profile
from restock.train import checkpoint
from restock.train.config import TrainConfig
from restock.train.network import make_network
from restock.train.run import Run


def kept_run(path: Path) -> Path:
    """A network of random weights, seed 0, as the best of gradient step 7."""
    task, config = load_profile("warehouse_amr").task, TrainConfig()
    made = Run.create(path, {"config": msgspec.to_builtins(config), "panel": None})
    generator = torch.Generator().manual_seed(0)
    network = make_network(config.network, task.observation_size, len(task.actions), generator)
    made.best.parent.mkdir()
    checkpoint.save(
        made.best,
        {
            "network": dict(network.state_dict()),
            "observation_size": task.observation_size,
            "actions": len(task.actions),
            "task_hash": task.hash,
            "env_steps": 0,
            "gradient_steps": 7,
            "score": {},
        },
    )
    return path
