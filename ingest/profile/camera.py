"""Cameras of a profile: whose frames are kept beside the rows."""

from __future__ import annotations

import re
from typing import Annotated

from msgspec import Meta

from restock.toml import Checked


class Camera(Checked, frozen=True):
    """One `[cameras.NAME]` of a profile: a topic of sensor_msgs Image or CompressedImage."""

    topic: str
    max_age_s: Annotated[float, Meta(gt=0)] = 0.5  # age of the last frame at the step, at most
    max_hz: Annotated[float, Meta(gt=0)] | None = None  # frames kept per second; None: all
    doc: str = ""


def camera_name_problem(name: str) -> str | None:
    """Why a camera may not have this name, or None."""
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,63}", name):
        return "a name consists of lower-case letters, digits and _, and begins with a letter"
    return None
