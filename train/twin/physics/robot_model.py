"""The robot that the twin builds from a profile's `[robot]`, and its grip on the floor.

`stand_in` is the twin's own robot, used if a profile has no `[robot]`. `design` builds a robot from
`[robot]`. Values that it omits are estimated from the outline's size, by what is usual for wheeled
robots, and motors are as strong for their load as the stand-in's. How a designed robot stands,
rolls and turns is then measured (`restock.train.twin.physics.model`).

The contact parameters of wheels are measured, not guessed. Stiff contacts chatter when they slide,
and do not converge as the timestep gets smaller; these soft contacts do (see docs/twin.md).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from restock.arrays import F64, Bools, Ints, stacked
from restock.errors import ConfigError
from restock.ingest.task.robot import USUAL_STEERING_RAD, Drive, Lidar, Robot
from restock.ingest.task.task import Body
from restock.train.twin.floors.layout import NO_PATCH, PATCHES

FLOOR_FRICTION = 0.8
FLOOR = [FLOOR_FRICTION, 0.005, 0.0001]  # sliding, torsion (m), rolling (m)
SLIPPERY_BELOW = 0.3  # friction under which a wheel counts as on a patch
SOFT = {"solref": [0.02, 1], "solimp": [0, 0.95, 0.004, 0.5, 2]}  # wheels and casters

# Groups of geoms. Lidar rays hit only the first group; groups after the last are hidden.
OBSTACLE_GROUP, ROBOT_GROUP, FLOOR_GROUP, DRAWN_GROUP = 0, 1, 2, 3


def _mask(kind: int, touches: int) -> dict[str, int]:
    return {"contype": kind, "conaffinity": touches}


# Wheels and casters touch only the floor. The chassis touches racks, walls, pallets and traffic.
FLOOR_MASK, ROLLING_MASK = _mask(1, 0), _mask(0, 1)
OBSTACLE_MASK, CHASSIS_MASK = _mask(2, 0), _mask(0, 2)
NO_MASK = _mask(0, 0)


class FloorFriction:
    """Friction under the wheels of N robots: the floor's or a patch's, times a factor per wheel.

    It is looked up at the wheels' positions and written into the batch's geoms.
    """

    def __init__(self, geom_friction: F64, wheel_geoms: Sequence[int], wheels_m: F64) -> None:
        """Take the batch's `geom_friction` (N, geoms, 3) and the wheels' positions (W, 2)."""
        self._written, self._geoms, self._wheels_m = geom_friction, wheel_geoms, wheels_m
        count = len(geom_friction)
        self.patches = np.tile(NO_PATCH, (count, PATCHES, 1)).astype(np.float64)
        self.base = np.full(count, FLOOR_FRICTION)  # friction of the floor outside patches
        self.scale = np.ones((count, len(wheels_m)))  # factor under each wheel
        self.icy: Ints = np.zeros(0, np.int64)  # the environments that have patches

    def lay(self, env: int, patches: F64) -> None:
        """Lay the patches (PATCHES, 5) of an episode."""
        self.patches[env] = patches
        self.icy = np.flatnonzero((self.patches[..., 2] > 0).any(axis=1))

    def set_floor(self, env: int, friction: float) -> None:
        """Set the floor's friction coefficient outside patches."""
        self.base[env] = friction
        self._written[env, self._geoms, 0] = friction * self.scale[env]

    def write(self, ids: Ints, pose: F64) -> Bools:
        """Write the friction under the wheels of `ids` at poses (n, 3).

        Returns which wheels (n, W) stand on a patch.
        """
        base = self.base[ids]
        friction = friction_at(self._wheel_points(pose), self.patches[ids], base)
        self._written[ids[:, None], self._geoms, 0] = friction * self.scale[ids]
        return np.asarray(friction < np.minimum(SLIPPERY_BELOW, base[:, None] - 1e-9), np.bool_)

    def _wheel_points(self, pose: F64) -> F64:
        """Return the positions (n, W, 2) of the wheels of robots at poses (n, 3)."""
        cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        x, y = self._wheels_m[:, 0, None], self._wheels_m[:, 1, None]
        points: F64 = pose[:, None, :2] + stacked(-sin, cos)[:, None] * y
        return points if len(self._wheels_m) == 2 else points + stacked(cos, sin)[:, None] * x


def friction_at(points_m: F64, patches: F64, base: F64) -> F64:
    """Return the friction (N, K) at points (N, K, 2), from patches (N, P, 5) and base (N,).

    A patch row is x, y, half x, half y (metres) and its friction coefficient. If patches overlap,
    the most slippery one counts.
    """
    gap = np.abs(points_m[:, :, None, :] - patches[:, None, :, 0:2])  # (N, K, P, 2)
    inside = (gap <= patches[:, None, :, 2:4]).all(axis=-1)
    slippery = np.where(inside, patches[:, None, :, 4], np.inf).min(axis=-1)
    friction: F64 = np.minimum(slippery, base[:, None])
    return friction


