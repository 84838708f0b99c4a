"""An episode: its start, its goal, and the obstacles, patches and traffic on its route.

`draw_episode` draws all of it from an `EpisodeSpec`, so an episode can be repeated, listed in a
table, and watched again. Its kind is a module of `restock.train.twin.missions`.
`describe_floor` and the checks below it find which kinds of episodes fit on a floor.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import msgspec
import numpy as np

from restock.arrays import F64
from restock.errors import ConfigError, RunError
from restock.ingest.task.task import Body
from restock.train.twin.floors.layout import AGENTS, NO_PATCH, PATCHES, Walk, Warehouse, no_pallets
from restock.train.twin.floors.planner import Planner
from restock.train.twin.floors.state_lattice import near_gap
from restock.train.twin.missions import KINDS, MISSIONS
from restock.train.twin.missions.mission import length_m, point_along
from restock.train.twin.physics.perturbation import Perturbation

TURN_ROOM_M = 0.45  # room on each side of the body's middle for a turn on the spot


Way = tuple[float, float, float, float, float]  # start x, y, yaw, goal x, y in the floor's frame


class EpisodeSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The settings that determine an episode. Without `perturbation`, the environment's is used.

    `layout` is the name of a floor; if it is None, the seed draws one of the environment's floors.
    `way` is the start and goal; if it is None, the seed draws them.
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
    """An episode drawn from a spec: its start, goal, first plan, obstacles and noise."""

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
    """Draw the episode of a spec; on one floor, the same spec always gives the same episode."""
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
    """Return the episode with its start turned or moved if the outline would hit a rack or wall.

    `outline_m` (K, 2) are points on the outline, relative to the pose. Starts are drawn for the
    twin's own robot. A longer robot is turned along its route or the aisle; if that is not enough,
    it is also moved to the aisle's middle. The start is kept if none of this makes room, or if the
    spec's `way` set it.
    """
    if episode.spec.way is not None or _has_room(warehouse, outline_m, episode.start):
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
            if _has_room(warehouse, outline_m, (*place, heading)):
                return replace(episode, start=(*place, heading))
    return episode


def _has_room(warehouse: Warehouse, outline_m: F64, pose: tuple[float, float, float]) -> bool:
    """Return whether an outline (K, 2) at a pose is clear of all racks and walls."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    points = outline_m @ np.array([[cos, sin], [-sin, cos]]) + pose[:2]
    corners = points[None, :, 0], points[None, :, 1]
    return bool(near_gap(warehouse, _NO_BOXES, *corners, AISLE_ROOM_M).min() > 0)


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


_NO_BOXES: F64 = np.empty((1, 0, 4))
AISLE_ROOM_M = 0.1  # minimum room beside a robot in an aisle: one cell of the planner


def describe_floor(floor: Warehouse) -> dict[str, Any]:
    """Return sizes in metres, counts, unreachable goals, and the kinds of episodes that fit.

    A goal is unreachable if one-way rules and racks leave no way to and from the part of the floor
    with most goals. `hash` identifies the floor independently of its name.
    """
    widths = [segment.width_m for segment in floor.segments]
    return {
        "name": floor.name,
        "hash": floor.hash,
        "width_m": floor.width_m,
        "depth_m": floor.depth_m,
        "racks": len(floor.racks),
        "aisle_segments": len(floor.segments),
        "narrowest_aisle_m": round(min(widths), 3) if widths else None,
        "widest_aisle_m": round(max(widths), 3) if widths else None,
        "one_way_rules": len(floor.one_way),
        "docks": len(floor.docks),
        "goals": len(floor.goals),
        "unreachable_goals": unreachable_goals(floor),
        "map_origin": list(floor.map_origin),
        "episodes": list(fitting_kinds(floor)),
    }


def refuse_unfit(floors: Iterable[Warehouse], kinds: Iterable[str]) -> None:
    """Raise ConfigError for an unknown kind of episode, or one that does not fit on a floor."""
    kinds = tuple(kinds)
    if unknown := [kind for kind in kinds if kind not in KINDS]:
        raise ConfigError(
            f"there is no kind of episode {', '.join(map(repr, unknown))}",
            where="conditions",
            remedy=f"choose from {', '.join(KINDS)}",
        )
    for floor in floors:
        unfit = [kind for kind in kinds if kind not in fitting_kinds(floor)]
        if unfit:
            raise ConfigError(
                f"{floor.name} has no room for episodes of {', '.join(unfit)}",
                where="layouts",
                remedy="train and record without these conditions, or give it more aisles or room;"
                " `restock twin layout` shows what fits on a floor",
            )


def refuse_too_large(floors: Iterable[Warehouse], body: Body) -> None:
    """Raise ConfigError if a robot, with `AISLE_ROOM_M` to spare, is wider than an aisle."""
    for floor in floors:
        narrowest = min(floor.segments, key=lambda segment: segment.width_m, default=None)
        if narrowest is not None and body.width_m + AISLE_ROOM_M > narrowest.width_m:
            raise ConfigError(
                f"the robot is {body.width_m:g} m wide, but {narrowest.name} of {floor.name}"
                f" only {narrowest.width_m:.2f} m: it does not fit",
                where="the twin",
                remedy="choose a floor with wider aisles (env.layouts, `restock twin layout`), or"
                " correct the outline in [task.body]",
            )


def names_and_hashes(floors: Iterable[Warehouse]) -> list[list[str]]:
    """Return the names and hashes by which a saved state identifies its floors."""
    return [[floor.name, floor.hash] for floor in floors]


def refuse_other_floors(saved: Sequence[Sequence[str]], floors: Iterable[Warehouse]) -> None:
    """Raise RunError if a saved state's `names_and_hashes` are not those of these floors."""
    own = names_and_hashes(floors)
    if saved != own:
        changed = [floor[0] for floor in saved if floor not in own]
        raise RunError(
            f"the saved state is from other floors: {', '.join(changed) or 'fewer, or reordered'}",
            where="state of the twin",
            remedy="make the environment with the same layouts; a file may have changed since",
        )


def unfit_kinds(floors: Iterable[Warehouse]) -> dict[str, list[str]]:
    """Return the kinds of episodes that do not fit on every floor -> names of the unfit floors."""
    unfit: dict[str, list[str]] = {}
    for floor in floors:
        for kind in KINDS:
            if kind not in fitting_kinds(floor):
                unfit.setdefault(kind, []).append(floor.name)
    return unfit


def report_unreachable(floors: Iterable[Warehouse]) -> list[str]:
    """Return a line per floor with unreachable goals, which its episodes never use."""
    return [
        f"{floor.name}: {count} of {len(floor.goals)} goals cannot be reached from the others"
        for floor in floors
        if (count := unreachable_goals(floor))
    ]


def unreachable_goals(floor: Warehouse) -> int:
    """Count the goals without a way to and from the part of the floor that has most goals."""
    planner = Planner(floor)
    cells = np.array([planner.cell(x, y) for x, y in floor.goals])
    return len(cells) - int(np.bincount(planner.parts()[cells]).max())


@lru_cache(maxsize=1024)
def fitting_kinds(floor: Warehouse) -> tuple[str, ...]:
    """Return the kinds of episodes that can be drawn on a floor with each of three seeds."""
    planner = Planner(floor)
    return tuple(
        kind for kind in KINDS if all(_fits(kind, seed, floor, planner) for seed in range(3))
    )


def _fits(kind: str, seed: int, floor: Warehouse, planner: Planner) -> bool:
    try:
        draw_episode(EpisodeSpec(kind, seed), floor, planner)
    except ConfigError:
        return False
    return True
