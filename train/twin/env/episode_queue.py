"""The queue of episodes: which one each of N environments begins next, and on which floor.

Fixed episodes come first, in their order; then episodes are drawn. A drawn episode may be of an
ordered mission (a kind, a floor and a zone). If practice chooses, it is of an arm: a kind of
episode, one block of a blocked aisle, or an order.

An episode is determined by its kind and its seed. If it must pass through a zone or have an arm's
block, seeds are tried until one gives such an episode: the episode itself is not changed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import msgspec
import numpy as np

from restock.arrays import F64
from restock.errors import ConfigError
from restock.replay.fleet.missions_file import MissionOrder
from restock.state import Stateful
from restock.train.twin.floors.layout import Warehouse
from restock.train.twin.floors.planner import Planner
from restock.train.twin.missions import KINDS, MISSIONS
from restock.train.twin.physics.episode import EpisodeSpec, draw_episode, refuse_unfit
from restock.train.twin.physics.perturbation import Schedule

TRIES = 300  # seeds that are tried for a route through a zone, or for a block
WAY_POINTS = 24  # number of points on each leg of a plan whose zones are looked up


class MissionOrders:
    """Orders of missions that can be driven on the given floors.

    `shares` (K,) are the orders' shares of all ordered missions.

    Raises:
        ConfigError: a kind, floor or zone does not exist, a floor has no room for a kind, or an
            order asks for hours instead of missions.
    """

    def __init__(
        self,
        orders: Sequence[MissionOrder],
        floors: Sequence[Warehouse],
        planners: Sequence[Planner],
        *,
        where: str,
    ) -> None:
        self.orders, self._floors, self._planners = list(orders), list(floors), list(planners)
        self._where = where
        self._on = [self._find_floors(number, order) for number, order in enumerate(orders)]
        amounts = np.array([float(order.missions or 0) for order in orders])
        self.shares = amounts / amounts.sum()

    def spec(self, number: int, seed: int) -> EpisodeSpec:
        """Return an episode of an order: the same for the same seed.

        Raises:
            ConfigError: no route passed through its zone.
        """
        order, on = self.orders[number], self._on[number]
        kind = str(order.kind)
        rng = np.random.default_rng([seed, number])
        for _ in range(TRIES):
            place, zone = on[int(rng.integers(len(on)))]
            drawn = int(rng.integers(1 << 31))
            # A single floor is not named, so that specs are the same as in earlier versions.
            named = self._floors[place].name if len(self._floors) > 1 else None
            spec = EpisodeSpec(kind, drawn, layout=named)
            if zone is None or self._comes_through(spec, place, zone):
                return spec
        raise ConfigError(
            f"none of {TRIES} routes of a {kind} mission passes through {order.zone}",
            where=f"{self._where}, missions[{number}]",
            remedy="leave out `zone`, or choose one on a robot's route",
        )

    def _comes_through(self, spec: EpisodeSpec, place: int, zone: str) -> bool:
        plan = draw_episode(spec, self._floors[place], self._planners[place]).plan_m  # (P, 2)
        along = np.linspace(0.0, 1.0, WAY_POINTS)[:, None, None]
        points = (plan[:-1] + along * (plan[1:] - plan[:-1])).reshape(-1, 2)
        return zone in self._floors[place].zone_of(points[:, 0], points[:, 1])

    def _find_floors(self, number: int, order: MissionOrder) -> list[tuple[int, str | None]]:
        """Return the indices of floors that an order can be driven on, each with its zone."""

        def refuse(problem: str, remedy: str) -> ConfigError:
            return ConfigError(problem, where=f"{self._where}, missions[{number}]", remedy=remedy)

        if order.kind is None or order.missions is None:
            raise refuse(
                "asks for hours of logging, but the twin drives a number of missions",
                f"give `kind` ({', '.join(KINDS)}) and `missions`",
            )
        if order.kind not in KINDS:
            raise refuse(
                f"the twin has no missions of kind {order.kind!r}", f"it has {', '.join(KINDS)}"
            )
        chosen = [
            (place, floor)
            for place, floor in enumerate(self._floors)
            if order.layout in (None, floor.name)
        ]
        if not chosen:
            raise refuse(
                f"the floor {order.layout!r} is not among the floors of this run",
                f"they are {_list_some([floor.name for floor in self._floors])}: choose one of"
                " these, or add that floor (`layouts`)",
            )
        fitting = [(place, _find_zone(floor, order.zone)) for place, floor in chosen]
        if order.zone is not None:
            fitting = [(place, zone) for place, zone in fitting if zone is not None]
        if not fitting:
            zones = dict.fromkeys(zone for _, floor in chosen for zone in floor.zones)
            raise refuse(
                f"no floor of this run has a zone {order.zone!r}",
                f"the zones are {_list_some(list(zones))}",
            )
        refuse_unfit([self._floors[place] for place, _ in fitting], [order.kind])
        return fitting


def _find_zone(floor: Warehouse, zone: str | None) -> str | None:
    """Return a zone's name on a floor, also if given as `FLOOR/ZONE`; None without such a zone."""
    name = (zone or "").removeprefix(f"{floor.name}/")
    return name if name in floor.zones else None


