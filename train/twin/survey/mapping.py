"""Occupancy grids made from scans, or from the corridor that a robot drove in.

Each scan makes the cells that its beams pass less likely to be occupied, and those in which they
end more likely (log-odds, Elfes 1989). A scan changes a cell only once. Poses are used as they are,
without scan matching or loop closure. The agreement of scans is the share of beams that end within
one cell of a wall of the map made from all of them.

Without a lidar it is only known that the robot fitted where it was. So its outline and a margin
around its path are free, and everything beyond counts as a wall.

The boxes of a floor are parallel to its axes, but a map's walls may not be, so grids are turned.
Directions that differ by a right angle count as one: with angles a_i and weights w_i, the main
direction is the argument of the sum of w_i exp(4 i a_i), divided by four.

Scans are placed at the robot's pose at their time. These are left out and counted: scans without a
pose within a second before and after, and scans taken while turning fast, as a scan takes up to
.2 s, and poses are less exact then. Most scans of a robot that stands are left out, too. Beams
without a return (inf, NaN or 0) are ignored.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from restock.arrays import F64, Bools, Ints
from restock.ingest.containers.recording import Recording
from restock.ingest.containers.storage import Fields, Reduction, TopicInfo
from restock.ingest.decoding.columns import FieldColumn, Ragged, TopicColumns, offsets_of
from restock.ingest.profile.description import BASE_FRAMES
from restock.ingest.profile.profile import Profile
from restock.ingest.propose.footprint import Footprint, scans_of
from restock.ingest.propose.pose_choice import mount_of, transform_edges
from restock.ingest.propose.roles import KINDS, Kind, topics_for
from restock.ingest.steps.clocks import STAMP
from restock.ingest.steps.needs import angle_keys
from restock.train.twin.floors.layout import NEAR_RETURN_M, ON_WALL_M
from restock.train.twin.floors.occupancy_grid import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
    into_frame,
    out_of_frame,
)
from restock.train.twin.survey.poses import JUMP_M, Poses, Times, shared_clock

BEAMS = 360  # scans with twice as many beams or more are thinned to about this number
SCANS = 3000  # maximum number of scans that are used of a recording
MOVED_M, TURNED_RAD, WAITED_S = 0.05, 0.05, 2.0  # a scan is used after this much motion or time
FAST_RADPS = 0.6  # scans during faster turns are left out
_LIMITS = ("range_min", "range_max")  # fields that only some types of scan have


@dataclass(frozen=True)
class PlacedScans:
    """N scans in the frame of the poses: beams from `origin_m` to `hit_m`."""

    origin_m: F64  # (N, 2) positions of the lidar
    hit_m: list[F64]  # N arrays (B, 2) of the ends of beams
    order: list[Ints]  # N arrays (B,) of the beams' indices in their scan
    source: str
    notes: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.origin_m)


def placed_scans(
    recording: Recording, poses: Poses, profile: Profile | None, footprint: Footprint | None
) -> list[PlacedScans]:
    """Place a recording's lidar scans on the map, once per clock shared with the poses.

    Scans placed by header stamp come first, then scans placed by log time, as two computers' clocks
    may differ. The result is empty if there are no scans, or none can be placed.
    """
    fit = _scan_topic(recording, profile)
    if fit is None:
        return []
    topic, kind = fit[0].name, fit[1]
    leaves, ranges = set(recording.leaves(topic)), kind.fields["ranges_m"]
    angles = [kind.fields[key] for key in angle_keys(kind.fields)]
    if not {ranges, *angles} <= leaves:
        return []
    paths = [path for path in (*angles, *_LIMITS, STAMP) if path in leaves]
    read = recording.read({topic: paths}, {topic: Reduction((ranges,), partial(_thin, ranges))})
    columns = read.get(topic)
    if columns is None or not len(columns):
        return []
    notes: list[str] = []
    frame = scans_of(recording, [fit])[topic].frame
    turn, place = _mount(recording, frame, profile, footprint, notes)
    first, last = (np.asarray(columns.fields[path], np.float64) for path in angles)
    if "angle_max_rad" in kind.fields:  # then `last` is the last bearing: make it the step
        last = (last - first) / np.maximum(np.asarray(columns.fields["count"]) - 1, 1)
    times = Times.of(columns)
    clocks = [True, False] if shared_clock(poses.times, times) else [False]
    placed = [
        _place_scans(columns, poses, topic, (turn, place), (first, last), notes, by_stamp=by_stamp)
        for by_stamp in clocks
    ]
    return [scans for scans in placed if len(scans)]


def _place_scans(
    columns: TopicColumns,
    poses: Poses,
    topic: str,
    mount: tuple[F64, F64],
    bearings: tuple[F64, F64],
    notes: list[str],
    *,
    by_stamp: bool,
) -> PlacedScans:
    """Place the scans of a topic, with poses looked up by one clock.

    `mount` is the lidar's rotation and position; `bearings` are each scan's first bearing (N,) and
    its step from beam to beam (N,).
    """
    times, (turn, place), notes = Times.of(columns), mount, list(notes)
    pose, known = poses.at(times, by_stamp=by_stamp)
    chosen = _keyframes(pose, known, times.log_ns, topic, notes)
    numbers = {
        name: np.asarray(columns.fields[name], np.float64)
        for name in _LIMITS
        if name in columns.fields
    }
    ranges, beams = columns.fields["thinned"], columns.fields["beams"]
    origins, hits, order = np.zeros((len(chosen), 2)), [], []
    for index, row in enumerate(chosen.tolist()):
        reach = np.asarray(ranges[row], np.float64)
        beam = np.asarray(beams[row], np.int64)
        low = numbers["range_min"][row] if "range_min" in numbers else 0.0
        high = numbers["range_max"][row] if "range_max" in numbers else 0.0
        good = np.isfinite(reach) & (reach > max(low, 0.02))
        good &= reach < (high if high > 0 else np.inf)
        reach, beam = reach[good], beam[good]
        bearing = bearings[0][row] + beam * bearings[1][row]
        own = np.stack([reach * np.cos(bearing), reach * np.sin(bearing), 0 * reach], axis=-1)
        body = own @ turn.T + place
        cos, sin = np.cos(pose[row, 2]), np.sin(pose[row, 2])
        planar = np.array([[cos, sin], [-sin, cos]])
        origins[index] = place[:2] @ planar + pose[row, :2]
        hits.append(body[:, :2] @ planar + pose[row, :2])
        order.append(beam)
    clock = "header stamps" if by_stamp else "log time"
    return PlacedScans(origins, hits, order, f"scans of {topic} by {clock}", notes)


def _scan_topic(recording: Recording, profile: Profile | None) -> tuple[TopicInfo, Kind] | None:
    """Return the topic of the lidar's scans, and its type and fields; None if there is none."""
    if profile is not None:
        scan = profile.inputs.scan
        named = None if scan is None else recording.topics.get(scan.topic)
        if scan is None or named is None or not named.expected or named.skipped:
            return None
        return named, Kind(scan.type, scan.fields)
    found = topics_for(recording, KINDS["scan"])
    return min(found, key=lambda fit: "fake" in fit[0].name or "sim" in fit[0].name, default=None)


