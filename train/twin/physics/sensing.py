"""The robot's sensors: the signals of `restock.ingest.task.task` from the simulation.

Functions of ingest turn ranges into clearances, and plans into waypoints. This module has only the
sensors: lidar, localisation, encoders, gyroscope, accelerometer and bumper, with the noise of a
perturbation. All noise of an episode is drawn from the episode's own seed, some steps at a time.
"""

from __future__ import annotations

from itertools import accumulate
from statistics import NormalDist

import numpy as np

from restock.arrays import F64, Ints
from restock.ingest.task.surroundings import (
    PLAN_PARTS,
    SCANNED,
    SectorMap,
    came_nearer,
    outline_reach,
    plan_distances_m,
    returns_on_plan,
    steps_remembered,
    view_route,
)
from restock.ingest.task.task import (
    Body,
    Signals,
    Task,
    clearance_ahead,
    localised_velocity,
    wrap_angle,
)
from restock.ingest.task.tracks import Lidar as FineLidar
from restock.ingest.task.tracks import Tracker
from restock.state import Stateful
from restock.train.twin.physics.model import passed_over
from restock.train.twin.physics.perturbation import Perturbation
from restock.train.twin.physics.robot_model import LIDAR_Z_M, stand_in
from restock.train.twin.physics.scenery import Lidar
from restock.train.twin.physics.simulation import Simulation

FIRST_STAMP_NS = 1_000_000_000  # timestamp of an episode's first step: timestamps are never 0
DRIFT_TIME_S = 3.0  # time constant of the localisation's drift
WIDEST_GAP_RAD = np.radians(20)  # if neighbouring beams are closer than this, no obstacle is missed
DRAWN = 60  # steps of an episode whose noise is drawn together
_SCALARS = 9  # x, y, yaw, drift x, drift y, left, right, gyro, accel


