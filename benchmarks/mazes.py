"""Quotas on another task: a point mass in two mazes of gymnasium-robotics, learnt offline.

    pip install gymnasium-robotics
    python benchmarks/mazes.py --out DIR                      # ten seeds, two mazes, two conditions
    python benchmarks/mazes.py --out DIR --maze umaze --seeds 3
    python benchmarks/mazes.py --out DIR --quick              # seconds: shows only that it runs

A run is a log of 600 missions by a script that errs, of which 6 (1 %) are rare; a panel of that
table (`build_panel`, docs/panel.md); 6,000 updates of a double DQN on its batches; and 100 missions
of each kind, the same ones for all arms and seeds. Success is being at the goal in time.

Pre-registration, written before any run of this file:

- Conditions. `goal`: the goal is in the other arm of the maze, which the observation shows.
  `gain`: the goal is the usual one, the motors have .4 of their force. The observation does not
  show it, so quotas change which next observation follows a state and an action.
- Arms. `uniform`; `quotas`: the rare condition is a quarter of each batch, uncorrected;
  `corrected` (of `gain` only): the same quota, weighted by density ratio, as the default mixture
  does; `clone`: the actions of the quotas' batches by cross-entropy, no Q; `demonstrations`:
  uniform draws of 600 other missions, of which a quarter are rare: what quotas stand in for.
- Primary, one a maze, corrected by Holm for the two: rare success of `quotas` less `uniform` in
  `goal`, paired by seed, Student's t, 95 %. Expected: above 0 in both (a pilot gave .90 against
  .69 in UMaze with three seeds). Quotas help if the interval is above 0 in both mazes.
- They cost if nominal success of `quotas` less `uniform` has an interval below -.02.
- In `gain`, no gain of `quotas` is expected. If uncorrected quotas lose nominal success and
  `corrected` does not, that is the bias that the correction is for.
- Secondary, without a claim: `clone` and `demonstrations` less `quotas`.
- No run is left out; a run that fails is repeated with the same seed. Ten seeds, 0 to 9.
"""

from __future__ import annotations

import copy
import itertools
import json
import sys
import tempfile
from collections import deque
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pyarrow as pa
from harness import finish, markdown, option_parser

from restock.files import write_text
from restock.replay import build_panel, load_mixture, sampler_for
from restock.stats import holm, paired_t

FORCES = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=2)))  # the nine actions
FRAMES = 10  # of 10 ms an action
ERRS = 0.3  # share of the script's actions that are random
GAIN = 0.4
RARE = "rare"
QUOTA = 0.25
MIXTURE = """
discount = 0.97
n_step = 3
evaluation_split = {{by = "none"}}
correction = {{pre = "none", post = "{post}", below_natural = "allow"}}
[[strata]]
name = "rare"
share = {share}
[each_condition]
"""


class Maze(NamedTuple):
    """Cells (row, column) of a maze, and the decisions that a mission may take."""

    id: str
    start: tuple[int, int]
    goal: tuple[int, int]
    other: tuple[int, int]  # the goal in the other arm
    limit: int


MAZES = {
    "umaze": Maze("PointMaze_UMaze-v3", (2, 3), (1, 1), (3, 1), 40),
    "medium": Maze("PointMaze_Medium-v3", (3, 3), (1, 1), (6, 6), 80),
}
ARMS = {"goal": ("uniform", "quotas", "clone", "demonstrations")}
ARMS["gain"] = (*ARMS["goal"][:2], "corrected", *ARMS["goal"][2:])


class Missions:
    """Missions in one maze, nominal or rare by a condition."""

    def __init__(self, maze: Maze, condition: str) -> None:
        import gymnasium_robotics

        gym.register_envs(gymnasium_robotics)
        self.maze, self.condition = maze, condition
        self.env = gym.make(maze.id, continuing_task=False, max_episode_steps=maze.limit)
        self.point: Any = self.env.unwrapped
        self.point.point_env.frame_skip = FRAMES
        self.force = self.point.model.actuator_gear[:, 0].copy()

    def reset(self, seed: int, rare: bool) -> np.ndarray:
        """Begin a mission; return the observation (6,): position, velocity, goal."""
        other = rare and self.condition == "goal"
        weak = rare and self.condition == "gain"
        self.point.model.actuator_gear[:, 0] = self.force * (GAIN if weak else 1.0)
        cells = {
            "reset_cell": self.maze.start,
            "goal_cell": self.maze.other if other else self.maze.goal,
        }
        given = {name: np.array(cell) for name, cell in cells.items()}
        return seen(self.env.reset(seed=seed, options=given)[0])

    def step(self, action: int) -> tuple[np.ndarray, bool, bool]:
        """Return the observation, and whether the mission terminated or was truncated."""
        after, _, terminated, truncated, _ = self.env.step(FORCES[action])
        return seen(after), terminated, truncated and not terminated

    def script(self, observation: np.ndarray, rng: np.random.Generator) -> int:
        """Return the action of a driver that knows the maze, and errs."""
        if rng.random() < ERRS:
            return int(rng.integers(len(FORCES)))
        position, velocity, goal = observation[:2], observation[2:4], observation[4:]
        maze = self.point.maze
        here, there = (tuple(maze.cell_xy_to_rowcol(xy)) for xy in (position, goal))
        following = next_cell(maze.maze_map, here, there)
        aim = goal if following == there else maze.cell_rowcol_to_xy(np.array(following))
        wanted = 2.0 * (aim - position) - 0.5 * velocity
        return int(np.argmin(((FORCES - np.clip(wanted, -1, 1)) ** 2).sum(axis=1)))


