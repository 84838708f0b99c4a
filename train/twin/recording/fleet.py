"""A fleet that drives missions in the twin, several robots at a time, for a recorder.

The kinds and drivers of missions are drawn by their shares. Driven missions are returned in the
order in which they were drawn, however long each took.

A driver is a script of `restock.train.twin.env.drivers`, or any policy that acts on observations.
Steps are tagged with their driver's name, version and probability of the action, so that each
driver is a behaviour policy of its own in the store.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from msgspec.structs import replace

from restock.arrays import F32, F64, Ints
from restock.errors import ConfigError
from restock.ingest.profile.profile import load_profile
from restock.ingest.task.task import Signals
from restock.replay.fleet.missions_file import MissionsFile, as_toml
from restock.train.twin.env.drivers import (
    BehaviourPolicy,
    Handover,
    Operator,
    PlannerFollower,
    RandomPolicy,
)
from restock.train.twin.env.episode_queue import MissionOrders
from restock.train.twin.env.interface import Policy, epsilon_greedy
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.floors.layout import DEFAULT, Warehouse
from restock.train.twin.missions import KINDS, MISSIONS
from restock.train.twin.physics.episode import EpisodeSpec
from restock.train.twin.physics.perturbation import Perturbation, Schedule
from restock.train.twin.physics.robot_model import CHASSIS_Z_M
from restock.train.twin.physics.simulation import BLOCK_S, BodyState
from restock.train.twin.recording.robot_topics import Drive, Motion

HANDOVER = "handover"  # the fleet: planners, and an operator who takes over from them
SCRIPTED = (HANDOVER, "planner", "operator", "random")
# Shares of drivers in the fleet: the planner, its next release on a few robots (an operator takes
# over from both), and an operator who drives whole missions.
FLEET = {"planner 1": 0.70, "planner 2": 0.18, f"operator {Operator.version}": 0.12}
VERSIONS = {driver.name: driver.version for driver in (PlannerFollower, Operator, RandomPolicy)}
BLOCK = 20  # missions drawn at a time, so that a short recording has every condition, too

PAUSE_S = (4.0, 12.0)  # pause between missions, which is not recorded
MAX_DRIVEN = 3  # most missions driven per ordered one, as some do not meet the ordered kind


@dataclass(frozen=True)
class Mission:
    """A mission to be driven and recorded."""

    spec: EpisodeSpec
    driver: str  # planner, operator, random, or the name of a policy
    version: str
    handover: bool  # whether the operator takes over when the driver is stuck
    pause_s: float  # pause before the next mission
    order: int | None = None  # index in `MissionOrders.orders`; None: not driven for an order


def schedule(
    seed: int,
    conditions: Mapping[str, float],
    driver: str,
    hardware: Perturbation | Schedule,
    *,
    version: str = "1",
) -> Iterator[Mission]:
    """Yield the missions of a recording, endlessly; the same for the same arguments.

    `driver` is `handover` (the fleet), or the name of a driver for all missions.
    """
    rng = np.random.Generator(np.random.PCG64([seed, 0x6D697373]))
    kinds = _deal(conditions, rng)
    drivers = _deal(FLEET, rng)
    while True:
        name, version = next(drivers).split() if driver == HANDOVER else (driver, version)
        spec = EpisodeSpec(next(kinds), int(rng.integers(1 << 31)))
        yield _staff(spec, name, version, hardware, rng, fleet=driver == HANDOVER)


class OrderedMissions:
    """The missions of a file, in rounds until as many as ordered have met the ordered kind.

    A mission with pallets in an aisle may never get near them. So each round drives the missions
    still owed, shuffled; all rounds together drive at most MAX_DRIVEN times the ordered number.
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
        # Seeds depend on the file, so that another file gives other missions.
        self._rng = np.random.Generator(np.random.PCG64([seed, zlib.crc32(as_toml(file).encode())]))
        self._drivers = _deal(FLEET, self._rng)
        self._driver, self._version = driver, version
        self.driven: Counter[int] = Counter()  # missions driven so far, by order
        self.observed: Counter[int] = Counter()

    def rounds(self) -> Iterator[Iterator[Mission]]:
        """Yield rounds; drive and `note` all missions of a round before taking the next round."""
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
        fleet = self._driver == HANDOVER
        return _staff(spec, name, version, self._hardware, rng, fleet=fleet, order=number)


