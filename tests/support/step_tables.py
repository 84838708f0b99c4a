"""Tables of steps, for tests of conditions: a robot that drives, with nothing near."""

import numpy as np
import pyarrow as pa

from restock.ingest.task.schema import SIGNAL_COLUMNS


def steps(count: int, **signals: object) -> pa.Table:
    """Return an episode of a robot at .5 m/s with nothing near, but for these signals."""
    usual = {
        "stamp_ns": np.arange(count) * 200_000_000,
        "pose_stamp_ns": np.arange(count) * 200_000_000,
        "wheel_speed_mps": np.full(count, 0.5),
        "localised_speed_mps": np.full(count, 0.5),
        "clearance_m": np.full(count, 2.0),
        "clearance_ahead_m": np.full(count, 2.0),
        "plan_return_m": np.full(count, 4.0),
        "plan_gap_m": np.full(count, 4.0),
        "bumped": np.zeros(count, np.bool_),
        "command_speed_mps": np.full(count, 0.5),
        "waypoint_near_x_m": np.ones(count),
        "waypoint_far_x_m": np.full(count, 2.2),
    } | signals
    columns = {
        column.name: pa.array(usual.get(column.name, np.zeros(count))).cast(column.type, safe=False)
        for column in SIGNAL_COLUMNS
    }
    index = np.arange(count)
    return pa.table({"episode_index": np.zeros(count, np.int32), "step_index": index, **columns})


def changed(value: float, usual: float, count: int, at: slice) -> np.ndarray:
    """Return a column (N,) of one value, and of another at some steps."""
    column = np.full(count, usual)
    column[at] = value
    return column
