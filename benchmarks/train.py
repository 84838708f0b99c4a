"""How long one update takes, beside CleanRL's logic and Stable-Baselines3, in one interleaved run.

    python benchmarks/train.py [--quick] [--json] [--check]

Equal network (2 x 256, no LayerNorm, because Stable-Baselines3's MLP has none), equal batch, plain
DQN targets, one thread. Then what Restock's own default adds: double DQN, LayerNorm, half of the
batch from logs by quotas, and the record of what was fed. `--check` exits 1 where a target of the
design is missed. Stable-Baselines3 is left out where it is not installed.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from restock.replay.ring import FreshRing
from restock.train.batches import Batches, Coded, Logs
from restock.train.config import TrainConfig, parse_config
from restock.train.learner import Learner
from restock.train.record import FeedRecord
from restock.train.run import Run

OBSERVATION, ACTIONS, ROWS, DISCOUNT = 94, 10, 50_000, 0.97
TARGETS = {"cleanrl": 1.6, "stable_baselines3": 1.9}
FEED_TARGET = 0.06


def data(rng: np.random.Generator) -> dict[str, np.ndarray]:
    return {
        "observation": rng.normal(size=(ROWS, OBSERVATION)).astype(np.float32),
        "next_observation": rng.normal(size=(ROWS, OBSERVATION)).astype(np.float32),
        "action": rng.integers(ACTIONS, size=(ROWS, 1)),
        "reward": rng.normal(size=(ROWS, 1)).astype(np.float32),
        "done": (rng.random((ROWS, 1)) < 0.02).astype(np.float32),
    }


def config(batch: int, **changes: Any) -> TrainConfig:
    base = {"replay": {"batch_size": batch}, "optimizer": {"learning_rate": 3e-4}}
    return parse_config({**base, **changes}, where="benchmark")


class Restock:
    """Restock's update; with `logs`, half of the batch from logs; with `run`, recorded."""

    def __init__(
        self, settings: TrainConfig, arrays: dict[str, np.ndarray], *, run: Run | None, logs: bool
    ) -> None:
        ring = FreshRing(ROWS, 16, OBSERVATION, discount=DISCOUNT, conditions=("rare", "nominal"))
        discount = DISCOUNT * (1 - arrays["done"])
        columns = [arrays["observation"], arrays["next_observation"], arrays["action"]]
        ring.rows[:] = np.concatenate([*columns, arrays["reward"], discount], axis=1)
        ring.appended = ROWS
        shelf = self._logs(torch.from_numpy(ring.rows.copy())) if logs else None
        self.learner = Learner(settings, OBSERVATION, ACTIONS)
        self.batches = Batches(
            shelf,
            ring,
            batch_size=settings.replay.batch_size,
            logs_share=0.5 if logs else 0.0,
            seed=0,
            device=torch.device("cpu"),
        )
        self.feed = FeedRecord(run, shelf, ring, audit_share=0.01, seed=0) if run else None

    @staticmethod
    def _logs(rows: torch.Tensor) -> Logs:
        rare = np.arange(ROWS) < ROWS // 50
        codes = Coded(rare.astype(np.int32), ["nominal", "rare"])
        return Logs(
            rows=rows,
            strata=["nominal", "rare"],
            timings=["pre", "pre"],
            stratum_rows=[np.flatnonzero(~rare), np.flatnonzero(rare)],
            shares=np.array([0.8, 0.2]),
            weights=None,
            as_of_ns=0,
            transition_id=np.arange(ROWS),
            stamp_ns=np.zeros(ROWS, np.int64),
            condition=codes,
            behaviour_policy=codes,
            behaviour_version=codes,
            episode=codes,
        )

    def __call__(self, updates: int) -> None:
        learner = self.learner
        for _ in range(updates):
            batch = self.batches.draw_online()
            loss = learner.update(batch.rows, weight=batch.weight, logged=batch.logged)
            step = learner.gradient_steps
            if self.feed is not None:
                self.feed.batch(step, step * 4, batch, loss, learner.target.last_sync)
            learner.target.after(step)
            if self.feed is not None and step % 500 == 0:
                self.feed.flush(step * 4, step, "online")


