"""d3rlpy's own dump of episodes (HDF5, version 2.1 of the format):

    with open("OUT.h5", "rb") as file:
        dataset = d3rlpy.dataset.ReplayBuffer.load(file, d3rlpy.dataset.InfiniteBuffer())

d3rlpy keeps as many observations as steps, and takes no transition from the last step of an
episode that did not terminate. So such an episode gets one closing step: the observation after its
last step, that step's action again, reward 0. Nothing is lost, and the closing step itself gives
no transition.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from restock.replay.export.selection import Selection
from restock.replay.export.trajectory import Counts, Trajectory

FORMAT_VERSION = "2.1"
COLUMNS = ("observations", "actions", "rewards", "terminated")


def write(
    selection: Selection, found: Iterator[Trajectory], out: Path, counts: Counts
) -> list[str]:
    """Write the file `out`."""
    import h5py  # type: ignore[import-untyped]

    number = -1
    with h5py.File(out, "w") as file:
        file.create_dataset("columns", data=list(COLUMNS))
        for number, trajectory in enumerate(found):
            t = trajectory
            steps = len(t) if t.terminated else len(t) + 1
            actions = t.actions if t.actions.ndim == 2 else t.actions[:, None]
            values = {
                "observations": t.observations[:steps],
                "actions": actions if t.terminated else np.concatenate([actions, actions[-1:]]),
                "rewards": np.pad(t.rewards, (0, steps - len(t)))[:, None],
                "terminated": t.terminated,
            }
            for name in COLUMNS:
                file.create_dataset(f"{name}_{number}", data=values[name])
            # Beside what d3rlpy reads: which transition each step was.
            group = file.require_group(f"restock/{number}")
            group.attrs.update(
                {"episode_id": t.episode_id, "first_step": t.first_step, "cut": t.cut}
            )
            if "transition_id" in t.carried:
                group.create_dataset("transition_id", data=t.carried["transition_id"])
        file.create_dataset("num_episodes", data=number + 1)
        file.create_dataset("version", data=FORMAT_VERSION)
        about = selection.provenance | {"counts": counts.describe()}
        file["restock"].attrs["provenance"] = json.dumps(about)
    closed = counts.truncated + counts.cut
    return [f"{closed} truncated episodes got a closing step, so that no transition is lost"]
