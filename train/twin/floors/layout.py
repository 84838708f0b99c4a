"""A warehouse floor: racks, aisles, crossings, docks and one-way rules, in metres.

The floor's frame has its origin in the south-west corner, x east and y north; `map_origin` places
it in the map that a robot localises in. Floors are generated, read from TOML, or read from an
occupancy map: see `restock.train.twin.floors.floors`. `default_warehouse()` is the floor of the
sample logs, and the twin's own.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Bools, Ints
from restock.errors import ConfigError

PALLETS = 2
PALLET_HALF_M = (0.60, 0.40, 0.30)  # long side along the aisle
PEOPLE = 2
PERSON_RADIUS_M = 0.25
PERSON_HALF_HEIGHT_M = 0.85
FORKLIFTS = 1
FORKLIFT_HALF_M = (0.60, 0.40, 0.60)
PARKED_M = (-50.0, -50.0, 1.0)  # where bodies that an episode does not use are parked
AGENTS = PEOPLE + FORKLIFTS  # the people first
WAY_POINTS = 24
PATCHES = 4  # maximum per episode; a patch is a part of the floor with its own friction
NO_PATCH = (1e6, 1e6, 0.0, 0.0, 1.0)  # x, y, half x, half y, friction


@dataclass(frozen=True)
class Walk:
    """The path of a person or forklift, and its behaviour on the path."""

    way_m: F64  # (WAY_POINTS, 2), evenly spaced
    speed_mps: float
    trigger: tuple[float, float, float]  # x, y, radius: the walk starts when the robot is inside
    attentive: bool  # stops before a robot, even one that drives


def no_pallets() -> F64:
    """Return poses (PALLETS, 3) of pallets that are all parked off the floor."""
    return np.tile([PARKED_M[0], PARKED_M[1], 0.0], (PALLETS, 1))


def pallet_half_m(yaw_rad: F64) -> F64:
    """Return pallets' half sizes (..., 2) along x and y, exchanged if yaw is beyond 45 degrees."""
    across = np.abs(np.sin(yaw_rad))[..., None] > 0.7
    return np.where(across, PALLET_HALF_M[1::-1], PALLET_HALF_M[:2])


Axis = Literal["x", "y"]
Heading = Literal["east", "north", "west", "south"]

HEADINGS: dict[str, tuple[int, int]] = {
    "east": (1, 0),
    "north": (0, 1),
    "west": (-1, 0),
    "south": (0, -1),
}
DEFAULT = "default"
ELSEWHERE = "elsewhere"
MIN_SIDE_M = 1.0
MAX_SIDE_M = 60.0  # planning on a larger floor takes seconds
MAX_RACKS = 400
ROOM_M = 0.3  # minimum distance from robot's middle to racks: half the stand-in's width, and more
WAY_M = (4.0, 11.0)  # shortest and longest route of a mission
BAY_M = 0.6  # distance between the goals along an aisle
ON_WALL_M = 0.25  # a lidar return this near to a wall is on it
NEAR_RETURN_M = 3.0  # returns farther from the lidar are off their wall if the yaw is imprecise


@dataclass(frozen=True)
class Rect:
    """An axis-aligned rectangle."""

    x_min: float
    y_min: float
    x_max: float
    y_max: float

    @property
    def edges(self) -> tuple[float, float, float, float]:
        """Return x_min, y_min, x_max, y_max."""
        return self.x_min, self.y_min, self.x_max, self.y_max

    @property
    def center(self) -> tuple[float, float]:
        return (self.x_min + self.x_max) / 2, (self.y_min + self.y_max) / 2

    @property
    def half_size(self) -> tuple[float, float]:
        return (self.x_max - self.x_min) / 2, (self.y_max - self.y_min) / 2

    @property
    def transposed(self) -> Rect:
        """Return the rectangle with x and y exchanged."""
        return Rect(self.y_min, self.x_min, self.y_max, self.x_max)


@dataclass(frozen=True)
class AisleSegment:
    """A part of an aisle between two cross-aisles. Pallets across it at any place close it.

    It runs along the axis `along`, between racks or walls on its two other sides.
    """

    name: str  # aisle_2_west
    aisle: int
    area: Rect
    along: Axis = "x"

    @property
    def lengthwise(self) -> Rect:
        """Return the area with x along the aisle: x and y are exchanged if the aisle runs north."""
        return self.area if self.along == "x" else self.area.transposed

    @property
    def width_m(self) -> float:
        """Return the width from rack to rack, in metres."""
        return self.lengthwise.y_max - self.lengthwise.y_min


