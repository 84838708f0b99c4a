"""Learning online in the twin, end to end: `restock train` beside Stable-Baselines3's DQN.

    python benchmarks/train_loop.py [--steps 20000] [--quick] [--json] [--check]

The same environments (16, the same conditions), network (2 x 256 ReLU), batch (128), Adam, target
(Polyak 0.005 at every update) and updates an environment step (0.125), one torch thread; Restock
with its record of what was fed, audit rows and labels of finished episodes, Stable-Baselines3 with
none. "restock" learns as its peers do; "restock_default" has LayerNorm, 3-step returns, double DQN,
the teacher who is asked in every state and the network that learns from it. Stable-Baselines3 steps
Restock's own vector environment, so that the learners are what is compared, and once more 16 single
environments, as its users make them (`make_vec_env`). All are timed from the end of the warm-up, in
turns, by wall clock and CPU. Stable-Baselines3 is left out where it is not installed.

Each has a limit, measured in the same turns: the physics of an environment step and the matrix
products of its recipe's passes (by `torch.mm`), and nothing else. The targets compare how many
times its limit each takes: `--check` exits 1 where one is missed.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from harness import cpu_us, finish, option_parser
from own_updates import products
from twin import physics

from restock.ingest.profile.profile import load_profile
from restock.train.dqn.config import TrainConfig, parse_config
from restock.train.feed.practice import make_twin
from restock.train.loop import TrainingInterrupted, train
from restock.train.prepare import prepare_new

ENVS, BATCH, WARMUP, UPDATES_PER_STEP = 16, 128, 1_600, 0.125
# So many times the peer's on the same vector environment, at least: of the default recipe, the part
# that its limit is of a step, by wall clock and CPU.
TARGETS = {"env_steps_per_s": 2.0, "env_steps_per_cpu_s": 1.5}
FAIR, SINGLE = "stable_baselines3_same_env", "stable_baselines3_single_envs"
# Passes of the batch per update, forward and backward. The default recipe's are the network's at s
# and s', the target's, and the behaviour network's at s' and at its own states.
PASSES = {"restock": (2, 1), "restock_default": (5, 2), FAIR: (2, 1), SINGLE: (2, 1)}


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


PEERS = ("network.layer_norm=false", "loss.n_step=1", "loss.double=false", "teacher.source=none")


def restock(steps: int, seed: int, settings: Sequence[str] = ()) -> Stretch:
    stretch = Stretch(steps)
    with tempfile.TemporaryDirectory() as folder:
        session = prepare_new(
            Path(folder) / "run",
            None,
            None,
            [
                f"seed={seed}",
                *settings,
                f"replay.batch_size={BATCH}",
                f"env.num_envs={ENVS}",
                f"schedule.env_steps={10 * (WARMUP + steps)}",
                f"schedule.warmup_env_steps={WARMUP}",
                f"schedule.updates_per_env_step={UPDATES_PER_STEP}",
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


def limits() -> dict[str, float]:
    """Return the CPU seconds of an environment step's physics and products alone."""
    size = load_profile(TrainConfig().profile).task.observation_size
    step_us = cpu_us(physics(ENVS).run, 100) / ENVS
    updates_us = {
        passes: cpu_us(partial(products(BATCH, *passes, size), 200), 1) / 200
        for passes in set(PASSES.values())
    }
    return {
        name: (step_us + UPDATES_PER_STEP * updates_us[passes]) / 1e6
        for name, passes in PASSES.items()
    }


def as_vec_env(env: Any) -> Any:
    """Restock's vector environment as Stable-Baselines3's `VecEnv`."""
    from stable_baselines3.common.vec_env import VecEnv

    class SameVectorEnv(VecEnv):
        def reset(self) -> Any:
            return env.reset()[0]

        def step_async(self, actions: Any) -> None:
            self.actions = actions

        def step_wait(self) -> Any:
            observation, reward, terminated, truncated, info = env.step(self.actions)
            done = terminated | truncated
            infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
            for index in np.flatnonzero(done).tolist():
                infos[index]["terminal_observation"] = info["final_obs"][index]
                infos[index]["TimeLimit.truncated"] = bool(truncated[index])
            return observation, reward, done, infos

        def close(self) -> None:
            env.close()

        def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
            return [getattr(env, attr_name, None)] * self.num_envs

        def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
            raise NotImplementedError(attr_name)

        def env_method(self, method_name: str, *_: Any, **__: Any) -> list[Any]:
            raise NotImplementedError(method_name)

        def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
            return [False] * self.num_envs

    return SameVectorEnv(env.num_envs, env.single_observation_space, env.single_action_space)


