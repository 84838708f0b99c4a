"""The physics of N warehouses at once: one `mujoco.batch.Batch` and its inputs.

A control period is driven in blocks of .1 s, or in equal blocks if it is not a multiple of .1 s.
Before each block, friction is looked up under every wheel and traffic moves. Within a block, the
base controller's ramp and latency act at every substep. Results do not depend on the number of
threads.

The base controller gets commands late, ramps toward them and sets the motors' wheel speeds. The
perturbation sets the payload, wheels and slope that act on a robot's body.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from restock.arrays import F64, Bools, Ints, stacked
from restock.errors import ConfigError
from restock.ingest.task.task import Task
from restock.state import Stateful
from restock.train.twin.floors.layout import AGENTS, Warehouse
from restock.train.twin.floors.state_lattice import rectangle
from restock.train.twin.physics.episode import Episode
from restock.train.twin.physics.model import Handles, build_model, yaw_of
from restock.train.twin.physics.perturbation import RANGES, Perturbation
from restock.train.twin.physics.robot_model import (
    FLOOR_FRICTION,
    FloorFriction,
    RobotModel,
    stand_in,
)
from restock.train.twin.physics.scenery import Lidar, Scenery, quaternion

GRAVITY_MPS2 = 9.81
_HISTORY = 5  # minimum number of commands kept; more if the longest latency takes more


class BaseController(Stateful):
    """The controllers of N robots. A command reaches its controller `latency_s` late.

    Robots that steer have a `SteeringController`; `base_controller` builds the right one.
    """

    STATE: ClassVar[tuple[str, ...]] = ("commands", "set_point")

    def __init__(
        self, num_envs: int, robot: RobotModel, period_s: float, timestep_s: float, substeps: int
    ) -> None:
        self.robot, self._axles = robot, len(robot.wheels_m) // 2
        self._accel_limit, self._speed_limit = map(np.array, (robot.accel_limit, robot.speed_limit))
        self._period_s, self._timestep_s, self._substeps = period_s, timestep_s, substeps
        history = max(_HISTORY, math.ceil(RANGES["latency_s"][1] / period_s - 1e-9) + 1)
        self.commands = np.zeros((num_envs, history, 2))  # speed, yaw rate; newest first
        self.set_point = np.zeros((num_envs, 2))
        self.latency_s = np.zeros(num_envs)
        self.gain = np.ones(num_envs)
        self.left_gain = np.ones(num_envs)
        # A cache: since_s -> result of `_find_change`.
        self._changes: dict[float, tuple[Ints, Ints, tuple[Bools, F64, F64]]] = {}

    def reset(self, env: int) -> None:
        """Reset to a standstill, as after a stop command long ago."""
        self.commands[env] = self.set_point[env] = 0.0
        self._changes.clear()  # the latency may change

    def begin(self, motion: F64) -> None:
        """Begin at steady speeds and yaw rates (N, 2) of the wheels, as if commanded long ago."""
        command = motion / self.gain[:, None]
        self.commands[:], self.set_point[:] = command[:, None], command

    def command(self, command: F64) -> None:
        """Set commands (N, 2), forward speed and yaw rate, at the start of a control period.

        Commands are clipped to the robot's speed limits.
        """
        self.commands[:, 1:] = self.commands[:, :-1]
        self.commands[:, 0] = _limit(np.asarray(command, np.float64), self._speed_limit)

    def controls(self, since_s: float) -> F64:
        """Return the actuators' inputs over a block that begins `since_s` into a period.

        They are wheel speeds in rad/s, (N, substeps, actuators), in the model's order. The
        controller ramps toward the command in force.
        """
        old, new, reach = self._find_commands(since_s)
        ramp = _ramp(self.set_point[:, None], old, new, reach)
        self.set_point = ramp[:, -1].copy()
        speeds = self._wheels(ramp)
        return speeds if self._axles == 1 else np.tile(speeds, self._axles)

    def _find_commands(self, since_s: float) -> tuple[F64, F64, tuple[Bools, F64, F64]]:
        """Return the commands (N, 1, 2) in force at the first and last substep of a block.

        Also returns the substeps (N, S, 1) in which the first command is in force, and how far
        (N, S, 2) a ramp gets by each substep toward the first command and toward the last.
        """
        if since_s not in self._changes:
            self._changes[since_s] = self._find_change(since_s)
        first, last, reach = self._changes[since_s]
        rows = np.arange(len(first))
        return self.commands[rows, first][:, None], self.commands[rows, last][:, None], reach

    def _find_change(self, since_s: float) -> tuple[Ints, Ints, tuple[Bools, F64, F64]]:
        """Return the results of `_find_commands`, with ages (N,) in periods instead of commands.

        The command changes at most once within a block.
        """
        step = np.arange(self._substeps)
        age_s = since_s + step * self._timestep_s - self.latency_s[:, None] + 1e-9
        age = np.clip(-np.floor(age_s / self._period_s), 0, self.commands.shape[1] - 1)
        age = age.astype(np.int64)  # (N, S) age of the command in force, in periods
        first, last = age[:, 0], age[:, -1]
        former = (age == first[:, None])[..., None]  # all, if the command stays
        switch, count = former.sum(axis=1, keepdims=True), (step + 1)[:, None]
        reach = self._accel_limit * self._timestep_s
        to_old, to_new = np.minimum(count, switch), np.maximum(count - switch, 0)
        return first, last, (former, reach * to_old, reach * to_new)

    def _wheels(self, ramp: F64) -> F64:
        """Return both sides' wheel speeds (N, substeps, 2) in rad/s, from speeds and yaw rates."""
        left, right = self.robot.wheel_commands(ramp[..., 0], ramp[..., 1])
        gain = self.gain[:, None]
        return stacked(left * gain * self.left_gain[:, None], right * gain)