def meets(kind: str, true_conditions: Sequence[str]) -> bool:
    """Return whether a mission met its kind at one of its steps; a nominal one always does."""
    return MISSIONS[kind].is_true is None or any(
        kind in text.split(",") for text in true_conditions
    )


def _staff(
    spec: EpisodeSpec,
    name: str,
    version: str,
    hardware: Perturbation | Schedule,
    rng: np.random.Generator,
    *,
    fleet: bool,
    order: int | None = None,
) -> Mission:
    """Return the mission of a spec with a driver, hardware and a pause after it.

    In a `fleet`, the operator takes over from planners. A schedule's hardware follows from the
    mission's seed.
    """
    if isinstance(hardware, Schedule):
        hardware = hardware.draw(np.random.default_rng([spec.seed, 1]))
    pause_s = round(float(rng.uniform(*PAUSE_S)), 3)
    spec = replace(spec, perturbation=hardware)
    return Mission(spec, name, version, fleet and name == "planner", pause_s, order)


def _deal(shares: Mapping[str, float], rng: np.random.Generator) -> Iterator[str]:
    """Yield names by their shares, in shuffled blocks; rounding carries over to the next block."""
    names = [name for name, share in shares.items() if share > 0]
    share = np.array([shares[name] for name in names])
    owed = np.zeros(len(names))
    while True:
        owed += share / share.sum() * BLOCK
        count = np.zeros(len(names), int)
        for _ in range(BLOCK):  # take the name that is owed most; debts may become negative
            index = int(owed.argmax())
            count[index] += 1
            owed[index] -= 1
        yield from (
            names[index] for index in rng.permutation(np.repeat(np.arange(len(names)), count))
        )


def parse_shares(text: str) -> dict[str, float]:
    """Parse `nominal=0.8,wheel_slip=0.2` to shares; omitted conditions get none.

    Raises:
        ConfigError: a condition is unknown, a share is not a number of at least 0, or all are 0.
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
        ConfigError: a name is not in `names` or is given twice, or a value is not a number.
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


_Key = tuple[str, str, bool]  # a mission's driver, its version, whether the operator takes over


class CarefulPlanner(PlannerFollower):
    """The planner's next release, on a few robots at first: slows and stops farther away."""

    version = "2"
    stop_m = 0.40
    slow_m = 1.20


class ExternalPolicy:
    """A policy from outside that drives, with a random action at probability `epsilon`."""

    def __init__(self, policy: Policy, *, epsilon: float = 0.0, seed: int = 0) -> None:
        self.policy, self.epsilon = policy, epsilon
        self.name, self.version = policy.name, policy.version
        self._rng = np.random.default_rng([seed, 0x6775])
        self.acting = np.array([], np.str_)
        self.acting_version = np.array([], np.str_)

    def act(self, env: WarehouseVectorEnv, observation: F32) -> tuple[Ints, F64]:
        """Return actions (N,) and their probabilities (N,).

        Raises:
            ConfigError: epsilon is set for a policy that is itself stochastic.
        """
        action, given = self.policy.act(env, observation)
        probability = np.asarray(given, np.float64)
        if self.epsilon:
            if (probability < 1).any():
                raise ConfigError(
                    f"{self.name} is stochastic itself: the probability of an action that epsilon "
                    "chooses is unknown",
                    where="--epsilon",
                    remedy="leave it out",
                )
            actions = len(env.task.actions)
            action, explored = epsilon_greedy(action, actions, self.epsilon, self._rng)
            probability = explored.astype(np.float64)
        self.acting = np.full(len(action), self.name)
        self.acting_version = np.full(len(action), self.version)
        return np.asarray(action, np.int64), probability


