"""A state lattice: the time to a goal from every pose near obstacles, and the fastest plan.

A plan on the map is a path for a point. A search over places and headings (a state lattice:
Pivtoraiko and Kelly, 2005) also finds whether the robot's outline fits through a gap, and with
which heading. Within a window around the obstacles, the states are cells of .1 m with 16 headings;
outside the window, they are the planner's cells. One Dijkstra tree from the goal holds both.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from restock import native
from restock.arrays import F64, Bools, Ints
from restock.train.twin.floors.layout import Warehouse
from restock.train.twin.floors.planner import CELL_M, smooth_plan

# The step in cells along each of 16 headings, counter-clockwise from east.
_QUARTER = [(1, 0), (2, 1), (1, 1), (1, 2)]
STEPS = [*_QUARTER, *((-y, x) for x, y in _QUARTER)]
STEPS += [(-x, -y) for x, y in STEPS]
HEADINGS_RAD = np.array([np.arctan2(y, x) % (2 * np.pi) for x, y in STEPS])
_ROUND_RAD = np.append(HEADINGS_RAD, 2 * np.pi)
TOUCH_M = 0.06  # a pose whose outline comes nearer to anything is not free
NEAR_M, NEAR_COST = 0.25, 2.0  # within NEAR_M, a step costs up to 1 + NEAR_COST times its time
ARC = 0.35  # extra time of a turn while driving, as a share of the same turn on the spot
OFF_COST_S = 0.5  # a state with no way to the goal has the nearest state's time, plus this per cell
_FIELD_M = 0.05  # cell size of the clearance field in which outlines are looked up
_NO_WAY_S = 60.0  # time to the goal assumed for all states of a heading if none has a way to it
BORDER_CELLS = 2  # width of the border along a window's sides where the floor continues
ENTER_RAD = 0.6  # turn charged for entering the window: outside it, turning costs nothing


@dataclass(frozen=True)
class Motion:
    """The outline and speeds of a robot that turns on the spot."""

    outline_m: F64  # (K, 2) points on its outline, x ahead of the pose
    ahead_mps: float
    back_mps: float  # 0 if the robot does not drive backwards
    turn_radps: float  # yaw rate of a turn on the spot


@cache
def rectangle(length_m: float, width_m: float, axle_x_m: float = 0.0, points: int = 5) -> F64:
    """Return points on a rectangle's outline, (4 * points - 4, 2), relative to its axle.

    The axle is `axle_x_m` ahead of the centre. Each side has `points` points, corners included.
    """
    side = np.linspace(-1.0, 1.0, points)[:-1]
    one = np.ones_like(side)
    corners = np.concatenate(
        [
            np.stack(pair, axis=-1)
            for pair in ((one, side), (-side, one), (-one, -side), (side, -one))
        ]
    )
    outline: F64 = corners * (length_m / 2, width_m / 2) - (axle_x_m, 0.0)
    outline.setflags(write=False)
    return outline


@dataclass(frozen=True)
class Window:
    """The cells of a floor that a lattice spans."""

    low: Ints  # (2,) first cell
    high: Ints  # (2,) last cell + 1
    floor: tuple[int, int]  # number of cells of the whole floor

    @classmethod
    def around(cls, places_m: F64, reach_m: float, floor: tuple[int, int]) -> Window:
        """Return the window of the floor within `reach_m` of places (K, 2), along both axes."""
        low = np.floor((places_m.min(axis=0) - reach_m) / CELL_M).astype(np.int64)
        high = np.ceil((places_m.max(axis=0) + reach_m) / CELL_M).astype(np.int64)
        return cls(np.maximum(low, 0), np.minimum(high, floor), floor)

    @property
    def shape(self) -> tuple[int, int]:
        nx, ny = (self.high - self.low).tolist()
        return nx, ny

    @property
    def cells(self) -> Ints:
        """Return the floor's indices (nx, ny) of the window's cells."""
        x, y = (np.arange(self.low[axis], self.high[axis]) for axis in range(2))
        return np.asarray(x[:, None] * self.floor[1] + y)

    @property
    def border(self) -> Bools:
        """Return a mask (nx, ny) of cells along the window's sides, except sides of the floor."""
        border = np.ones(self.shape, np.bool_)
        first = np.where(self.low > 0, BORDER_CELLS, 0)
        last = self.shape - np.where(self.high < self.floor, BORDER_CELLS, 0)
        border[first[0] : last[0], first[1] : last[1]] = False
        return border

    def covers(self, x_m: float, y_m: float) -> bool:
        """Return whether a place is in the window but not on its border."""
        (west, south), (east, north) = self._inner
        return west < x_m < east and south < y_m < north

    @cached_property
    def _inner(self) -> tuple[list[float], list[float]]:
        """Return the minimum and maximum x and y of the window without its border, in metres.

        They are infinite at sides of the floor.
        """
        margin = (BORDER_CELLS + 1) * CELL_M
        low = np.where(self.low == 0, -np.inf, self.low * CELL_M + margin)
        high = np.where(self.high == self.floor, np.inf, self.high * CELL_M - margin)
        return low.tolist(), high.tolist()


