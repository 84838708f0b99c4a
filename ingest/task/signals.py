"""The signals: the named columns, with units, that logs and the twin both fill.

One row of signals is one step of the control clock, at time t. A profile says how a robot's
topics fill them; the twin fills them from MuJoCo. Everything after this point (task, conditions,
store) sees only signals, and so cannot tell a log from a simulation.

`Signals` maps a signal's name to an array whose leading axis is the step (in a log) or the
environment (in the twin). `Noise` says how much the readings behind them vary.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from restock.toml import Checked

Signals = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Signal:
    """A column: its name (which ends in its unit), shape per step, type and meaning."""

    name: str
    meaning: str
    dtype: str = "float64"
    per_sector: bool = False  # shape (sectors,) instead of ()
    stored: bool = True  # kept as a column of the transition table
    optional: bool = False  # NaN where it is not known; null in the table
    lidar: bool = False  # seen by it alone: not known of a robot without one


def _of_lidar(name: str, meaning: str) -> Signal:
    return Signal(name, meaning, optional=True, lidar=True)


SIGNALS: tuple[Signal, ...] = (
    Signal("stamp_ns", "time of the step on the alignment clock", "int64"),
    Signal("pose_x_m", "localised position in the map frame, x"),
    Signal("pose_y_m", "localised position in the map frame, y"),
    Signal("pose_yaw_rad", "localised heading in the map frame, in (-pi, pi]"),
    Signal("pose_stamp_ns", "when that pose was measured; at or before stamp_ns", "int64"),
    Signal("wheel_speed_mps", "forward speed from the wheel encoders"),
    Signal("wheel_yaw_rate_radps", "yaw rate from the wheel encoders"),
    Signal("gyro_yaw_rate_radps", "yaw rate from the gyroscope"),
    Signal("accel_x_mps2", "forward acceleration from the accelerometer"),
    Signal(
        "sector_clearance_m",
        "per sector of bearing: nearest lidar return minus the body's extent in that direction",
        per_sector=True,
        stored=False,
        lidar=True,
    ),
    _of_lidar("clearance_m", "the smallest sector clearance"),
    _of_lidar("clearance_ahead_m", "the smallest sector clearance toward the near waypoint"),
    Signal("waypoint_near_x_m", "near look-ahead point of the plan, body frame, forward"),
    Signal("waypoint_near_y_m", "near look-ahead point of the plan, body frame, left"),
    Signal("waypoint_far_x_m", "far look-ahead point of the plan, body frame, forward"),
    Signal("waypoint_far_y_m", "far look-ahead point of the plan, body frame, left"),
    Signal("route_remaining_m", "length of the plan from the nearest point on it to its end"),
    Signal("goal_distance_m", "straight-line distance from the pose to the goal"),
    Signal("localised_speed_mps", "forward speed from the last two localised poses"),
    Signal("localised_lateral_mps", "sideways speed (left) from the last two localised poses"),
    _of_lidar(
        "came_nearer_m",
        "how much nearer something within 2 m is than at the step before and in the last second,"
        " without the robot's own motion; 0: nothing",
    ),
    _of_lidar(
        "plan_return_m",
        "distance along the plan to the first lidar return within half the body's width of it;"
        " range_max_m: none",
    ),
    _of_lidar(
        "plan_gap_m",
        "distance from the plan just ahead (1.4 of near_m) to the nearest lidar return;"
        " range_max_m: none",
    ),
    Signal("bumped", "the bumper was pressed since the step before", "bool"),
    Signal("command_speed_mps", "commanded forward speed in force until the next step"),
    Signal("command_yaw_rate_radps", "commanded yaw rate in force until the next step"),
    Signal("nav_speed_mps", "forward speed that navigation proposes, or unknown", optional=True),
    Signal("nav_yaw_rate_radps", "yaw rate that navigation proposes, or unknown", optional=True),
)

STORED_SIGNALS: tuple[Signal, ...] = tuple(signal for signal in SIGNALS if signal.stored)
OPTIONAL_SIGNALS = frozenset(signal.name for signal in SIGNALS if signal.optional)
OUTLINE_SIGNALS = frozenset({"clearance_m", "clearance_ahead_m", "plan_return_m"})  # rest on it
PLAN_SIGNALS = frozenset({"plan_return_m", "plan_gap_m"})  # what stands on the plan
LIDAR_SIGNALS = frozenset(signal.name for signal in SIGNALS if signal.lidar)


def localised_velocity(
    now: Signals, before: Signals
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return forward and lateral speed (m/s) from two localised poses, in the body frame of `now`.

    Where no new pose has arrived since the step before there is no evidence of motion beyond
    the wheels', and the wheel speed is returned (so that it never looks like slip).
    """
    elapsed_s = (now["pose_stamp_ns"] - before["pose_stamp_ns"]) * 1e-9
    fresh = elapsed_s > 1e-6
    elapsed_s = np.where(fresh, elapsed_s, 1.0)
    vx = (now["pose_x_m"] - before["pose_x_m"]) / elapsed_s
    vy = (now["pose_y_m"] - before["pose_y_m"]) / elapsed_s
    # The heading half-way between the poses: a turn in place must not read as sideways motion.
    turn = wrap_angle(now["pose_yaw_rad"] - before["pose_yaw_rad"])
    heading = now["pose_yaw_rad"] - turn / 2
    cos, sin = np.cos(heading), np.sin(heading)
    forward = np.where(fresh, cos * vx + sin * vy, now["wheel_speed_mps"])
    lateral = np.where(fresh, -sin * vx + cos * vy, 0.0)
    return forward, lateral


def wrap_angle(angle_rad: NDArray[Any]) -> NDArray[Any]:
    """Return the same angle in [-pi, pi)."""
    return (angle_rad + np.pi) % (2 * np.pi) - np.pi


def yaw_of(
    x: NDArray[Any], y: NDArray[Any], z: NDArray[Any], w: NDArray[Any]
) -> NDArray[np.float64]:
    """Return the yaw of quaternions (N,) in (-pi, pi], REP 103: about z, counter-clockwise.

    NaN where one has no length: it was not filled in. Those of other lengths are normalised.
    """
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # NaN stays NaN
        length = np.sqrt(x * x + y * y + z * z + w * w)
        scale = np.where((length > 1e-9) & (length < np.inf), 1 / length, np.nan)
        scale[np.abs(length - 1) < 1e-3] = 1.0
        x, y, z, w = (part * scale for part in (x, y, z, w))
        return np.asarray(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)), np.float64)


class Noise(Checked, frozen=True):
    """The `[noise]` of a profile: what the sensors' readings vary by, for probabilities.

    Standard deviations. The SQL of conditions names them as `lidar_noise_m`, and so on.
    """

    lidar_m: Annotated[float, Meta(gt=0)] = 0.015  # standard deviation of a range
    localiser_m: Annotated[float, Meta(gt=0)] = 0.01  # of the distance between two poses, per axis
    wheels_mps: Annotated[float, Meta(gt=0)] = 0.003  # of the wheel speed
    gyro_radps: Annotated[float, Meta(gt=0)] = 0.01  # of the yaw rate, including bias

    @property
    def constants(self) -> dict[str, float]:
        """Return each by the name that SQL has for it."""
        named = msgspec.structs.asdict(self)
        return {"_noise_".join(name.rsplit("_", 1)): value for name, value in named.items()}
