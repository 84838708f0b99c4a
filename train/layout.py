"""The warehouse: its racks, aisles and cross-aisles, in metres in the map frame.

The map frame has its origin in the floor's south-west corner, x east and y north. Aisles run east
and west between the racks; cross-aisles run north and south and join them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from restock.errors import ConfigError

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Rect:
    """An axis-aligned rectangle."""

    x_min: float
    y_min: float
    x_max: float
    y_max: float

    @property
    def center(self) -> tuple[float, float]:
        return (self.x_min + self.x_max) / 2, (self.y_min + self.y_max) / 2

    @property
    def half_size(self) -> tuple[float, float]:
        return (self.x_max - self.x_min) / 2, (self.y_max - self.y_min) / 2

    def contains(self, x_m: float, y_m: float, margin_m: float = 0.0) -> bool:
        """Whether the point lies inside, at least `margin_m` from every side."""
        return (
            self.x_min + margin_m <= x_m <= self.x_max - margin_m
            and self.y_min + margin_m <= y_m <= self.y_max - margin_m
        )


@dataclass(frozen=True)
class Segment:
    """The part of an aisle between two cross-aisles: what a block closes."""

    name: str  # aisle_2_west
    aisle: int
    area: Rect


@dataclass(frozen=True)
class Warehouse:
    """Racks in a grid: `aisle_y_m` and `cross_x_m` are the free strips between them.

    The first and last strips lie along the walls.
    """

    width_m: float
    depth_m: float
    aisle_y_m: tuple[tuple[float, float], ...]  # (south, north) of each aisle
    cross_x_m: tuple[tuple[float, float], ...]  # (west, east) of each cross-aisle
    wall_m: float = 0.1

    def __post_init__(self) -> None:
        for name, strips, end in (
            ("aisles", self.aisle_y_m, self.depth_m),
            ("cross-aisles", self.cross_x_m, self.width_m),
        ):
            edges = [edge for strip in strips for edge in strip]
            if len(strips) < 2 or edges != sorted(edges) or edges[0] < 0 or edges[-1] > end:
                raise ConfigError(
                    f"{name} {strips} are not two or more strips in order within 0 to {end} m",
                    where="warehouse layout",
                    remedy="give each strip as (start, end) in metres, in rising order",
                )

    @cached_property
    def racks(self) -> tuple[Rect, ...]:
        """The racks: everything between two aisles and two cross-aisles."""
        return tuple(
            Rect(west[1], south[1], east[0], north[0])
            for south, north in zip(self.aisle_y_m[:-1], self.aisle_y_m[1:], strict=True)
            for west, east in zip(self.cross_x_m[:-1], self.cross_x_m[1:], strict=True)
        )

    @cached_property
    def segments(self) -> tuple[Segment, ...]:
        """The aisle segments, from the south-west, eastwards then northwards."""
        part = ("west", "east") if len(self.cross_x_m) == 3 else None
        found = []
        for aisle, (south, north) in enumerate(self.aisle_y_m):
            pairs = zip(self.cross_x_m[:-1], self.cross_x_m[1:], strict=True)
            for index, (west, east) in enumerate(pairs):
                suffix = part[index] if part else str(index + 1)
                area = Rect(west[1], south, east[0], north)
                found.append(Segment(f"aisle_{aisle + 1}_{suffix}", aisle, area))
        return tuple(found)

    @cached_property
    def crossings(self) -> tuple[Rect, ...]:
        """Where an aisle meets a cross-aisle."""
        return tuple(
            Rect(west, south, east, north)
            for south, north in self.aisle_y_m
            for west, east in self.cross_x_m
        )

    @cached_property
    def zones(self) -> dict[str, Rect]:
        """Named parts of the map, for coverage: the same names and edges as in the profile."""
        zones = {segment.name: segment.area for segment in self.segments}
        names = ("west", "middle", "east") if len(self.cross_x_m) == 3 else None
        for index, (west, east) in enumerate(self.cross_x_m):
            zones[f"cross_{names[index] if names else index + 1}"] = Rect(
                west, 0.0, east, self.depth_m
            )
        return zones

    @cached_property
    def goals(self) -> F64:
        """Where a robot may be sent, (G, 2): bays along the aisles and the crossings' middles."""
        bays = [
            (x, segment.area.center[1])
            for segment in self.segments
            for x in np.arange(segment.area.x_min + 0.45, segment.area.x_max - 0.2, 0.6)
        ]
        return np.array(bays + [crossing.center for crossing in self.crossings])

    def segment_of(self, x_m: F64, y_m: F64) -> NDArray[np.int64]:
        """The index of the aisle segment each point lies in, (N,); -1 for none."""
        return np.where(
            (found := self._inside(x_m, y_m)).any(axis=1), found.argmax(axis=1), -1
        ).astype(np.int64)

    def _inside(self, x_m: F64, y_m: F64) -> NDArray[np.bool_]:
        edges = self.segment_edges
        x, y = np.asarray(x_m)[:, None], np.asarray(y_m)[:, None]
        inside: NDArray[np.bool_] = (
            (edges[:, 0] <= x) & (x <= edges[:, 2]) & (edges[:, 1] <= y) & (y <= edges[:, 3])
        )
        return inside

    @cached_property
    def segment_edges(self) -> F64:
        """(S, 4): x_min, y_min, x_max, y_max of each aisle segment."""
        return np.array(
            [(a.x_min, a.y_min, a.x_max, a.y_max) for a in (s.area for s in self.segments)]
        )


def default_warehouse() -> Warehouse:
    """12 x 10 m: four aisles 1.8 m wide, three cross-aisles 2.2 m wide, six racks."""
    rack, aisle = 2.8 / 3, 1.8
    starts = [index * (aisle + rack) for index in range(4)]
    return Warehouse(
        width_m=12.0,
        depth_m=10.0,
        aisle_y_m=tuple((round(y, 3), round(y + aisle, 3)) for y in starts),
        cross_x_m=((0.0, 2.2), (4.9, 7.1), (9.8, 12.0)),
    )
