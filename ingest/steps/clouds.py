"""Scans from the point clouds of a 3-D lidar, like those of ROS's pointcloud_to_laserscan.

Points between two heights and two bearings become a scan. Each of its beams has the distance of the
nearest point, measured along the floor, or inf. Clouds are decoded column by column, in the layout
that their own fields define, and one at a time, to save memory.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F32, F64
from restock.ingest.containers.storage import Fields, Reduction
from restock.ingest.decoding.columns import FieldColumn
from restock.ingest.profile.tables import Input

BEAM_RAD = np.pi / 360  # angle between two beams
_FIELDS = ("fields[].name", "fields[].offset", "fields[].datatype")
_SHAPE = ("height", "width", "point_step", "row_step", "is_bigendian")
CLOUD_PATHS = (*_FIELDS, *_SHAPE, "data")  # fields read of a sensor_msgs/msg/PointCloud2
_FLOATS = {7: "f4", 8: "f8"}  # PointField.FLOAT32 and FLOAT64 -> NumPy type


def cloud_reduction(source: Input, range_min_m: float) -> Reduction:
    """Build the reduction of clouds to scans, whose columns are named by `source.fields`.

    A cloud without any point at `range_min_m` or farther gets NaN ranges, like a lidar that sees
    nothing. A cloud that cannot be decoded gets a NaN angle.
    """
    low, high = source.angle_rad or (-np.pi, np.pi)
    beams = max(round((high - low) / BEAM_RAD), 1)

    def apply(fields: Fields) -> dict[str, FieldColumn]:
        count = len(fields["width"])
        ranges = np.full((count, beams), np.nan, np.float32)
        first = np.full(count, low + BEAM_RAD / 2)
        for row in range(count):
            points = points_of(fields, row)
            if points is None:
                first[row] = np.nan
            else:
                ranges[row] = _scan(source, points, range_min_m, low, beams)
        made = (ranges, first, np.full(count, BEAM_RAD))
        keys = ("ranges_m", "angle_min_rad", "angle_increment_rad")
        return {source.fields[key]: column for key, column in zip(keys, made, strict=True)}

    return Reduction(CLOUD_PATHS, apply)


def points_of(fields: Fields, row: int) -> F64 | None:
    """Return the points (3, P) of one cloud in its own frame, in metres, NaN included.

    None if the cloud is cut short, or lacks x, y or z as a float.
    """
    names, offsets, kinds = (tuple(np.asarray(fields[path][row]).tolist()) for path in _FIELDS)
    height, width, step, row_step = (int(np.asarray(fields[path])[row]) for path in _SHAPE[:4])
    layout = _layout(names, offsets, kinds, step, bool(np.asarray(fields["is_bigendian"])[row]))
    data = np.ascontiguousarray(fields["data"][row], np.uint8)
    if not height * width:
        return np.zeros((3, 0))
    short = (height - 1) * row_step + width * step > len(data)
    if layout is None or short or (height > 1 and row_step < width * step):
        return None
    rows = (row_step, step)  # strides in bytes: rows and points may be padded
    table: NDArray[Any] = np.ndarray((height, width), layout, data.data, strides=rows)
    return np.stack([table[axis].ravel().astype(np.float64) for axis in "xyz"])


@lru_cache(maxsize=64)
def _layout(
    names: tuple[str, ...], offsets: tuple[int, ...], kinds: tuple[int, ...], step: int, big: bool
) -> np.dtype[Any] | None:
    """Return the layout of x, y and z in a point; None if any is missing or not a float."""
    at = {name: place for place, name in enumerate(names)}
    if not {"x", "y", "z"} <= at.keys():
        return None
    places = [at[axis] for axis in "xyz"]
    types = [_FLOATS.get(kinds[place]) for place in places]
    if None in types:
        return None
    formats = [(">" if big else "<") + str(one) for one in types]
    xyz, at_byte = list("xyz"), [offsets[place] for place in places]
    try:
        return np.dtype({"names": xyz, "formats": formats, "offsets": at_byte, "itemsize": step})
    except ValueError:  # a field lies beyond the end of a point
        return None


def _scan(source: Input, points: F64, range_min_m: float, low: float, beams: int) -> F32:
    """Return the distance of the nearest point in each beam, in metres along the floor."""
    x, y, z = points[:, np.isfinite(points).all(axis=0)]
    far = np.hypot(x, y)
    there = far >= range_min_m
    scan = np.full(beams, np.inf if there.any() else np.nan, np.float32)
    bottom, top = source.height_m or (-np.inf, np.inf)
    up = -z if source.upside_down else z
    beam = np.floor((np.arctan2(y, x) - low) / BEAM_RAD).astype(np.int64)
    beam[beam == beams] -= 1  # a point at exactly the last bearing belongs to the last beam
    kept = there & (bottom <= up) & (up <= top) & (beam >= 0) & (beam < beams)
    np.minimum.at(scan, beam[kept], far[kept].astype(np.float32))
    return scan
