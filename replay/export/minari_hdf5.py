"""A Minari data set: `minari.MinariDataset("OUT")`, or `minari.load_dataset` from its data folder.

`infos` have one entry per observation, T + 1 as in Minari. Entry t describes the transition that
begins there; the last entry is empty (-1, "" or NaN).
"""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from restock.ingest.profile.profile import load_profile
from restock.replay.export.selection import Selection
from restock.replay.export.trajectory import Counts, Trajectory

TWIN, TWIN_PROFILE = "restock/Warehouse-v0", "warehouse_amr"


def write_minari(
    selection: Selection, trajectories: Iterator[Trajectory], out: Path, counts: Counts
) -> list[str]:
    """Write the directory `out`."""
    import minari  # type: ignore[import-untyped]
    from minari.data_collector import EpisodeBuffer  # type: ignore[import-untyped]
    from minari.dataset.minari_storage import (  # type: ignore[import-untyped]
        MinariStorage,
    )

    size = selection.observation_size
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
    action_space: gymnasium.Space[Any] = gymnasium.spaces.Discrete(len(selection.task.actions))
    if selection.continuous:
        low, high = (end.astype(np.float32) for end in selection.command_range)
        action_space = gymnasium.spaces.Box(low, high, dtype=np.float32)
    storage = MinariStorage.new(
        out.absolute(),  # Minari joins a relative path to itself
        observation_space=observation_space,
        action_space=action_space,
        env_spec=_twin_spec(selection),
    )
    storage.update_metadata(
        {
            "dataset_id": f"restock/{selection.task.hash}-v0",
            "minari_version": minari.__version__,
            "algorithm_name": "logged behaviour",
            "description": "Robot logs, by Restock; see the key `restock`.",
        }
    )
    storage.update_episodes(
        EpisodeBuffer(
            id=number,
            options={
                "episode_id": t.episode_id,
                "first_step": t.first_step,
                "cut": t.cut,
                **t.robot_and_site,
            },
            observations=t.observations,
            actions=t.actions,
            rewards=t.rewards,
            terminations=_only_last(t.terminated, len(t)),
            truncations=_only_last(t.truncated, len(t)),
            infos={name: _pad(column) for name, column in t.carried.items()},
        )
        for number, t in enumerate(trajectories)
    )
    about = selection.provenance | {"counts": counts.describe()}
    storage.update_metadata({"restock": json.dumps(about)})
    return []


def _twin_spec(selection: Selection) -> Any:
    """Return the twin's environment spec if it has the same task as these rows, else None."""
    if load_profile(TWIN_PROFILE).task.hash != selection.task.hash:
        return None
    spec = copy.deepcopy(gymnasium.spec(TWIN))  # must not change the registry's spec
    spec.kwargs = {"action": "continuous"} if selection.continuous else {}
    return spec


def _only_last(value: bool, length: int) -> NDArray[np.bool_]:
    flags = np.zeros(length, np.bool_)
    flags[-1] = value
    return flags


def _pad(column: NDArray[Any]) -> Any:
    if column.dtype == object:
        return [*("" if value is None else str(value) for value in column), ""]
    empty = np.nan if column.dtype.kind == "f" else -1
    return np.append(column, np.array(empty, column.dtype))
