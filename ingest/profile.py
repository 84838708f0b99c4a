"""Profiles: how one kind of robot's topics fill the signals, and the task that is learnt on them.

A profile is a TOML file: `name`, the shipped `conditions` it uses and `[[condition]]` of its own,
`[task]`, `[clock]`, `[episodes]`, `[inputs.*]` (which topic fills what) and `[[zone]]` (named
rectangles of the map). `load_profile("warehouse_amr")` reads one that comes with Restock,
`load_profile("my_robot.toml")` one of yours.
"""

from __future__ import annotations

import hashlib
import re
import tomllib
from collections.abc import Iterator
from difflib import get_close_matches
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from restock.errors import ConfigError
from restock.ingest.conditions import Condition, labels_version, shipped
from restock.ingest.task import Task

ELSEWHERE = "elsewhere"

# What each input must and may say of a message: signal-side name -> whether it is required.
# `orientation` is a quaternion's path and becomes a yaw.
INPUT_FIELDS: dict[str, dict[str, bool]] = {
    "command": {"speed_mps": True, "yaw_rate_radps": True},
    "pose": {"x_m": True, "y_m": True, "orientation": False, "yaw_rad": False},
    "wheels": {"speed_mps": True, "yaw_rate_radps": True},
    "imu": {"yaw_rate_radps": True, "accel_x_mps2": True},
    "scan": {"ranges_m": True, "angle_min_rad": True, "angle_increment_rad": True},
    "goal": {"x_m": True, "y_m": True},
    "plan": {"x_m": True, "y_m": True},
    "bumper": {"pressed": True},
    "behaviour_policy": {"text": True},
    "true_condition": {"text": True},
}

# What stands in for an input that a profile leaves out, or marks optional and a recording lacks.
FALLBACKS: dict[str, str] = {
    "imu": "gyro yaw rate taken from the wheels, acceleration 0",
    "bumper": "never pressed",
    "behaviour_policy": "the profile's behaviour_policy",
    "true_condition": "unknown: labels are not scored",
}
ROUTE_FALLBACK = "none: the task has no goal, progress is forward displacement"


