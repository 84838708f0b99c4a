"""Pallets across an aisle on the route, which leave a gap of .8 to 1 m or block it wholly."""

from __future__ import annotations

import numpy as np

from restock.arrays import F64
from restock.train.twin.floors.layout import PALLET_HALF_M, Warehouse, no_pallets
from restock.train.twin.missions.mission import Mission, Staged, length_m

GAP_M = (0.80, 1.00)


def stage(rng: np.random.Generator, warehouse: Warehouse, plan: F64) -> Staged | None:
    """Stage pallets across an aisle on the plan; None if there is no room."""
    block = "partial" if rng.random() < 0.5 else "full"
    pallets = _draw_block(rng, warehouse, plan, full=block == "full")
    return None if pallets is None else Staged(block, pallets=pallets)


def _draw_block(
    rng: np.random.Generator, warehouse: Warehouse, plan: F64, *, full: bool
) -> F64 | None:
    """Place pallets across an aisle on the route; None if there is no room."""
    if not warehouse.segments:
        return None
    spacing = length_m(plan) / (len(plan) - 1)
    arc = np.arange(len(plan)) * spacing
    segment = warehouse.segment_of(plan[:, 0], plan[:, 1])
    half_x, half_y = PALLET_HALF_M[:2]
    room = (arc >= 1.9) & (arc <= arc[-1] - 1.5) & (segment >= 0)
    edges = warehouse.segment_edges[np.maximum(segment, 0)]
    turned = warehouse.segment_along_y[np.maximum(segment, 0)]
    edges = np.where(turned[:, None], edges[:, [1, 0, 3, 2]], edges)
    along = np.where(turned, plan[:, 1], plan[:, 0])
    room &= (along > edges[:, 0] + half_x) & (along < edges[:, 2] - half_x)
    places = np.flatnonzero(room)
    if not len(places):
        return None
    place = int(rng.choice(places))
    area = warehouse.segments[segment[place]].lengthwise
    pallets = no_pallets()
    x = along[place]
    width = area.y_max - area.y_min
    if full:
        # Pallets stay between the racks of a narrow aisle, and leave no gap to pass in a wide one.
        near = min(half_y, max(width / 2 - half_y, 0.0))
        apart = float(np.clip(width / 2 - 2 * half_y, 0.0, 0.2))
        for row in range(2):
            side = 1 if row else -1
            y = area.center[1] + side * (near + rng.uniform(0.0, apart))
            pallets[row] = (x + rng.uniform(-0.1, 0.1), y, rng.normal(0.0, 0.03))
    else:
        gap = rng.uniform(*GAP_M)
        if width < gap + 0.15:
            return None
        side = rng.choice([-1.0, 1.0])
        y = area.center[1] + side * (width / 2 - gap - half_y)
        pallets[0] = (x, y, rng.normal(0.0, 0.02))
    if turned[place]:
        placed = pallets[:, 0] > 0
        pallets[placed] = pallets[placed][:, [1, 0, 2]]
        pallets[placed, 2] = np.pi / 2 - pallets[placed, 2]
    return pallets


MISSION = Mission(
    "blocked_aisle",
    stage,
    share=0.2,
    natural=0.07,
    colour="#e69f00",
    place=2,
    is_true=lambda situation: situation.plan_blocked,
    blocks={"partial": "#e69f00", "full": "#8a5a00"},
    block_measures={"partly_blocked": "partial", "wholly_blocked": "full"},
    needs_lidar=True,
)
