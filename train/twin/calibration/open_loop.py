"""Open-loop replay: logged commands driven again in the twin, beside what the robot did.

The commands of each segment are driven in the twin's physics, which is told nothing on the way.
The W steps before a segment begin with the logged motion, and are driven only so that ramps and
late commands are under way when the K steps begin. Then the twin's pose is put on the logged pose,
and the two go their ways.

The floor is empty. Obstacles of a log are not known, racks of another floor are not there, and a
pose that localisation has 3 cm wrong must not become a collision: what is asked is how the robot
moves, and steps with contact are told by the signal `bumped`. Nor are slippery patches known.
Without obstacles the motion does not depend on where it begins, so all segments are driven from one
place and laid onto the map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from restock.ingest.task.signals import localised_velocity, wrap_angle
from restock.ingest.task.task import Task
from restock.train.twin.calibration.log_segments import MOTION, POSE, Segments
from restock.train.twin.floors.layout import Warehouse
from restock.train.twin.physics.episode import Episode, EpisodeSpec
from restock.train.twin.physics.model import TRACK_M, WHEEL_RADIUS_M, body_velocity, wheel_commands
from restock.train.twin.physics.perturbation import Perturbation
from restock.train.twin.physics.simulation import Simulation

F64 = NDArray[np.float64]

PREDICTED = (*POSE, *MOTION)  # what the twin says of each step
_SLIDING = "sliding_mps"
ROBOTS = 512  # simulated at a time
SLIPS_MPS = 0.2  # wheels and localisation this far apart: the floor's word is taken
_SIDE_M = 60.0  # of the floor; who comes near its wall is put back in its middle


@dataclass(frozen=True)
class Replayed:
    """What P twins did under the commands of S segments.

    `signals` has the names of `PREDICTED`, each (P, S, K + 1), without sensor noise; entry 0 of a
    pose is the logged one.
    """

    perturbations: tuple[Perturbation, ...]
    timestep_s: float
    signals: dict[str, F64]
    sliding_mps: F64  # (P, S, K + 1) of the faster sliding wheel over the floor, along the robot
    blown_up: NDArray[np.bool_]  # (P, S) the physics broke: the segment says nothing

    @property
    def pose(self) -> F64:
        """Predicted x, y and heading, (P, S, K + 1, 3)."""
        return np.stack([self.signals[name] for name in POSE], axis=-1)


def replay_segments(
    segments: Segments,
    perturbations: Sequence[Perturbation],
    *,
    timestep_s: float = 0.01,
    nthread: int = 1,
) -> Replayed:
    """Drive every segment's commands under every perturbation: P x S robots on an empty floor.

    The perturbations' own `timestep_s` and sensor noise are not looked at. The result does not
    depend on `nthread`, nor on which other segments and perturbations are asked for.

    Raises:
        ConfigError: a timestep that does not divide .1 s, or a control period that the twin
            cannot keep (no multiple of .1 s).
    """
    jobs = len(perturbations) * len(segments)
    signals = {
        name: np.zeros((jobs, segments.horizon_steps + 1)) for name in (*PREDICTED, _SLIDING)
    }
    blown_up = np.zeros(jobs, np.bool_)
    simulation: Simulation | None = None
    for begin in range(0, jobs, ROBOTS):
        ids = np.arange(begin, min(begin + ROBOTS, jobs))
        if simulation is None or simulation.num_envs != len(ids):
            simulation = _simulation(len(ids), segments.task, timestep_s, nthread)
        which, segment = np.divmod(ids, len(segments))
        part = segments.take(segment)
        for env, number in enumerate(which):
            _place(simulation, env, perturbations[number], part)
        moved, blown_up[ids] = _drive(simulation, part)
        for name, values in moved.items():
            signals[name][ids] = values
    shape = (len(perturbations), len(segments))
    shaped = {name: values.reshape(*shape, -1) for name, values in signals.items()}
    return Replayed(
        perturbations=tuple(perturbations),
        timestep_s=timestep_s,
        sliding_mps=shaped.pop(_SLIDING),
        signals=shaped,
        blown_up=blown_up.reshape(shape),
    )


def _simulation(robots: int, task: Task, timestep_s: float, nthread: int) -> Simulation:
    middle = (_SIDE_M / 2, _SIDE_M / 2)
    floor = Warehouse(_SIDE_M, _SIDE_M, racks=(), segments=(), goals_m=(middle,), name="empty")
    return Simulation(robots, task, floor, timestep_s, nthread)


def _place(simulation: Simulation, env: int, perturbation: Perturbation, part: Segments) -> None:
    """Put robot `env` at the beginning of the warm-up of segment `env` of `part`, in motion."""
    start = (_SIDE_M / 2, _SIDE_M / 2, 0.0)
    spec = EpisodeSpec("nominal", 0, perturbation)
    episode = Episode(spec, start, goal=start[:2], plan_m=np.array([start[:2], start[:2]]))
    simulation.reset(env, episode, perturbation)
    if part.still[env]:
        return
    speed, turn, gyro, localised = part.before[env]
    rolling = abs(speed - localised) < SLIPS_MPS
    forward = speed * simulation.body.radius_m[env] / WHEEL_RADIUS_M if rolling else localised
    simulation.qvel[env, 0], simulation.qvel[env, 5] = forward, gyro
    simulation.qvel[env, 6:8] = wheel_commands(speed, turn)
    # What was commanded earlier is not in the segment: as if it had been what the wheels do.
    asked = np.array([speed, turn]) / simulation.controller.gain[env]
    simulation.controller.commands[env] = simulation.controller.set_point[env] = asked


def _drive(simulation: Simulation, part: Segments) -> tuple[dict[str, F64], NDArray[np.bool_]]:
    """Predicted signals (N, K + 1) of N robots already placed, and whose physics broke (N,)."""
    num, warmup = len(part), part.warmup_steps
    pose = np.zeros((num, warmup + part.horizon_steps + 1, 3))
    motion = {name: np.zeros((num, part.horizon_steps + 1)) for name in (*MOTION, _SLIDING)}
    blown_up = np.zeros(num, np.bool_)
    shifted = np.zeros((num, 2))
    for step in range(pose.shape[1]):
        if step:
            simulation.drive(part.command[:, step - 1])
            blown_up |= simulation.blown_up
        pose[:, step] = simulation.pose()
        pose[:, step, :2] += shifted
        from_middle = simulation.qpos[:, :2] - _SIDE_M / 2
        away = np.where(np.abs(from_middle) > _SIDE_M / 4, from_middle, 0.0)
        shifted += away
        simulation.qpos[:, :2] -= away
        if step >= warmup:
            velocity, at = simulation.qvel, step - warmup
            speed, turn = body_velocity(velocity[:, 6], velocity[:, 7])
            motion["wheel_speed_mps"][:, at], motion["wheel_yaw_rate_radps"][:, at] = speed, turn
            motion["gyro_yaw_rate_radps"][:, at] = velocity[:, 5]
            motion["accel_x_mps2"][:, at] = simulation.accel[:, 0]
            motion[_SLIDING][:, at] = _sliding(simulation, pose[:, step, 2])
    forward, lateral = _localised(pose, part.task.control_period_s, motion["wheel_speed_mps"])
    motion["localised_speed_mps"], motion["localised_lateral_mps"] = forward, lateral
    laid = _lay(pose[:, warmup:], part.pose[:, 0])
    return {**{name: laid[..., i] for i, name in enumerate(POSE)}, **motion}, blown_up


def _sliding(simulation: Simulation, yaw_rad: F64) -> F64:
    """How fast a wheel's rim moves over the floor, (N,) m/s, the larger of the two wheels."""
    velocity = simulation.qvel
    forward = np.cos(yaw_rad) * velocity[:, 0] + np.sin(yaw_rad) * velocity[:, 1]
    turn = velocity[:, 5] * (TRACK_M / 2)
    ground = np.stack([forward - turn, forward + turn], axis=-1)
    rim = velocity[:, 6:8] * simulation.body.radius_m[:, None]
    faster: F64 = np.abs(rim - ground).max(axis=1)
    return faster


