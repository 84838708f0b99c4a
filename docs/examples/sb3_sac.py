"""Stable-Baselines3's SAC in the twin's continuous action space, unchanged.

python docs/examples/sb3_sac.py --steps 100000
"""

import argparse
import json

from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env

import restock  # noqa: F401 - registers restock/Warehouse-v0


def main(steps: int = 100_000, num_envs: int = 4, seed: int = 0) -> dict:
    env = make_vec_env(
        "restock/Warehouse-v0",
        n_envs=num_envs,
        seed=seed,
        env_kwargs={"action": "continuous"},  # (m/s, rad/s); SAC scales them itself
    )
    model = SAC(
        "MlpPolicy",
        env,
        gamma=0.99,
        batch_size=128,
        learning_starts=min(1000, steps // 4),
        train_freq=4,
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
    parser.add_argument("--steps", type=int, default=100_000)
    print(json.dumps(main(parser.parse_args().steps)))  # noqa: T201
