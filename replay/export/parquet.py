"""One Parquet file, a row a transition, in order; provenance in the schema's metadata."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from restock.replay.export.selection import Selection
from restock.replay.export.trajectory import Counts, Trajectory

GROUP_ROWS = 16_384


def write(
    selection: Selection, found: Iterator[Trajectory], out: Path, counts: Counts
) -> list[str]:
    """Write the file `out`."""
    writer: pq.ParquetWriter | None = None
    waiting: list[pa.Table] = []
    rows = 0
    try:
        for number, trajectory in enumerate(found):
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
    """A trajectory's transitions as rows."""
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


def fixed_lists(values: NDArray[np.float32]) -> pa.FixedSizeListArray:
    """(n, k) float32 as n lists of k."""
    flat = np.ascontiguousarray(values, np.float32).ravel()
    return pa.FixedSizeListArray.from_arrays(pa.array(flat), values.shape[1])