def _list_some(names: list[Any]) -> str:
    return ", ".join(map(str, names[:12])) + (", …" if len(names) > 12 else "")


_PROBES = 24  # seeds that show which blocks a floor has room for


@dataclass(frozen=True)
class MissionArm:
    """A group of missions that practice can choose."""

    name: str
    kind: str
    share: float  # share of all missions if practice is off
    block: str = ""  # partial | full; "": the seed draws it
    order: int = -1  # index of its order; -1: the arm is not an order's

    def holds(self, kind: str, block: str) -> bool:
        """Return whether this kind and block belong to the arm; False for the arm of an order."""
        return self.order < 0 and kind == self.kind and self.block in ("", block)


class MissionArms:
    """The missions that a twin can draw: kinds of episodes by their shares, and ordered missions.

    `conditions` are shares per kind; a schedule draws a perturbation for each mission. If missions
    are ordered, they are `orders_share` of all missions. `arms` are groups of missions that
    practice can choose among: the kinds, each block of them, and the orders.

    Raises:
        ConfigError: an unknown condition, or shares that are not numbers of at least 0.
    """

    def __init__(
        self,
        floors: Sequence[Warehouse],
        planners: Sequence[Planner],
        conditions: Mapping[str, float],
        *,
        schedule: Schedule | None = None,
        orders: MissionOrders | None = None,
        orders_share: float = 0.0,
    ) -> None:
        shares = conditions.values()
        if (
            set(conditions) - set(KINDS)
            or not all(share >= 0 for share in shares)
            or not 0 < sum(shares) < np.inf
        ):
            raise ConfigError(
                f"conditions {conditions!r} are not shares per kind of episode",
                where="the twin",
                remedy=f"give numbers of at least 0, not all 0, for {', '.join(KINDS)}",
            )
        self.conditions = {k: float(conditions[k]) for k in KINDS if k in conditions}
        self.schedule, self.orders, self.orders_share = schedule, orders, orders_share
        self._floors, self._planners = list(floors), list(planners)
        self._place = {floor.name: place for place, floor in enumerate(floors)}

    @cached_property
    def arms(self) -> list[MissionArm]:
        """Return the arms, each with its share if practice is off."""
        left = 1.0 if self.orders is None else 1.0 - self.orders_share
        total = sum(self.conditions.values())
        arms = [
            arm
            for kind, part in self.conditions.items()
            if left * part  # a kind whose share is 0 is evaluated, but never practised
            for arm in self._split_by_block(MissionArm(kind, kind, left * part / total))
        ]
        if self.orders is not None:
            arms += [
                MissionArm(
                    f"missions[{number}] {order.kind}"
                    + "".join(f" {part}" for part in (order.zone, order.layout) if part),
                    str(order.kind),
                    self.orders_share * float(self.orders.shares[number]),
                    order=number,
                )
                for number, order in enumerate(self.orders.orders)
            ]
        return arms

    def floor_of(self, spec: EpisodeSpec) -> int:
        """Return the index of an episode's floor: by its name, or drawn by its seed.

        Raises:
            ConfigError: there is no floor of that name.
        """
        if spec.layout is None:
            if len(self._place) == 1:
                return 0
            return int(np.random.default_rng([spec.seed, 2]).integers(len(self._place)))
        if spec.layout not in self._place:
            raise ConfigError(
                f"an episode needs layout {spec.layout!r}, which is not among the environment's"
                f" {len(self._place)}",
                where=f"episode {spec.condition}/{spec.seed}",
                remedy="make the environment with that layout",
            )
        return self._place[spec.layout]

    def spec(self, number: int, seed: int) -> EpisodeSpec:
        """Return a mission of an arm, with its perturbation: the same for the same seed.

        Raises:
            ConfigError: none of `TRIES` seeds gave the arm's block.
        """
        arm = self.arms[number]
        if arm.order >= 0 and self.orders is not None:
            return self.perturbed(self.orders.spec(arm.order, seed))
        rng = np.random.default_rng([seed, 3])
        for _ in range(TRIES):
            spec = EpisodeSpec(arm.kind, seed)
            if not arm.block or self._block(spec) == arm.block:
                return self.perturbed(spec)
            seed = int(rng.integers(1 << 31))
        raise ConfigError(
            f"none of {TRIES} seeds gave a mission of {arm.name}",
            where="practice",
            remedy="its floor hardly has room for it: give the kind no share",
        )

    def perturbed(self, spec: EpisodeSpec) -> EpisodeSpec:
        """Return an episode with a perturbation drawn by its seed, if there is a schedule."""
        if self.schedule is None:
            return spec
        rng = np.random.default_rng([spec.seed, 1])
        return msgspec.structs.replace(spec, perturbation=self.schedule.draw(rng))

    def _block(self, spec: EpisodeSpec) -> str:
        place = self.floor_of(spec)
        return draw_episode(spec, self._floors[place], self._planners[place]).block

    def _split_by_block(self, arm: MissionArm) -> list[MissionArm]:
        if not MISSIONS[arm.kind].blocks:
            return [arm]
        found = self._find_blocks(arm.kind)
        return [
            replace(arm, name=f"{arm.name} ({block})", block=block, share=arm.share / len(found))
            for block in found
        ]

    def _find_blocks(self, kind: str) -> list[str]:
        """Return the blocks of a kind that the floors have room for."""
        found: set[str] = set()
        blocks = list(MISSIONS[kind].blocks)
        for seed in range(_PROBES):
            try:
                found.add(self._block(EpisodeSpec(kind, seed)))
            except ConfigError:  # no room at all, which `refuse_unfit` reports
                break
            if len(found) == len(blocks):
                break
        return [block for block in blocks if block in found] or [""]