class Sensing(Stateful):
    """The sensors of N robots."""

    STATE = ("ranges_m", "pose", "pose_stamp_ns", "true_clearance_m", "scanned", "tracker")

    def __init__(self, simulation: Simulation, task: Task) -> None:
        self.simulation, self.task = simulation, task
        # The twin always simulates a lidar. If its beams see everything, they give the true
        # clearance, even if the task has no lidar.
        self.beams = SectorMap.build(simulation.bearings_rad, max(task.sectors, 4), task.body)
        self._fine = FineLidar(simulation.bearings_rad + task.body.lidar_yaw_rad)
        self.tracker = Tracker(task, simulation.num_envs) if task.tracks else None
        self._true_room = None if _sees_everything(simulation) else _TrueRoom(simulation)
        num, steps = simulation.num_envs, task.time_limit_steps + 1
        self._noise = np.zeros((num, steps, _SCALARS + simulation.beams), np.float32)
        self._drawn = np.full(num, steps)  # number of steps with drawn noise; all before a reset
        self._generators = [np.random.default_rng(0)] * num
        self._drift = np.zeros((num, 2))  # drift of localised x and y at the last drawn step
        self._scale = np.zeros((num, _SCALARS))
        self._bias = np.zeros((num, 3))  # biases of wheels' speed, gyroscope, accelerometer
        self._scan_every = np.ones(num, np.int64)  # steps from scan to scan
        self._pose_every = np.ones(num, np.int64)
        self.pose = np.zeros((num, 3))  # last localised pose
        self.pose_stamp_ns = np.zeros(num, np.int64)  # timestamp of that pose
        self._range_noise_m = np.zeros(num)
        self._dropout_beyond = np.full(num, np.inf)
        self.ranges_m = np.zeros((num, simulation.beams))  # last measured ranges
        self.true_clearance_m = np.zeros(num)
        scan: Signals = {name: np.zeros(num) for name in SCANNED}
        scan["sector_clearance_m"] = np.zeros((num, task.sectors))
        scan["stamp_ns"] = np.zeros(num, np.int64)
        self.scanned: list[Signals] = [  # signals of the previous steps, newest first
            {name: column.copy() for name, column in scan.items()}
            for _ in range(steps_remembered(task))
        ]

    def reset(self, env: int, seeds: np.random.SeedSequence, perturbation: Perturbation) -> None:
        """Prepare an episode's noise, which is drawn when it is needed."""
        self._generators[env] = np.random.Generator(np.random.SFC64(seeds))
        self._drawn[env] = self._drift[env] = 0
        p = perturbation
        self._scale[env] = (
            *(p.localisation_noise_m, p.localisation_noise_m, p.localisation_yaw_noise_rad),
            *(p.localisation_drift_m, p.localisation_drift_m),
            *(p.encoder_noise_radps, p.encoder_noise_radps),
            *(p.gyro_noise_radps, p.accel_noise_mps2),
        )
        self._bias[env] = p.encoder_bias_radps, p.gyro_bias_radps, p.accel_bias_mps2
        period_s = self.task.control_period_s
        self._scan_every[env] = max(round(p.lidar_period_s / period_s), 1)
        self._pose_every[env] = max(round(p.localisation_period_s / period_s), 1)
        self._range_noise_m[env] = p.lidar_noise_m
        # A beam is lost if its noise falls into the tails, whose probability is the dropout.
        self._dropout_beyond[env] = (
            NormalDist().inv_cdf(1 - p.lidar_dropout / 2) if p.lidar_dropout else np.inf
        )

    def _draw(self, env: int, step: int) -> None:
        """Draw the noise of an episode up to a step or further, `DRAWN` steps at a time.

        The localisation's drift is a first-order autoregressive process of unit variance.
        """
        keep = float(np.exp(-self.task.control_period_s / DRIFT_TIME_S))
        while (begin := int(self._drawn[env])) <= step:
            noise = self._noise[env, begin : begin + DRAWN]
            self._generators[env].standard_normal(dtype=np.float32, out=noise)
            self._drawn[env] += len(noise)
            drift = noise[:, 3:5]
            drift[int(begin == 0) :] *= np.sqrt(1 - keep**2)
            for axis, new in enumerate(drift.T.tolist()):  # scipy.signal would take .6 s to import
                last = float(self._drift[env, axis])
                walk = list(accumulate(new, lambda was, new: new + keep * was, initial=last))
                drift[:, axis], self._drift[env, axis] = walk[1:], walk[-1]

    def sense(self, ids: Ints, step: Ints) -> Signals:
        """Return the signals of robots `ids` (n,) at their steps (n,).

        They lack the route (`add_route`), and localised speeds and tracks (`add_motion`).
        """
        sim, task = self.simulation, self.task
        late = step >= self._drawn[ids]
        for env, at in zip(ids[late].tolist(), step[late].tolist(), strict=True):
            self._draw(env, at)
        noise = self._noise[ids, step]
        scalar = noise[:, :_SCALARS] * self._scale[ids]
        true_ranges = sim.cast(ids)
        if self._true_room is None:
            room = true_ranges - self.beams.reach_m
        else:
            room = self._true_room.room_m(ids)
        self.true_clearance_m[ids] = np.maximum(np.minimum.reduce(room, axis=1), 0.0)
        beam = noise[:, _SCALARS:].astype(np.float64)
        ranges = np.maximum(true_ranges + beam * self._range_noise_m[ids, None], 0.0)
        ranges[np.abs(beam) > self._dropout_beyond[ids, None]] = np.inf
        stale = step % self._scan_every[ids] != 0
        ranges[stale] = self.ranges_m[ids[stale]]
        self.ranges_m[ids] = ranges
        clearance = np.zeros((len(ids), 0))
        if task.lidar:
            clearance = self.beams.clearance(ranges, task.range_min_m, task.range_max_m)
        localised = sim.pose(ids) + scalar[:, :3]
        localised[:, :2] += scalar[:, 3:5]
        localised[:, 2] = wrap_angle(localised[:, 2])
        bias = self._bias[ids]
        wheels = sim.wheel_speeds(ids) + scalar[:, 5:7] + bias[:, :1]
        speed, yaw_rate = sim.robot.body_velocity(wheels[:, 0], wheels[:, 1])
        period_ns = round(task.control_period_s * 1e9)
        stamp = FIRST_STAMP_NS + step * period_ns
        fresh = step % self._pose_every[ids] == 0
        moved = ids[fresh]
        self.pose[moved], self.pose_stamp_ns[moved] = localised[fresh], stamp[fresh]
        last, command = self.pose[ids], sim.controller.commands[ids, 0]
        return {
            "stamp_ns": stamp,
            "pose_x_m": last[:, 0],
            "pose_y_m": last[:, 1],
            "pose_yaw_rad": last[:, 2],
            "pose_stamp_ns": self.pose_stamp_ns[ids],
            "wheel_speed_mps": speed,
            "wheel_yaw_rate_radps": yaw_rate,
            "gyro_yaw_rate_radps": sim.qvel[ids, 5] + bias[:, 1] + scalar[:, 7],
            "accel_x_mps2": sim.accel[ids, 0] + scalar[:, 8] + bias[:, 2],
            "sector_clearance_m": clearance,
            "clearance_m": clearance.min(axis=1) if task.lidar else np.full(len(ids), np.nan),
            "bumped": sim.bumped[ids],
            "command_speed_mps": command[:, 0],
            "command_yaw_rate_radps": command[:, 1],
        }

    def add_motion(self, ids: Ints, signals: Signals, before: Signals | None = None) -> None:
        """Add speeds from the last two localised poses, how far others came nearer, and tracks.

        `signals` are of all robots. At the first step of an episode, they are of `ids` (n,) alone
        and `before` is None: then speeds are those of the wheels, and nobody came nearer.
        """
        forward, lateral = localised_velocity(signals, signals if before is None else before)
        signals["localised_speed_mps"], signals["localised_lateral_mps"] = forward, lateral
        if before is None:
            for scan in self.scanned:
                for name, column in scan.items():
                    column[ids] = signals[name]
            signals["came_nearer_m"] = came_nearer(self.task, signals, [signals])
            self._track(ids, signals, begin=True)
            return
        signals["came_nearer_m"] = came_nearer(self.task, signals, self.scanned)
        self.scanned = [{name: signals[name].copy() for name in SCANNED}, *self.scanned[:-1]]
        self._track(ids, signals)

    def _track(self, ids: Ints, signals: Signals, *, begin: bool = False) -> None:
        """Add tracks to signals of robots `ids`: robots that `begin` an episode, or else all."""
        if self.tracker is None:
            return
        scan_m = self._fine.scan(self.ranges_m[ids], self.task.range_min_m)
        period_ns = round(self.task.control_period_s * 1e9)
        step = (signals["stamp_ns"] - FIRST_STAMP_NS) // period_ns
        stamp_ns = signals["stamp_ns"] - step % self._scan_every[ids] * period_ns
        if begin:
            signals |= self.tracker.begin(ids, signals, scan_m, stamp_ns)
        else:
            signals |= self.tracker.update(signals, scan_m, stamp_ns)


