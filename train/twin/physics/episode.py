"""An episode: its start, its goal, and the obstacles, patches and traffic on its route.

`draw_episode` makes all of it from an `EpisodeSpec` alone, so an episode can be repeated, named
in a table, and looked at again. Its kind is a module of
`restock.train.twin.missions`.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field, replace

import msgspec
import numpy as np

from restock.arrays import F64
from restock.errors import ConfigError
from restock.train.twin.floors.layout import AGENTS, NO_PATCH, PATCHES, Walk, Warehouse, no_pallets
from restock.train.twin.floors.planner import Planner
from restock.train.twin.floors.state_lattice import floor_gap
from restock.train.twin.missions.mission import length_m, point_along
from restock.train.twin.missions.registry import KINDS, MISSIONS
from restock.train.twin.physics.perturbation import Perturbation

TURN_ROOM_M = 0.45  # that the body needs on both sides to turn on the spot


Way = tuple[float, float, float, float, float]  # start x, y, yaw, goal x, y: on the floor


class EpisodeSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The settings that determine an episode. `perturbation` None: the environment's.

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
    """An episode as drawn."""

    spec: EpisodeSpec
    start: tuple[float, float, float]  # x, y, yaw
    goal: tuple[float, float]
    plan_m: F64  # (PLAN_POINTS, 2), the first plan
    block: str = "none"
    pallets: F64 = field(default_factory=lambda: no_pallets())  # (PALLETS, 3): x, y, yaw
    patches: F64 = field(default_factory=lambda: np.tile(NO_PATCH, (PATCHES, 1)))  # (PATCHES, 5)
    walks: tuple[Walk | None, ...] = (None,) * AGENTS
    noise: np.random.SeedSequence = field(default_factory=lambda: np.random.SeedSequence(0))


def draw_episode(spec: EpisodeSpec, warehouse: Warehouse, planner: Planner) -> Episode:
    """Draw the episode that `spec` determines: the same spec always gives the same episode."""
    entropy = [spec.seed, zlib.crc32(spec.condition.encode())]
    layout, noise = np.random.SeedSequence(entropy).spawn(2)
    rng = np.random.Generator(np.random.PCG64(layout))
    for _ in range(200):
        if spec.way is None:
            start, goal, plan = _draw_way(rng, warehouse, planner)
        else:
            start, goal = spec.way[:3], spec.way[3:]
            plan = planner.plan(start[0], start[1], goal)
        staged = MISSIONS[spec.condition].stage(rng, warehouse, plan)
        if staged is not None:
            return Episode(spec, start, goal, plan, **vars(staged), noise=noise)
    low, high = warehouse.way_m
    raise ConfigError(
        f"no route of {low:g} to {high:g} m suits a {spec.condition} episode",
        where=f"layout {warehouse.name}",
        remedy="use a larger floor",
    )


def with_room(episode: Episode, warehouse: Warehouse, outline_m: F64) -> Episode:
    """Return the episode, its robot turned if its outline would stand in a rack or wall.

    `outline_m` (K, 2) are points on the outline, about the pose. Starts are drawn for the twin's
    own robot. A longer one is turned along its way or the aisle, and if that is not enough it is
    moved to the aisle's middle. A start without room for any of these is kept, and so is one that
    was requested.
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
