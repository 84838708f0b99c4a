"""What stands on a floor, as a camera draws it: boxes, cylinders, spheres and capsules.

It is made from what an environment says of itself (its floor, pallets, patches, traffic, plan, goal
and pose), not from the physics' own model: so racks have shelves and people have heads, and nothing
that is drawn can touch the physics.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from restock.ingest.task.scan import Body
from restock.train.twin.floors.layout import Rect, Warehouse
from restock.train.twin.physics.model import (
    FORKLIFT_HALF_M,
    PALLET_HALF_M,
    PARKED_M,
    PEOPLE,
    RACK_HALF_HEIGHT_M,
    TRACK_M,
    WALL_HALF_HEIGHT_M,
    WHEEL_RADIUS_M,
)

if TYPE_CHECKING:
    from restock.train.twin.env.vector_env import WarehouseVectorEnv

Place = tuple[float, float, float]
Color = tuple[float, float, float, float]
Part = tuple[Any, Place, Place, float, Color]  # shape, middle, MuJoCo's sizes, yaw, colour

_BOX, _CYLINDER, _SPHERE, _CAPSULE = (
    mujoco.mjtGeom.mjGEOM_BOX,
    mujoco.mjtGeom.mjGEOM_CYLINDER,
    mujoco.mjtGeom.mjGEOM_SPHERE,
    mujoco.mjtGeom.mjGEOM_CAPSULE,
)
WALL: Color = (0.74, 0.76, 0.79, 1)
POST: Color = (0.16, 0.27, 0.46, 1)
BEAM: Color = (0.90, 0.42, 0.10, 1)
CARTONS: tuple[Color, ...] = ((0.76, 0.60, 0.42, 1), (0.69, 0.52, 0.35, 1), (0.82, 0.68, 0.50, 1))
WOOD: Color = (0.55, 0.39, 0.22, 1)
LOAD: Color = (0.80, 0.64, 0.44, 1)
BODY: Color = (0.95, 0.50, 0.10, 1)
DARK: Color = (0.12, 0.13, 0.15, 1)
LAMP: Color = (0.30, 0.95, 0.55, 1)
TRUCK: Color = (0.98, 0.78, 0.05, 1)
STEEL: Color = (0.35, 0.37, 0.40, 1)
SKIN: Color = (0.90, 0.72, 0.58, 1)
TROUSERS: Color = (0.15, 0.20, 0.32, 1)
VESTS: tuple[Color, ...] = ((0.10, 0.35, 0.90, 1), (0.80, 0.10, 0.55, 1))  # one a person
OIL: Color = (0.10, 0.42, 0.62, 0.55)
PLAN: Color = (0.10, 0.62, 0.30, 1)
GOAL: Color = (0.10, 0.70, 0.30, 0.45)


def parts(env: WarehouseVectorEnv, index: int, floor: Warehouse) -> Iterator[Part]:
    """Everything on the floor as parts; what is seen through comes last."""
    sim, body = env.simulation, env.task.body
    x, y, yaw = sim.pose()[index]
    yield from _robot(x, y, yaw, body)
    for x, y, yaw in sim.pallets[index]:
        if x > PARKED_M[0] / 2:
            yield from _pallet(x, y, yaw)
    traffic = sim.traffic
    for agent, (x, y) in enumerate(traffic.position_m[index]):
        yaw = traffic.heading_rad[index, agent]
        if x > PARKED_M[0] / 2:
            yield from _person(x, y, agent) if agent < PEOPLE else _forklift(x, y, yaw)
    for rack in floor.racks:
        yield from _rack(rack)
    yield from _walls(floor)
    yield from _route(env.navigation.plans_m[index])
    x, y = env.navigation.goals_m[index]
    radius = env.task.goal_radius_m
    yield _CYLINDER, (x, y, 0.6), (0.025, 0.6, 0.0), 0.0, PLAN
    yield _BOX, (x + 0.15, y, 1.1), (0.15, 0.012, 0.1), 0.0, PLAN
    yield _CYLINDER, (x, y, 0.008), (radius, 0.008, 0.0), 0.0, GOAL
    for x, y, half_x, half_y, _ in sim.patches[index]:
        if half_x > 0:
            yield _BOX, (x, y, 0.002), (half_x, half_y, 0.002), 0.0, OIL


def _frame(x: float, y: float, yaw: float) -> Callable[[float, float, float], Place]:
    """Places ahead, left and up of a body to places on the floor."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    return lambda ahead, left, up: (x + cos * ahead - sin * left, y + sin * ahead + cos * left, up)


def _robot(x: float, y: float, yaw: float, body: Body) -> Iterator[Part]:
    at, half_x, half_y = _frame(x, y, yaw), body.length_m / 2, body.width_m / 2
    yield _BOX, at(0, 0, 0.17), (half_x, half_y, 0.11), yaw, BODY
    yield _BOX, at(0, 0, 0.29), (half_x - 0.07, half_y - 0.07, 0.015), yaw, DARK
    yield _BOX, at(half_x, 0, 0.2), (0.006, half_y - 0.08, 0.02), yaw, LAMP
    for ahead in (0.16, 0.24):  # an arrow on the deck: which way is forward
        yield _BOX, at(ahead, 0, 0.306), (0.02, 0.16 - ahead / 2, 0.003), yaw, LAMP
    for side in (1, -1):
        wheel = at(0, side * TRACK_M / 2, WHEEL_RADIUS_M)
        yield _BOX, wheel, (WHEEL_RADIUS_M, 0.03, WHEEL_RADIUS_M), yaw, DARK
    yield _CYLINDER, at(body.lidar_x_m, 0, 0.34), (0.06, 0.04, 0.0), yaw, DARK