def _localised(pose: F64, period_s: float, wheel_speed: F64) -> tuple[F64, F64]:
    """Speeds from poses (N, W + K + 1, 3) a period apart, as ingest has them; (N, K + 1) each.

    Without a warm-up no pose is before the first, and the wheels say its speed.
    """
    steps = wheel_speed.shape[1]
    stamp = np.broadcast_to(np.arange(pose.shape[1]) * round(period_s * 1e9), pose.shape[:2])
    columns = {name: pose[..., i] for i, name in enumerate(POSE)} | {"pose_stamp_ns": stamp}
    at = np.arange(pose.shape[1] - steps, pose.shape[1])
    now = {name: values[:, at] for name, values in columns.items()}
    before = {name: values[:, np.maximum(at - 1, 0)] for name, values in columns.items()}
    return localised_velocity({**now, "wheel_speed_mps": wheel_speed}, before)


def _lay(pose: F64, onto: F64) -> F64:
    """Poses (N, K + 1, 3) moved as one so that each first is `onto` (N, 3)."""
    turn = onto[:, 2] - pose[:, 0, 2]
    cos, sin = np.cos(turn)[:, None], np.sin(turn)[:, None]
    x, y = pose[..., 0] - pose[:, :1, 0], pose[..., 1] - pose[:, :1, 1]
    return np.stack(
        [
            onto[:, :1] + cos * x - sin * y,
            onto[:, 1:2] + sin * x + cos * y,
            wrap_angle(pose[..., 2] + turn[:, None]),
        ],
        axis=-1,
    )
