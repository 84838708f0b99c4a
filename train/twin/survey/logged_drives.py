"""Where the robots of a store's recordings were, and what their lidars saw, for telling frames."""

from __future__ import annotations

from collections.abc import Sequence

import duckdb
import numpy as np

from restock.arrays import F64
from restock.ingest.task.surroundings import sector_returns
from restock.ingest.task.task import Task, clearances_of
from restock.train.twin.floors.placed import Drive

COMPARED = 64  # recordings whose frames are looked at where there may be thousands
ROWS = 2000  # of a recording, at most about so many
WITHIN_M = 3.0  # of the lidar: farther off, a sector is wide
RETURNS = 4000  # at most so many

_COUNTS = (
    "SELECT recording_id, count(*) FROM transitions WHERE list_contains(?, recording_id)"
    " GROUP BY recording_id"
)
_ROWS = (
    "SELECT pose_x_m, pose_y_m, pose_yaw_rad{} FROM transitions"
    " WHERE recording_id = ? AND step_index % ? = 0"
)


def logged_drives(
    connection: duckdb.DuckDBPyConnection, task: Task | None, recordings: Sequence[str]
) -> dict[str, Drive]:
    """Of each of these recordings, by its id, from rows of this task; None: poses alone."""
    counts = connection.execute(_COUNTS, [list(recordings)]).fetchall()
    lidar = task is not None and task.lidar
    query = _ROWS.format(", observation" if lidar else "")  # large: only where it is looked at
    drives = {}
    for recording, count in counts:
        x, y, yaw, *seen = (
            connection.execute(query, [recording, count // ROWS + 1]).fetchnumpy().values()
        )
        poses = np.column_stack([x, y, yaw]).astype(np.float64)
        if task is None or not task.lidar:
            drives[recording] = Drive(_known(poses)[:, :2], np.empty((0, 2)))
        else:
            clearance_m = clearances_of(task, np.stack(list(seen[0])))
            drives[recording] = drive_of(task, poses, clearance_m)
    return drives


def drive_of(task: Task, poses: F64, clearance_m: F64) -> Drive:
    """A drive by its poses (N, 3), where known, and the clearances (N, K) that were seen there."""
    clearance_m, poses = clearance_m[np.isfinite(poses).all(axis=1)], _known(poses)
    x, y = sector_returns(task, clearance_m)
    cos, sin = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    returns = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1) + poses[:, None, :2]
    seen = returns[clearance_m < min(task.range_max_m * (1 - 1e-6), WITHIN_M)]
    return Drive(poses[:, :2], seen[:: len(seen) // RETURNS + 1])


def _known(poses: F64) -> F64:
    return poses[np.isfinite(poses).all(axis=1)]


__all__ = ["COMPARED", "drive_of", "logged_drives"]