def _pallet(x: float, y: float, yaw: float) -> Iterator[Part]:
    half_x, half_y, half_z = PALLET_HALF_M
    yield _BOX, (x, y, 0.07), (half_x, half_y, 0.07), yaw, WOOD
    top = 2 * half_z - 0.14
    yield _BOX, (x, y, 0.14 + top / 2), (half_x - 0.03, half_y - 0.03, top / 2), yaw, LOAD


def _person(x: float, y: float, which: int) -> Iterator[Part]:
    yield _CAPSULE, (x, y, 0.45), (0.13, 0.32, 0.0), 0.0, TROUSERS
    yield _CAPSULE, (x, y, 1.12), (0.2, 0.24, 0.0), 0.0, VESTS[which % len(VESTS)]
    yield _SPHERE, (x, y, 1.62), (0.13, 0.0, 0.0), 0.0, SKIN
    yield _SPHERE, (x, y, 1.67), (0.135, 0.0, 0.0), 0.0, (1, 1, 1, 1)  # a helmet


def _forklift(x: float, y: float, yaw: float) -> Iterator[Part]:
    at, (half_x, half_y, half_z) = _frame(x, y, yaw), FORKLIFT_HALF_M
    yield _BOX, at(-0.12, 0, 0.4), (half_x - 0.12, half_y, 0.34), yaw, TRUCK
    yield _BOX, at(-0.2, 0, 2 * half_z + 0.5), (0.3, half_y - 0.05, 0.03), yaw, DARK
    for side in (1, -1):
        mast = at(half_x - 0.2, side * (half_y - 0.12), half_z + 0.3)
        yield _BOX, mast, (0.04, 0.04, half_z + 0.3), yaw, STEEL
        yield _BOX, at(half_x, side * 0.18, 0.06), (0.2, 0.06, 0.02), yaw, STEEL
        for ahead in (-0.4, 0.3):
            wheel = at(ahead, side * half_y, 0.14)
            yield _BOX, wheel, (0.14, 0.05, 0.14), yaw, DARK
        post = at(-0.45, side * (half_y - 0.08), 1.2)
        yield _BOX, post, (0.025, 0.025, 0.5), yaw, DARK


def _rack(rack: Rect) -> Iterator[Part]:
    """Posts, two shelves above the floor, and cartons on each of the three levels."""
    x, y = rack.center
    half_x, half_y = rack.half_size
    top = 2 * RACK_HALF_HEIGHT_M
    for side_x in (-1, 1):
        for side_y in (-1, 1):
            corner = (x + side_x * (half_x - 0.04), y + side_y * (half_y - 0.04), top / 2)
            yield _BOX, corner, (0.04, 0.04, top / 2), 0.0, POST
    for level in range(3):
        up = 0.06 + level * top / 3
        yield _BOX, (x, y, up), (half_x, half_y, 0.03), 0.0, BEAM
        along = half_x >= half_y
        count = min(max(round(2 * max(half_x, half_y) / 0.65), 1), 40)
        bay = 2 * max(half_x, half_y) / count
        for slot in range(count):
            number = slot * 7 + level * 3 + round(10 * (x + y))
            tall = (0.13, 0.17, 0.10)[number % 3]
            offset = (slot + 0.5) * bay - max(half_x, half_y)
            at = (x + offset, y) if along else (x, y + offset)
            deep = min(half_x, half_y) - 0.05
            half = (bay / 2 - 0.04, deep) if along else (deep, bay / 2 - 0.04)
            yield _BOX, (*at, up + 0.03 + tall), (*half, tall), 0.0, CARTONS[number % 3]


def _walls(floor: Warehouse) -> Iterator[Part]:
    thick, width, depth = floor.wall_m, floor.width_m, floor.depth_m
    up = WALL_HALF_HEIGHT_M
    for place, half in (
        ((-thick, depth / 2), (thick, depth / 2 + 2 * thick)),
        ((width + thick, depth / 2), (thick, depth / 2 + 2 * thick)),
        ((width / 2, -thick), (width / 2, thick)),
        ((width / 2, depth + thick), (width / 2, thick)),
    ):
        yield _BOX, (*place, up), (*half, up), 0.0, WALL


def _route(plan_m: NDArray[np.float64]) -> Iterator[Part]:
    """The plan as a band on the floor, piece by piece."""
    step = np.diff(plan_m, axis=0)
    length = np.hypot(step[:, 0], step[:, 1])
    for start, (dx, dy), long in zip(plan_m[:-1], step, length, strict=True):
        if long > 1e-6:
            middle = (start[0] + dx / 2, start[1] + dy / 2, 0.006)
            yield _BOX, middle, (long / 2, 0.03, 0.004), float(np.arctan2(dy, dx)), PLAN
