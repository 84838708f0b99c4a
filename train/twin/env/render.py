"""Pictures of the twin: maps drawn from above, without GL."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageOps

from restock.arrays import F64, Bools
from restock.errors import ConfigError
from restock.train.twin.floors.layout import (
    FORKLIFT_HALF_M,
    HEADINGS,
    PALLET_HALF_M,
    PATCHES,
    PEOPLE,
    PERSON_RADIUS_M,
    Warehouse,
)
from restock.train.twin.floors.occupancy_grid import (
    OCCUPIED,
    OccupancyGrid,
    into_frame,
    out_of_frame,
)

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
            canvas.box(*area.center, *area.half_size, 0.0, color)
    if grid is not None:
        canvas.cells(grid.occupancy == OCCUPIED, grid.cell_m, MAP_WALL)
    if driven_m is not None:
        for x, y in into_frame(driven_m, floor.map_origin).tolist():
            canvas.disc(x, y, 0.03, ROBOT)
    for x, y in floor.goals.tolist():
        canvas.box(x, y, 0.06, 0.06, 0.0, MAP_GOAL)
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
    canvas.line(env.navigation.plans_m[index], ROUTE)
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
    """A picture of a floor; the first row is the southernmost until it is read as `pixels`."""

    def __init__(self, floor: Warehouse, pixels_per_m: int) -> None:
        self._scale = pixels_per_m
        size = round(floor.width_m * pixels_per_m), round(floor.depth_m * pixels_per_m)
        self._image = Image.new("RGB", size, FLOOR)
        self._draw = ImageDraw.Draw(self._image)

    def cells(self, cells: Bools, cell_m: float, color: Pixel) -> None:
        """Fill cells (X, Y), which begin in the south-west corner."""
        size = [max(round(count * cell_m * self._scale), 1) for count in cells.shape]
        mask = Image.fromarray(np.where(cells.T, np.uint8(255), np.uint8(0)))
        mask = mask.resize((size[0], size[1]), Image.Resampling.NEAREST)
        self._image.paste(color, (0, 0, *size), mask)

    def box(
        self, x: float, y: float, half_x: float, half_y: float, yaw: float, color: Pixel
    ) -> None:
        corners = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)]) * (half_x, half_y)
        self._polygon(out_of_frame(corners, (x, y, yaw)), color)

    def disc(self, x: float, y: float, radius: float, color: Pixel) -> None:
        ends = [at * self._scale for at in (x - radius, y - radius, x + radius, y + radius)]
        self._draw.ellipse(ends, fill=color)

    def line(self, points_m: F64, color: Pixel) -> None:
        self._draw.line((points_m * self._scale).ravel().tolist(), fill=color, width=2)

    def arrow(self, x: float, y: float, heading: tuple[int, int], color: Pixel) -> None:
        """Draw a triangle around a place, pointing along `heading`."""
        yaw = float(np.arctan2(heading[1], heading[0]))
        corners = np.array([(-0.35, 0.35), (-0.35, -0.35), (0.35, 0.0)])
        self._polygon(out_of_frame(corners, (x, y, yaw)), color)

    def _polygon(self, corners: F64, color: Pixel) -> None:
        self._draw.polygon((corners * self._scale).ravel().tolist(), fill=color)

    def pixels(self, wall: int = 0) -> NDArray[np.uint8]:
        """Return the pixels (H, W, 3), north first, with this many pixels of wall around."""
        return np.array(ImageOps.expand(ImageOps.flip(self._image), wall, MAP_WALL))


def write_png(path: Path, image: NDArray[np.uint8]) -> None:
    """Write pixels (H, W, 3). Raises ConfigError if they cannot be written."""
    try:
        Image.fromarray(image).save(path, format="PNG")
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", where=str(path)) from error
