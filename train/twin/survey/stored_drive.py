"""What a store has of its drives for a survey: the poses of its rows, and where recordings lie.

A store keeps no maps, and of scans the clearance in a few sectors alone: both are read from the
recording that the rows came from, where it is still there.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path

import numpy as np

from restock.errors import RestockError, StoreError
from restock.ingest.profile.profile import Profile, parse_profile
from restock.replay.store.store import Store
from restock.train.twin.survey.poses import Poses, Times

_POSES = (
    "SELECT stamp_ns, logged_ns, pose_x_m, pose_y_m, pose_yaw_rad FROM transitions"
    " WHERE list_contains(?, recording_id) ORDER BY recording_id, logged_ns"
)


@dataclass(frozen=True)
class StoredDrive:
    """The drive of a store with the most rows, and whose poses they are."""

    poses: Poses
    everywhere: (
        Poses  # of all recordings by the same profile: places of one map, where there is one
    )
    recording: Path | None  # where it lies; None where it is no longer there
    profile: Profile | None  # that its rows were made by
    notes: list[str] = field(default_factory=list)


def stored_drive(path: Path) -> StoredDrive:
    """The recording with the most rows, of those that are still there if any is.

    Raises:
        StoreError: the store is empty, or cannot be read.
    """
    sql = (files("restock.train.twin.survey") / "stored_drive.sql").read_text(encoding="utf-8")
    with Store(str(path)) as store:
        rows = store.connection.sql(sql).fetchall()
        if not rows:
            raise StoreError("no transitions", where=str(path), remedy="ingest recordings into it")
        there = [row for row in rows if row[1] and Path(row[1]).exists()]
        identity, source, toml, _ = (there or rows)[0]
        alike = [row[0] for row in rows if row[2] == toml]
        poses = _poses(store, [identity], f"poses of the rows of {source}")
        everywhere = _poses(store, alike, f"poses of the rows of {len(alike)} recordings")
    notes = []
    if not there:
        notes.append(f"{source} no longer exists: its map and its scans cannot be read")
    if len(rows) > 1:
        notes.append(f"by {source}, of {len(rows)} recordings in the store")
    return StoredDrive(
        poses, everywhere, Path(source) if there else None, _profile(toml, source), notes
    )


def _poses(store: Store, recordings: list[str], source: str) -> Poses:
    columns = store.connection.execute(_POSES, [recordings]).fetchnumpy()
    stamp, log, *numbers = columns.values()
    x, y, yaw = (np.asarray(number, np.float64) for number in numbers)
    times = Times(np.asarray(stamp, np.int64), np.asarray(log, np.int64))
    return Poses(times, x, y, np.unwrap(yaw), "", source)


def _profile(toml: str | None, source: str) -> Profile | None:
    try:
        return parse_profile(toml, where=f"the profile of {source}") if toml else None
    except RestockError:  # of another version: what it said of topics is guessed again
        return None
