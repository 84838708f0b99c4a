"""Data sets of one file: Parquet, and d3rlpy's dump of episodes (HDF5).

    with open("OUT.h5", "rb") as file:
        dataset = d3rlpy.dataset.ReplayBuffer.load(file, d3rlpy.dataset.InfiniteBuffer())

d3rlpy stores as many observations as steps, and does not use the last step of an episode that did
not terminate. So such an episode gets a closing step: the observation after its last step, that
step's action again, and reward 0. Then no transition is lost, and the closing step itself is not
used.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from restock.replay.export.selection import Selection
from restock.replay.export.trajectory import Counts, Trajectory, fixed_lists

GROUP_ROWS = 16_384
D3RLPY_VERSION = "2.1"  # version of its format
D3RLPY_COLUMNS = ("observations", "actions", "rewards", "terminated")


def write_parquet(
    selection: Selection, trajectories: Iterator[Trajectory], out: Path, counts: Counts
) -> list[str]:
    """Write one row per transition, in order, with provenance in the schema's metadata."""
    writer: pq.ParquetWriter | None = None
    waiting: list[pa.Table] = []
    rows = 0
    try:
        for number, trajectory in enumerate(trajectories):
            table = as_table(trajectory, number)
            waiting.append(table)
            rows += len(table)
            if writer is None:
                writer = pq.ParquetWriter(out, table.schema, compression="zstd")
            if rows >= GROUP_ROWS:
                writer.write_table(pa.concat_tables(waiting))
                waiting, rows = [], 0
        if writer is not None:
            if waiting:
                writer.write_table(pa.concat_tables(waiting))
            about = selection.provenance | {"counts": counts.describe()}
            writer.add_key_value_metadata({"restock": json.dumps(about)})
    finally:
        if writer is not None:
            writer.close()
    return []


def as_table(trajectory: Trajectory, number: int) -> pa.Table:
    """Return a trajectory's transitions as rows."""
    t, steps = trajectory, len(trajectory)
    last = np.arange(steps) == steps - 1
    columns: dict[str, Any] = {
        "trajectory": np.full(steps, number, np.int64),
        "episode_id": pa.array([t.episode_id] * steps, pa.string()),
        "step_index": t.first_step + np.arange(steps, dtype=np.int64),
        "observation": fixed_lists(t.observations[:-1]),
        "action": fixed_lists(t.actions) if t.actions.ndim == 2 else t.actions,
        "reward": t.rewards,
        "next_observation": fixed_lists(t.observations[1:]),
        "terminated": last & t.terminated,
        "truncated": last & t.truncated,
        "cut": last & t.cut,
    }
    for name, column in t.carried.items():
        text = column.dtype == object
        columns[name] = pa.array(column, pa.string() if text else pa.from_numpy_dtype(column.dtype))
    return pa.table(columns)


def write_d3rlpy(
    selection: Selection, trajectories: Iterator[Trajectory], out: Path, counts: Counts
) -> list[str]:
    """Write episodes in d3rlpy's dump format."""
    import h5py  # type: ignore[import-untyped]

    number = -1
    with h5py.File(out, "w") as file:
        file.create_dataset("columns", data=list(D3RLPY_COLUMNS))
        for number, trajectory in enumerate(trajectories):
            t = trajectory
            steps = len(t) if t.terminated else len(t) + 1
            actions = t.actions if t.actions.ndim == 2 else t.actions[:, None]
            values = {
                "observations": t.observations[:steps],
                "actions": actions if t.terminated else np.concatenate([actions, actions[-1:]]),
                "rewards": np.pad(t.rewards, (0, steps - len(t)))[:, None],
                "terminated": t.terminated,
            }
            for name in D3RLPY_COLUMNS:
                file.create_dataset(f"{name}_{number}", data=values[name])
            # The ids of each step's transition; d3rlpy does not read this group.
            group = file.require_group(f"restock/{number}")
            group.attrs.update(
                {"episode_id": t.episode_id, "first_step": t.first_step, "cut": t.cut}
            )
            group.attrs.update(t.robot_and_site)
            if "transition_id" in t.carried:
                group.create_dataset("transition_id", data=t.carried["transition_id"])
        file.create_dataset("num_episodes", data=number + 1)
        file.create_dataset("version", data=D3RLPY_VERSION)
        about = selection.provenance | {"counts": counts.describe()}
        file["restock"].attrs["provenance"] = json.dumps(about)
    closed = counts.truncated + counts.cut
    return [f"{closed} truncated episodes got a closing step, so that no transition is lost"]
