"""The robot's `[robot]` table, and the limiter of its commands.

The outline and the lidar's position are in `[task.body]`, as ingest needs them too; `[robot]` holds
what only the twin needs. A value that is left out is unknown: the twin derives it from the
outline's size (`restock.train.twin.physics.robot_model`) and reports that it did. `[robot.origin]`
records the source of each value.

The limiter filters the commands of any driver, as Nav2's collision monitor does, on the robot and
in the twin. It only ever reduces speed, by these rules:

- `unknown`: an input is stale or not a number, so the robot stops;
- `stop`, `slow`: on the arc of the command, the outline must be able to stop `stop_m` short of the
  first lidar return, after `reaction_s` at the reduced speed;
- `speed`, `acceleration`: the command exceeds the robot's limits. Braking is never limited.

Slowing scales speed and yaw rate by one factor, so that the robot stays on the arc of the command.
The limiter uses the nearest return of each sector, at the sector's middle bearing. Space behind a
return counts as occupied; moving things are assumed to stand still. For a robot without a lidar,
only `unknown`, `speed` and `acceleration` apply.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from restock.arrays import F64, Bools, Ints
from restock.errors import ConfigError
from restock.ingest.task.surroundings import outline_reach
from restock.ingest.task.task import Body, Task
from restock.toml import Checked

Drive = Literal["differential", "skid_steer", "omnidirectional", "ackermann"]
# Source of a value: written by hand, a recording's description, a URDF file, a fit of the twin,
# estimates from logs, or the outline's size.
Origin = Literal["profile", "robot_description", "urdf", "fit", "logs", "default"]
Metres = Annotated[float, Meta(gt=0, le=10)]
Limit = Annotated[float, Meta(gt=0, le=100)]
OUTLINE = "outline"  # key in [robot.origin] for the outline in [task.body]
USUAL_STEERING_RAD = 0.6  # default of max_steering_rad


class Lidar(Checked, frozen=True):
    """The `[robot.lidar]` of a profile: height and beams, in the lidar's own frame.

    The lidar's position on the outline, and its yaw, are in `[task.body]`.
    """

    z_m: Annotated[float, Meta(gt=0, le=5)] | None = None  # height above the floor
    beams: Annotated[int, Meta(ge=4, le=720)] | None = None  # evenly spaced, from angle_min_rad on
    angle_min_rad: Annotated[float, Meta(ge=-7, le=7)] = -math.pi
    angle_max_rad: Annotated[float, Meta(ge=-7, le=7)] = math.pi  # no beam here in a full circle

    def check(self) -> None:
        if not 0 < self.angle_max_rad - self.angle_min_rad <= 2 * math.pi + 1e-3:
            raise ValueError(
                "angle_max_rad must be greater than angle_min_rad, by at most a full turn; got "
                f"{self.angle_min_rad:g} and {self.angle_max_rad:g}"
            )


class Robot(Checked, frozen=True):
    """The `[robot]` of a profile; None is unknown."""

    drive: Drive = "differential"
    wheel_radius_m: Metres | None = None
    track_m: Metres | None = None  # distance between left and right wheels' contact points
    wheelbase_m: Metres | None = None  # distance between the axles, if there are two
    # How far the axle (the middle of two) is ahead of the outline's middle. Poses are the axle's.
    axle_x_m: Annotated[float, Meta(ge=-10, le=10)] = 0.0
    mass_kg: Annotated[float, Meta(gt=0, le=5000)] | None = None  # total, with wheels
    height_m: Metres | None = None
    casters_m: tuple[tuple[float, float], ...] | None = None  # x ahead of the axle, y to the left
    max_speed_mps: Limit | None = None
    max_yaw_rate_radps: Limit | None = None
    max_accel_mps2: Limit | None = None
    max_yaw_accel_radps2: Limit | None = None
    # For ackermann: largest angle, to either side, of a virtual wheel in the middle of the front
    # axle, and how fast the angle changes.
    max_steering_rad: Annotated[float, Meta(gt=0.01, le=1.4)] | None = None
    max_steering_rate_radps: Limit | None = None
    # Wheel separation that controller and odometry assume, divided by track_m. It is above 1 if the
    # robot turns less than its wheels suggest, like skid-steer robots. None: the twin's own value.
    track_ratio: Annotated[float, Meta(ge=0.5, le=10)] | None = None
    lidar: Lidar = Lidar()
    origin: dict[str, Origin] = msgspec.field(default_factory=dict)

    def check(self) -> None:
        lidar = (f"lidar.{name}" for name in Lidar.__struct_fields__)
        known = {*self.__struct_fields__, *lidar, OUTLINE}
        for name in self.origin:
            if name not in known or name in ("origin", "lidar"):
                raise ValueError(f"origin refers to a value that the robot does not have: {name!r}")
        if self.wheelbase_m is None and self.drive == "ackermann":
            raise ValueError("an ackermann robot needs wheelbase_m")
        if self.drive != "ackermann" and (self.max_steering_rad or self.max_steering_rate_radps):
            raise ValueError(
                f"a robot with {self.drive} drive does not steer: leave out max_steering_*"
            )

    @property
    def outline_guessed(self) -> bool:
        """Return whether the outline is a guess that nobody measured."""
        return self.origin.get(OUTLINE) == "default"

    @property
    def min_turning_radius_m(self) -> float:
        """Return the smallest radius that the axle can drive; 0 if the robot can turn in place."""
        if self.drive != "ackermann" or self.wheelbase_m is None:
            return 0.0
        return self.wheelbase_m / math.tan(self.max_steering_rad or USUAL_STEERING_RAD)

    def origin_of(self, name: str) -> Origin:
        """Return the source of the value of a key, such as `mass_kg` or `lidar.beams`."""
        if name in self.origin:
            return self.origin[name]
        value = getattr(self.lidar, name[6:]) if name.startswith("lidar.") else getattr(self, name)
        return "default" if value is None else "profile"


def beyond_limits(robot: Robot, actions: tuple[tuple[float, float], ...]) -> str | None:
    """Describe the first action (m/s, rad/s) that is too fast for this robot; None if none is."""
    for speed, turn in actions:
        for value, most, name, unit in (
            (speed, robot.max_speed_mps, "max_speed_mps", "m/s"),
            (turn, robot.max_yaw_rate_radps, "max_yaw_rate_radps", "rad/s"),
        ):
            if most is not None and abs(value) > most * (1 + 1e-3):
                return f"[{speed:g}, {turn:g}] is beyond robot.{name} = {most:g} {unit}"
    return None


def refuse_beyond_steering(
    robot: Robot | None, actions: tuple[tuple[float, float], ...], *, where: str
) -> None:
    """Raise ConfigError if an action (m/s, rad/s) turns tighter than this robot can steer."""
    if robot is not None and (problem := _beyond_steering(robot, actions)):
        raise ConfigError(
            f"`task.actions`: {problem}",
            where=where,
            remedy="give the action more speed or a lower yaw rate; or, if the robot can steer "
            "tighter, correct [robot]",
        )


def _beyond_steering(robot: Robot, actions: tuple[tuple[float, float], ...]) -> str | None:
    least = robot.min_turning_radius_m
    for speed, turn in actions if least else ():
        if turn and not speed:
            return (
                f"[{speed:g}, {turn:g}] turns on the spot, which a robot that steers"
                ' (robot.drive = "ackermann") cannot'
            )
        if abs(turn) * least > abs(speed) * (1 + 1e-2):
            return (
                f"[{speed:g}, {turn:g}] turns on a circle of {abs(speed / turn):.3g} m, and the"
                f" robot's tightest has {least:.3g} m (wheelbase_m, max_steering_rad)"
            )
    return None


# The rules by number, weakest first; a command reports the strongest rule that limited it.
RULES = ("none", "speed", "acceleration", "slow", "stop", "unknown")
NONE, SPEED, ACCELERATION, SLOW, STOP, UNKNOWN = range(6)
STANDSTILL_S = 1.0  # time to brake from the fastest action, if no braking limit is known
CREEP_MPS = 0.02  # speed of the outline's fastest point below which the command is a stop
_STEP_M = 0.025  # the arc is checked each time that the outline's fastest point moves this far
_TOUCH_M = 1e-6


class Limiter(Checked, frozen=True):
    """The `[limiter]` of a profile; a None is derived from outline, actions and control period."""

    stop_m: Annotated[float, Meta(ge=0, le=10)] | None = None  # room to keep; None: .2 of the width
    reaction_s: Annotated[float, Meta(ge=0, le=5)] | None = None  # None: two control periods
    brake_mps2: Limit | None = None  # None: robot.max_accel_mps2 / 2, or top speed to 0 in 1 s
    brake_radps2: Limit | None = None  # None: likewise for the yaw rate
    max_speed_mps: Limit | None = None  # None: robot.max_speed_mps, or the fastest action
    max_yaw_rate_radps: Limit | None = None
    max_accel_mps2: Limit | None = None  # None: robot.max_accel_mps2, or no limit
    max_yaw_accel_radps2: Limit | None = None


@dataclass(frozen=True)
class Limits:
    """A limiter's values, with all defaults filled in."""

    stop_m: float
    reaction_s: float
    brake: tuple[float, float]  # m/s2, rad/s2
    fastest: tuple[float, float]  # m/s, rad/s
    accel: tuple[float, float]  # m/s2, rad/s2; inf: no limit
    period_s: float
    body: Body
    axle_x_m: float  # how far the turning point is ahead of the outline's middle
    sectors: int

    @classmethod
    def of(cls, task: Task, robot: Robot | None = None, given: Limiter | None = None) -> Limits:
        """Build a robot's limits from `given`, and defaults from its task and `[robot]`."""
        given, robot = given or Limiter(), robot or Robot()
        largest = np.abs(np.asarray(task.actions)).max(axis=0).tolist()
        accel = robot.max_accel_mps2, robot.max_yaw_accel_radps2
        fastest = (
            given.max_speed_mps or robot.max_speed_mps or largest[0],
            given.max_yaw_rate_radps or robot.max_yaw_rate_radps or largest[1],
        )
        brake = (
            given.brake_mps2 or (accel[0] or 2 * fastest[0] / STANDSTILL_S) / 2,
            given.brake_radps2 or (accel[1] or 2 * fastest[1] / STANDSTILL_S) / 2,
        )
        period_s = task.control_period_s
        return cls(
            stop_m=0.2 * task.body.width_m if given.stop_m is None else given.stop_m,
            reaction_s=2 * period_s if given.reaction_s is None else given.reaction_s,
            brake=(max(brake[0], 1e-3), max(brake[1], 1e-3)),  # not 0 if no action drives, or turns
            fastest=fastest,
            accel=(
                given.max_accel_mps2 or accel[0] or np.inf,
                given.max_yaw_accel_radps2 or accel[1] or np.inf,
            ),
            period_s=period_s,
            body=task.body,
            axle_x_m=robot.axle_x_m,
            sectors=task.sectors,
        )

    @property
    def hash(self) -> str:
        """Return a hash of the limits, 8 hex digits."""
        return hashlib.blake2b(msgspec.json.encode(self), digest_size=4).hexdigest()

    @property
    def reach_m(self) -> float:
        """Return the distance from the turning point to the farthest corner of the outline."""
        ahead = self.body.length_m / 2 + abs(self.axle_x_m)
        return float(np.hypot(ahead, self.body.width_m / 2))

    @property
    def way_m(self) -> float:
        """Return the distance checked along an arc, measured at the outline's fastest point."""
        fast = self.fastest[0] + self.fastest[1] * self.reach_m
        stand_s = max(self.fastest[0] / self.brake[0], self.fastest[1] / self.brake[1])
        return self.stop_m + fast * (self.reaction_s + stand_s / 2)


