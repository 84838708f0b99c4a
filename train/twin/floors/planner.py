"""The robot's navigation stack: plans on the known map of racks and walls.

Pallets, people and wet floors are not on the map. If the lidar shows that an aisle is wholly
blocked (`BlockFinder`), the aisle is closed on the grid and the robot replans. Plans are shortest
paths on a .1 m grid whose cells cost more near racks. Each goal and set of closures has a cached
Dijkstra tree; a plan is read off the tree, smoothed and resampled. One-way rules are directed
edges. A robot that has no way to its goal under these rules, behind a block, may break them.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph

from restock.arrays import F64, Bools, Ints, stacked
from restock.train.twin.floors.layout import (
    HEADINGS,
    ROOM_M,
    Warehouse,
    box_distance,
    from_walls_m,
)

CELL_M = 0.1
PLAN_POINTS = 48
WIDE_M = 0.85  # for the stand-in, a cell with at least this clearance costs just its length
NEAR_COST = 3.0  # a cell whose clearance is the floor's `room_m` costs 1 + this times its length
_TREES_KEPT = 2048
_TREES_KEPT_BYTES = 1 << 29  # limit for the caches of all planners of a `planners` call

Closure = tuple[int, int]  # aisle segment, and the position along it in steps of CLOSURE_STEP_M
CLOSURE_STEP_M = 0.3


@dataclass
class Planner:
    """The planner of one warehouse, shared by all environments; its only state is a cache."""

    warehouse: Warehouse
    trees_kept: int = _TREES_KEPT
    _trees: OrderedDict[tuple[int, tuple[Closure, ...]], tuple[F64, NDArray[np.int32]]] = field(
        default_factory=OrderedDict
    )

    def __post_init__(self) -> None:
        self.shape = (
            round(self.warehouse.width_m / CELL_M),
            round(self.warehouse.depth_m / CELL_M),
        )
        self._clearance_m = from_walls_m(self.warehouse, *_cell_middles(self.shape))
        self._graph = self._build_graph(self._clearance_m)
        self._rule_free = (
            Planner(replace(self.warehouse, one_way=()), max(self.trees_kept // 8, 8))
            if self.warehouse.one_way
            else None
        )

    def plan(
        self,
        x_m: float,
        y_m: float,
        goal: tuple[float, float],
        closures: Sequence[Closure] = (),
    ) -> F64:
        """Return the plan from a place to a goal, (PLAN_POINTS, 2), first point near the place.

        If closures leave no way, the last ones are ignored until there is a way: a robot for which
        everything is closed would stand still for ever. If one-way rules leave no way from a free
        place, the plan ignores them.
        """
        cell = self.cell(x_m, y_m)
        if self._rule_free is not None and self._clearance_m.flat[cell] >= self.warehouse.room_m:
            ruled = self._tree(self.cell(*goal), tuple(sorted(closures)))[0]
            if not np.isfinite(ruled[cell]):
                return self._rule_free.plan(x_m, y_m, goal, closures)
        for kept in range(len(closures), -1, -1):
            distance, before = self._tree(self.cell(*goal), tuple(sorted(closures[:kept])))
            start = cell if np.isfinite(distance[cell]) else self._nearest(cell, distance)
            if start >= 0:
                break
        return self._read_off(start, before, goal)

    def plan_around(
        self,
        x_m: float,
        y_m: float,
        goal: tuple[float, float],
        boxes: F64,
        half_m: tuple[float, float],
    ) -> F64 | None:
        """Plan past boxes (see `graph_around`), uncached; None if there is no way.

        Without boxes the plan is that of `plan`.
        """
        if not len(boxes):
            return self.plan(x_m, y_m, goal)
        graph = self.graph_around(x_m, y_m, goal, boxes, half_m)
        distance, before = csgraph.dijkstra(
            graph, indices=self.cell(*goal), return_predecessors=True
        )
        cell = self.cell(x_m, y_m)
        start = cell if np.isfinite(distance[cell]) else self._nearest(cell, distance)
        return self._read_off(start, before, goal) if start >= 0 else None

    def graph_around(
        self,
        x_m: float,
        y_m: float,
        goal: tuple[float, float],
        boxes: F64,
        half_m: tuple[float, float],
    ) -> sparse.csr_matrix:
        """Return the graph of cells for driving past boxes that are not on the map.

        The boxes (K, 3) are x, y, yaw, with half sizes `half_m`. Edges run against the robot's
        direction; their weights are cost-weighted metres.

        The graph is for drivers that see more than the robot does, and is not cached. As in `plan`,
        it has no one-way rules if they and the boxes leave no way to the goal.
        """
        clearance = self._clearance_m
        for x, y, yaw in boxes:
            gap = box_distance(*_cell_middles(self.shape), (x, y), half_m, yaw)
            clearance = np.minimum(clearance, gap)
        graph = self._build_graph(clearance)
        cell = self.cell(x_m, y_m)
        if self._rule_free is None or clearance.flat[cell] < self.warehouse.room_m:
            return graph
        distance = csgraph.dijkstra(graph, indices=self.cell(*goal))
        return graph if np.isfinite(distance[cell]) else self._rule_free._build_graph(clearance)

    def _read_off(self, start: int, before: NDArray[np.int32], goal: tuple[float, float]) -> F64:
        """Follow the tree from a cell to the goal; return the path smoothed and resampled."""
        cells, following = [start], before.data  # a memoryview: its items are Python ints
        while (cell := following[cells[-1]]) >= 0:
            cells.append(cell)
        way = stacked(*np.divmod(np.array(cells), self.shape[1])) * CELL_M + CELL_M / 2
        way[-1] = goal
        return smooth_plan(way)

    def distance_m(self, x_m: float, y_m: float, goal: tuple[float, float]) -> float:
        """Return the cost-weighted length of the way to the goal on the known map; inf if none."""
        return float(self._tree(self.cell(*goal), ())[0][self.cell(x_m, y_m)])

    def parts(self) -> Ints:
        """Return the part (size,) of each cell; robots can drive both ways within a part."""
        return np.asarray(csgraph.connected_components(self._graph, connection="strong")[1])

    def cell(self, x_m: float, y_m: float) -> int:
        """Return the index of the cell at a place, or of the nearest cell if it is off the map."""
        i = min(max(int(x_m / CELL_M), 0), self.shape[0] - 1)
        j = min(max(int(y_m / CELL_M), 0), self.shape[1] - 1)
        return i * self.shape[1] + j

    def _nearest(self, cell: int, distance: F64) -> int:
        """Return the reachable cell nearest to an unreachable one, such as one beside a rack.

        It is at most 8 cells away along each axis; -1 if there is none.
        """
        i, j = divmod(cell, self.shape[1])
        low_i, low_j = max(i - 8, 0), max(j - 8, 0)
        window = distance.reshape(self.shape)[low_i : i + 9, low_j : j + 9]
        cells = np.argwhere(np.isfinite(window))
        if not len(cells):
            return -1
        gap = ((cells + np.array([low_i - i, low_j - j])) ** 2).sum(axis=1)
        best = cells[np.argmin(gap)]
        return int((low_i + best[0]) * self.shape[1] + low_j + best[1])

    def _tree(self, goal_cell: int, closures: tuple[Closure, ...]) -> tuple[F64, NDArray[np.int32]]:
        key = (goal_cell, closures)
        if key in self._trees:
            self._trees.move_to_end(key)
            return self._trees[key]
        graph = self._graph
        if closures:
            clearance = self._clearance_m.copy()
            for closure in closures:
                clearance[self._closed_cells(closure)] = 0.0
            graph = self._build_graph(clearance)
        distance, before = csgraph.dijkstra(graph, indices=goal_cell, return_predecessors=True)
        tree = distance, before.astype(np.int32)
        self._trees[key] = tree
        if len(self._trees) > self.trees_kept:
            self._trees.popitem(last=False)
        return tree

    def _closed_cells(self, closure: Closure) -> tuple[slice, slice]:
        segment, step = closure
        turned = self.warehouse.segments[segment].along == "y"
        area = self.warehouse.segments[segment].lengthwise
        middle = area.x_min + (step + 0.5) * CLOSURE_STEP_M
        i0, i1 = (round((middle + side * 0.2) / CELL_M) for side in (-1, 1))
        along = slice(max(i0, 0), i1 + 1)
        across = slice(int(area.y_min / CELL_M), int(area.y_max / CELL_M) + 1)
        return (across, along) if turned else (along, across)

    def _build_graph(self, clearance_m: F64) -> sparse.csr_matrix:
        """Connect cells to their eight neighbours; a weight is length × mean cost of both ends.

        Edges run against the robot's direction, because trees grow from the goal.
        """
        room = self.warehouse.room_m
        wide = WIDE_M * (room / ROOM_M)
        free = clearance_m >= room
        near = np.clip((wide - clearance_m) / (wide - room), 0.0, 1.0)
        cost = 1.0 + NEAR_COST * near**2
        index = np.arange(free.size).reshape(self.shape)
        rules = self._find_ruled_cells()
        forth: list[tuple[NDArray[Any], ...]] = []  # from, to, weight
        back: list[tuple[NDArray[Any], ...]] = []
        for di, dj in ((1, 0), (0, 1), (1, 1), (1, -1)):
            cells = (slice(0, self.shape[0] - di), slice(max(-dj, 0), self.shape[1] - max(dj, 0)))
            neighbours = (slice(di, None), slice(max(dj, 0), self.shape[1] + min(dj, 0)))
            both = free[cells] & free[neighbours]
            one, other = index[cells][both], index[neighbours][both]
            length = CELL_M * np.hypot(di, dj)
            weight = length * (cost[cells][both] + cost[neighbours][both]) / 2
            # A robot drives the edge one -> other from `other` to `one`, a step of (-di, -dj).
            kept = _find_allowed(rules, (-di, -dj), one, other)
            forth.append((one[kept], other[kept], weight[kept]))
            kept = _find_allowed(rules, (di, dj), one, other)
            back.append((other[kept], one[kept], weight[kept]))
        row, column, value = map(np.concatenate, zip(*forth, *back, strict=True))
        return sparse.csr_matrix((value, (row, column)), shape=(free.size, free.size))

    def _find_ruled_cells(self) -> list[tuple[tuple[int, int], Bools]]:
        """Return each one-way rule's heading, and a mask (size,) of the cells where it holds."""
        x, y = _cell_middles(self.shape)
        rules = []
        for rule in self.warehouse.one_way:
            area = rule.area
            inside = (area.x_min < x) & (x < area.x_max) & (area.y_min < y) & (y < area.y_max)
            rules.append((HEADINGS[rule.heading], inside.ravel()))
        return rules