@dataclass(frozen=True)
class StateLattice:
    """The time to the goal from every pose in a window, and plans to the goal from anywhere."""

    window: Window
    times_s: F64  # (nx, ny, 17) at the centres of cells; the last heading repeats the first
    goal: tuple[float, float]
    _before: Ints  # (cells + states + 1,) the next node on the way to the goal; negative: no way

    def time_s(self, poses: F64) -> F64:
        """Return times (...) from poses (..., 3): x, y, heading, interpolated between states."""
        total, corner, shares = np.zeros(poses.shape[:-1]), 0, []
        for value, count in zip(self._place(poses), self.times_s.shape, strict=True):
            value = value.clip(0.0, count - 1.001)
            first = value.astype(np.int64)
            corner, share = corner * count + first, value - first
            shares.append((1.0 - share, share))
        for bits in np.ndindex(2, 2, 2):
            x, y, yaw = (both[bit] for both, bit in zip(shares, bits, strict=True))
            beside = np.ravel_multi_index(bits, self.times_s.shape)
            total += x * y * yaw * self.times_s.take(corner + beside)
        return total

    def plan(self, x_m: float, y_m: float, yaw_rad: float) -> F64 | None:
        """Return the plan (PLAN_POINTS, 2) from a pose; None if no way leads to the goal."""
        node = self._nearest(x_m, y_m, yaw_rad)
        if node < 0:
            return None
        way = []
        while node < len(self._before) - 1:
            way.append(self._middle(node))
            node = int(self._before[node])
        places = np.array([*way, self.goal])
        moved = np.any(np.diff(places, axis=0) != 0.0, axis=1)
        return smooth_plan(places[np.append(moved, True)])

    def _nearest(self, x_m: float, y_m: float, yaw_rad: float) -> int:
        """Return the nearest node, within .6 m of a pose, that has a way to the goal; else -1."""
        inside = self.window.covers(x_m, y_m)
        pose = np.array([x_m, y_m, yaw_rad])
        x, y, turned = (float(value) for value in self._place(pose))
        size = self.window.shape if inside else self.window.floor
        if not inside:
            x, y = x + float(self.window.low[0]), y + float(self.window.low[1])
        near = [
            np.arange(max(round(at) - 6, 0), min(round(at) + 7, count))
            for at, count in zip((x, y), size, strict=True)
        ]
        i, j = (part.ravel() for part in np.meshgrid(*near, indexing="ij"))
        nodes = i * size[1] + j
        if inside:
            nodes = (
                nodes * len(STEPS) + round(turned) % len(STEPS) + int(np.prod(self.window.floor))
            )
        gap = np.where(self._before[nodes] < 0, np.inf, np.hypot(i - x, j - y))
        return int(nodes[gap.argmin()]) if np.isfinite(gap).any() else -1

    def _place(self, poses: F64) -> list[F64]:
        """Convert poses (..., 3) to fractional indices of the window's cells and headings."""
        turned = np.interp(poses[..., 2] % (2 * np.pi), _ROUND_RAD, np.arange(len(_ROUND_RAD)))
        return [*(poses[..., a] / CELL_M - 0.5 - self.window.low[a] for a in range(2)), turned]

    def _middle(self, node: int) -> tuple[float, float]:
        nx, ny = self.window.floor
        if node < nx * ny:
            cell = np.array(divmod(node, ny))
        else:
            i, j, _ = np.unravel_index(node - nx * ny, (*self.window.shape, len(STEPS)))
            cell = self.window.low + np.array([i, j])
        x, y = ((cell + 0.5) * CELL_M).tolist()
        return x, y


