"""The tables of a profile: inputs, clock, episodes, frames, motion, zones, cameras, signals.

An input names its topic and the message fields it needs. `FALLBACKS` are what replaces it if it is
missing.

A custom signal is a value of any topic that becomes a column of the transitions:
`[signals.battery_v]` of a profile defines the column `battery_v` and its source. At every step, it
is the topic's latest value (at or before the step, at most `max_age_s` old), or null. Conditions
and queries can use it like Restock's own signals; observation and reward do not contain it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import numpy as np
import pyarrow as pa
from msgspec import Meta
from numpy.typing import NDArray

from restock.errors import ConfigError, StoreError
from restock.ingest.profile.signal_paths import (
    IN,
    UNITS,
    PathProblem,
    SignalPath,
    factor_of,
    last_part,
    pressed_paths,
)
from restock.ingest.profile.tag_rules import NAMED
from restock.ingest.task.schema import COLUMNS
from restock.toml import Checked

if TYPE_CHECKING:
    from restock.ingest.decoding.columns import Leaf


class Clock(Checked, frozen=True):
    """The `[clock]` of a profile: which of a message's times counts, and when steps are taken."""

    alignment: Literal["header.stamp", "log_time"] = "header.stamp"
    steps: Literal["rate", "command"] = "rate"
    max_gap_s: Annotated[float, Meta(gt=0)] = 0.5  # longest gap between two steps of an episode


class Episodes(Checked, frozen=True):
    """The `[episodes]` of a profile: what ends episodes besides goals, gaps and clock jumps."""

    # After a larger jump the robot was carried, or relocalised, so the episode ends.
    max_pose_jump_m: Annotated[float, Meta(gt=0)] = 1.0


class Frames(Checked, frozen=True):
    """The `[frames]` of a profile: take the pose of frame `base` in `fixed` from transforms."""

    fixed: str = "map"
    base: str = "base_link"
    max_age_s: Annotated[float, Meta(gt=0)] = 0.5  # largest age of a transform at the step
    topic: str = "/tf"
    static_topic: str = "/tf_static"

    def check(self) -> None:
        if self.fixed.strip("/") == self.base.strip("/"):
            raise ValueError(f"fixed and base are the same frame: {self.base!r}")


class Motion(Checked, frozen=True):
    """The `[motion]` of a profile: speeds from poses, for robots without odometry."""

    window_s: Annotated[float, Meta(gt=0, le=5)]  # time span of the poses that a speed is fitted to


class Zone(Checked, frozen=True, omit_defaults=True):  # keys at their default do not change a hash
    """A named rectangle of the map.

    `box_m = [x0, y0, x1, y1]` is turned about its middle by `yaw_rad`, counter-clockwise.
    """

    name: str
    box_m: tuple[float, float, float, float]
    # None, not 0.0: msgspec omits a default only if the value is the same object.
    yaw_rad: Annotated[float, Meta(ge=-7, le=7)] | None = None

    def check(self) -> None:
        x0, y0, x1, y1 = self.box_m
        if not (x0 < x1 and y0 < y1):
            raise ValueError(f"box_m must be [x0, y0, x1, y1] with x0 < x1 and y0 < y1: {self}")

    def holds(self, x_m: NDArray[Any], y_m: NDArray[Any]) -> NDArray[np.bool_]:
        """Return which points (N,) lie in the zone or on its edge."""
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
    max_age_s: Annotated[float, Meta(gt=0)] = 0.5  # largest age of a frame at the step
    max_hz: Annotated[float, Meta(gt=0)] | None = None  # frames kept per second; None: all
    doc: str = ""


def camera_name_problem(name: str) -> str | None:
    """Return why a camera may not have this name, or None."""
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,63}", name):
        return "a name consists of lower-case letters, digits and _, and begins with a letter"
    return None


Reduce = Literal["min", "max", "mean", "sum", "count", "yaw"]
NUMBER = pa.float64()
LIST = pa.list_(pa.field("element", pa.float32()))
# Names that custom signals may not have: columns of transitions, of a store's views, of labelling.
_TAKEN = {
    *("logged_ns", "stamp_time", "logged_time", "pose_stamp_time", "tags", *NAMED, "row_"),
    *(column.name for column in COLUMNS),
}
QUATERNION = ("x", "y", "z", "w")