class CleanRL:
    """The update of CleanRL's `dqn.py`, with its buffer's gather and Restock's default tau."""

    def __init__(self, batch: int, arrays: dict[str, np.ndarray]) -> None:
        def network() -> nn.Module:
            return nn.Sequential(
                *(nn.Linear(OBSERVATION, 256), nn.ReLU()),
                *(nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, ACTIONS)),
            )

        self.batch, self.arrays = batch, arrays
        self.network, self.target = network(), network()
        self.target.load_state_dict(self.network.state_dict())
        self.optimizer = torch.optim.Adam(self.network.parameters(), lr=3e-4)
        self.rng = np.random.default_rng(0)

    def __call__(self, updates: int) -> None:
        for _ in range(updates):
            index = self.rng.integers(ROWS, size=self.batch)
            sample = {name: torch.tensor(column[index]) for name, column in self.arrays.items()}
            with torch.no_grad():
                best, _ = self.target(sample["next_observation"]).max(dim=1)
                goal = sample["reward"].flatten() + DISCOUNT * best * (1 - sample["done"].flatten())
            old = self.network(sample["observation"]).gather(1, sample["action"]).squeeze()
            loss = functional.mse_loss(goal, old)
            self.optimizer.zero_grad()
            loss.backward()
            self.optimizer.step()
            for slow, fast in zip(self.target.parameters(), self.network.parameters(), strict=True):
                slow.data.copy_(0.005 * fast.data + 0.995 * slow.data)


def stable_baselines3(batch: int, arrays: dict[str, np.ndarray]) -> Callable[[int], None] | None:
    try:
        import gymnasium
        from stable_baselines3 import DQN
        from stable_baselines3.common.logger import Logger
    except ImportError:
        return None

    class Still(gymnasium.Env[Any, Any]):
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (OBSERVATION,), np.float32)
        action_space = gymnasium.spaces.Discrete(ACTIONS)

    model = DQN(
        "MlpPolicy",
        Still(),
        learning_rate=3e-4,
        buffer_size=ROWS,
        batch_size=batch,
        gamma=DISCOUNT,
        tau=0.005,
        policy_kwargs={"net_arch": [256, 256]},
        device="cpu",
    )
    model.set_logger(Logger(None, []))
    buffer = model.replay_buffer
    buffer.observations[:, 0], buffer.next_observations[:, 0] = (
        arrays["observation"],
        arrays["next_observation"],
    )
    buffer.actions[:, 0], buffer.rewards[:] = arrays["action"], arrays["reward"]
    buffer.dones[:], buffer.full = arrays["done"], True

    from stable_baselines3.common.utils import polyak_update

    def update(updates: int) -> None:
        for _ in range(updates):
            model.train(gradient_steps=1, batch_size=batch)
            polyak_update(model.q_net.parameters(), model.q_net_target.parameters(), 0.005)

    return update


def measure(
    contenders: dict[str, Callable[[int], None]], rounds: int, updates: int
) -> dict[str, float]:
    """Median microseconds an update, the contenders taking turns."""
    taken: dict[str, list[float]] = {name: [] for name in contenders}
    for run in contenders.values():
        run(updates)  # warm
    for _ in range(rounds):
        for name, run in contenders.items():
            began = time.perf_counter()
            run(updates)
            taken[name].append((time.perf_counter() - began) / updates * 1e6)
    return {name: float(np.median(values)) for name, values in taken.items()}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--batch", type=int, default=128)
    args = parser.parse_args()
    torch.set_num_threads(1)
    arrays = data(np.random.default_rng(0))
    equal = config(args.batch, network={"layer_norm": False}, loss={"double": False})
    with tempfile.TemporaryDirectory() as folder:
        run = Run.create(Path(folder) / "run", {})
        contenders: dict[str, Callable[[int], None]] = {
            "restock": Restock(equal, arrays, run=None, logs=False),
            "cleanrl": CleanRL(args.batch, arrays),
            "restock_default": Restock(config(args.batch), arrays, run=None, logs=True),
            "restock_default_recorded": Restock(config(args.batch), arrays, run=run, logs=True),
        }
        peer = stable_baselines3(args.batch, arrays)
        if peer is not None:
            contenders["stable_baselines3"] = peer
        rounds, updates = (5, 40) if args.quick else (15, 200)
        us = measure(contenders, rounds, updates)
    ratios = {name: us[name] / us["restock"] for name in TARGETS if name in us}
    feed = us["restock_default_recorded"] / us["restock_default"] - 1
    missed = [
        f"{name}: {ratios[name]:.2f}x, target {TARGETS[name]}x"
        for name in ratios
        if ratios[name] < TARGETS[name]
    ]
    if feed > FEED_TARGET:
        missed.append(f"record: {feed:.1%} of an update, target {FEED_TARGET:.0%}")
    if args.json:
        print(
            json.dumps(
                {
                    "batch": args.batch,
                    "us_per_update": us,
                    "ratios": ratios,
                    "record_share": feed,
                    "missed": missed,
                }
            )
        )
    else:
        for name, value in us.items():
            print(f"{name:28s} {value:7.0f} us an update")
        for name, value in ratios.items():
            print(f"{name} / restock: {value:.2f}x (target {TARGETS[name]}x)")
        print(f"record of what was fed: {feed:.1%} of an update (target at most {FEED_TARGET:.0%})")
    if args.check and missed:
        print("missed: " + "; ".join(missed), file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
