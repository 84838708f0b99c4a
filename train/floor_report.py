"""What a floor is and which episodes fit on it, before anything is trained there."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse import csgraph

from restock.errors import ConfigError
from restock.train.episode import KINDS, EpisodeSpec, draw_episode
from restock.train.layout import Warehouse
from restock.train.planner import Planner


def describe_floor(floor: Warehouse) -> dict[str, Any]:
    """Plain values: sizes in metres, counts, unreachable goals, and the kinds of episodes that fit.

    A goal is unreachable where no robot gets there from the largest part of the floor, by its
    one-way rules. `hash` names the floor whatever it is called.
    """
    planner = Planner(floor)
    _, part = csgraph.connected_components(planner._graph, connection="strong")
    cells = np.array([planner.cell(x, y) for x, y in floor.goals])
    largest = np.bincount(part[cells]).argmax()
    widths = [segment.width_m for segment in floor.segments]
    return {
        "name": floor.name,
        "hash": floor.hash,
        "width_m": floor.width_m,
        "depth_m": floor.depth_m,
        "racks": len(floor.racks),
        "aisle_segments": len(floor.segments),
        "narrowest_aisle_m": round(min(widths), 3) if widths else None,
        "widest_aisle_m": round(max(widths), 3) if widths else None,
        "one_way_rules": len(floor.one_way),
        "docks": len(floor.docks),
        "goals": len(floor.goals),
        "unreachable_goals": int((part[cells] != largest).sum()),
        "map_origin": list(floor.map_origin),
        "episodes": [kind for kind in KINDS if _fits(kind, floor, planner)],
    }


def _fits(kind: str, floor: Warehouse, planner: Planner) -> bool:
    """Whether an episode of this kind could be drawn."""
    try:
        draw_episode(EpisodeSpec(kind, 0), floor, planner)
    except ConfigError:
        return False
    return True
