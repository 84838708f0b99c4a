"""`restock twin record`: missions driven by simulated hardware, written as logs.

The simulated hardware is the twin with half the timestep and other physical parameters than in
training, so that there is a gap between logs and simulator to find. Missions are driven, published
and written one after another, so memory does not grow with the recording's length.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from restock.errors import ConfigError
from restock.ingest.profile.tag_rules import tag_problem
from restock.ingest.task.schema import primary_of
from restock.replay.fleet.missions_file import MissionOrder, MissionsFile
from restock.toml import typed
from restock.train.twin.env.episode_queue import MissionOrders
from restock.train.twin.env.interface import Policy
from restock.train.twin.floors.cells import cells_of
from restock.train.twin.floors.layout import DEFAULT, Warehouse
from restock.train.twin.missions import NATURAL
from restock.train.twin.physics.perturbation import Perturbation, Schedule
from restock.train.twin.physics.robot_model import LIDAR_BEAMS, TRACK_M, WHEEL_RADIUS_M
from restock.train.twin.recording.bag_writer import Format, recording_sink
from restock.train.twin.recording.fleet import (
    HANDOVER,
    SCRIPTED,
    VERSIONS,
    BehaviourPolicies,
    ExternalPolicy,
    Fleet,
    Mission,
    OrderedMissions,
    meets,
    parse_numbers,
    schedule,
)
from restock.train.twin.recording.publish import Rates, Robot
from restock.train.twin.recording.robot_topics import TOPICS, Lidar, Odometer

HARDWARE = Perturbation(
    name="stand-in hardware",
    friction_scale=0.85,
    patch_friction_scale=1.1,
    payload_kg=20.0,
    wheel_radius_scale=0.985,
    latency_s=0.08,
    gain=0.98,
    lidar_noise_m=0.015,
    lidar_dropout=0.01,
    localisation_noise_m=0.005,
    localisation_drift_m=0.025,
    encoder_noise_radps=0.04,
    gyro_noise_radps=0.008,
    gyro_bias_radps=0.004,
    accel_noise_mps2=0.08,
    timestep_s=0.005,
)
NOISELESS = Perturbation(
    name="nominal without noise",
    lidar_noise_m=0.0,
    lidar_dropout=0.0,
    localisation_noise_m=0.0,
    localisation_drift_m=0.0,
    localisation_yaw_noise_rad=0.0,
    encoder_noise_radps=0.0,
    gyro_noise_radps=0.0,
    accel_noise_mps2=0.0,
)
FIRST_NS = 1_772_438_400_000_000_000  # 2026-03-02, 08:00 UTC: fixed, for reproducible bytes
LATEST_START_NS = 7_258_118_400 * 10**9  # year 2200: 64-bit timestamps end in 2262
LIDAR_RANGE_M = (0.05, 25.0)
MAP_CELL_M = 0.1


@dataclass(frozen=True)
class RecordingPlan:
    """The settings of a recording. Either `minutes` or `missions` ends it."""

    format: Format = "mcap"
    minutes: float | None = None
    missions: int | MissionsFile | None = None  # a file: until its missions have met their kinds
    seed: int = 0
    conditions: Mapping[str, float] = field(default_factory=lambda: dict(NATURAL))
    policy: str = HANDOVER  # the fleet; or planner, operator, random, or the name of a given policy
    epsilon: float | None = None  # share of random actions; None: each driver's default
    rates: Rates = field(default_factory=Rates)
    hardware: Perturbation | Schedule = HARDWARE  # a schedule draws one for every mission
    layouts: str = DEFAULT  # floors, as `restock.train.twin.floors.floors.open_floors` reads them
    start_ns: int = FIRST_NS  # when the first mission starts
    tags: Mapping[str, str] = field(default_factory=dict)  # robot, site, …

    def __post_init__(self) -> None:
        """Raise ConfigError if the recording would have no end, or nothing in it."""
        if (self.minutes is None) == (self.missions is None):
            raise ConfigError("give either minutes or missions", where="recording")
        for name in ("minutes", "missions"):
            value = getattr(self, name)
            if isinstance(value, int | float) and not 0 < value < float("inf"):
                raise ConfigError(f"{name} must be above 0, got {value}", where="recording")
        for name, value in self.tags.items():
            if problem := tag_problem(name, value):
                raise ConfigError(problem, where="recording")
        if not 0 <= self.start_ns < LATEST_START_NS:
            raise ConfigError(
                f"a recording begins between 1970 and 2200, not at {self.start_ns} ns",
                where="recording",
            )
        if self.seed < 0:
            raise ConfigError(f"seed must be 0 or more, got {self.seed}", where="recording")
        if self.epsilon is not None and not 0 <= self.epsilon <= 1:
            raise ConfigError(f"must be in [0, 1], got {self.epsilon}", where="--epsilon")
        if self.epsilon is not None and self.policy == "random":
            raise ConfigError(
                "random already takes every action with the same probability",
                where="--epsilon",
                remedy="leave it out",
            )

    @property
    def kinds(self) -> Mapping[str, float]:
        """Return the shares of missions by kind, or their numbers if missions are ordered."""
        if not isinstance(self.missions, MissionsFile):
            return self.conditions
        amounts: Counter[str] = Counter()
        for order in self.orders():
            amounts[str(order.kind)] += order.missions or 0
        return dict(amounts)

    def orders(self) -> list[MissionOrder]:
        """Return the file's orders for this robot or for any robot; none without a file.

        Raises:
            ConfigError: all orders are for other robots, or some are for certain robots and no tag
                says which robot this is.
        """
        if not isinstance(self.missions, MissionsFile):
            return []
        mine = self.tags.get("robot")
        robots = sorted({order.robot for order in self.missions.missions if order.robot})
        chosen = [order for order in self.missions.missions if order.robot in (None, mine)]
        if not chosen or (robots and mine is None):
            raise ConfigError(
                f"asks for missions of {', '.join(robots)}"
                + (f", none of {mine}" if mine else ": no robot was given"),
                where="the missions file",
                remedy=f"`--tag robot={robots[0]}` drives the missions of that robot",
            )
        return chosen

    def describe(self) -> dict[str, Any]:
        """Return the plan as plain values for JSON."""
        return {
            "format": self.format,
            "minutes": self.minutes,
            "missions": sum(order.missions or 0 for order in self.orders()) or self.missions,
            "orders": [
                {k: v for k, v in msgspec.structs.asdict(order).items() if v and k != "fills"}
                for order in self.orders()
            ],
            "seed": self.seed,
            "conditions": dict(self.kinds),
            "policy": self.policy,
            "epsilon": self.epsilon,
            "rates_hz": msgspec.structs.asdict(self.rates),
            "hardware": self.hardware.name,
            "layouts": self.layouts,
            "start": date_text(self.start_ns),
            "tags": dict(self.tags),
            "topics": [topic.name for topic in TOPICS],
        }


@dataclass
class RecordingSummary:
    """A summary of a recording. Counts are by kind of mission, unless a comment says otherwise."""

    path: Path
    plan: RecordingPlan
    missions: Counter[str] = field(default_factory=Counter)
    succeeded: Counter[str] = field(default_factory=Counter)
    observed: Counter[str] = field(default_factory=Counter)  # missions that truly met their kind
    steps: Counter[str] = field(default_factory=Counter)  # by true condition
    policies: Counter[str] = field(default_factory=Counter)  # steps by driver
    handovers: int = 0
    topics: Counter[str] = field(default_factory=Counter)  # messages by topic
    minutes: float = 0.0
    work_s: float = 0.0

    def describe(self) -> dict[str, Any]:
        """Return the summary as `restock twin record --json` prints it."""
        files = [self.path] if self.path.is_file() else list(self.path.iterdir())
        return {
            "path": str(self.path),
            "format": self.plan.format,
            "seed": self.plan.seed,
            "size_bytes": sum(file.stat().st_size for file in files),
            "start": date_text(self.plan.start_ns),
            "tags": dict(self.plan.tags),
            "minutes": round(self.minutes, 3),
            "missions": dict(self.missions),
            "succeeded": {kind: self.succeeded[kind] for kind in self.missions},
            "met": {kind: self.observed[kind] for kind in self.missions},
            "ordered": dict(self.plan.kinds) if self.plan.orders() else None,
            "steps": dict(self.steps),
            "policy_steps": dict(self.policies),
            "handovers": self.handovers,
            "messages": sum(self.topics.values()),
            "topics": {topic.name: self.topics[topic.name] for topic in TOPICS},
            "work_s": round(self.work_s, 2),
        }


def record(
    path: Path | str,
    plan: RecordingPlan,
    *,
    policy: Policy | None = None,
    on_mission: Callable[[int, float], None] | None = None,
) -> RecordingSummary:
    """Drive and write a recording; `on_mission(1, minutes)` is called after each mission.

    A `policy` drives instead of the script that the plan names: a trained one, or any object with a
    `name`, a `version` and `act(env, observation)`.

    Raises:
        RecordingError: `path` exists, or its folder cannot be written to.
        ConfigError: the plan names no script, and no policy was given.
    """
    begun, path = time.perf_counter(), Path(path)
    external = None
    if policy is not None:
        external = ExternalPolicy(policy, epsilon=plan.epsilon or 0.0, seed=plan.seed)
    elif plan.policy not in SCRIPTED:
        raise ConfigError(
            f"unknown policy {plan.policy!r}",
            where="recording",
            remedy=f"give {', '.join(SCRIPTED)}, or a policy that was loaded",
        )
    fleet = Fleet(
        plan.hardware,
        layouts=plan.layouts,
        conditions=plan.kinds,
        stops=plan.policy != HANDOVER,
        scan_hz=plan.rates.scan,
    )
    robot = _robot(plan, fleet)
    summary = RecordingSummary(path, plan)
    driver, version = plan.policy, VERSIONS.get(plan.policy, "1")
    if policy is not None:
        driver, version = policy.name, policy.version
    ordered: OrderedMissions | None = None
    rounds: Iterator[Iterator[Mission]]
    if isinstance(plan.missions, MissionsFile):
        floors, planners = fleet.env.floors, fleet.env.navigation.planners
        ordered = OrderedMissions(
            MissionOrders(plan.orders(), floors, planners, where="the missions file"),
            *(plan.missions, plan.seed, driver, plan.hardware),
            version=version,
        )
        rounds = ordered.rounds()
    else:
        endless = schedule(plan.seed, plan.conditions, driver, plan.hardware, version=version)
        rounds = iter([islice(endless, plan.missions)])
    drivers = BehaviourPolicies(
        fleet.env.num_envs, seed=plan.seed, epsilon=plan.epsilon, external=external
    )
    start_ns = plan.start_ns
    with recording_sink(path, plan.format, TOPICS, plan.tags) as sink:
        floor: Warehouse | None = None
        for driven in (one for missions in rounds for one in fleet.drive(missions, drivers)):
            if driven.floor is not floor:  # send the map once, and again on another floor
                floor = driven.floor
                racks = ~cells_of(floor, MAP_CELL_M).T
                occupied = np.pad(racks, 1, constant_values=True)  # one cell of wall around
                static = robot.static(start_ns, occupied, MAP_CELL_M, (-MAP_CELL_M, -MAP_CELL_M))
                sink.write(static)
                summary.topics.update(message.topic for message in static)
            start_ns += 50_000_000  # 50 ms after the latched messages or the pause
            messages = robot.publish(driven.drive, start_ns)
            sink.write(messages)
            summary.topics.update(message.topic for message in messages)
            seconds = float(driven.drive.tick_s[-1])
            kind = driven.mission.spec.condition
            observed = meets(kind, driven.drive.true_condition)
            if ordered is not None:
                ordered.note(driven.mission, observed=observed)
            summary.missions[kind] += 1
            summary.succeeded[kind] += driven.success
            summary.observed[kind] += observed
            summary.steps.update(map(primary_of, driven.drive.true_condition))
            who = [f"{name} {version}" for name, version, _ in driven.drive.policy]
            summary.policies.update(who)
            summary.handovers += sum(a != b for a, b in pairwise(who))
            summary.minutes += seconds / 60
            start_ns += round((seconds + driven.mission.pause_s) * 1e9)
            if on_mission is not None:
                on_mission(1, seconds / 60)
            if plan.minutes is not None and summary.minutes >= plan.minutes:
                break
    summary.work_s = time.perf_counter() - begun
    return summary


def parse_start(text: str) -> int:
    """Parse the start, an ISO date or time (UTC by default), to nanoseconds.

    Raises:
        ConfigError: it is not a date or time.
    """
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise ConfigError(
            f"{text!r} is not a time", where="--start", remedy="such as 2026-10-05T08:00"
        ) from error
    moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return (moment - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1) * 1000


def date_text(moment_ns: int) -> str:
    """Return a moment in ISO format, UTC."""
    moment = datetime.fromtimestamp(moment_ns // 10**9, UTC)
    return moment.isoformat().replace("+00:00", "Z")


def parse_rates(text: str) -> Rates:
    """Parse `odom=20,scan=5` to rates; omitted topics keep their default.

    Raises:
        ConfigError: a topic is unknown, or a rate is out of range.
    """
    rates = parse_numbers(text, "--rates", [field.name for field in msgspec.structs.fields(Rates)])
    return typed(rates, Rates, where="--rates")


def _robot(plan: RecordingPlan, fleet: Fleet) -> Robot:
    bearings = fleet.env.simulation.bearings_rad
    lidar = Lidar(
        angle_min_rad=float(bearings[0]),
        angle_increment_rad=2 * np.pi / LIDAR_BEAMS,
        range_min_m=LIDAR_RANGE_M[0],
        range_max_m=LIDAR_RANGE_M[1],
        x_m=fleet.env.task.body.lidar_x_m,
    )
    rng = np.random.Generator(np.random.PCG64([plan.seed, 0x726F62]))
    return Robot(rng, lidar, plan.rates, Odometer(WHEEL_RADIUS_M, TRACK_M))