@dataclass(frozen=True)
class Limited:
    """Allowed commands, and the rule that limited each."""

    command: F64  # (N, 2): speed m/s, yaw rate rad/s
    rule: Ints  # (N,) indices into RULES

    @property
    def intervened(self) -> Bools:
        """Return whether each command differs from the proposed one, (N,)."""
        return np.asarray(self.rule != NONE, np.bool_)


def limit(limits: Limits, proposed: F64, clearance_m: F64, previous: F64) -> Limited:
    """Limit the proposed commands.

    Limiting never increases a speed or yaw rate, nor changes its sign. The nearer a return, the
    slower the command. Limiting an allowed command again leaves it unchanged.

    Args:
        proposed: (N, 2) speed in m/s and yaw rate in rad/s.
        clearance_m: (N, K) the signal `sector_clearance_m`; K is 0 without a lidar.
        previous: (N, 2) the commands in force until now.
    """
    reported = np.isfinite(np.concatenate([proposed, previous], axis=1))  # (N, 4)
    blind: Bools = ~reported.all(axis=1)
    blind |= np.isnan(clearance_m).any(axis=1)
    command = np.where(blind[:, None], 0.0, proposed)
    rule = np.where(blind, UNKNOWN, NONE).astype(np.int64)

    within = np.clip(command, -np.array(limits.fastest), limits.fastest)
    command, rule = _lower(command, within, rule, SPEED)
    before = np.where(blind[:, None], 0.0, previous) * np.sign(command)  # > 0: along the command
    most = np.maximum(before + np.array(limits.accel) * limits.period_s, 0.0)
    command, rule = _lower(command, np.clip(command, -most, most), rule, ACCELERATION)

    factor = _factor(limits, command, clearance_m)
    command, rule = _lower(command, command * factor[:, None], rule, SLOW)
    rule[(rule == SLOW) & ~command.any(axis=1)] = STOP
    return Limited(command, rule)


