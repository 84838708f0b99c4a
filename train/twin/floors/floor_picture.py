"""A floor drawn from above, as PNG: racks, aisles, docks, goals and one-way rules."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from restock.errors import ConfigError
from restock.train.twin.floors.layout import HEADINGS, Rect, Warehouse

PIXELS_PER_M = 24
FLOOR, RACK, AISLE, DOCK = (238, 238, 236), (92, 108, 132), (222, 232, 220), (250, 214, 150)
GOAL, RULE, WALL = (30, 150, 60), (205, 70, 60), (70, 74, 80)


def draw_floor(floor: Warehouse) -> NDArray[np.uint8]:
    """(H, W, 3) uint8, north up, a wall around it."""
    size = (round(floor.depth_m * PIXELS_PER_M), round(floor.width_m * PIXELS_PER_M))
    image = np.empty((*size, 3), np.uint8)
    image[:] = FLOOR

    def fill(box: Rect, colour: tuple[int, int, int]) -> None:
        x0, y0, x1, y1 = (
            round(edge * PIXELS_PER_M) for edge in (box.x_min, box.y_min, box.x_max, box.y_max)
        )
        image[y0:y1, x0:x1] = colour

    for segment in floor.segments:
        fill(segment.area, AISLE)
    for dock in floor.docks:
        fill(dock.area, DOCK)
    for rack in floor.racks:
        fill(rack, RACK)
    for x, y in floor.goals.tolist():
        fill(Rect(x - 0.06, y - 0.06, x + 0.06, y + 0.06), GOAL)
    for rule in floor.one_way:
        _arrow(image, rule.area, HEADINGS[rule.heading])
    framed = np.empty((size[0] + 8, size[1] + 8, 3), np.uint8)
    framed[:] = WALL
    framed[4:-4, 4:-4] = image
    return np.ascontiguousarray(framed[::-1])


def _arrow(image: NDArray[np.uint8], area: Rect, heading: tuple[int, int]) -> None:
    """A triangle in the middle of an area that points the way."""
    rows, columns = np.indices(image.shape[:2])
    x = (columns + 0.5) / PIXELS_PER_M - area.center[0]
    y = (rows + 0.5) / PIXELS_PER_M - area.center[1]
    ahead = heading[0] * x + heading[1] * y
    aside = np.abs(heading[1] * x - heading[0] * y)
    image[(ahead > -0.35) & (ahead < 0.35) & (aside < (0.35 - ahead) / 2)] = RULE


def write_png(path: Path, image: NDArray[np.uint8]) -> None:
    """Write pixels (H, W, 3). Raises ConfigError where they cannot be written."""
    height, width = image.shape[:2]
    rows = np.concatenate([np.zeros((height, 1), np.uint8), image.reshape(height, -1)], axis=1)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    data = b"\x89PNG\r\n\x1a\n" + chunk(
        b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    )
    data += chunk(b"IDAT", zlib.compress(rows.tobytes(), 9)) + chunk(b"IEND", b"")
    try:
        path.write_bytes(data)
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", where=str(path)) from error
