"""A floor as a TOML file in metres: reading, writing and its keys.

    name = "hall 3"
    width_m = 12.0
    depth_m = 10.0
    racks = [[2.2, 1.8, 4.9, 2.733], [7.1, 1.8, 9.8, 2.733]] # x0, y0, x1, y1

    [[dock]]
    name = "dock_1"
    box_m = [0.0, 4.0, 1.2, 5.0]

    [[one_way]]
    box_m = [2.2, 2.733, 4.9, 4.533]
    heading = "east" # north, west, south

Aisles (`[[aisle]]` with name, box_m, along = "x" or "y"), goals, crossings and `[[zone]]` may be
given too; aisles, goals and crossings that are not are found from the racks. `starts` are places
where missions begin (else in aisles), `room_m` is how far plans keep a robot's middle off
obstacles, `way_m` how long a mission's way is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

from restock.errors import ConfigError
from restock.toml import Checked, read_toml, toml_value, typed
from restock.train.twin.floors.cells import cells_of, find_crossings, find_goals, find_segments
from restock.train.twin.floors.layout import (
    ROOM_M,
    WAY_M,
    AisleSegment,
    Axis,
    Dock,
    Heading,
    OneWay,
    Rect,
    Warehouse,
    bays,
)

Box = tuple[float, float, float, float]
CELL_M = 0.05  # in which aisles are looked for


class _NamedBox(Checked, frozen=True):
    name: str
    box_m: Box


class _OneWayRule(Checked, frozen=True):
    box_m: Box
    heading: Heading


class _Aisle(_NamedBox, frozen=True):
    along: Axis
    aisle: int = 0


class FloorFile(Checked, frozen=True):
    """The keys of a floor's TOML file; boxes are x0, y0, x1, y1 in metres."""

    width_m: float
    depth_m: float
    racks: list[Box]
    name: str = ""
    goals: list[tuple[float, float]] | None = None
    crossings: list[Box] | None = None
    map_origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    room_m: float = ROOM_M
    way_m: tuple[float, float] = WAY_M
    starts: list[tuple[float, float]] = msgspec.field(default_factory=list)
    aisles: list[_Aisle] | None = msgspec.field(default=None, name="aisle")
    zones: list[_NamedBox] = msgspec.field(default_factory=list, name="zone")
    docks: list[_NamedBox] = msgspec.field(default_factory=list, name="dock")
    one_way: list[_OneWayRule] = msgspec.field(default_factory=list)


def read_floor(path: Path) -> Warehouse:
    """Read the floor that a TOML file describes.

    Raises:
        ConfigError: no such file, an unknown or missing key, or numbers that do not make a floor.
    """
    remedy = "docs/layouts.md lists the keys of a floor"
    content = typed(read_toml(path), FloorFile, where=str(path), remedy=remedy)
    bare = Warehouse(
        width_m=content.width_m,
        depth_m=content.depth_m,
        racks=tuple(Rect(*box) for box in content.racks),
        segments=(),
        goals_m=tuple(content.goals or ()) or ((content.width_m / 2, content.depth_m / 2),),
        cross_zones=tuple((zone.name, Rect(*zone.box_m)) for zone in content.zones),
        docks=tuple(Dock(dock.name, Rect(*dock.box_m)) for dock in content.docks),
        one_way=tuple(OneWay(Rect(*rule.box_m), rule.heading) for rule in content.one_way),
        name=content.name or path.name,
        map_origin=content.map_origin,
        room_m=content.room_m,
        way_m=content.way_m,
        starts_m=tuple(content.starts),
    )
    free = cells_of(bare, CELL_M)
    segments = (
        find_segments(free, CELL_M)
        if content.aisles is None
        else tuple(AisleSegment(a.name, a.aisle, Rect(*a.box_m), a.along) for a in content.aisles)
    )
    crossings = (
        find_crossings(segments, free, CELL_M)
        if content.crossings is None
        else tuple(Rect(*box) for box in content.crossings)
    )
    goals = (
        bays(segments) + find_goals(free, CELL_M)
        if content.goals is None
        else tuple((x, y) for x, y in content.goals)
    )
    return replace(bare, segments=segments, crossings=crossings, goals_m=goals)


def floor_toml(floor: Warehouse, remarks: Sequence[str] = ()) -> str:
    """Return a floor as TOML that reads back equal, with remarks as comments on top."""
    values = {
        "name": floor.name,
        "width_m": float(floor.width_m),
        "depth_m": float(floor.depth_m),
        "map_origin": [float(value) for value in floor.map_origin],
        "room_m": float(floor.room_m),
        "way_m": [float(value) for value in floor.way_m],
    }
    lines = [f"# {remark}" for remark in remarks]
    lines += [f"{key} = {toml_value(value)}" for key, value in values.items()]
    for key, rows in (
        ("racks", map(_box, floor.racks)),
        ("crossings", map(_box, floor.crossings)),
        ("goals", ([float(x), float(y)] for x, y in floor.goals_m)),
        ("starts", ([float(x), float(y)] for x, y in floor.starts_m)),
    ):
        lines += [f"{key} = [", *(f"  {toml_value(row)}," for row in rows), "]"]
    if not floor.segments:
        lines.append("aisle = []")
    tables: list[tuple[str, dict[str, Any]]] = [
        *(
            ("aisle", {"name": s.name, "box_m": _box(s.area), "along": s.along, "aisle": s.aisle})
            for s in floor.segments
        ),
        *(("zone", {"name": name, "box_m": _box(area)}) for name, area in floor.cross_zones),
        *(("dock", {"name": dock.name, "box_m": _box(dock.area)}) for dock in floor.docks),
        *(("one_way", {"box_m": _box(r.area), "heading": r.heading}) for r in floor.one_way),
    ]
    for name, entries in tables:
        lines += ["", f"[[{name}]]", *(f"{k} = {toml_value(v)}" for k, v in entries.items())]
    return "\n".join(lines) + "\n"


def _box(area: Rect) -> list[float]:
    return [float(edge) for edge in area.edges]


def write_floor(floor: Warehouse, path: Path, remarks: Sequence[str] = ()) -> None:
    """Write a floor as TOML. Raises ConfigError if it cannot be written."""
    try:
        path.write_text(floor_toml(floor, remarks), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", where=str(path)) from error
