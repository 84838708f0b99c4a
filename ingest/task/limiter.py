"""The limiter: what a proposed command may be, by what the robot sees. For robot and twin alike.

It stands in front of whatever drives, as Nav2's collision monitor does, and only ever takes speed
away:

- `unknown`: an input is stale or not a number: stop;
- `stop`, `slow`: along the arc that the command drives, the outline must be able to come to a stand
  `stop_m` short of the first lidar return, after `reaction_s` at the speed that is left;
- `speed`, `acceleration`: beyond what the robot may do. Braking is never limited.

A command is slowed along its own arc: speed and yaw rate by one factor, so that slowing does not
steer. Returns are the nearest of each sector, at its middle bearing. What is behind a return is not
seen, and counts as occupied; what moves is taken to stand still. A robot without a lidar sees
nothing: of it only `unknown`, `speed` and `acceleration` hold.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from restock.arrays import F64, Bools, Ints
from restock.ingest.task.robot import Limit, Robot
from restock.ingest.task.scan import Body, outline_reach
from restock.ingest.task.task import Task
from restock.toml import Checked

# Which rule held, by its number: the strongest of those that did.
RULES = ("none", "speed", "acceleration", "slow", "stop", "unknown")
NONE, SPEED, ACCELERATION, SLOW, STOP, UNKNOWN = range(6)
STANDSTILL_S = 1.0  # from the fastest action, where nothing says how the robot brakes
CREEP_MPS = 0.02  # of the outline's fastest point: slower than that is a stop
_STEP_M = 0.025  # of the outline's fastest point along the arc
_TOUCH_M = 1e-6


class Limiter(Checked, frozen=True):
    """The `[limiter]` of a profile. None: by its outline, its actions and its control period."""

    stop_m: Annotated[float, Meta(ge=0, le=10)] | None = None  # to keep; None: .2 of the width
    reaction_s: Annotated[float, Meta(ge=0, le=5)] | None = None  # None: two control periods
    brake_mps2: Limit | None = None  # None: half of robot.max_accel_mps2, or max. to 0 in 1 s
    brake_radps2: Limit | None = None  # None: likewise for the yaw rate
    max_speed_mps: Limit | None = None  # None: robot.max_speed_mps, or the fastest action
    max_yaw_rate_radps: Limit | None = None
    max_accel_mps2: Limit | None = None  # None: robot.max_accel_mps2, or no limit
    max_yaw_accel_radps2: Limit | None = None


@dataclass(frozen=True)
class Limits:
    """A limiter with every value known."""

    stop_m: float
    reaction_s: float
    brake: tuple[float, float]  # m/s2, rad/s2
    fastest: tuple[float, float]  # m/s, rad/s
    accel: tuple[float, float]  # m/s2, rad/s2; inf: no limit
    period_s: float
    body: Body
    axle_x_m: float  # of what the robot turns about, ahead of the outline's middle
    sectors: int

    @classmethod
    def of(cls, task: Task, robot: Robot | None = None, given: Limiter | None = None) -> Limits:
        """Return a robot's limits: what is `given`, and the rest from its task and `[robot]`."""
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
            brake=(max(brake[0], 1e-3), max(brake[1], 1e-3)),  # actions may all be turns, or none
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
        """Names them: 8 hex digits."""
        return hashlib.blake2b(msgspec.json.encode(self), digest_size=4).hexdigest()

    @property
    def reach_m(self) -> float:
        """Return the distance from the turning point to the farthest corner of the outline."""
        ahead = self.body.length_m / 2 + abs(self.axle_x_m)
        return float(np.hypot(ahead, self.body.width_m / 2))

    @property
    def way_m(self) -> float:
        """Return how far it looks along an arc, as the outline's fastest point drives."""
        fast = self.fastest[0] + self.fastest[1] * self.reach_m
        stand_s = max(self.fastest[0] / self.brake[0], self.fastest[1] / self.brake[1])
        return self.stop_m + fast * (self.reaction_s + stand_s / 2)


@dataclass(frozen=True)
class Limited:
    """Allowed commands, and the rule that limited each."""

    command: F64  # (N, 2): speed m/s, yaw rate rad/s
    rule: Ints  # (N,) of RULES

    @property
    def intervened(self) -> Bools:
        """(N,) where it is not what was proposed."""
        return np.asarray(self.rule != NONE, np.bool_)


