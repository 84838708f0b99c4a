"""An episode: where it starts and goes, and what stands, lies and walks in the way.

`draw_episode` makes all of it from an `EpisodeSpec` alone, so an episode can be repeated, named
in a table, and looked at again. Kinds of episode:

- nominal: the known map and a dry floor;
- wheel_slip: slippery patches on the way, where the robot starts, turns or stops;
- blocked_aisle: pallets across an aisle on the way, partly (a gap of .8 to 1 m) or wholly;
- near_collision: people and forklifts who cross the way or come toward the robot.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field, replace

import msgspec
import numpy as np

from restock.arrays import F64
from restock.errors import ConfigError
from restock.train.twin.floors.layout import Warehouse
from restock.train.twin.floors.planner import Planner
from restock.train.twin.floors.state_lattice import floor_gap
from restock.train.twin.physics.contact import NO_PATCH, PATCHES
from restock.train.twin.physics.model import PALLET_HALF_M, PALLETS, PARKED_M
from restock.train.twin.physics.perturbation import Perturbation
from restock.train.twin.physics.traffic import AGENTS, Walk, draw_walks

KINDS = ("nominal", "wheel_slip", "blocked_aisle", "near_collision")
PATCH_FRICTION = (0.02, 0.045)  # oil or wet ice on sealed concrete
GAP_M = (0.80, 1.00)
TURN_ROOM_M = 0.45  # that the body needs on both sides to turn on the spot


Way = tuple[float, float, float, float, float]  # start x, y, yaw, goal x, y: on the floor


class EpisodeSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What determines an episode. `perturbation` None: the environment's.

    `layout` is the name of a floor; None: the environment's, or the one of its floors that the seed
    draws. `way` is where it starts and goes, instead of what the seed draws.
    """

    condition: str
    seed: int
    perturbation: Perturbation | None = None
    layout: str | None = None
    way: Way | None = None

    def __post_init__(self) -> None:
        if self.condition not in KINDS:
            raise ConfigError(
                f"unknown kind of episode: {self.condition!r}", remedy=f"one of {', '.join(KINDS)}"
            )
        if not 0 <= self.seed < 2**63:
            raise ConfigError(f"an episode's seed must be from 0 to 2^63 - 1, got {self.seed}")


@dataclass(frozen=True)
class Episode:
    """An episode laid out."""

    spec: EpisodeSpec
    start: tuple[float, float, float]  # x, y, yaw
    goal: tuple[float, float]
    plan_m: F64  # (PLAN_POINTS, 2), the first plan
    block: str = "none"
    pallets: F64 = field(default_factory=lambda: no_pallets())  # (PALLETS, 3): x, y, yaw
    patches: F64 = field(default_factory=lambda: np.tile(NO_PATCH, (PATCHES, 1)))  # (PATCHES, 5)
    walks: tuple[Walk | None, ...] = (None,) * AGENTS
    noise: np.random.SeedSequence = field(default_factory=lambda: np.random.SeedSequence(0))


def no_pallets() -> F64:
    """Every pallet parked off the floor."""
    return np.tile([PARKED_M[0], PARKED_M[1], 0.0], (PALLETS, 1))


def draw_episode(spec: EpisodeSpec, warehouse: Warehouse, planner: Planner) -> Episode:
    """The episode that `spec` determines: the same spec always gives the same episode."""
    entropy = [spec.seed, zlib.crc32(spec.condition.encode())]
    layout, noise = np.random.SeedSequence(entropy).spawn(2)
    rng = np.random.Generator(np.random.PCG64(layout))
    for _ in range(200):
        if spec.way is None:
            start, goal, plan = _draw_way(rng, warehouse, planner)
        else:
            start, goal = spec.way[:3], spec.way[3:]
            plan = planner.plan(start[0], start[1], goal)
        if spec.condition == "nominal":
            return Episode(spec, start, goal, plan, noise=noise)
        if spec.condition == "wheel_slip":
            patches = _draw_patches(rng, plan)
            return Episode(spec, start, goal, plan, patches=patches, noise=noise)
        if spec.condition == "blocked_aisle":
            block = "partial" if rng.random() < 0.5 else "full"
            pallets = _draw_block(rng, warehouse, plan, full=block == "full")
            if pallets is not None:
                return Episode(spec, start, goal, plan, block, pallets=pallets, noise=noise)
        else:
            walks = draw_walks(rng, warehouse, plan)
            if walks is not None:
                return Episode(spec, start, goal, plan, walks=walks, noise=noise)
    low, high = warehouse.way_m
    raise ConfigError(
        f"no route of {low:g} to {high:g} m suits a {spec.condition} episode",
        where=f"layout {warehouse.name}",
        remedy="use a larger floor",
    )


