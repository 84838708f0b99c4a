"""The shipped labels against the truth, on any profile's robot in the twin.

    python benchmarks/robot_labels.py PROFILE... [--seeds 2] [--steps 400] [--json]

Precision and recall of every shipped condition and exposure, also of those that the profile leaves
out. Task, robot and noise are the profile's; where that has no goals, missions have. The planner
drives, with 15 % of random actions, as many rare missions of each kind as nominal ones. This is not
about what a robot's own logs hold, but about what its limits, noise and control period let be told.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
from harness import finish, markdown, option_parser

from restock.ingest.profile.profile import Profile, load_profile
from restock.ingest.store.transitions import label_table
from restock.ingest.task.conditions import label, shipped
from restock.ingest.task.schema import true_names
from restock.ingest.task.task import STORED_SIGNALS
from restock.train.twin.env.drivers import PlannerFollower
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.missions import KINDS

ROBOTS = 24
RANDOM = 0.15  # of the actions
SIGNALS = [signal.name for signal in STORED_SIGNALS]


def main() -> int:
    parser = option_parser(__doc__, quick="60 steps of one seed")
    parser.add_argument("profiles", nargs="+", metavar="PROFILE")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--steps", type=int, default=400)
    options = parser.parse_args()
    seeds, steps = (1, 60) if options.quick else (options.seeds, options.steps)
    rows = [
        {"profile": Path(name).stem, "seed": seed, **score}
        for name in options.profiles
        for seed in range(seeds)
        for score in scores(load_profile(name), seed, steps)
    ]
    lines = [[_text(value) for value in row.values()] for row in rows]
    return finish(options, {"scores": rows}, [], [markdown(list(rows[0]), lines)])


def scores(profile: Profile, seed: int, steps: int) -> Iterator[dict[str, Any]]:
    """Yield precision, recall and the number of true steps of each condition and exposure."""
    table, truth = driven(profile, seed, steps)
    known = shipped(profile.constants) | shipped(profile.constants, "exposure")
    for name, reported in label(table, list(known.values())).items():
        true = np.array([name in names for names in truth], np.bool_)
        right = int((reported & true).sum())
        yield {
            "condition": name,
            "precision": right / int(reported.sum()) if reported.any() else None,
            "recall": right / int(true.sum()) if true.any() else None,
            "true steps": int(true.sum()),
        }


def driven(profile: Profile, seed: int, steps: int) -> tuple[pa.Table, list[frozenset[str]]]:
    """Return steps of ROBOTS robots, and what is true of each."""
    task = msgspec.structs.replace(profile.task, goal="route")
    shares = {kind: 1 / len(KINDS) for kind in KINDS}
    env = WarehouseVectorEnv(ROBOTS, task=task, robot=profile.robot, seed=seed, conditions=shares)
    env.reset(seed=seed)
    driver = PlannerFollower(epsilon=RANDOM, seed=seed)
    episode = np.arange(ROBOTS) * steps  # of each robot; one episode has a step at least
    index = np.zeros(ROBOTS, np.int64)  # in that episode
    signals, episodes, indices, truth = [], [], [], []
    for _ in range(steps):
        signals.append({name: env.signals[name].copy() for name in SIGNALS})
        episodes.append(episode)
        indices.append(index)
        action, _ = driver.act(env, env.observation)
        _, _, terminated, truncated, info = env.step(action)
        both = zip(info["true_condition"], info["true_exposure"], strict=True)
        truth += [true_names(str(what)) | true_names(str(exposed)) for what, exposed in both]
        done = terminated | truncated
        episode, index = episode + done, np.where(done, 0, index + 1)
    columns = {name: np.concatenate([row[name] for row in signals]) for name in SIGNALS}
    table = label_table(columns, np.concatenate(episodes), np.concatenate(indices), pa.table({}))
    return table, truth


def _text(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.2f}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    sys.exit(main())