class BehaviourPolicies:
    """The drivers of N robots side by side. A driver without a robot does not act.

    Args:
        epsilon: share of random actions of the scripted drivers; None: each one's default.
        external: a policy that drives all missions instead of the scripts.
    """

    def __init__(
        self,
        robots: int,
        *,
        seed: int,
        epsilon: float | None = None,
        external: ExternalPolicy | None = None,
    ) -> None:
        self._seed, self._external = seed, external
        self._epsilon = {} if epsilon is None else {"epsilon": epsilon}
        self._drivers: dict[_Key, BehaviourPolicy] = {}
        self._keys: list[_Key] = [("planner", "1", False)] * robots

    def begin(self, robot: int, mission: Mission) -> None:
        """Start a mission on one robot."""
        self._keys[robot] = (mission.driver, mission.version, mission.handover)

    def act(self, env: WarehouseVectorEnv) -> tuple[Ints, list[tuple[str, str]], F64]:
        """Return actions (N,), who chose each as (policy, version), and its probability (N,)."""
        action = np.zeros(env.num_envs, np.int64)
        probability = np.ones(env.num_envs)
        tags = [("", "")] * env.num_envs
        for key in sorted(set(self._keys)):
            if key not in self._drivers:
                self._drivers[key] = self._make(*key)
            driver = self._drivers[key]
            actions, probabilities = driver.act(env, env.observation)
            for robot in (robot for robot, other in enumerate(self._keys) if other == key):
                action[robot], probability[robot] = actions[robot], probabilities[robot]
                tags[robot] = (str(driver.acting[robot]), str(driver.acting_version[robot]))
        return action, tags, probability

    def _make(self, name: str, version: str, handover: bool) -> BehaviourPolicy:
        if self._external is not None:
            return self._external
        seed = self._seed * 16 + len(self._drivers)  # differs by driver
        if name == "random":
            return RandomPolicy(seed=seed)
        if name == "operator":
            return Operator(seed=seed, **self._epsilon)
        kind = CarefulPlanner if version == "2" else PlannerFollower
        planner = kind(seed=seed, **self._epsilon)
        return Handover(planner, Operator(seed=seed, **self._epsilon)) if handover else planner


ROBOTS = 8  # number of robots that drive at a time
MOTION_PERIOD_S = 0.02


@dataclass(frozen=True)
class DrivenMission:
    """A driven mission, with the twin's own data of its T steps."""

    mission: Mission
    drive: Drive
    observation: F32  # (T + 1, D)
    action: Ints  # (T,)
    reward: F32  # (T,)
    success: bool
    terminated: bool  # the last step was terminal; False: truncated
    floor: Warehouse


@dataclass
class _Log:
    """The log of one robot's current mission."""

    place: int  # index among the missions
    mission: Mission
    hardware: Perturbation
    rng: np.random.Generator  # for the noise of scans between ticks
    pallets: F64  # (P, 3)
    patches: F64  # (K, 5)
    motion: list[BodyState]  # true states of all robots since the mission began
    signals: list[dict[str, Any]] = field(default_factory=list)  # T + 1 rows
    observation: list[F32] = field(default_factory=list)  # T + 1
    action: list[int] = field(default_factory=list)
    reward: list[float] = field(default_factory=list)
    policy: list[tuple[str, str, float]] = field(default_factory=list)
    truth: list[str] = field(default_factory=list)
    exposure: list[str] = field(default_factory=list)
    scan_s: list[float] = field(default_factory=list)
    ranges_m: list[F64] = field(default_factory=list)
    plans: list[tuple[int, F64]] = field(default_factory=list)
    plan_number: int = -1
    traffic: list[F64] = field(default_factory=list)  # T + 1


