"""Checks of a floor before training: what it is and which episodes fit on it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from restock.errors import ConfigError, RunError
from restock.ingest.task.scan import Body
from restock.train.twin.floors.layout import Warehouse
from restock.train.twin.floors.planner import Planner
from restock.train.twin.missions.registry import KINDS
from restock.train.twin.physics.episode import EpisodeSpec, draw_episode

AISLE_ROOM_M = 0.1  # beside a robot in an aisle: a cell of the planner's


def describe_floor(floor: Warehouse) -> dict[str, Any]:
    """Return sizes in metres, counts, unreachable goals, and the kinds of episodes that fit.

    A goal is unreachable if no robot gets there from the largest part of the floor under its
    one-way rules. `hash` identifies the floor independently of its name.
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
                f"the robot is {body.width_m:g} m wide, and {narrowest.name} of {floor.name}"
                f" {narrowest.width_m:.2f} m: it does not fit",
                where="the twin",
                remedy="choose a floor with wider aisles (env.layouts, `restock twin layout`), or"
                " correct the outline in [task.body]",
            )


def names_and_hashes(floors: Iterable[Warehouse]) -> list[list[str]]:
    """Return the names and hashes by which a saved state identifies its floors."""
    return [[floor.name, floor.hash] for floor in floors]


def refuse_other_floors(saved: Sequence[Sequence[str]], floors: Iterable[Warehouse]) -> None:
    """Raise RunError if a saved state's `names_and_hashes` are not those of these floors."""
    here = names_and_hashes(floors)
    if saved != here:
        changed = [floor[0] for floor in saved if floor not in here]
        raise RunError(
            f"the saved state is of other floors: {', '.join(changed) or 'fewer'} of"
            f" {len(saved)} floors, not among this one's {len(here)}",
            where="state of the twin",
            remedy="make the environment with the same layouts as then; a file may have changed",
        )


def unfit_kinds(floors: Iterable[Warehouse]) -> dict[str, list[str]]:
    """Return the kinds of episodes that some floor has no room for -> names of those floors."""
    unfit: dict[str, list[str]] = {}
    for floor in floors:
        for kind in KINDS:
            if kind not in fitting_kinds(floor):
                unfit.setdefault(kind, []).append(floor.name)
    return unfit


def sealed(floors: Iterable[Warehouse]) -> list[str]:
    """Return a line for each floor with unreachable goals, which its episodes never go to."""
    return [
        f"{floor.name}: {count} of {len(floor.goals)} goals cannot be reached from the others"
        for floor in floors
        if (count := unreachable_goals(floor))
    ]


def unreachable_goals(floor: Warehouse) -> int:
    """Count goals that a robot cannot reach, and return from, from the part with most of them."""
    planner = Planner(floor)
    cells = np.array([planner.cell(x, y) for x, y in floor.goals])
    return len(cells) - int(np.bincount(planner.parts()[cells]).max())


@lru_cache(maxsize=1024)
def fitting_kinds(floor: Warehouse) -> tuple[str, ...]:
    """Return the kinds of episodes that fit on a floor with each of three seeds."""
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
