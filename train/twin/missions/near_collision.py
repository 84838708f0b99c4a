"""People and forklifts who cross the route or come toward the robot."""

from __future__ import annotations

import numpy as np

from restock.arrays import F64
from restock.train.twin.floors.layout import (
    AGENTS,
    PEOPLE,
    WAY_POINTS,
    Walk,
    Warehouse,
    edges_of,
    within,
)
from restock.train.twin.missions.mission import Mission, Staged

PASSING_M = 0.6  # from the plan to the side of a waiting person: half the robot and a margin


def stage(rng: np.random.Generator, warehouse: Warehouse, plan: F64) -> Staged | None:
    """Stage one or two people and perhaps a forklift on the plan; None if none fits."""
    walks: list[Walk | None] = [None] * AGENTS
    crossings = _find_crossings(plan, warehouse)
    for slot in range(1 + int(rng.random() < 0.35)):
        oncoming = rng.random() < 0.4 or not crossings
        walks[slot] = (
            _draw_oncoming(rng, plan)
            if oncoming
            else _draw_crossing(rng, warehouse, plan, crossings[rng.integers(len(crossings))], 0.3)
        )
    if crossings and rng.random() < 0.65:  # only about half of these find room
        place = crossings[rng.integers(len(crossings))]
        walks[PEOPLE] = _draw_crossing(rng, warehouse, plan, place, 0.6)
    return Staged(walks=tuple(walks)) if any(walk is not None for walk in walks) else None


def _find_crossings(plan: F64, warehouse: Warehouse) -> list[int]:
    """Return the indices of plan points in a crossing, at least 1.5 m from the plan's ends."""
    spacing = float(np.hypot(*(plan[1] - plan[0])))
    margin = int(1.5 / max(spacing, 1e-6)) + 1
    x, y = plan[margin : len(plan) - margin].T
    inside = within(edges_of(warehouse.crossings), x, y, 0.3).any(axis=1)
    return [margin + int(index) for index in np.flatnonzero(inside)]


def _draw_crossing(
    rng: np.random.Generator, warehouse: Warehouse, plan: F64, index: int, half_width_m: float
) -> Walk | None:
    """Draw a walk straight across the plan at point `index`, up to the racks; None without room."""
    place = plan[index]
    along = plan[min(index + 2, len(plan) - 1)] - plan[max(index - 2, 0)]
    across = np.array([0.0, 1.0]) if abs(along[0]) > abs(along[1]) else np.array([1.0, 0.0])
    across = across * rng.choice([-1.0, 1.0])
    reach = [_free_m(warehouse, place, side * across, half_width_m) for side in (-1, 1)]
    if min(reach) < 1.0 and max(reach) < 2.0:
        return None
    start, end = place - across * min(reach[0], 4.0), place + across * min(reach[1], 4.0)
    ends = np.stack([start, end])
    off_plan = np.hypot(*(ends[:, None] - plan[None]).transpose(2, 0, 1)).min(axis=1)
    if off_plan.min() < half_width_m + PASSING_M:
        return None  # a person who waits or has arrived there would leave no room to pass
    speed = rng.uniform(0.5, 1.1)
    arrival_s = float(np.hypot(*(place - start))) / speed + rng.uniform(-0.6, 0.6)
    return Walk(
        np.linspace(start, end, WAY_POINTS),
        speed,
        (float(place[0]), float(place[1]), float(np.clip(0.8 * arrival_s, 1.2, 4.0))),
        bool(rng.random() < 0.4),
    )


def _draw_oncoming(rng: np.random.Generator, plan: F64) -> Walk:
    """Draw a walk along the plan toward the robot, .25 to .5 m to one side of the plan."""
    spacing = float(np.hypot(*(plan[1] - plan[0])))
    length = spacing * (len(plan) - 1)
    meet_m = rng.uniform(0.4, 0.7) * length
    at = np.linspace(min(meet_m + 3.5, length), max(meet_m - 5.0, 0.0), WAY_POINTS)
    place = np.clip(at / spacing, 0, len(plan) - 1.001)
    first = place.astype(int)
    way = plan[first] + (place - first)[:, None] * (plan[first + 1] - plan[first])
    along = np.gradient(way, axis=0)
    along /= np.maximum(np.hypot(*along.T), 1e-9)[:, None]
    offset = rng.uniform(0.25, 0.5) * rng.choice([-1.0, 1.0])
    way = way + offset * np.stack([-along[:, 1], along[:, 0]], axis=-1)
    meet = plan[int(meet_m / spacing)]
    return Walk(
        way,
        rng.uniform(0.5, 1.0),
        (float(meet[0]), float(meet[1]), float(rng.uniform(2.0, 3.5))),
        bool(rng.random() < 0.4),
    )


def _free_m(warehouse: Warehouse, place: F64, direction: F64, half_width_m: float) -> float:
    """Return how far a walk can go from a place before a rack or wall is too near; 6 m at most."""
    x, y = (place + direction * (0.1 * np.arange(1, 60))[:, None]).T
    floor = np.array([[0.0, 0.0, warehouse.width_m, warehouse.depth_m]])
    free = within(floor, x, y, half_width_m)[:, 0]
    free &= ~within(edges_of(warehouse.racks), x, y, -half_width_m).any(axis=1)
    return 6.0 if free.all() else 0.1 * int(free.argmin())


MISSION = Mission(
    "near_collision",
    stage,
    share=0.2,
    natural=0.06,
    colour="#d55e00",
    place=3,
    is_true=lambda situation: situation.near,
)