class Input(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One topic, and which of its fields fill what."""

    topic: str
    type: str
    fields: dict[str, str]
    max_age_s: float | None = None  # None: latched, held until the next message
    optional: bool = False


class Inputs(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The `[inputs]` of a profile."""

    command: Input
    pose: Input
    wheels: Input
    scan: Input
    imu: Input | None = None
    goal: Input | None = None
    plan: Input | None = None
    bumper: Input | None = None
    behaviour_policy: Input | None = None
    true_condition: Input | None = None

    def items(self) -> Iterator[tuple[str, Input]]:
        for name in self.__struct_fields__:
            source = getattr(self, name)
            if source is not None:
                yield name, source


class Clock(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The `[clock]` of a profile: what time is, and when the steps are."""

    alignment: Literal["header.stamp", "log_time"] = "header.stamp"
    steps: Literal["rate", "command"] = "rate"
    max_gap_s: float = 0.5  # between two steps of an episode
    jump_s: float = 1.0  # a change of (log time - stamp) that means the clock was set


class Episodes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The `[episodes]` of a profile: what cuts one, beside goals, gaps and clock jumps."""

    max_pose_jump_m: float = 1.0  # between two steps: the robot was carried, or relocalised
    goal_moved_m: float = 0.01  # a goal further than this from the last one is a new one
    plan_goal_tolerance_m: float = 0.5  # a plan that ends further from the goal is for another


class Zone(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A named rectangle of the map: `box_m = [x0, y0, x1, y1]`."""

    name: str
    box_m: tuple[float, float, float, float]

    def __post_init__(self) -> None:
        x0, y0, x1, y1 = self.box_m
        if not (x0 < x1 and y0 < y1):
            raise ValueError(f"box_m must be [x0, y0, x1, y1] with x0 < x1 and y0 < y1: {self}")


class Profile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One kind of robot. Read with `load_profile`."""

    name: str
    task: Task
    inputs: Inputs
    doc: str = ""
    shipped_conditions: list[str] = msgspec.field(default_factory=list, name="conditions")
    own_conditions: list[Condition] = msgspec.field(default_factory=list, name="condition")
    behaviour_policy: str = "unknown"  # who drove, where no topic says
    clock: Clock = Clock()
    episodes: Episodes = Episodes()
    zones: list[Zone] = msgspec.field(default_factory=list, name="zone")

    @property
    def conditions(self) -> list[Condition]:
        """The conditions that label this robot's steps."""
        known = shipped()
        return [known[name] for name in self.shipped_conditions] + self.own_conditions

    @property
    def labels_version(self) -> str:
        return labels_version(self.conditions)

    @property
    def hash(self) -> str:
        """Names all that the profile says: 12 hex digits."""
        return hashlib.blake2b(msgspec.json.encode(self), digest_size=6).hexdigest()

    @property
    def fallbacks(self) -> dict[str, str]:
        """Inputs the profile leaves out -> what stands in for each."""
        given = dict(self.inputs.items())
        stand_ins = {name: how for name, how in FALLBACKS.items() if name not in given}
        if self.task.goal == "none":
            stand_ins |= dict.fromkeys(("goal", "plan"), ROUTE_FALLBACK)
        return stand_ins

    def zone_of(self, x_m: NDArray[Any], y_m: NDArray[Any]) -> list[str]:
        """The name of the first zone that holds each point (N,), or `elsewhere`."""
        x, y = np.asarray(x_m, np.float64), np.asarray(y_m, np.float64)
        index = np.full(x.shape, len(self.zones), np.intp)
        for position in reversed(range(len(self.zones))):
            x0, y0, x1, y1 = self.zones[position].box_m
            index[(x >= x0) & (x <= x1) & (y >= y0) & (y <= y1)] = position
        names = [zone.name for zone in self.zones] + [ELSEWHERE]
        return [names[position] for position in index]


def shipped_profiles() -> list[str]:
    """The names of the profiles that come with Restock."""
    folder = files("restock.ingest") / "profiles"
    return sorted(e.name.removesuffix(".toml") for e in folder.iterdir() if e.name[-5:] == ".toml")


def load_profile(name_or_path: str | Path) -> Profile:
    """A shipped profile by its name, or one of yours by its path.

    Raises:
        ConfigError: no such profile, or its TOML says something Restock cannot use; names the
            file and the key.
    """
    where = str(name_or_path)
    if where in (names := shipped_profiles()):
        text = (files("restock.ingest") / "profiles" / f"{where}.toml").read_text("utf-8")
        return parse_profile(text, where=f"profile {where!r}")
    path = Path(name_or_path)
    if not path.is_file():
        near = get_close_matches(where, names, n=1)
        raise ConfigError(
            "no such profile: neither a file nor one that comes with Restock",
            where=where,
            remedy=f"did you mean {near[0]!r}?" if near else f"shipped are: {', '.join(names)}",
        )
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot be read as UTF-8 text: {error}", where=where) from error
    return parse_profile(text, where=where)


def parse_profile(text: str, *, where: str) -> Profile:
    """A profile from its TOML text; `where` names it in errors."""
    try:
        profile = msgspec.convert(tomllib.loads(text), Profile)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"is not TOML: {error}", where=where) from error
    except msgspec.ValidationError as error:
        raise ConfigError(_explain(str(error)), where=where) from error
    _check(profile, where)
    return profile


def _check(profile: Profile, where: str) -> None:
    """What the types alone do not say."""
    known = shipped()
    for name in profile.shipped_conditions:
        if name not in known:
            raise ConfigError(
                f"`conditions`: no condition named {name!r}",
                where=where,
                remedy=f"shipped are {', '.join(known)}; write your own as [[condition]]",
            )
    names = [condition.name for condition in profile.conditions]
    if doubled := sorted({name for name in names if names.count(name) > 1}):
        raise ConfigError(f"`conditions`: {', '.join(doubled)} given twice", where=where)
    for name, source in profile.inputs.items():
        _check_fields(name, source, where)
    for name in ("goal", "plan"):
        if profile.task.goal == "route" and getattr(profile.inputs, name) is None:
            raise ConfigError(
                f"`inputs.{name}` is missing, and `task.goal` is 'route'",
                where=where,
                remedy=f'name the topic of the {name}, or set task.goal = "none"',
            )


def _check_fields(name: str, source: Input, where: str) -> None:
    known = INPUT_FIELDS[name]
    unknown = sorted(source.fields.keys() - known.keys())
    missing = sorted(
        key for key, required in known.items() if required and key not in source.fields
    )
    if name == "pose" and not source.fields.keys() & {"orientation", "yaw_rad"}:
        missing.append("orientation")
    if unknown or missing:
        said = [f"unknown {key!r}" for key in unknown] + [f"missing {key!r}" for key in missing]
        raise ConfigError(
            f"`inputs.{name}.fields`: {', '.join(said)}",
            where=where,
            remedy=f"{name} takes {', '.join(known)}",
        )
    if source.optional and name not in FALLBACKS:
        raise ConfigError(
            f"`inputs.{name}.optional`: nothing can stand in for {name}",
            where=where,
            remedy=f"optional may be {', '.join(FALLBACKS)}",
        )


def _explain(message: str) -> str:
    """msgspec's message with the key as TOML writes it: `task.body.foo`, not `$.task.body`."""
    said, _, path = message.partition(" - at `$")
    path = path.rstrip("`").lstrip(".")
    unknown = re.fullmatch(r"Object contains unknown field `(.*)`", said)
    if unknown:
        return f"unknown key `{'.'.join(part for part in (path, unknown[1]) if part)}`"
    missing = re.fullmatch(r"Object missing required field `(.*)`", said)
    if missing:
        return f"missing key `{'.'.join(part for part in (path, missing[1]) if part)}`"
    return f"`{path}`: {said}" if path else said


__all__ = [
    "ELSEWHERE",
    "Clock",
    "Episodes",
    "Input",
    "Inputs",
    "Profile",
    "Zone",
    "load_profile",
    "parse_profile",
    "shipped_profiles",
]