def _lower(command: F64, allowed: F64, rule: Ints, by: int) -> tuple[F64, Ints]:
    changed = (allowed != command).any(axis=1)
    return allowed, np.where(changed, np.maximum(rule, by), rule)


def _factor(limits: Limits, command: F64, clearance_m: F64) -> F64:
    """Return the factor (N,) by which to scale each command so that the robot can stop in time."""
    factor = np.ones(len(command))
    if not limits.sectors:
        return factor
    rate = np.abs(command[:, 0]) + np.abs(command[:, 1]) * limits.reach_m  # m/s, fastest point
    near = clearance_m.min(axis=1) < limits.way_m
    ids = np.flatnonzero((rate > 1e-6) & near)
    if not len(ids):
        return factor
    rate = rate[ids]
    free_m = free_way(limits, command[ids] / rate[:, None], clearance_m[ids])
    room_s = np.maximum(free_m - limits.stop_m, 0.0) / np.maximum(rate, CREEP_MPS)
    stand_s = (np.abs(command[ids]) / np.array(limits.brake)).max(axis=1)
    # Solve reaction * f + stand / 2 * f^2 = room, all in seconds, for the factor f.
    reaction = limits.reaction_s
    f = 2 * room_s / (reaction + np.sqrt(reaction**2 + 2 * stand_s * room_s) + 1e-12)
    f = np.minimum(f, 1.0)
    f[f > 1 - 1e-6] = 1.0  # a rounding error must not slow an allowed command again
    f[(f < 1) & (f * rate < CREEP_MPS)] = 0.0
    factor[ids] = f
    return factor