class CustomSignal(Checked, frozen=True):
    """One `[signals.NAME]` of a profile."""

    topic: str
    type: str
    path: str  # syntax: `restock.ingest.profile.signal_paths`
    unit: str  # "V", "m", "1", …
    max_age_s: Annotated[float, Meta(gt=0)] | None = (
        None  # None: latched, held until the next message
    )
    reduce: Reduce | None = None  # how to make one number of a list, or of a quaternion ("yaw")
    values: dict[str, float] | None = None  # maps texts, bools or numbers to numbers
    scale: float = 1.0  # stored value = value * scale + offset
    offset: float = 0.0
    length: Annotated[int, Meta(ge=1, le=65536)] | None = None  # length of lists; None: any
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
        """Return the fields to read below the path's end: those of a quaternion for "yaw"."""
        return QUATERNION if self.reduce == "yaw" else ()

    @property
    def is_list(self) -> bool:
        return self.reduce is None and self.read.lists > 0

    @property
    def picks(self) -> bool:
        """Return whether the path selects a single element, which a message may lack."""
        return any(s.choice is not None and not s.choice.many for s in self.read.steps)

    def wanted(self) -> list[str]:
        """Return the field paths to decode."""
        return self.read.wanted(*self.ends)

    def field(self, name: str) -> pa.Field:
        """Return the signal's Arrow column, with unit and source in the metadata."""
        about = {"unit": self.unit, "topic": self.topic, "path": self.path, "meaning": self.doc}
        about |= {"length": str(self.length or "")}
        kind = LIST if self.is_list else NUMBER
        return pa.field(name, kind, nullable=True, metadata={k: v for k, v in about.items() if v})

    def problem(self, leaves: Sequence[Leaf]) -> str | None:
        """Return why messages with these fields do not contain the signal, or None."""
        try:
            kinds = self.read.check(leaves, *self.ends)
        except PathProblem as problem:
            return str(problem)
        if self.reduce == "yaw" and "string" in kinds:
            return "is not a quaternion"
        return None


def name_problem(name: str) -> str | None:
    """Return why a custom signal may not have this name, or None."""
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        return "a name consists of lower-case letters, digits and _"
    if name in _TAKEN:
        return "Restock has a column of this name: choose another name"
    if name in _reserved():
        return "this name is a keyword of SQL: choose another name"
    return None


