"""Tianshou's collectors and DQN in the twin, unchanged.

    python docs/examples/tianshou_dqn.py --steps 200000

The settings are the defaults of `restock train`; the comments name its keys (docs/train.md). There
is no warm-up and no teacher, and a hard target in place of Polyak averaging, as old in the mean:
copied every 400 updates it is 200 old, which is 1 / tau.
"""

import argparse
import json

import gymnasium as gym
import torch
from tianshou.algorithm import DQN
from tianshou.algorithm.modelfree.dqn import DiscreteQLearningPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, CollectStats, VectorReplayBuffer
from tianshou.env import DummyVectorEnv
from tianshou.trainer import OffPolicyTrainerParams
from tianshou.utils.net.common import Net

import restock  # noqa: F401 - registers restock/Warehouse-v0


def main(
    steps: int = 200_000,
    num_envs: int = 32,  # env.num_envs
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
            hidden_sizes=[256, 256],  # network.hidden
            norm_layer=torch.nn.LayerNorm,  # network.layer_norm
        ),
        action_space=action_space,
    )
    algorithm = DQN(
        policy=policy,
        optim=AdamOptimizerFactory(lr=1e-3),  # optimizer.learning_rate
        gamma=0.99,  # loss.discount
        n_step_return_horizon=3,  # loss.n_step
        is_double=True,  # loss.double
        huber_loss_delta=10.0,  # loss.huber_delta
        target_update_freq=400,  # target = {rule = "polyak", tau = 0.005}
    )
    buffer = VectorReplayBuffer(100_000, num_envs)  # replay.ring_capacity
    collector = Collector[CollectStats](algorithm, envs, buffer, exploration_noise=True)
    collector.reset()
    first = 1.0  # epsilon.start

    def explore(epoch: int, env_step: int) -> None:
        done = min(env_step / 20_000, 1.0)  # epsilon.steps
        policy.set_eps_training(first + done * (0.05 - first))  # epsilon.end

    epochs = max(1, steps // 20_000)  # evaluation.every_env_steps
    result = algorithm.run_training(
        OffPolicyTrainerParams(
            training_collector=collector,
            test_collector=Collector[CollectStats](algorithm, tests),
            test_step_num_episodes=1,
            max_epochs=epochs,
            epoch_num_steps=steps // epochs,
            collection_step_num_env_steps=num_envs,  # then the updates that these are worth
            update_step_num_gradient_steps_per_sample=0.25,  # schedule.updates_per_env_step
            batch_size=128,  # replay.batch_size
            training_fn=explore,
            show_progress=False,
            verbose=False,
        )
    )
    return {
        "env_steps": result.train_step,
        "updates": algorithm._iter,  # result.update_step counts collections
        "return": float(result.best_reward),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=200_000)
    print(json.dumps(main(parser.parse_args().steps)))  # noqa: T201
