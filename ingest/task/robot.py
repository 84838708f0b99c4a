"""The `[robot]` table of a profile: how the robot drives, how large and heavy its parts are.

Its outline, and where its lidar is on it, stand in `[task.body]`, which logs need too; here is what
only the twin needs. A value that is left out is unknown: the twin takes one from the outline's size
(`restock.train.twin.physics.robot_model`), and says so. `[robot.origin]` says where each value is
from.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from restock.errors import ConfigError
from restock.toml import Checked

Drive = Literal["differential", "skid_steer", "omnidirectional", "ackermann"]
# Where a value is from: written by hand, a recording's description, a URDF file, a fit of the twin,
# what logs show, or the outline's size.
Origin = Literal["profile", "robot_description", "urdf", "fit", "logs", "default"]
Metres = Annotated[float, Meta(gt=0, le=10)]
Limit = Annotated[float, Meta(gt=0, le=100)]
OUTLINE = "outline"  # in [robot.origin]: of [task.body]
USUAL_STEERING_RAD = 0.6  # of a robot that steers, where nothing says


class Lidar(Checked, frozen=True):
    """The `[robot.lidar]` of a profile: its beams, in the lidar's own frame.

    Where it is ahead of the outline's middle, and how it is turned, stand in `[task.body]`.
    """

    z_m: Annotated[float, Meta(gt=0, le=5)] | None = None  # height above the floor
    beams: Annotated[int, Meta(ge=4, le=720)] | None = None  # evenly spaced, from angle_min_rad on
    angle_min_rad: Annotated[float, Meta(ge=-7, le=7)] = -math.pi
    angle_max_rad: Annotated[float, Meta(ge=-7, le=7)] = math.pi  # full circle: less by one beam

    def check(self) -> None:
        if not 0 < self.angle_max_rad - self.angle_min_rad <= 2 * math.pi + 1e-3:
            raise ValueError(
                "angle_max_rad must be greater than angle_min_rad, by at most a full turn; got "
                f"{self.angle_min_rad:g} and {self.angle_max_rad:g}"
            )


class Robot(Checked, frozen=True):
    """The `[robot]` of a profile. None: unknown."""

    drive: Drive = "differential"
    wheel_radius_m: Metres | None = None
    track_m: Metres | None = None  # distance of left and right wheels' contact points
    wheelbase_m: Metres | None = None  # distance of the axles, if there are two
    axle_x_m: Annotated[float, Meta(ge=-10, le=10)] = 0.0  # x of the axle (of two: their middle)
    # ahead of the outline's middle: poses are the axle's
    mass_kg: Annotated[float, Meta(gt=0, le=5000)] | None = None  # total, with wheels
    height_m: Metres | None = None
    casters_m: tuple[tuple[float, float], ...] | None = None  # x ahead of the axle, y to the left
    max_speed_mps: Limit | None = None
    max_yaw_rate_radps: Limit | None = None
    max_accel_mps2: Limit | None = None
    max_yaw_accel_radps2: Limit | None = None
    # Of a robot that steers (ackermann): the angle of the wheel that would stand in the middle of
    # its front axle, to either side, and how fast it changes.
    max_steering_rad: Annotated[float, Meta(gt=0.01, le=1.4)] | None = None
    max_steering_rate_radps: Limit | None = None
    # How far the driven wheels are apart for the controller and its odometry, by the track: a skid-
    # steer robot turns less than its wheels say. None: what the twin's own robot does.
    track_ratio: Annotated[float, Meta(ge=0.5, le=10)] | None = None
    # A model of one's own in the built one's place: a file beside the profile; its text, once read.
    mjcf: str | None = None
    lidar: Lidar = Lidar()
    origin: dict[str, Origin] = msgspec.field(default_factory=dict)

    def check(self) -> None:
        lidar = (f"lidar.{name}" for name in Lidar.__struct_fields__)
        known = {*self.__struct_fields__, *lidar, OUTLINE}
        for name in self.origin:
            if name not in known or name in ("origin", "lidar"):
                raise ValueError(f"origin refers to a value that the robot does not have: {name!r}")
        if self.wheelbase_m is None and self.drive == "ackermann":
            raise ValueError("an ackermann robot needs wheelbase_m")
        if self.drive != "ackermann" and (self.max_steering_rad or self.max_steering_rate_radps):
            raise ValueError(
                f"a robot with {self.drive} drive does not steer: leave out max_steering_*"
            )

    @property
    def outline_guessed(self) -> bool:
        """Return whether nobody measured the outline."""
        return self.origin.get(OUTLINE) == "default"

    @property
    def min_turning_radius_m(self) -> float:
        """Return the radius of the pose's circle at full steering; 0 if it turns on the spot."""
        if self.drive != "ackermann" or self.wheelbase_m is None:
            return 0.0
        return self.wheelbase_m / math.tan(self.max_steering_rad or USUAL_STEERING_RAD)

    def origin_of(self, name: str) -> Origin:
        """Return the source of a value, by its key, such as `mass_kg` or `lidar.beams`."""
        if name in self.origin:
            return self.origin[name]
        value = getattr(self.lidar, name[6:]) if name.startswith("lidar.") else getattr(self, name)
        return "default" if value is None else "profile"


def beyond_limits(robot: Robot, actions: tuple[tuple[float, float], ...]) -> str | None:
    """Describe the first action (m/s, rad/s) that this robot cannot drive."""
    for speed, turn in actions:
        for value, most, name, unit in (
            (speed, robot.max_speed_mps, "max_speed_mps", "m/s"),
            (turn, robot.max_yaw_rate_radps, "max_yaw_rate_radps", "rad/s"),
        ):
            if most is not None and abs(value) > most * (1 + 1e-3):
                return f"[{speed:g}, {turn:g}] is beyond robot.{name} = {most:g} {unit}"
    return None


def refuse_beyond_steering(
    robot: Robot | None, actions: tuple[tuple[float, float], ...], *, where: str
) -> None:
    """Raise ConfigError if an action (m/s, rad/s) turns tighter than this robot can steer."""
    if robot is not None and (problem := _beyond_steering(robot, actions)):
        raise ConfigError(
            f"`task.actions`: {problem}",
            where=where,
            remedy="give the action more speed or a lower yaw rate; or, if the robot can steer "
            "tighter, correct [robot]",
        )


def _beyond_steering(robot: Robot, actions: tuple[tuple[float, float], ...]) -> str | None:
    least = robot.min_turning_radius_m
    for speed, turn in actions if least else ():
        if turn and not speed:
            return (
                f"[{speed:g}, {turn:g}] turns on the spot, which a robot that steers"
                ' (robot.drive = "ackermann") cannot'
            )
        if abs(turn) * least > abs(speed) * (1 + 1e-2):
            return (
                f"[{speed:g}, {turn:g}] turns on a circle of {abs(speed / turn):.3g} m, and the"
                f" robot's tightest has {least:.3g} m (wheelbase_m, max_steering_rad)"
            )
    return None