def lattice_around(
    floor: Warehouse,
    graph: sparse.csr_matrix,
    boxes: F64,
    half_m: F64,
    goal: tuple[float, float],
    goal_radius_m: float,
    motion: Motion,
    window: Window,
) -> StateLattice:
    """Build a lattice over a window of a floor on which boxes (K, 2) of half sizes (K, 2) stand.

    `graph` (from `Planner.graph_around`) connects the floor's cells past the boxes, in metres,
    against the robot's direction. It is used outside the window.
    """
    room = _find_room(floor, boxes, half_m, window, motion.outline_m)
    free = room > TOUCH_M
    cost = 1.0 + NEAR_COST * np.clip(1.0 - room / NEAR_M, 0.0, 1.0)
    edges = [_outer_edges(graph, window, motion), _inner_edges(free, cost, motion, graph.shape[0])]
    edges += [
        _border_edges(free, window, motion, graph.shape[0]),
        _goal_edges(free, window, goal, goal_radius_m),
    ]
    from_, to, time_s = (np.concatenate(parts) for parts in zip(*edges, strict=True))
    nodes = graph.shape[0] + free.size + 1
    joined = sparse.csr_matrix((time_s, (to, from_)), shape=(nodes, nodes))
    times, before = csgraph.dijkstra(joined, indices=nodes - 1, return_predecessors=True)
    times = times[graph.shape[0] : -1].reshape(free.shape)
    filled = np.stack([_fill_unknown(times[..., k]) for k in range(len(STEPS))], axis=-1)
    filled = np.concatenate([filled, filled[..., :1]], axis=-1)
    before = before.astype(np.int64)
    before[-1] = nodes  # the root is at the goal: not negative, which would mean no way
    return StateLattice(window, filled, goal, before)


Edges = tuple[Ints, Ints, F64]  # start and end nodes in the robot's direction, and the seconds


def _outer_edges(graph: sparse.csr_matrix, window: Window, motion: Motion) -> Edges:
    """Return the edges between the floor's cells, except those within the window."""
    within = np.zeros(graph.shape[0], np.bool_)
    within[window.cells[~window.border]] = True
    way = graph.tocoo()
    kept = ~(within[way.row] | within[way.col])
    return way.col[kept], way.row[kept], way.data[kept] / motion.ahead_mps


