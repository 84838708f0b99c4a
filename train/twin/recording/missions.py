"""The missions that a recorded fleet drives: conditions and drivers at their shares."""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from restock.errors import ConfigError
from restock.replay.fleet.missions_file import MissionsFile, as_toml
from restock.train.twin.drivers.operator_policy import Operator
from restock.train.twin.drivers.policies import PlannerFollower, RandomPolicy
from restock.train.twin.env.episode_queue import MissionOrders
from restock.train.twin.missions.registry import KINDS, MISSIONS
from restock.train.twin.physics.episode import EpisodeSpec
from restock.train.twin.physics.perturbation import Perturbation, Schedule

HANDOVER = "handover"  # the fleet: planners, and an operator who takes over from them
SCRIPTED = (HANDOVER, "planner", "operator", "random")
# How the fleet is driven: the planner (and its next release, on a few robots), whom an operator
# helps out, and missions that an operator drives throughout.
FLEET = {"planner 1": 0.70, "planner 2": 0.18, f"operator {Operator.version}": 0.12}
VERSIONS = {one.name: one.version for one in (PlannerFollower, Operator, RandomPolicy)}
BLOCK = 20  # missions dealt at a time, so that every condition comes up in a short recording too

PAUSE_S = (4.0, 12.0)  # between missions, unrecorded
MAX_DRIVEN = 3  # missions for each that was ordered, where some do not meet what they should


@dataclass(frozen=True)
class Mission:
    """A mission to be driven and recorded."""

    spec: EpisodeSpec
    driver: str  # planner, operator, random, or the name of a policy
    version: str
    handover: bool  # whether the operator takes over when the driver is stuck
    pause_s: float  # before the next mission
    order: int | None = None  # the one it is of, where missions were ordered


def schedule(
    seed: int,
    conditions: Mapping[str, float],
    driver: str,
    hardware: Perturbation | Schedule,
    *,
    version: str = "1",
) -> Iterator[Mission]:
    """Yield the missions of a recording, endlessly; the same for the same arguments.

    `driver` is `handover` (the fleet) or the name of whoever drives all of them.
    """
    rng = np.random.Generator(np.random.PCG64([seed, 0x6D697373]))
    kinds = _deal(conditions, rng)
    drivers = _deal(FLEET, rng)
    while True:
        name, version = next(drivers).split() if driver == HANDOVER else (driver, version)
        kind, mission_seed = next(kinds), int(rng.integers(1 << 31))
        yield Mission(
            EpisodeSpec(kind, mission_seed, _in_force(hardware, mission_seed)),
            name,
            version,
            handover=driver == HANDOVER and name == "planner",
            pause_s=round(float(rng.uniform(*PAUSE_S)), 3),
        )


class OrderedMissions:
    """The missions of a file, in rounds until the ordered number met their kind.

    A mission with pallets in an aisle may never pass them. So each round drives what is still
    owed, shuffled, and at most MAX_DRIVEN times what was ordered.
    """

    def __init__(
        self,
        orders: MissionOrders,
        file: MissionsFile,
        seed: int,
        driver: str,
        hardware: Perturbation | Schedule,
        *,
        version: str = "1",
    ) -> None:
        self.orders, self._hardware = orders, hardware
        # Another list is driven with other seeds: its missions are not the ones of the last.
        self._rng = np.random.Generator(np.random.PCG64([seed, zlib.crc32(as_toml(file).encode())]))
        self._drivers = _deal(FLEET, self._rng)
        self._driver, self._version = driver, version
        self.driven: Counter[int] = Counter()  # by order
        self.observed: Counter[int] = Counter()

    def rounds(self) -> Iterator[Iterator[Mission]]:
        """Yield rounds: drive each to its end, and `note` its missions, before the next."""
        while owed := self.owed():
            numbers = np.repeat(list(owed), list(owed.values()))
            yield iter([self._mission(int(number)) for number in self._rng.permutation(numbers)])

    def owed(self) -> dict[int, int]:
        """Return how many missions are still to be driven, by order."""
        owed = {}
        for number, order in enumerate(self.orders.orders):
            wanted = order.missions or 0
            left = min(wanted - self.observed[number], MAX_DRIVEN * wanted - self.driven[number])
            if left > 0:
                owed[number] = left
        return owed

    def note(self, mission: Mission, *, observed: bool) -> None:
        """Count a driven mission for its order, and whether its kind was observed."""
        if mission.order is not None:
            self.driven[mission.order] += 1
            self.observed[mission.order] += observed

    def _mission(self, number: int) -> Mission:
        rng, version = self._rng, self._version
        name = self._driver
        if name == HANDOVER:
            name, version = next(self._drivers).split()
        spec = self.orders.spec(number, int(rng.integers(1 << 31)))
        return Mission(
            msgspec.structs.replace(spec, perturbation=_in_force(self._hardware, spec.seed)),
            name,
            version,
            handover=self._driver == HANDOVER and name == "planner",
            pause_s=round(float(rng.uniform(*PAUSE_S)), 3),
            order=number,
        )


