"""Arms: the kinds of missions that practice chooses among, and how a mission of one is drawn.

An arm is a kind of episode, and where it is asked for one block of a blocked aisle, one floor, or
one part of a perturbation's range; each ordered mission is an arm of its own. A mission of an arm
is the first of its seeds that is so by itself: nothing about the episode is changed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from restock.arrays import F64
from restock.errors import ConfigError
from restock.train.twin.env.mission_orders import MissionOrders
from restock.train.twin.floors.layout import Warehouse
from restock.train.twin.floors.planner import Planner
from restock.train.twin.missions.registry import MISSIONS
from restock.train.twin.physics.episode import EpisodeSpec, draw_episode
from restock.train.twin.physics.perturbation import Schedule

BLOCK, LAYOUT = "block", "layout"
PARTS = ("low", "high")  # halves of a range of the perturbation
TRIES = 300  # seeds that are tried for a block
_PROBES = 24  # seeds that show which blocks a floor has room for


@dataclass(frozen=True)
class MissionArm:
    """A kind of missions; "" and () where the seed decides."""

    name: str
    kind: str
    share: float  # natural: of the missions, where nothing is practised
    block: str = ""  # partial | full
    layout: str = ""
    ranges: tuple[tuple[str, float, float], ...] = ()  # of the schedule: field, low, high
    order: int = -1  # of the ordered missions

    def holds(self, kind: str, block: str, layout: str, values: Mapping[str, float]) -> bool:
        """Whether an episode is of this arm; `values` are those of its perturbation."""
        return (
            self.order < 0
            and kind == self.kind
            and self.block in ("", block)
            and self.layout in ("", layout)
            and all(low <= values.get(name, low) <= high for name, low, high in self.ranges)
        )


class MissionArms:
    """The arms of a twin's floors, shares of kinds, orders and schedule, split `by` what is asked.

    `by` holds "block", "layout" and fields of the schedule's ranges, each split in two halves.

    Raises:
        ConfigError: `by` names something else.
    """

    def __init__(
        self,
        floors: Sequence[Warehouse],
        planners: Sequence[Planner],
        conditions: Mapping[str, float],
        *,
        by: Sequence[str],
        schedule: Schedule | None = None,
        orders: MissionOrders | None = None,
        orders_share: float = 0.0,
    ) -> None:
        self._floors, self._planners = list(floors), list(planners)
        self._place = {floor.name: place for place, floor in enumerate(floors)}
        self._schedule, self._orders = schedule, orders
        ranges = {} if schedule is None else schedule.ranges
        unknown = [name for name in by if name not in (BLOCK, LAYOUT, *ranges)]
        if unknown:
            raise ConfigError(
                f"missions cannot be distinguished by {', '.join(map(repr, unknown))}",
                where="practice.by",
                remedy=f"give {', '.join((BLOCK, LAYOUT, *ranges))}"
                + ("" if ranges else "; fields of env.perturbation, where it is a schedule"),
            )
        left = 1.0 if orders is None else 1.0 - orders_share
        total = sum(conditions.values())
        arms = [
            MissionArm(kind, kind, left * part / total)
            for kind, part in conditions.items()
            if left * part  # a kind without a share is evaluated, and never practised
        ]
        if LAYOUT in by:
            arms = [one for arm in arms for one in self._by_layout(arm)]
        if BLOCK in by:
            arms = [one for arm in arms for one in self._by_block(arm)]
        for field in by:
            if field in ranges:
                arms = [one for arm in arms for one in _by_range(arm, field, ranges[field])]
        if orders is not None:
            arms += [
                MissionArm(
                    f"missions[{number}] {order.kind}"
                    + "".join(f" {part}" for part in (order.zone, order.layout) if part),
                    str(order.kind),
                    orders_share * float(orders.shares[number]),
                    order=number,
                )
                for number, order in enumerate(orders.orders)
            ]
        self.arms: list[MissionArm] = arms

    def spec(self, number: int, seed: int) -> EpisodeSpec:
        """A mission of an arm, with its perturbation: the same for the same seed.

        Raises:
            ConfigError: none of many seeds had the arm's block.
        """
        arm = self.arms[number]
        if arm.order >= 0 and self._orders is not None:
            return perturbed(self._orders.spec(arm.order, seed), self._schedule)
        layout, rng = arm.layout or None, np.random.default_rng([seed, 3])
        for _ in range(TRIES):
            spec = EpisodeSpec(arm.kind, seed, layout=layout)
            if not arm.block or self._block(spec) == arm.block:
                return perturbed(spec, self._narrowed(arm))
            seed = int(rng.integers(1 << 31))
        raise ConfigError(
            f"none of {TRIES} seeds gave a mission of {arm.name}",
            where="practice",
            remedy="its floor hardly has room for it: leave `block` out of practice.by",
        )

    def _narrowed(self, arm: MissionArm) -> Schedule | None:
        """What draws an arm's perturbations: the schedule, in the arm's part of its ranges."""
        ranges = {name: (low, high) for name, low, high in arm.ranges}
        if self._schedule is None or not ranges:
            return self._schedule
        return msgspec.structs.replace(self._schedule, ranges=self._schedule.ranges | ranges)

    def _block(self, spec: EpisodeSpec) -> str:
        place = floor_place(spec, self._place)
        return draw_episode(spec, self._floors[place], self._planners[place]).block

    def _by_layout(self, arm: MissionArm) -> list[MissionArm]:
        names = list(self._place)
        if len(names) == 1:
            return [arm]
        share = arm.share / len(names)
        return [
            replace(arm, name=f"{arm.name} on {name}", layout=name, share=share) for name in names
        ]

    def _by_block(self, arm: MissionArm) -> list[MissionArm]:
        if not MISSIONS[arm.kind].blocks:
            return [arm]
        found = self._blocks(arm)
        name, _, floor = arm.name.partition(" on ")
        floor = f" on {floor}" if floor else ""
        return [
            replace(arm, name=f"{name} ({block}){floor}", block=block, share=arm.share / len(found))
            for block in found
        ]

    def _blocks(self, arm: MissionArm) -> list[str]:
        """The blocks that an arm's floors have room for."""
        found: set[str] = set()
        blocks = list(MISSIONS[arm.kind].blocks)
        for seed in range(_PROBES):
            try:
                found.add(self._block(EpisodeSpec(arm.kind, seed, layout=arm.layout or None)))
            except ConfigError:  # no room at all: the floors are asked about kinds elsewhere
                break
            if len(found) == len(blocks):
                break
        return [block for block in blocks if block in found] or [""]