def _border_edges(free: Bools, window: Window, motion: Motion, cells: int) -> Edges:
    """Return the edges between states and cells along the window's border."""
    enter_s = ENTER_RAD / motion.turn_radps
    at = np.flatnonzero(window.border[..., None] & free)
    cell = window.cells.ravel()[at // free.shape[2]]
    leave, enter = np.full(len(at), 1e-9), np.full(len(at), enter_s)
    return np.append(at + cells, cell), np.append(cell, at + cells), np.append(leave, enter)


def _goal_edges(
    free: Bools, window: Window, goal: tuple[float, float], goal_radius_m: float
) -> Edges:
    """Return the edges from states and cells at the goal to the root, which is the last node."""
    nx, ny = window.floor
    x, y = (CELL_M * (np.arange(window.low[a], window.high[a]) + 0.5) for a in range(2))
    near = np.hypot(x[:, None] - goal[0], y - goal[1]) < max(goal_radius_m - CELL_M, CELL_M)
    states = np.flatnonzero(near[..., None] & free) + nx * ny
    cell = min(int(goal[0] / CELL_M), nx - 1) * ny + min(int(goal[1] / CELL_M), ny - 1)
    at = np.append(states, cell)
    return at, np.full(len(at), nx * ny + free.size), np.full(len(at), 1e-9)


def _inner_edges(free: Bools, cost: F64, motion: Motion, cells: int) -> Edges:
    """Return the edges between the window's states; their nodes are numbered after the cells."""
    nx, ny, headings = free.shape
    index = np.arange(free.size).reshape(free.shape)
    edges: list[Edges] = []

    def join(from_: Ints, to: Ints, seconds: float, *, back: float = 0.0) -> None:
        both = free.flat[from_] & free.flat[to]
        from_, to = from_[both], to[both]
        weight = (cost.flat[from_] + cost.flat[to]) / 2
        edges.append((from_ + cells, to + cells, weight * seconds))
        if back:
            edges.append((to + cells, from_ + cells, weight * back))

    for k, (dx, dy) in enumerate(STEPS):
        length = CELL_M * float(np.hypot(dx, dy))
        start = index[max(-dx, 0) : nx - max(dx, 0), max(-dy, 0) : ny - max(dy, 0)]
        end = index[max(dx, 0) : nx - max(-dx, 0), max(dy, 0) : ny - max(-dy, 0)]
        ahead = length / motion.ahead_mps
        back = length / motion.back_mps if motion.back_mps else 0.0
        join(start[..., k].ravel(), end[..., k].ravel(), ahead, back=back)
        following = (k + 1) % headings
        angle = (HEADINGS_RAD[following] - HEADINGS_RAD[k]) % (2 * np.pi)
        turn = float(angle) / motion.turn_radps
        join(index[..., k].ravel(), index[..., following].ravel(), turn, back=turn)
        for to in (following, (k - 1) % headings):
            join(start[..., k].ravel(), end[..., to].ravel(), ahead + ARC * turn)
    from_, to_, time_s = (np.concatenate(parts) for parts in zip(*edges, strict=True))
    return from_, to_, time_s


def _find_room(floor: Warehouse, boxes: F64, half_m: F64, window: Window, outline_m: F64) -> F64:
    """Return the clearance (nx, ny, 16) of the outline at every state of the window."""
    pad = float(np.hypot(*outline_m.T).max()) + _FIELD_M
    x, y = (
        np.arange((window.low[a] + 0.5) * CELL_M - pad, window.high[a] * CELL_M + pad, _FIELD_M)
        for a in range(2)
    )
    at_x, at_y = (place[None] for place in np.meshgrid(x, y, indexing="ij"))
    (gap,) = near_gap(floor, np.hstack([boxes, half_m])[None], at_x, at_y, np.inf)
    count = window.shape
    per_cell = round(CELL_M / _FIELD_M)
    room = np.empty((*count, len(STEPS)))
    for k, heading in enumerate(HEADINGS_RAD):
        cos, sin = np.cos(heading), np.sin(heading)
        turned = outline_m @ np.array([[cos, sin], [-sin, cos]])
        least = np.full(count, np.inf)
        for i, j in np.unique(np.round((turned + pad) / _FIELD_M).astype(np.int64), axis=0):
            part = gap[i:, j:][: per_cell * count[0] : per_cell, : per_cell * count[1] : per_cell]
            np.minimum(least, part, out=least)
        room[..., k] = least
    return room


def _fill_unknown(times: F64) -> F64:
    """Fill unknown times (nx, ny) of one heading with the nearest known time plus a penalty."""
    known = np.isfinite(times)
    if not known.any():
        return np.full(times.shape, _NO_WAY_S)
    gap, (i, j) = ndimage.distance_transform_edt(~known, return_indices=True)
    filled: F64 = times[i, j] + OFF_COST_S * gap
    return filled


def near_gap(floor: Warehouse, own: F64, x: F64, y: F64, within_m: float) -> F64:
    """Return the distance from points (n, …) of n robots to the nearest rack, wall or `own` box.

    It is negative inside. Values below `within_m` are exact: boxes farther from all points of a
    robot are skipped, because a floor made from scans has hundreds. `own` (n, K, 4) are the centres
    and half sizes of boxes on each robot's floor.
    """
    room = np.minimum(np.minimum(x, floor.width_m - x), np.minimum(y, floor.depth_m - y))
    room = np.ascontiguousarray(room)
    racks = floor.rack_boxes
    if native.IS_USED:
        boxes = racks.ravel(), own.ravel(), room.ravel()
        native.compiled.near_boxes(x.ravel(), y.ravel(), *boxes, len(x), within_m)
        return room
    over, each = tuple(range(1, x.ndim)), (4, -1, *(1,) * (x.ndim - 1))
    low = np.stack([x.min(axis=over), y.min(axis=over)], axis=-1) - within_m  # (n, 2)
    high = np.stack([x.max(axis=over), y.max(axis=over)], axis=-1) + within_m
    for box in (*racks[:, None], *own.swapaxes(0, 1)):  # (1, 4) or (n, 4)
        middle, half = box[:, :2], box[:, 2:]
        rows = np.flatnonzero(((low < middle + half) & (high > middle - half)).all(axis=1))
        if len(rows):
            beside = np.broadcast_to(box, (len(x), 4))[rows].T.reshape(each)
            room[rows] = np.minimum(room[rows], box_gap(x[rows], y[rows], beside[:2], beside[2:]))
    return room


def box_gap(x: F64, y: F64, center: F64, half: F64) -> F64:
    """Return the distance from points to an axis-aligned box; negative inside."""
    dx, dy = np.abs(x - center[0]) - half[0], np.abs(y - center[1]) - half[1]
    outside = np.hypot(np.maximum(dx, 0), np.maximum(dy, 0))
    gap: F64 = outside + np.minimum(np.maximum(dx, dy), 0)
    return gap