class EpisodeQueue(Stateful):
    """A queue of episodes. An environment's n-th drawn episode is independent of all others."""

    STATE = ("seed", "conditions", "drawn", "fixed", "next_fixed")
    STATE_TYPES: ClassVar[Mapping[str, Any]] = {"fixed": list[EpisodeSpec]}

    def __init__(self, num_envs: int, missions: MissionArms, seed: int) -> None:
        self.seed, self.missions = seed, missions
        self.conditions = missions.conditions
        self.drawn = np.zeros(num_envs, np.int64)  # episodes so far, per environment
        self.fixed: list[EpisodeSpec] = []
        self.next_fixed = 0
        self._arm_shares: F64 | None = None  # cumulative; None: practice does not choose

    def practise(self, shares: Sequence[float]) -> None:
        """Draw episodes from now on in these shares, one per arm of the missions."""
        parts = np.array([share for _, share in zip(self.missions.arms, shares, strict=True)])
        self._arm_shares = np.cumsum(parts) / parts.sum()

    def set_fixed(self, specs: Iterable[EpisodeSpec]) -> None:
        """Run these episodes next, in order, in any environment."""
        self.fixed, self.next_fixed = list(specs), 0

    def next(self, env: int) -> tuple[EpisodeSpec, int, int]:
        """Return the episode that an environment begins now, its index in `fixed`, and its arm.

        The index is -1 for a drawn episode. The arm is -1 unless `practise` was called.
        """
        if self.next_fixed < len(self.fixed):
            self.next_fixed += 1
            return self.fixed[self.next_fixed - 1], self.next_fixed - 1, -1
        draw = np.random.SeedSequence([self.seed, env, int(self.drawn[env])]).generate_state(5)
        self.drawn[env] += 1
        seed = int(draw[1]) << 20 ^ int(draw[2])
        missions, orders = self.missions, self.missions.orders
        if self._arm_shares is not None:
            arm = _draw_index(self._arm_shares, draw[0])
            return missions.spec(arm, seed), -1, arm
        if orders is not None and draw[3] / 2**32 < missions.orders_share:
            spec = orders.spec(_draw_index(np.cumsum(orders.shares), draw[4]), seed)
        else:
            parts = np.array([self.conditions.get(kind, 0.0) for kind in KINDS])
            kind = KINDS[_draw_index(np.cumsum(parts) / sum(parts), draw[0])]
            spec = EpisodeSpec(kind, seed)
        return missions.perturbed(spec), -1, -1


def _draw_index(cumulative: F64, draw: np.integer[Any]) -> int:
    """Return the index of the share, of cumulative shares, that 32 random bits fall into."""
    place = int(np.searchsorted(cumulative, draw / 2**32, side="right"))
    return min(place, len(cumulative) - 1)  # their sum may fall short of 1 by rounding
