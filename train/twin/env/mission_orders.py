"""Missions that were ordered, as episodes of the twin: of a kind, a floor and a zone.

An episode is determined by its kind and its seed. One that must come through a zone gets the first
of its seeds whose way does: nothing about the episode itself is changed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from restock.errors import ConfigError
from restock.replay.fleet.missions_file import MissionOrder
from restock.train.twin.env.floor_report import refuse_unfit
from restock.train.twin.floors.layout import Warehouse
from restock.train.twin.floors.planner import Planner
from restock.train.twin.missions.registry import KINDS
from restock.train.twin.physics.episode import EpisodeSpec, draw_episode

TRIES = 300  # seeds that are tried for a way through a zone
WAY_POINTS = 24  # along each leg of a plan at which zones are looked up


@dataclass(frozen=True)
class _Floor:
    """A floor that an order can be driven on, and the zone there."""

    place: int  # among the floors
    zone: str | None


class MissionOrders:
    """Orders that the given floors can hold.

    `shares` (K,) are their parts of all missions.

    Raises:
        ConfigError: a kind, floor or zone that is not there, a floor without room for a kind, or
            hours in place of missions; names it.
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
        self._on = [self._fitting(number, order) for number, order in enumerate(orders)]
        amounts = np.array([float(order.missions or 0) for order in orders])
        self.shares = amounts / amounts.sum()

    def spec(self, number: int, seed: int) -> EpisodeSpec:
        """An episode of an order: the same for the same seed.

        Raises:
            ConfigError: no way came through its zone.
        """
        order, on = self.orders[number], self._on[number]
        kind = str(order.kind)
        rng = np.random.default_rng([seed, number])
        for _ in range(TRIES):
            floor = on[int(rng.integers(len(on)))]
            drawn = int(rng.integers(1 << 31))
            # With one floor it goes without saying, and the episode is called as it always was.
            named = self._floors[floor.place].name if len(self._floors) > 1 else None
            spec = EpisodeSpec(kind, drawn, layout=named)
            if floor.zone is None or self._comes_through(spec, floor):
                return spec
        raise ConfigError(
            f"none of {TRIES} routes of a {kind} mission passes through {order.zone}",
            where=f"{self._where}, missions[{number}]",
            remedy="leave out `zone`, or choose one on a robot's route",
        )

    def _comes_through(self, spec: EpisodeSpec, floor: _Floor) -> bool:
        warehouse = self._floors[floor.place]
        plan = draw_episode(spec, warehouse, self._planners[floor.place]).plan_m  # (P, 2)
        along = np.linspace(0.0, 1.0, WAY_POINTS)[:, None, None]
        points = (plan[:-1] + along * (plan[1:] - plan[:-1])).reshape(-1, 2)
        return floor.zone in warehouse.zone_of(points[:, 0], points[:, 1])

    def _fitting(self, number: int, order: MissionOrder) -> list[_Floor]:
        where = f"{self._where}, missions[{number}]"
        if order.kind is None or order.missions is None:
            raise ConfigError(
                "asks for hours of logging, but the twin drives a number of missions",
                where=where,
                remedy=f"give `kind` ({', '.join(KINDS)}) and `missions`",
            )
        if order.kind not in KINDS:
            raise ConfigError(
                f"the twin has no missions of kind {order.kind!r}",
                where=where,
                remedy=f"it has {', '.join(KINDS)}",
            )
        names = [floor.name for floor in self._floors]
        if order.layout is not None and order.layout not in names:
            raise ConfigError(
                f"the floor {order.layout!r} is not among the floors of this run",
                where=where,
                remedy=f"they are {_some(names)}: choose one of these, or add that floor "
                "(`layouts`)",
            )
        chosen = [
            (place, floor)
            for place, floor in enumerate(self._floors)
            if order.layout in (None, floor.name)
        ]
        if order.zone is not None:
            fitting = [_Floor(place, _zone_on(floor, order.zone)) for place, floor in chosen]
            fitting = [one for one in fitting if one.zone is not None]
            if not fitting:
                zones = dict.fromkeys(zone for _, floor in chosen for zone in floor.zones)
                raise ConfigError(
                    f"no floor of this run has a zone {order.zone!r}",
                    where=where,
                    remedy=f"the zones are {_some(list(zones))}",
                )
        else:
            fitting = [_Floor(place, None) for place, _ in chosen]
        refuse_unfit([self._floors[one.place] for one in fitting], [order.kind])
        return fitting


def _zone_on(floor: Warehouse, zone: str) -> str | None:
    """A zone's name on a floor; rows of other floors than the default say `FLOOR/ZONE`."""
    bare = zone.removeprefix(f"{floor.name}/")
    return bare if bare in floor.zones else None


def _some(names: list[Any]) -> str:
    return ", ".join(map(str, names[:12])) + (", …" if len(names) > 12 else "")
