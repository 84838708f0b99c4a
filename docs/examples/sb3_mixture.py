"""Stable-Baselines3's DQN on a panel of logs first, then on logs and fresh rows together.

restock mix store/ --mixture uniform --out panel/
python docs/examples/sb3_mixture.py panel/ runs/sb3
restock sql runs/sb3 "SELECT source, stratum, sum(drawn_rows) FROM strata GROUP BY ALL"
"""

import argparse
import json

from stable_baselines3 import DQN
from stable_baselines3.common.env_util import make_vec_env

import restock  # noqa: F401 - registers restock/Warehouse-v0
from restock.train import MixtureReplayBuffer, dqn_critic


def main(panel: str, run: str, updates: int = 2000, steps: int = 20_000, seed: int = 0) -> dict:
    model = DQN(
        "MlpPolicy",
        make_vec_env("restock/Warehouse-v0", n_envs=4, seed=seed),
        replay_buffer_class=MixtureReplayBuffer,
        replay_buffer_kwargs={
            "panel": panel,
            "run": run,
            "n_step": 3,
            "ignore_weights": True,
            "seed": seed,
        },
        buffer_size=100_000,
        batch_size=128,
        learning_starts=min(1000, steps // 4),
        train_freq=4,
        exploration_initial_eps=0.2,
        seed=seed,
        device="cpu",
    )
    model.replay_buffer.critic = dqn_critic(model)  # TD errors by condition
    model.learn(0)  # only sets up the logger
    model.train(updates, batch_size=128)  # nothing is fresh yet: all of it logs
    model.learn(steps, reset_num_timesteps=False)
    model.replay_buffer.close()
    return {"env_steps": model.num_timesteps, "updates": model._n_updates}


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("panel")
    parser.add_argument("run")
    given = parser.parse_args()
    print(json.dumps(main(given.panel, given.run)))  # noqa: T201