def _thin(path: str, fields: Fields) -> dict[str, FieldColumn]:
    """Thin scans to fewer than 2 BEAMS beams; return ranges, beam indices and beam counts."""
    ranges = fields[path]
    rows = [np.asarray(ranges[row], np.float32).ravel() for row in range(len(ranges))]
    kept = [np.arange(0, len(row), max(len(row) // BEAMS, 1)) for row in rows]
    offsets = offsets_of(np.array([len(beams) for beams in kept], np.int64))
    none = np.zeros(0, np.float32)
    values = np.concatenate([none, *(row[beams] for row, beams in zip(rows, kept, strict=True))])
    beams = np.concatenate([np.zeros(0, np.int32), *(one.astype(np.int32) for one in kept)])
    count = np.array([len(row) for row in rows], np.int64)
    return {
        "thinned": Ragged(values, offsets),
        "beams": Ragged(beams, offsets),
        "count": count,
    }


def _mount(
    recording: Recording,
    frame: str,
    profile: Profile | None,
    footprint: Footprint | None,
    notes: list[str],
) -> tuple[F64, F64]:
    """Return the lidar's rotation (3, 3) and position (3,) on the robot."""
    over = np.diag([1.0, -1.0, -1.0])
    scan = None if profile is None else profile.inputs.scan
    bases = [profile.frames.base] if profile is not None and profile.frames is not None else []
    edges = transform_edges(recording)
    for base in (*bases, *BASE_FRAMES):
        if found := mount_of(edges, frame, base):
            turn, place = found
            if scan is None or scan.upside_down == (turn[2, 2] < 0):
                return turn, place
            way = "upside down" if scan.upside_down else "upright"
            notes.append(f"the lidar is {way} by the profile's inputs.scan, but not by {frame}")
            return turn @ over, place
    ahead: float | None = None
    yaw: float | None = None
    if profile is not None:
        ahead, yaw = profile.task.body.lidar_x_m, profile.task.body.lidar_yaw_rad
    elif footprint is not None:
        ahead, yaw = footprint.lidar_x_m, footprint.lidar_yaw_rad
    left = 0.0
    if scan is not None and scan.lidar_at_m is not None:
        (ahead, left), yaw = scan.lidar_at_m, scan.lidar_yaw_rad or 0.0
    if ahead is None or yaw is None:
        notes.append(
            "the position of the lidar is unknown: it is assumed to be in the robot's middle, "
            "facing ahead"
        )
    turn = _turn(yaw or 0.0)
    if scan is not None and scan.upside_down:
        turn = turn @ over
    return turn, np.array([ahead or 0.0, left, 0.0])


def _turn(yaw_rad: float) -> F64:
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _keyframes(pose: F64, known: Bools, log_ns: Ints, topic: str, notes: list[str]) -> Ints:
    """Choose the scans to use: with a pose, not in fast turns, and after a move or some time."""
    rows = np.flatnonzero(known)
    if len(rows) < len(known):
        notes.append(
            f"{len(known) - len(rows):,} of {len(known):,} scans of {topic} have no pose within a"
            " second before and after: left out"
        )
    if not len(rows):
        return rows
    elapsed = np.maximum(np.diff(log_ns[rows]) * 1e-9, 1e-3)
    rate = np.abs(np.diff(pose[rows, 2])) / elapsed
    turning = np.maximum(np.append(rate, 0.0), np.append(0.0, rate)) > FAST_RADPS
    if turning.any():
        notes.append(
            f"{int(turning.sum()):,} scans taken while turning by more than {FAST_RADPS:g} rad/s:"
            " left out"
        )
    rows = rows[~turning]
    kept: list[int] = []
    for row in rows.tolist():
        if kept:
            moved = float(np.hypot(*(pose[row, :2] - pose[kept[-1], :2])))
            turned = abs(pose[row, 2] - pose[kept[-1], 2])
            waited = (log_ns[row] - log_ns[kept[-1]]) * 1e-9
            if moved < MOVED_M and turned < TURNED_RAD and waited < WAITED_S:
                continue
        kept.append(row)
    if len(kept) > SCANS:
        kept = [kept[k] for k in np.linspace(0, len(kept) - 1, SCANS).astype(int)]
    return np.array(kept, np.int64)


AGREEING = 0.25  # least share of the weight that must agree on a direction
MIN_TURN_RAD = np.deg2rad(3.0)
_SUB = 3  # points per axis at which a turned cell is sampled


def main_direction(angles_rad: F64, weights: F64) -> float:
    """Return the main direction in (-pi/4, pi/4], 0 if the directions do not agree on one."""
    total = float(weights.sum())
    if total <= 0:
        return 0.0
    sum_ = complex((weights * np.exp(4j * angles_rad)).sum())
    return float(np.angle(sum_) / 4) if abs(sum_) >= AGREEING * total else 0.0


def walls_direction(grid: OccupancyGrid) -> float:
    """Return the angle (rad) between a grid's walls and its axes."""
    walls = ndimage.gaussian_filter((grid.occupancy == OCCUPIED).astype(np.float32), 1.5)
    across_x, across_y = np.gradient(walls)
    return main_direction(np.arctan2(across_y, across_x), np.hypot(across_x, across_y))


def along_walls(grid: OccupancyGrid) -> tuple[OccupancyGrid, float]:
    """Return the grid with its axes along its walls, and the angle it was turned by (rad).

    A new cell is occupied if any part of it was, so that walls get no holes.
    """
    known = grid.occupancy != UNKNOWN
    if not known.any():
        return grid, 0.0
    columns, rows = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    part = grid.cut(int(columns[0]), int(columns[-1]) + 1, int(rows[0]), int(rows[-1]) + 1)
    turn = walls_direction(part)
    if abs(turn) < MIN_TURN_RAD:
        return grid, 0.0
    cell_m, size = part.cell_m, np.array(part.occupancy.shape) * part.cell_m
    corners = np.array([[0.0, 0.0], [1, 0], [0, 1], [1, 1]]) * size
    turned = into_frame(corners, (0.0, 0.0, turn))
    low, high = turned.min(axis=0), turned.max(axis=0)
    shape = np.ceil((high - low) / cell_m).astype(int)
    occupied, free = np.zeros((2, *shape), np.int16)
    indices = np.indices(tuple(shape), sparse=True)
    for dx in range(_SUB):
        for dy in range(_SUB):
            x, y = (
                np.broadcast_to(low[axis] + (indices[axis] + (d + 0.5) / _SUB) * cell_m, shape)
                for axis, d in enumerate((dx, dy))
            )
            places = out_of_frame(np.stack([x.ravel(), y.ravel()], axis=-1), (0.0, 0.0, turn))
            cells = np.floor(places / cell_m).astype(np.int64)
            inside = ((cells >= 0) & (cells < part.occupancy.shape)).all(axis=1)
            found = np.full(len(cells), UNKNOWN, np.int8)
            found[inside] = part.occupancy[tuple(cells[inside].T)]
            occupied += (found == OCCUPIED).reshape(shape)
            free += (found == FREE).reshape(shape)
    occupancy = np.full(tuple(shape), UNKNOWN, np.int8)
    occupancy[free > _SUB * _SUB / 2] = FREE
    occupancy[occupied > 0] = OCCUPIED
    corner = out_of_frame(out_of_frame(low[None], (0.0, 0.0, turn)), part.origin)[0]
    origin = (float(corner[0]), float(corner[1]), part.origin[2] + turn)
    return OccupancyGrid(occupancy, cell_m, origin, grid.frame), turn


CORRIDOR_CELL_M = 0.05
MARGIN_M = 0.25  # free floor around the circle in which the robot turns


def driven_corridor(poses: Poses, turn_m: float) -> OccupancyGrid:
    """Return the driven corridor as a grid, with its axes along the main driving directions.

    `turn_m` is the radius that the robot needs to turn.
    """
    step = np.diff(poses.places_m, axis=0)
    length = np.hypot(*step.T)
    yaw = main_direction(np.arctan2(step[:, 1], step[:, 0]), length * (length <= JUMP_M))
    places = into_frame(poses.places_m, (0.0, 0.0, yaw))
    way = way_between(places)
    reach = turn_m + MARGIN_M
    low = way.min(axis=0) - reach - 2 * CORRIDOR_CELL_M
    cells = np.floor((way - low) / CORRIDOR_CELL_M).astype(np.int64)
    shape = cells.max(axis=0) + 2 + int(reach / CORRIDOR_CELL_M) + 2
    seen = np.zeros(tuple(shape), np.bool_)
    seen[tuple(cells.T)] = True
    free = ndimage.distance_transform_edt(~seen) * CORRIDOR_CELL_M <= reach
    corner = out_of_frame(low[None], (0.0, 0.0, yaw))[0]
    occupancy = np.where(free, np.int8(FREE), np.int8(UNKNOWN))
    return OccupancyGrid(
        occupancy, CORRIDOR_CELL_M, (float(corner[0]), float(corner[1]), yaw), poses.frame
    )


def way_between(places_m: F64) -> F64:
    """Append points, under a cell apart, between successive places (N, 2), except across jumps."""
    parts = [places_m]
    length = np.hypot(*np.diff(places_m, axis=0).T)
    for index in np.flatnonzero((length > CORRIDOR_CELL_M / 2) & (length <= JUMP_M)):
        start, end = places_m[index], places_m[index + 1]
        count = int(length[index] / (CORRIDOR_CELL_M / 2)) + 1
        share = np.arange(1, count)[:, None] / count
        parts.append(start + share * (end - start))
    return np.concatenate(parts)


MIN_RETURNS, RETURNS = 50, 4000  # fewest lidar returns that are compared with a map, and most


def returns_on_walls(scans: PlacedScans, grid: OccupancyGrid) -> float | None:
    """Return the share of lidar returns within ON_WALL_M of an occupied cell of a map.

    Returns farther than NEAR_RETURN_M from the lidar are ignored. None if there are too few
    returns, or no walls.
    """
    nearby = [
        hit[np.hypot(*(hit - origin).T) < NEAR_RETURN_M]
        for origin, hit in zip(scans.origin_m, scans.hit_m, strict=True)
    ]
    returns = np.concatenate([np.zeros((0, 2)), *nearby])
    walls = _wall_middles(grid)
    if len(returns) < MIN_RETURNS or not len(walls):
        return None
    apart = cKDTree(walls).query(returns[:: len(returns) // RETURNS + 1])[0]
    return float((apart <= ON_WALL_M + grid.cell_m / 2).mean())


def _wall_middles(grid: OccupancyGrid) -> F64:
    """Return the centres (N, 2) of the occupied cells, in the map's frame."""
    cells = np.argwhere(grid.occupancy == OCCUPIED)
    return out_of_frame(np.asarray((cells + 0.5) * grid.cell_m, np.float64), grid.origin)


CELL_M = 0.05
REACH_M = 8.0  # beams are cut there, as farther points are less exact than a cell
HIT, MISS = 0.9, -0.5  # changes of a cell's log-odds if a beam ends in it, and if one passes it
MOST = 4.0  # largest absolute log-odds
FREE_BELOW, OCCUPIED_ABOVE = -0.9, 0.6
_APART = 4  # a wall's direction is measured between ends this many beams apart: less is noise
_WALL_STEP_M = 0.6  # if such ends are farther apart, they are not on one wall


def scan_map(
    scans: PlacedScans, driven_m: F64, room_m: float, frame: str, notes: list[str]
) -> tuple[OccupancyGrid, float]:
    """Build a map from scans, with its axes along the walls; also return the scans' agreement.

    Floor within `room_m` of the robot's path `driven_m` (N, 2) is free. The agreement is the share
    of beams that end within one cell of a wall.
    """
    yaw = main_direction(*_wall_directions(scans))
    turned = (0.0, 0.0, yaw)
    origins = into_frame(scans.origin_m, turned)
    hits = [into_frame(hit, turned) for hit in scans.hit_m]
    driven = into_frame(way_between(driven_m), turned)
    ends = [_cut_beams(origin, hit)[0] for origin, hit in zip(origins, hits, strict=True)]
    every = np.concatenate([origins, driven, *ends])
    low = every.min(axis=0) - 3 * CELL_M
    shape = tuple(np.ceil((every.max(axis=0) - low) / CELL_M).astype(int) + 3)
    odds, ended = _trace(origins, hits, low, shape)
    occupancy = np.full(shape, UNKNOWN, np.int8)
    occupancy[odds <= FREE_BELOW] = FREE
    walls = odds >= OCCUPIED_ABOVE
    walls &= ~_remove_speckles(walls, occupancy, notes)
    occupancy[walls] = OCCUPIED
    way = np.zeros(shape, np.bool_)
    way[tuple(_cells(driven, low).T)] = True
    occupancy[ndimage.distance_transform_edt(~way) * CELL_M <= room_m + CELL_M] = FREE
    wide = ndimage.binary_dilation(occupancy == OCCUPIED, np.ones((3, 3), np.bool_))
    share = float(ended[wide].sum() / max(ended.sum(), 1))
    corner = out_of_frame(low[None], turned)[0]
    origin = (float(corner[0]), float(corner[1]), yaw)
    return OccupancyGrid(occupancy, CELL_M, origin, frame), share


def _wall_directions(scans: PlacedScans) -> tuple[F64, F64]:
    """Return the directions (rad) and lengths (m) of pieces of wall between the ends of beams."""
    steps = []
    for hit, beam in zip(scans.hit_m, scans.order, strict=True):
        if len(hit) > _APART:
            beams = beam[_APART:] - beam[:-_APART]
            steps.append((hit[_APART:] - hit[:-_APART])[beams == beams.min()])
    step = np.concatenate([np.zeros((0, 2)), *steps])
    length = np.hypot(*step.T)
    on_wall = (length > 0) & (length < _WALL_STEP_M)
    return np.arctan2(step[on_wall, 1], step[on_wall, 0]), length[on_wall]


def _cut_beams(origin: F64, hit: F64) -> tuple[F64, F64, Bools]:
    """Cut beams at REACH_M; return their ends (B, 2), lengths (B,), and which were not cut (B,)."""
    along = hit - origin
    length = np.hypot(*along.T)
    share = np.minimum(1.0, REACH_M / np.maximum(length, 1e-9))
    return origin + along * share[:, None], length * share, np.asarray(length <= REACH_M)


def _cells(places: F64, low: F64) -> Ints:
    return np.floor((places - low) / CELL_M).astype(np.int64)


def _trace(origins: F64, hits: list[F64], low: F64, shape: tuple[int, ...]) -> tuple[F64, Ints]:
    """Return the log-odds (X, Y) that cells are occupied, and how many scans ended in each cell."""
    odds = np.zeros(shape)
    flat, ended = odds.reshape(-1), np.zeros(odds.size, np.int64)
    passed, stopped = np.zeros((2, odds.size), np.bool_)  # cells, for one scan
    for origin, hit in zip(origins, hits, strict=True):
        if not len(hit):
            continue
        ends, length, stops = _cut_beams(origin, hit)
        at = np.arange(0.0, float(length.max()), 0.7 * CELL_M)
        beam, step = np.nonzero(at[None, :] < length[:, None] - CELL_M / 2)
        way = origin + (ends - origin)[beam] * (at[step] / length[beam])[:, None]
        stopped[np.ravel_multi_index(tuple(_cells(ends[stops], low).T), shape)] = True
        passed[np.ravel_multi_index(tuple(_cells(way, low).T), shape)] = True
        stop = np.flatnonzero(stopped)
        passed[stop] = False
        pass_ = np.flatnonzero(passed)
        flat[pass_] = np.maximum(flat[pass_] + MISS, -MOST)
        flat[stop] = np.minimum(flat[stop] + HIT, MOST)
        ended[stop] += 1
        stopped[stop] = passed[pass_] = False
    return odds, ended.reshape(shape)


def _remove_speckles(walls: Bools, occupancy: np.ndarray, notes: list[str]) -> Bools:
    """Free single wall cells in free floor, such as a person's legs; return their mask (X, Y)."""
    neighbours = ndimage.convolve(walls.astype(np.int8), np.ones((3, 3), np.int8), mode="constant")
    alone = walls & (neighbours == 1)
    surrounded = ndimage.convolve(
        (occupancy == FREE).astype(np.int8), np.ones((3, 3), np.int8), mode="constant"
    )
    alone &= surrounded >= 7
    if alone.any():
        occupancy[alone] = FREE
        notes.append(f"{int(alone.sum()):,} single wall cells on free floor: left out")
    return np.asarray(alone, np.bool_)
