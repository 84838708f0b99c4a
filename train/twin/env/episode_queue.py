"""Which episode each of N environments begins next, and on which floor.

Fixed episodes come in their order, then drawn ones.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar

import msgspec
import numpy as np

from restock.errors import ConfigError
from restock.state import Stateful
from restock.train.twin.env.mission_orders import MissionOrders
from restock.train.twin.floors.layout import Warehouse
from restock.train.twin.physics.episode import KINDS, EpisodeSpec
from restock.train.twin.physics.perturbation import Schedule


class EpisodeQueue(Stateful):
    """An environment's n-th drawn episode is the same whatever the others do.

    `conditions` are shares per kind of episode; a schedule draws each a perturbation. Where
    missions were ordered, a share of the drawn episodes is of those.

    Raises:
        ConfigError: an unknown condition, or shares that are not numbers of at least 0.
    """

    STATE = ("seed", "conditions", "drawn", "fixed", "next_fixed")
    STATE_TYPES: ClassVar[Mapping[str, Any]] = {"fixed": list[EpisodeSpec]}

    def __init__(
        self,
        num_envs: int,
        floors: Sequence[Warehouse],
        conditions: Mapping[str, float],
        schedule: Schedule | None,
        seed: int,
    ) -> None:
        self.seed, self.schedule = seed, schedule
        self._floors = {floor.name: index for index, floor in enumerate(floors)}
        self.drawn = np.zeros(num_envs, np.int64)  # episodes so far, per environment
        self.fixed: list[EpisodeSpec] = []
        self.next_fixed = 0
        self._orders: MissionOrders | None = None
        self._orders_share = 0.0
        self.set_conditions(conditions)

    def set_conditions(self, conditions: Mapping[str, float]) -> None:
        """Shares per kind of episode, for episodes that begin from now on."""
        unknown = set(conditions) - set(KINDS)
        total = sum(conditions.values())
        if unknown or min(conditions.values(), default=-1) < 0 or total <= 0:
            raise ConfigError(
                f"conditions {dict(conditions)} are not shares per kind of episode",
                where="the twin",
                remedy=f"give numbers of at least 0, not all 0, for {', '.join(KINDS)}",
            )
        shares = np.array([conditions.get(kind, 0.0) for kind in KINDS])
        self.conditions = {k: float(conditions[k]) for k in KINDS if k in conditions}
        self._cumulative = np.cumsum(shares) / total

    def follow(self, orders: MissionOrders, share: float) -> None:
        """From now on this share of the drawn episodes is of these orders, each at its part."""
        self._orders, self._orders_share = orders, share

    def restored(self) -> None:
        """What the shares add up to follows from them."""
        self.set_conditions(self.conditions)

    def set_fixed(self, specs: Iterable[EpisodeSpec]) -> None:
        """These are next, in order, for any environment."""
        self.fixed, self.next_fixed = list(specs), 0

    def next(self, env: int) -> tuple[EpisodeSpec, int]:
        """The episode that an environment begins now, and its place among the fixed, or -1."""
        if self.next_fixed < len(self.fixed):
            self.next_fixed += 1
            return self.fixed[self.next_fixed - 1], self.next_fixed - 1
        draw = np.random.SeedSequence([self.seed, env, int(self.drawn[env])]).generate_state(5)
        self.drawn[env] += 1
        seed = int(draw[1]) << 20 ^ int(draw[2])
        if self._orders is not None and draw[3] / 2**32 < self._orders_share:
            drawn = np.searchsorted(np.cumsum(self._orders.shares), draw[4] / 2**32, side="right")
            spec = self._orders.spec(min(int(drawn), len(self._orders.orders) - 1), seed)
        else:
            kind = np.searchsorted(self._cumulative, draw[0] / 2**32, side="right")
            spec = EpisodeSpec(KINDS[int(kind)], seed)
        if self.schedule is not None:
            rng = np.random.default_rng([spec.seed, 1])
            spec = msgspec.structs.replace(spec, perturbation=self.schedule.draw(rng))
        return spec, -1

    def floor_of(self, spec: EpisodeSpec) -> int:
        """Which floor an episode is on: by name, or by its seed.

        Raises:
            ConfigError: the environment has no floor of that name.
        """
        if spec.layout is None:
            if len(self._floors) == 1:
                return 0
            return int(np.random.default_rng([spec.seed, 2]).integers(len(self._floors)))
        if spec.layout not in self._floors:
            raise ConfigError(
                f"an episode needs layout {spec.layout!r}, which is not among the environment's"
                f" {len(self._floors)}",
                where=f"episode {spec.condition}/{spec.seed}",
                remedy="make the environment with that layout",
            )
        return self._floors[spec.layout]
