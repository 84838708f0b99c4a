"""What the lidar adds to the robot's navigation stack: aisles that are wholly blocked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from restock.arrays import F64, Bools, Ints
from restock.state import Stateful
from restock.train.twin.floors.layout import Warehouse
from restock.train.twin.floors.planner import CLOSURE_STEP_M, Closure


@dataclass
class BlockFinder(Stateful):
    """Finds wholly blocked aisles from the lidar, over time. State for N robots.

    Within the aisle segment ahead, lidar returns that are neither rack nor wall are gathered up
    to `reach_m` away. If no free gap across the aisle is as wide as `passable_m`, and that is so
    for `persistence` steps at the same place, the aisle is blocked there. Robots may be on several
    floors: `floor` (N,) says on which of `warehouses` each is.
    """

    STATE = ("seen", "place")

    warehouses: Warehouse | Sequence[Warehouse]
    num: int
    reach_m: float = 2.0
    passable_m: float = 0.6
    persistence: int = 3

    def __post_init__(self) -> None:
        self.seen = np.zeros(self.num, np.int64)  # steps in a row
        self.place = np.full((self.num, 2), -1, np.int64)  # of the last sighting: a closure
        self.floor = np.zeros(self.num, np.int64)
        floors = self.warehouses
        self.floors = (floors,) if isinstance(floors, Warehouse) else tuple(floors)

    def reset(self, ids: Ints) -> None:
        self.seen[ids] = 0
        self.place[ids] = -1

    def update(
        self,
        ids: Ints,
        pose: F64,
        hits_m: F64,
        valid: Bools,
        heading: F64,
        along_y: Bools | None = None,
    ) -> list[tuple[int, Closure]]:
        """Look at one scan of each robot in `ids`; returns (robot, closure) of each block.

        `pose` (n, 3) is localised, `hits_m` (n, B, 2) are the returns in the map frame, `valid`
        (n, B) which of them are returns, `heading` (n,) the sign of the way along x, or along y
        where `along_y` (n,) says that it mostly runs that way.
        """
        turned = np.zeros(len(ids), np.bool_) if along_y is None else along_y
        segment, edges = self._segments_ahead(ids, pose, heading, turned)
        swap = turned[:, None]
        pose = np.where(swap, pose[:, [1, 0, 2]], pose)
        heading_x = heading
        x = np.where(swap, hits_m[..., 1], hits_m[..., 0])
        y = np.where(swap, hits_m[..., 0], hits_m[..., 1])
        ahead = (x - pose[:, None, 0]) * heading_x[:, None]
        rack = 0.1  # returns this near to a rack are the rack
        obstacle = (
            valid
            & (segment >= 0)[:, None]
            & (ahead > 0.1)
            & (ahead < self.reach_m)
            & (y > edges[:, 1, None] + rack)
            & (y < edges[:, 3, None] - rack)
            & (x > edges[:, 0, None] - 0.1)
            & (x < edges[:, 2, None] + 0.1)
        )
        face = np.where(obstacle, ahead, np.inf).min(axis=1)
        obstacle &= ahead < face[:, None] + 0.5
        across = np.where(obstacle, y, edges[:, 3, None])
        across = np.concatenate([edges[:, 1, None], across, edges[:, 3, None]], axis=1)
        across.sort(axis=1)
        gap = np.diff(across, axis=1).max(axis=1)
        shut = obstacle.any(axis=1) & (gap < self.passable_m)
        middle = pose[:, 0] + heading_x * (np.where(shut, face, 0.0) + 0.3)
        step = ((middle - edges[:, 0]) / CLOSURE_STEP_M).astype(np.int64)
        step = np.clip(step, 0, ((edges[:, 2] - edges[:, 0]) / CLOSURE_STEP_M).astype(np.int64) - 1)
        place = np.stack([segment, step], axis=1)
        same = (place[:, 0] == self.place[ids, 0]) & (np.abs(step - self.place[ids, 1]) <= 1)
        self.seen[ids] = np.where(shut, np.where(same, self.seen[ids] + 1, 1), 0)
        self.place[ids] = np.where(shut[:, None], place, -1)
        blocked = np.flatnonzero(self.seen[ids] >= self.persistence)
        self.seen[ids[blocked]] = 0
        return [(int(ids[k]), (int(place[k, 0]), int(place[k, 1]))) for k in blocked]

    def _segments_ahead(
        self,
        ids: Ints,
        pose: F64,
        heading: F64,
        turned: Bools,
    ) -> tuple[Ints, F64]:
        """The aisle segment (n,) each robot is in, or the one just ahead of it; -1 for none.

        With its edges (n, 4), x and y exchanged for robots that are `turned`. Only segments that
        run the robot's way count.
        """
        segment = np.full(len(ids), -1, np.int64)
        edges = np.zeros((len(ids), 4))
        x, y = pose[:, 0], pose[:, 1]
        then_x, then_y = x + 0.8 * heading * ~turned, y + 0.8 * heading * turned
        floors = self.floor[ids]
        for number in np.unique(floors):
            warehouse = self.floors[number]
            on = np.flatnonzero(floors == number)
            if not len(warehouse.segments):
                continue
            for at_x, at_y in ((then_x[on], then_y[on]), (x[on], y[on])):
                inside = warehouse.segment_of(at_x, at_y)
                fits = (inside >= 0) & (warehouse.segment_along_y[inside] == turned[on])
                segment[on] = np.where(fits, inside, segment[on])
            edges[on] = warehouse.segment_edges[segment[on]]
        edges = np.where(turned[:, None], edges[:, [1, 0, 3, 2]], edges)
        return segment, edges
