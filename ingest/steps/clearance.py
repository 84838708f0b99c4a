"""A topic's laser scans to clearance per sector, while they are read: the ranges are not kept."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Ints
from restock.errors import RecordingError
from restock.ingest.containers.topic_reading import Fields, Reduction
from restock.ingest.decoding.columns import FieldColumn, Ragged, cut, take
from restock.ingest.profile.tables import Input
from restock.ingest.task.scan import MovedMap, SectorMap
from restock.ingest.task.task import Task

# What is made of a scan, beside the message's own fields (whose names hold no space).
SECTORS = "clearance of each sector"  # (N, sectors) float64, m
BEAMS = "number of beams"  # (N,) int64
CLOSE = "whether a beam is too close to be measured"  # (N,) bool: -inf (REP 117)
BLIND = "whether no beam has a valid range"  # (N,) bool; inf is one: nothing was hit
UNAIMED = "whether its angles say where no beam points"  # (N,) bool

_VALUES = 1 << 18  # ranges reduced at a time: what is in between stays in the processor's cache
_MAPS = 64  # geometries that are remembered; a lidar has one
_TURNS_RAD = 4 * np.pi  # angles beyond two turns are not in radians


def scan_reduction(task: Task, source: Input) -> Reduction:
    """Build the reduction of an input's scans to SECTORS, BEAMS, CLOSE, BLIND and UNAIMED.

    Its `apply` raises RecordingError where an angle is not one number a message.
    """
    reducer = _ScanReducer(task, source)
    return Reduction(tuple(dict.fromkeys(reducer.paths)), reducer)


def angle_keys(fields: Mapping[str, str]) -> tuple[str, str]:
    """Return the fields that define the angles of a scan's beams, as `beam_angles` takes them."""
    last = "angle_max_rad" if "angle_max_rad" in fields else "angle_increment_rad"
    return "angle_min_rad", last


def beam_angles(source: Input, first: F64, last: F64, beams: Ints) -> tuple[F64, F64]:
    """Return the angle of the first beam and the step to the next, (N,), counter-clockwise.

    As seen from above, either as the scans have them or by the angle of the last beam.
    """
    increment = last
    if "angle_max_rad" in source.fields:
        with np.errstate(invalid="ignore", over="ignore"):
            increment = np.asarray((last - first) / np.maximum(beams - 1, 1))
    return (-first, -increment) if source.upside_down else (first, increment)


class _ScanReducer:
    def __init__(self, task: Task, source: Input) -> None:
        self.task, self.source = task, source
        fields = source.fields
        self.paths = [fields[key] for key in ("ranges_m", *angle_keys(fields))]
        self._maps: dict[tuple[float, float, int], SectorMap | MovedMap] = {}

    def __call__(self, fields: Fields) -> dict[str, FieldColumn]:
        ranges = fields[self.paths[0]]
        first, last = (self._angle(fields, path) for path in self.paths[1:])
        if isinstance(ranges, Ragged):
            beams = ranges.lengths
        else:
            beams = np.full(len(ranges), ranges.shape[1] if ranges.ndim > 1 else 1, np.int64)
        first, increment = beam_angles(self.source, first, last, beams)
        clearance = np.full((len(beams), self.task.sectors), float(self.task.range_max_m))
        close, blind = np.zeros((2, len(beams)), np.bool_)
        with np.errstate(invalid="ignore", over="ignore"):
            angles = np.maximum(np.abs(first), np.abs(first + increment * (beams - 1)))
        unaimed = (beams > 0) & ~(angles <= _TURNS_RAD)  # so is NaN
        unaimed |= (beams > 1) & (increment == 0)
        geometry = np.stack([first, increment, np.where(unaimed, 0, beams)], axis=1)
        if len(geometry) and (geometry == geometry[0]).all():
            self._fill(clearance, close, blind, ranges, None, geometry[0])
        else:
            kinds, kind = np.unique(geometry, axis=0, return_inverse=True)
            for index, one in enumerate(kinds):
                rows = np.flatnonzero(kind == index)
                self._fill(clearance, close, blind, ranges, rows, one)
        return {
            SECTORS: clearance,
            BEAMS: beams,
            CLOSE: close,
            BLIND: blind,
            UNAIMED: unaimed,
        }

    def _fill(
        self,
        clearance: NDArray[np.float64],
        close: NDArray[np.bool_],
        blind: NDArray[np.bool_],
        ranges: FieldColumn,
        rows: NDArray[np.intp] | None,
        geometry: NDArray[np.float64],
    ) -> None:
        """Write what is made of these rows (None: of all), which have one geometry."""
        first, increment, beams = float(geometry[0]), float(geometry[1]), int(geometry[2])
        if not beams:
            return
        sectors, task = self._map(first, increment, beams), self.task
        count = len(clearance) if rows is None else len(rows)
        some = max(_VALUES // beams, 1)
        for start in range(0, count, some):
            stop = min(start + some, count)
            if rows is None:
                here: Any = slice(start, stop)
                part = cut(ranges, start, stop)
            else:
                here = rows[start:stop]
                part = take(ranges, here)
            values = part.values if isinstance(part, Ragged) else part
            table = np.asarray(values).reshape(stop - start, beams)
            found = sectors.clearance(table, task.range_min_m, task.range_max_m)
            clearance[here] = found
            close[here] = np.isneginf(table).any(axis=1)
            seen = (found < task.range_max_m).any(axis=1)  # False for NaN: no beam ends there
            free = np.flatnonzero(~seen | close[here])
            if len(free):
                blind[start + free if rows is None else rows[start + free]] = ~(
                    table[free] >= task.range_min_m  # False for NaN
                ).any(axis=1)

    def _map(self, first: float, increment: float, beams: int) -> SectorMap | MovedMap:
        key = (first, increment, beams)
        sectors = self._maps.get(key)
        if sectors is None:
            if len(self._maps) >= _MAPS:
                self._maps.clear()
            bearings = first + increment * np.arange(beams)
            count, body, at_m = self.task.sectors, self.task.body, self.source.lidar_at_m
            if at_m is None:
                sectors = SectorMap.build(bearings, count, body)
            else:
                turned = bearings + (self.source.lidar_yaw_rad or 0.0)
                sectors = MovedMap.build(turned, count, body, at_m)
            self._maps[key] = sectors
        return sectors

    def _angle(self, fields: Fields, path: str) -> NDArray[np.float64]:
        column = fields[path]
        if isinstance(column, Ragged) or column.ndim != 1 or column.dtype.kind not in "biuf":
            raise RecordingError(
                f"{path!r} of {self.source.topic} is not one number per message",
                remedy="correct the `fields` of this scan in the profile's inputs",
            )
        return np.asarray(column, np.float64)