@dataclass(frozen=True)
class Dock:
    """A named place where robots are sent to load and unload."""

    name: str
    area: Rect


@dataclass(frozen=True)
class OneWay:
    """A part of the floor where robots may drive, turn and cross, but not against `heading`."""

    area: Rect
    heading: Heading


@dataclass(frozen=True)
class Warehouse:
    """A floor within walls, on which everything but the racks is free."""

    width_m: float
    depth_m: float
    racks: tuple[Rect, ...]
    segments: tuple[AisleSegment, ...]
    goals_m: tuple[tuple[float, float], ...]  # where a robot may be sent, besides the docks
    crossings: tuple[Rect, ...] = ()  # where traffic crosses: an aisle meets a cross-aisle
    cross_zones: tuple[tuple[str, Rect], ...] = ()  # named parts besides aisles and docks
    docks: tuple[Dock, ...] = ()
    one_way: tuple[OneWay, ...] = ()
    name: str = DEFAULT
    wall_m: float = 0.1
    map_origin: tuple[float, float, float] = (0.0, 0.0, 0.0)  # x, y, yaw of the corner, in the map
    room_m: float = ROOM_M  # plans keep a robot's middle this far off racks and walls
    way_m: tuple[float, float] = WAY_M  # shortest and longest route of a mission
    starts_m: tuple[tuple[float, float], ...] = ()  # where missions begin, if known

    def __post_init__(self) -> None:
        """Raise ConfigError if the numbers do not make a floor."""
        if problem := self._find_problem():
            raise ConfigError(problem[0], where=f"layout {self.name}", remedy=problem[1])

    def _find_problem(self) -> tuple[str, str] | None:
        """Return what is wrong with the numbers, and the remedy; None if they make a floor."""
        size = f"0 to {self.width_m:g} m by 0 to {self.depth_m:g} m"
        for side in (self.width_m, self.depth_m):
            if not MIN_SIDE_M <= side <= MAX_SIDE_M:
                what = f"a side of {side:g} m is outside {MIN_SIDE_M:g} to {MAX_SIDE_M:g} m"
                return what, "give the part that the robots drive in, in metres"
        if len(self.racks) > MAX_RACKS:
            what = f"{len(self.racks)} racks are more than {MAX_RACKS}"
            return what, "join racks that touch, or cut the floor"
        areas = [("rack", rack) for rack in self.racks]
        areas += [(segment.name, segment.area) for segment in self.segments]
        areas += [(dock.name, dock.area) for dock in self.docks]
        areas += [("one-way part", rule.area) for rule in self.one_way]
        for what, box in (*areas, *self.cross_zones):
            inside = -1e-9 <= box.x_min < box.x_max <= self.width_m + 1e-9
            if not inside or not -1e-9 <= box.y_min < box.y_max <= self.depth_m + 1e-9:
                edges = ", ".join(f"{edge:g}" for edge in box.edges)
                remedy = "give a box as x0, y0, x1, y1 with x0 < x1 and y0 < y1, in metres"
                return f"{what} [{edges}] is not a box within {size}", remedy
        if not 0.05 <= self.room_m <= 3.0:
            return f"room_m is {self.room_m:g}", "give half a robot's width and a margin, .05 to 3"
        if not 0.1 <= self.way_m[0] < self.way_m[1] <= 4 * MAX_SIDE_M:
            what = f"way_m is {self.way_m[0]:g} to {self.way_m[1]:g} m"
            return what, "give the shortest and longest route of a mission, in metres"
        for x, y in self.goals_m + self.starts_m:
            if not (0 <= x <= self.width_m and 0 <= y <= self.depth_m):
                what = f"the place [{x:g}, {y:g}] is not within {size}"
                return what, "give goals and starts in the floor's own frame, in metres"
        return None if len(self.goals) else ("has no place for a goal", "give goals or docks")

    @cached_property
    def goals(self) -> F64:
        """Return the places that a robot may be sent to, (G, 2): `goals_m`, then the docks."""
        docks = tuple(dock.area.center for dock in self.docks)
        return np.array(self.goals_m + docks, np.float64).reshape(-1, 2)

    @cached_property
    def starts(self) -> tuple[AisleSegment, ...]:
        """Return the areas where episodes begin: known starts, else aisle segments, else goals."""
        if self.starts_m:
            areas = (Rect(x - 0.46, y - 0.46, x + 0.46, y + 0.46) for x, y in self.starts_m)
            return tuple(AisleSegment("start", 0, area) for area in areas)
        around = (Rect(x - 0.5, y - 0.5, x + 0.5, y + 0.5) for x, y in self.goals.tolist())
        return self.segments or tuple(AisleSegment("start", 0, area) for area in around)

    @cached_property
    def zones(self) -> dict[str, Rect]:
        """Return the named parts of the floor, for coverage; if parts overlap, the first counts."""
        named = {dock.name: dock.area for dock in self.docks}
        named |= dict(self.cross_zones)
        return named | {segment.name: segment.area for segment in self.segments}

    def zone_of(self, x_m: F64, y_m: F64) -> list[str]:
        """Return the name of the first zone that holds each point (N,), or `elsewhere`."""
        names = np.array([*self.zones, ELSEWHERE], object)
        boxes = np.array([area.edges for area in self.zones.values()])
        inside = np.ones((len(x_m), len(names)), np.bool_)
        inside[:, :-1] = within(boxes.reshape(-1, 4), x_m, y_m)
        return [str(name) for name in names[inside.argmax(axis=1)]]

    def segment_of(self, x_m: F64, y_m: F64) -> Ints:
        """Return the index (N,) of the aisle segment that holds each point; -1 if none does."""
        if not self.segments:
            return np.full(np.shape(x_m), -1, np.int64)
        inside = within(self.segment_edges, x_m, y_m)
        return np.where(inside.any(axis=1), inside.argmax(axis=1), -1).astype(np.int64)

    @cached_property
    def rack_boxes(self) -> F64:
        """Return the centre and half size of each rack, (R, 4)."""
        return np.array([(*rack.center, *rack.half_size) for rack in self.racks]).reshape(-1, 4)

    @cached_property
    def segment_edges(self) -> F64:
        """Return x_min, y_min, x_max, y_max of each aisle segment, (S, 4)."""
        return edges_of(segment.area for segment in self.segments)

    @cached_property
    def segment_along_y(self) -> Bools:
        """Return which aisle segments run north and south, (S,)."""
        return np.array([segment.along == "y" for segment in self.segments], np.bool_)

    @cached_property
    def hash(self) -> str:
        """Return 12 hex digits that identify the floor, independently of its name."""
        content = asdict(self) | {"name": ""}
        for later, usual in (("room_m", ROOM_M), ("way_m", WAY_M), ("starts_m", ())):
            if content[later] == usual:  # older floors, without the field, keep their hash
                del content[later]
        return hashlib.blake2b(msgspec.json.encode(content), digest_size=6).hexdigest()


