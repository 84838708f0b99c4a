"""The evidence for a floor in a recording or store: a map, poses, scans, the robot's size.

The map is a recording's last `nav_msgs/OccupancyGrid` that is not a costmap. Map servers write 0,
100 or -1. Some SLAM packages (Cartographer) write the probability that a cell is occupied. Below 25
percent a cell counts as free, and above 65 as occupied, as when `map_saver` writes a `map.yaml`.

A store keeps no maps, and only the clearance of scans in a few sectors. So both are read from the
recording that the rows came from, if it still exists.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from restock.arrays import F64, Bools
from restock.errors import RecordingError, RestockError, StoreError, counted
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.containers.recording import Recording
from restock.ingest.containers.storage import TopicInfo
from restock.ingest.decoding.columns import Ragged
from restock.ingest.profile.profile import Profile, parse_profile
from restock.ingest.propose.footprint import Footprint, descriptions, footprint_of
from restock.ingest.task.task import yaw_of
from restock.replay.store.store import Store, is_store
from restock.train.twin.floors.floor_files import FURTHEST_M, read_grid
from restock.train.twin.floors.occupancy_grid import (
    FREE,
    MAX_CELLS,
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
)
from restock.train.twin.survey.mapping import PlacedScans, placed_scans
from restock.train.twin.survey.poses import (
    WELL_PLACED,
    Poses,
    Times,
    candidate_poses,
    choose_poses,
)

TYPE = "nav_msgs/msg/OccupancyGrid"
FREE_BELOW, OCCUPIED_ABOVE = 25, 65  # occupancy in percent
_OTHERS = ("costmap", "cost_map", "transformed", "local", "_updates")  # in topics of other grids
_INFO = (
    "info.resolution",
    "info.width",
    "info.height",
    "info.origin.position.x",
    "info.origin.position.y",
    *(f"info.origin.orientation.{axis}" for axis in "xyzw"),
)

_FRAME = "header.frame_id"


def map_topic(recording: Recording) -> TopicInfo | None:
    """Return the topic of the recording's map, preferably `/map`; None if it has none."""
    found = [
        topic
        for topic in recording.topics.values()
        if topic.type == TYPE and topic.expected and not topic.skipped
        if not any(word in topic.name.lower() for word in _OTHERS)
    ]
    return min(found, key=lambda t: (t.name.split("/")[-1] != "map", t.name), default=None)


def recorded_map(recording: Recording) -> tuple[OccupancyGrid, str] | None:
    """Return a recording's last map and a text on its source; None if it has no map.

    Raises:
        RecordingError: the map's size, resolution or origin is not valid.
    """
    topic = map_topic(recording)
    if topic is None:
        return None
    columns = recording.read({topic.name: [*_INFO, _FRAME, "data"]}).get(topic.name)
    if columns is None or not len(columns):
        return None
    fields = columns.fields
    values: list[Any] = [np.asarray(fields[path])[-1] for path in _INFO]
    cell_m, width, height, x, y = (float(value) for value in values[:5])
    yaw = float(yaw_of(*(np.array([float(value)]) for value in values[5:]))[0])
    data = fields["data"]
    cells = np.asarray(data[len(data) - 1] if isinstance(data, Ragged) else data[-1]).ravel()
    sane = 1 <= width * height <= MAX_CELLS and len(cells) == width * height
    if not (sane and 0.001 <= cell_m <= 1 and (np.abs([x, y, yaw]) <= FURTHEST_M).all()):
        raise RecordingError(
            f"its map of {width:,.0f} x {height:,.0f} cells of {cell_m:g} m, with {len(cells):,}"
            f" values, from {x:g}, {y:g} and turned by {yaw:g} rad, cannot be used: it must have 1"
            f" to {MAX_CELLS:,} cells of .001 to 1 m",
            where=f"{recording.path}, {topic.name}",
            remedy="give the map as a file (--map map.yaml), or --by scans, or --by corridor",
        )
    percent = cells.astype(np.int16).reshape(int(height), int(width)).T
    occupancy = np.full(percent.shape, UNKNOWN, np.int8)
    occupancy[(percent >= 0) & (percent < FREE_BELOW)] = FREE
    occupancy[(percent > OCCUPIED_ABOVE) & (percent <= 100)] = OCCUPIED
    frame = str(np.asarray(fields[_FRAME], object)[-1]).strip("/")
    grid = OccupancyGrid(np.ascontiguousarray(occupancy), cell_m, (x, y, yaw), frame)
    count = f", the last of {len(columns)}" if len(columns) > 1 else ""
    return grid, f"{topic.name} of {recording.path.name}{count}"


_POSES = (
    "SELECT stamp_ns, logged_ns, pose_x_m, pose_y_m, pose_yaw_rad FROM transitions"
    " WHERE list_contains(?, recording_id) ORDER BY recording_id, logged_ns"
)


@dataclass(frozen=True)
class StoredDrive:
    """The drive of one recording of a store, and the poses of all with the same profile."""

    poses: Poses
    everywhere: Poses  # of all recordings with this profile; in one frame only if they share a map
    recording: Path | None  # its file; None if that no longer exists
    profile: Profile | None  # the profile of its ingest; None if unreadable
    notes: list[str] = field(default_factory=list)


