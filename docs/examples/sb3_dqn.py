"""Stable-Baselines3's DQN in the twin, unchanged.

python docs/examples/sb3_dqn.py --steps 100000
"""

import argparse
import json

import gymnasium as gym
from stable_baselines3 import DQN
from stable_baselines3.common.env_util import make_vec_env

import restock  # noqa: F401 - registers restock/Warehouse-v0


def main(steps: int = 100_000, num_envs: int = 4, seed: int = 0) -> dict:
    env = make_vec_env("restock/Warehouse-v0", n_envs=num_envs, seed=seed)
    model = DQN(
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

    test = gym.make("restock/Warehouse-v0", conditions={"nominal": 1.0})
    observation, _ = test.reset(seed=seed + 1)
    done = False
    while not done:
        action, _ = model.predict(observation, deterministic=True)
        observation, _, terminated, truncated, info = test.step(action)
        done = terminated or truncated
    return {
        "env_steps": model.num_timesteps,
        "updates": model._n_updates,
        "success": bool(info["success"]),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=100_000)
    print(json.dumps(main(parser.parse_args().steps)))  # noqa: T201
