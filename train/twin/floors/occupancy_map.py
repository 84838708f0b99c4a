"""ROS occupancy maps, `map.yaml` and a PGM, as floors of the twin; and floors as such maps.

As `nav2_map_server` reads them (https://docs.nav2.org, map_io.cpp): with `p` a pixel's darkness in
[0, 1], turned around by `negate`,

- `trinary`: occupied above `occupied_thresh`, free below `free_thresh`, else unknown;
- `scale`: the same, and in between a share of occupancy;
- `raw`: the pixel is the occupancy in percent; above 100, unknown; the thresholds hold on it.

The twin's floor is the largest free part of the map. What is not free, or unknown, is obstacle. The
image's lower left corner is `origin` (x, y, yaw) in the map's frame; the floor keeps the image's
axes, and `Warehouse.map_origin` the way back.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from scipy import ndimage

from restock.arrays import F64
from restock.errors import ConfigError
from restock.toml import Checked, typed
from restock.train.twin.floors.cells import (
    Cells,
    cells_of,
    cover,
    find_crossings,
    find_goals,
    find_segments,
)
from restock.train.twin.floors.layout import MAX_RACKS, MAX_SIDE_M, Rect, Warehouse, bays

Mode = Literal["trinary", "scale", "raw"]
FREE, OCCUPIED, UNKNOWN = 0, 100, -1
ROOM_M = 0.3  # as the planner: a robot's middle comes no nearer to an obstacle
COARSEST_M = 0.2
MAX_PIXELS = 64_000_000
_SPACE = re.compile(rb"(?:\s|#[^\r\n]*[\r\n])*")
_TOKEN = re.compile(rb"[^\s#]+")


class MapDescription(Checked, frozen=True, forbid_unknown_fields=False):
    """What a `map.yaml` says. Keys that are not here are of other tools, and left alone."""

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
        if not np.isfinite(self.origin).all():
            raise ValueError(f"origin must be three finite numbers, got {list(self.origin)}")


def read_map(path: Path) -> Warehouse:
    """The floor of an occupancy map.

    Raises:
        ConfigError: files that cannot be read, a key that is missing or out of range, an image that
            is not a PGM, or a map without room for the robot.
    """
    description = _read_yaml(path)
    image = path.parent / description.image
    occupancy = occupancy_of(read_pgm(image), description)
    return floor_of_cells(
        occupancy == FREE,
        description.resolution,
        origin=description.origin,
        name=path.name,
        where=str(image),
    )


def _read_yaml(path: Path) -> MapDescription:
    try:
        document: Any = YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(
            f"cannot be read: {error.strerror}", where=str(path), remedy="check the path"
        ) from error
    except (YAMLError, UnicodeDecodeError) as error:
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
    """Occupancy (X, Y) in percent, -1 unknown, of pixels (H, W) in [0, 1], north first."""
    if description.mode == "raw":
        percent = np.round(pixels * 255)
        occupancy = np.where(percent <= 100, percent, UNKNOWN)
        low, high = description.free_thresh * 100, description.occupied_thresh * 100
        occupancy = np.where((occupancy >= 0) & (occupancy <= low), FREE, occupancy)
        occupancy = np.where(occupancy >= high, OCCUPIED, occupancy)
    else:
        dark = pixels if description.negate else 1 - pixels
        between: Any = UNKNOWN
        if description.mode == "scale":
            span = description.occupied_thresh - description.free_thresh
            between = np.clip(np.round((dark - description.free_thresh) / span * 98 + 1), 1, 99)
        occupancy = np.where(dark > description.occupied_thresh, OCCUPIED, between)
        occupancy = np.where(dark < description.free_thresh, FREE, occupancy)
    return np.ascontiguousarray(occupancy[::-1].T.astype(np.int8))


def floor_of_cells(
    free: Cells,
    cell_m: float,
    *,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    name: str,
    where: str,
) -> Warehouse:
    """The floor of free cells (X, Y): the largest part that a robot fits in.

    Raises:
        ConfigError: no such part, one too large, or obstacles too ragged for boxes.
    """
    drivable = _reachable(free, cell_m)
    if not drivable.any():
        raise ConfigError(
            f"has no free place that a robot fits in: {int(free.sum()):,} of"
            f" {free.size:,} cells are free",
            where=where,
            remedy="check mode, negate and the thresholds in map.yaml",
        )
    # Free cells that belong to it: within the room around its cells.
    near = ndimage.distance_transform_edt(~drivable) * cell_m <= 1.5 * ROOM_M + cell_m
    free = free & near
    columns, rows = np.flatnonzero(free.any(axis=1)), np.flatnonzero(free.any(axis=0))
    i0, i1, j0, j1 = columns[0], columns[-1] + 1, rows[0], rows[-1] + 1
    free = free[i0:i1, j0:j1]
    if max(free.shape) * cell_m > MAX_SIDE_M:
        raise ConfigError(
            f"its free part is {free.shape[0] * cell_m:.1f} x {free.shape[1] * cell_m:.1f} m, more"
            f" than {MAX_SIDE_M:g} m",
            where=where,
            remedy="cut the map to the part that the robots drive in",
        )
    corner = (float(i0 * cell_m), float(j0 * cell_m))
    free, cell_m, racks = _racks(free, cell_m, where)
    shape = (round(free.shape[0] * cell_m, 6), round(free.shape[1] * cell_m, 6))
    reachable = _reachable(free, cell_m)
    segments = tuple(
        segment
        for segment in find_segments(free, cell_m)
        if _holds(reachable, cell_m, segment.area.center)
    )
    goals = find_goals(free & reachable, cell_m)
    goals += tuple(bay for bay in bays(segments) if _holds(reachable, cell_m, bay))
    x0, y0, yaw = origin
    cos, sin = float(np.cos(yaw)), float(np.sin(yaw))
    return Warehouse(
        width_m=shape[0],
        depth_m=shape[1],
        racks=racks,
        segments=segments,
        goals_m=goals,
        crossings=find_crossings(segments, free, cell_m),
        name=name,
        map_origin=(
            x0 + cos * corner[0] - sin * corner[1],
            y0 + sin * corner[0] + cos * corner[1],
            yaw,
        ),
    )


def _racks(free: Cells, cell_m: float, where: str) -> tuple[Cells, float, tuple[Rect, ...]]:
    """The obstacles as boxes; cells are made coarser, and never freer, until few boxes do."""
    while cell_m <= COARSEST_M:
        boxes = cover(~free, MAX_RACKS)
        if boxes is not None:
            edges = [(a, c, b, d) for a, b, c, d in boxes]
            racks = tuple(Rect(*(round(e * cell_m, 6) for e in edge)) for edge in edges)
            return free, cell_m, racks
        padded = np.pad(free, [(0, size % 2) for size in free.shape])
        pairs = padded.reshape(padded.shape[0] // 2, 2, padded.shape[1] // 2, 2)
        free = np.asarray(pairs.all(axis=(1, 3)), np.bool_)
        cell_m *= 2
    raise ConfigError(
        f"its obstacles take more than {MAX_RACKS} boxes, even at {cell_m / 2:g} m a cell",
        where=where,
        remedy="cut the map, or clean it of speckles",
    )


def _reachable(free: Cells, cell_m: float) -> Cells:
    """The largest part that a robot's middle can be in."""
    room = ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1] * cell_m
    parts, count = ndimage.label(room >= ROOM_M)
    if not count:
        return np.zeros_like(free)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    return np.asarray(parts == int(np.argmax(sizes)), np.bool_)