class SteeringController(BaseController):
    """The controllers of N robots that steer. They ramp speed and steering angle.

    The angle is that of the commanded circle, or the maximum for a tighter circle. A stop command
    keeps the steering angle.
    """

    STATE: ClassVar[tuple[str, ...]] = (*BaseController.STATE, "steering_rad")

    def __init__(
        self, num_envs: int, robot: RobotModel, period_s: float, timestep_s: float, substeps: int
    ) -> None:
        super().__init__(num_envs, robot, period_s, timestep_s, substeps)
        self._accel_limit = np.array([robot.accel_limit[0], robot.steering_rate_radps])
        self.steering_rad = np.zeros(num_envs)  # angle of a virtual wheel, midway on the front axle

    def reset(self, env: int) -> None:
        """Reset to a standstill with the wheels straight ahead."""
        super().reset(env)
        self.steering_rad[env] = 0.0

    def begin(self, motion: F64) -> None:
        """Begin at steady motion, with the steering angles it needs."""
        super().begin(motion)
        self.steering_rad = self.robot.steering_for(motion, np.zeros(len(motion)))

    def controls(self, since_s: float) -> F64:
        """Return speeds of the rear wheels and angles (rad) of the front ones over a block."""
        old, new, reach = self._find_commands(since_s)
        begin = stacked(self.set_point[:, 0], self.steering_rad)[:, None]
        first = self._to_steering(old, begin[..., 1])
        turned = begin[..., 1] + _limit(first[..., 1] - begin[..., 1], reach[1][:, -1:, 1])
        ramp = _ramp(begin, first, self._to_steering(new, turned), reach)
        speed, steering = ramp[..., 0], ramp[..., 1]
        self.steering_rad = steering[:, -1].copy()
        driven = np.stack([speed, self.robot.yaw_rate(speed, steering)], axis=-1)
        self.set_point = driven[:, -1].copy()
        return np.concatenate([self._wheels(driven), self.robot.front_angles(steering)], axis=-1)

    def _to_steering(self, command: F64, held_rad: F64) -> F64:
        """Convert commands (N, 1, 2) to speeds and steering angles."""
        steering = self.robot.steering_for(command, held_rad)
        return stacked(command[..., 0], steering)


def base_controller(
    num_envs: int, robot: RobotModel, period_s: float, timestep_s: float, substeps: int
) -> BaseController:
    """Build the controllers for robots of this model."""
    kind = SteeringController if robot.steers else BaseController
    return kind(num_envs, robot, period_s, timestep_s, substeps)