def edges_of(areas: Iterable[Rect]) -> F64:
    """Return x_min, y_min, x_max, y_max of rectangles, (B, 4)."""
    return np.array([area.edges for area in areas]).reshape(-1, 4)


def within(edges: F64, x_m: F64, y_m: F64, margin_m: float = 0.0) -> Bools:
    """Return which boxes (B, 4) hold each point, (N, B), at least `margin_m` from every side."""
    x, y = np.asarray(x_m)[:, None], np.asarray(y_m)[:, None]
    low, high = edges[:, :2] + margin_m, edges[:, 2:] - margin_m
    inside: Bools = (low[:, 0] <= x) & (x <= high[:, 0]) & (low[:, 1] <= y) & (y <= high[:, 1])
    return inside


def is_free(floor: Warehouse, x_m: NDArray[Any], y_m: NDArray[Any]) -> Bools:
    """Return which places, arrays of any shape, are on the floor and outside all racks."""
    free: Bools = (x_m >= 0) & (x_m <= floor.width_m) & (y_m >= 0) & (y_m <= floor.depth_m)
    for rack in floor.racks:
        inside = (rack.x_min <= x_m) & (x_m <= rack.x_max)
        free &= ~(inside & (rack.y_min <= y_m) & (y_m <= rack.y_max))
    return free


