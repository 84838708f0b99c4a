"""Floors as files: TOML in metres, and ROS occupancy maps.

`docs/layouts.md` has an example and lists the keys of a floor. Aisles, goals and crossings that are
not given are found from the racks.

An occupancy map is a `map.yaml` and its image, read as `nav2_map_server` reads them
(https://docs.nav2.org, map_io.cpp). The `mode` decides what a pixel means:

- `trinary`: occupied if its darkness in [0, 1] (inverted by `negate`) is above `occupied_thresh`,
  free if below `free_thresh`, else unknown;
- `scale`: the same, but transparent pixels are unknown;
- `raw`: its value is the occupancy in percent, compared with the thresholds; unknown above 100.

The image's lower left corner is `origin` (x, y, yaw) in the map's frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray
from PIL import Image
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from restock.arrays import F64
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
from restock.train.twin.floors.occupancy_grid import (
    FREE,
    MAX_CELLS,
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
    floor_of_grid,
)

Box = tuple[float, float, float, float]
CELL_M = 0.05  # size of the cells in which aisles, crossings and goals are searched


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
    floor = Warehouse(
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
    free = cells_of(floor, CELL_M)
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
    return replace(floor, segments=segments, crossings=crossings, goals_m=goals)


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


Mode = Literal["trinary", "scale", "raw"]
FURTHEST_M = 1e6  # limit for an origin: float32 coordinates beyond it lose their millimetres
MAX_YAML = 1 << 20  # bytes
_FORMATS = ("PPM", "PNG", "BMP")  # PPM: Pillow's name for PGM and its kin


class MapDescription(Checked, frozen=True, forbid_unknown_fields=False):
    """The keys of a `map.yaml`. Other tools' keys are ignored."""

    image: str
    resolution: Annotated[float, Meta(ge=0.001, le=1)]  # metres a cell
    origin: tuple[float, float, float]
    occupied_thresh: float = 0.65
    free_thresh: float = 0.25
    negate: bool | int = 0
    mode: Mode = "trinary"

    def check(self) -> None:
        if not 0 <= self.free_thresh < self.occupied_thresh <= 1:
            raise ValueError(
                "free_thresh and occupied_thresh must rise within 0 to 1, got"
                f" {self.free_thresh} and {self.occupied_thresh}"
            )
        if not self.image or "\0" in self.image:
            raise ValueError(f"image is not a file name: {self.image!r}")
        if not (np.abs(self.origin) <= FURTHEST_M).all():  # False for NaN
            raise ValueError(
                f"origin must be three numbers within {FURTHEST_M:g}, got {list(self.origin)}"
            )


def read_map(path: Path) -> Warehouse:
    """Read the floor of an occupancy map.

    Raises:
        ConfigError: as in `read_grid`, or the map has no room for the robot.
    """
    return floor_of_grid(read_grid(path), name=path.name, where=str(path)).floor


def read_grid(path: Path) -> OccupancyGrid:
    """Read the occupancy grid of a `map.yaml`.

    Raises:
        ConfigError: a file cannot be read, a key is missing or out of range, or the image is not
            an image or is outside the map's folder.
    """
    description = _read_yaml(path)
    image = path.parent / description.image
    if not image.resolve().is_relative_to(path.parent.resolve()):
        raise ConfigError(
            f"its image {description.image!r} is outside its folder",
            where=str(path),
            remedy="copy the image into its folder, and give only the file's name in `image:`",
        )
    pixels, seen = read_image(image)
    occupancy = occupancy_of(pixels, description)
    if description.mode == "scale":
        occupancy[~np.ascontiguousarray(seen[::-1].T)] = UNKNOWN
    return OccupancyGrid(occupancy, description.resolution, description.origin)


def _read_yaml(path: Path) -> MapDescription:
    try:
        if path.stat().st_size > MAX_YAML:
            raise ConfigError("is too large for a map.yaml", where=str(path))
        document: Any = YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(
            f"cannot be read: {error.strerror}", where=str(path), remedy="check the path"
        ) from error
    except (YAMLError, UnicodeDecodeError, ValueError, RecursionError) as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(f"is not YAML: {reason}", where=str(path)) from error
    return typed(
        document,
        MapDescription,
        where=str(path),
        remedy="a map.yaml has image, resolution, origin: [x, y, yaw], and may have mode"
        f" ({', '.join(get_args(Mode))}), negate, occupied_thresh and free_thresh",
    )


def occupancy_of(pixels: F64, description: MapDescription) -> NDArray[np.int8]:
    """Convert pixels (H, W) in [0, 1], north first, to FREE, OCCUPIED or UNKNOWN cells (X, Y)."""
    low, high = description.free_thresh, description.occupied_thresh
    occupancy = np.full(pixels.shape, UNKNOWN, np.int8)
    if description.mode == "raw":
        percent = np.round(pixels * 255)
        occupancy[percent <= 100 * low] = FREE
        occupancy[(percent >= 100 * high) & (percent <= 100)] = OCCUPIED
    else:
        dark = pixels if description.negate else 1 - pixels
        occupancy[dark < low] = FREE
        occupancy[dark > high] = OCCUPIED
    return np.ascontiguousarray(occupancy[::-1].T)


def read_image(path: Path) -> tuple[F64, NDArray[np.bool_]]:
    """Read shades (H, W) in [0, 1], top row first, and which pixels are opaque (H, W).

    Raises:
        ConfigError: the file does not exist, is not a PGM, PNG or BMP, is cut short or too large.
    """
    try:
        with Image.open(path, formats=_FORMATS) as image:
            width, height = image.size
            if not 0 < width * height <= MAX_CELLS:
                raise ConfigError(
                    f"is {width:,} x {height:,} pixels, and {MAX_CELLS:,} at most can be read",
                    where=str(path),
                    remedy="cut the map to the part that the robots drive in",
                )
            image.load()
            seen = np.ones((height, width), np.bool_)
            if "A" in image.getbands() or "transparency" in image.info:
                seen = np.asarray(image.convert("RGBA").getchannel("A")) == 255
            if image.mode.startswith("I"):  # 16 bits: `convert` would clip them
                return np.asarray(image).astype(np.float64) / 65535, seen
            return np.asarray(image.convert("L")).astype(np.float64) / 255, seen
    except (OSError, ValueError, SyntaxError, OverflowError, Image.DecompressionBombError) as error:
        raise ConfigError(
            f"cannot be read as a PGM, PNG or BMP: {error}",
            where=str(path),
            remedy="image in map.yaml is a path beside it; convert other formats, such as with"
            " `convert map.tif map.png`",
        ) from error