def seen(observation: dict[str, np.ndarray]) -> np.ndarray:
    return np.concatenate([observation["observation"], observation["desired_goal"]]).astype("f4")


def next_cell(walls: list[list[Any]], here: Any, there: Any) -> tuple[int, int]:
    """Return the next cell of a shortest way; the one that it is in where that is the goal's."""
    after, waiting = {there: there}, deque([there])
    while waiting:
        cell = waiting.popleft()
        for way in ((0, 1), (1, 0), (0, -1), (-1, 0)):
            near = cell[0] + way[0], cell[1] + way[1]
            if near not in after and walls[near[0]][near[1]] != 1:
                after[near] = cell
                waiting.append(near)
    return after.get(here, here)


def log(missions: Missions, count: int, rare: int, seed: int) -> pa.Table:
    """Return `count` missions of the script as a table of transitions, `rare` of them rare."""
    rng, rows = np.random.default_rng(seed), []
    odd = set(rng.choice(count, size=rare, replace=False).tolist())
    for episode in range(count):
        observation, over = missions.reset(seed * 100_000 + episode, episode in odd), False
        while not over:
            action = missions.script(observation, rng)
            after, terminated, truncated = missions.step(action)
            row = {"observation": observation, "action": action, "reward": float(terminated)}
            row |= {"next_observation": after, "terminated": terminated, "truncated": truncated}
            row |= {"episode": episode, "condition": RARE if episode in odd else "nominal"}
            rows.append(row)
            observation, over = after, terminated or truncated
    return pa.Table.from_pylist(rows)


def trained(panel: Any, updates: int, seed: int, clone: bool) -> tuple[Any, float]:
    """Return a network of Q (or of a clone's logits), and the share of rare rows it was fed."""
    import torch
    from torch.nn import Linear, ReLU, Sequential
    from torch.nn import functional as F

    torch.manual_seed(seed)
    torch.set_num_threads(1)
    layers = [Linear(6, 128), ReLU(), Linear(128, 128), ReLU(), Linear(128, len(FORCES))]
    online = Sequential(*layers)
    target, optimizer = copy.deepcopy(online), torch.optim.Adam(online.parameters(), 1e-3)
    sampler, part = sampler_for(panel, 128, seed=seed), panel.columns
    packed, rare = np.empty((128, panel.rows.shape[1]), np.float32), 0
    names = [stratum.name for stratum in panel.strata]
    for _ in range(updates):
        draw = sampler.draw()
        sampler.gather(draw.rows, packed)
        rare += int((draw.strata == names.index(RARE)).sum())
        batch = {name: torch.from_numpy(packed[:, columns]) for name, columns in part.items()}
        given, action = online(batch["observation"]), batch["action"].long()
        if clone:
            loss = F.cross_entropy(given, action[:, 0])
        else:
            with torch.no_grad():
                best = online(batch["next_observation"]).argmax(1, keepdim=True)
                value = target(batch["next_observation"]).gather(1, best)
                wanted = batch["reward"] + batch["discount"] * value
            each = F.huber_loss(given.gather(1, action), wanted, reduction="none")
            weight = 1.0 if draw.weight is None else torch.from_numpy(draw.weight)[:, None]
            loss = (weight * each).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        with torch.no_grad():
            torch._foreach_lerp_(list(target.parameters()), list(online.parameters()), 0.005)
    return online, rare / (updates * 128)


def driven(missions: Missions, network: Any, rare: bool, count: int) -> list[bool]:
    """Return the success of each of the fixed missions of one kind, (count,)."""
    import torch

    success = []
    with torch.no_grad():
        for mission in range(count):
            observation, over = missions.reset(900_000_000 + mission, rare), False
            while not over:
                action = int(network(torch.from_numpy(observation)).argmax())
                observation, terminated, truncated = missions.step(action)
                over = terminated or truncated
            success.append(terminated)
    return success


