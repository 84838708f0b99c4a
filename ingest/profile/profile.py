"""Profiles: how one kind of robot's topics fill the signals, and the task that is learnt on them.

A profile is a TOML file: `name`, the shipped `conditions` it uses and `[[condition]]` of its own,
`[task]`, `[clock]`, `[episodes]`, `[inputs.*]` (which topic fills what), `[frames]` (poses from
transforms), `[signals.*]` (custom columns) and `[[zone]]` (named rectangles of the map).
`load_profile("warehouse_amr")` reads one that comes with Restock, `load_profile("my_robot.toml")`
one of yours.
"""

from __future__ import annotations

import hashlib
import re
import tomllib
from difflib import get_close_matches
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from restock.errors import ConfigError
from restock.ingest.profile.custom_signal import CustomSignal, name_problem
from restock.ingest.profile.inputs import (
    FALLBACKS,
    INPUT_FIELDS,
    POSE_FALLBACK,
    ROUTE_FALLBACK,
    Input,
    Inputs,
    check_input,
)
from restock.ingest.task.condition_files import with_files
from restock.ingest.task.conditions import Condition, label, labels_version, shipped
from restock.ingest.task.schema import steps_schema
from restock.ingest.task.task import Task

ELSEWHERE = "elsewhere"


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


class Frames(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The `[frames]` of a profile: poses are of `base` in `fixed`."""

    fixed: str = "map"
    base: str = "base_link"
    max_age_s: float = 0.5  # of a transform of `topic`, at the step
    topic: str = "/tf"
    static_topic: str = "/tf_static"

    def __post_init__(self) -> None:
        if self.fixed.strip("/") == self.base.strip("/"):
            raise ValueError(f"fixed and base are the same frame: {self.base!r}")
        if not self.max_age_s > 0:
            raise ValueError(f"max_age_s must be above 0, got {self.max_age_s}")


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
    frames: Frames | None = None
    signals: dict[str, CustomSignal] = msgspec.field(default_factory=dict)

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
        """Names all that the profile says but its conditions, 12 hex digits: rows depend on the
        rest, and labels, which can be changed without the recordings, on `labels_version`."""
        rest = msgspec.structs.replace(self, shipped_conditions=[], own_conditions=[])
        return hashlib.blake2b(msgspec.json.encode(rest), digest_size=6).hexdigest()

    @property
    def transform_topics(self) -> tuple[str, ...]:
        """The topics of the transforms that `[frames]` asks for."""
        return (self.frames.topic, self.frames.static_topic) if self.frames else ()

    @property
    def topics(self) -> list[str]:
        """Every topic that the profile names."""
        named = [source.topic for _, source in self.inputs.items()]
        named += [signal.topic for signal in self.signals.values()]
        return list(dict.fromkeys([*named, *self.transform_topics]))

    @property
    def fallbacks(self) -> dict[str, str]:
        """Inputs the profile leaves out -> what stands in for each."""
        given = dict(self.inputs.items())
        stand_ins = {name: how for name, how in FALLBACKS.items() if name not in given}
        if self.inputs.pose is None:
            stand_ins["pose"] = POSE_FALLBACK
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
    folder = files("restock.ingest.profile") / "profiles"
    return sorted(e.name.removesuffix(".toml") for e in folder.iterdir() if e.name[-5:] == ".toml")


def load_profile(name_or_path: str | Path) -> Profile:
    """A shipped profile by its name, or one of yours by its path.

    Raises:
        ConfigError: no such profile, or its TOML says something Restock cannot use; names the
            file and the key.
    """
    where = str(name_or_path)
    if where in (names := shipped_profiles()):
        text = (files("restock.ingest.profile") / "profiles" / f"{where}.toml").read_text("utf-8")
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
    return parse_profile(text, where=where, folder=path.parent)


def parse_profile(text: str, *, where: str, folder: Path | None = None) -> Profile:
    """A profile from its TOML text; `where` names it in errors, `.sql` files lie in `folder`."""
    try:
        said = with_files(tomllib.loads(text), folder, where)
        _convert_signals(said.get("signals"), where)
        profile = msgspec.convert(said, Profile)
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
        check_input(name, source, where, framed=profile.frames is not None)
    if profile.inputs.pose is None and profile.frames is None:
        raise ConfigError(
            "`inputs.pose` is missing, and there is no `frames`",
            where=where,
            remedy="name the topic of the pose, or take it from /tf: [frames] fixed and base",
        )
    for name in ("goal", "plan"):
        if profile.task.goal == "route" and getattr(profile.inputs, name) is None:
            raise ConfigError(
                f"`inputs.{name}` is missing, and `task.goal` is 'route'",
                where=where,
                remedy=f'name the topic of the {name}, or set task.goal = "none"',
            )
    _check_signals(profile, where)
    _check_conditions(profile, where)


def _convert_signals(said: Any, where: str) -> None:
    """Each signal by itself first: msgspec's paths leave out the keys of a table of tables."""
    for name, table in said.items() if isinstance(said, dict) else ():
        try:
            msgspec.convert(table, CustomSignal)
        except msgspec.ValidationError as error:
            raise ConfigError(_explain(str(error), f"signals.{name}"), where=where) from error


def _check_signals(profile: Profile, where: str) -> None:
    for name in profile.signals:
        if problem := name_problem(name):
            raise ConfigError(f"`signals.{name}`: {problem}", where=where)


def _check_conditions(profile: Profile, where: str) -> None:
    """That every condition of the profile's own binds to the steps that there will be."""
    fields = [signal.field(name) for name, signal in profile.signals.items()]
    steps = steps_schema(fields).empty_table()
    for place, condition in enumerate(profile.own_conditions):
        try:
            label(steps, [condition])
        except ConfigError as error:
            raise ConfigError(
                f"`condition[{place}].sql` ({condition.name!r}): {error.what}",
                where=where,
                remedy=error.remedy,
            ) from error


def _explain(message: str, under: str = "") -> str:
    """msgspec's message with the key as TOML writes it: `task.body.foo`, not `$.task.body`."""
    said, _, path = message.partition(" - at `$")
    path = ".".join(part for part in (under, path.rstrip("`").lstrip(".")) if part)
    unknown = re.fullmatch(r"Object contains unknown field `(.*)`", said)
    if unknown:
        return f"unknown key `{'.'.join(part for part in (path, unknown[1]) if part)}`"
    missing = re.fullmatch(r"Object missing required field `(.*)`", said)
    if missing:
        return f"missing key `{'.'.join(part for part in (path, missing[1]) if part)}`"
    return f"`{path}`: {said}" if path else said


__all__ = [
    "ELSEWHERE",
    "FALLBACKS",
    "INPUT_FIELDS",
    "Clock",
    "Episodes",
    "Frames",
    "Input",
    "Inputs",
    "Profile",
    "Zone",
    "load_profile",
    "parse_profile",
    "shipped_profiles",
]
