"""The robots apart from their model: the base controller, and bodies as a perturbation has them.

The controller takes late commands, ramps toward them and sets the wheel speeds of the motors. The
body has a payload, wheels and the pull of a slope.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import mujoco
import numpy as np

from restock.arrays import F64, Ints
from restock.state import Stateful
from restock.train.twin.physics.model import Handles
from restock.train.twin.physics.perturbation import RANGES, Perturbation
from restock.train.twin.physics.robot_model import RobotModel

GRAVITY_MPS2 = 9.81
_HISTORY = 5  # commands kept, or as many more as the longest latency takes


class BaseController(Stateful):
    """The controllers of N robots. A command reaches its controller `latency_s` late.

    Those of robots that steer are `SteeringController`s; `base_controller` makes the right one.
    """

    STATE: ClassVar[tuple[str, ...]] = ("commands", "set_point")

    def __init__(
        self, num_envs: int, robot: RobotModel, period_s: float, timestep_s: float, substeps: int
    ) -> None:
        self.robot = robot
        self._accel_limit, self._speed_limit = map(np.array, (robot.accel_limit, robot.speed_limit))
        self._period_s, self._timestep_s, self._substeps = period_s, timestep_s, substeps
        history = max(_HISTORY, math.ceil(RANGES["latency_s"][1] / period_s - 1e-9) + 1)
        self.commands = np.zeros((num_envs, history, 2))  # speed, yaw rate; newest first
        self.set_point = np.zeros((num_envs, 2))
        self.latency_s = np.zeros(num_envs)
        self.gain = np.ones(num_envs)
        self.left_gain = np.ones(num_envs)

    def reset(self, env: int) -> None:
        """Stand still, as after a stop command long ago."""
        self.commands[env] = self.set_point[env] = 0.0

    def begin(self, motion: F64) -> None:
        """Drive steadily at speeds and yaw rates (N, 2) of the wheels, as commanded long ago."""
        command = motion / self.gain[:, None]
        self.commands[:], self.set_point[:] = command[:, None], command

    def command(self, command: F64) -> None:
        """Give commands (N, 2): forward speed and yaw rate, at the start of a control period.

        What is beyond the robot's limits is driven as fast as they allow.
        """
        self.commands[:, 1:] = self.commands[:, :-1]
        self.commands[:, 0] = _limit(np.asarray(command, np.float64), self._speed_limit)

    def controls(self, since_s: float) -> F64:
        """What the actuators are told over a block that begins `since_s` into a period.

        (N, substeps, actuators), in the model's order: wheel speeds in rad/s. The controller ramps
        toward the command in force.
        """
        ramp = self._ramp(self.set_point, *self._in_force(since_s))
        self.set_point = ramp[:, -1].copy()
        speeds = self._wheels(ramp)
        return np.tile(speeds, len(self.robot.wheels_m) // 2)

    def _in_force(self, since_s: float) -> tuple[F64, F64, Ints]:
        """Commands (N, 1, 2) in force as a block begins and as it ends, and the substep (N, 1, 1)
        of the change: within a block there is at most one."""
        step = np.arange(self._substeps)
        age_s = since_s + step * self._timestep_s - self.latency_s[:, None] + 1e-9
        age = np.clip(-np.floor(age_s / self._period_s), 0, self.commands.shape[1] - 1)
        age = age.astype(np.int64)  # (N, S) how many periods old the command in force is
        first, last = age[:, 0], age[:, -1]
        rows = np.arange(len(age))
        old, new = self.commands[rows, first][:, None], self.commands[rows, last][:, None]
        switch = (age == first[:, None]).sum(axis=1)[:, None, None]  # substeps under `old`
        switch = np.where(first[:, None, None] == last[:, None, None], self._substeps, switch)
        return old, new, switch

    def _ramp(self, begin: F64, old: F64, new: F64, switch: Ints) -> F64:
        """From `begin` (N, 2) toward the commands in force, (N, substeps, 2), in closed form."""
        reach = self._accel_limit * self._timestep_s
        begin = begin[:, None]
        count = (np.arange(self._substeps) + 1)[None, :, None]
        under_old = begin + _limit(old - begin, reach * np.minimum(count, switch))
        turned = begin + _limit(old - begin, reach * switch)
        under_new = turned + _limit(new - turned, reach * np.maximum(count - switch, 0))
        ramp: F64 = np.where(count <= switch, under_old, under_new)
        return ramp

    def _wheels(self, ramp: F64) -> F64:
        """Wheel speeds (N, substeps, 2) of both sides in rad/s, at speeds and yaw rates."""
        left, right = self.robot.wheel_commands(ramp[..., 0], ramp[..., 1])
        speeds: F64 = np.stack([left, right], axis=-1) * self.gain[:, None, None]
        speeds[..., 0] *= self.left_gain[:, None]
        return speeds


class SteeringController(BaseController):
    """Controllers of robots that steer: speed and steering angle ramp, and the angle is that of
    the circle that is commanded, as tight as the steering allows. It stays where it is under a
    command to stop."""

    STATE: ClassVar[tuple[str, ...]] = (*BaseController.STATE, "steering_rad")

    def __init__(
        self, num_envs: int, robot: RobotModel, period_s: float, timestep_s: float, substeps: int
    ) -> None:
        super().__init__(num_envs, robot, period_s, timestep_s, substeps)
        self._accel_limit = np.array([robot.accel_limit[0], robot.steering_rate_radps])
        self.steering_rad = np.zeros(num_envs)  # of the wheel in the middle of the front axle

    def reset(self, env: int) -> None:
        """As of every controller, with the wheels straight ahead."""
        super().reset(env)
        self.steering_rad[env] = 0.0

    def begin(self, motion: F64) -> None:
        """As of every controller, steering as it takes to drive so."""
        super().begin(motion)
        self.steering_rad = self.robot.steering_for(motion, np.zeros(len(motion)))

    def controls(self, since_s: float) -> F64:
        """As of every controller: speeds of the rear wheels, and angles (rad) of the front ones."""
        old, new, switch = self._in_force(since_s)
        begin = np.stack([self.set_point[:, 0], self.steering_rad], axis=-1)
        first = self._steered(old, begin[:, None, 1])
        reach = self._accel_limit[1] * self._timestep_s * switch[..., 0]
        turned = begin[:, None, 1] + _limit(first[..., 1] - begin[:, None, 1], reach)
        ramp = self._ramp(begin, first, self._steered(new, turned), switch)
        speed, steering = ramp[..., 0], ramp[..., 1]
        self.steering_rad = steering[:, -1].copy()
        driven = np.stack([speed, self.robot.yaw_rate(speed, steering)], axis=-1)
        self.set_point = driven[:, -1].copy()
        return np.concatenate([self._wheels(driven), self.robot.front_angles(steering)], axis=-1)

    def _steered(self, command: F64, held_rad: F64) -> F64:
        """Commands (N, 1, 2) as speeds and steering angles."""
        steering = self.robot.steering_for(command, held_rad)
        return np.stack([command[..., 0], steering], axis=-1)


def base_controller(
    num_envs: int, robot: RobotModel, period_s: float, timestep_s: float, substeps: int
) -> BaseController:
    """The controllers that robots of this model have."""
    kind = SteeringController if robot.steers else BaseController
    return kind(num_envs, robot, period_s, timestep_s, substeps)


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
                place[env, body, 2] = self.model.body_pos[body, 2] + radius - nominal
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
