"""The robots apart from their model: the base controller, and bodies as a perturbation has them.

The controller takes late commands, ramps toward them and sets the wheel speeds of the motors. The
body has a payload, wheels and the pull of a slope.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from restock.arrays import F64
from restock.state import Stateful
from restock.train.twin.physics.model import Handles
from restock.train.twin.physics.perturbation import Perturbation
from restock.train.twin.physics.robot_model import RobotModel

GRAVITY_MPS2 = 9.81
_HISTORY = 5  # commands kept: enough for the longest latency at the shortest period


class BaseController(Stateful):
    """The controllers of N robots. A command reaches its controller `latency_s` late."""

    STATE = ("commands", "set_point")

    def __init__(
        self, num_envs: int, robot: RobotModel, period_s: float, timestep_s: float, substeps: int
    ) -> None:
        self.robot = robot
        self._accel_limit, self._speed_limit = map(np.array, (robot.accel_limit, robot.speed_limit))
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
        """Give commands (N, 2): forward speed and yaw rate, at the start of a control period.

        What is beyond the robot's limits is driven as fast as they allow.
        """
        self.commands[:, 1:] = self.commands[:, :-1]
        self.commands[:, 0] = _limit(np.asarray(command, np.float64), self._speed_limit)

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
        reach = self._accel_limit * self._timestep_s
        begin = self.set_point[:, None]
        count = (step + 1)[None, :, None]
        under_old = begin + _limit(old - begin, reach * np.minimum(count, switch))
        turned = begin + _limit(old - begin, reach * switch)
        under_new = turned + _limit(new - turned, reach * np.maximum(count - switch, 0))
        ramp = np.where(count <= switch, under_old, under_new)
        self.set_point = ramp[:, -1].copy()
        left, right = self.robot.wheel_commands(ramp[..., 0], ramp[..., 1])
        speeds: F64 = np.stack([left, right], axis=-1) * self.gain[:, None, None]
        speeds[..., 0] *= self.left_gain[:, None]
        return speeds


def _limit(change: F64, most: F64) -> F64:
    return np.minimum(np.maximum(change, -most), most)


class RobotBody:
    """What a perturbation changes of N robots, written into the batch that holds them.

    Fields are made per-simulation when first needed: as long as no episode needs one, all share
    the model's.
    """

    def __init__(
        self,
        batch: Any,
        model: mujoco.MjModel,
        handles: Handles,
        num_envs: int,
        robot: RobotModel,
    ) -> None:
        self.batch, self.model, self.handles, self.robot = batch, model, handles, robot
        self.radius_m = np.full(num_envs, robot.wheel_radius_m)  # (N,) that they roll on
        self._masses = self._radii = self._sloped = False

    def apply(self, env: int, perturbation: Perturbation) -> None:
        """Write a perturbation's payload, wheels and slope into one environment."""
        self._slope(env, perturbation)
        if perturbation.payload_kg or self._masses:
            self._masses = True
            body = self.handles.chassis_body
            mass, inertia = self.batch.expand("body_mass"), self.batch.expand("body_inertia")
            scale = 1.0 + perturbation.payload_kg / self.robot.chassis_kg
            mass[env, body] = self.model.body_mass[body] * scale
            inertia[env, body] = self.model.body_inertia[body] * scale
        if (perturbation.wheel_radius_scale, perturbation.track_scale) != (1, 1) or self._radii:
            self._radii = True
            nominal = self.robot.contact_radius_m
            radius = nominal * perturbation.wheel_radius_scale
            self.radius_m[env] = self.robot.wheel_radius_m * perturbation.wheel_radius_scale
            size, bound = self.batch.expand("geom_size"), self.batch.expand("geom_rbound")
            place = self.batch.expand("body_pos")
            for geom in self.handles.wheel_geoms:
                size[env, geom, 0] = bound[env, geom] = radius
            wheels = zip(self.handles.wheel_bodies, self.robot.wheels_m[:, 1], strict=True)
            for body, y in wheels:
                place[env, body, 1] = y * perturbation.track_scale
                # So that the casters keep their share of the load.
                place[env, body, 2] = radius - nominal
        if self._masses or self._radii:
            self.batch.set_const(np.array([env]))

    def _slope(self, env: int, perturbation: Perturbation) -> None:
        """Gravity along a sloping floor, as a force on the chassis in place of a tilted floor."""
        rise = np.array([perturbation.slope_x, perturbation.slope_y])
        if not rise.any() and not self._sloped:
            return
        self._sloped = True
        body = self.handles.chassis_body
        weight = (self.model.body_subtreemass[body] + perturbation.payload_kg) * GRAVITY_MPS2
        force = self.batch.bind("xfrc_applied")
        force[env, body, :2] = -weight * rise / np.sqrt(1 + rise @ rise)
