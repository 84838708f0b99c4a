"""Finished runs with the tables that comparisons read, written without training."""

import copy
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from restock.train.dqn.config import TrainConfig
from restock.train.run.run import Run

UPDATES, ENV_STEPS = 10_000, 40_000
DOCUMENT: dict[str, Any] = {
    "created_ns": 0,
    "config": msgspec.to_builtins(TrainConfig()),
    "panel": {
        "path": "/panels/p",
        "id": "abc",
        "store": "store",
        "store_version": 3,
        "labels_version": "l1",
        "strata": {"nominal": 0.7, "wheel_slip": 0.3},
    },
    "task_hash": "t",
    "labels_version": "l1",
    "versions": {"torch": "1"},
}


def document(seed: int = 0, **changes: Any) -> dict[str, Any]:
    """Return a run's config.json, with `section__key=value` changed."""
    whole = copy.deepcopy(DOCUMENT)
    whole["config"]["seed"] = seed
    for path, value in changes.items():
        *sections, last = path.split("__")
        place = whole
        for section in sections:
            place = place[section]
        place[last] = value
    return whole


def make_run(
    path: Path,
    whole: dict[str, Any],
    *,
    slip_share: float = 0.3,
    success: float | None = 0.5,
    updates: int = UPDATES,
    fresh_episodes: int = 4000,
    first_episode_seed: int = 90_000,
    episodes: int = 40,
) -> Path:
    """Write a finished run: half its rows from logs by quota, half fresh, one kind an episode.

    Success is null where none is given, as in a task without a goal.
    """
    seed, rate = whole["config"]["seed"], success or 0.0
    rng = np.random.default_rng([seed, abs(round(1000 * rate))])
    run = Run.create(path, whole)
    for part in range(1, 11):
        clocks = {"env_steps": ENV_STEPS * part // 10, "gradient_steps": updates * part // 10}
        for stratum, share in (("nominal", 1 - slip_share), ("wheel_slip", slip_share)):
            run.append_columns(
                "sampled_episodes",
                {
                    **clocks,
                    "source": "logs",
                    "stratum": "all",
                    "condition": stratum,
                    "episode": [f"a/{key}" for key in range(50)],
                    "drawn_rows": round(1000 * share),
                    "weight": 1000.0 * share,
                },
            )
        count = fresh_episodes // 10
        kinds = np.where(rng.random(count) < 0.3, "wheel_slip", "nominal")
        run.append_columns(
            "sampled_episodes",
            {
                **clocks,
                "source": "fresh",
                "stratum": kinds,
                "condition": kinds,
                "episode": (part * count + np.arange(count)).astype(str),
                "drawn_rows": 50_000 // count,
                "weight": 50_000.0 / count,
            },
        )
        run.append_columns(
            "progress",
            {**dict.fromkeys(run.table("progress").schema.names), **clocks, "phase": ["online"]},
        )
    for condition, bonus in (("nominal", 0.2), ("wheel_slip", 0.0)):
        won = rng.random(episodes) < rate + bonus
        run.append_columns(
            "evaluations",
            {
                **dict.fromkeys(run.table("evaluations").schema.names),
                "env_steps": ENV_STEPS,
                "gradient_steps": updates,
                "condition": condition,
                "block": "none",
                "episode_seed": first_episode_seed + np.arange(episodes),
                "success": None if success is None else won,
                "bumps": 0,
                "time_s": 10.0,
                "return": won.astype(float),
                "discounted_return": won.astype(float),
                "distance_m": 8.0,
                "closest_person_m": None,
                "best": True,
                "perturbation": "none",
            },
        )
    run.flush()
    return path
