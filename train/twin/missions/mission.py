"""The interface of a kind of mission, and the nominal kind, which stages nothing.

Every other kind is a module in this folder that defines `MISSION`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from restock.arrays import F64, Bools
from restock.train.twin.floors.layout import AGENTS, NO_PATCH, PATCHES, Walk, Warehouse, no_pallets


@dataclass(frozen=True)
class Staged:
    """The obstacles, patches and traffic staged for an episode."""

    block: str = "none"
    pallets: F64 = field(default_factory=no_pallets)  # (PALLETS, 3): x, y, yaw
    patches: F64 = field(default_factory=lambda: np.tile(NO_PATCH, (PATCHES, 1)))  # (PATCHES, 5)
    walks: tuple[Walk | None, ...] = (None,) * AGENTS


@dataclass(frozen=True)
class Situation:
    """The physical truth about one step of N environments; arrays are (N,) if not stated."""

    plan_blocked: Bools  # at t: pallets lay on the plan just ahead
    near: Bools  # at t + 1: less clearance than `tight_clearance_m`, or the bumper was pressed
    slipped: Bools  # a wheel moved over a slippery patch by more than the task's limit
    clearance_m: F64  # at t + 1, from the body's edge
    traffic_gap_m: F64  # (N, AGENTS) at t, to each person and forklift; inf if absent


@dataclass(frozen=True)
class Mission:
    """A kind of mission: `stage` draws its obstacles, `is_true` finds the steps that met them.

    `stage` takes a generator, the floor and the plan (P, 2), and returns None if the plan has no
    room. The order of its draws determines the episode of every seed: keep it.
    """

    name: str
    stage: Callable[[np.random.Generator, Warehouse, F64], Staged | None]
    share: float  # default share of missions in training
    natural: float  # share of missions at a site that runs well
    colour: str  # in charts, from the palette of Okabe and Ito
    place: int  # kinds are sorted by place, then by name
    is_true: Callable[[Situation], Bools] | None = None  # None: no obstacle is staged
    blocks: Mapping[str, str] = field(default_factory=dict)  # way to stage it -> colour in charts
    block_measures: Mapping[str, str] = field(default_factory=dict)  # measure of a study -> block
    needs_lidar: bool = False  # without a lidar, a robot notices the obstacle only by hitting it


def length_m(plan: F64) -> float:
    """Return the length of a polyline (P, 2)."""
    return float(np.hypot(*(plan[1:] - plan[:-1]).T).sum())


def point_along(plan: F64, at_m: float) -> F64:
    """Return the point `at_m` along an evenly spaced polyline (P, 2), clipped to its ends."""
    place = min(max(at_m / max(length_m(plan), 1e-9), 0.0), 1.0) * (len(plan) - 1)
    first = min(int(place), len(plan) - 2)
    point: F64 = plan[first] + (place - first) * (plan[first + 1] - plan[first])
    return point


def stage_nothing(rng: np.random.Generator, warehouse: Warehouse, plan: F64) -> Staged:
    """Stage nothing: the known map and a dry floor."""
    return Staged()


NOMINAL = Mission("nominal", stage_nothing, share=0.4, natural=0.80, colour="#6b7280", place=0)