def with_room(episode: Episode, warehouse: Warehouse, outline_m: F64) -> Episode:
    """The episode, its robot turned where as drawn its outline would stand in a rack or wall.

    `outline_m` (K, 2) are points on the outline, about the pose. Drawn are starts for the twin's
    own robot: a longer one is turned along its way or the aisle, and where that is not enough
    stands in the aisle's middle. A place with room for none of that is left as it is, and so is
    a start that was asked for.
    """
    if episode.spec.way is not None:
        return episode
    x, y, yaw = episode.start
    along = point_along(episode.plan_m, 1.0) - episode.plan_m[0]
    ahead = float(np.arctan2(along[1], along[0]))
    square = np.arange(4) * (np.pi / 2)
    square = square[np.argsort(-np.cos(square - ahead), kind="stable")]
    places = [(x, y)]
    if (segment := int(warehouse.segment_of(np.array([x]), np.array([y]))[0])) >= 0:
        aisle = warehouse.segments[segment]
        middle = aisle.area.center
        places.append((x, middle[1]) if aisle.along == "x" else (middle[0], y))
    for place in places:
        for heading in (yaw, ahead, *square.tolist()):
            cos, sin = np.cos(heading), np.sin(heading)
            points = outline_m @ np.array([[cos, sin], [-sin, cos]]) + place
            if floor_gap(warehouse, *points.T).min() > 0:
                return replace(episode, start=(*place, heading))
    return episode


def _draw_way(
    rng: np.random.Generator, warehouse: Warehouse, planner: Planner
) -> tuple[tuple[float, float, float], tuple[float, float], F64]:
    low, high = warehouse.way_m
    for _ in range(200):
        segment = warehouse.starts[rng.integers(len(warehouse.starts))]
        area = segment.lengthwise
        aside = min(0.3, max(segment.width_m / 2 - TURN_ROOM_M, 0.0))
        x = rng.uniform(area.x_min + 0.4, area.x_max - 0.4)
        y = area.center[1] + rng.uniform(-aside, aside)
        x, y = (x, y) if segment.along == "x" else (y, x)
        goal = tuple(warehouse.goals[rng.integers(len(warehouse.goals))])
        turn, anywhere = rng.normal(0.0, 0.3), rng.uniform(-np.pi, np.pi)
        free = rng.random() < 0.25
        if segment.width_m < 2 * TURN_ROOM_M:
            free, turn = False, 0.0
        if not low <= planner.distance_m(x, y, goal) <= 1.3 * high:
            continue
        plan = planner.plan(x, y, goal)
        if not low <= length_m(plan) <= high:
            continue
        along = point_along(plan, 1.0) - plan[0]
        yaw = anywhere if free else np.arctan2(along[1], along[0]) + turn
        return (float(x), float(y), float(yaw)), (float(goal[0]), float(goal[1])), plan
    raise ConfigError(
        f"there is no route of {low:g} to {high:g} m between aisles and goals",
        where=f"layout {warehouse.name}",
        remedy="use a larger floor",
    )


