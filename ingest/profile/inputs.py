"""The inputs of a profile: which topic fills what, what it must say, and what stands in for it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated

from msgspec import Meta

from restock.errors import ConfigError
from restock.ingest.profile.signal_paths import PathProblem, last_part, pressed_paths
from restock.toml import Checked

COMMAND_SOURCES = "command_sources"
COMMAND_THROUGH = "command_through"
MAX_NAME = 64  # characters of a behaviour policy
_OnRobot = Annotated[float, Meta(ge=-20, le=20)]  # m from the middle of its outline
SCANS = ("scan", "scan_2", "scan_3", "scan_4")  # of a robot's lidars
_SCAN_FIELDS = {
    "ranges_m": True,
    "angle_min_rad": True,
    "angle_increment_rad": False,  # either this one
    "angle_max_rad": False,  # or this one
}


# What each input must and may say of a message: signal-side name -> whether it is required.
# `orientation` is a quaternion's path and becomes a yaw.
INPUT_FIELDS: dict[str, dict[str, bool]] = {
    "command": {"speed_mps": True, "yaw_rate_radps": False, "steering_rad": False},
    "pose": {
        **{"x_m": True, "y_m": True, "orientation": False, "yaw_rad": False},
        **{"latitude_deg": False, "longitude_deg": False, "status": False},
        **{"covariance_m2": False, "covariance_type": False},
    },
    "heading": {"orientation": False, "yaw_rad": False},  # of a pose by fix
    "wheels": {"speed_mps": True, "yaw_rate_radps": True},
    "imu": {"yaw_rate_radps": True, "accel_x_mps2": True},
    **dict.fromkeys(SCANS, _SCAN_FIELDS),
    "goal": {"x_m": True, "y_m": True},
    "plan": {"x_m": True, "y_m": True},
    "bumper": {"pressed": True},
    "nav_command": {"speed_mps": True, "yaw_rate_radps": False, "steering_rad": False},
    "behaviour_policy": {"text": True},
    "true_condition": {"text": True},
    "true_exposure": {"text": True},
    "perturbation": {"text": True},
}
# Of a source of commands: the commands that it gives, or what is pressed while it drives.
COMMAND_SOURCE_FIELDS = {**INPUT_FIELDS["nav_command"], "speed_mps": False, "pressed": False}

# What is used instead of an input that is left out, or is optional and the recording lacks.
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
MOTION = "Odometry"  # the last part of its types: what was measured, where commands are of others
STEERED = "speed x tan(steering angle) / {wheelbase_m:g} m of {topic}"
COMMAND_FALLBACK = "the measured motion of {topic} in place of commands"
POLICY_FALLBACK = "the source whose command it equals: {names}; else the profile's behaviour_policy"
FIX_FALLBACK = "the direction of the last {track_m:g} m driven, as fixes have no heading"
POSE_FALLBACK = "from transforms, by [frames]"
WHEELS_FALLBACK = "speeds from the poses of the last {window_s:g} s: slip cannot be detected"
ROUTE_FALLBACK = "none: the task has no goal, progress is forward displacement"
HINDSIGHT = {
    "goal": "in hindsight: where the drive stopped, turned back or passed often",
    "plan": "in hindsight: the path that was driven",
}


FIX_SETTINGS = ("origin_deg", "max_std_m", "track_m")
SCAN_SETTINGS = ("upside_down", "lidar_at_m", "lidar_yaw_rad")
_COMMAND, _SCAN, _FIX = "a command", "a scan", "a pose by latitude and longitude"
_APPLIES_TO = {
    "stop_holds": _COMMAND,
    **dict.fromkeys(SCAN_SETTINGS, _SCAN),
    **dict.fromkeys(FIX_SETTINGS, _FIX),
}


def is_motion(kind: str) -> bool:
    """Return whether messages of this type hold measurements and no commands."""
    return last_part(kind) == MOTION


class Input(Checked, frozen=True):
    """One topic, and which of its fields fill what."""

    topic: str
    type: str
    fields: dict[str, str]
    # Largest age; None: latched until the next message.
    max_age_s: Annotated[float, Meta(gt=0)] | None = None
    optional: bool = False
    wheelbase_m: Annotated[float, Meta(gt=0)] | None = None  # between the axles, for steering_rad
    stop_holds: bool = False  # a command to stop holds until the next one
    # Of a lidar: whether its scans turn clockwise, as seen from above; where it is, from the middle
    # of the outline (ahead, left), if not where [task.body] has it; and the angle of its zero.
    upside_down: bool = False
    lidar_at_m: tuple[_OnRobot, _OnRobot] | None = None
    lidar_yaw_rad: Annotated[float, Meta(ge=-7, le=7)] | None = None
    # Of a pose by latitude and longitude (`restock.ingest.steps.input_columns`).
    origin_deg: tuple[float, float] | None = None  # of the map; None: the recording's first fix
    max_std_m: Annotated[float, Meta(gt=0)] | None = None  # larger: the fix is not used; None: 5
    track_m: Annotated[float, Meta(gt=0)] | None = None  # distance that gives the yaw; None: 1

    @property
    def by_fix(self) -> bool:
        """Return whether it is a position by latitude and longitude."""
        return "latitude_deg" in self.fields


class Inputs(Checked, frozen=True):
    """The `[inputs]` of a profile."""

    command: Input
    wheels: Input | None = None  # None: speeds from poses, by [motion]
    pose: Input | None = None
    heading: Input | None = None  # for fixes; None: the direction of driving
    scan: Input | None = None
    scan_2: Input | None = None  # further lidars: what is nearest to any of them counts
    scan_3: Input | None = None
    scan_4: Input | None = None
    imu: Input | None = None
    goal: Input | None = None
    plan: Input | None = None
    bumper: Input | None = None
    nav_command: Input | None = None  # the navigation stack's proposal, before the choice
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
    """Check that an input has the fields it needs; `framed` if transforms can give its pose.

    Raises:
        ConfigError: it does not; names the key.
    """
    known = INPUT_FIELDS[name]
    unknown = sorted(source.fields.keys() - known.keys())
    missing = sorted(
        key for key, required in known.items() if required and key not in source.fields
    )
    if source.by_fix:
        missing = sorted({"latitude_deg", "longitude_deg"} - source.fields.keys())
        unknown += sorted(source.fields.keys() & {"x_m", "y_m", "orientation", "yaw_rad"})
    elif name in ("pose", "heading") and not source.fields.keys() & {"orientation", "yaw_rad"}:
        missing.append("orientation")
    _check_settings(f"inputs.{name}", name, source, where)
    steered = "steering_rad" in source.fields
    if name in ("command", "nav_command"):
        if steered and "yaw_rate_radps" in source.fields:
            unknown.append("steering_rad beside yaw_rate_radps")
        elif not steered and "yaw_rate_radps" not in source.fields:
            missing.append("yaw_rate_radps")
    if name in SCANS:
        if {"angle_increment_rad", "angle_max_rad"} <= source.fields.keys():
            unknown.append("angle_max_rad beside angle_increment_rad")
        elif not {"angle_increment_rad", "angle_max_rad"} & source.fields.keys():
            missing.append("angle_increment_rad")
    _check_wheelbase(f"inputs.{name}", source, where)
    _check_pressed(f"inputs.{name}", source, where)
    if unknown or missing:
        problems = [f"unknown {key!r}" for key in unknown] + [f"missing {key!r}" for key in missing]
        raise ConfigError(
            f"`inputs.{name}.fields`: {', '.join(problems)}",
            where=where,
            remedy=f"{name} has the fields {', '.join(known)}",
        )
    if source.optional and name not in FALLBACKS and not (name == "pose" and framed):
        raise ConfigError(
            f"`inputs.{name}.optional`: {name} has no fallback, so it cannot be optional",
            where=where,
            remedy=f"optional may be {', '.join(FALLBACKS)}, and pose where there is [frames]",
        )


def _check_settings(key: str, name: str, source: Input, where: str) -> None:
    """Refuse settings that do not apply to an input of this name; "": to a source of commands."""
    own = {"command": _COMMAND, **dict.fromkeys(SCANS, _SCAN)}.get(name)
    for setting, only in _APPLIES_TO.items():
        applies = only == own or (only == _FIX and source.by_fix)
        if getattr(source, setting) not in (None, False) and not applies:
            raise ConfigError(
                f"`{key}.{setting}` applies only to {only}", where=where, remedy="leave it out"
            )


def check_scans(scans: Mapping[str, Input], where: str) -> None:
    """Check that the settings of several lidars go together.

    Raises:
        ConfigError: they do not; names the key.
    """
    for name, source in scans.items():
        if source.lidar_yaw_rad is not None and source.lidar_at_m is None:
            raise ConfigError(
                f"`inputs.{name}.lidar_yaw_rad` is given without lidar_at_m",
                where=where,
                remedy="give both, or lidar_x_m and lidar_yaw_rad of [task.body]",
            )
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
                f"`inputs.{name}.lidar_at_m` is missing: of several lidars, each says where it is",
                where=where,
                remedy="give lidar_at_m = [AHEAD, LEFT], from the middle of the outline, and"
                " lidar_yaw_rad",
            )
        if source.optional:
            raise ConfigError(
                f"`inputs.{name}.optional`: of several lidars, none is optional, as rows would"
                " not tell what it alone sees",
                where=where,
                remedy="leave it out, and give recordings without it a profile of their own",
            )
    topics = [source.topic for source in scans.values()]
    if len(set(topics)) < len(topics):
        raise ConfigError(
            f"`inputs.{list(scans)[-1]}.topic`: two of the lidars have one topic", where=where
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


def _check_wheelbase(key: str, source: Input, where: str) -> None:
    if ("steering_rad" in source.fields) != (source.wheelbase_m is not None):
        raise ConfigError(
            f"`{key}`: steering_rad and wheelbase_m belong together",
            where=where,
            remedy="wheelbase_m is the distance between the axles, in metres",
        )


def check_command_source(key: str, source: Input, command: Input, where: str) -> None:
    """Check that a source has the command's fields, or says what is pressed while it drives.

    Raises:
        ConfigError: it does not; names the key.
    """
    commanding = source.fields.keys() - {"pressed"}
    name = key.removeprefix(f"{COMMAND_SOURCES}.")
    if not name or len(name) > MAX_NAME or not name.isprintable():
        raise ConfigError(
            f"`{key}`: the name of a behaviour policy has 1 to {MAX_NAME} printable characters",
            where=where,
            remedy='name the driver: "teleop", "navigation"',
        )
    if unknown := sorted(source.fields.keys() - COMMAND_SOURCE_FIELDS.keys()):
        raise ConfigError(
            f"`{key}.fields`: unknown {', '.join(map(repr, unknown))}",
            where=where,
            remedy=f"a source of commands has the fields {', '.join(COMMAND_SOURCE_FIELDS)}",
        )
    complete = "speed_mps" in commanding and len(commanding) == len(source.fields) == 2
    by_button = key != COMMAND_THROUGH and source.fields.keys() == {"pressed"}
    if not (complete or by_button):
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
    if source.optional:
        raise ConfigError(
            f"`{key}.optional`: a recording may always lack a source of commands",
            where=where,
            remedy="leave it out",
        )
    _check_wheelbase(key, source, where)
    _check_pressed(key, source, where)
    _check_settings(key, "", source, where)