class _TrueRoom:
    """The true room around robots whose lidar does not see all around, or sees over obstacles."""

    def __init__(self, simulation: Simulation) -> None:
        body, bearings = simulation.task.body, np.array(stand_in(simulation.task.body).bearings_rad)
        self._simulation = simulation
        self._reach_m = outline_reach(bearings, Body(body.length_m, body.width_m))
        self._lidar = Lidar(simulation.batch, simulation.scenery, bearings, LIDAR_Z_M)

    def room_m(self, ids: Ints) -> F64:
        """Return distances (n, beams) from outlines to the nearest obstacle along each bearing."""
        middle = self._simulation.middle(self._simulation.pose(ids))
        ranges: F64 = self._lidar.ranges(ids, middle[:, :2], middle[:, 2]) - self._reach_m
        return ranges


def _sees_everything(simulation: Simulation) -> bool:
    """Return whether the beams cover all bearings and do not pass over any obstacle."""
    bearings = np.sort(simulation.bearings_rad % (2 * np.pi))
    widest = np.diff(bearings, append=bearings[0] + 2 * np.pi).max()
    return bool(widest < WIDEST_GAP_RAD) and not passed_over(simulation.robot.lidar_z_m)


def add_route(task: Task, signals: Signals, plans_m: F64, goals_m: F64) -> F64:
    """Add the signals of plans (n, P, 2) and goals (n, 2); return distances (n,) off the plans."""
    x, y, yaw = signals["pose_x_m"], signals["pose_y_m"], signals["pose_yaw_rad"]
    view = view_route(plans_m, x, y, yaw, plan_distances_m(task))
    near, far = view.look_ahead_m[:, PLAN_PARTS], view.look_ahead_m[:, 2 * PLAN_PARTS]
    signals["waypoint_near_x_m"], signals["waypoint_near_y_m"] = near[:, 0], near[:, 1]
    signals["waypoint_far_x_m"], signals["waypoint_far_y_m"] = far[:, 0], far[:, 1]
    signals["route_remaining_m"] = view.remaining_m
    signals["goal_distance_m"] = np.hypot(goals_m[:, 0] - x, goals_m[:, 1] - y)
    signals["clearance_ahead_m"] = clearance_ahead(
        task, signals["sector_clearance_m"], near[:, 0], near[:, 1]
    )
    signals["plan_return_m"], signals["plan_gap_m"] = returns_on_plan(
        task, signals["sector_clearance_m"], view.look_ahead_m
    )
    return view.offset_m
