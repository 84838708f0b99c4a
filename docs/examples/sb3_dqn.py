"""Stable-Baselines3's DQN in the twin, unchanged, at the default settings of `restock train`.

    python docs/examples/sb3_dqn.py --steps 200000

The comments name Restock's keys (docs/train.md). Stable-Baselines3 has no counterpart of
`loss.double`, `loss.huber_delta` (its own is 1) and `network.layer_norm`, and no teacher. To
compare with it, make it an arm of a study (docs/study.md): both drive the same missions there.
"""

import argparse
import json

import gymnasium as gym
from stable_baselines3 import DQN
from stable_baselines3.common.env_util import make_vec_env

import restock  # noqa: F401 - registers restock/Warehouse-v0


def main(steps: int = 200_000, num_envs: int = 32, seed: int = 0) -> dict:
    updates = max(round(0.25 * num_envs), 1)  # schedule.updates_per_env_step = 0.25
    env = make_vec_env("restock/Warehouse-v0", n_envs=num_envs, seed=seed)  # env.num_envs = 32
    model = DQN(
        "MlpPolicy",
        env,
        policy_kwargs={"net_arch": [256, 256]},  # network.hidden
        learning_rate=1e-3,  # optimizer.learning_rate
        max_grad_norm=float("inf"),  # Restock clips none
        gamma=0.99,  # loss.discount
        n_steps=3,  # loss.n_step
        buffer_size=100_000,  # replay.ring_capacity
        batch_size=128,  # replay.batch_size
        learning_starts=min(2000, steps // 4),  # schedule.warmup_env_steps = 2000
        train_freq=1,  # a step of all environments, then the updates that it is worth
        gradient_steps=updates,
        # target = {rule = "polyak", tau = 0.005} moves at every update. Here it moves once before
        # the updates of a step, as far as it would have moved in them.
        target_update_interval=num_envs,
        tau=1 - (1 - 0.005) ** updates,
        exploration_initial_eps=1.0,  # epsilon.start
        exploration_final_eps=0.05,  # epsilon.end
        exploration_fraction=min(20_000 / steps, 1.0),  # epsilon.steps = 20000
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
    parser.add_argument("--steps", type=int, default=200_000)
    print(json.dumps(main(parser.parse_args().steps)))  # noqa: T201