WHEEL_RADIUS_M = 0.10  # the stand-in's radius; all constants up to REST_Z_M are the stand-in's
TRACK_M = 0.44  # distance between the wheels' contact points
CASTER_RADIUS_M = 0.04
CASTER_X_M = 0.27
CASTER_KG = 0.5
WHEEL_KG = 2.0
CHASSIS_KG = 50.0
CHASSIS_HEIGHT_M = 0.26
CHASSIS_Z_M = 0.17  # height of the chassis' middle above the floor
LIDAR_Z_M = 0.22
LIDAR_BEAMS = 72
MOTOR_KV = 8.0
MOTOR_LIMIT_NM = 18.0
ARMATURE, DAMPING = 0.02, 0.05
ACCEL_LIMIT = (4.0, 10.0)  # m/s2 and rad/s2
REST_Z_M = 0.09756  # height of the chassis frame at rest

USUAL_ACCEL = (2.5, 6.0)  # default limits, m/s2 and rad/s2
STIFF = 8.0  # factor on motors' gain if wheels scrub: they need torque even at the set speed
SCRUB = 1.5  # factor on motors' torque limit if wheels scrub
USUAL_STEERING_RADPS = 2.0  # default limit of the steering rate


@dataclass(frozen=True)
class RobotModel:
    """A robot with two or four wheels; x is ahead of the axle, z above the floor.

    The axle of a robot that steers (ackermann) is the rear one, whose wheels are driven. For other
    robots with two axles, it is the line halfway between them.
    """

    length_m: float
    width_m: float
    axle_x_m: float  # position of the axle ahead of the outline's middle
    wheel_radius_m: float  # rolling radius, which odometry uses too
    contact_radius_m: float  # radius of the wheels' spheres, which sink into the floor a little
    track_m: float  # distance between the wheels' contact points
    turn_track_m: float  # effective track, from which controller and odometry compute turns
    wheelbase_m: float  # distance between two axles; 0 if there is one
    wheel_kg: float
    chassis_kg: float
    chassis_height_m: float
    chassis_z_m: float  # height of the chassis' middle
    ballast: bool  # the chassis' mass is in its lower half
    casters_m: tuple[tuple[float, float], ...]
    caster_radius_m: float
    caster_kg: float
    lidar_z_m: float
    bearings_rad: tuple[float, ...]  # bearings of the beams in the lidar's own frame
    motor_kv: float
    motor_limit_nm: float
    armature: float
    damping: float
    accel_limit: tuple[float, float]  # m/s2 and rad/s2 of the base controller's ramp
    speed_limit: tuple[float, float]  # m/s and rad/s
    rest_z_m: float  # height of the chassis frame at rest
    drive: Drive = "differential"
    max_steering_rad: float = 0.0
    steering_rate_radps: float = 0.0

    @property
    def wheels_m(self) -> F64:
        """Return x and y of every wheel (W, 2): left before right, front before rear."""
        axles = (0.0,) if not self.wheelbase_m else (self.wheelbase_m / 2, -self.wheelbase_m / 2)
        if self.steers:
            axles = (self.wheelbase_m, 0.0)
        half = self.track_m / 2
        return np.array([(x, y) for x in axles for y in (half, -half)])

    @property
    def steers(self) -> bool:
        """Return whether the front wheels steer; then only the rear wheels are driven."""
        return self.drive == "ackermann"

    @property
    def min_turning_radius_m(self) -> float:
        """Return the radius of the tightest circle, in metres; 0 if the robot turns on the spot."""
        return self.wheelbase_m / math.tan(self.max_steering_rad) if self.steers else 0.0

    @property
    def mass_kg(self) -> float:
        wheels = len(self.wheels_m) * self.wheel_kg
        return self.chassis_kg + wheels + len(self.casters_m) * self.caster_kg

    def wheel_commands(self, speed_mps: F64, yaw_rate_radps: F64) -> tuple[F64, F64]:
        """Convert body velocity to left and right wheel speeds in rad/s, at the nominal radius."""
        turn = yaw_rate_radps * (self.turn_track_m / 2)
        return (speed_mps - turn) / self.wheel_radius_m, (speed_mps + turn) / self.wheel_radius_m

    def body_velocity(self, left_radps: F64, right_radps: F64) -> tuple[F64, F64]:
        """Convert wheel speeds in rad/s to speed (m/s) and yaw rate (rad/s): wheel odometry."""
        speed = (left_radps + right_radps) * (self.wheel_radius_m / 2)
        return speed, (right_radps - left_radps) * (self.wheel_radius_m / self.turn_track_m)

    def by_side(self, wheels: F64) -> F64:
        """Return means of the left and right wheels (N, 2), only of the rear ones if it steers."""
        if self.steers:
            return wheels[:, 2:]
        return wheels if wheels.shape[1] == 2 else wheels.reshape(-1, 2, 2).mean(axis=1)

    # -- steering -------------------------------------------------------------------------------

    def steering_for(self, motion: F64, held_rad: F64) -> F64:
        """Return steering angles (...) for speeds and yaw rates (..., 2); `held_rad` at a stop.

        A turn on the spot, which is impossible, gets the maximum angle.
        """
        speed, turn = motion[..., 0], motion[..., 1]
        rolls = np.abs(speed) > 1e-6
        angle = np.arctan(self.wheelbase_m * turn / np.where(rolls, speed, 1.0))
        angle = np.where(rolls, angle, np.where(turn != 0, np.sign(turn) * np.pi, held_rad))
        return np.clip(angle, -self.max_steering_rad, self.max_steering_rad)

    def yaw_rate(self, speed_mps: F64, steering_rad: F64) -> F64:
        """Return yaw rates in rad/s by the kinematic bicycle model."""
        return np.asarray(speed_mps * np.tan(steering_rad) / self.wheelbase_m)

    def front_angles(self, steering_rad: F64) -> F64:
        """Return the left and right front wheels' angles (..., 2): both turn about one centre."""
        tangent, half = np.tan(steering_rad) / self.wheelbase_m, self.track_m / 2
        return np.stack(
            [
                np.arctan(self.wheelbase_m * tangent / (1 - tangent * half)),
                np.arctan(self.wheelbase_m * tangent / (1 + tangent * half)),
            ],
            axis=-1,
        )


