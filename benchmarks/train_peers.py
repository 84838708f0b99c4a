"""The same DQN update in other libraries: 2 x 256 ReLU, Adam, their own loss.

Each function returns what makes `n` updates from a full buffer of the same rows, or None where the
library is not installed. Target networks and optimisers are each library's defaults: a copy at
every so many updates, which is less work than Restock's pull at every one (TorchRL alone is given
that). CleanRL and Stable-Baselines3 can be given Restock's settings instead, `equal`: the pull, and
PyTorch's fused Adam.
"""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn import functional

OBSERVATION, ACTIONS, ROWS, DISCOUNT = 94, 10, 50_000, 0.99
LEARNING_RATE, TAU, COPY_EVERY = 3e-4, 0.005, 500
Arrays = dict[str, np.ndarray]
Updates = Callable[[int], float | None]  # CPU seconds, where they are another process's


def data(rng: np.random.Generator) -> Arrays:
    return {
        "observation": rng.normal(size=(ROWS, OBSERVATION)).astype(np.float32),
        "next_observation": rng.normal(size=(ROWS, OBSERVATION)).astype(np.float32),
        "action": rng.integers(ACTIONS, size=(ROWS, 1)),
        "reward": rng.normal(size=(ROWS, 1)).astype(np.float32),
        "done": (rng.random((ROWS, 1)) < 0.02).astype(np.float32),
    }


def mlp() -> nn.Sequential:
    return nn.Sequential(
        *(nn.Linear(OBSERVATION, 256), nn.ReLU()),
        *(nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, ACTIONS)),
    )


def cleanrl(batch: int, arrays: Arrays, *, equal: bool = False) -> Updates:
    """Return the update of CleanRL's `cleanrl/dqn.py`, line by line, without its logging.

    Its buffer is the one of Stable-Baselines3 1 (`cleanrl_utils/buffers.py`): a gather of each
    column, then `torch.tensor`. Its target is copied every 500 steps (`tau` 1).
    """
    tau, every = (TAU, 1) if equal else (1.0, COPY_EVERY)
    network, target = mlp(), mlp()
    target.load_state_dict(network.state_dict())
    optimizer = torch.optim.Adam(network.parameters(), lr=LEARNING_RATE, fused=equal or None)
    steps = itertools.count(1)
    rng = np.random.default_rng(0)

    def update(updates: int) -> None:
        for _ in range(updates):
            index = rng.integers(ROWS, size=batch)
            sample = {name: torch.tensor(column[index]) for name, column in arrays.items()}
            with torch.no_grad():
                best, _ = target(sample["next_observation"]).max(dim=1)
                goal = sample["reward"].flatten() + DISCOUNT * best * (1 - sample["done"].flatten())
            old = network(sample["observation"]).gather(1, sample["action"]).squeeze()
            loss = functional.mse_loss(goal, old)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            if next(steps) % every == 0:
                for slow, fast in zip(target.parameters(), network.parameters(), strict=True):
                    slow.data.copy_(tau * fast.data + (1.0 - tau) * slow.data)

    return update


def stable_baselines3(
    batch: int, arrays: Arrays, *, equal: bool = False, device: str = "cpu"
) -> Updates | None:
    """Build its DQN's update; by default the target is copied too rarely to matter here."""
    try:
        import gymnasium
        from stable_baselines3 import DQN
        from stable_baselines3.common.logger import Logger
        from stable_baselines3.common.utils import polyak_update
    except ImportError:
        return None

    class Still(gymnasium.Env[Any, Any]):
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (OBSERVATION,), np.float32)
        action_space = gymnasium.spaces.Discrete(ACTIONS)

    model = DQN(
        "MlpPolicy",
        Still(),
        learning_rate=LEARNING_RATE,
        buffer_size=ROWS,
        batch_size=batch,
        gamma=DISCOUNT,
        tau=TAU if equal else 1.0,
        policy_kwargs={
            "net_arch": [256, 256],
            "optimizer_kwargs": {"fused": True} if equal else {},
        },
        device=device,
    )
    model.set_logger(Logger(None, []))
    buffer: Any = model.replay_buffer
    buffer.observations[:, 0] = arrays["observation"]
    buffer.next_observations[:, 0] = arrays["next_observation"]
    buffer.actions[:, 0], buffer.rewards[:] = arrays["action"], arrays["reward"]
    buffer.dones[:], buffer.full = arrays["done"], True

    def update(updates: int) -> None:
        for _ in range(updates):
            model.train(gradient_steps=1, batch_size=batch)
            if equal:
                slow, fast = model.q_net_target, model.q_net
                polyak_update(fast.parameters(), slow.parameters(), TAU)

    return update