def _by_range(arm: MissionArm, field: str, ends: tuple[float, float]) -> list[MissionArm]:
    low, high = ends
    edges: F64 = np.linspace(low, high, len(PARTS) + 1)
    return [
        replace(
            arm,
            name=f"{arm.name}, {field} {part}",
            share=arm.share / len(PARTS),
            ranges=(*arm.ranges, (field, float(edges[number]), float(edges[number + 1]))),
        )
        for number, part in enumerate(PARTS)
    ]


def perturbed(spec: EpisodeSpec, schedule: Schedule | None) -> EpisodeSpec:
    """An episode with what a schedule draws by its seed; as it is without a schedule."""
    if schedule is None:
        return spec
    rng = np.random.default_rng([spec.seed, 1])
    return msgspec.structs.replace(spec, perturbation=schedule.draw(rng))


def floor_place(spec: EpisodeSpec, places: Mapping[str, int]) -> int:
    """Which floor an episode is on, among those named: by name, or by its seed.

    Raises:
        ConfigError: there is no floor of that name.
    """
    if spec.layout is None:
        if len(places) == 1:
            return 0
        return int(np.random.default_rng([spec.seed, 2]).integers(len(places)))
    if spec.layout not in places:
        raise ConfigError(
            f"an episode needs layout {spec.layout!r}, which is not among the environment's"
            f" {len(places)}",
            where=f"episode {spec.condition}/{spec.seed}",
            remedy="make the environment with that layout",
        )
    return places[spec.layout]


__all__ = ["MissionArm", "MissionArms", "floor_place", "perturbed"]
