"""A mission as the twin drove it, and the wheel odometry that a robot makes of it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from restock.arrays import F64, Bools
from restock.ingest.task.signals import Signals
from restock.train.twin.physics.perturbation import Perturbation

ENCODER_LSB_RAD = 2 * np.pi / 4096


@dataclass(frozen=True)
class Lidar:
    """The geometry of a planar lidar's scan, in its own frame."""

    angle_min_rad: float
    angle_increment_rad: float
    range_min_m: float
    range_max_m: float
    x_m: float = 0.0  # ahead of the robot's middle


@dataclass(frozen=True)
class Motion:
    """The true motion, at every physics step of the mission (M of them, the start included)."""

    time_s: F64  # (M,) from the start of the mission
    pose: F64  # (M, 3) x_m, y_m, yaw_rad (not wrapped) in the map
    wheel_angle_rad: F64  # (M, 2) left, right
    wheel_rate_radps: F64  # (M, 2)
    yaw_rate_radps: F64  # (M,)
    accel_mps2: F64  # (M, 2) of the body, forward and left
    bumped: Bools  # (M,) the bumper touched something

    def at(self, values: F64, time_s: F64) -> F64:
        """Return a column, (M,) or (M, 2), interpolated at times (n,)."""
        if values.ndim == 1:
            return np.interp(time_s, self.time_s, values)
        columns = [np.interp(time_s, self.time_s, column) for column in values.T]
        return np.stack(columns, axis=-1)


@dataclass(frozen=True)
class Scene:
    """The obstacles, patches and traffic of one mission of T steps."""

    pallets: F64  # (P, 3) x_m, y_m, yaw_rad; parked off the floor where there is none
    patches: F64  # (K, 5) x_m, y_m, half sizes, friction; no size where there is none
    traffic: F64  # (T + 1, A, 3) x_m, y_m, yaw_rad, the people first; parked while out of sight
    perturbation: Perturbation
    goal_radius_m: float
    body_m: tuple[float, float, float]  # length, width, height of the robot


EMPTY = Scene(
    pallets=np.zeros((0, 3)),
    patches=np.zeros((0, 5)),
    traffic=np.zeros((1, 0, 3)),
    perturbation=Perturbation(),
    goal_radius_m=0.4,
    body_m=(0.7, 0.5, 0.3),
)


@dataclass(frozen=True)
class Drive:
    """A mission: true motion between the control ticks, and signals and actions at them.

    There are T commands and T + 1 ticks: the last tick is where the mission ended.
    """

    goal_m: tuple[float, float]
    motion: Motion
    tick_s: F64  # (T + 1,) from the start of the mission
    signals: Signals  # each (T + 1, …): what the policy saw
    scan_s: F64  # (K,) when the lidar scanned; the first tick is among them
    ranges_m: F64  # (K, B) as measured; inf where nothing came back
    command: F64  # (T, 2) speed_mps, yaw_rate_radps
    true_condition: list[str]  # T
    true_exposure: list[str]  # T
    policy: list[tuple[str, str, float]]  # T of (name, version, probability of the action)
    plans: list[tuple[int, F64]]  # (tick from which it is in force, (P, 2) points)
    scene: Scene = EMPTY


@dataclass
class Odometer:
    """The pose in `odom`, from the encoders alone."""

    wheel_radius_m: float  # as the odometry believes it
    track_m: float
    pose: F64 = field(default_factory=lambda: np.zeros(3))  # x, y, yaw where the robot stands
    wheel_angle_rad: F64 = field(default_factory=lambda: np.zeros(2))

    def dead_reckoning(self, motion: Motion) -> F64:
        """Return the pose at every time of the motion, (M, 3)."""
        ticks = np.floor((self.wheel_angle_rad + motion.wheel_angle_rad) / ENCODER_LSB_RAD)
        rolled = np.diff(ticks, axis=0) * (ENCODER_LSB_RAD * self.wheel_radius_m)  # (M - 1, 2)
        turn = (rolled[:, 1] - rolled[:, 0]) / self.track_m
        x, y, yaw = self.pose
        heading = yaw + np.concatenate([[0.0], np.cumsum(turn)])
        ahead = rolled.mean(axis=1)
        middle = heading[:-1] + turn / 2
        return np.stack(
            [
                x + np.concatenate([[0.0], np.cumsum(ahead * np.cos(middle))]),
                y + np.concatenate([[0.0], np.cumsum(ahead * np.sin(middle))]),
                heading,
            ],
            axis=-1,
        )

    def speeds(self, rate_radps: F64) -> tuple[F64, F64]:
        """Return speeds in m/s and yaw rates in rad/s (n,) of wheels turning at rates (n, 2)."""
        speed = rate_radps.mean(axis=1) * self.wheel_radius_m
        turn = (rate_radps[:, 1] - rate_radps[:, 0]) * (self.wheel_radius_m / self.track_m)
        return speed, turn

    def wheel_angles(self, motion: Motion, time_s: F64) -> F64:
        """Return what the encoders read at these times, (n, 2)."""
        angle = self.wheel_angle_rad + motion.at(motion.wheel_angle_rad, time_s)
        return np.floor(angle / ENCODER_LSB_RAD) * ENCODER_LSB_RAD

    def carry_on(self, motion: Motion, reckoned: F64) -> None:
        """Begin the next mission where this motion ended."""
        turned = motion.wheel_angle_rad[-1] - motion.wheel_angle_rad[0]
        self.wheel_angle_rad = self.wheel_angle_rad + turned
        self.pose = reckoned[-1]
