"""Quotas for a Gymnasium task of your own: log it, mix a panel, train a double DQN offline.

Replace `Corridor` and `scripted` by yours; the table needs the columns that `drive` gives it.
"""

import copy
import tempfile
from pathlib import Path

import gymnasium as gym
import numpy as np
import pyarrow as pa
import torch

from restock.replay import build_panel, load_mixture
from restock.train import MixtureReplayBuffer, Run

MIXTURE = """
correction = {pre = "none", post = "none"}  # the end is in the observation: quotas do not bias Q
[[strata]]
name = "rare"  # a condition of the table; or any name, with where = "SQL over its columns"
share = 0.5
[each_condition]
"""


class Corridor(gym.Env):
    """Walk from the middle to one end; in one episode of fifty it is the right one."""

    observation_space = gym.spaces.Box(-6, 6, (2,), np.float32)  # place, end
    action_space = gym.spaces.Discrete(2)  # left, right

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.end = 6 if self.np_random.random() < (options or {}).get("rare", 0.02) else -6
        self.place, self.steps = 0, 0
        return np.array([0, self.end], np.float32), {}

    def step(self, action):
        self.place, self.steps = self.place + (1 if action else -1), self.steps + 1
        there, over = self.place == self.end, abs(self.place) == 6 or self.steps == 40
        seen = np.array([self.place, self.end], np.float32)
        return seen, float(there), there, over and not there, {}


def drive(env, policy, episode, **options):
    (seen, _), over, rows = env.reset(seed=episode, options=options), False, []
    while not over:
        action = policy(seen)
        after, reward, terminated, truncated, _ = env.step(action)
        row = {"observation": seen, "action": action, "reward": reward, "next_observation": after}
        row |= {"terminated": terminated, "truncated": truncated, "episode": episode}
        rows.append(row | {"condition": "rare" if env.end > 0 else "nominal"})
        seen, over = after, terminated or truncated
    return rows


def main(updates: int = 400, episodes: int = 500, seed: int = 0) -> dict:
    rng, folder, env = np.random.default_rng(seed), Path(tempfile.mkdtemp()), Corridor()

    def scripted(seen):
        return int(seen[1] > 0) if rng.random() < 0.7 else int(rng.integers(2))

    rows = [row for episode in range(episodes) for row in drive(env, scripted, episode)]
    (folder / "mixture.toml").write_text(MIXTURE)
    mixture = load_mixture(folder / "mixture.toml")
    panel = build_panel(pa.Table.from_pylist(rows), mixture, folder / "panel")
    options = {"panel": panel, "run": folder / "run", "seed": seed}
    options["settings"] = {"target": {"rule": "polyak", "tau": 0.02}}  # for `restock diagnose`
    spaces = env.observation_space, env.action_space
    buffer = MixtureReplayBuffer(1000, *spaces, "cpu", **options)  # `add` takes fresh steps

    torch.manual_seed(seed)
    online = torch.nn.Sequential(torch.nn.Linear(2, 64), torch.nn.ReLU(), torch.nn.Linear(64, 2))
    target, optimizer = copy.deepcopy(online), torch.optim.Adam(online.parameters(), 3e-3)

    def critic(batch):  # Q and TD error, (B, 1), which the record keeps by condition
        best = online(batch.next_observations).argmax(1, keepdim=True)
        value = target(batch.next_observations).gather(1, best)
        q = online(batch.observations).gather(1, batch.actions)
        return q, q - (batch.rewards + batch.discounts * value).detach()

    buffer.critic = critic
    for _ in range(updates):
        optimizer.zero_grad()
        critic(buffer.sample(128))[1].square().mean().backward()
        optimizer.step()
        for slow, fast in zip(target.parameters(), online.parameters(), strict=True):
            slow.data.lerp_(fast.data, 0.02)

    success = {}
    for name, rare in (("nominal", 0), ("rare", 1)):
        driven = drive(env, lambda seen: int(online(torch.tensor(seen)).argmax()), 0, rare=rare)
        success[name], gained = driven[-1]["terminated"], sum(row["reward"] for row in driven)
        row = {"condition": name, "episode_seed": 0, "success": success[name], "return": gained}
        buffer.feed.evaluated([row])  # for `restock compare`
    buffer.close()
    fed = dict.fromkeys(success, 0)
    for row in Run.open(folder / "run").table("conditions").to_pylist():
        fed[row["condition"]] += row["drawn_rows"]
    return {"success": success, "rows fed": fed, "run": str(folder / "run")}


if __name__ == "__main__":
    print(main())  # noqa: T201
