"""ROS occupancy maps, `map.yaml` and its image: reads them as floors, and writes floors so.

As `nav2_map_server` reads them (https://docs.nav2.org, map_io.cpp): with `p` a pixel's darkness in
[0, 1], turned around by `negate`,

- `trinary`: occupied above `occupied_thresh`, free below `free_thresh`, else unknown;
- `scale`: the same, and in between a share of occupancy; what is transparent is unknown;
- `raw`: the pixel is the occupancy in percent; above 100, unknown; the thresholds hold on it.

The image's lower left corner is `origin` (x, y, yaw) in the map's frame.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from restock.arrays import F64
from restock.errors import ConfigError
from restock.toml import Checked, typed
from restock.train.twin.floors.cells import cells_of
from restock.train.twin.floors.layout import Warehouse
from restock.train.twin.floors.occupancy_grid import (
    FREE,
    MAX_CELLS,
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
    floor_of_grid,
)

Mode = Literal["trinary", "scale", "raw"]
FURTHEST_M = 1e6  # of an origin: beyond it a coordinate has no millimetres left
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
        ConfigError: as `read_grid`, or a map without room for the robot.
    """
    return floor_of_grid(read_grid(path), name=path.name, where=str(path)).floor


def read_grid(path: Path) -> OccupancyGrid:
    """Read the occupancy grid of a `map.yaml`.

    Raises:
        ConfigError: files that cannot be read, a key that is missing or out of range, an image
            that lies elsewhere, or is none.
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
    """Convert pixels (H, W) in [0, 1], north first, to occupancy (X, Y) in percent, -1 unknown."""
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


def read_image(path: Path) -> tuple[F64, NDArray[np.bool_]]:
    """Read shades (H, W) in [0, 1], top row first, and which pixels are opaque (H, W).

    Raises:
        ConfigError: no such file, one that is not a PGM, PNG or BMP, or is cut short or too large.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            opened = Image.open(path, formats=_FORMATS)
        with opened as image:
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
    except UnidentifiedImageError as error:
        raise ConfigError(
            "is not a PGM, PNG or BMP",
            where=str(path),
            remedy="convert it, such as with `convert map.tif map.png`",
        ) from error
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise ConfigError(
            f"has more than {MAX_CELLS:,} pixels",
            where=str(path),
            remedy="cut the map to the part that the robots drive in",
        ) from error
    except FileNotFoundError as error:
        raise ConfigError(
            f"cannot be read: {error.strerror}",
            where=str(path),
            remedy="image in map.yaml is a path beside it",
        ) from error
    except (OSError, ValueError, SyntaxError, OverflowError) as error:
        raise ConfigError(f"cannot be read as an image: {error}", where=str(path)) from error


def write_pgm(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Write pixels (H, W) as P5."""
    height, width = pixels.shape
    path.write_bytes(b"P5\n%d %d\n255\n" % (width, height) + pixels.tobytes())
