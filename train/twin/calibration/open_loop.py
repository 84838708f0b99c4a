"""Open loop: logged commands driven again in the twin, without any other information from the log.

`drive_open_loop` puts robots into logged states and drives logged commands from there, one control
period or many. `replay_segments` drives segments of a log with it: the W steps before a segment
begin with the logged motion, and are driven only so that ramps and late commands are under way when
the K steps begin. Then the twin's pose is put on the logged pose, and the two go their ways.

Without a floor map the floor is empty. Obstacles of a log are not known, racks of another floor are
not there, and a pose that localisation has 3 cm wrong must not become a collision: the question is
how the robot moves, and steps with contact are marked by the signal `bumped`. Nor are slippery
patches known. Without obstacles the motion does not depend on where it begins, so robots are driven
in the middle of an empty hall, and their paths laid onto the map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from restock.arrays import F64, Bools, Ints
from restock.ingest.task.signals import Signals, localised_velocity, wrap_angle
from restock.ingest.task.task import Task
from restock.train.twin.calibration.logged_steps import rows_of
from restock.train.twin.calibration.segments import POSE, LoggedSegments
from restock.train.twin.floors.layout import Warehouse
from restock.train.twin.physics.episode import Episode, EpisodeSpec
from restock.train.twin.physics.perturbation import Perturbation
from restock.train.twin.physics.robot_model import RobotModel
from restock.train.twin.physics.sensing import Sensing
from restock.train.twin.physics.simulation import Simulation

ROBOTS = 512  # simulated at a time
SLIP_MPS = 0.2  # wheels and localisation this far apart: ground speed is the localised one
EMPTY_M = 60.0  # the side of an empty floor; who comes near its wall is put back in its middle
SENSED = ("wheel_speed_mps", "wheel_yaw_rate_radps", "gyro_yaw_rate_radps", "accel_x_mps2")


@dataclass(frozen=True)
class OpenLoopStart:
    """The states in which S robots begin, and the commands that they are given from there.

    `motion` are the logged wheel speed and yaw rate, gyroscope, localised speed and lateral speed,
    (S,) each. Without `past` the base controllers begin as if always commanded what their wheels
    do; with it they begin as those commands leave them.
    """

    pose: F64  # (S, 3) x, y and heading
    motion: Signals
    command: F64  # (S, K, 2) speed m/s and yaw rate rad/s
    past: F64 | None = None  # (S, P, 2) the commands of the periods before

    def take(self, which: Ints) -> OpenLoopStart:
        past = None if self.past is None else self.past[which]
        return OpenLoopStart(
            self.pose[which], rows_of(self.motion, which), self.command[which], past
        )


@dataclass(frozen=True)
class OpenLoopResult:
    """What P twins did from S starts, without sensor noise: at the start and after each period."""

    signals: dict[str, F64]  # of pose, wheels, gyroscope and accelerometer, (P, S, K + 1) each
    sliding_mps: F64  # (P, S, K + 1) of the faster sliding wheel over the floor, along the robot
    bumped: Bools  # (P, S) in the last period
    sector_clearance_m: F64  # (P, S, sectors) at the end; none on an empty floor
    diverged: Bools  # (P, S) the physics broke: the rest says nothing

    @property
    def pose(self) -> F64:
        """x, y and heading, (P, S, K + 1, 3)."""
        return np.stack([self.signals[name] for name in POSE], axis=-1)


def drive_open_loop(
    task: Task,
    start: OpenLoopStart,
    perturbations: Sequence[Perturbation],
    *,
    robot: RobotModel | None = None,
    warehouse: Warehouse | None = None,
    timestep_s: float = 0.01,
    nthread: int = 1,
) -> OpenLoopResult:
    """Drive every start's commands under every perturbation: P x S robots.

    Without a `robot` they are stand-ins.

    The perturbations' own `timestep_s` and sensor noise are not used. The result does not depend
    on `nthread`, nor on which other starts and perturbations are driven.

    Raises:
        ConfigError: a timestep that does not divide .1 s, or a control period that the twin
            cannot keep (no whole number of timesteps).
    """
    shape = (len(perturbations), len(start.pose))
    jobs, periods = shape[0] * shape[1], start.command.shape[1]
    sectors = 0 if warehouse is None else task.sectors
    pose = np.zeros((jobs, periods + 1, 3))
    signals = {name: np.zeros((jobs, periods + 1)) for name in SENSED}
    sliding = np.zeros((jobs, periods + 1))
    bumped, diverged = np.zeros((2, jobs), np.bool_)
    clearance = np.zeros((jobs, sectors))
    simulation: Simulation | None = None
    for begin in range(0, jobs, ROBOTS):
        ids = np.arange(begin, min(begin + ROBOTS, jobs))
        if simulation is None or simulation.num_envs != len(ids):
            floor = warehouse or empty_floor()
            simulation = Simulation(len(ids), task, floor, timestep_s, nthread, robot=robot)
        which, number = np.divmod(ids, shape[1])
        twins, part = [perturbations[index] for index in which], start.take(number)
        offset = _place(simulation, part, twins, endless=warehouse is None)
        bias = np.array([twin.gyro_bias_radps for twin in twins])
        for step in range(periods + 1):
            if step:
                simulation.drive(part.command[:, step - 1])
                diverged[ids] |= simulation.diverged
            pose[ids, step] = simulation.pose()
            pose[ids, step, :2] += offset
            speed, turn = simulation.robot.body_velocity(*simulation.wheel_speeds().T)
            sensed = (speed, turn, simulation.qvel[:, 5] + bias, simulation.accel[:, 0])
            for name, values in zip(SENSED, sensed, strict=True):
                signals[name][ids, step] = values
            sliding[ids, step] = _sliding(simulation, pose[ids, step, 2])
            if warehouse is None:
                offset += _recentre(simulation)
        bumped[ids] = simulation.bumped
        if sectors:
            clearance[ids] = see_sectors(simulation)
    signals |= {name: pose[..., i] for i, name in enumerate(POSE)}
    return OpenLoopResult(
        signals={name: values.reshape(*shape, -1) for name, values in signals.items()},
        sliding_mps=sliding.reshape(*shape, -1),
        bumped=bumped.reshape(shape),
        sector_clearance_m=clearance.reshape(*shape, sectors),
        diverged=diverged.reshape(shape),
    )


def empty_floor() -> Warehouse:
    """A floor without racks."""
    middle = (EMPTY_M / 2, EMPTY_M / 2)
    return Warehouse(EMPTY_M, EMPTY_M, racks=(), segments=(), goals_m=(middle,), name="empty")


def see_sectors(simulation: Simulation) -> F64:
    """The sector clearances (N, sectors) that robots sense now, without noise."""
    sensing = Sensing(simulation, simulation.task)  # its noise is zero until an episode is drawn
    ids = np.arange(simulation.num_envs)
    return np.asarray(sensing.sense(ids, np.zeros(len(ids), np.int64))["sector_clearance_m"])


def _place(
    simulation: Simulation,
    start: OpenLoopStart,
    perturbations: Sequence[Perturbation],
    *,
    endless: bool,
) -> F64:
    """Put every robot where its log was, moving as it did; returns map less simulation (N, 2).

    On an `endless` floor robots start in its middle.
    """
    middle = np.full(2, EMPTY_M / 2)
    offset = start.pose[:, :2] - middle if endless else np.zeros((len(start.pose), 2))
    motion = start.motion
    for env, perturbation in enumerate(perturbations):
        x, y = middle if endless else start.pose[env, :2]
        plan = np.array([[x, y], [x, y]])
        episode = Episode(
            EpisodeSpec("nominal", 0), (x, y, start.pose[env, 2]), goal=(x, y), plan_m=plan
        )
        simulation.reset(env, episode, perturbation)
    wheels = np.asarray(motion["wheel_speed_mps"])
    localised = np.asarray(motion["localised_speed_mps"])
    slips = np.abs(wheels - localised) > SLIP_MPS
    rolled = wheels * simulation.body.radius_m / simulation.robot.wheel_radius_m
    forward = np.where(slips, localised, rolled)
    lateral = np.asarray(motion["localised_lateral_mps"])
    lateral = np.where(np.abs(lateral) > SLIP_MPS, lateral, 0.0)
    cos, sin = np.cos(start.pose[:, 2]), np.sin(start.pose[:, 2])
    simulation.qvel[:, 0] = cos * forward - sin * lateral
    simulation.qvel[:, 1] = sin * forward + cos * lateral
    bias = np.array([twin.gyro_bias_radps for twin in perturbations])
    simulation.qvel[:, 5] = motion["gyro_yaw_rate_radps"] - bias
    turn = motion["wheel_yaw_rate_radps"]
    simulation.roll(wheels, turn)
    controller = simulation.controller
    if start.past is None:
        controller.begin(np.stack([wheels, turn], axis=-1))
        simulation.steer()
        return offset
    for step in range(start.past.shape[1]):  # its ramp and its late commands, as they are now
        controller.command(start.past[:, step])
        for block in range(simulation.blocks):
            controller.controls(block * simulation.block_s)
    simulation.steer()
    return offset


def _recentre(simulation: Simulation) -> F64:
    """Put robots near the wall of an empty floor back in its middle; returns how far (N, 2)."""
    from_middle = simulation.qpos[:, :2] - EMPTY_M / 2
    away = np.where(np.abs(from_middle) > EMPTY_M / 4, from_middle, 0.0)
    simulation.qpos[:, :2] -= away
    return np.asarray(away)


def _sliding(simulation: Simulation, yaw_rad: F64) -> F64:
    """How fast the rims on a side move over the floor, (N,) m/s, the larger of the two sides."""
    velocity = simulation.qvel
    forward = np.cos(yaw_rad) * velocity[:, 0] + np.sin(yaw_rad) * velocity[:, 1]
    turn = velocity[:, 5] * (simulation.robot.track_m / 2)
    ground = np.stack([forward - turn, forward + turn], axis=-1)
    rim = simulation.wheel_speeds() * simulation.body.radius_m[:, None]
    faster: F64 = np.abs(rim - ground).max(axis=1)
    return faster


def replay_segments(
    segments: LoggedSegments,
    perturbations: Sequence[Perturbation],
    *,
    timestep_s: float = 0.01,
    nthread: int = 1,
) -> OpenLoopResult:
    """Drive every segment's commands under every perturbation, on an empty floor.

    The signals are those of poses, laid onto the log so that each first one is the logged one, and
    of motion, localised speeds too.

    Raises:
        ConfigError: as `drive_open_loop`.
    """
    moving = ~segments.still
    motion = {name: np.where(moving, values, 0.0) for name, values in segments.before.items()}
    motion["localised_lateral_mps"] = np.zeros(len(segments))  # the warm-up is long enough for it
    start = OpenLoopStart(np.zeros((len(segments), 3)), motion, segments.command)
    driven = drive_open_loop(
        *(segments.task, start, perturbations),
        robot=segments.robot, timestep_s=timestep_s, nthread=nthread,
    )  # fmt: skip
    warmup = segments.warmup_steps
    signals = {name: driven.signals[name][..., warmup:] for name in SENSED}
    forward, lateral = _localised(
        driven.pose, segments.task.control_period_s, signals["wheel_speed_mps"]
    )
    signals["localised_speed_mps"], signals["localised_lateral_mps"] = forward, lateral
    laid = lay_onto(driven.pose[:, :, warmup:], segments.pose[:, 0])
    laid[..., 2] = wrap_angle(laid[..., 2])
    signals |= {name: laid[..., i] for i, name in enumerate(POSE)}
    return replace(driven, signals=signals, sliding_mps=driven.sliding_mps[..., warmup:])


def _localised(pose: F64, period_s: float, wheel_speed: F64) -> tuple[F64, F64]:
    """Speeds from poses (..., W + K + 1, 3) a period apart, as ingest has them; (..., K + 1) each.

    Without a warm-up no pose is before the first, and the wheels say its speed.
    """
    stamp = np.broadcast_to(np.arange(pose.shape[-2]) * round(period_s * 1e9), pose.shape[:-1])
    columns = {name: pose[..., i] for i, name in enumerate(POSE)} | {"pose_stamp_ns": stamp}
    at = np.arange(pose.shape[-2] - wheel_speed.shape[-1], pose.shape[-2])
    now = {name: values[..., at] for name, values in columns.items()}
    before = {name: values[..., np.maximum(at - 1, 0)] for name, values in columns.items()}
    return localised_velocity({**now, "wheel_speed_mps": wheel_speed}, before)


def lay_onto(pose: F64, onto: F64) -> F64:
    """Poses (..., S, K + 1, 3) moved as one so that each first is `onto` (S, 3)."""
    turn = onto[:, 2] - pose[..., 0, 2]
    cos, sin = np.cos(turn)[..., None], np.sin(turn)[..., None]
    x, y = pose[..., 0] - pose[..., :1, 0], pose[..., 1] - pose[..., :1, 1]
    moved = (onto[:, :1] + cos * x - sin * y, onto[:, 1:2] + sin * x + cos * y)
    return np.stack([*moved, pose[..., 2] + turn[..., None]], axis=-1)