def free_way(limits: Limits, direction: F64, clearance_m: F64) -> F64:
    """Return how far (N,) the outline's fastest point can go until the outline meets a return, m.

    At most `limits.way_m`, in steps of 2.5 cm. The outline meets a return if, anywhere on the way,
    it reaches beyond the return on the same bearing: space behind a return counts as occupied.

    Args:
        direction: (N, 2) m ahead and rad of turn, per metre that the fastest point travels.
        clearance_m: (N, K).
    """
    free = np.zeros(len(direction))
    arcs, of = np.unique(direction.round(9), axis=0, return_inverse=True)
    for index, (ahead, turn) in enumerate(arcs.tolist()):
        rows = np.flatnonzero(of.ravel() == index)
        swept = _swept(limits, ahead, turn)  # (M, K)
        beyond = np.asarray(swept > clearance_m[rows, None] + _TOUCH_M, np.bool_)  # (n, M, K)
        observed = np.asarray(beyond.any(axis=2), np.bool_)  # (n, M)
        first = np.where(observed.any(axis=1), observed.argmax(axis=1), len(swept))
        free[rows] = np.maximum(first - 1, 0) * _STEP_M
    return free


@lru_cache(maxsize=1024)
def _swept(limits: Limits, ahead: float, turn: float) -> F64:
    """Return the clearance (M, K) that the outline needs in each sector, at each step of an arc.

    `ahead` (m) and `turn` (rad) are per metre that the outline's fastest point travels.
    """
    body, count = limits.body, limits.sectors
    bearing: F64 = (np.arange(count, dtype=np.float64) + 0.5) * (2 * np.pi / count) - np.pi
    way_m = np.arange(0.0, limits.way_m + _STEP_M, _STEP_M)
    turned = turn * way_m
    x, y = ahead * way_m * _sinc(turned), ahead * way_m * _cosc(turned)  # turning point
    # The lidar's position and beams at the start, in the frame of the outline at each step.
    lidar_x, cos, sin = body.lidar_x_m - limits.axle_x_m, np.cos(turned), np.sin(turned)
    from_x = (cos * (lidar_x - x) - sin * y + limits.axle_x_m)[:, None]
    from_y = (-sin * (lidar_x - x) - cos * y)[:, None]
    beam = bearing - turned[:, None]  # (M, K)
    with np.errstate(divide="ignore"):
        over_cos, over_sin = 1 / np.cos(beam), 1 / np.sin(beam)
    half_x, half_y = body.length_m / 2, body.width_m / 2
    to_x, wide_x = -from_x * over_cos, half_x * np.abs(over_cos)
    to_y, wide_y = -from_y * over_sin, half_y * np.abs(over_sin)
    far, near = np.minimum(to_x + wide_x, to_y + wide_y), np.maximum(to_x - wide_x, to_y - wide_y)
    reach = np.where((far >= near) & (far > 0), far, 0.0)
    return np.asarray(reach - outline_reach(bearing, body), np.float64)


def _sinc(angle: F64) -> F64:
    """Return sin(a) / a."""
    return np.asarray(np.sinc(angle / np.pi), np.float64)


def _cosc(angle: F64) -> F64:
    """Return (1 - cos(a)) / a."""
    small = np.abs(angle) < 1e-6
    safe = np.where(small, 1.0, angle)
    return np.asarray(np.where(small, angle / 2, (1 - np.cos(safe)) / safe), np.float64)
