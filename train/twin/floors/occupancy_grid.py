"""Occupancy grids from any source, and the twin's floors made from them.

Occupancy is in percent, -1 for unknown, as in `nav_msgs/OccupancyGrid`. The floor is one connected
part of the free cells: the part that a robot drove in if its poses are known, else the largest.
All other cells, unknown ones included, are obstacles, which are merged into boxes. If that takes
too many boxes, cells are made coarser (never freer), and a note of the floor says so. The floor
keeps the grid's axes; `Warehouse.map_origin` leads back to the map's frame.

If the robot's poses are known, missions start and end at places where it really was, with room to
turn, and connected with each other. Each square of the floor keeps its place with the most room.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from restock.arrays import F64, Bools
from restock.errors import ConfigError
from restock.train.twin.floors.cells import (
    GOAL_ROOM_M,
    Cells,
    cover,
    find_crossings,
    find_goals,
    find_segments,
)
from restock.train.twin.floors.layout import (
    MAX_RACKS,
    MAX_SIDE_M,
    ROOM_M,
    WAY_M,
    Rect,
    Warehouse,
    bays,
)
from restock.train.twin.floors.planner import Planner

SPACING_M = 0.5  # side of a square: of the places in it, only the widest is kept
PLACES = 100  # maximum number of places
SAMPLE = 12  # approximate number of starts, and of goals, between which routes are measured
OFTEN = 0.1  # if fewer routes have a usual length (WAY_M), mission lengths are fitted to the floor
SHORTEST = 0.4  # shortest of the fitted mission lengths, as a share of the longest route
NEAR_M = 3.0  # if routes between visited places are shorter, missions go to other places, too
NEAREST_M = 0.5  # shorter routes are not used as missions


def find_places(
    free: Bools,
    reachable: Bools,
    cell_m: float,
    visited_m: F64,
    room_m: float,
    turn_m: float,
    notes: list[str],
) -> tuple[tuple[float, float], ...]:
    """Choose start and goal places among the visited ones (N, 2), in the floor's frame.

    `free` and `reachable` (X, Y) are masks of the floor's cells. A robot needs `room_m` around its
    middle to drive, and `turn_m` to turn. If fewer than two places fit, none is returned.
    """
    room = ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1] * cell_m
    cells = np.floor(visited_m / cell_m).astype(np.int64)
    on = ((cells >= 0) & (cells < free.shape)).all(axis=1)
    cells = cells[on]
    fits = reachable[tuple(cells.T)]
    wide = fits & (room[tuple(cells.T)] >= turn_m)
    if len(visited_m) and fits.sum() < 0.9 * len(visited_m):
        notes.append(
            f"{1 - fits.sum() / len(visited_m):.0%} of the poses are nearer to obstacles than the"
            f" {room_m:.2f} m that this robot needs, or in another part of the floor: no mission "
            "goes there. If the robot did drive there, it is smaller than in the profile: measure "
            "its [task.body]"
        )
    best: dict[tuple[int, int], tuple[float, tuple[float, float]]] = {}
    for i, j in np.unique(cells[wide], axis=0).tolist():
        x, y = (i + 0.5) * cell_m, (j + 0.5) * cell_m
        square = int(x / SPACING_M), int(y / SPACING_M)
        if square not in best or room[i, j] > best[square][0]:
            best[square] = float(room[i, j]), (round(x, 6), round(y, 6))
    places = [place for _, place in best.values()]
    if len(places) > PLACES:
        places = [places[k] for k in np.linspace(0, len(places) - 1, PLACES).astype(int)]
    if len(places) < 2:
        notes.append(
            f"the robot was at {len(places) or 'no'} place{'s'[: not places]} with room to turn: "
            "missions start and end wherever there is room"
        )
        return ()
    return tuple(places)


def with_missions(
    floor: Warehouse, elsewhere: tuple[tuple[float, float], ...], notes: list[str]
) -> Warehouse:
    """Return the floor with mission lengths that fit its places.

    If the visited places are all close together, missions also go to places in `elsewhere`.
    """
    made = fit_lengths(connected(floor))
    longest_m = made.way_m[1]
    if longest_m >= NEAR_M or not elsewhere:
        return made
    step = max(len(elsewhere) // PLACES, 1)
    wider = fit_lengths(connected(replace(floor, goals_m=floor.goals_m + elsewhere[::step])))
    if wider.way_m[1] < 1.5 * longest_m or not wider.starts_m:
        return made
    notes.append(
        f"the robot's places are at most {longest_m:.1f} m apart:"
        f" missions start there and also go to {len(elsewhere[::step])} places that it could"
        " have reached"
    )
    return wider


def fit_lengths(floor: Warehouse) -> Warehouse:
    """Return the floor with mission lengths that fit its routes, if few are of usual length."""
    planner = Planner(floor, trees_kept=1)
    starts = [segment.area.center for segment in floor.starts]
    starts = starts[:: max(len(starts) // SAMPLE, 1)]
    lengths, costs = [], []
    for x, y in floor.goals[:: max(len(floor.goals) // SAMPLE, 1)].tolist():
        for start in starts:
            away = planner.distance_m(*start, (x, y))
            if np.isfinite(away) and away > NEAREST_M:
                way = planner.plan(*start, (x, y))
                costs.append(away)
                lengths.append(float(np.hypot(*np.diff(way, axis=0).T).sum()))
    if not lengths:
        return replace(floor, way_m=(NEAREST_M, NEAREST_M + 0.5))
    (low, high), length, cost = WAY_M, np.array(lengths), np.array(costs)
    usual = (length >= low) & (length <= high) & (cost <= 1.3 * high)  # as in `draw_episode`
    if usual.mean() >= OFTEN:
        return floor
    longest = float(max(length.max(), cost.max() / 1.3))
    shortest = max(round(SHORTEST * float(length.max()), 1), NEAREST_M)
    return replace(floor, way_m=(shortest, max(round(longest + 0.1, 1), shortest + 0.5)))


def connected(floor: Warehouse) -> Warehouse:
    """Return the floor with only the goals and starts of the connected part with most goals."""
    planner = Planner(floor, trees_kept=1)
    part = planner.parts()
    goals = part[[planner.cell(x, y) for x, y in floor.goals_m]]
    largest = int(np.bincount(goals).argmax())
    starts = [place for place in floor.starts_m if part[planner.cell(*place)] == largest]
    kept = [place for place, of in zip(floor.goals_m, goals, strict=True) if of == largest]
    return replace(floor, goals_m=tuple(kept), starts_m=tuple(starts))


FREE, OCCUPIED, UNKNOWN = 0, 100, -1
COARSEST_M = 0.2
MAX_CELLS = 40_000_000  # checked in the header of a map's image, before its pixels take memory
_MANY_CELLS = 6_000_000  # larger grids are made coarser first: a floor has at most MAX_SIDE_M
_AROUND_M = 12.0  # a map that is too large is cut to this distance around the robot's places


@dataclass(frozen=True)
class OccupancyGrid:
    """The cells (X, Y) of a map: cell (i, j) is i-th along the grid's x and j-th along its y."""

    occupancy: NDArray[np.int8]  # (X, Y) percent, -1 unknown
    cell_m: float
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)  # x, y, yaw of its corner, in the map
    frame: str = ""

    @property
    def free(self) -> Cells:
        """Return which cells are free, (X, Y)."""
        return np.asarray(self.occupancy == FREE, np.bool_)

    def within(self, places_m: F64) -> F64:
        """Convert places (N, 2) from the map's frame to the grid's, with the grid's corner at 0."""
        return into_frame(places_m, self.origin)

    def at(self, places_m: F64) -> NDArray[np.int8]:
        """Return the occupancy (N,) at places (N, 2) in the map's frame; UNKNOWN off the grid."""
        cells, inside = self.cells_at(places_m)
        found = np.full(len(places_m), UNKNOWN, np.int8)
        found[inside] = self.occupancy[cells[inside, 0], cells[inside, 1]]
        return found

    def cells_at(self, places_m: F64) -> tuple[NDArray[np.int64], Bools]:
        """Return the cells (N, 2) at places (N, 2) in the map's frame, and which are on the map."""
        cells = np.floor(self.within(places_m) / self.cell_m).astype(np.int64)
        inside = ((cells >= 0) & (cells < self.occupancy.shape)).all(axis=1)
        return cells, np.asarray(inside, np.bool_)

    def cut(self, i0: int, i1: int, j0: int, j1: int) -> OccupancyGrid:
        """Return the grid of columns i0 to i1 and rows j0 to j1 (exclusive)."""
        corner = out_of_frame(np.array([[i0, j0]]) * self.cell_m, self.origin)[0]
        origin = (float(corner[0]), float(corner[1]), self.origin[2])
        return OccupancyGrid(self.occupancy[i0:i1, j0:j1], self.cell_m, origin, self.frame)

    def coarser(self) -> OccupancyGrid:
        """Merge four cells into one: free if all are, else occupied if any is, else unknown."""
        shape = self.occupancy.shape
        padded = np.pad(self.occupancy, [(0, size % 2) for size in shape], constant_values=UNKNOWN)
        four = padded.reshape(padded.shape[0] // 2, 2, padded.shape[1] // 2, 2)
        free = (four == FREE).all(axis=(1, 3))
        known = np.where((four > FREE).any(axis=(1, 3)), np.int8(OCCUPIED), np.int8(UNKNOWN))
        merged = np.where(free, np.int8(FREE), known)
        return OccupancyGrid(merged, 2 * self.cell_m, self.origin, self.frame)


@dataclass(frozen=True)
class GridFloor:
    """A floor made from a grid, the part of the grid that was used, and notes on changes to it."""

    floor: Warehouse
    grid: OccupancyGrid
    notes: list[str] = field(default_factory=list)


def into_frame(places_m: F64, origin: tuple[float, float, float]) -> F64:
    """Convert places (N, 2) from the map's frame to the frame with this origin (x, y, yaw)."""
    x, y, yaw = origin
    cos, sin = np.cos(yaw), np.sin(yaw)
    moved: F64 = (np.asarray(places_m, np.float64) - (x, y)) @ np.array([[cos, -sin], [sin, cos]])
    return moved


def out_of_frame(places_m: F64, origin: tuple[float, float, float]) -> F64:
    """Convert places (N, 2) from the frame with this origin (x, y, yaw) to the map's frame."""
    x, y, yaw = origin
    cos, sin = np.cos(yaw), np.sin(yaw)
    moved: F64 = np.asarray(places_m, np.float64) @ np.array([[cos, sin], [-sin, cos]]) + (x, y)
    return moved


def floor_of_grid(
    grid: OccupancyGrid,
    *,
    name: str,
    where: str,
    room_m: float = ROOM_M,
    turn_m: float = GOAL_ROOM_M,
    visited_m: F64 | None = None,
) -> GridFloor:
    """Build a floor from a grid: the part the robot was in, or the largest part that it fits in.

    Args:
        name: name of the floor.
        where: name of the grid in errors.
        room_m: minimum distance from a robot's middle to obstacles.
        turn_m: the same distance for turning on the spot.
        visited_m: places (N, 2), in the map's frame, where the robot drove: missions start and end
            there.

    Raises:
        ConfigError: no such part exists, it is too large, or obstacles are too ragged for boxes.
    """
    notes: list[str] = []
    grid = _limit_size(grid, where, visited_m, notes)
    drivable = drivable_part(grid.free, grid.cell_m, room_m, _visited_cells(grid, visited_m))
    if not drivable.any():
        raise ConfigError(_explain_no_room(grid, room_m), where=where, remedy=_NO_ROOM_REMEDY)
    # The part also has the free cells around those that the robot's middle can be in.
    near = ndimage.distance_transform_edt(~drivable) * grid.cell_m <= 1.5 * room_m + grid.cell_m
    free = grid.free & near
    columns, rows = np.flatnonzero(free.any(axis=1)), np.flatnonzero(free.any(axis=0))
    window = columns[0], columns[-1] + 1, rows[0], rows[-1] + 1
    grid, free = grid.cut(*map(int, window)), free[window[0] : window[1], window[2] : window[3]]
    free, cell_m, racks = _cover_obstacles(free, grid.cell_m, where, notes)
    reachable = drivable_part(free, cell_m, room_m, _visited_cells(grid, visited_m, cell_m))
    if not reachable.any():
        raise ConfigError(_explain_no_room(grid, room_m), where=where, remedy=_NO_ROOM_REMEDY)
    segments = tuple(
        segment
        for segment in find_segments(free, cell_m)
        if _holds(reachable, cell_m, segment.area.center)
    )
    places: tuple[tuple[float, float], ...] = ()
    if visited_m is not None:
        places = find_places(free, reachable, cell_m, grid.within(visited_m), room_m, turn_m, notes)
    if visited_m is None:
        elsewhere = find_goals(free & reachable, cell_m, room_m=turn_m)
    else:
        there = find_goals(free, cell_m, room_m=turn_m)
        elsewhere = tuple(place for place in there if _holds(reachable, cell_m, place))
    elsewhere += tuple(bay for bay in bays(segments) if _holds(reachable, cell_m, bay))
    if not places and not elsewhere:
        raise ConfigError(
            f"there is no place for a goal: the robot needs {turn_m:.2f} m around its middle to"
            " turn",
            where=where,
            remedy="check [task.body] in the profile, or give a larger map",
        )
    floor = Warehouse(
        width_m=round(free.shape[0] * cell_m, 6),
        depth_m=round(free.shape[1] * cell_m, 6),
        racks=racks,
        segments=segments,
        goals_m=places or elsewhere,
        crossings=find_crossings(segments, free, cell_m),
        name=name,
        map_origin=grid.origin,
        room_m=room_m,
        starts_m=places,
    )
    if visited_m is not None:
        floor = with_missions(floor, elsewhere if places else (), notes)
    return GridFloor(floor, grid, notes)


_NO_ROOM_REMEDY = (
    "check [task.body] in the profile, and mode, negate and the thresholds in map.yaml"
)


def _explain_no_room(grid: OccupancyGrid, room_m: float) -> str:
    free, size = int(grid.free.sum()), grid.occupancy.size
    unknown = int((grid.occupancy == UNKNOWN).sum())
    what = f"has no free place that a robot fits in: {free:,} of {size:,} cells are free"
    if unknown:
        what += f", {unknown:,} unknown"
    if free:
        room = ndimage.distance_transform_edt(np.pad(grid.free, 1)).max() * grid.cell_m
        what += (
            f"; the widest place leaves {room:.2f} m around a robot's middle, which needs"
            f" {room_m:.2f} m"
        )
    return what


def _limit_size(
    grid: OccupancyGrid, where: str, visited_m: F64 | None, notes: list[str]
) -> OccupancyGrid:
    """Cut a grid that is too large for a floor to where the robot drove, and make it coarser."""
    size = grid.occupancy.shape
    if visited_m is not None and len(visited_m) and max(size) * grid.cell_m > MAX_SIDE_M:
        cells, inside = grid.cells_at(visited_m)
        if inside.any():
            around = round(_AROUND_M / grid.cell_m)
            low = np.maximum(cells[inside].min(axis=0) - around, 0)
            high = np.minimum(cells[inside].max(axis=0) + 1 + around, size)
            before = grid
            grid = grid.cut(int(low[0]), int(high[0]), int(low[1]), int(high[1]))
            notes.append(
                f"cut from {_extent(before)} to {_extent(grid)}: {_AROUND_M:g} m around where the"
                " robot drove"
            )
    fine = grid
    while grid.occupancy.size > _MANY_CELLS and grid.cell_m <= COARSEST_M / 2:
        grid = grid.coarser()
    if grid is not fine:
        notes.append(f"{fine.occupancy.size:,} cells were made coarser, {grid.cell_m:g} m each")
    if grid.occupancy.size > _MANY_CELLS:
        raise ConfigError(
            f"its {fine.occupancy.size:,} cells are {_extent(fine)}: a floor has a side of at most"
            f" {MAX_SIDE_M:g} m",
            where=where,
            remedy="cut the map to the part that the robots drive in",
        )
    return grid


def _extent(grid: OccupancyGrid) -> str:
    sides = (f"{size * grid.cell_m:.0f}" for size in grid.occupancy.shape)
    return " x ".join(sides) + " m"


def _visited_cells(
    grid: OccupancyGrid, visited_m: F64 | None, cell_m: float | None = None
) -> NDArray[np.int64] | None:
    """Return the cells (N, 2), of size `cell_m`, that the robot was in, even cells off the grid."""
    if visited_m is None:
        return None
    return np.floor(grid.within(visited_m) / (cell_m or grid.cell_m)).astype(np.int64)


def _cover_obstacles(
    free: Cells, cell_m: float, where: str, notes: list[str]
) -> tuple[Cells, float, tuple[Rect, ...]]:
    """Cover obstacles with at most MAX_RACKS boxes, on coarser (never freer) cells if needed."""
    fine, fine_m = free, cell_m
    while cell_m <= COARSEST_M:
        boxes = cover(~free, MAX_RACKS)
        if boxes is not None:
            edges = [(a, c, b, d) for a, b, c, d in boxes]
            racks = tuple(Rect(*(round(e * cell_m, 6) for e in edge)) for edge in edges)
            if cell_m > fine_m:
                lost = fine.sum() * fine_m**2 - free.sum() * cell_m**2
                notes.append(
                    f"simplified to {len(racks)} boxes: cells of {cell_m:g} m instead of"
                    f" {fine_m:g} m, which takes {lost:.1f} of {fine.sum() * fine_m**2:.1f} m2"
                    " of free floor"
                )
            return free, cell_m, racks
        padded = np.pad(free, [(0, size % 2) for size in free.shape])
        pairs = padded.reshape(padded.shape[0] // 2, 2, padded.shape[1] // 2, 2)
        free = np.asarray(pairs.all(axis=(1, 3)), np.bool_)
        cell_m *= 2
    raise ConfigError(
        f"its obstacles take more than {MAX_RACKS} boxes, even at {cell_m / 2:g} m a cell",
        where=where,
        remedy="cut the map, or clean it of speckles",
    )


def drivable_part(
    free: Cells, cell_m: float, room_m: float, visited: NDArray[np.int64] | None = None
) -> Cells:
    """Return one connected part of the cells that a robot's centre can be in.

    It is the part with most of the cells `visited` (N, 2), or the largest part if none has any.
    """
    room = ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1] * cell_m
    parts, count = ndimage.label(room >= room_m)
    if not count:
        return np.zeros_like(free)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    if visited is not None and len(visited):
        inside = ((visited >= 0) & (visited < free.shape)).all(axis=1)
        held = np.bincount(parts[tuple(visited[inside].T)], minlength=len(sizes))
        held[0] = 0
        if held.any():
            sizes = held
    return np.asarray(parts == int(np.argmax(sizes)), np.bool_)


def _holds(cells: Cells, cell_m: float, place: tuple[float, float]) -> bool:
    i, j = (min(int(at / cell_m), size - 1) for at, size in zip(place, cells.shape, strict=True))
    return bool(cells[i, j])
