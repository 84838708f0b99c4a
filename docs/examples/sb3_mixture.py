"""Stable-Baselines3's DQN on a panel of logs first, then on logs and fresh rows together.

    restock mix store/ --mixture uniform --out panel/
    python docs/examples/sb3_mixture.py panel/ runs/sb3
    restock sql runs/sb3 "SELECT source, stratum, sum(drawn_rows) FROM strata GROUP BY ALL"

The settings are those of `restock train`, as in sb3_dqn.py, which names their keys.
"""

import argparse
import json

from stable_baselines3 import DQN
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import polyak_update

import restock  # noqa: F401 - registers restock/Warehouse-v0
from restock.train import MixtureReplayBuffer, dqn_critic

TAU = 0.005  # target = {rule = "polyak", tau = 0.005}, at every update


def main(
    panel: str,
    run: str,
    offline_updates: int = 2000,  # schedule.offline_updates
    steps: int = 200_000,
    num_envs: int = 32,
    seed: int = 0,
) -> dict:
    updates = max(round(0.25 * num_envs), 1)  # schedule.updates_per_env_step = 0.25
    model = DQN(
        "MlpPolicy",
        make_vec_env("restock/Warehouse-v0", n_envs=num_envs, seed=seed),
        policy_kwargs={"net_arch": [256, 256]},
        replay_buffer_class=MixtureReplayBuffer,
        replay_buffer_kwargs={
            "panel": panel,
            "run": run,
            "n_step": 3,
            "ignore_weights": True,
            "seed": seed,
        },
        learning_rate=1e-3,
        max_grad_norm=float("inf"),
        gamma=0.99,
        buffer_size=100_000,
        batch_size=128,
        learning_starts=min(2000, steps // 4),
        train_freq=1,
        gradient_steps=updates,
        target_update_interval=num_envs,
        tau=1 - (1 - TAU) ** updates,
        exploration_initial_eps=0.2,  # epsilon.start where there are logs
        exploration_final_eps=0.05,
        exploration_fraction=min(20_000 / steps, 1.0),
        seed=seed,
        device="cpu",
    )
    model.replay_buffer.critic = dqn_critic(model)  # TD errors by condition
    model.learn(0)  # only sets up the logger
    for _ in range(offline_updates):  # nothing is fresh yet: all of it logs
        model.train(1, batch_size=128)
        # Stable-Baselines3 moves the target only when it steps the environments.
        polyak_update(model.q_net.parameters(), model.q_net_target.parameters(), TAU)
    model.learn(steps, reset_num_timesteps=False)
    model.replay_buffer.close()
    return {"env_steps": model.num_timesteps, "updates": model._n_updates}


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("panel")
    parser.add_argument("run")
    parser.add_argument("--steps", type=int, default=200_000)
    given = parser.parse_args()
    print(json.dumps(main(given.panel, given.run, steps=given.steps)))  # noqa: T201