def from_walls_m(floor: Warehouse, x_m: F64, y_m: F64) -> F64:
    """Return the distance of places, of any shape, to the next rack or wall; 0 in a rack."""
    away = np.abs(np.stack([x_m, floor.width_m - x_m, y_m, floor.depth_m - y_m])).min(axis=0)
    for rack in floor.racks:
        away = np.minimum(away, box_distance(x_m, y_m, rack.center, rack.half_size, 0.0))
    return np.asarray(away, np.float64)


def box_distance(
    x_m: F64, y_m: F64, center: tuple[float, float], half: tuple[float, float], yaw_rad: float
) -> F64:
    """Return the distance in metres from points to a box; 0 inside."""
    dx, dy = x_m - center[0], y_m - center[1]
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    outside_x = np.maximum(np.abs(cos * dx + sin * dy) - half[0], 0.0)
    outside_y = np.maximum(np.abs(cos * dy - sin * dx) - half[1], 0.0)
    distance: F64 = np.hypot(outside_x, outside_y)
    return distance


Strip = tuple[float, float]


def strip_warehouse(
    width_m: float,
    depth_m: float,
    aisle_y_m: tuple[Strip, ...],
    cross_x_m: tuple[Strip, ...],
    *,
    name: str = DEFAULT,
    docks: tuple[Dock, ...] = (),
    open_racks: frozenset[int] = frozenset(),
) -> Warehouse:
    """Build a grid of racks between free strips: aisles (south, north), cross-aisles (west, east).

    Racks whose index is in `open_racks` are left out, so their place is free. No aisle segment lies
    beside such a place.
    """
    blocks = [
        Rect(west[1], south[1], east[0], north[0])
        for south, north in pairwise(aisle_y_m)
        for west, east in pairwise(cross_x_m)
    ]
    columns = len(cross_x_m) - 1
    racks = tuple(block for index, block in enumerate(blocks) if index not in open_racks)
    part = ("west", "east") if columns == 2 else tuple(str(i + 1) for i in range(columns))
    segments = tuple(
        AisleSegment(
            f"aisle_{aisle + 1}_{part[column]}", aisle, Rect(west[1], south, east[0], north)
        )
        for aisle, (south, north) in enumerate(aisle_y_m)
        for column, (west, east) in enumerate(pairwise(cross_x_m))
        if not open_racks & {(aisle - 1) * columns + column, aisle * columns + column}
    )
    crossings = tuple(
        Rect(west, south, east, north) for south, north in aisle_y_m for west, east in cross_x_m
    )
    thirds = ("west", "middle", "east") if columns == 2 else ()
    return Warehouse(
        width_m=width_m,
        depth_m=depth_m,
        racks=racks,
        segments=segments,
        goals_m=bays(segments) + tuple(crossing.center for crossing in crossings),
        crossings=crossings,
        cross_zones=tuple(
            (f"cross_{thirds[i] if thirds else i + 1}", Rect(west, 0.0, east, depth_m))
            for i, (west, east) in enumerate(cross_x_m)
        ),
        docks=docks,
        name=name,
    )


def bays(segments: tuple[AisleSegment, ...]) -> tuple[tuple[float, float], ...]:
    """Return goals along the middle of aisle segments."""
    places_m: list[tuple[float, float]] = []
    for segment in segments:
        area = segment.lengthwise
        along = np.arange(area.x_min + 0.45, area.x_max - 0.2, BAY_M).tolist()
        middle = area.center[1]
        places_m += [(at, middle) if segment.along == "x" else (middle, at) for at in along]
    return tuple(places_m)


def default_warehouse() -> Warehouse:
    """Build a 12 x 10 m floor: four 1.8 m aisles, three 2.2 m cross-aisles and six racks."""
    rack, aisle = 2.8 / 3, 1.8
    starts = [index * (aisle + rack) for index in range(4)]
    return strip_warehouse(
        width_m=12.0,
        depth_m=10.0,
        aisle_y_m=tuple((round(y, 3), round(y + aisle, 3)) for y in starts),
        cross_x_m=((0.0, 2.2), (4.9, 7.1), (9.8, 12.0)),
    )