def stable_baselines3(steps: int, seed: int, *, same_env: bool) -> Stretch:
    from stable_baselines3 import DQN
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_vec_env

    if same_env:
        config = parse_config({"seed": seed}, where="benchmark")
        envs = as_vec_env(make_twin(config, load_profile(config.profile), ENVS))
    else:
        envs = make_vec_env("restock/Warehouse-v0", n_envs=ENVS, seed=seed)
    stretch = Stretch(steps)

    class Timed(BaseCallback):
        def _on_step(self) -> bool:
            return not stretch.over(self.num_timesteps, model._n_updates)

    model: Any = DQN(
        "MlpPolicy",
        envs,
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
    envs.close()
    return stretch


def main() -> int:
    parser = option_parser(__doc__, quick="1,600 steps, once")
    parser.add_argument("--steps", type=int, default=20_000)
    options = parser.parse_args()
    torch.set_num_threads(1)
    import restock as package  # registers the environment

    del package
    steps, rounds = (1_600, 1) if options.quick else (options.steps, 3)
    contenders: dict[str, Callable[[int, int], Stretch]] = {
        "restock": partial(restock, settings=PEERS),
        "restock_default": restock,
        FAIR: partial(stable_baselines3, same_env=True),
        SINGLE: partial(stable_baselines3, same_env=False),
    }
    left_out = [] if find_spec("stable_baselines3") else [FAIR, SINGLE]
    for name in left_out:
        del contenders[name]
    runs: dict[str, list[Stretch]] = {name: [] for name in contenders}
    alone: list[dict[str, float]] = []
    for seed in range(rounds):
        alone.append(limits())
        for name, contender in contenders.items():
            runs[name].append(contender(steps, seed))
    limit_s = {name: float(np.median([each[name] for each in alone])) for name in contenders}
    rates = {
        name: {
            "env_steps_per_s": float(np.median([steps / each.took[0] for each in stretches])),
            "updates_per_s": float(np.median([each.updates / each.took[0] for each in stretches])),
            "env_steps_per_cpu_s": float(np.median([steps / each.took[1] for each in stretches])),
        }
        for name, stretches in runs.items()
    }
    ratios = {
        f"{own} / {name}": {unit: rates[own][unit] / rates[name][unit] for unit in TARGETS}
        for own in ("restock", "restock_default")
        for name in (FAIR, SINGLE)
        if name in rates
    }
    # What the limit is of a step, over the same of the peer.
    to_limit = {
        pair: {unit: each[unit] * limit_s[own] / limit_s[name] for unit in TARGETS}
        for pair, each in ratios.items()
        for own, name in [pair.split(" / ")]
    }
    possible = {
        pair: 1 / (rates[name]["env_steps_per_cpu_s"] * limit_s[own])
        for pair in ratios
        for own, name in [pair.split(" / ")]
    }
    missed = [
        f"the default recipe's limit of its step, over the peer's: {fair[unit]:.2f}x {unit},"
        f" target {target}x"
        for unit, target in TARGETS.items()
        if (fair := to_limit.get(f"restock_default / {FAIR}")) and fair[unit] < target
    ]
    lines = [
        f"{name:30s} {rate['env_steps_per_s']:7.0f} env steps/s"
        f" {rate['updates_per_s']:6.0f} updates/s"
        f" {rate['env_steps_per_cpu_s']:7.0f} env steps/CPU s, limit {1 / limit_s[name]:.0f}:"
        f" {1 / (rate['env_steps_per_cpu_s'] * limit_s[name]):.2f} times its limit"
        for name, rate in rates.items()
    ]
    lines += [
        f"{name}: {ratio['env_steps_per_s']:.2f}x by wall clock,"
        f" {ratio['env_steps_per_cpu_s']:.2f}x by CPU (at its limit {possible[name]:.2f}x);"
        f" each over its limit: {to_limit[name]['env_steps_per_s']:.2f}x by wall clock,"
        f" {to_limit[name]['env_steps_per_cpu_s']:.2f}x by CPU"
        for name, ratio in ratios.items()
    ]
    lines += [f"{name}: not installed, left out" for name in left_out]
    if left_out:
        lines.append("end to end, in the same environment: not measured")
    answer = {
        "steps": steps,
        "rates": rates,
        "limit_s": limit_s,
        "ratios": ratios,
        "to_limit": to_limit,
        "possible": possible,
        "left_out": left_out,
    }
    return finish(options, answer, missed, lines)


if __name__ == "__main__":
    sys.exit(main())