def stored_drive(path: Path, recording: str | None = None) -> StoredDrive:
    """Return the drive of the recording with the most rows, preferably one whose file still exists.

    Args:
        recording: chooses another one: its ID, its file's name or the end of its path.

    Raises:
        StoreError: the store is empty or cannot be read, or `recording` fits none or several.
    """
    sql = (files("restock.train.twin.survey") / "stored_drive.sql").read_text(encoding="utf-8")
    with Store(str(path)) as store:
        rows = store.connection.sql(sql).fetchall()
        if not rows:
            raise StoreError("no transitions", where=str(path), remedy="ingest recordings into it")
        there = [row for row in rows if row[1] and Path(row[1]).exists()]
        if recording is not None:
            there = [_find_recording(recording, rows, str(path))]
        identity, source, toml, _ = (there or rows)[0]
        alike = [row for row in rows if row[2] == toml]
        source_text = f"poses of the rows of {counted(len(alike), 'recording')}"
        everywhere = _poses(store, [row[0] for row in alike], source_text)
        profile = _stored_profile(toml, source)
        poses = _poses(store, [identity], f"poses of the rows of {source}")
    file = Path(source) if source and Path(source).exists() else None
    notes = []
    if file is None:
        notes.append(f"{source} no longer exists: its map and its scans cannot be read")
    if len(rows) > 1:
        notes.append(
            f"made from {source}, one of {len(rows)} recordings in the store: another may have a"
            " frame of its own, for which --recording makes a floor"
        )
    return StoredDrive(poses, everywhere, file, profile, notes)


def _find_recording(recording: str, rows: list[tuple[Any, ...]], where: str) -> tuple[Any, ...]:
    """Return the row whose ID, file name or end of path is `recording`.

    Raises:
        StoreError: no row fits, or several do.
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


def _stored_profile(toml: str | None, source: str) -> Profile | None:
    try:
        return parse_profile(toml, where=f"the profile of {source}") if toml else None
    except RestockError:  # written by another version: topics are guessed instead
        return None


@dataclass(frozen=True)
class Evidence:
    """The data that a floor can be made from; None for what is missing."""

    poses: Poses | None
    known: tuple[OccupancyGrid, str] | None  # a map, and a text on its source
    footprint: Footprint | None = None
    scans: list[PlacedScans] = field(default_factory=list)  # once per clock
    notes: list[str] = field(default_factory=list)


def gather(
    path: Path,
    *,
    stored_recording: str | None = None,
    map_yaml: Path | None,
    with_map: bool,
    with_scans: bool,
    profile: Profile | None,
    definitions: str | None,
) -> Evidence:
    """Read the data for a floor from a recording, or from one recording of a store.

    In a store, this is `stored_recording` or, if that is None, the one with the most rows. If
    `with_map` is False, an invalid map is ignored and not an error.

    Raises:
        RecordingError: the recording cannot be read, or its map is invalid.
        ConfigError: `map_yaml` is invalid.
        StoreError: the store is empty, or cannot be read.
    """
    notes: list[str] = []
    file, stored = path, None
    if is_store(path):
        stored = stored_drive(path, stored_recording)
        profile, notes = profile or stored.profile, stored.notes
        if stored.recording is None:
            known = None if map_yaml is None else (read_grid(map_yaml), str(map_yaml))
            size = _profile_footprint(profile)
            return Evidence(stored.poses, known, size, notes=notes)
        file = stored.recording
    with open_recording(file, definitions=definitions, salvage=True) as recording:
        known = _read_map(recording, map_yaml, notes, needed=with_map)
        free_on = _free_on(known)
        poses = own = choose_poses(candidate_poses(recording, profile), free_on)
        if with_map and known and stored is not None and _is_on_map(stored.everywhere, free_on):
            poses = stored.everywhere  # all of them lie on this map, so they are in its frame
        size = _profile_footprint(profile) or footprint_of(descriptions(recording))[0]
        scans: list[PlacedScans] = []
        if with_scans and own is not None:
            scans = placed_scans(recording, own, profile, size)
    return Evidence(poses, known, size, scans, notes)


def _is_on_map(poses: Poses, free_on: Callable[[F64], Bools]) -> bool:
    return len(poses) > 0 and float(free_on(poses.places_m).mean()) >= WELL_PLACED


def _read_map(
    recording: Recording, map_yaml: Path | None, notes: list[str], *, needed: bool
) -> tuple[OccupancyGrid, str] | None:
    try:
        if map_yaml is not None:
            return read_grid(map_yaml), str(map_yaml)
        return recorded_map(recording)
    except RestockError as error:
        if needed:
            raise
        notes.append(f"{error.what}: not used")
        return None


def _profile_footprint(profile: Profile | None) -> Footprint | None:
    if profile is None:
        return None
    body = profile.task.body
    return Footprint(body.length_m, body.width_m, f"of the profile {profile.name}")


def _free_on(known: tuple[OccupancyGrid, str] | None) -> Callable[[F64], Bools]:
    """Return a function that tests which places (N, 2) are free on the map, or all without map."""

    def on_map(places_m: F64) -> Bools:
        if known is None:
            return np.ones(len(places_m), np.bool_)
        return np.asarray(known[0].at(places_m) == FREE, np.bool_)

    return on_map
