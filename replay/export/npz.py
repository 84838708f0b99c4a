"""Arrays in one `.npz`, by the names that D4RL's data sets use; held in memory while written."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.replay.export.selection import Selection
from restock.replay.export.trajectory import Counts, Trajectory


def write(
    selection: Selection, found: Iterator[Trajectory], out: Path, counts: Counts
) -> list[str]:
    """Write the file `out`."""
    all_of_them = list(found)
    lengths = np.array([len(t) for t in all_of_them])
    last = np.zeros(lengths.sum(), np.bool_)
    last[np.cumsum(lengths) - 1] = True

    def each(name: str) -> NDArray[Any]:
        return np.repeat([getattr(t, name) for t in all_of_them], lengths)

    arrays: dict[str, Any] = {
        "observations": np.concatenate([t.observations[:-1] for t in all_of_them]),
        "actions": np.concatenate([t.actions for t in all_of_them]),
        "rewards": np.concatenate([t.rewards for t in all_of_them]),
        "next_observations": np.concatenate([t.observations[1:] for t in all_of_them]),
        "terminals": last & each("terminated"),
        "timeouts": last & each("truncated"),
        "trajectory": np.repeat(np.arange(len(lengths)), lengths),
        "episode_id": each("episode_id"),
    }
    for name in all_of_them[0].carried:
        column = np.concatenate([t.carried[name] for t in all_of_them])
        if column.dtype == object:  # as fixed-width text: no pickles
            column = np.array(["" if value is None else str(value) for value in column])
        arrays[name] = column
    about = selection.provenance | {"counts": counts.describe()}
    np.savez_compressed(out, **arrays, restock=np.array(json.dumps(about)))
    return []