def _holds(cells: Cells, cell_m: float, place: tuple[float, float]) -> bool:
    i, j = (min(int(at / cell_m), size - 1) for at, size in zip(place, cells.shape, strict=True))
    return bool(cells[i, j])


def write_map(floor: Warehouse, path: Path, cell_m: float = 0.05) -> None:
    """Write a floor as `map.yaml` with a PGM beside it, walls as cells around it.

    Raises:
        ConfigError: it cannot be written there.
    """
    image = path.with_suffix(".pgm")
    free = np.pad(cells_of(floor, cell_m), 1)  # a wall around it
    x0, y0, yaw = floor.map_origin
    cos, sin = float(np.cos(yaw)), float(np.sin(yaw))
    corner = (x0 - cell_m * (cos - sin), y0 - cell_m * (sin + cos), yaw)
    text = (
        f"image: {image.name}\nmode: trinary\nresolution: {cell_m}\n"
        f"origin: [{', '.join(repr(float(value)) for value in corner)}]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.25\n"
    )
    try:
        write_pgm(image, np.where(free, 254, 0).astype(np.uint8).T[::-1])
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", where=str(path)) from error


def read_pgm(path: Path) -> F64:
    """Pixels (H, W) in [0, 1], the first row on top.

    Raises:
        ConfigError: no such file, one that is not a PGM, or one that is cut short or too large.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError(
            f"cannot be read: {error.strerror}",
            where=str(path),
            remedy="image in map.yaml is a path beside it",
        ) from error
    if data[:2] not in (b"P2", b"P5"):
        raise ConfigError(
            f"is not a PGM: it begins with {data[:2]!r}",
            where=str(path),
            remedy="convert it, such as with `convert map.png map.pgm`",
        )
    place, header = 2, []
    for name in ("width", "height", "largest value"):
        number, place = _number(data, place, name, path)
        header.append(number)
    width, height, largest = header
    if not (width > 0 and height > 0 and width * height <= MAX_PIXELS and 0 < largest < 65536):
        raise ConfigError(
            f"its header says {width} x {height} pixels of 0 to {largest}",
            where=str(path),
            remedy=f"at most {MAX_PIXELS:,} pixels of 0 to 65535",
        )
    count = width * height
    if data[:2] == b"P5":
        kind = np.dtype(np.uint8 if largest < 256 else ">u2")
        body = data[place + 1 : place + 1 + count * kind.itemsize]
        values = np.frombuffer(body[: len(body) // kind.itemsize * kind.itemsize], kind)
    else:
        text = re.sub(rb"#[^\r\n]*", b"", data[place:])
        try:
            values = np.array(text.split()[:count], np.int64)
        except ValueError as error:
            raise ConfigError("has a pixel that is not a number", where=str(path)) from error
    if len(values) < count:
        raise ConfigError(f"is cut short: {len(values):,} of {count:,} pixels", where=str(path))
    if values.max() > largest or values.min() < 0:
        raise ConfigError(f"has a pixel outside 0 to {largest}", where=str(path))
    shares: F64 = values.astype(np.float64) / largest
    return shares.reshape(height, width)


def _number(data: bytes, place: int, name: str, path: Path) -> tuple[int, int]:
    skipped = _SPACE.match(data, place)
    token = _TOKEN.match(data, skipped.end() if skipped else place)
    if token is None or not token[0].isdigit() or len(token[0]) > 9:
        raise ConfigError(f"its header has no {name}", where=str(path))
    return int(token[0]), token.end()


def write_pgm(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Write pixels (H, W) as P5."""
    height, width = pixels.shape
    path.write_bytes(b"P5\n%d %d\n255\n" % (width, height) + pixels.tobytes())
