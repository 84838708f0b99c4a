"""Pictures of the twin: maps drawn from above, without GL."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from restock.arrays import F64, Bools
from restock.errors import ConfigError
from restock.train.twin.floors.layout import (
    FORKLIFT_HALF_M,
    HEADINGS,
    PALLET_HALF_M,
    PATCHES,
    PEOPLE,
    PERSON_RADIUS_M,
    Rect,
    Warehouse,
)
from restock.train.twin.floors.occupancy_grid import OCCUPIED, OccupancyGrid, into_frame

if TYPE_CHECKING:
    from restock.train.twin.env.vector_env import WarehouseVectorEnv


Pixel = tuple[int, int, int]

FLOOR, RACK, PALLET, PERSON = (238, 238, 236), (92, 108, 132), (176, 130, 80), (45, 110, 200)
FORKLIFT, ICE, ROUTE, ROBOT, MAP_GOAL = (
    *((225, 180, 20), (150, 205, 235), (120, 180, 120)),
    *((240, 130, 30), (30, 150, 60)),
)
AISLE, DOCK, ONE_WAY, MAP_WALL = (222, 232, 220), (250, 214, 150), (205, 70, 60), (70, 74, 80)
FLOOR_PIXELS, MAP_PIXELS_PER_M = 960, 40  # the first is for a floor's longer side


def draw_floor(
    floor: Warehouse, grid: OccupancyGrid | None = None, driven_m: F64 | None = None
) -> NDArray[np.uint8]:
    """Draw racks, aisles, docks, goals and one-way rules, (H, W, 3) uint8, north up, with walls.

    For a floor made from a `grid`, this also draws the grid's occupied cells, and the places
    `driven_m` (N, 2), in the map's frame, where the robot drove.
    """
    canvas = _Canvas(floor, int(FLOOR_PIXELS / max(floor.width_m, floor.depth_m)))
    for color, areas in (
        (AISLE, [segment.area for segment in floor.segments]),
        (DOCK, [dock.area for dock in floor.docks]),
        (RACK, floor.racks),
    ):
        for area in areas:
            canvas.fill(area, color)
    if grid is not None:
        canvas.cells(grid.occupancy == OCCUPIED, grid.cell_m, MAP_WALL)
    if driven_m is not None:
        for x, y in into_frame(driven_m, floor.map_origin).tolist():
            canvas.disc(x, y, 0.03, ROBOT)
    for x, y in floor.goals.tolist():
        canvas.fill(Rect(x - 0.06, y - 0.06, x + 0.06, y + 0.06), MAP_GOAL)
    for rule in floor.one_way:
        canvas.arrow(*rule.area.center, HEADINGS[rule.heading], ONE_WAY)
    return canvas.pixels(wall=4)


def draw_map(env: WarehouseVectorEnv, index: int) -> NDArray[np.uint8]:
    """Draw one environment as it is now, (H, W, 3) uint8, north up."""
    floor = env.floor_of(index)
    canvas = _Canvas(floor, MAP_PIXELS_PER_M)
    sim = env.simulation
    for row in range(PATCHES):
        x, y, half_x, half_y, _ = sim.patches[index, row]
        canvas.box(x, y, half_x, half_y, 0.0, ICE)
    for rack in floor.racks:
        canvas.box(*rack.center, *rack.half_size, 0.0, RACK)
    for x, y in _dense(env.navigation.plans_m[index]):
        canvas.disc(x, y, 0.03, ROUTE)
    goal_x, goal_y = env.navigation.goals_m[index]
    canvas.disc(goal_x, goal_y, env.task.goal_radius_m, MAP_GOAL)
    for x, y, yaw in sim.pallets[index]:
        canvas.box(x, y, *PALLET_HALF_M[:2], yaw, PALLET)
    for agent, (x, y) in enumerate(sim.traffic.position_m[index]):
        if agent < PEOPLE:
            canvas.disc(x, y, PERSON_RADIUS_M, PERSON)
        else:
            yaw = sim.traffic.heading_rad[index, agent]
            canvas.box(x, y, *FORKLIFT_HALF_M[:2], yaw, FORKLIFT)
    x, y, yaw = sim.middle(sim.pose())[index]
    body = env.task.body
    canvas.box(x, y, body.length_m / 2, body.width_m / 2, yaw, ROBOT)
    nose = body.length_m / 2 - 0.1
    canvas.disc(x + nose * np.cos(yaw), y + nose * np.sin(yaw), 0.06, (60, 40, 20))
    return canvas.pixels()


class _Canvas:
    """The pixels of a floor; the first row is the southernmost."""

    def __init__(self, floor: Warehouse, pixels_per_m: int) -> None:
        height, width = round(floor.depth_m * pixels_per_m), round(floor.width_m * pixels_per_m)
        self._image = np.empty((height, width, 3), np.uint8)
        self._image[:] = FLOOR
        self._scale = pixels_per_m
        self._x = (np.arange(width) + 0.5) / pixels_per_m
        self._y = (np.arange(height) + 0.5) / pixels_per_m

    def fill(self, area: Rect, color: Pixel) -> None:
        """Fill an axis-aligned box, its edges rounded to whole pixels."""
        x0, y0, x1, y1 = (round(edge * self._scale) for edge in area.edges)
        self._image[y0:y1, x0:x1] = color

    def cells(self, cells: Bools, cell_m: float, color: Pixel) -> None:
        """Fill the pixels whose centres are in these cells (X, Y), from the south-west corner."""
        column, row = (
            np.minimum((at / cell_m).astype(np.int64), size - 1)
            for at, size in zip((self._x, self._y), cells.shape, strict=True)
        )
        self._image[cells[np.ix_(column, row)].T] = color

    def box(
        self, x: float, y: float, half_x: float, half_y: float, yaw: float, color: Pixel
    ) -> None:
        window, dx, dy = self._window(x, y, float(np.hypot(half_x, half_y)))
        cos, sin = np.cos(yaw), np.sin(yaw)
        inside = (np.abs(cos * dx + sin * dy) <= half_x) & (np.abs(cos * dy - sin * dx) <= half_y)
        self._image[window][inside] = color

    def disc(self, x: float, y: float, radius: float, color: Pixel) -> None:
        window, dx, dy = self._window(x, y, radius)
        self._image[window][dx * dx + dy * dy <= radius * radius] = color

    def arrow(self, x: float, y: float, heading: tuple[int, int], color: Pixel) -> None:
        """Draw a triangle around a place, pointing along `heading`."""
        window, dx, dy = self._window(x, y, 0.4)
        ahead = heading[0] * dx + heading[1] * dy
        aside = np.abs(heading[1] * dx - heading[0] * dy)
        inside = (ahead > -0.35) & (ahead < 0.35) & (aside < (0.35 - ahead) / 2)
        self._image[window][inside] = color

    def _window(self, x: float, y: float, reach: float) -> tuple[tuple[slice, slice], F64, F64]:
        columns = slice(*np.searchsorted(self._x, [x - reach, x + reach]))
        rows = slice(*np.searchsorted(self._y, [y - reach, y + reach]))
        return (rows, columns), self._x[None, columns] - x, self._y[rows, None] - y

    def pixels(self, wall: int = 0) -> NDArray[np.uint8]:
        """Return the pixels (H, W, 3), north first, with this many pixels of wall around."""
        height, width, _ = self._image.shape
        framed = np.empty((height + 2 * wall, width + 2 * wall, 3), np.uint8)
        framed[:] = MAP_WALL
        framed[wall : wall + height, wall : wall + width] = self._image[::-1]
        return framed


def _dense(plan_m: F64) -> F64:
    """Return a polyline with three more points in every segment."""
    share = np.arange(4)[None, :, None] / 4
    return (plan_m[:-1, None] * (1 - share) + plan_m[1:, None] * share).reshape(-1, 2)


def write_png(path: Path, image: NDArray[np.uint8]) -> None:
    """Write pixels (H, W, 3). Raises ConfigError if they cannot be written."""
    try:
        Image.fromarray(image).save(path, format="PNG")
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", where=str(path)) from error
