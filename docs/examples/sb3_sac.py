"""Stable-Baselines3's SAC in the twin's continuous action space, unchanged.

python docs/examples/sb3_sac.py --steps 200000

As many updates for each environment step, as many environments and as large batches as `restock
train` has by default; the comments name its keys (docs/train.md). The rest is SAC's own.
"""

import argparse
import json

from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env

import restock  # noqa: F401 - registers restock/Warehouse-v0


def main(steps: int = 200_000, num_envs: int = 32, seed: int = 0) -> dict:
    env = make_vec_env(
        "restock/Warehouse-v0",
        n_envs=num_envs,  # env.num_envs = 32
        seed=seed,
        env_kwargs={"action": "continuous"},  # (m/s, rad/s); SAC scales them itself
    )
    model = SAC(
        "MlpPolicy",
        env,
        gamma=0.99,  # loss.discount
        buffer_size=100_000,  # replay.ring_capacity
        batch_size=128,  # replay.batch_size
        learning_starts=min(2000, steps // 4),  # schedule.warmup_env_steps = 2000
        train_freq=1,  # a step of all environments, then the updates that it is worth
        gradient_steps=max(round(0.25 * num_envs), 1),  # schedule.updates_per_env_step = 0.25
        tau=0.005,  # target.tau, at every update
        seed=seed,
        device="cpu",
    )
    model.learn(steps)
    command, _ = model.predict(env.reset(), deterministic=True)
    return {
        "env_steps": model.num_timesteps,
        "updates": model._n_updates,
        "command": command[0].tolist(),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=200_000)
    print(json.dumps(main(parser.parse_args().steps)))  # noqa: T201