def stand_in(body: Body, beams: int = LIDAR_BEAMS) -> RobotModel:
    """Return the twin's own robot with this outline."""
    bearings = np.arange(beams) * (2 * np.pi / beams) - np.pi
    return RobotModel(
        length_m=body.length_m,
        width_m=body.width_m,
        axle_x_m=0.0,
        wheel_radius_m=WHEEL_RADIUS_M,
        contact_radius_m=WHEEL_RADIUS_M,
        track_m=TRACK_M,
        turn_track_m=TRACK_M,
        wheelbase_m=0.0,
        wheel_kg=WHEEL_KG,
        chassis_kg=CHASSIS_KG,
        chassis_height_m=CHASSIS_HEIGHT_M,
        chassis_z_m=CHASSIS_Z_M,
        ballast=False,
        casters_m=((CASTER_X_M, 0.0), (-CASTER_X_M, 0.0)),
        caster_radius_m=CASTER_RADIUS_M,
        caster_kg=CASTER_KG,
        lidar_z_m=LIDAR_Z_M,
        bearings_rad=tuple((bearings + np.pi / beams).tolist()),
        motor_kv=MOTOR_KV,
        motor_limit_nm=MOTOR_LIMIT_NM,
        armature=ARMATURE,
        damping=DAMPING,
        accel_limit=ACCEL_LIMIT,
        speed_limit=(math.inf, math.inf),
        rest_z_m=REST_Z_M,
    )


