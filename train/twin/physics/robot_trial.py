"""The profile's robot as the twin drives it: designed, then tried on an empty floor.

Wheels' soft contacts sink a little into the floor, which a small wheel rolls slower for, and a
robot whose wheels scrub turns slower than they say. Both are measured here once, so that every
robot drives the speed that it is commanded, and its odometry says what it drives.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from restock.arrays import F64
from restock.errors import ConfigError
from restock.ingest.task.robot import Lidar, Robot
from restock.ingest.task.scan import Body
from restock.train.twin.physics.contact import FLOOR_FRICTION
from restock.train.twin.physics.model import build_robot_alone
from restock.train.twin.physics.robot_model import RobotModel, design, stand_in
from restock.train.twin.physics.robot_parts import actuator_places, own_model, wheels_of

TIMESTEP_S = 0.01
SETTLE_S, DRIVE_S = 1.0, 1.5
MAX_TILT_RAD = 0.05
MIN_OUTSIDE_M = 0.01  # that is said of a part
TRY_SPEED, TRY_TURN = 0.5, 1.0  # m/s and rad/s, or as fast as its limits allow


def robot_model(robot: Robot | None, body: Body) -> RobotModel:
    """Return the model of a profile's `[robot]`, or the stand-in if it has none.

    Raises:
        ConfigError: a drive that the twin does not have, parts that do not go together, or a robot
            that does not stand or drive.
    """
    return stand_in(body) if robot is None else _tried(_Key(robot, body))


class _Key:
    """A robot and its outline, hashed by their content."""

    def __init__(self, robot: Robot, body: Body) -> None:
        self.robot, self.body = robot, body
        self._text = repr((robot, body))

    def __hash__(self) -> int:
        return hash(self._text)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and self._text == other._text


@functools.lru_cache(maxsize=32)
def _tried(key: _Key) -> RobotModel:
    built = design(key.robot, key.body)
    own = key.robot.mjcf is not None
    robot = _settled(own_model(key.robot, key.body, built) if own else built)
    speed = min(TRY_SPEED, robot.speed_limit[0] / 2)
    ahead, _ = _driven(robot, speed, 0.0)
    # It rolls on the middle of what its wheels sink in.
    radius = robot.contact_radius_m * robot.wheel_radius_m / _rolling_m(robot, ahead, speed)
    if not own:  # whose wheels are what its file says
        robot = _settled(replace(robot, contact_radius_m=radius))
    if robot.drive == "skid_steer" and key.robot.track_ratio is None:
        turn = min(TRY_TURN, robot.speed_limit[1] / 2)
        for _ in range(3):
            _, turned = _driven(robot, 0.0, turn)
            if not turned > 0.02 * turn:
                raise _unfit("its wheels do not turn it on the spot")
            robot = replace(robot, turn_track_m=robot.turn_track_m * turn / turned)
    return robot


def _rolling_m(robot: RobotModel, ahead_mps: float, speed_mps: float) -> float:
    """Return its wheels' rolling radius, from how fast it drives at a commanded speed."""
    if not 0.5 * speed_mps < ahead_mps < 2 * speed_mps:
        raise _unfit(f"it drives {ahead_mps:.2f} m/s where {speed_mps:.2f} m/s is commanded")
    return robot.wheel_radius_m * ahead_mps / speed_mps


def _settled(robot: RobotModel) -> RobotModel:
    """Return the robot with the height at which it comes to rest."""
    model = build_robot_alone(replace(robot, rest_z_m=robot.contact_radius_m), TIMESTEP_S)
    data = mujoco.MjData(model)
    _run(model, data, SETTLE_S)
    _, x, y, _ = data.qpos[3:7]
    tilt = float(np.arccos(np.clip(1 - 2 * (x * x + y * y), -1, 1)))
    if not np.isfinite(data.qpos).all() or tilt > MAX_TILT_RAD:
        raise _unfit(f"standing still it tips over, by {np.degrees(tilt):.0f} degrees")
    return replace(robot, rest_z_m=float(data.qpos[2]))


def driven_actions(
    robot: RobotModel, actions: Sequence[tuple[float, float]], friction: float
) -> list[dict[str, float]]:
    """Return the steady speeds (m/s, rad/s) of each action on a floor of this friction."""
    rows = []
    for speed, turn in actions:
        ahead, turned = _driven(robot, speed, turn, friction)
        rows.append(
            {
                "speed_mps": speed,
                "yaw_rate_radps": turn,
                "driven_mps": round(ahead, 3) + 0.0,
                "driven_radps": round(turned, 3) + 0.0,
            }
        )
    return rows


