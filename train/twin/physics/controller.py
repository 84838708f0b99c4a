"""The robot's base controller: late commands, a ramp, and wheel speeds asked of the motors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from restock.train.twin.physics.model import wheel_commands

F64 = NDArray[np.float64]

ACCEL_LIMIT = np.array([4.0, 10.0])  # m/s2 and rad/s2
_HISTORY = 5  # commands kept: enough for the longest latency at the shortest period


class BaseController:
    """The controllers of N robots. A command reaches its controller `latency_s` late."""

    def __init__(self, num_envs: int, period_s: float, timestep_s: float, substeps: int) -> None:
        self._period_s, self._timestep_s, self._substeps = period_s, timestep_s, substeps
        self.commands = np.zeros((num_envs, _HISTORY, 2))  # speed, yaw rate; newest first
        self.set_point = np.zeros((num_envs, 2))
        self.latency_s = np.zeros(num_envs)
        self.gain = np.ones(num_envs)
        self.left_gain = np.ones(num_envs)

    def reset(self, env: int) -> None:
        """Stand still, as after a stop command long ago."""
        self.commands[env] = self.set_point[env] = 0.0

    def command(self, command: F64) -> None:
        """Give commands (N, 2): forward speed and yaw rate, at the start of a control period."""
        self.commands[:, 1:] = self.commands[:, :-1]
        self.commands[:, 0] = command

    def wheel_speeds(self, since_s: float) -> F64:
        """Wheel speeds (N, substeps, 2) in rad/s over a block that begins `since_s` into a period.

        The controller ramps toward the command in force. Within a block that changes at most
        once, which gives the ramp in closed form.
        """
        step = np.arange(self._substeps)
        age_s = since_s + step * self._timestep_s - self.latency_s[:, None] + 1e-9
        age = np.clip(-np.floor(age_s / self._period_s), 0, _HISTORY - 1)
        age = age.astype(np.int64)  # (N, S) how many periods old the command in force is
        first, last = age[:, 0], age[:, -1]
        rows = np.arange(len(age))
        old, new = self.commands[rows, first][:, None], self.commands[rows, last][:, None]
        switch = (age == first[:, None]).sum(axis=1)[:, None, None]  # substeps under `old`
        switch = np.where(first[:, None, None] == last[:, None, None], self._substeps, switch)
        reach = ACCEL_LIMIT * self._timestep_s
        begin = self.set_point[:, None]
        count = (step + 1)[None, :, None]
        under_old = begin + _limit(old - begin, reach * np.minimum(count, switch))
        turned = begin + _limit(old - begin, reach * switch)
        under_new = turned + _limit(new - turned, reach * np.maximum(count - switch, 0))
        asked = np.where(count <= switch, under_old, under_new)
        self.set_point = asked[:, -1].copy()
        left, right = wheel_commands(asked[..., 0], asked[..., 1])
        speeds: F64 = np.stack([left, right], axis=-1) * self.gain[:, None, None]
        speeds[..., 0] *= self.left_gain[:, None]
        return speeds


def _limit(change: F64, most: F64) -> F64:
    return np.minimum(np.maximum(change, -most), most)
