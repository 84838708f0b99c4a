"""The tables of a profile: clock, episodes, frames, motion, zones, cameras and custom signals.

A custom signal is a value of any topic that becomes a column of the transitions:
`[signals.battery_v]` of a profile names the column `battery_v` and says where it comes from. At
every step it is the latest value of the topic (at or before the step, at most `max_age_s` old), or
null. Conditions and queries see it as they see Restock's own signals; observation and reward do
not.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, Literal

import duckdb
import numpy as np
import pyarrow as pa
from msgspec import Meta
from numpy.typing import NDArray

from restock.errors import StoreError
from restock.ingest.profile.signal_paths import PathProblem, SignalPath
from restock.ingest.profile.tag_rules import NAMED
from restock.ingest.task.schema import COLUMNS
from restock.toml import Checked

if TYPE_CHECKING:
    from restock.ingest.decoding.columns import Leaf


class Clock(Checked, frozen=True):
    """The `[clock]` of a profile: what time is, and when the steps are."""

    alignment: Literal["header.stamp", "log_time"] = "header.stamp"
    steps: Literal["rate", "command"] = "rate"
    max_gap_s: Annotated[float, Meta(gt=0)] = 0.5  # longest gap between two steps of an episode


class Episodes(Checked, frozen=True):
    """The `[episodes]` of a profile: what ends one, beside goals, gaps and clock jumps."""

    # Larger: the robot was carried, or relocalised.
    max_pose_jump_m: Annotated[float, Meta(gt=0)] = 1.0


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


Reduce = Literal["min", "max", "mean", "sum", "count", "yaw"]
NUMBER = pa.float64()
LIST = pa.list_(pa.field("element", pa.float32()))
# Columns that a store's views add to a transition's, and that labelling adds.
_TAKEN = {
    *("logged_ns", "stamp_time", "logged_time", "pose_stamp_time", "tags", *NAMED, "row_"),
    *(column.name for column in COLUMNS),
}
QUATERNION = ("x", "y", "z", "w")


class CustomSignal(Checked, frozen=True):
    """One `[signals.NAME]` of a profile."""

    topic: str
    type: str
    path: str  # see `restock.ingest.profile.signal_paths`
    unit: str  # "V", "m", "1", …
    max_age_s: Annotated[float, Meta(gt=0)] | None = (
        None  # None: latched, held until the next message
    )
    reduce: Reduce | None = None  # how a list becomes one number, or a quaternion its yaw
    values: dict[str, float] | None = None  # the number for each text, bool or number
    scale: float = 1.0  # stored value = value * scale + offset
    offset: float = 0.0
    length: Annotated[int, Meta(ge=1, le=65536)] | None = None  # length of a vector
    doc: str = ""

    def check(self) -> None:
        try:
            path = SignalPath.read(self.path)
        except PathProblem as problem:
            raise ValueError(f"path {self.path!r} {problem}") from None
        if self.reduce is None and path.lists > 1:
            raise ValueError(
                f"path {self.path!r} gives lists of lists: choose one element, or give reduce"
            )
        if self.reduce == "yaw" and path.lists:
            raise ValueError(
                f'path {self.path!r} gives a list: reduce = "yaw" takes one quaternion'
            )
        if self.reduce not in (None, "yaw") and not path.lists:
            raise ValueError(f"path {self.path!r} gives one value: there is nothing to reduce")
        if self.length is not None and not self.is_list:
            raise ValueError(
                f"path {self.path!r} gives one value: the length of a vector needs a list"
            )
        if not self.unit:
            raise ValueError('unit is empty: write "1" for a quantity without a unit')

    @property
    def read(self) -> SignalPath:
        return SignalPath.read(self.path)

    @property
    def ends(self) -> tuple[str, ...]:
        """Return the fields to read of the message at the end of the path, if it is a message."""
        return QUATERNION if self.reduce == "yaw" else ()

    @property
    def is_list(self) -> bool:
        return self.reduce is None and self.read.lists > 0

    @property
    def picks(self) -> bool:
        """Return whether it means one certain element, which a message may lack."""
        return any(s.choice is not None and not s.choice.many for s in self.read.steps)

    def wanted(self) -> list[str]:
        """Return the field paths to read for it."""
        return self.read.wanted(*self.ends)

    def field(self, name: str) -> pa.Field:
        """Return its column, with unit and source in the metadata."""
        about = {"unit": self.unit, "topic": self.topic, "path": self.path, "meaning": self.doc}
        about |= {"length": str(self.length or "")}
        kind = LIST if self.is_list else NUMBER
        return pa.field(name, kind, nullable=True, metadata={k: v for k, v in about.items() if v})

    def problem(self, leaves: Sequence[Leaf]) -> str | None:
        """Say why messages with these fields lack it; None if they have it."""
        try:
            kinds = self.read.check(leaves, *self.ends)
        except PathProblem as problem:
            return str(problem)
        if self.reduce == "yaw" and "string" in kinds:
            return "is not a quaternion"
        return None


def name_problem(name: str) -> str | None:
    """Say why a custom signal may not have this name; None if it may."""
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        return "a name consists of lower-case letters, digits and _"
    if name in _TAKEN:
        return "Restock has a column of this name: choose another name"
    if name in _reserved():
        return "this name is a keyword of SQL: choose another name"
    return None


def refuse_other_signals(have: Mapping[str, Any], schema: pa.Schema, where: str) -> None:
    """See that a store's columns of custom signals mean what rows of this schema mean by them.

    `have` are the fields of the store's table, as deltalake gives them.

    Raises:
        StoreError: one of the same name has another type or unit.
    """
    for field in schema:
        unit = (field.metadata or {}).get(b"unit")
        stored = have.get(field.name)
        if unit is None or stored is None:
            continue
        length = (field.metadata or {}).get(b"length", b"").decode()
        kind = _kind(field.type == LIST, length)
        stored_kind = _kind(
            "Array" in type(stored.type).__name__, str(stored.metadata.get("length", ""))
        )
        stored_unit = stored.metadata.get("unit", "")
        if (kind, unit.decode()) != (stored_kind, stored_unit):
            raise StoreError(
                f"its column `{field.name}` is a {stored_kind} in {stored_unit or '1'},"
                f" and `signals.{field.name}` of the profile a {kind} in {unit.decode()}",
                where=where,
                remedy="rename the signal in the profile, or use another store",
            )


def _kind(is_list: bool, length: str) -> str:
    return (f"vector of {length}" if length else "list") if is_list else "number"


@cache
def _reserved() -> set[str]:
    with duckdb.connect() as connection:
        rows = connection.sql(
            "SELECT keyword_name FROM duckdb_keywords() WHERE keyword_category = 'reserved'"
        ).fetchall()
    return {name for (name,) in rows}
