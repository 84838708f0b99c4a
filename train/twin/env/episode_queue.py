"""Which episode each of N environments begins next, and on which floor.

Fixed episodes come in their order, then drawn ones.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from restock.arrays import F64
from restock.errors import ConfigError, expect
from restock.state import Stateful
from restock.train.twin.env.mission_arms import MissionArm, MissionArms, floor_place, perturbed
from restock.train.twin.env.mission_orders import MissionOrders
from restock.train.twin.floors.layout import Warehouse
from restock.train.twin.floors.planner import Planner
from restock.train.twin.missions.registry import KINDS
from restock.train.twin.physics.episode import EpisodeSpec
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
        self._layouts = list(floors)
        self._floors = {floor.name: index for index, floor in enumerate(floors)}
        self.drawn = np.zeros(num_envs, np.int64)  # episodes so far, per environment
        self.fixed: list[EpisodeSpec] = []
        self.next_fixed = 0
        self._orders: MissionOrders | None = None
        self._orders_share = 0.0
        self._asked: MissionArms | None = None  # the last that were asked for
        self._arms: MissionArms | None = None  # in force
        self._arm_shares = np.zeros(0)  # cumulative
        self.set_conditions(conditions)

    def set_conditions(self, conditions: Mapping[str, float]) -> None:
        """Shares per kind of episode, for episodes that begin from now on."""
        shares = conditions.values() if isinstance(conditions, Mapping) else ()
        numbers = all(isinstance(share, int | float | np.number) for share in shares)
        if (
            not numbers
            or set(conditions) - set(KINDS)
            or not all(share >= 0 for share in shares)
            or not 0 < sum(shares) < np.inf
        ):
            raise ConfigError(
                f"conditions {conditions!r} are not shares per kind of episode",
                where="the twin",
                remedy=f"give numbers of at least 0, not all 0, for {', '.join(KINDS)}",
            )
        self.conditions = {k: float(conditions[k]) for k in KINDS if k in conditions}
        parts = np.array([self.conditions.get(kind, 0.0) for kind in KINDS])
        self._cumulative = np.cumsum(parts) / sum(shares)

    def follow(self, orders: MissionOrders, share: float) -> None:
        """From now on this share of the drawn episodes is of these orders, each at its part."""
        self._orders, self._orders_share = orders, share

    def practise(self, shares: Sequence[float]) -> None:
        """From now on the drawn episodes are of the last `arms`, in these shares.

        Raises:
            ConfigError: they are not one share an arm, numbers of at least 0 and not all 0.
        """
        if (arms := self._asked) is None:
            raise ConfigError("has no arms yet: ask for `mission_arms` first", where="the twin")
        parts = np.asarray(shares, np.float64)
        if parts.shape != (len(arms.arms),) or not (parts >= 0).all() or not parts.sum() > 0:
            raise ConfigError(
                f"{list(shares)} are not shares of {len(arms.arms)} arms", where="the twin"
            )
        self._arms, self._arm_shares = arms, np.cumsum(parts) / parts.sum()

    def arms(self, by: Sequence[str], planners: Sequence[Planner]) -> list[MissionArm]:
        """The arms that its drawn episodes can be of. Raises ConfigError as `MissionArms`."""
        self._asked = MissionArms(
            self._layouts,
            planners,
            self.conditions,
            by=by,
            schedule=self.schedule,
            orders=self._orders,
            orders_share=self._orders_share,
        )
        return self._asked.arms

    def restored(self) -> None:
        """What the shares add up to follows from them."""
        self.set_conditions(self.conditions)

    def set_fixed(self, specs: Iterable[EpisodeSpec]) -> None:
        """These are next, in order, for any environment. Raises ArgumentError for other things."""
        fixed = list(specs)
        for spec in fixed:
            expect("an episode", spec, EpisodeSpec, 'such as EpisodeSpec("nominal", seed=1)')
        self.fixed, self.next_fixed = fixed, 0

    def next(self, env: int) -> tuple[EpisodeSpec, int, int]:
        """The episode that an environment begins now, its place among the fixed, and its arm.

        The place is -1 of a drawn one, the arm -1 where none was asked for.
        """
        if self.next_fixed < len(self.fixed):
            self.next_fixed += 1
            return self.fixed[self.next_fixed - 1], self.next_fixed - 1, -1
        draw = np.random.SeedSequence([self.seed, env, int(self.drawn[env])]).generate_state(5)
        self.drawn[env] += 1
        seed = int(draw[1]) << 20 ^ int(draw[2])
        if self._arms is not None:
            arm = _drawn(self._arm_shares, draw[0])
            return self._arms.spec(arm, seed), -1, arm
        if self._orders is not None and draw[3] / 2**32 < self._orders_share:
            spec = self._orders.spec(_drawn(np.cumsum(self._orders.shares), draw[4]), seed)
        else:
            spec = EpisodeSpec(KINDS[_drawn(self._cumulative, draw[0])], seed)
        return perturbed(spec, self.schedule), -1, -1

    def floor_of(self, spec: EpisodeSpec) -> int:
        """Which floor an episode is on. Raises ConfigError where there is none of its name."""
        return floor_place(spec, self._floors)


def _drawn(cumulative: F64, draw: np.integer[Any]) -> int:
    """The place among cumulative shares that 32 random bits fall into."""
    place = int(np.searchsorted(cumulative, draw / 2**32, side="right"))
    return min(place, len(cumulative) - 1)  # their sum may fall short of 1 by rounding