class Fleet:
    """N robots that drive missions in the twin, under one set of effective parameters.

    Args:
        hardware: these parameters; a mission may have its own.
        layouts: the floors, as `restock.train.twin.floors.floors.open_floors` reads them. If a
            mission names no floor, its seed draws one.
        conditions: its keys are the kinds of the missions to come, which must fit on the floors.
        stops: a bump is a protective stop and ends the mission. Otherwise the mission goes on, so
            that an operator can drive the robot out.
        scan_hz: the lidar scans at every control tick, and above 5 Hz once more between two ticks.
    """

    def __init__(
        self,
        hardware: Perturbation | Schedule,
        *,
        layouts: str = DEFAULT,
        conditions: Mapping[str, float] | None = None,
        stops: bool = True,
        scan_hz: float = 10.0,
    ) -> None:
        task = load_profile("warehouse_amr").task
        self.env = WarehouseVectorEnv(
            ROBOTS,
            task=replace(task, bump_terminates=task.bump_terminates and stops),
            perturbation=hardware,
            layouts=layouts,
            conditions=conditions,
            autoreset_mode=AutoresetMode.DISABLED,
        )
        self.period_s = self.env.task.control_period_s
        self._scans_between = scan_hz * self.period_s > 1
        self._logs: list[_Log | None] = [None] * ROBOTS
        self._motion: list[BodyState] = []  # states during the current step
        self._scan: F64 | None = None  # true ranges half-way through the current step
        self.env.set_block_callback(self._note_motion, MOTION_PERIOD_S)

    def drive(
        self, missions: Iterator[Mission], policies: BehaviourPolicies
    ) -> Iterator[DrivenMission]:
        """Drive missions and yield them in their order, until none is left or the caller stops."""
        env, numbered = self.env, enumerate(missions)
        finished: dict[int, DrivenMission] = {}
        delivered = 0
        self._begin(np.arange(env.num_envs), numbered, policies)
        while any(log is not None for log in self._logs):
            action, tags, probability = policies.act(env)
            self._motion, self._scan = [], None
            _, reward, terminated, truncated, info = env.step(action)
            ended = np.flatnonzero(terminated | truncated)
            for robot, log in enumerate(self._logs):
                if log is not None:
                    log.action.append(int(action[robot]))
                    log.policy.append((*tags[robot], float(probability[robot])))
                    log.reward.append(float(reward[robot]))
                    log.truth.append(str(info["true_condition"][robot]))
                    log.exposure.append(str(info["true_exposure"][robot]))
                    self._note_step(log, robot, info)
            for robot in ended.tolist():
                if (log := self._logs[robot]) is not None:
                    finished[log.place] = self._finish(
                        log, robot, info, terminated=bool(terminated[robot])
                    )
            if len(ended):
                self._begin(ended, numbered, policies)
            while delivered in finished:
                yield finished.pop(delivered)
                delivered += 1

    def _begin(
        self,
        robots: Ints,
        missions: Iterator[tuple[int, Mission]],
        policies: BehaviourPolicies,
    ) -> None:
        """Give each of these robots its next mission; without one, a robot drives on unrecorded."""
        env = self.env
        entries = [next(missions, None) for _ in robots]
        idle = EpisodeSpec("nominal", 0)
        env.set_episodes([idle if entry is None else entry[1].spec for entry in entries])
        mask = np.zeros(env.num_envs, np.bool_)
        mask[robots] = True
        env.reset(options={"reset_mask": mask})
        still = np.zeros((env.num_envs, 3))
        standing = env.simulation.body_state(still, np.zeros(env.num_envs, np.bool_))
        for robot, entry in zip(robots.tolist(), entries, strict=True):
            if entry is None:
                self._logs[robot] = None
                continue
            place, mission = entry
            log = _Log(
                place,
                mission,
                mission.spec.perturbation or env.perturbation,
                np.random.Generator(np.random.PCG64(mission.spec.seed)),
                env.simulation.pallets[robot].copy(),
                env.simulation.patches[robot].copy(),
                [standing],
            )
            self._logs[robot] = log
            self._note_tick(log, robot, env.signals)
            policies.begin(robot, mission)

    def _note_motion(self, state: BodyState) -> None:
        self._motion.append(state)
        if self._scans_between and len(self._motion) == round(BLOCK_S / MOTION_PERIOD_S):
            self._scan = self.env.simulation.cast(np.arange(self.env.num_envs))

    def _note_step(self, log: _Log, robot: int, info: Mapping[str, Any]) -> None:
        """Note what an action led to."""
        log.motion.extend(self._motion)
        if self._scan is not None and not log.hardware.lidar_period_s:
            log.scan_s.append(round((len(log.action) - 1) * self.period_s + BLOCK_S, 6))
            log.ranges_m.append(self._measured(log, self._scan[robot]))
        self._note_tick(log, robot, info["signals"])

    def _note_tick(self, log: _Log, robot: int, signals: Signals) -> None:
        """Note what the policy sees at a tick."""
        env, tick = self.env, len(log.action)
        log.signals.append({name: column[robot] for name, column in signals.items()})
        log.observation.append(env.observation[robot].copy())
        every = max(round(log.hardware.lidar_period_s / self.period_s), 1)
        if tick % every == 0:  # otherwise the robot keeps its previous scan
            log.scan_s.append(round(tick * self.period_s, 6))
            log.ranges_m.append(env.sensing.ranges_m[robot].copy())
        traffic = env.simulation.traffic
        log.traffic.append(np.column_stack([traffic.position_m[robot], traffic.heading_rad[robot]]))
        number = int(env.navigation.plan_number[robot])
        if number != log.plan_number:
            log.plans.append((tick, env.navigation.plans_m[robot].copy()))
            log.plan_number = number

    def _measured(self, log: _Log, true_ranges_m: F64) -> F64:
        """Return a scan between ticks, with its own draw of the same noise and dropout."""
        hardware = log.hardware
        ranges = true_ranges_m + log.rng.normal(0, hardware.lidar_noise_m, len(true_ranges_m))
        lost = log.rng.random(len(ranges)) < hardware.lidar_dropout
        return np.where(lost, np.inf, np.maximum(ranges, 0.0))

    def _finish(
        self, log: _Log, robot: int, info: Mapping[str, Any], *, terminated: bool
    ) -> DrivenMission:
        env = self.env
        goal = env.navigation.goals_m[robot]
        names = log.signals[0].keys()
        action = np.array(log.action, np.int64)
        drive = Drive(
            goal_m=(float(goal[0]), float(goal[1])),
            motion=_motion_of(log.motion, robot),
            tick_s=np.round(np.arange(len(log.signals)) * self.period_s, 6),
            signals={name: np.array([row[name] for row in log.signals]) for name in names},
            scan_s=np.array(log.scan_s),
            ranges_m=np.array(log.ranges_m),
            command=np.asarray(env.task.actions, np.float64)[action],
            true_condition=log.truth,
            true_exposure=log.exposure,
            policy=log.policy,
            plans=log.plans,
            pallets=log.pallets,
            patches=log.patches,
            traffic=np.array(log.traffic),
            perturbation=log.hardware,
            goal_radius_m=env.task.goal_radius_m,
            body_m=(env.task.body.length_m, env.task.body.width_m, 2 * CHASSIS_Z_M),
        )
        return DrivenMission(
            mission=log.mission,
            drive=drive,
            observation=np.array(log.observation),
            action=action,
            reward=np.array(log.reward, np.float32),
            success=bool(info["success"][robot]),
            terminated=terminated,
            floor=env.floor_of(robot),
        )


def _motion_of(states: list[BodyState], robot: int) -> Motion:
    """Extract one robot's motion from the states of all robots."""
    pose = np.array(
        [(state.x_m[robot], state.y_m[robot], state.yaw_rad[robot]) for state in states]
    )
    pose[:, 2] = np.unwrap(pose[:, 2])
    return Motion(
        time_s=np.round(np.arange(len(states)) * MOTION_PERIOD_S, 6),
        pose=pose,
        wheel_angle_rad=np.array([state.wheel_angle_rad[robot] for state in states]),
        wheel_rate_radps=np.array([state.wheel_speed_radps[robot] for state in states]),
        yaw_rate_radps=np.array([state.yaw_rate_radps[robot] for state in states]),
        accel_mps2=np.array([state.accel_mps2[robot, :2] for state in states]),
        bumped=np.array([state.bumped[robot] for state in states]),
    )
