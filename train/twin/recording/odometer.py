"""Wheel odometry: what a robot's encoders make of its motion, carried from mission to mission."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from restock.train.twin.recording.drive import Motion

F64 = NDArray[np.float64]

ENCODER_LSB_RAD = 2 * np.pi / 4096


@dataclass
class Odometer:
    """The pose in `odom`, from the encoders alone."""

    wheel_radius_m: float  # as the odometry believes it
    track_m: float
    pose: F64 = field(default_factory=lambda: np.zeros(3))  # x, y, yaw where the robot stands
    wheel_angle_rad: F64 = field(default_factory=lambda: np.zeros(2))

    def dead_reckoning(self, motion: Motion) -> F64:
        """The pose at every time of the motion, (M, 3)."""
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
        """Speed in m/s and yaw rate in rad/s (n,) of wheels that turn at these rates (n, 2)."""
        speed = rate_radps.mean(axis=1) * self.wheel_radius_m
        turn = (rate_radps[:, 1] - rate_radps[:, 0]) * (self.wheel_radius_m / self.track_m)
        return speed, turn

    def wheel_angles(self, motion: Motion, time_s: F64) -> F64:
        """What the encoders read at these times, (n, 2)."""
        angle = self.wheel_angle_rad + motion.at(motion.wheel_angle_rad, time_s)
        return np.floor(angle / ENCODER_LSB_RAD) * ENCODER_LSB_RAD

    def carry_on(self, motion: Motion, reckoned: F64) -> None:
        """The next mission begins where this motion ended."""
        turned = motion.wheel_angle_rad[-1] - motion.wheel_angle_rad[0]
        self.wheel_angle_rad = self.wheel_angle_rad + turned
        self.pose = reckoned[-1]


__all__ = ["Odometer"]
