"""A top-down drawing of the warehouse as pixels; needs no GL."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from restock.train.twin.floors.layout import Warehouse
from restock.train.twin.physics.friction import PATCHES
from restock.train.twin.physics.model import FORKLIFT_HALF_M, PALLET_HALF_M, PEOPLE, PERSON_RADIUS_M

if TYPE_CHECKING:
    from restock.train.twin.env.vector_env import WarehouseVectorEnv

PIXELS_PER_M = 40
FLOOR, RACK, PALLET, PERSON = (238, 238, 236), (92, 108, 132), (176, 130, 80), (45, 110, 200)
FORKLIFT, ICE, ROUTE, ROBOT, GOAL = (
    *((225, 180, 20), (150, 205, 235), (120, 180, 120)),
    *((240, 130, 30), (30, 150, 60)),
)


def draw_map(env: WarehouseVectorEnv, index: int) -> NDArray[np.uint8]:
    """One environment now, (H, W, 3) uint8, north up."""
    floor = env.floor_of(index)
    canvas = _Canvas(floor)
    sim = env.simulation
    for row in range(PATCHES):
        x, y, half_x, half_y, _ = sim.patches[index, row]
        canvas.box(x, y, half_x, half_y, 0.0, ICE)
    for rack in floor.racks:
        canvas.box(*rack.center, *rack.half_size, 0.0, RACK)
    for x, y in _dense(env.navigation.plans_m[index]):
        canvas.disc(x, y, 0.03, ROUTE)
    goal_x, goal_y = env.navigation.goals_m[index]
    canvas.disc(goal_x, goal_y, env.task.goal_radius_m, GOAL)
    for x, y, yaw in sim.pallets[index]:
        canvas.box(x, y, *PALLET_HALF_M[:2], yaw, PALLET)
    for agent, (x, y) in enumerate(sim.traffic.position_m[index]):
        if agent < PEOPLE:
            canvas.disc(x, y, PERSON_RADIUS_M, PERSON)
        else:
            yaw = sim.traffic.heading_rad[index, agent]
            canvas.box(x, y, *FORKLIFT_HALF_M[:2], yaw, FORKLIFT)
    x, y, yaw = sim.pose()[index]
    body = env.task.body
    canvas.box(x, y, body.length_m / 2, body.width_m / 2, yaw, ROBOT)
    nose = body.length_m / 2 - 0.1
    canvas.disc(x + nose * np.cos(yaw), y + nose * np.sin(yaw), 0.06, (60, 40, 20))
    return canvas.pixels()


class _Canvas:
    def __init__(self, warehouse: Warehouse) -> None:
        height = round(warehouse.depth_m * PIXELS_PER_M)
        width = round(warehouse.width_m * PIXELS_PER_M)
        self._image = np.empty((height, width, 3), np.uint8)
        self._image[:] = FLOOR
        self._x = (np.arange(width) + 0.5) / PIXELS_PER_M
        self._y = (np.arange(height) + 0.5) / PIXELS_PER_M

    def box(
        self, x: float, y: float, half_x: float, half_y: float, yaw: float, color: tuple[int, ...]
    ) -> None:
        window, dx, dy = self._window(x, y, float(np.hypot(half_x, half_y)))
        cos, sin = np.cos(yaw), np.sin(yaw)
        inside = (np.abs(cos * dx + sin * dy) <= half_x) & (np.abs(cos * dy - sin * dx) <= half_y)
        self._image[window][inside] = color

    def disc(self, x: float, y: float, radius: float, color: tuple[int, ...]) -> None:
        window, dx, dy = self._window(x, y, radius)
        self._image[window][dx * dx + dy * dy <= radius * radius] = color

    def _window(
        self, x: float, y: float, reach: float
    ) -> tuple[tuple[slice, slice], NDArray[np.float64], NDArray[np.float64]]:
        columns = slice(*np.searchsorted(self._x, [x - reach, x + reach]))
        rows = slice(*np.searchsorted(self._y, [y - reach, y + reach]))
        return (rows, columns), self._x[None, columns] - x, self._y[rows, None] - y

    def pixels(self) -> NDArray[np.uint8]:
        return np.ascontiguousarray(self._image[::-1])


def _dense(plan_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """A polyline with three points more in every segment."""
    share = np.arange(4)[None, :, None] / 4
    return (plan_m[:-1, None] * (1 - share) + plan_m[1:, None] * share).reshape(-1, 2)
