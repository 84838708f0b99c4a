"""A floor of the twin from what a recording or store shows: its map, else scans, else the way
driven.

surveyed = survey(Path("logs/run.mcap"))
surveyed.floor, surveyed.source, surveyed.notes
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from restock.arrays import F64, Bools
from restock.errors import ConfigError, RecordingError
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.containers.recording import Recording
from restock.ingest.profile.profile import Profile
from restock.ingest.propose.footprint import Footprint, footprint_of
from restock.replay.store.store import is_store
from restock.train.twin.floors.layout import Warehouse
from restock.train.twin.floors.occupancy_grid import FREE, UNKNOWN, OccupancyGrid, floor_of_grid
from restock.train.twin.floors.occupancy_map import read_grid
from restock.train.twin.survey.directions import along_walls
from restock.train.twin.survey.driven_corridor import driven_corridor
from restock.train.twin.survey.poses import Poses, candidate_poses, choose_poses
from restock.train.twin.survey.recorded_map import recorded_map
from restock.train.twin.survey.stored_drive import stored_drive

Source = Literal["map", "scans", "corridor"]
SOURCES: tuple[Source, ...] = get_args(Source)
MARGIN_M = 0.05  # beyond half the body, when it drives along a wall
TURN_MARGIN_M = 0.07  # beyond the circle around its corners, when it turns
STAND_IN = Footprint(0.7, 0.5, "the stand-in's: nothing says how large this robot is")
MOST_OFF = 0.5  # of the poses: a map that fewer lie on is not theirs


@dataclass(frozen=True)
class Surveyed:
    """A floor, what it was made from, and what a person should know of it."""

    floor: Warehouse
    grid: OccupancyGrid
    source: str  # in words
    by: Source
    footprint: Footprint
    poses: Poses | None = None
    notes: list[str] = field(default_factory=list)

    def facts(self) -> dict[str, Any]:
        """Plain values, for people and JSON."""
        cells = self.grid.occupancy
        values: dict[str, Any] = {
            "made_from": self.source,
            "frame": self.grid.frame or (self.poses.frame if self.poses else ""),
            "cell_m": round(self.grid.cell_m, 6),
            "unknown_share": round(float((cells == UNKNOWN).mean()), 3),
            "robot": f"{self.footprint.length_m:g} x {self.footprint.width_m:g} m,"
            f" {self.footprint.source}",
        }
        if self.poses is not None:
            free = self.grid.at(self.poses.places_m) == FREE
            values |= {
                "poses": f"{len(self.poses):,}, {self.poses.source}",
                "driven_m": round(self.poses.driven_m, 1),
                "poses_off_free_floor": round(float(1 - free.mean()), 3),
            }
        return values


def survey(
    path: Path,
    *,
    map_yaml: Path | None = None,
    by: Source | None = None,
    profile: Profile | None = None,
    footprint: Footprint | None = None,
    typestore: str | None = None,
) -> Surveyed:
    """The floor that a recording shows, or the recording of a store with the most rows.

    Args:
        path: of the recording or store.
        map_yaml: the map that its robot localised in, in place of one in the recording.
        by: what to make the floor from; None: the first of map, scans and corridor that is there.
        profile: says which topics are the pose and the scan, and how large the robot is; of a
            store, the one that it was ingested by if this is None.
        footprint: how large the robot is, before anything else that says it.
        typestore: as `open_recording` takes it.

    Raises:
        RecordingError: it cannot be read, or holds nothing that a floor can be made from.
        ConfigError: the map is none, or not of these poses; or no floor for this robot.
    """
    stored = None
    if is_store(path):
        stored = stored_drive(path)
        profile = profile or stored.profile
    file = path if stored is None else stored.recording
    if file is None and stored is not None:
        evidence = _Evidence(stored.poses, None if map_yaml is None else _of_yaml(map_yaml))
    else:
        assert file is not None
        with open_recording(file, typestore=typestore, salvage=True) as recording:
            evidence = _gather(recording, map_yaml, by, profile)
    notes = [] if stored is None else list(stored.notes)
    return _floor_of(evidence, by, footprint or evidence.footprint, path, notes)


@dataclass(frozen=True)
class _Evidence:
    """What a floor can be made from."""

    poses: Poses | None
    recorded: tuple[OccupancyGrid, str] | None  # a map, and where it is from
    footprint: Footprint | None = None


def _gather(
    recording: Recording, map_yaml: Path | None, by: Source | None, profile: Profile | None
) -> _Evidence:
    found = None
    if by in (None, "map"):
        found = recorded_map(recording) if map_yaml is None else _of_yaml(map_yaml)
    poses = choose_poses(
        candidate_poses(recording, profile), _placed(None if found is None else found[0])
    )
    if profile is not None:
        body = profile.task.body
        size = Footprint(body.length_m, body.width_m, f"of the profile {profile.name}")
        return _Evidence(poses, found, size)
    return _Evidence(poses, found, footprint_of(recording)[0])


def _of_yaml(path: Path) -> tuple[OccupancyGrid, str]:
    return read_grid(path), str(path)


def _floor_of(
    evidence: _Evidence,
    by: Source | None,
    footprint: Footprint | None,
    path: Path,
    notes: list[str],
) -> Surveyed:
    poses, body = evidence.poses, footprint or STAND_IN
    turn_m = float(np.hypot(body.length_m, body.width_m)) / 2 + TURN_MARGIN_M
    if evidence.recorded is not None:
        grid, source = evidence.recorded
        _check_frames(grid, poses, source, str(path), notes)
        grid, turn = along_walls(grid)
        how: Source = "map"
        if turn:
            notes.append(
                f"turned by {np.rad2deg(turn):.1f} degrees, so that the floor's axes run along its"
                " walls"
            )
    elif by == "map":
        raise RecordingError(
            "holds no map: no nav_msgs/OccupancyGrid but costmaps",
            where=str(path),
            remedy="give it as --map map.yaml, or leave out --by",
        )
    elif poses is None:
        raise RecordingError(
            "holds neither a map nor anything that says where the robot was",
            where=str(path),
            remedy="record /map, a localisation, odometry, or /tf and /tf_static; or give a"
            " map.yaml as the floor itself: `restock twin layout map.yaml`",
        )
    else:
        grid, source = driven_corridor(poses, turn_m), f"the way driven, by {poses.source}"
        how = "corridor"
    made = floor_of_grid(
        grid,
        name=path.stem,
        where=f"{path}, {source}",
        room_m=round(body.width_m / 2 + MARGIN_M, 3),
        turn_m=turn_m,
        visited_m=None if poses is None else poses.places_m,
    )
    return Surveyed(made.floor, made.grid, source, how, body, poses, notes + made.notes)


def _placed(grid: OccupancyGrid | None) -> Any:
    """A function that says which places (N, 2) are on free floor; anywhere, without a map."""

    def on_map(places_m: F64) -> Bools:
        if grid is None:
            return np.ones(len(places_m), np.bool_)
        return np.asarray(grid.at(places_m) == FREE, np.bool_)

    return on_map


def _check_frames(
    grid: OccupancyGrid, poses: Poses | None, source: str, where: str, notes: list[str]
) -> None:
    """That the poses lie on the map; says the share that does not.

    Raises:
        ConfigError: most do not.
    """
    if poses is None:
        notes.append(
            "nothing says where the robot was: missions start and end wherever there is room"
        )
        return
    found = grid.at(poses.places_m)
    on = grid.cells_at(poses.places_m)[1]
    off, walls = float((~on).mean()), float((on & (found > FREE)).mean())
    unknown = float((on & (found == UNKNOWN)).mean())
    said = f"of {len(poses):,} {poses.source}, {off:.0%} lie off the map, {walls:.0%} in walls" + (
        f" and {unknown:.0%} where it is unknown" if unknown >= 0.005 else ""
    )
    frames = ""
    if grid.frame and poses.frame and grid.frame != poses.frame:
        frames = f"; the map is in frame {grid.frame!r}, they are in {poses.frame!r}"
    if off + walls + unknown > MOST_OFF:
        raise ConfigError(
            f"{said}{frames}: it is not a map of these poses",
            where=f"{where}, {source}",
            remedy="give the map that they were localised in (--map map.yaml), a --profile whose"
            " pose is in the map's frame, or make the floor --by scans or --by corridor",
        )
    if off + walls + unknown >= 0.01 or frames:
        notes.append(said + frames)