def _ramp(begin: F64, old: F64, new: F64, reach: tuple[Bools, F64, F64]) -> F64:
    """Return the ramp (N, substeps, 2) from `begin` (N, 1, 2) toward the commands in force."""
    former, to_old, to_new = reach
    under_old = begin + _limit(old - begin, to_old)
    turned = under_old[:, -1:]
    ramp: F64 = np.where(former, under_old, turned + _limit(new - turned, to_new))
    return ramp


def _limit(change: F64, most: F64) -> F64:
    return np.minimum(np.maximum(change, -most), most)


class RobotBody:
    """The perturbed properties of N robots, written into their batch.

    All environments share a field of the model until an episode needs its own value. From then on,
    each environment has its own copy of the field.
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
        self.radius_m = np.full(num_envs, robot.wheel_radius_m)  # (N,) the wheels' rolling radius
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
                # Move the wheel up by as much as its radius grows: the casters keep their load.
                place[env, body, 2] = self.model.body_pos[body, 2] + radius - nominal
        if self._masses or self._radii:
            self.batch.set_const(np.array([env]))

    def _slope(self, env: int, perturbation: Perturbation) -> None:
        """Apply gravity along a sloping floor as a force on the chassis."""
        rise = np.array([perturbation.slope_x, perturbation.slope_y])
        if not rise.any() and not self._sloped:
            return
        self._sloped = True
        body = self.handles.chassis_body
        weight = (self.model.body_subtreemass[body] + perturbation.payload_kg) * GRAVITY_MPS2
        force = self.batch.bind("xfrc_applied")
        force[env, body, :2] = -weight * rise / np.sqrt(1 + rise @ rise)


BLOCK_S = 0.1
OUTLINE_STEP_M = 0.05  # maximum distance between points on a robot's outline
_CONTROLLED = int(mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_MOCAP_POS)


@dataclass(frozen=True)
class BodyState:
    """The true state of every environment at one moment, for recorders."""

    time_s: F64  # (N,) since the episode began
    x_m: F64
    y_m: F64
    yaw_rad: F64
    speed_mps: F64  # (N,) forward speed over ground
    yaw_rate_radps: F64
    wheel_angle_rad: F64  # (N, 2) left, right
    wheel_speed_radps: F64  # (N, 2)
    accel_mps2: F64  # (N, 3) mean reading of the accelerometer since the previous call
    bumped: Bools  # (N,) the bumper was pressed since the previous call


class Simulation(Stateful):
    """N robots in N warehouses. The first axis of arrays is the environment.

    Before a state is restored, every environment must be reset to the episode of that state.
    """

    # The scenery is restored after the physics, because it reads positions from the physics.
    STATE = (
        "time_s",
        "bumped",
        "slipped",
        "accel",
        "diverged",
        "controller",
        "_physics",
        "scenery",
    )

    def __init__(
        self,
        num_envs: int,
        task: Task,
        floors: Warehouse | Sequence[Warehouse],
        timestep_s: float,
        nthread: int,
        *,
        robot: RobotModel | None = None,
    ) -> None:
        """Build N warehouses; with several `floors`, `reset` chooses the one of each episode.

        `robot` None is the stand-in.
        """
        floors = (floors,) if isinstance(floors, Warehouse) else tuple(floors)
        self.num_envs, self.task = num_envs, task
        self.robot = robot = robot or stand_in(task.body)
        self.beams = len(robot.bearings_rad)
        self.timestep_s = timestep_s
        self.blocks, self.block_s = blocks_of(task, timestep_s)
        self.substeps = round(self.block_s / timestep_s)
        slots = max(len(floor.racks) for floor in floors)
        self.model, self.handles = build_model(floors[0], robot, timestep_s, slots)
        self.batch = Batch(self.model, num_envs, nthread)
        self.qpos, self.qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self._ctrl = self.batch.bind("ctrl")
        self._slip_mps = task.slip_limit_mps
        self._wheels_m = robot.wheels_m
        self._wheel_qpos = np.array(self.handles.wheel_qpos)
        self._wheel_qvel = np.array(self.handles.wheel_qvel)
        self._steering_qpos = np.array(self.handles.steering_qpos, np.int64)
        self._actuators = self.model.nu
        width = self._actuators + 3 * self.model.nmocap
        self._control = np.zeros((num_envs, self.substeps, width))
        length_m, width_m = task.body.length_m, task.body.width_m
        points = math.ceil(max(length_m, width_m) / OUTLINE_STEP_M) + 1
        self.outline_m = rectangle(length_m, width_m, robot.axle_x_m, points)  # (K, 2) from pose
        half_m = length_m / 2, width_m / 2
        self.scenery = Scenery(
            *(self.batch, self.handles, floors, slots, half_m, robot.lidar_z_m),
            self._control[:, :, self._actuators :],
        )
        self.traffic, self.pallets = self.scenery.traffic, self.scenery.pallets
        self.body = RobotBody(self.batch, self.model, self.handles, num_envs, robot)
        self.friction = FloorFriction(
            self.batch.expand("geom_friction"), self.handles.wheel_geoms, self._wheels_m
        )
        self.patches = self.friction.patches
        self.controller = base_controller(
            num_envs, robot, task.control_period_s, timestep_s, self.substeps
        )
        self.time_s = np.zeros(num_envs)
        self.bumped = np.zeros(num_envs, np.bool_)  # bumper was pressed in the last control period
        self.accel = np.zeros((num_envs, 3))  # mean over the second half of the last block
        self.slipped = np.zeros(num_envs, np.bool_)  # a wheel slid on a patch in the last period
        self.travelled_m = np.zeros(num_envs)  # distance over ground in the last control period
        self.diverged = np.zeros(num_envs, np.bool_)
        # At the start of the last control period: poses, gaps to traffic, robots on a patch.
        self.start, self.traffic_gap_m = np.zeros((num_envs, 3)), np.zeros((num_envs, AGENTS))
        self.on_patch = np.zeros(num_envs, np.bool_)

        self.bearings_rad = np.array(robot.bearings_rad)  # (beams,) in the lidar's own frame
        ahead = self.bearings_rad + task.body.lidar_yaw_rad
        self.lidar = Lidar(self.batch, self.scenery, ahead, robot.lidar_z_m)
        self.callback: Callable[[BodyState], None] | None = None
        self.callback_period_s = 0.02

    # -- layout ---------------------------------------------------------------------------------

    def reset(self, env: int, episode: Episode, perturbation: Perturbation, floor: int = 0) -> None:
        """Put one environment at the start of an episode, on one of the floors."""
        self.scenery.build(env, floor)
        self.batch.reset(np.array([env]), stage=int(mujoco.mjtStage.mjSTAGE_NONE))
        self.batch.warning[env] = 0
        self.place_robot(env, *episode.start)
        self.apply(env, perturbation)
        patches = episode.patches.copy()
        patches[:, 4] *= perturbation.patch_friction_scale
        self.friction.lay(env, patches)
        self.scenery.reset(env, episode)
        self.controller.reset(env)
        self.accel[env] = 0.0
        self.time_s[env] = 0.0
        self.bumped[env] = self.slipped[env] = self.diverged[env] = False

    def place_robot(self, env: int, x_m: float, y_m: float, yaw_rad: float) -> None:
        """Put the robot at a pose, standing still."""
        self.qpos[env] = self.model.qpos0
        self.qpos[env, :3] = x_m, y_m, self.robot.rest_z_m
        self.qpos[env, 3:7] = quaternion(np.array([yaw_rad]))[0]
        self.qvel[env] = 0.0
        self._ctrl[env] = 0.0

    def apply(self, env: int, perturbation: Perturbation) -> None:
        """Write a perturbation's physics into one environment."""
        self.friction.scale[env, ::2] = perturbation.left_friction_scale
        self.friction.set_floor(env, FLOOR_FRICTION * perturbation.friction_scale)
        self.controller.latency_s[env] = perturbation.latency_s
        self.controller.gain[env] = perturbation.gain
        self.controller.left_gain[env] = perturbation.left_gain
        self.body.apply(env, perturbation)

    # -- motion ---------------------------------------------------------------------------------

    def drive(self, command: F64) -> None:
        """Drive one control period under commands (N, 2): forward speed, yaw rate."""
        self.controller.command(command)
        self.bumped[:] = self.slipped[:] = self.on_patch[:] = False
        touched, icy = self.bumped.copy(), self.friction.icy
        self.start = pose = self.pose()
        middle = self.middle(pose)
        self.traffic_gap_m = self.traffic.gaps_m(middle)
        for block in range(self.blocks):
            self.scenery.walk(self.traffic.advance(middle, self.qvel[:, :2], touched, self.block_s))
            slippery = self.friction.write(icy, pose[icy])
            if block == 0:
                self.on_patch[icy] = slippery.any(axis=1)
            touched, accel = self._run(self.controller.controls(block * self.block_s))
            self.bumped |= touched
            pose = self.pose()
            middle = self.middle(pose)
            if slippery.any():
                self.slipped[icy] |= self._slipping(icy, pose[icy, 2], slippery)
            self.traffic.note_closest(middle)
        self.accel = accel[:, self.substeps // 2 :].mean(axis=1)
        self.travelled_m = np.hypot(*(pose - self.start)[:, :2].T)
        warnings = np.asarray(self.batch.warning).reshape(self.num_envs, -1)
        self.diverged = np.asarray((warnings > 0).any(axis=1), np.bool_)

    def _run(self, actuators: F64) -> tuple[Bools, F64]:
        """Run one block of substeps under controls (N, S, actuators).

        Returns which bumpers were pressed (N,), and the accelerations at each substep (N, S, 3).
        """
        control = self._control
        control[:, :, : self._actuators] = actuators
        touched = np.zeros(self.num_envs, np.bool_)
        if self.callback is None:
            parts = [(0, self.substeps)]
        else:
            stride = max(round(self.callback_period_s / self.timestep_s), 1)
            starts = range(0, self.substeps, stride)
            parts = [(start, min(start + stride, self.substeps)) for start in starts]
        records = []
        for start, stop in parts:
            part = control[:, start:stop]
            record = self.batch.rollout(stop - start, part, _CONTROLLED, ("sensordata",))
            sensed = record["sensordata"]
            pressed = (sensed[:, :, self.handles.bumper] > 0).any(axis=1)
            touched |= pressed
            self.time_s += (stop - start) * self.timestep_s
            records.append(sensed[:, :, self.handles.accelerometer])
            if self.callback is not None:
                self.callback(self.body_state(records[-1].mean(axis=1), pressed))
        return touched, records[0] if len(records) == 1 else np.concatenate(records, axis=1)

    def body_state(self, accel: F64, pressed: Bools) -> BodyState:
        """Return the true state now."""
        pose = self.pose()
        ahead = np.cos(pose[:, 2]) * self.qvel[:, 0] + np.sin(pose[:, 2]) * self.qvel[:, 1]
        return BodyState(
            time_s=self.time_s.copy(),
            x_m=pose[:, 0],
            y_m=pose[:, 1],
            yaw_rad=pose[:, 2],
            speed_mps=ahead,
            yaw_rate_radps=self.qvel[:, 5].copy(),
            wheel_angle_rad=self.robot.by_side(self.qpos[:, self._wheel_qpos]).copy(),
            wheel_speed_radps=self.wheel_speeds().copy(),
            accel_mps2=accel,
            bumped=pressed,
        )

    def pose(self, ids: Ints | slice = slice(None)) -> F64:
        """Return the true x, y and heading, (N, 3), or those of `ids` (n,)."""
        qpos = self.qpos[ids]
        return stacked(qpos[:, 0], qpos[:, 1], yaw_of(qpos[:, 3:7]))

    def middle(self, pose: F64) -> F64:
        """Return the centres and headings (..., 3) of outlines with axles at poses (..., 3)."""
        if not self.robot.axle_x_m:
            return pose
        back = self.robot.axle_x_m
        x, y = np.cos(pose[..., 2]) * back, np.sin(pose[..., 2]) * back
        return stacked(pose[..., 0] - x, pose[..., 1] - y, pose[..., 2])

    def wheel_speeds(self, ids: Ints | slice = slice(None)) -> F64:
        """Return the speeds (N, 2) of the left and right wheels, in rad/s."""
        return self.robot.by_side(self._wheel_spin(ids))

    def _wheel_spin(self, ids: Ints | slice = slice(None)) -> F64:
        """Return the speeds (n, W) of all wheels, in rad/s."""
        spin: F64 = self.qvel[ids].take(self._wheel_qvel, axis=1)
        return spin

    def roll(self, speed_mps: F64, yaw_rate_radps: F64) -> None:
        """Set the wheels' speeds for robots that drive at speeds (N,) and yaw rates (N,)."""
        left, right = self.robot.wheel_commands(speed_mps, yaw_rate_radps)
        for wheel, dof in enumerate(self.handles.wheel_qvel):
            self.qvel[:, dof] = right if wheel % 2 else left

    def steer(self) -> None:
        """Set the front wheels of robots that steer to their controllers' angles."""
        if isinstance(self.controller, SteeringController):
            angles = self.robot.front_angles(self.controller.steering_rad)
            self.qpos[:, self._steering_qpos] = angles

    def _slipping(self, ids: Ints, heading: F64, slippery: Bools) -> Bools:
        """Return the robots (n,) with a wheel on a patch (n, W) that slides beyond the limit."""
        velocity = self.qvel[ids]
        cos, sin = np.cos(heading), np.sin(heading)
        forward = cos * velocity[:, 0] + sin * velocity[:, 1]
        lateral = cos * velocity[:, 1] - sin * velocity[:, 0]
        ground = forward[:, None] - velocity[:, 5, None] * self._wheels_m[:, 1]
        aside = lateral[:, None] + velocity[:, 5, None] * self._wheels_m[:, 0]
        rim = self._wheel_spin(ids) * self.body.radius_m[ids, None]
        if self.robot.steers:
            steering = self.qpos[ids].take(self._steering_qpos, axis=1)
            ground[:, :2] -= rim[:, :2] * (np.cos(steering) - 1)
            aside[:, :2] -= rim[:, :2] * np.sin(steering)
        slip = np.hypot(rim - ground, aside)
        return np.asarray((slippery & (slip > self._slip_mps)).any(axis=1), np.bool_)

    # -- sensing --------------------------------------------------------------------------------

    @property
    def lidar_x_m(self) -> float:
        """Return how far ahead of the pose the lidar is, in metres."""
        return self.task.body.lidar_x_m - self.robot.axle_x_m

    def cast(self, ids: Ints) -> F64:
        """Return the true lidar ranges (n, beams) in metres; inf if nothing is hit."""
        pose = self.pose(ids)
        heading = pose[:, 2]
        ahead = self.lidar_x_m * stacked(np.cos(heading), np.sin(heading))
        return self.lidar.ranges(ids, pose[:, :2] + ahead, heading)

    # -- state ----------------------------------------------------------------------------------

    @property
    def _physics(self) -> NDArray[Any]:
        """Return the state of the physics of the batch's N robots, (N, …)."""
        state: NDArray[Any] = self.batch.state
        return state

    @_physics.setter
    def _physics(self, state: NDArray[Any]) -> None:
        self.batch.state[:] = state


def blocks_of(task: Task, timestep_s: float) -> tuple[int, float]:
    """Return the number of blocks in a control period, and their length in seconds.

    Blocks are `BLOCK_S` long if the period is a multiple of it, else an equal part of the period.

    Raises:
        ConfigError: the length is not a multiple of the timestep.
    """
    period_s = task.control_period_s
    blocks = max(math.ceil(period_s / BLOCK_S - 1e-9), 1)
    whole = abs(blocks * BLOCK_S - period_s) < 1e-9
    block_s = BLOCK_S if whole else period_s / blocks
    if abs(round(block_s / timestep_s) * timestep_s - block_s) < 1e-9:
        return blocks, block_s
    if whole:
        raise ConfigError(
            f"timestep_s = {timestep_s} does not divide {BLOCK_S} s",
            where="perturbation",
            remedy="use .01, .005, .002 or .001",
        )
    raise ConfigError(
        f"control_period_s = {period_s} is not a whole number of physics timesteps of "
        f"{timestep_s} s" + (f", in {blocks} equal parts" if blocks > 1 else ""),
        where="task",
        remedy="use whole hundredths of a second (above .1 s, an even number), such as .05, .08 or"
        " .12, or a smaller timestep_s",
    )