def refuse_other_signals(have: Mapping[str, Any], schema: pa.Schema, where: str) -> None:
    """Check that a store's columns of custom signals have the types and units of this schema.

    `have` maps names to deltalake's fields of the store's table.

    Raises:
        StoreError: a column of the same name has another type or unit.
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
    import duckdb

    with duckdb.connect() as connection:
        rows = connection.sql(
            "SELECT keyword_name FROM duckdb_keywords() WHERE keyword_category = 'reserved'"
        ).fetchall()
    return {name for (name,) in rows}


COMMAND_SOURCES = "command_sources"
CLOUD = "sensor_msgs/msg/PointCloud2"
SCAN_OF_CLOUD = {
    "ranges_m": "ranges",
    "angle_min_rad": "angle_min",
    "angle_increment_rad": "angle_increment",
}
_Bearing = Annotated[float, Meta(ge=-3.1416, le=3.1416)]
_OnRobot = Annotated[float, Meta(ge=-20, le=20)]  # coordinate in m from the middle of the outline
SCANS = ("scan", "scan_2", "scan_3", "scan_4")  # inputs of up to four lidars


class Form(NamedTuple):
    """The names of fields that an input must or may have."""

    needs: tuple[str, ...] = ()
    either: tuple[str, ...] = ()  # alternatives, of which exactly one must be given
    may: tuple[str, ...] = ()  # optional

    @property
    def known(self) -> tuple[str, ...]:
        return (*self.needs, *self.either, *self.may)


_TURNS = ("yaw_rate_radps", "steering_rad")
_HEADING = ("orientation", "yaw_rad")  # a quaternion, which is converted to a yaw, or a yaw
_TEXT = Form(("text",))
BY_FIX = Form(("latitude_deg", "longitude_deg"), may=("status", "covariance_m2", "covariance_type"))
BY_RATES = Form(("speed_mps", "yaw_rate_radps"), may=("sideways_mps",))
INPUT_FIELDS: dict[str, Form] = {
    "command": Form(("speed_mps",), _TURNS, ("sideways_mps",)),
    "pose": Form(("x_m", "y_m"), _HEADING),  # other forms: BY_FIX, BY_RATES
    "heading": Form(either=_HEADING),  # only for a pose by fix
    "wheels": Form(("speed_mps", "yaw_rate_radps")),
    "imu": Form(("yaw_rate_radps", "accel_x_mps2")),
    **dict.fromkeys(
        SCANS, Form(("ranges_m", "angle_min_rad"), ("angle_increment_rad", "angle_max_rad"))
    ),
    "goal": Form(("x_m", "y_m")),
    "plan": Form(("x_m", "y_m")),
    "bumper": Form(("pressed",)),
    "nav_command": Form(("speed_mps",), _TURNS),
    "behaviour_policy": _TEXT,
    "true_condition": _TEXT,
    "true_exposure": _TEXT,
    "perturbation": _TEXT,
}
# Fields of a source of commands: its commands, or a button that is pressed while it drives.
COMMAND_SOURCE_FIELDS = ("speed_mps", *_TURNS, "pressed")

# What replaces an input that the profile leaves out, or an optional one that a recording lacks.
FALLBACKS: dict[str, str] = {
    "scan": "no lidar: clearance is unknown (null), and the observation has no sectors",
    "imu": "gyro yaw rate taken from the wheels, acceleration 0",
    "bumper": "never pressed",
    "nav_command": "unknown: null, and 0 in the observation",
    "behaviour_policy": "the profile's behaviour_policy",
    "true_condition": "unknown: labels are not scored",
    "true_exposure": "unknown: exposures are not scored",
    "perturbation": "unknown: null, as for hardware",
}
MOTION = "Odometry"  # last part of message types that contain measured motion, not commands
STEERED = "speed x tan(steering angle) / {wheelbase_m:g} m of {topic}"
COMMAND_FALLBACK = "the measured motion of {topic} in place of commands"
POLICY_FALLBACK = "the source whose command it equals: {names}; else the profile's behaviour_policy"
FIX_FALLBACK = "the direction of the last {track_m:g} m driven, as fixes have no heading"
RECKONED = "dead reckoning by the speeds of {topic}: it drifts, and slip cannot be detected"
POSE_FALLBACK = "from transforms, by [frames]"
WHEELS_FALLBACK = "speeds from the poses of the last {window_s:g} s: slip cannot be detected"
ROUTE_FALLBACK = "none: the task has no goal, progress is forward displacement"
HINDSIGHT = {
    "goal": "in hindsight: where the drive stopped, turned back or went far enough",
    "plan": "in hindsight: the path that was driven",
}


FIX_SETTINGS = ("origin_deg", "max_std_m", "track_m")
SCAN_SETTINGS = ("upside_down", "lidar_at_m", "lidar_yaw_rad", "height_m", "angle_rad")
_COMMAND, _SCAN, _FIX = "a command", "a scan", "a pose by latitude and longitude"
_APPLIES_TO = {
    "stop_holds": _COMMAND,
    **dict.fromkeys(SCAN_SETTINGS, _SCAN),
    **dict.fromkeys(FIX_SETTINGS, _FIX),
}


def is_motion(kind: str) -> bool:
    """Return whether messages of this type contain measured motion, not commands."""
    return last_part(kind) == MOTION


class Input(Checked, frozen=True):
    """One `[inputs.NAME]` of a profile: a topic, and the paths of the fields that it needs."""

    topic: str
    type: str
    fields: dict[str, str]  # name in `INPUT_FIELDS` -> path in the message
    # Largest age of a message that a step uses; None: a message holds until the next.
    max_age_s: Annotated[float, Meta(gt=0)] | None = None
    optional: bool = False
    wheelbase_m: Annotated[float, Meta(gt=0)] | None = None  # axle distance, for steering_rad
    stop_holds: bool = False  # a command to stop holds until the next command, whatever its age
    # For a lidar: whether scans run clockwise, seen from above; the position (ahead, left) from the
    # middle of the outline, if not that of [task.body]; and the yaw of the scans' zero angle.
    upside_down: bool = False
    lidar_at_m: tuple[_OnRobot, _OnRobot] | None = None
    lidar_yaw_rad: Annotated[float, Meta(ge=-7, le=7)] | None = None
    # For a point cloud: the slice that `restock.ingest.steps.clouds` reads as a scan.
    height_m: tuple[float, float] | None = None  # bottom and top of the slice above the lidar
    angle_rad: tuple[_Bearing, _Bearing] | None = None  # first and last bearing; None: all
    # For a pose by latitude and longitude (`restock.ingest.steps.input_columns`).
    origin_deg: tuple[float, float] | None = None  # origin of the map; None: the first fix
    max_std_m: Annotated[float, Meta(gt=0)] | None = None  # less certain fixes are unused; None: 5
    track_m: Annotated[float, Meta(gt=0)] | None = None  # way driven to find a yaw; None: 1

    @property
    def by_fix(self) -> bool:
        """Return whether the input is a position by latitude and longitude."""
        return "latitude_deg" in self.fields

    @property
    def by_rates(self) -> bool:
        """Return whether the input has speeds; a pose with speeds is found by dead reckoning."""
        return not {*BY_RATES.needs, *BY_RATES.may}.isdisjoint(self.fields)


class Inputs(Checked, frozen=True):
    """The `[inputs]` of a profile."""

    command: Input
    wheels: Input | None = None  # None: speeds from poses, by [motion]
    pose: Input | None = None
    heading: Input | None = None  # for a pose by fixes; None: the direction of driving
    scan: Input | None = None
    scan_2: Input | None = None  # further lidars; of all lidars, the nearest return counts
    scan_3: Input | None = None
    scan_4: Input | None = None
    imu: Input | None = None
    goal: Input | None = None
    plan: Input | None = None
    bumper: Input | None = None
    nav_command: Input | None = None  # the navigation stack's proposed command
    behaviour_policy: Input | None = None
    true_condition: Input | None = None
    true_exposure: Input | None = None
    perturbation: Input | None = None

    def items(self) -> Iterator[tuple[str, Input]]:
        for name in self.__struct_fields__:
            source = getattr(self, name)
            if source is not None:
                yield name, source

    @property
    def scans(self) -> dict[str, Input]:
        """Return the lidars, by name."""
        return {name: source for name, source in self.items() if name in SCANS}


def check_input(name: str, source: Input, where: str, *, framed: bool) -> None:
    """Check an input's fields and settings; `framed` says whether [frames] can give the pose.

    Raises:
        ConfigError: a field or setting is missing or does not apply; names the key.
    """
    form = INPUT_FIELDS[name]
    if name == "pose" and (source.by_fix or source.by_rates):
        form = BY_FIX if source.by_fix else BY_RATES
    unknown = sorted(source.fields.keys() - form.known)
    missing = sorted(form.needs - source.fields.keys())
    given = [key for key in form.either if key in source.fields]
    if form.either and not given:
        missing.append(form.either[0])
    if len(given) > 1:
        unknown.append(f"{given[1]} beside {given[0]}")
    _check_settings(f"inputs.{name}", name, source, where)
    _check_units(f"inputs.{name}", source, where)
    _check_wheelbase(f"inputs.{name}", source, where)
    _check_pressed(f"inputs.{name}", source, where)
    if unknown or missing:
        problems = [f"unknown {key!r}" for key in unknown] + [f"missing {key!r}" for key in missing]
        raise ConfigError(
            f"`inputs.{name}.fields`: {', '.join(problems)}",
            where=where,
            remedy=f"{name} has the fields {', '.join(form.known)}",
        )
    if source.optional and name not in FALLBACKS and not (name == "pose" and framed):
        raise ConfigError(
            f"`inputs.{name}.optional`: {name} has no fallback, so it cannot be optional",
            where=where,
            remedy=f"optional may be {', '.join(FALLBACKS)}, and pose where there is [frames]",
        )


def _check_settings(key: str, name: str, source: Input, where: str) -> None:
    """Refuse settings that do not apply to an input; `name` is "" for a source of commands."""
    own = {"command": _COMMAND, **dict.fromkeys(SCANS, _SCAN)}.get(name)
    for setting, only in _APPLIES_TO.items():
        applies = only == own or (only == _FIX and source.by_fix)
        if getattr(source, setting) not in (None, False) and not applies:
            raise ConfigError(
                f"`{key}.{setting}` applies only to {only}", where=where, remedy="leave it out"
            )


def check_scans(scans: Mapping[str, Input], where: str) -> None:
    """Check that the settings of all lidars are consistent.

    Raises:
        ConfigError: settings are inconsistent; names the key.
    """
    for name, source in scans.items():
        if source.lidar_yaw_rad is not None and source.lidar_at_m is None:
            raise ConfigError(
                f"`inputs.{name}.lidar_yaw_rad` is given without lidar_at_m",
                where=where,
                remedy="give both, or lidar_x_m and lidar_yaw_rad of [task.body]",
            )
        _check_cloud(f"inputs.{name}", source, where)
    if scans and "scan" not in scans:
        raise ConfigError(
            f"`inputs.{next(iter(scans))}` is given without `inputs.scan`",
            where=where,
            remedy="name the first lidar scan",
        )
    if len(scans) < 2:
        return
    for name, source in scans.items():
        if source.lidar_at_m is None:
            raise ConfigError(
                f"`inputs.{name}.lidar_at_m` is missing: with several lidars, each needs its place",
                where=where,
                remedy="give lidar_at_m = [AHEAD, LEFT], from the middle of the outline, and"
                " lidar_yaw_rad",
            )
        if source.optional:
            raise ConfigError(
                f"`inputs.{name}.optional`: with several lidars, none is optional: rows would "
                "silently lack what only that one sees",
                where=where,
                remedy="leave it out, and give recordings without it a profile of their own",
            )
    topics = [source.topic for source in scans.values()]
    if len(set(topics)) < len(topics):
        raise ConfigError(
            f"`inputs.{list(scans)[-1]}.topic`: two lidars have the same topic", where=where
        )


def _check_cloud(key: str, source: Input, where: str) -> None:
    """Check the settings that turn a point cloud into a scan."""
    if source.type != CLOUD:
        for setting in ("height_m", "angle_rad"):
            if getattr(source, setting) is not None:
                what = f"`{key}.{setting}` applies only to {CLOUD}, not to {source.type}"
                raise ConfigError(what, where=where, remedy="leave it out")
        return
    if source.height_m is None or source.fields != SCAN_OF_CLOUD:
        fields = ", ".join(f'{key} = "{path}"' for key, path in SCAN_OF_CLOUD.items())
        raise ConfigError(
            f"`{key}`: a point cloud is read as the scan of a slice of it",
            where=where,
            remedy="give the slice, height_m = [LOW, HIGH] above the lidar, at which the robot can"
            f" hit something, and the fields of that scan: fields = {{ {fields} }}",
        )
    for setting in ("height_m", "angle_rad"):
        low, high = getattr(source, setting) or (0, 1)
        if not low < high:
            raise ConfigError(
                f"`{key}.{setting}` must be [LOW, HIGH], got {[low, high]}", where=where
            )


def _check_pressed(key: str, source: Input, where: str) -> None:
    try:
        pressed_paths(source.fields.get("pressed", "data"))
    except PathProblem as problem:
        raise ConfigError(
            f"`{key}.fields.pressed`: {source.fields['pressed']!r} {problem}",
            where=where,
            remedy='give a field, or several: "is_left_pressed or is_right_pressed"',
        ) from None


def _check_units(key: str, source: Input, where: str) -> None:
    for field, path in source.fields.items():
        if factor_of(field, path) is None:
            raise ConfigError(
                f"`{key}.fields.{field}`: {path!r} has an unknown unit",
                where=where,
                remedy=f"after a speed or a yaw rate:{IN}"
                + ", ".join(unit for units in UNITS.values() for unit in units),
            )


def _check_wheelbase(key: str, source: Input, where: str) -> None:
    if ("steering_rad" in source.fields) != (source.wheelbase_m is not None):
        raise ConfigError(
            f"`{key}`: steering_rad and wheelbase_m belong together",
            where=where,
            remedy="wheelbase_m is the distance between the axles, in metres",
        )


def check_command_source(key: str, source: Input, command: Input, where: str) -> None:
    """Check that a source of commands has commands, or a button that is pressed while it drives.

    Raises:
        ConfigError: the source has neither; names the key.
    """
    commanding = source.fields.keys() - {"pressed"}
    if unknown := sorted(source.fields.keys() - {*COMMAND_SOURCE_FIELDS}):
        raise ConfigError(
            f"`{key}.fields`: unknown {', '.join(map(repr, unknown))}",
            where=where,
            remedy=f"a source of commands has the fields {', '.join(COMMAND_SOURCE_FIELDS)}",
        )
    _check_units(key, source, where)
    complete = "speed_mps" in commanding and len(commanding) == len(source.fields) == 2
    if not (complete or source.fields.keys() == {"pressed"}):
        raise ConfigError(
            f"`{key}.fields`: {', '.join(source.fields) or 'nothing'} does not show when this "
            "source drives",
            where=where,
            remedy="give speed_mps with yaw_rate_radps (or steering_rad), or pressed alone",
        )
    if source.topic == command.topic and "pressed" not in source.fields:
        raise ConfigError(
            f"`{key}.topic` is the topic of the command, {command.topic}: this source would "
            "always be in force",
            where=where,
            remedy="give the topic of this source's commands, before one of several sources is "
            "chosen",
        )
    _check_wheelbase(key, source, where)
    _check_pressed(key, source, where)
    _check_settings(key, "", source, where)
