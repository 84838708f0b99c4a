"""Learning online in the twin, end to end: `restock train` beside Stable-Baselines3's DQN.

    python benchmarks/train_loop.py [--steps 20000] [--quick] [--json] [--check]

The same environments (16, the same conditions), network (2 x 256 ReLU), batch (128), Adam, target
(Polyak 0.005 at every update) and updates an environment step (0.125), one torch thread; Restock
with its record of what was fed, audit rows and labels of finished episodes, Stable-Baselines3 with
none. Both are timed from the end of the warm-up, in turns, by wall clock and CPU. `--check` exits
1 where a target of the design is missed.
"""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from harness import finish, option_parser

from restock.train.loop import TrainingInterrupted, train
from restock.train.prepare import prepare_new

ENVS, BATCH, WARMUP, UPDATES_PER_STEP = 16, 128, 1_600, 0.125
TARGET = 3.0  # times Stable-Baselines3's environment steps a second, at least


@dataclass
class Stretch:
    """Environment steps from the warm-up's end on, and the time they took."""

    steps: int
    began: tuple[float, float] | None = None  # wall, CPU
    took: tuple[float, float] = (0.0, 0.0)
    updates: int = 0

    def over(self, env_steps: int, updates: int) -> bool:
        """Call after every step of all environments; True once the stretch is done."""
        now = time.perf_counter(), time.process_time()
        if self.began is None:
            if env_steps >= WARMUP:
                self.began, self.updates = now, -updates
            return False
        if env_steps < WARMUP + self.steps:
            return False
        self.took = now[0] - self.began[0], now[1] - self.began[1]
        self.updates += updates
        return True


def restock(steps: int, seed: int, *, layer_norm: bool) -> Stretch:
    stretch = Stretch(steps)
    with tempfile.TemporaryDirectory() as folder:
        session = prepare_new(
            Path(folder) / "run",
            None,
            None,
            [
                f"seed={seed}",
                f"network.layer_norm={str(layer_norm).lower()}",
                "loss.n_step=1",
                f"loss.double={str(layer_norm).lower()}",
                f"replay.batch_size={BATCH}",
                f"env.num_envs={ENVS}",
                f"schedule.env_steps={10 * (WARMUP + steps)}",
                f"schedule.warmup_env_steps={WARMUP}",
                f"schedule.updates_per_env_step={UPDATES_PER_STEP}",
                "teacher.source=none",  # its peers have none
                f"evaluation.every_env_steps={100 * (WARMUP + steps)}",
                f"record.checkpoint_every_env_steps={100 * (WARMUP + steps)}",
            ],
        ).open()
        try:
            train(
                session,
                stop=lambda: stretch.over(
                    session.progress.env_steps, session.learner.gradient_steps
                ),
            )
        except TrainingInterrupted:  # by `stop`
            pass
        finally:
            session.close()
    return stretch


def stable_baselines3(steps: int, seed: int) -> Stretch:
    from stable_baselines3 import DQN
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_vec_env

    stretch = Stretch(steps)

    class Timed(BaseCallback):
        def _on_step(self) -> bool:
            return not stretch.over(self.num_timesteps, model._n_updates)

    model: Any = DQN(
        "MlpPolicy",
        make_vec_env(
            "restock/Warehouse-v0",
            n_envs=ENVS,
            seed=seed,
        ),
        learning_rate=1e-3,
        buffer_size=100_000,
        learning_starts=WARMUP,
        batch_size=BATCH,
        gamma=0.99,
        tau=0.005,
        target_update_interval=1,
        train_freq=1,
        gradient_steps=int(UPDATES_PER_STEP * ENVS),
        policy_kwargs={"net_arch": [256, 256]},
        seed=seed,
        device="cpu",
    )
    model.learn(10 * (WARMUP + steps), callback=Timed())
    return stretch


def main() -> int:
    parser = option_parser(__doc__, quick="1,600 steps, once")
    parser.add_argument("--steps", type=int, default=20_000)
    options = parser.parse_args()
    torch.set_num_threads(1)
    import restock as package  # registers the environment

    del package
    steps, rounds = (1_600, 1) if options.quick else (options.steps, 3)
    runs: dict[str, list[Stretch]] = {"restock": [], "restock_default": [], "stable_baselines3": []}
    for seed in range(rounds):
        runs["restock"].append(restock(steps, seed, layer_norm=False))
        runs["restock_default"].append(restock(steps, seed, layer_norm=True))
        runs["stable_baselines3"].append(stable_baselines3(steps, seed))
    rates = {
        name: {
            "env_steps_per_s": float(np.median([steps / each.took[0] for each in stretches])),
            "updates_per_s": float(np.median([each.updates / each.took[0] for each in stretches])),
            "env_steps_per_cpu_s": float(np.median([steps / each.took[1] for each in stretches])),
        }
        for name, stretches in runs.items()
    }
    ratios = {
        unit: rates["restock"][unit] / rates["stable_baselines3"][unit] for unit in rates["restock"]
    }
    missed = []
    if ratios["env_steps_per_s"] < TARGET:
        missed.append(f"end to end: {ratios['env_steps_per_s']:.2f}x, target {TARGET}x")
    lines = [
        f"{name:18s} {rate['env_steps_per_s']:7.0f} env steps/s"
        f" {rate['updates_per_s']:6.0f} updates/s"
        f" {rate['env_steps_per_cpu_s']:7.0f} env steps/CPU s"
        for name, rate in rates.items()
    ]
    lines.append(
        f"restock / stable_baselines3: {ratios['env_steps_per_s']:.2f}x by wall clock"
        f" (target {TARGET}x), {ratios['env_steps_per_cpu_s']:.2f}x by CPU"
    )
    return finish(options, {"steps": steps, "rates": rates, "ratios": ratios}, missed, lines)


if __name__ == "__main__":
    sys.exit(main())