def design(robot: Robot, body: Body) -> RobotModel:
    """Design a profile's robot from its dimensions, without trying it in the physics.

    Raises:
        ConfigError: its parts do not fit together.
    """
    known = measures(robot, body)
    radius, track, mass = known.wheel_radius_m, known.track_m, known.mass_kg
    height, casters = known.height_m, known.casters_m
    _refuse_misfit(known, body, robot.axle_x_m)
    scrubs, steers = robot.drive == "skid_steer", robot.drive == "ackermann"
    wheels = 4 if known.wheelbase_m else 2
    driven = 2 if steers else wheels
    wheel_kg, caster_kg = 0.072 / wheels * mass, 0.009 * mass
    # The pose of a robot that steers is its rear axle's.
    behind = known.wheelbase_m / 2 if steers else 0.0
    # Motors are the stand-in's, scaled by the share of the load that each one moves.
    load = mass / (CHASSIS_KG + 2 * WHEEL_KG + 2 * CASTER_KG) * 2 / driven
    turning = load * (radius / WHEEL_RADIUS_M) ** 2
    low = 0.13 * height
    return RobotModel(
        length_m=body.length_m,
        width_m=body.width_m,
        axle_x_m=robot.axle_x_m - behind,
        wheel_radius_m=radius,
        contact_radius_m=radius,
        track_m=track,
        turn_track_m=track * (robot.track_ratio or 1.0),
        wheelbase_m=known.wheelbase_m,
        wheel_kg=wheel_kg,
        chassis_kg=mass - wheels * wheel_kg - len(casters) * caster_kg,
        chassis_height_m=height - low,
        chassis_z_m=(height + low) / 2,
        ballast=True,
        casters_m=tuple((x + behind, y) for x, y in casters),
        caster_radius_m=0.4 * radius,
        caster_kg=caster_kg,
        lidar_z_m=known.lidar_z_m,
        bearings_rad=_bearings(robot.lidar, known.beams),
        motor_kv=MOTOR_KV * turning * (STIFF if scrubs else 1.0),
        motor_limit_nm=MOTOR_LIMIT_NM * load * radius / WHEEL_RADIUS_M * (SCRUB if scrubs else 1.0),
        armature=ARMATURE * turning,
        damping=DAMPING * turning,
        accel_limit=(
            robot.max_accel_mps2 or USUAL_ACCEL[0],
            robot.max_yaw_accel_radps2 or USUAL_ACCEL[1],
        ),
        speed_limit=(robot.max_speed_mps or math.inf, robot.max_yaw_rate_radps or math.inf),
        rest_z_m=radius,
        drive=robot.drive,
        max_steering_rad=(robot.max_steering_rad or USUAL_STEERING_RAD) if steers else 0.0,
        steering_rate_radps=robot.max_steering_rate_radps or USUAL_STEERING_RADPS,
    )


@dataclass(frozen=True)
class Measures:
    """The dimensions of a robot, from its profile or estimated from its outline."""

    wheel_radius_m: float
    track_m: float
    wheelbase_m: float  # 0 if there is one axle
    mass_kg: float
    height_m: float
    casters_m: tuple[tuple[float, float], ...]
    lidar_z_m: float
    beams: int


def measures(robot: Robot, body: Body) -> Measures:
    """Return a robot's dimensions; those that its profile omits are estimated from its outline."""
    size = math.sqrt(body.length_m * body.width_m)
    height = robot.height_m or max(0.5 * size, 2.2 * (robot.wheel_radius_m or 0.0))
    # An action has no sideways speed, so an omnidirectional robot drives as a differential one.
    four = robot.drive in ("skid_steer", "ackermann")
    casters = robot.casters_m
    if casters is None:
        ahead, x = 0.77 * body.length_m / 2, robot.axle_x_m
        casters = () if four else ((ahead - x, 0.0), (-ahead - x, 0.0))
    span = robot.lidar.angle_max_rad - robot.lidar.angle_min_rad
    return Measures(
        wheel_radius_m=robot.wheel_radius_m or 0.15 * size,
        track_m=robot.track_m or 0.87 * body.width_m,
        wheelbase_m=(robot.wheelbase_m or 0.55 * body.length_m) if four else 0.0,
        mass_kg=robot.mass_kg or 120.0 * size**3,
        height_m=height,
        casters_m=casters,
        lidar_z_m=robot.lidar.z_m or min(0.73 * height, 0.5),
        beams=robot.lidar.beams or max(round(LIDAR_BEAMS * span / (2 * math.pi)), 4),
    )


def _bearings(lidar: Lidar, beams: int) -> tuple[float, ...]:
    """Return evenly spaced bearings of beams, both ends included; a full turn omits its end."""
    span = lidar.angle_max_rad - lidar.angle_min_rad
    around = span > 2 * math.pi * (1 - 0.5 / beams)
    step = span / beams if around else span / (beams - 1)
    return tuple((lidar.angle_min_rad + step * np.arange(beams)).tolist())


def _refuse_misfit(robot: Measures, body: Body, axle_x_m: float) -> None:
    """Raise ConfigError for parts that do not fit together."""
    problem = None
    if 2 * robot.wheel_radius_m > 1.5 * body.length_m:
        problem = f"wheels of radius {robot.wheel_radius_m:g} m are longer than the outline"
    elif robot.track_m > 2 * body.width_m:
        problem = f"a track of {robot.track_m:g} m is more than twice the outline's width"
    elif abs(axle_x_m) > body.length_m / 2:
        problem = f"an axle {axle_x_m:g} m ahead of the middle is outside the outline"
    elif robot.wheelbase_m > body.length_m:
        problem = f"a wheelbase of {robot.wheelbase_m:g} m is longer than the outline"
    if problem:
        raise ConfigError(
            f"`robot`: {problem} ({body.length_m:g} x {body.width_m:g} m)",
            where="the twin",
            remedy="correct [robot], or the outline in [task.body]",
        )