def measured(model: RobotModel, robot: Robot | None) -> list[tuple[str, Any, str]]:
    """Return a robot's values in the twin as rows of name, value and source."""
    own = robot is not None and robot.mjcf is not None
    lidar = Lidar() if robot is None else robot.lidar
    of_file = ("wheel_radius_m", "track_m", "wheelbase_m", "mass_kg", "lidar.z_m")
    values: dict[str, Any] = {
        "drive": model.drive,
        "own_model": own or None,
        "wheel_radius_m": model.wheel_radius_m,
        "track_m": model.track_m,
        "wheelbase_m": model.wheelbase_m or None,
        "mass_kg": model.mass_kg,
        "min_turning_radius_m": model.min_turning_radius_m or None,
        "max_steering_rad": model.max_steering_rad or None,
        "track_ratio": model.turn_track_m / model.track_m,
        "lidar.z_m": model.lidar_z_m,
        "lidar.beams": len(model.bearings_rad),
        "lidar.angle_min_rad": lidar.angle_min_rad,
        "lidar.angle_max_rad": lidar.angle_max_rad,
        "max_speed_mps": _known(model.speed_limit[0]),
        "max_yaw_rate_radps": _known(model.speed_limit[1]),
        "max_accel_mps2": model.accel_limit[0],
        "max_yaw_accel_radps2": None if model.steers else model.accel_limit[1],
        "max_steering_rate_radps": model.steering_rate_radps if model.steers else None,
    }
    rows = []
    for name, value in values.items():
        if value is None:
            continue
        if robot is None:
            origin = "the twin's own"
        elif own and name in of_file:
            origin = "mjcf"
        elif name == "min_turning_radius_m":
            origin = "wheelbase_m, max_steering_rad"
        elif name.startswith("lidar.angle") and lidar == Lidar(beams=lidar.beams, z_m=lidar.z_m):
            origin = "default"
        elif name == "track_ratio" and not robot.track_ratio:
            origin = "measured"
        else:
            origin = "profile" if name == "own_model" else robot.origin_of(name)
        rows.append((name, round(value, 4) if isinstance(value, float) else value, origin))
    return rows


def outlined(body: Body) -> list[tuple[str, Any, str]]:
    """Return a robot's outline and lidar place as rows of name, value and source."""
    return [
        (f"body.{name}", round(getattr(body, name), 4), "task.body")
        for name in body.__struct_fields__
    ]


def outside(model: RobotModel, body: Body) -> list[str]:
    """Return the parts of a robot that are outside its outline, and by how much."""
    places = {"the lidar": (body.lidar_x_m, 0.0)}
    for number, (x, y) in enumerate(model.casters_m):
        places[f"caster {number + 1}"] = (x + model.axle_x_m, y)
    found = []
    for name, (x, y) in places.items():
        over_m = max(abs(x) - body.length_m / 2, abs(y) - body.width_m / 2)
        if over_m > MIN_OUTSIDE_M:
            found.append(f"{name} is {over_m:.2f} m outside the outline of [task.body]")
    return found


def _known(limit: float) -> float | None:
    return limit if np.isfinite(limit) else None


def _driven(
    robot: RobotModel, speed_mps: float, yaw_rate_radps: float, friction: float = FLOOR_FRICTION
) -> tuple[float, float]:
    """Return the steady speed (m/s) and yaw rate (rad/s) under a command."""
    model = build_robot_alone(robot, TIMESTEP_S)
    for geom in wheels_of(model, robot).geoms:
        model.geom_friction[geom, 0] = friction
    data = mujoco.MjData(model)
    data.qpos[2] = robot.rest_z_m
    steps = round(1.0 / TIMESTEP_S)
    for step in range(steps):  # no faster than it accelerates
        share = np.array((step + 1) / steps)
        _control(robot, model, data, speed_mps * share, yaw_rate_radps * share)
        mujoco.mj_step(model, data)
    _run(model, data, 0.5)
    rows = np.array([_motion(model, data) for _ in range(round(DRIVE_S / TIMESTEP_S))])
    ahead, turned = rows.mean(axis=0)
    return float(ahead), float(turned)


def _control(
    robot: RobotModel, model: mujoco.MjModel, data: mujoco.MjData, speed: F64, turn: F64
) -> None:
    motion = np.array([[[speed, turn]]])  # (1, 1, 2)
    sides = np.stack(robot.wheel_commands(motion[..., 0], motion[..., 1]), axis=-1)
    if robot.steers:
        steering = robot.steering_for(motion, np.zeros((1, 1)))
        values = [*sides[0, 0], *robot.front_angles(steering)[0, 0]]
    else:
        values = [*np.tile(sides[0, 0], len(robot.wheels_m) // 2)]
    data.ctrl[list(actuator_places(model, robot))] = values


def _motion(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[float, float]:
    """Step the physics once; return forward speed (m/s) and yaw rate (rad/s)."""
    mujoco.mj_step(model, data)
    w, x, y, z = data.qpos[3:7]
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return float(np.cos(yaw) * data.qvel[0] + np.sin(yaw) * data.qvel[1]), float(data.qvel[5])


def _run(model: mujoco.MjModel, data: mujoco.MjData, seconds: float) -> None:
    for _ in range(round(seconds / TIMESTEP_S)):
        mujoco.mj_step(model, data)


def _unfit(problem: str) -> ConfigError:
    return ConfigError(
        f"`robot`: {problem}",
        where="the twin",
        remedy="check its wheels, casters_m and mass_kg, and the outline in [task.body]",
    )
