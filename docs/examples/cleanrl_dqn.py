"""DQN in one file, in the style of CleanRL's `dqn.py`, on the native vector environment.

    python docs/examples/cleanrl_dqn.py --steps 200000
    python docs/examples/cleanrl_dqn.py --panel panel/

With a panel of logs (one that needs no importance weights) it learns from them first, and then
half of each batch is logs, by the panel's quotas. The settings are the defaults of `restock train`;
the comments name its keys (docs/train.md). Returns are of one step (`loss.n_step` is 3 there), and
there is no teacher.

References: V. Mnih et al., Human-level control through deep reinforcement learning (2015); H. van
Hasselt et al., Deep Reinforcement Learning with Double Q-learning (2016).
"""

import argparse
import json

import gymnasium as gym
import numpy as np
import torch
from torch import nn, optim
from torch.nn import functional as F

import restock  # noqa: F401 - registers restock/Warehouse-v0
from restock.replay import Panel, sampler_for


class QNetwork(nn.Module):
    def __init__(self, observation_size: int, actions: int) -> None:
        super().__init__()
        self.network = nn.Sequential(  # network.hidden, network.layer_norm
            nn.Linear(observation_size, 256),
            nn.LayerNorm(256),
            nn.ReLU(),
            nn.Linear(256, 256),
            nn.LayerNorm(256),
            nn.ReLU(),
            nn.Linear(256, actions),
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.network(x)


def linear_schedule(start: float, end: float, duration: float, t: int) -> float:
    return max((end - start) / duration * t + start, end)


def main(
    steps: int = 200_000,  # schedule.env_steps
    num_envs: int = 32,  # env.num_envs
    learning_rate: float = 1e-3,  # optimizer.learning_rate
    buffer_size: int = 100_000,  # replay.ring_capacity
    gamma: float = 0.99,  # loss.discount
    tau: float = 0.005,  # target = {rule = "polyak", tau = 0.005}
    batch_size: int = 128,  # replay.batch_size
    start_e: float | None = None,  # epsilon.start: 1, and .2 with logs
    end_e: float = 0.05,  # epsilon.end
    exploration_steps: int = 20_000,  # epsilon.steps
    learning_starts: int = 2000,  # schedule.warmup_env_steps
    updates_per_env_step: float = 0.25,  # schedule.updates_per_env_step
    huber_delta: float = 10.0,  # loss.huber_delta
    panel: str | None = None,
    offline_updates: int = 2000,  # schedule.offline_updates
    seed: int = 0,
) -> dict:
    rng = np.random.default_rng(seed)
    torch.manual_seed(seed)
    learning_starts = min(learning_starts, steps // 4)
    if start_e is None:
        start_e = 1.0 if panel is None else 0.2

    envs = gym.make_vec(
        "restock/Warehouse-v0", num_envs=num_envs, vectorization_mode="vector_entry_point"
    )
    size = envs.single_observation_space.shape[0]
    q_network = QNetwork(size, envs.single_action_space.n)
    target_network = QNetwork(size, envs.single_action_space.n)
    target_network.load_state_dict(q_network.state_dict())
    optimizer = optim.Adam(q_network.parameters(), lr=learning_rate)

    buffer = {
        "observation": np.zeros((buffer_size, size), np.float32),
        "next_observation": np.zeros((buffer_size, size), np.float32),
        "action": np.zeros((buffer_size, 1), np.float32),
        "reward": np.zeros((buffer_size, 1), np.float32),
        "discount": np.zeros((buffer_size, 1), np.float32),
    }
    filled = updates = 0
    logs = None if panel is None else Panel.open(panel)
    sampler = None if logs is None else sampler_for(logs, batch_size // 2, seed=seed)

    def draw() -> dict[str, torch.Tensor]:
        """Return a batch: fresh rows, or half logs, or logs alone while nothing is fresh."""
        parts = []
        if sampler is not None:
            rows = [sampler.draw().rows for _ in range(1 if filled else 2)]
            packed = logs.rows[np.concatenate(rows)]
            parts.append({name: packed[:, logs.columns[name]] for name in buffer})
        if filled:
            count = batch_size - (len(packed) if parts else 0)
            rows = rng.integers(min(filled, buffer_size), size=count)
            parts.append({name: array[rows] for name, array in buffer.items()})
        return {n: torch.as_tensor(np.concatenate([part[n] for part in parts])) for n in buffer}

    def update() -> torch.Tensor:
        data = draw()
        with torch.no_grad():
            best = q_network(data["next_observation"]).argmax(dim=1, keepdim=True)  # loss.double
            next_value = target_network(data["next_observation"]).gather(1, best)
            td_target = data["reward"] + data["discount"] * next_value
        old_value = q_network(data["observation"]).gather(1, data["action"].long())
        loss = F.huber_loss(old_value, td_target, delta=huber_delta)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        with torch.no_grad():
            pairs = zip(target_network.parameters(), q_network.parameters(), strict=True)
            for slow, fast in pairs:
                slow.lerp_(fast, tau)
        return loss

    if logs is not None:
        for _ in range(offline_updates):
            update()
            updates += 1

    returns, running = [], np.zeros(num_envs)

    obs, _ = envs.reset(seed=seed)
    for step in range(0, steps, num_envs):
        # ALGO LOGIC: epsilon-greedy actions
        epsilon = linear_schedule(start_e, end_e, exploration_steps, step)
        with torch.no_grad():
            actions = q_network(torch.as_tensor(obs)).argmax(dim=1).numpy()
        explore = rng.random(num_envs) < epsilon
        actions[explore] = rng.integers(envs.single_action_space.n, size=explore.sum())

        # TRY NOT TO MODIFY: execute the game and log data
        next_obs, reward, terminated, truncated, info = envs.step(actions)
        running += reward
        done = terminated | truncated
        returns += running[done].tolist()
        running[done] = 0.0

        # The environments reset in the same step: the last observation is in `final_obs`.
        last_obs = next_obs.copy()
        if done.any():
            last_obs[done] = info["final_obs"][done]
        for place in np.flatnonzero(~info["invalid"]):  # a step that diverged is no experience
            row = filled % buffer_size
            buffer["observation"][row], buffer["next_observation"][row] = (
                obs[place],
                last_obs[place],
            )
            buffer["action"][row], buffer["reward"][row] = actions[place], reward[place]
            buffer["discount"][row] = gamma * (1 - terminated[place])  # truncated ones bootstrap
            filled += 1
        obs = next_obs

        # ALGO LOGIC: training
        if step >= learning_starts:
            for _ in range(max(1, round(updates_per_env_step * num_envs))):
                loss = update()
                updates += 1
    return {
        "env_steps": step + num_envs,
        "updates": updates,
        "episodes": len(returns),
        "return_first_100": float(np.mean(returns[:100])) if returns else None,
        "return_last_100": float(np.mean(returns[-100:])) if returns else None,
        "loss": loss.item(),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--panel")
    given = parser.parse_args()
    print(json.dumps(main(given.steps, panel=given.panel)))  # noqa: T201