def limit(
    limits: Limits,
    proposed: F64,
    clearance_m: F64,
    previous: F64,
    unknown: Bools | None = None,
) -> Limited:
    """Limit the proposed commands to what may be driven.

    No speed and no yaw rate grows or changes its sign by it. The nearer something is, the slower;
    what was allowed is allowed again as it is.

    Args:
        proposed: (N, 2) speed in m/s and yaw rate in rad/s.
        clearance_m: (N, K) the signal `sector_clearance_m`; K is 0 without a lidar.
        previous: (N, 2) the commands in force until now.
        unknown: (N,) where an input cannot be relied on; None: nowhere.
    """
    reported = np.isfinite(np.concatenate([proposed, previous], axis=1))  # (N, 4)
    blind: Bools = ~reported.all(axis=1)
    blind |= np.isnan(clearance_m).any(axis=1)
    if unknown is not None:
        blind |= unknown
    command = np.where(blind[:, None], 0.0, proposed)
    rule = np.where(blind, UNKNOWN, NONE).astype(np.int64)

    within = np.clip(command, -np.array(limits.fastest), limits.fastest)
    command, rule = _lower(command, within, rule, SPEED)
    before = np.where(blind[:, None], 0.0, previous) * np.sign(command)  # along what is proposed
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
    """Return the share (N,) of each command at which the robot can stop in time."""
    factor = np.ones(len(command))
    if not limits.sectors:
        return factor
    rate = np.abs(command[:, 0]) + np.abs(command[:, 1]) * limits.reach_m  # m/s of the outline
    near = clearance_m.min(axis=1) < limits.way_m
    ids = np.flatnonzero((rate > 1e-6) & near)
    if not len(ids):
        return factor
    rate = rate[ids]
    free_m = free_way(limits, command[ids] / rate[:, None], clearance_m[ids])
    room_s = np.maximum(free_m - limits.stop_m, 0.0) / np.maximum(rate, CREEP_MPS)
    stand_s = (np.abs(command[ids]) / np.array(limits.brake)).max(axis=1)
    # reaction f + stand / 2 f^2 = room, solved for f.
    reaction = limits.reaction_s
    f = 2 * room_s / (reaction + np.sqrt(reaction**2 + 2 * stand_s * room_s) + 1e-12)
    f = np.minimum(f, 1.0)
    f[f > 1 - 1e-6] = 1.0  # what was slowed once is not slowed again by a rounding error
    f[(f < 1) & (f * rate < CREEP_MPS)] = 0.0
    factor[ids] = f
    return factor


def free_way(limits: Limits, direction: F64, clearance_m: F64) -> F64:
    """Return how far (N,) the outline's fastest point may go until the outline meets a return, m.

    At most `limits.way_m`, in steps of 2.5 cm. A return is met where the outline, from here to
    there, reaches farther along its bearing than it is: what lies behind it counts as occupied.

    Args:
        direction: (N, 2) m and rad for each metre of that point.
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

    `ahead` (m) and `turn` (rad) are for each metre of the outline's fastest point.
    """
    body, count = limits.body, limits.sectors
    bearing: F64 = (np.arange(count, dtype=np.float64) + 0.5) * (2 * np.pi / count) - np.pi
    way_m = np.arange(0.0, limits.way_m + _STEP_M, _STEP_M)
    turned = turn * way_m
    x, y = ahead * way_m * _sinc(turned), ahead * way_m * _cosc(turned)  # of what it turns about
    # The lidar of now, and its beams, as the outline sees them from there.
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
    """sin(a) / a."""
    return np.asarray(np.sinc(angle / np.pi), np.float64)


def _cosc(angle: F64) -> F64:
    """(1 - cos(a)) / a."""
    small = np.abs(angle) < 1e-6
    safe = np.where(small, 1.0, angle)
    return np.asarray(np.where(small, angle / 2, (1 - np.cos(safe)) / safe), np.float64)


__all__ = ["RULES", "Limited", "Limiter", "Limits", "free_way", "limit"]