def tianshou(batch: int, arrays: Arrays) -> Updates | None:
    try:
        import gymnasium
        from tianshou.algorithm import DQN
        from tianshou.algorithm.algorithm_base import policy_within_training_step
        from tianshou.algorithm.modelfree.dqn import DiscreteQLearningPolicy
        from tianshou.algorithm.optim import AdamOptimizerFactory
        from tianshou.data import ReplayBuffer
        from tianshou.utils.net.common import Net
    except ImportError:
        return None
    policy = DiscreteQLearningPolicy(
        model=Net(state_shape=OBSERVATION, action_shape=ACTIONS, hidden_sizes=[256, 256]),
        action_space=gymnasium.spaces.Discrete(ACTIONS),
    )
    algorithm: Any = DQN(
        policy=policy,
        optim=AdamOptimizerFactory(lr=LEARNING_RATE),
        gamma=DISCOUNT,
        target_update_freq=COPY_EVERY,
        is_double=False,
    )
    done = arrays["done"][:, 0] > 0
    buffer = ReplayBuffer.from_data(
        obs=arrays["observation"],
        act=arrays["action"][:, 0],
        rew=arrays["reward"][:, 0],
        terminated=done,
        truncated=np.zeros(ROWS, np.bool_),
        done=done,
        obs_next=arrays["next_observation"],
    )

    def update(updates: int) -> None:
        with policy_within_training_step(algorithm.policy):
            for _ in range(updates):
                algorithm.update(buffer, batch)

    return update


def torchrl(batch: int, arrays: Arrays) -> Updates | None:
    try:
        from tensordict import TensorDict
        from torchrl.data import Categorical, LazyTensorStorage, TensorDictReplayBuffer
        from torchrl.modules import QValueActor
        from torchrl.objectives import DQNLoss, SoftUpdate
    except ImportError:
        return None
    space = Categorical(ACTIONS)
    actor = QValueActor(module=mlp(), spec=space, in_keys=["observation"])
    loss_of = DQNLoss(actor, delay_value=True, action_space=space)
    loss_of.make_value_estimator(gamma=DISCOUNT)
    follow = SoftUpdate(loss_of, tau=TAU)
    optimizer = torch.optim.Adam(loss_of.parameters(), lr=LEARNING_RATE)
    done = torch.from_numpy(arrays["done"] > 0)
    rows = TensorDict(
        {
            "observation": torch.from_numpy(arrays["observation"]),
            "action": torch.from_numpy(arrays["action"][:, 0]),
            "next": {
                "observation": torch.from_numpy(arrays["next_observation"]),
                "reward": torch.from_numpy(arrays["reward"]),
                "done": done,
                "terminated": done,
            },
        },
        [ROWS],
    )
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(ROWS), batch_size=batch)
    buffer.extend(rows)

    def update(updates: int) -> None:
        for _ in range(updates):
            loss = loss_of(buffer.sample())["loss"]
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            follow.step()

    return update


def d3rlpy(batch: int, arrays: Arrays, python: Path) -> Updates | None:
    """Start `d3rlpy_child` in its own Python, because d3rlpy needs an older Gymnasium."""
    if not python.exists():
        return None
    child = subprocess.Popen(  # ends when its stdin does
        [str(python), __file__, str(batch)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    to, of = child.stdin, child.stdout
    if to is None or of is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rows.npz"
        np.savez(path, **arrays)
        to.write(f"{path}\n".encode())
        to.flush()
        ready = of.readline()
    if ready != b"ready\n":
        return None

    def update(updates: int) -> float:
        to.write(f"{updates}\n".encode())
        to.flush()
        return float(of.readline())

    return update


def d3rlpy_child(batch: int) -> None:
    """d3rlpy's updates, in a Python that has it.

    Reads the path of the rows (.npz) from stdin, says "ready", then for each line `n` makes n
    updates and prints the CPU seconds they took.
    """
    import d3rlpy  # type: ignore[import-not-found]

    answers = os.fdopen(os.dup(1), "w")  # d3rlpy's own lines go to stderr
    os.dup2(2, 1)
    torch.set_num_threads(1)
    with np.load(sys.stdin.readline().strip()) as rows:
        names = ("observation", "action", "reward", "done")
        observation, action, reward, done = (rows[name] for name in names)
    # Next observations are the rows that follow: d3rlpy keeps episodes, not pairs.
    done[-1] = 1
    dataset = d3rlpy.dataset.MDPDataset(observation, action[:, 0], reward[:, 0], done[:, 0])
    algorithm = d3rlpy.algos.DQNConfig(
        batch_size=batch,
        gamma=DISCOUNT,
        learning_rate=LEARNING_RATE,
        encoder_factory=d3rlpy.models.VectorEncoderFactory([256, 256]),
        target_update_interval=COPY_EVERY,
    ).create(device="cpu:0")
    algorithm.create_impl(observation.shape[1:], int(action.max()) + 1)
    print("ready", file=answers, flush=True)
    for line in sys.stdin:
        began = time.process_time()
        for _ in range(int(line)):
            algorithm.update(dataset.sample_transition_batch(batch))
        print(time.process_time() - began, file=answers, flush=True)


if __name__ == "__main__":
    d3rlpy_child(int(sys.argv[1]))