def run(maze: str, condition: str, arm: str, seed: int, quick: bool) -> dict[str, Any]:
    """Log, mix, train and drive one arm with one seed."""
    missions = Missions(MAZES[maze], condition)
    count, updates, drives = (60, 100, 4) if quick else (600, 6_000, 100)
    often = arm == "demonstrations"
    rare = round(count * QUOTA) if often else max(count // 100, 1)
    table = log(missions, count, rare, seed + 5_000 * often)
    quota = arm in ("quotas", "corrected", "clone")
    text = MIXTURE.format(
        share=QUOTA if quota else '"natural"',
        post="density_ratio" if arm == "corrected" else "none",
    )
    with tempfile.TemporaryDirectory() as folder:
        write_text(Path(folder) / "mixture.toml", text)
        mixture = load_mixture(Path(folder) / "mixture.toml")
        panel = build_panel(table, mixture, Path(folder) / "panel")
        network, fed = trained(panel, updates, seed, arm == "clone")
        logged = {
            "rows": len(panel),
            "rare_rows": int(sum(s.rows for s in panel.strata if s.name == RARE)),
        }
    results = {kind: driven(missions, network, kind == RARE, drives) for kind in ("nominal", RARE)}
    last = table.filter(pa.compute.field("terminated"))
    reached = len(last) / count  # of the script's missions
    return {**logged, "fed_rare": fed, "script_success": reached, "success": results}


def contrasts(found: dict[tuple[str, ...], dict[str, Any]], seeds: int) -> list[dict[str, Any]]:
    """Return the differences between arms, paired by seed; the primary ones first."""

    def means(maze: str, condition: str, arm: str, kind: str) -> np.ndarray:
        runs = (found[maze, condition, arm, str(seed)] for seed in range(seeds))
        return np.array([np.mean(one["success"][kind]) for one in runs])

    rows = []
    mazes = sorted({key[0] for key in found}, key=list(MAZES).index)
    for condition, maze, arm, kind in itertools.product(
        ARMS, mazes, ARMS["gain"][1:], ("rare", "nominal")
    ):
        if (maze, condition, arm, "0") not in found:
            continue
        base = "uniform" if arm in ("quotas", "corrected") else "quotas"
        of = maze, condition
        mean, p = paired_t(means(*of, arm, kind) - means(*of, base, kind))
        primary = (condition, arm, kind) == ("goal", "quotas", "rare")
        named = {"maze": maze, "condition": condition, "contrast": f"{arm} - {base}", "kind": kind}
        ends = {"value": mean.value, "low": mean.low, "high": mean.high, "p": p}
        rows.append({**named, "primary": primary, **ends})
    rows.sort(key=lambda row: not row["primary"])
    first = [row for row in rows if row["primary"]]
    for row, p in zip(first, holm([row["p"] for row in first]), strict=True):
        row["p_adjusted"] = p
    return rows


def main() -> int:
    parser = option_parser(__doc__, quick="a few missions and updates of one seed: no result")
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs, kept")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--maze", choices=list(MAZES), action="append", help="default: both")
    parser.add_argument("--condition", choices=list(ARMS), action="append", help="default: both")
    options = parser.parse_args()
    seeds = 1 if options.quick else options.seeds
    found: dict[tuple[str, ...], dict[str, Any]] = {}
    chosen = itertools.product(range(seeds), options.maze or MAZES, options.condition or ARMS)
    for seed, maze, condition in chosen:
        for arm in ARMS[condition]:
            key = (maze, condition, arm, str(seed))
            file = options.out / f"{'-'.join(key)}{'-quick' * options.quick}.json"
            if not file.exists():
                options.out.mkdir(parents=True, exist_ok=True)
                write_text(file, json.dumps(run(maze, condition, arm, seed, options.quick)) + "\n")
            found[key] = json.loads(file.read_text(encoding="utf-8"))
            print(*key, file=sys.stderr)
    rows = []
    for maze, condition, arm in dict.fromkeys(key[:3] for key in found):
        runs = [found[maze, condition, arm, str(seed)] for seed in range(seeds)]
        each = [
            np.mean([np.mean(one["success"][kind]) for one in runs]) for kind in (RARE, "nominal")
        ]
        fed = np.mean([one["fed_rare"] for one in runs])
        named = {"maze": maze, "condition": condition, "arm": arm}
        rows.append({**named, "rare": each[0], "nominal": each[1], "fed_rare": fed})
    figures = {"seeds": seeds, "arms": rows, "contrasts": contrasts(found, seeds)}
    lines = [
        markdown(
            list(rows[0]),
            [[v if isinstance(v, str) else f"{v:.3f}" for v in r.values()] for r in rows],
        )
    ]
    for row in figures["contrasts"]:
        lines.append(
            f"{row['maze']}, {row['condition']}: {row['contrast']}, {row['kind']} success"
            f" {row['value']:+.3f} [{row['low']:+.3f}, {row['high']:+.3f}], p {row['p']:.3f}"
            + (f", adjusted {row['p_adjusted']:.3f}: primary" if row["primary"] else "")
        )
    missed = [
        f"{r['maze']}: quotas are not ahead"
        for r in figures["contrasts"]
        if r["primary"] and not r["low"] > 0
    ]
    return finish(options, figures, missed, lines)


if __name__ == "__main__":
    raise SystemExit(main())