def meets(kind: str, true_conditions: Sequence[str]) -> bool:
    """Return whether a mission met its kind at one of its steps; a nominal one always does."""
    return MISSIONS[kind].is_true is None or any(
        kind in text.split(",") for text in true_conditions
    )


def _in_force(hardware: Perturbation | Schedule, mission_seed: int) -> Perturbation:
    if isinstance(hardware, Perturbation):
        return hardware
    return hardware.draw(np.random.default_rng([mission_seed, 1]))


def _deal(shares: Mapping[str, float], rng: np.random.Generator) -> Iterator[str]:
    """Yield names at their shares, block by block, carrying over what rounding leaves."""
    names = [name for name, share in shares.items() if share > 0]
    share = np.array([shares[name] for name in names])
    owed = np.zeros(len(names))
    while True:
        owed += share / share.sum() * BLOCK
        count = np.zeros(len(names), int)
        for _ in range(BLOCK):  # to whom most is owed; what came early is owed less than nothing
            index = int(owed.argmax())
            count[index] += 1
            owed[index] -= 1
        yield from (
            names[index] for index in rng.permutation(np.repeat(np.arange(len(names)), count))
        )


def parse_shares(text: str) -> dict[str, float]:
    """Parse `nominal=0.8,wheel_slip=0.2` to shares; omitted conditions get none.

    Raises:
        ConfigError: no such condition, no number, or nothing above 0.
    """
    shares = parse_numbers(text, "--conditions", KINDS)
    for name, share in shares.items():
        if not 0 <= share < float("inf"):
            raise ConfigError(f"must be at least 0, got {share}", where=f"--conditions {name}")
    if not sum(shares.values()) > 0:
        raise ConfigError(
            "no condition has a share above 0", where="--conditions", remedy="such as nominal=1"
        )
    return shares


def parse_numbers(text: str, flag: str, names: Sequence[str]) -> dict[str, float]:
    """Parse a flag's `name=number,name=number`.

    Raises:
        ConfigError: a name that is none of `names` or is given twice, or a value that is not a
            number.
    """
    numbers: dict[str, float] = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        name, _, number = part.partition("=")
        if name not in names or name in numbers:
            raise ConfigError(
                f"{name!r} is {'given twice' if name in numbers else 'unknown'}",
                where=flag,
                remedy=f"give numbers for {', '.join(names)}",
            )
        try:
            numbers[name] = float(number)
        except ValueError as error:
            raise ConfigError(f"{number!r} is not a number", where=f"{flag} {name}") from error
    return numbers


__all__ = [
    "FLEET",
    "VERSIONS",
    "Mission",
    "OrderedMissions",
    "meets",
    "parse_numbers",
    "parse_shares",
    "schedule",
]
