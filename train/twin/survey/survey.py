"""A floor of the twin from a recording or store: its map, else its scans, else its corridor.

    surveyed = survey(Path("logs/run.mcap"))
    surveyed.floor, surveyed.source, surveyed.notes

The floor's zones (aisles and crossings, or quarters if it has no aisles) can be written as the
`[[zone]]` of a profile, so that logs from this map and episodes in the twin name the same places.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from restock.errors import ConfigError, RecordingError
from restock.ingest.decoding.definitions import choose_definitions
from restock.ingest.profile.profile import Profile
from restock.ingest.propose.footprint import Footprint
from restock.replay.store.store import is_store
from restock.toml import toml_value
from restock.train.twin.floors.layout import Rect, Warehouse
from restock.train.twin.floors.occupancy_grid import (
    FREE,
    UNKNOWN,
    OccupancyGrid,
    floor_of_grid,
    out_of_frame,
)
from restock.train.twin.survey.evidence import Evidence, gather
from restock.train.twin.survey.mapping import (
    PlacedScans,
    along_walls,
    driven_corridor,
    returns_on_walls,
    scan_map,
)
from restock.train.twin.survey.poses import Poses

Source = Literal["map", "scans", "corridor"]
MARGIN_M = 0.05  # distance between body and wall when the robot drives along it
TURN_MARGIN_M = 0.07  # distance from the body's corners to walls when the robot turns
STAND_IN = Footprint(0.7, 0.5, "the twin's default robot: the size of this robot is not known")
MIN_BODY_M = 0.15
MIN_SCANS = 8
AGREEING, WELL_AGREEING = 0.5, 0.8  # scans' agreement to use a map, and to try no other clock
CLOCKS_APART = 0.1  # another clock is used if its agreement is higher by this
MAX_OFF = 0.5  # if a larger share of the poses is off free floor, the map is not theirs

# Least share of lidar returns on a map's walls; with less, the poses are not in the map's frame.
# Other people's robots with their own maps have .58 (badly localised) to 1.0.
MIN_ON_WALLS, USUAL_ON_WALLS = 0.5, 0.7  # below the second, a note says so


@dataclass(frozen=True)
class Surveyed:
    """A surveyed floor, its source, and notes for the user."""

    floor: Warehouse
    grid: OccupancyGrid  # the floor was made from this
    by: Source
    source: str  # description of the source, for people
    footprint: Footprint
    poses: Poses | None = None
    notes: list[str] = field(default_factory=list)

    def facts(self) -> dict[str, Any]:
        """Return the survey as plain values, for people and JSON."""
        cells = self.grid.occupancy
        values: dict[str, Any] = {
            "made_by": self.by,
            "made_from": self.source,
            "frame": self.grid.frame or (self.poses.frame if self.poses else ""),
            "cell_m": round(self.grid.cell_m, 6),
            "unknown_share": round(float((cells == UNKNOWN).mean()), 3),
            "robot": f"{self.footprint.length_m:.2f} x {self.footprint.width_m:.2f} m,"
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
    recording: str | None = None,
    map_yaml: Path | None = None,
    by: Source | None = None,
    profile: Profile | None = None,
    footprint: Footprint | None = None,
    definitions: str | None = None,
) -> Surveyed:
    """Build the floor that a recording, or one recording of a store, shows.

    Args:
        path: of the recording or store.
        recording: of a store, its ID or the end of its path; None: the one with the most rows.
        map_yaml: the map that the robot localised in; replaces one in the recording.
        by: what to make the floor from; None: map, else scans, else the driven corridor.
        profile: defines the topics of pose and scan, and the robot's size; None: for a store, the
            profile that it was ingested with, else guesses.
        footprint: the robot's size; takes precedence over all other sources.
        definitions: as in `open_recording`.

    Raises:
        RecordingError: it cannot be read, or has nothing that a floor can be made from.
        ConfigError: the map is invalid or does not fit the poses, or the robot has no room.
        StoreError: the store is empty, cannot be read, or has no such recording.
    """
    if recording is not None and not is_store(path):
        raise ConfigError(
            "a recording can only be chosen from a store, and this is not one", where=str(path),
            remedy="leave it out, or give the store",
        )  # fmt: skip
    choose_definitions(definitions)  # refuse invalid definitions before anything is read
    evidence = gather(
        path,
        stored_recording=recording,
        map_yaml=map_yaml,
        with_map=by in (None, "map"),
        with_scans=by in (None, "scans"),
        profile=profile,
        definitions=definitions,
    )
    body, notes = footprint or evidence.footprint, list(evidence.notes)
    poses = evidence.poses
    how, grid, source = _choose_grid(evidence, by, body, str(path), notes)
    body = body or STAND_IN
    made = floor_of_grid(
        grid,
        name=path.stem if recording is None else f"{path.stem}: {Path(recording).stem}",
        where=f"{path}, {source}",
        room_m=round(body.width_m / 2 + MARGIN_M, 3),
        turn_m=_turn_m(body),
        visited_m=None if poses is None else poses.places_m,
    )
    notes += made.notes
    return Surveyed(with_zones(made.floor), made.grid, how, source, body, poses, notes)


def _choose_grid(
    evidence: Evidence, by: Source | None, body: Footprint | None, where: str, notes: list[str]
) -> tuple[Source, OccupancyGrid, str]:
    """Return the kind of source of the floor, its grid, and a text on the source."""
    poses = evidence.poses
    if by in (None, "map") and evidence.known is not None:
        grid, source = evidence.known
        _check_frames(grid, poses, source, where, notes)
        _check_walls(grid, evidence.scans, source, where, notes)
        grid, turn = along_walls(grid)
        if turn:
            notes.append(
                f"turned by {np.rad2deg(turn):.1f} degrees, so that the floor's axes run along its"
                " walls"
            )
        return "map", grid, source
    if by == "map":
        raise RecordingError(
            "contains no map: no nav_msgs/OccupancyGrid except costmaps",
            where=where,
            remedy="give a map as --map map.yaml, or leave out --by",
        )
    if poses is None:
        raise RecordingError(
            "contains neither a map nor the robot's pose",
            where=where,
            remedy="record /map, localisation, odometry, or /tf and /tf_static; or give a "
            "map.yaml as the floor: `restock twin layout map.yaml`",
        )
    usable = [scans for scans in evidence.scans if len(scans) >= MIN_SCANS]
    if usable:
        half_m = MIN_BODY_M / 2 if body is None else body.width_m / 2
        grid, agree, source, scan_notes = _map_scans(usable, poses, half_m + MARGIN_M)
        if agree >= AGREEING or by == "scans":
            notes += scan_notes
            return "scans", grid, f"{source}, by {poses.source}"
        notes.append(f"{scan_notes[-1]}: no map was made from them")
    elif by == "scans":
        raise RecordingError(
            "contains no scans that can be used: no LaserScan, or no poses at their times",
            where=where,
            remedy="leave out --by, or give the topics of pose and scan in a --profile",
        )
    elif evidence.scans:
        notes.append(f"only {len(evidence.scans[0])} scans have a pose, too few for a map")
    turn_m = _turn_m(body or STAND_IN)
    return "corridor", driven_corridor(poses, turn_m), f"the path driven, by {poses.source}"


def _map_scans(
    usable: list[PlacedScans], poses: Poses, room_m: float
) -> tuple[OccupancyGrid, float, str, list[str]]:
    """Map the scans by header stamps, or by log time if they agree clearly better that way.

    Returns the map, the scans' agreement (`scan_map`), their source, and notes.
    """
    best: tuple[OccupancyGrid, float, str, list[str]] | None = None
    for scans in usable:
        notes = list(scans.notes)
        grid, agree = scan_map(scans, poses.places_m, room_m, poses.frame, notes)
        notes.append(
            f"{len(scans):,} {scans.source} were used, and {agree:.0%} of their ends are within a "
            "cell of a wall of the combined map"
            + ("" if agree >= AGREEING else ": poses or clocks are off, do not trust this map")
        )
        if best is None or agree > best[1] + CLOCKS_APART:
            best = grid, agree, scans.source, notes
        if best[1] >= WELL_AGREEING:
            break
    assert best is not None
    return best


def _turn_m(body: Footprint) -> float:
    return float(np.hypot(body.length_m, body.width_m)) / 2 + TURN_MARGIN_M


def _check_frames(
    grid: OccupancyGrid, poses: Poses | None, source: str, where: str, notes: list[str]
) -> None:
    """Check that the poses lie on the map; note the share that does not.

    Raises:
        ConfigError: most poses are off the map's free floor.
    """
    if poses is None:
        notes.append("the robot's pose is not known: missions start and end wherever there is room")
        return
    found = grid.at(poses.places_m)
    on = grid.cells_at(poses.places_m)[1]
    off, walls = float((~on).mean()), float((on & (found > FREE)).mean())
    unknown = float((on & (found == UNKNOWN)).mean())
    shares = (
        f"of {len(poses):,} {poses.source}, {off:.0%} are off the map, {walls:.0%} in walls"
        + (f" and {unknown:.0%} where it is unknown" if unknown >= 0.005 else "")
    )
    frames = ""
    if grid.frame and poses.frame and grid.frame != poses.frame:
        frames = f"; the map is in frame {grid.frame!r}, the poses are in {poses.frame!r}"
    if off + walls + unknown > MAX_OFF:
        raise ConfigError(
            f"{shares}, and {int((found == FREE).sum()):,} on its free floor{frames}: the map does"
            " not belong to these poses",
            where=f"{where}, {source}",
            remedy="give the map that the robot localised in (--map map.yaml), or a --profile "
            "with a pose in the map's frame, or make the floor --by scans or --by corridor",
        )
    if off + walls + unknown >= 0.01 or frames:
        notes.append(shares + frames)


def _check_walls(
    grid: OccupancyGrid, scans: list[PlacedScans], source: str, where: str, notes: list[str]
) -> None:
    """Check that the lidar's returns are on the map's walls; note it if many are not.

    Raises:
        ConfigError: most returns are not on walls.
    """
    by_clock = [returns_on_walls(one, grid) for one in scans]
    agree = max((share for share in by_clock if share is not None), default=1.0)
    share = f"{agree:.0%} of the lidar's returns are on walls of the map"
    if agree < MIN_ON_WALLS:
        raise ConfigError(
            f"only {share}: it is not a map of this place, or the poses are in another frame",
            where=f"{where}, {source}",
            remedy="give the map that the robot localised in (--map map.yaml), or a --profile "
            "with a pose in the map's frame, or make the floor --by scans (--by map uses this map "
            "without this check)",
        )
    if agree < USUAL_ON_WALLS:
        notes.append(f"only {share}: the poses are imprecise, or the place has changed since")


MIN_SIDE_M = 2.0  # smaller floors are not divided into quarters
_QUARTERS = (("south", "west"), ("south", "east"), ("north", "west"), ("north", "east"))


def with_zones(floor: Warehouse) -> Warehouse:
    """Add a floor's crossings to its zones, or its quarters if it has no aisles."""
    if floor.segments:
        named = ((f"crossing_{k + 1}", area) for k, area in enumerate(floor.crossings))
        return replace(floor, cross_zones=tuple(named))
    if min(floor.width_m, floor.depth_m) < MIN_SIDE_M:
        return floor
    half_x, half_y = floor.width_m / 2, floor.depth_m / 2
    quarters = []
    for north, east in _QUARTERS:
        x, y = half_x * (east == "east"), half_y * (north == "north")
        quarters.append((f"{north}_{east}", Rect(x, y, x + half_x, y + half_y)))
    return replace(floor, cross_zones=tuple(quarters))


def profile_zones(floor: Warehouse) -> str:
    """Return a floor's zones as TOML for a profile: boxes in the map's frame, with their yaw."""
    yaw = float((floor.map_origin[2] + np.pi) % (2 * np.pi) - np.pi)
    lines: list[str] = []
    for name, area in floor.zones.items():
        x, y = out_of_frame(np.array([area.center]), floor.map_origin)[0].tolist()
        half_x, half_y = area.half_size
        box = [round(edge, 3) for edge in (x - half_x, y - half_y, x + half_x, y + half_y)]
        lines += ["[[zone]]", f"name = {toml_value(name)}", f"box_m = {toml_value(box)}"]
        lines += [f"yaw_rad = {round(yaw, 4)}"] if abs(yaw) > 1e-3 else []
        lines.append("")
    return "\n".join(lines)
