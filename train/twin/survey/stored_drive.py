"""What a store has of a drive for a survey: the poses of its rows, and where its recording lies.

A store keeps no maps, and of scans the clearance in a few sectors alone: both are read from the
recording that the rows came from, where it is still there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from restock.errors import RestockError, StoreError
from restock.ingest.profile.profile import Profile, parse_profile
from restock.replay.store.store import Store
from restock.train.twin.floors.placed import Drive
from restock.train.twin.survey.logged_drives import COMPARED, logged_drives
from restock.train.twin.survey.poses import Poses, Times
from restock.words import counted

_POSES = (
    "SELECT stamp_ns, logged_ns, pose_x_m, pose_y_m, pose_yaw_rad FROM transitions"
    " WHERE list_contains(?, recording_id) ORDER BY recording_id, logged_ns"
)


@dataclass(frozen=True)
class StoredDrive:
    """The drive of one recording of a store, and whose poses they are."""

    poses: Poses
    everywhere: (
        Poses  # of all recordings by the same profile: places of one map, where there is one
    )
    recording: Path | None  # where it lies; None where it is no longer there
    profile: Profile | None  # that its rows were made by
    others: Mapping[str, Drive]  # of the largest other recordings by that profile, by source
    notes: list[str] = field(default_factory=list)


def stored_drive(path: Path, recording: str | None = None) -> StoredDrive:
    """The recording with the most rows, of those that are still there if any is.

    Args:
        recording: which one instead: its id, or its file's name or the end of its path.

    Raises:
        StoreError: the store is empty, cannot be read, or has no such recording or several.
    """
    sql = (files("restock.train.twin.survey") / "stored_drive.sql").read_text(encoding="utf-8")
    with Store(str(path)) as store:
        rows = store.connection.sql(sql).fetchall()
        if not rows:
            raise StoreError("no transitions", where=str(path), remedy="ingest recordings into it")
        there = [row for row in rows if row[1] and Path(row[1]).exists()]
        if recording is not None:
            there = [_named(recording, rows, str(path))]
        identity, source, toml, _ = (there or rows)[0]
        alike = [row for row in rows if row[2] == toml]
        said = f"poses of the rows of {counted(len(alike), 'recording')}"
        everywhere = _poses(store, [row[0] for row in alike], said)
        profile = _profile(toml, source)
        names = {row[0]: row[1] or row[0] for row in alike[:COMPARED] if row[0] != identity}
        task = None if profile is None else profile.task
        drives = logged_drives(store.connection, task, list(names))
        others = {name: drives[one] for one, name in names.items()}
        poses = _poses(store, [identity], f"poses of the rows of {source}")
    file = Path(source) if source and Path(source).exists() else None
    notes = []
    if file is None:
        notes.append(f"{source} no longer exists: its map and its scans cannot be read")
    if len(rows) > 1:
        notes.append(f"by {source}, of {len(rows)} recordings in the store")
    return StoredDrive(poses, everywhere, file, profile, others, notes)


def _named(recording: str, rows: list[tuple[Any, ...]], where: str) -> tuple[Any, ...]:
    """The one row of the recordings that this names.

    Raises:
        StoreError: none, or several.
    """
    end = Path(recording).parts
    found = [
        row
        for row in rows
        if row[0] == recording or (row[1] and Path(row[1]).parts[-len(end) :] == end)
    ]
    if len(found) == 1:
        return found[0]
    names = ", ".join(str(row[1] or row[0]) for row in (found or rows)[:8])
    raise StoreError(
        f"{'several recordings are' if found else 'no recording is'} {recording!r}",
        where=where,
        remedy=f"give the path or the id of one of {names}",
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
