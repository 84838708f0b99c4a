"""What the operator foresees: where commands would lead robots, and how near to anything that is.

People are assumed to keep walking as they do.
"""

from __future__ import annotations

import numpy as np

from restock.arrays import F64, Ints
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.floors.obstacles import pallet_half_m
from restock.train.twin.floors.state_lattice import box_gap, near_floor_gap, rectangle
from restock.train.twin.physics.traffic import RETREATING, WALKING

# Nearer than this to anything is too near, and less room than that is a squeeze, for a robot of
# WIDTH_M or more; of a smaller one's, in proportion.
TOUCH_M, ROOMY_M, WIDTH_M = 0.05, 0.12, 0.5
PERSON_MARGIN_M = 0.4
STANDING_MARGIN_M = 0.2


def simulated(env: WarehouseVectorEnv, ids: Ints, pose: F64, commands: F64) -> tuple[F64, F64]:
    """Where robots (n,) get to by commands (n, A, T, 2): poses (n, A, T, 3) and speeds
    (n, A, T)."""
    period = env.task.control_period_s
    shape = commands.shape[:3]
    x, y, yaw = (np.broadcast_to(pose[:, axis, None], shape[:2]) for axis in range(3))
    velocity = np.broadcast_to(env.simulation.controller.set_point[ids][:, None], (*shape[:2], 2))
    ends = np.empty((*shape, 3))
    speed = np.empty(shape)
    for step in range(shape[2]):
        velocity = velocity + 0.8 * (commands[:, :, step] - velocity)
        middle = yaw + velocity[..., 1] * period / 2
        x = x + velocity[..., 0] * np.cos(middle) * period
        y = y + velocity[..., 0] * np.sin(middle) * period
        yaw = yaw + velocity[..., 1] * period
        ends[:, :, step] = np.stack([x, y, yaw], axis=-1)
        speed[:, :, step] = velocity[..., 0]
    return ends, speed


def room_of(env: WarehouseVectorEnv, ids: Ints, ends: F64) -> tuple[F64, F64]:
    """Clearance (n, A, T) to racks, walls and pallets, and to people where they will be.

    It is exact below `ROOMY_M`: what is farther away than that counts alike.
    """
    outline = outline_of(env, points=3)
    cos, sin = np.cos(ends[..., 2, None]), np.sin(ends[..., 2, None])
    x = ends[..., 0, None] + cos * outline[:, 0] - sin * outline[:, 1]  # (n, A, T, K)
    y = ends[..., 1, None] + sin * outline[:, 0] + cos * outline[:, 1]
    room = np.empty_like(x)
    on = env.layout[ids]
    for index in np.unique(on):
        rows = np.flatnonzero(on == index)
        room[rows] = near_floor_gap(env.floors[index], x[rows], y[rows], ROOMY_M)
    pallets = env.simulation.pallets[ids]
    for column in range(pallets.shape[1]):
        rows = np.flatnonzero(pallets[:, column, 0] > 0)
        if len(rows):
            middle = pallets[rows, column, :2][:, None, None, None]
            half = pallet_half_m(pallets[rows, column, 2])[:, None, None, None]
            gap = box_gap(
                x[rows], y[rows], (middle[..., 0], middle[..., 1]), (half[..., 0], half[..., 1])
            )
            room[rows] = np.minimum(room[rows], gap)
    people = np.full(ends.shape[:3], 9.0)
    traffic = env.simulation.traffic
    rows = np.flatnonzero(traffic.active[ids])
    if len(rows):
        about = ids[rows]
        later = (np.arange(ends.shape[2]) + 1) * env.task.control_period_s
        arrived = traffic.travelled_m[about] >= traffic.length_m[about]
        walking = (traffic.state[about] == WALKING) & ~arrived
        sign = np.where(walking, 1.0, np.where(traffic.state[about] == RETREATING, -0.6, 0.0))
        walked = (traffic.speed_mps[about] * sign)[..., None] * later  # (n, G, T)
        heading = traffic.heading_rad[about][..., None]
        px = traffic.position_m[about, :, 0, None] + np.cos(heading) * walked
        py = traffic.position_m[about, :, 1, None] + np.sin(heading) * walked
        gap = np.hypot(
            x[rows][:, None] - px[:, :, None, :, None],
            y[rows][:, None] - py[:, :, None, :, None],
        )
        gap = gap.min(axis=4) - traffic.radius_m[None, :, None, None]
        standing = sign == 0.0  # one may pass nearer to who stands
        gap += np.where(standing, PERSON_MARGIN_M - STANDING_MARGIN_M, 0.0)[:, :, None, None]
        people[rows] = gap.min(axis=1)
    return room.min(axis=3), people


def steps_of(env: WarehouseVectorEnv, seconds: float) -> int:
    """So long in control periods: one or more."""
    return max(round(seconds / env.task.control_period_s), 1)


def margins_of(env: WarehouseVectorEnv) -> tuple[float, float]:
    """`TOUCH_M` and `ROOMY_M` of this robot."""
    smaller = min(env.task.body.width_m / WIDTH_M, 1.0)
    return TOUCH_M * smaller, ROOMY_M * smaller


def outline_of(env: WarehouseVectorEnv, points: int) -> F64:
    """Points on the body's outline, (K, 2), about its axle."""
    body = env.task.body
    return rectangle(body.length_m, body.width_m, env.simulation.robot.axle_x_m, points)


__all__ = [
    "PERSON_MARGIN_M",
    "margins_of",
    "outline_of",
    "room_of",
    "simulated",
    "steps_of",
]
