"""What a recording or store has that a floor can be made from: a map, poses, scans, its robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from restock.arrays import F64, Bools
from restock.errors import RestockError
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.containers.recording import Recording
from restock.ingest.profile.profile import Profile
from restock.ingest.propose.evidence.footprint import Footprint, footprint_of
from restock.replay.store.store import is_store
from restock.train.twin.floors.occupancy_grid import FREE, OccupancyGrid
from restock.train.twin.floors.occupancy_map import read_grid
from restock.train.twin.floors.placed import Drive
from restock.train.twin.survey.poses import (
    WELL_PLACED,
    Poses,
    candidate_poses,
    choose_poses,
)
from restock.train.twin.survey.recorded_map import recorded_map
from restock.train.twin.survey.scans import PlacedScans, placed_scans
from restock.train.twin.survey.stored_drive import stored_drive


@dataclass(frozen=True)
class Evidence:
    """What a floor can be made from; None where there is none."""

    poses: Poses | None
    known: tuple[OccupancyGrid, str] | None  # a map, and where it is from
    footprint: Footprint | None = None
    scans: list[PlacedScans] = field(default_factory=list)  # by one clock, and by another
    notes: list[str] = field(default_factory=list)
    others: Mapping[str, Drive] = field(default_factory=dict)  # of a store's other recordings


def gather(
    path: Path,
    *,
    stored_recording: str | None = None,
    map_yaml: Path | None,
    with_map: bool,
    with_scans: bool,
    profile: Profile | None,
    typestore: str | None,
) -> Evidence:
    """What a recording has, or one of a store: `stored_recording`, or that with the most rows.

    `with_map`: a map that is none is an error; without, it is left aside.

    Raises:
        RecordingError: it cannot be read, or its map is none.
        ConfigError: `map_yaml` is none.
        StoreError: the store is empty, or cannot be read.
    """
    notes: list[str] = []
    file, stored = path, None
    if is_store(path):
        stored = stored_drive(path, stored_recording)
        profile, notes = profile or stored.profile, stored.notes
        if stored.recording is None:
            known = None if map_yaml is None else (read_grid(map_yaml), str(map_yaml))
            size = _of_profile(profile)
            return Evidence(stored.poses, known, size, notes=notes, others=stored.others)
        file = stored.recording
    with open_recording(file, typestore=typestore, salvage=True) as recording:
        known = _map(recording, map_yaml, notes, needed=with_map)
        free_on = _free_on(known)
        poses = own = choose_poses(candidate_poses(recording, profile), free_on)
        if with_map and known and stored is not None and _lies_on(stored.everywhere, free_on):
            poses = stored.everywhere  # drives on one map are in one frame
        size = _of_profile(profile) or footprint_of(recording)[0]
        scans: list[PlacedScans] = []
        if with_scans and own is not None:
            scans = placed_scans(recording, own, profile, size)
    return Evidence(poses, known, size, scans, notes, {} if stored is None else stored.others)


def _lies_on(poses: Poses, free_on: Callable[[F64], Bools]) -> bool:
    return len(poses) > 0 and float(free_on(poses.places_m).mean()) >= WELL_PLACED


def _map(
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


def _of_profile(profile: Profile | None) -> Footprint | None:
    if profile is None:
        return None
    body = profile.task.body
    return Footprint(body.length_m, body.width_m, f"of the profile {profile.name}")


def _free_on(known: tuple[OccupancyGrid, str] | None) -> Callable[[F64], Bools]:
    """Which places (N, 2) are on free floor of a map; all of them, without one."""

    def on_map(places_m: F64) -> Bools:
        if known is None:
            return np.ones(len(places_m), np.bool_)
        return np.asarray(known[0].at(places_m) == FREE, np.bool_)

    return on_map
