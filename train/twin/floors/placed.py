"""Check that a drive is in a floor's frame: poses on free ground, lidar returns near walls.

Odometry starts again from zero with each start of a robot, and so may a map that is made while
driving, so each recording may have its own frame. On open ground, poses of another frame fit as
well as poses of the floor's own frame; only the walls are then in the wrong place.

`logged_drives` reads the drives of a store's recordings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import duckdb
import numpy as np

from restock.arrays import F64
from restock.ingest.task.surroundings import sector_returns
from restock.ingest.task.task import Task, clearances_of
from restock.train.twin.floors.layout import Warehouse, from_walls_m, is_free
from restock.train.twin.floors.occupancy_grid import into_frame

PLACED = 0.8  # minimum share of poses on free ground

# Minimum share of lidar returns within NEAR_M of a wall. Measured on real drives and the sample
# logs: .78 to .98 on floors made from the same drives, up to .61 on floors of other frames.
SEEN, NEAR_M = 0.7, 0.25
MIN_RETURNS = 50  # with fewer returns, their distances from walls are not checked


@dataclass(frozen=True)
class Drive:
    """The positions of a robot and of its lidar's nearest returns, in the frame of its log."""

    places_m: F64  # (N, 2)
    returns_m: F64  # (M, 2); empty without a lidar


def placed_on(floor: Warehouse, drive: Drive) -> bool:
    """Return whether a drive's log is in the frame of this floor's map; False without positions."""
    if not len(drive.places_m):
        return False
    places, returns = (
        into_frame(part, floor.map_origin).T for part in (drive.places_m, drive.returns_m)
    )
    if float(is_free(floor, *places).mean()) < PLACED:
        return False
    if len(drive.returns_m) < MIN_RETURNS:
        return True
    return float((from_walls_m(floor, *returns) < NEAR_M).mean()) >= SEEN


COMPARED = 64  # maximum number of recordings whose frames are checked
ROWS = 2000  # approximate maximum of the rows that are read of a recording
WITHIN_M = 3.0  # maximum distance of returns from the lidar: farther away, sectors are too wide
RETURNS = 4000  # maximum returns of a drive
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
    """Read drives by recording id; without returns if `task` is None or has no lidar."""
    counts = connection.execute(_COUNTS, [list(recordings)]).fetchall()
    lidar = task is not None and task.lidar
    query = _ROWS.format(", observation" if lidar else "")  # large, so read only if it is used
    drives = {}
    for recording, count in counts:
        x, y, yaw, *seen = (
            connection.execute(query, [recording, count // ROWS + 1]).fetchnumpy().values()
        )
        poses = np.column_stack([x, y, yaw]).astype(np.float64)
        if task is not None and seen:
            clearance_m = clearances_of(task, np.stack(list(seen[0])))
            drives[recording] = drive_of(task, poses, clearance_m)
        else:
            drives[recording] = Drive(_drop_unknown(poses)[:, :2], np.empty((0, 2)))
    return drives


def drive_of(task: Task, poses: F64, clearance_m: F64) -> Drive:
    """Build a drive from poses (N, 3) and the clearances (N, K) seen there, without NaN poses."""
    clearance_m, poses = clearance_m[np.isfinite(poses).all(axis=1)], _drop_unknown(poses)
    x, y = sector_returns(task, clearance_m)
    cos, sin = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    returns = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1) + poses[:, None, :2]
    seen = returns[clearance_m < min(task.range_max_m * (1 - 1e-6), WITHIN_M)]
    return Drive(poses[:, :2], seen[:: len(seen) // RETURNS + 1])


def _drop_unknown(poses: F64) -> F64:
    return poses[np.isfinite(poses).all(axis=1)]
