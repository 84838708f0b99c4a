"""A floor as TOML, in metres: what a person writes, and what is written back.

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
given too; aisles, goals and crossings that are not are found from the racks.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import msgspec

from restock.errors import ConfigError
from restock.toml import toml_value
from restock.train.twin.floors.corridors import find_crossings, find_goals, find_segments
from restock.train.twin.floors.layout import (
    AisleSegment,
    Axis,
    Dock,
    Heading,
    OneWay,
    Rect,
    Warehouse,
    bays,
)
from restock.train.twin.floors.occupancy_map import cells_of

Box = tuple[float, float, float, float]
CELL_M = 0.05  # in which aisles are looked for


class _Dock(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: str
    box_m: Box


class _OneWay(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    box_m: Box
    heading: Heading


class _Aisle(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: str
    box_m: Box
    along: Axis
    aisle: int = 0


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    width_m: float
    depth_m: float
    racks: list[Box]
    name: str = ""
    goals: list[tuple[float, float]] | None = None
    crossings: list[Box] | None = None
    map_origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    aisles: list[_Aisle] | None = msgspec.field(default=None, name="aisle")
    zones: list[_Dock] = msgspec.field(default_factory=list, name="zone")
    docks: list[_Dock] = msgspec.field(default_factory=list, name="dock")
    one_way: list[_OneWay] = msgspec.field(default_factory=list)


def read_floor(path: Path) -> Warehouse:
    """The floor that a TOML file describes.

    Raises:
        ConfigError: no such file, an unknown or missing key, or numbers that are no floor.
    """
    try:
        said = msgspec.toml.decode(path.read_bytes(), type=_File)
    except OSError as error:
        raise ConfigError(
            f"cannot be read: {error.strerror}", where=str(path), remedy="check the path"
        ) from error
    except (msgspec.ValidationError, msgspec.DecodeError) as error:
        raise ConfigError(
            str(error).replace("Object ", "").replace("$.", ""),
            where=str(path),
            remedy="docs/layouts.md lists the keys of a floor",
        ) from error
    bare = Warehouse(
        width_m=said.width_m,
        depth_m=said.depth_m,
        racks=tuple(Rect(*box) for box in said.racks),
        segments=(),
        goals_m=tuple(said.goals or ()) or ((said.width_m / 2, said.depth_m / 2),),
        cross_zones=tuple((zone.name, Rect(*zone.box_m)) for zone in said.zones),
        docks=tuple(Dock(dock.name, Rect(*dock.box_m)) for dock in said.docks),
        one_way=tuple(OneWay(Rect(*rule.box_m), rule.heading) for rule in said.one_way),
        name=said.name or path.name,
        map_origin=said.map_origin,
    )
    free = cells_of(bare, CELL_M)
    segments = (
        find_segments(free, CELL_M)
        if said.aisles is None
        else tuple(AisleSegment(a.name, a.aisle, Rect(*a.box_m), a.along) for a in said.aisles)
    )
    crossings = (
        find_crossings(segments, free, CELL_M)
        if said.crossings is None
        else tuple(Rect(*box) for box in said.crossings)
    )
    goals = (
        bays(segments) + find_goals(free, CELL_M)
        if said.goals is None
        else tuple((x, y) for x, y in said.goals)
    )
    return replace(bare, segments=segments, crossings=crossings, goals_m=goals)


def floor_toml(floor: Warehouse) -> str:
    """A floor as TOML that reads back equal."""

    def box(area: Rect) -> str:
        return toml_value([float(e) for e in (area.x_min, area.y_min, area.x_max, area.y_max)])

    lines = [
        f"name = {toml_value(floor.name)}",
        f"width_m = {float(floor.width_m)!r}",
        f"depth_m = {float(floor.depth_m)!r}",
        f"map_origin = {toml_value([float(value) for value in floor.map_origin])}",
        "racks = [",
        *(f"  {box(rack)}," for rack in floor.racks),
        "]",
        "crossings = [",
        *(f"  {box(crossing)}," for crossing in floor.crossings),
        "]",
        "goals = [",
        *(f"  {toml_value([float(x), float(y)])}," for x, y in floor.goals_m),
        "]",
    ]
    if not floor.segments:
        lines.append("aisle = []")
    for segment in floor.segments:
        lines += [
            "",
            "[[aisle]]",
            f"name = {toml_value(segment.name)}",
            f"box_m = {box(segment.area)}",
        ]
        lines += [f"along = {toml_value(segment.along)}", f"aisle = {segment.aisle}"]
    for name, area in floor.cross_zones:
        lines += ["", "[[zone]]", f"name = {toml_value(name)}", f"box_m = {box(area)}"]
    for dock in floor.docks:
        lines += ["", "[[dock]]", f"name = {toml_value(dock.name)}", f"box_m = {box(dock.area)}"]
    for rule in floor.one_way:
        lines += [
            "",
            "[[one_way]]",
            f"box_m = {box(rule.area)}",
            f"heading = {toml_value(rule.heading)}",
        ]
    return "\n".join(lines) + "\n"


def write_floor(floor: Warehouse, path: Path) -> None:
    """Write a floor as TOML. Raises ConfigError where it cannot be written."""
    try:
        path.write_text(floor_toml(floor), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", where=str(path)) from error
