"""Slippery patches on the route, where the robot starts, turns or stops."""

from __future__ import annotations

import numpy as np

from restock.arrays import F64
from restock.train.twin.floors.layout import NO_PATCH, PATCHES, Warehouse
from restock.train.twin.missions.mission import Mission, Staged, length_m, point_along

PATCH_FRICTION = (0.02, 0.045)  # oil or wet ice on sealed concrete


def stage(rng: np.random.Generator, warehouse: Warehouse, plan: F64) -> Staged:
    """Stage oily patches before and in the sharpest turn, and mostly also at the start and goal.

    Some patches lie under the wheels of one side only, which turns a robot that accelerates or
    brakes.
    """
    patches = np.tile(NO_PATCH, (PATCHES, 1))
    turn, total = _sharpest_turn(plan), length_m(plan)
    places = [turn, turn - rng.uniform(0.6, 1.2)]
    if rng.random() < 0.7:
        places.append(total - rng.uniform(0.5, 1.5))
    if rng.random() < 0.7:
        places.append(rng.uniform(0.3, 1.2))
    for row, place in enumerate(places):
        at = point_along(plan, place)
        ahead = point_along(plan, place + 0.3) - point_along(plan, place - 0.3)
        long, wide = rng.uniform(1.2, 1.7), 1.5
        if row > 0 and rng.random() < 0.35:  # under one side only: its edge is along the plan
            normal = np.array([-ahead[1], ahead[0]]) / max(float(np.hypot(*ahead)), 1e-9)
            wide = 0.6
            at = at + normal * rng.choice([-1.0, 1.0]) * wide
        half = (long, wide) if abs(ahead[0]) > abs(ahead[1]) else (wide, long)
        patches[row] = (*at, *half, rng.uniform(*PATCH_FRICTION))
    return Staged(patches=patches)


def _sharpest_turn(plan: F64) -> float:
    """Return where, in metres along the plan, the heading changes most within .6 m either way."""
    step = np.diff(plan, axis=0)
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    spacing = length_m(plan) / (len(plan) - 1)
    reach = min(max(int(0.6 / spacing), 1), len(heading) // 3)
    bend = np.abs(heading[2 * reach :] - heading[: -2 * reach])
    return float((np.argmax(bend) + reach) * spacing)


MISSION = Mission(
    "wheel_slip",
    stage,
    share=0.2,
    natural=0.07,
    colour="#0072b2",
    place=1,
    is_true=lambda situation: situation.slipped,
)
