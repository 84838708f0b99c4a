"""Named parts of a surveyed floor; the same as `[[zone]]` of a profile, in the map's frame.

Aisles and crossings where a floor has them; where it has none, its quarters. Logs of the same map
and episodes in the twin then speak of the same places.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from restock.toml import toml_value
from restock.train.twin.floors.layout import Rect, Warehouse
from restock.train.twin.floors.occupancy_grid import out_of_frame

MIN_SIDE_M = 2.0  # of a floor that is worth quartering
_QUARTERS = (("south", "west"), ("south", "east"), ("north", "west"), ("north", "east"))


def with_zones(floor: Warehouse) -> Warehouse:
    """The floor with its crossings as zones beside its aisles, or its quarters without aisles."""
    if floor.segments:
        named = ((f"crossing_{k + 1}", area) for k, area in enumerate(floor.crossings))
        return replace(floor, cross_zones=tuple(named))
    if min(floor.width_m, floor.depth_m) < MIN_SIDE_M:
        return floor
    half_x, half_y = floor.width_m / 2, floor.depth_m / 2
    quarters = []
    for north, east in _QUARTERS:
        x, y = half_x * (east == "east"), half_y * (north == "north")
        quarters.append((f"{north}_{east}", Rect(x, y, x + half_x, y + half_y)))
    return replace(floor, cross_zones=tuple(quarters))


def profile_zones(floor: Warehouse) -> str:
    """The floor's zones as TOML for a profile: boxes in the map's frame, turned by `yaw_rad`."""
    yaw = float((floor.map_origin[2] + np.pi) % (2 * np.pi) - np.pi)
    lines: list[str] = []
    for name, area in floor.zones.items():
        x, y = out_of_frame(np.array([area.center]), floor.map_origin)[0].tolist()
        half_x, half_y = area.half_size
        box = [round(edge, 3) for edge in (x - half_x, y - half_y, x + half_x, y + half_y)]
        lines += ["[[zone]]", f"name = {toml_value(name)}", f"box_m = {toml_value(box)}"]
        lines += [f"yaw_rad = {round(yaw, 4)}"] if abs(yaw) > 1e-3 else []
        lines.append("")
    return "\n".join(lines)
