"""Find the aisles, crossings, goals and racks of a floor of which only the free cells are known.

An aisle segment is a straight, narrow, free corridor between racks or walls on two sides. Pallets
can close it, and the lidar can detect that. Corridors are searched along both axes. Racks are a
few rectangles, which may overlap, that cover the blocked cells. Only blocked cells beside free ones
must be covered: no robot reaches the cells behind them, and no lidar sees them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from restock.arrays import Bools, Ints
from restock.train.twin.floors.layout import AisleSegment, Axis, Rect, Warehouse, is_free

Cells = Bools  # (X, Y)
Box = tuple[int, int, int, int]  # first and last column, first and last row; lasts are exclusive

WIDTH_M = (0.7, 2.6)  # minimum and maximum width of a corridor
LENGTH_M = 1.8  # minimum length of a corridor: a pallet, and room before and behind it
EDGE_M = 0.15  # how far a corridor's side may wander: a map's racks are not straight
CROSSING_M = 2.0  # maximum length of a crossing beyond the end of an aisle segment
GOAL_ROOM_M = 0.5  # minimum distance from a goal to the nearest obstacle
GOALS = 200  # maximum number of goals
SPACING_M = 1.0  # side of the squares of which each gets one goal


@dataclass(frozen=True)
class _Corridor:
    """A corridor in cells: columns `first` to `last`, rows `low` to `high`; ends are exclusive."""

    first: int
    last: int
    low: int
    high: int


def cells_of(floor: Warehouse, cell_m: float) -> Cells:
    """Return the free cells (X, Y) of a floor: those whose centre is outside all racks."""
    x = (np.arange(round(floor.width_m / cell_m)) + 0.5) * cell_m
    y = (np.arange(round(floor.depth_m / cell_m)) + 0.5) * cell_m
    return is_free(floor, x[:, None], y[None, :])


def find_segments(free: Cells, cell_m: float) -> tuple[AisleSegment, ...]:
    """Find aisle segments in free cells; of overlapping ones, keep the longest.

    They are sorted by axis (x first), then from south to north and from west to east.
    """
    corridors: list[tuple[Axis, _Corridor]] = [("x", c) for c in _corridors(free, cell_m)]
    corridors += [("y", c) for c in _corridors(free.T, cell_m)]
    corridors.sort(key=lambda item: item[1].first - item[1].last)
    taken = np.zeros_like(free)
    kept: list[tuple[Rect, Axis]] = []
    for along, corridor in corridors:
        cells = taken if along == "x" else taken.T
        inside = cells[corridor.first : corridor.last, corridor.low : corridor.high]
        if inside.any():
            continue
        inside[:] = True
        edges = (corridor.first, corridor.low, corridor.last, corridor.high)
        box = Rect(*(round(edge * cell_m, 6) for edge in edges))
        kept.append((box if along == "x" else box.transposed, along))
    kept.sort(key=lambda item: (item[1], item[0].y_min, item[0].x_min))
    return tuple(
        AisleSegment(f"aisle_{index + 1}", index, area, along)
        for index, (area, along) in enumerate(kept)
    )


def _corridors(free: Cells, cell_m: float) -> list[_Corridor]:
    """Find corridors along the first axis: join free runs of cells in columns if sides agree."""
    low, high = WIDTH_M[0] / cell_m - 1e-6, WIDTH_M[1] / cell_m + 1e-6
    wander = EDGE_M / cell_m + 1e-6
    open_: list[tuple[_Corridor, int, int]] = []  # corridor, outermost low and high side so far
    closed: list[_Corridor] = []

    def close(corridor: _Corridor) -> None:
        length = corridor.last - corridor.first
        long_enough = max(LENGTH_M / cell_m, 1.2 * (corridor.high - corridor.low)) - 1e-6
        if length >= long_enough and corridor.high - corridor.low >= low:
            closed.append(corridor)

    for column in range(free.shape[0]):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], free[column], [False]])))
        runs = [(int(a), int(b)) for a, b in edges.reshape(-1, 2) if low <= b - a <= high]
        going = []
        for corridor, widest_low, widest_high in open_:
            match = next(
                (
                    run
                    for run in runs
                    if max(run[0], corridor.low) - min(run[0], widest_low) <= wander
                    and max(run[1], widest_high) - min(run[1], corridor.high) <= wander
                ),
                None,
            )
            if match is None:
                close(corridor)
                continue
            runs.remove(match)
            longer = _Corridor(
                corridor.first,
                column + 1,
                max(match[0], corridor.low),
                min(match[1], corridor.high),
            )
            going.append((longer, min(match[0], widest_low), max(match[1], widest_high)))
        open_ = going + [(_Corridor(column, column + 1, a, b), a, b) for a, b in runs]
    for corridor, _, _ in open_:
        close(corridor)
    return closed


def find_crossings(
    segments: tuple[AisleSegment, ...], free: Cells, cell_m: float
) -> tuple[Rect, ...]:
    """Find the free areas beyond the ends of aisle segments, where traffic comes from the side."""
    crossings: dict[Rect, None] = {}
    for segment in segments:
        turned = segment.along == "y"
        area = segment.lengthwise
        cells = free.T if turned else free
        low, high = round(area.y_min / cell_m), round(area.y_max / cell_m)
        for at, step in ((round(area.x_min / cell_m) - 1, -1), (round(area.x_max / cell_m), 1)):
            reach = 0
            while (
                reach * cell_m < CROSSING_M
                and 0 <= at + reach * step < cells.shape[0]
                and cells[at + reach * step, low:high].all()
            ):
                reach += 1
            if reach * cell_m < 0.8:
                continue
            ends = sorted((at - min(step, 0), at - min(step, 0) + reach * step))
            box = Rect(*(round(e * cell_m, 6) for e in (ends[0], low, ends[1], high)))
            crossings[box.transposed if turned else box] = None
    return tuple(crossings)


def find_goals(
    free: Cells, cell_m: float, room_m: float = GOAL_ROOM_M
) -> tuple[tuple[float, float], ...]:
    """Choose up to GOALS places, evenly over the free cells, `room_m` or more from obstacles."""
    room = ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1] * cell_m
    stride = max(round(SPACING_M / cell_m), 1)
    places = []
    for i in range(0, free.shape[0], stride):
        for j in range(0, free.shape[1], stride):
            window = room[i : i + stride, j : j + stride]
            best = np.unravel_index(int(window.argmax()), window.shape)
            if window[best] >= room_m:
                x, y = (i + best[0] + 0.5) * cell_m, (j + best[1] + 0.5) * cell_m
                places.append((round(float(x), 6), round(float(y), 6)))
    if len(places) > GOALS:
        kept = np.linspace(0, len(places) - 1, GOALS).astype(int)
        places = [places[index] for index in kept]
    return tuple(places)


def cover(blocked: Cells, limit: int) -> list[Box] | None:
    """Cover the blocked cells (X, Y) beside free ones with rectangles; None if over `limit`.

    Each rectangle grows from an uncovered cell, along one axis and then the other. Of the two
    orders of axes, the one that covers more is used.
    """
    seen = ndimage.binary_dilation(~blocked, np.ones((3, 3), np.bool_)) & blocked
    total = np.zeros((blocked.shape[0] + 1, blocked.shape[1] + 1), np.int64)
    total[1:, 1:] = blocked.cumsum(axis=0).cumsum(axis=1)
    left = seen.copy()
    boxes: list[Box] = []
    for i, j in np.argwhere(seen):
        if not left[i, j]:
            continue
        if len(boxes) == limit:
            return None
        grown = [_grow(total, int(i), int(j), order) for order in ((0, 1), (1, 0))]
        best = max(grown, key=lambda b: int(left[b[0] : b[1], b[2] : b[3]].sum()))
        left[best[0] : best[1], best[2] : best[3]] = False
        boxes.append(best)
    return boxes


def _grow(total: Ints, i: int, j: int, order: tuple[int, int]) -> Box:
    """Grow a rectangle of blocked cells from cell (i, j), along the axes in this order."""
    box = [i, i + 1, j, j + 1]
    for axis in order:
        for side, step in ((2 * axis, -1), (2 * axis + 1, 1)):
            end = total.shape[axis] - 1
            # Double the stride while the rectangle stays blocked, then halve it down to 1.
            stride = 1
            while stride:
                longer = box.copy()
                longer[side] += step * stride
                if 0 <= longer[side] <= end and _full(total, longer):
                    box = longer
                    stride *= 2
                else:
                    stride //= 2
    return box[0], box[1], box[2], box[3]


def _full(total: Ints, box: list[int]) -> bool:
    """Return whether every cell of a rectangle is blocked."""
    a, b, c, d = box
    count = total[b, d] - total[a, d] - total[b, c] + total[a, c]
    return bool(count == (b - a) * (d - c))