def _find_allowed(
    rules: list[tuple[tuple[int, int], Bools]],
    step: tuple[int, int],
    one: Ints,
    other: Ints,
) -> Bools:
    """Return which edges a robot may drive in direction `step` without breaking one-way rules."""
    allowed = np.ones(len(one), np.bool_)
    for heading, inside in rules:
        if heading[0] * step[0] + heading[1] * step[1] < 0:
            allowed &= ~(inside[one] & inside[other])
    return allowed


def planners(floors: Sequence[Warehouse]) -> list[Planner]:
    """Return a planner per floor; their caches together take at most about 500 MB."""
    cells = max(round(f.width_m / CELL_M) * round(f.depth_m / CELL_M) for f in floors)
    kept = _TREES_KEPT_BYTES // (12 * max(cells, 1) * len(floors))
    return [Planner(floor, min(max(kept, 16), _TREES_KEPT)) for floor in floors]


def _cell_middles(shape: tuple[int, int]) -> tuple[F64, F64]:
    x = (np.arange(shape[0]) + 0.5)[:, None] * CELL_M
    y = (np.arange(shape[1]) + 0.5)[None, :] * CELL_M
    return np.broadcast_to(x, shape), np.broadcast_to(y, shape)


def smooth_plan(way: NDArray[Any]) -> F64:
    """Smooth and resample the centres (C, 2) of a path's cells to a plan (PLAN_POINTS, 2)."""
    return _resample(_smooth(way))


def _smooth(way: NDArray[Any]) -> F64:
    """Average a path's cells over a moving window, which rounds off the grid's corners."""
    half_window = 4  # cells
    if len(way) < 3:
        return way
    padded = np.zeros((len(way) + 2 * half_window + 1, 2))  # row 0 stays 0: sums start from it
    padded[1 : half_window + 1], padded[-half_window:] = way[0], way[-1]
    padded[half_window + 1 : -half_window] = way
    total, width = np.cumsum(padded, axis=0), 2 * half_window + 1
    smooth: F64 = (total[width:] - total[:-width]) / width
    smooth[0], smooth[-1] = way[0], way[-1]
    return smooth


def _resample(way: F64) -> F64:
    """Return PLAN_POINTS points at equal distances along a polyline."""
    arc = np.zeros(len(way))
    np.cumsum(np.hypot(*(way[1:] - way[:-1]).T), out=arc[1:])
    at = np.linspace(0.0, arc[-1], PLAN_POINTS)
    return stacked(np.interp(at, arc, way[:, 0]), np.interp(at, arc, way[:, 1]))
