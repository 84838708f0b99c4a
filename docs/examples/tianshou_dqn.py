"""Tianshou's collectors and DQN in the twin, unchanged; with --panel on logs and fresh rows.

python docs/examples/tianshou_dqn.py --steps 100000
python docs/examples/tianshou_dqn.py --panel panel/ --run runs/tianshou
"""

import argparse
import json

import gymnasium as gym
from tianshou.algorithm import DQN
from tianshou.algorithm.modelfree.dqn import DiscreteQLearningPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, CollectStats, VectorReplayBuffer
from tianshou.env import DummyVectorEnv
from tianshou.trainer import OffPolicyTrainerParams
from tianshou.utils.net.common import Net

import restock  # noqa: F401 - registers restock/Warehouse-v0
from restock.train import MixtureVectorReplayBuffer


def main(
    steps: int = 100_000,
    num_envs: int = 4,
    panel: str | None = None,
    run: str | None = None,
    seed: int = 0,
) -> dict:
    envs = DummyVectorEnv([lambda: gym.make("restock/Warehouse-v0") for _ in range(num_envs)])
    envs.seed(seed)
    tests = DummyVectorEnv([lambda: gym.make("restock/Warehouse-v0")])
    observation_space, action_space = envs.observation_space[0], envs.action_space[0]
    policy = DiscreteQLearningPolicy(
        model=Net(
            state_shape=observation_space.shape,
            action_shape=action_space.n,
            hidden_sizes=[256, 256],
        ),
        action_space=action_space,
        eps_training=0.2,
    )
    algorithm = DQN(
        policy=policy, optim=AdamOptimizerFactory(lr=3e-4), gamma=0.99, target_update_freq=500
    )
    if panel is None:
        buffer = VectorReplayBuffer(100_000, num_envs)
    else:
        buffer = MixtureVectorReplayBuffer(100_000, num_envs, panel=panel, run=run, seed=seed)
    collector = Collector[CollectStats](algorithm, envs, buffer, exploration_noise=True)
    collector.reset()
    result = algorithm.run_training(
        OffPolicyTrainerParams(
            training_collector=collector,
            test_collector=Collector[CollectStats](algorithm, tests),
            test_step_num_episodes=1,
            max_epochs=max(1, steps // 10_000),
            epoch_num_steps=min(steps, 10_000),
            collection_step_num_env_steps=4 * num_envs,
            update_step_num_gradient_steps_per_sample=0.25,
            batch_size=128,
            show_progress=False,
            verbose=False,
        )
    )
    if panel is not None:
        buffer.close()
    return {
        "env_steps": result.train_step,
        "update_steps": result.update_step,
        "return": float(result.best_reward),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--panel")
    parser.add_argument("--run")
    given = parser.parse_args()
    print(json.dumps(main(given.steps, panel=given.panel, run=given.run)))  # noqa: T201
