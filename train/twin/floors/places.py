"""Where missions start and end on a floor that a robot drove on, and how long their ways are.

A place is one where the robot really was, with room to turn, and connected with the others. Of
each square of the floor the roomiest such place is kept.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy import ndimage

from restock.arrays import F64, Bools
from restock.train.twin.floors.layout import WAY_M, Warehouse
from restock.train.twin.floors.planner import Planner

SPACING_M = 0.5
PLACES = 100
SAMPLE = 12  # starts and goals at most, whose ways are measured
OFTEN = 0.1  # of the pairs of places: so many are a usual mission apart on a large floor
SHORTEST = 0.4  # of the longest way on a small one
NEAR_M = 3.0  # places that are no further apart give short missions alone
NEAREST_M = 0.5  # a way shorter than this is no mission


@dataclass(frozen=True)
class Places:
    """Places (x, y) in the floor's frame, and what is to be said of them."""

    places_m: tuple[tuple[float, float], ...] = ()
    notes: list[str] = field(default_factory=list)


def find_places(
    free: Bools, reachable: Bools, cell_m: float, visited_m: F64, room_m: float, turn_m: float
) -> Places:
    """The places among those visited (N, 2), in the floor's frame.

    `free` and `reachable` (X, Y) are the floor's cells, `room_m` is what driving needs around a
    robot's middle, `turn_m` what turning does. Without two places there are none.
    """
    room = ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1] * cell_m
    cells = np.floor(visited_m / cell_m).astype(np.int64)
    on = ((cells >= 0) & (cells < free.shape)).all(axis=1)
    cells = cells[on]
    fits = reachable[tuple(cells.T)]
    wide = fits & (room[tuple(cells.T)] >= turn_m)
    notes = []
    if len(visited_m) and fits.sum() < 0.9 * len(visited_m):
        notes.append(
            f"{1 - fits.sum() / len(visited_m):.0%} of the poses are nearer to obstacles than the"
            f" {room_m:.2f} m that this robot needs, or in another part of the floor: no mission "
            "goes there. If the robot did drive there, it is smaller than in the profile: give "
            "--footprint LxW"
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
        return Places((), notes)
    return Places(tuple(places), notes)


def with_missions(
    floor: Warehouse, elsewhere: tuple[tuple[float, float], ...], notes: list[str]
) -> Warehouse:
    """The floor with the lengths of its missions; where the places that the robot was at are all
    near to each other, missions go from them to others, too."""
    near = connected(floor)
    ways = _ways(near)
    made = _long_as(near, *ways)
    longest_m = made.way_m[1] if len(ways[0]) else 0.0
    if longest_m >= NEAR_M or not elsewhere:
        return made
    step = max(len(elsewhere) // PLACES, 1)
    wider = missions_way(connected(replace(floor, goals_m=floor.goals_m + elsewhere[::step])))
    if wider.way_m[1] < 1.5 * longest_m or not wider.starts_m:
        return made
    notes.append(
        f"the places that the robot was at are at most {longest_m or NEAREST_M:.1f} m apart:"
        f" missions start there and also go to {len(elsewhere[::step])} places where it could have"
        " been"
    )
    return wider


def missions_way(floor: Warehouse) -> Warehouse:
    """The floor with lengths of missions that its places allow: the usual ones where they do."""
    return _long_as(floor, *_ways(floor))


def _ways(floor: Warehouse) -> tuple[F64, F64]:
    """Lengths and costs (N,) in metres of ways between its places, of those that are missions."""
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
    return np.array(lengths), np.array(costs)


def _long_as(floor: Warehouse, length: F64, cost: F64) -> Warehouse:
    """The floor with missions of these lengths, where the usual ones are not among them."""
    if not len(length):
        return floor
    low, high = WAY_M
    usual = (length >= low) & (length <= high) & (cost <= 1.3 * high)  # as episodes are drawn
    if usual.mean() >= OFTEN:
        return floor
    longest = float(max(length.max(), cost.max() / 1.3))
    shortest = max(round(SHORTEST * float(length.max()), 1), NEAREST_M)
    return replace(floor, way_m=(shortest, max(round(longest + 0.1, 1), shortest + 0.5)))


def connected(floor: Warehouse) -> Warehouse:
    """The floor with those goals and starts alone that a robot gets to from most of the others."""
    planner = Planner(floor, trees_kept=1)
    part = planner.parts()
    goals = part[[planner.cell(x, y) for x, y in floor.goals_m]]
    largest = int(np.bincount(goals).argmax())
    starts = [place for place in floor.starts_m if part[planner.cell(*place)] == largest]
    kept = [place for place, of in zip(floor.goals_m, goals, strict=True) if of == largest]
    return replace(floor, goals_m=tuple(kept), starts_m=tuple(starts))
