"""The small tables of a profile: clock, episodes, frames, motion, zones and cameras."""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from restock.toml import Checked


class Clock(Checked, frozen=True):
    """The `[clock]` of a profile: what time is, and when the steps are."""

    alignment: Literal["header.stamp", "log_time"] = "header.stamp"
    steps: Literal["rate", "command"] = "rate"
    max_gap_s: Annotated[float, Meta(gt=0)] = 0.5  # longest gap between two steps of an episode
    # Change of (log time - stamp) that means the clock was set.
    jump_s: Annotated[float, Meta(gt=0)] = 1.0


class Episodes(Checked, frozen=True):
    """The `[episodes]` of a profile: what ends one, beside goals, gaps and clock jumps."""

    # Larger: the robot was carried, or relocalised.
    max_pose_jump_m: Annotated[float, Meta(gt=0)] = 1.0
    # Distance from the last goal that means a new one.
    goal_moved_m: Annotated[float, Meta(ge=0)] = 0.01
    # A plan that ends further from the goal is for another one.
    plan_goal_tolerance_m: Annotated[float, Meta(ge=0)] = 0.5


class Frames(Checked, frozen=True):
    """The `[frames]` of a profile: poses are of `base` in `fixed`."""

    fixed: str = "map"
    base: str = "base_link"
    max_age_s: Annotated[float, Meta(gt=0)] = 0.5  # age of a transform at the step, at most
    topic: str = "/tf"
    static_topic: str = "/tf_static"

    def check(self) -> None:
        if self.fixed.strip("/") == self.base.strip("/"):
            raise ValueError(f"fixed and base are the same frame: {self.base!r}")


class Motion(Checked, frozen=True):
    """The `[motion]` of a profile: how its speeds are known where there is no odometry."""

    window_s: Annotated[float, Meta(gt=0, le=5)]  # length of the window of poses for a speed


class Zone(Checked, frozen=True, omit_defaults=True):  # a profile's hash has what is given
    """A named rectangle of the map.

    `box_m = [x0, y0, x1, y1]` is turned about its middle by `yaw_rad`, counter-clockwise.
    """

    name: str
    box_m: tuple[float, float, float, float]
    yaw_rad: Annotated[float, Meta(ge=-7, le=7)] | None = None  # defaults are known by identity

    def check(self) -> None:
        x0, y0, x1, y1 = self.box_m
        if not (x0 < x1 and y0 < y1):
            raise ValueError(f"box_m must be [x0, y0, x1, y1] with x0 < x1 and y0 < y1: {self}")

    def holds(self, x_m: NDArray[Any], y_m: NDArray[Any]) -> NDArray[np.bool_]:
        """Return which points (N,) lie in it, its edges included."""
        x0, y0, x1, y1 = self.box_m
        if self.yaw_rad:
            middle_x, middle_y = (x0 + x1) / 2, (y0 + y1) / 2
            cos, sin = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
            dx, dy = x_m - middle_x, y_m - middle_y
            x_m, y_m = middle_x + cos * dx + sin * dy, middle_y + cos * dy - sin * dx
        return np.asarray((x_m >= x0) & (x_m <= x1) & (y_m >= y0) & (y_m <= y1), np.bool_)


class Camera(Checked, frozen=True):
    """One `[cameras.NAME]` of a profile: a topic of sensor_msgs Image or CompressedImage."""

    topic: str
    max_age_s: Annotated[float, Meta(gt=0)] = 0.5  # age of the last frame at the step, at most
    max_hz: Annotated[float, Meta(gt=0)] | None = None  # frames kept per second; None: all
    doc: str = ""


def camera_name_problem(name: str) -> str | None:
    """Say why a camera may not have this name; None if it may."""
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,63}", name):
        return "a name consists of lower-case letters, digits and _, and begins with a letter"
    return None