def _draw_patches(rng: np.random.Generator, plan: F64) -> F64:
    """Oily floor before and in the sharpest turn, and mostly where the robot starts or stops.

    Some patches lie under the wheels of one side only, which turns a robot that pulls or brakes.
    """
    patches = np.tile(NO_PATCH, (PATCHES, 1))
    turn, total = _sharpest_turn(plan), length_m(plan)
    places = [turn, turn - rng.uniform(0.6, 1.2)]
    if rng.random() < 0.7:
        places.append(total - rng.uniform(0.5, 1.5))
    if rng.random() < 0.7:
        places.append(rng.uniform(0.3, 1.2))
    for row, place in enumerate(places):
        at = point_along(plan, place)
        ahead = point_along(plan, place + 0.3) - point_along(plan, place - 0.3)
        long, wide = rng.uniform(1.2, 1.7), 1.5
        if row > 0 and rng.random() < 0.35:  # under one side only: an edge along the plan
            normal = np.array([-ahead[1], ahead[0]]) / max(float(np.hypot(*ahead)), 1e-9)
            wide = 0.6
            at = at + normal * rng.choice([-1.0, 1.0]) * wide
        half = (long, wide) if abs(ahead[0]) > abs(ahead[1]) else (wide, long)
        patches[row] = (*at, *half, rng.uniform(*PATCH_FRICTION))
    return patches


def _sharpest_turn(plan: F64) -> float:
    """How far along the plan it bends most over .6 m."""
    step = np.diff(plan, axis=0)
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    spacing = length_m(plan) / (len(plan) - 1)
    reach = min(max(int(0.6 / spacing), 1), len(heading) // 3)
    bend = np.abs(heading[2 * reach :] - heading[: -2 * reach])
    return float((np.argmax(bend) + reach) * spacing)


def _draw_block(
    rng: np.random.Generator, warehouse: Warehouse, plan: F64, *, full: bool
) -> F64 | None:
    """Pallets across an aisle that the plan runs through; None where placed is no room for it."""
    if not warehouse.segments:
        return None
    spacing = length_m(plan) / (len(plan) - 1)
    arc = np.arange(len(plan)) * spacing
    segment = warehouse.segment_of(plan[:, 0], plan[:, 1])
    half_x, half_y = PALLET_HALF_M[:2]
    room = (arc >= 1.9) & (arc <= arc[-1] - 1.5) & (segment >= 0)
    edges = warehouse.segment_edges[np.maximum(segment, 0)]
    turned = warehouse.segment_along_y[np.maximum(segment, 0)]
    edges = np.where(turned[:, None], edges[:, [1, 0, 3, 2]], edges)
    along = np.where(turned, plan[:, 1], plan[:, 0])
    room &= (along > edges[:, 0] + half_x) & (along < edges[:, 2] - half_x)
    places = np.flatnonzero(room)
    if not len(places):
        return None
    place = int(rng.choice(places))
    area = warehouse.segments[segment[place]].lengthwise
    pallets = no_pallets()
    x = along[place]
    width = area.y_max - area.y_min
    if full:
        # Between the racks in a narrow aisle, and without a gap to pass in a wide one.
        near = min(half_y, max(width / 2 - half_y, 0.0))
        apart = float(np.clip(width / 2 - 2 * half_y, 0.0, 0.2))
        for row in range(2):
            side = 1 if row else -1
            y = area.center[1] + side * (near + rng.uniform(0.0, apart))
            pallets[row] = (x + rng.uniform(-0.1, 0.1), y, rng.normal(0.0, 0.03))
    else:
        gap = rng.uniform(*GAP_M)
        if width < gap + 0.15:
            return None
        side = rng.choice([-1.0, 1.0])
        y = area.center[1] + side * (width / 2 - gap - half_y)
        pallets[0] = (x, y, rng.normal(0.0, 0.02))
    if turned[place]:
        placed = pallets[:, 0] > 0
        pallets[placed] = pallets[placed][:, [1, 0, 2]]
        pallets[placed, 2] = np.pi / 2 - pallets[placed, 2]
    return pallets


def length_m(plan: F64) -> float:
    """The length of a polyline (P, 2)."""
    return float(np.hypot(*np.diff(plan, axis=0).T).sum())


def point_along(plan: F64, at_m: float) -> F64:
    """The point `at_m` along an evenly spaced polyline (P, 2), clipped to its ends."""
    total = length_m(plan)
    place = np.clip(at_m / max(total, 1e-9), 0.0, 1.0) * (len(plan) - 1)
    first = min(int(place), len(plan) - 2)
    point: F64 = plan[first] + (place - first) * (plan[first + 1] - plan[first])
    return point
