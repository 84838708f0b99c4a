"""Profiles: how one kind of robot's topics fill the signals, and the task that is learnt on them.

A profile is a TOML file: `name`, the shipped `conditions` and `exposures` it uses, `[[condition]]`
of its own, `[task]`, `[goal]` (logged, or by hindsight), `[clock]`, `[episodes]`, `[inputs.*]`
(which topic fills what), `[command_sources.*]` (whose command it may be), `[frames]` (poses from
transforms), `[motion]` (speeds from poses), `[signals.*]` (custom columns), `[cameras.*]` (frames
that are kept), `[tags]` (whose drive it is), `[robot]` (what the twin builds), `[limiter]` (of a
policy's commands) and `[[zone]]` (named rectangles of the map).
`load_profile("warehouse_amr")` reads one that comes with Restock, `load_profile("my_robot.toml")`
one of yours.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from difflib import get_close_matches
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from restock.errors import ConfigError
from restock.ingest.profile.camera import Camera, camera_name_problem
from restock.ingest.profile.custom_signal import CustomSignal, name_problem
from restock.ingest.profile.inputs import (
    COMMAND_FALLBACK,
    COMMAND_SOURCES,
    COMMAND_THROUGH,
    FALLBACKS,
    FIX_FALLBACK,
    FIX_SETTINGS,
    HINDSIGHT,
    MOTION,
    POLICY_FALLBACK,
    POSE_FALLBACK,
    ROUTE_FALLBACK,
    STEERED,
    WHEELS_FALLBACK,
    Input,
    Inputs,
    check_command_source,
    check_input,
)
from restock.ingest.profile.robot_file import with_robot_file
from restock.ingest.profile.tag_rules import TagRules
from restock.ingest.task.condition_files import with_files
from restock.ingest.task.conditions import (
    Condition,
    Kind,
    Noise,
    label_with_probabilities,
    labels_version,
    of_kind,
    shipped,
)
from restock.ingest.task.hindsight import GoalRules, GoalSource
from restock.ingest.task.limiter import Limiter
from restock.ingest.task.robot import Robot, beyond_limits, refuse_beyond_steering
from restock.ingest.task.schema import steps_schema
from restock.ingest.task.task import Task
from restock.toml import Checked, parse_toml, read_toml, typed

ELSEWHERE = "elsewhere"


class Clock(Checked, frozen=True):
    """The `[clock]` of a profile: what time is, and when the steps are."""

    alignment: Literal["header.stamp", "log_time"] = "header.stamp"
    steps: Literal["rate", "command"] = "rate"
    max_gap_s: float = 0.5  # between two steps of an episode
    jump_s: float = 1.0  # a change of (log time - stamp) that means the clock was set


class Episodes(Checked, frozen=True):
    """The `[episodes]` of a profile: what ends one, beside goals, gaps and clock jumps."""

    max_pose_jump_m: float = 1.0  # between two steps: the robot was carried, or relocalised
    goal_moved_m: float = 0.01  # a goal further than this from the last one is a new one
    plan_goal_tolerance_m: float = 0.5  # a plan that ends further from the goal is for another


class Frames(Checked, frozen=True):
    """The `[frames]` of a profile: poses are of `base` in `fixed`."""

    fixed: str = "map"
    base: str = "base_link"
    max_age_s: Annotated[float, Meta(gt=0)] = 0.5  # of a transform of `topic`, at the step
    topic: str = "/tf"
    static_topic: str = "/tf_static"

    def check(self) -> None:
        if self.fixed.strip("/") == self.base.strip("/"):
            raise ValueError(f"fixed and base are the same frame: {self.base!r}")


class Motion(Checked, frozen=True):
    """The `[motion]` of a profile: how its speeds are known where there is no odometry."""

    window_s: Annotated[float, Meta(gt=0, le=5)]  # of the poses that a speed is the slope of


class Zone(Checked, frozen=True, omit_defaults=True):  # a profile's hash has what is given
    """A named rectangle of the map: `box_m = [x0, y0, x1, y1]`, turned about its middle by
    `yaw_rad`, counter-clockwise."""

    name: str
    box_m: tuple[float, float, float, float]
    yaw_rad: Annotated[float, Meta(ge=-7, le=7)] | None = None  # defaults are known by identity

    def check(self) -> None:
        x0, y0, x1, y1 = self.box_m
        if not (x0 < x1 and y0 < y1):
            raise ValueError(f"box_m must be [x0, y0, x1, y1] with x0 < x1 and y0 < y1: {self}")

    def holds(self, x_m: NDArray[Any], y_m: NDArray[Any]) -> NDArray[np.bool_]:
        """Which points (N,) lie in it, its edges included."""
        x0, y0, x1, y1 = self.box_m
        if self.yaw_rad:
            middle_x, middle_y = (x0 + x1) / 2, (y0 + y1) / 2
            cos, sin = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
            dx, dy = x_m - middle_x, y_m - middle_y
            x_m, y_m = middle_x + cos * dx + sin * dy, middle_y + cos * dy - sin * dx
        return np.asarray((x_m >= x0) & (x_m <= x1) & (y_m >= y0) & (y_m <= y1), np.bool_)


class Profile(Checked, frozen=True):
    """One kind of robot. Read with `load_profile`."""

    name: str
    task: Task
    inputs: Inputs
    doc: str = ""
    goal: GoalRules = GoalRules()
    shipped_conditions: list[str] = msgspec.field(default_factory=list, name="conditions")
    shipped_exposures: list[str] = msgspec.field(default_factory=list, name="exposures")
    own_conditions: list[Condition] = msgspec.field(default_factory=list, name="condition")
    behaviour_policy: str = "unknown"  # who drove, where no topic says
    # Behaviour policy -> its commands (of a person, of navigation) before one is chosen to drive.
    command_sources: dict[str, Input] = msgspec.field(default_factory=dict)
    # What was chosen among them, where the command is that smoothed or limited: it is by whose
    # command it follows.
    command_through: Input | None = None
    clock: Clock = Clock()
    episodes: Episodes = Episodes()
    zones: list[Zone] = msgspec.field(default_factory=list, name="zone")
    frames: Frames | None = None
    motion: Motion | None = None
    signals: dict[str, CustomSignal] = msgspec.field(default_factory=dict)
    cameras: dict[str, Camera] = msgspec.field(default_factory=dict)
    tags: TagRules = TagRules()
    noise: Noise = Noise()
    robot: Robot | None = None  # None: the twin's own
    limiter: Limiter | None = None  # in front of a policy; None: by outline and actions

    @property
    def conditions(self) -> list[Condition]:
        """The conditions that label this robot's steps: outcomes."""
        return self._of("outcome", self.shipped_conditions)

    @property
    def exposures(self) -> list[Condition]:
        """The situations that are listed beside them."""
        return self._of("exposure", self.shipped_exposures)

    def _of(self, kind: Kind, names: Sequence[str]) -> list[Condition]:
        known = shipped(self.noise, kind)
        own = of_kind(self.own_conditions, kind)
        constants = self.noise.constants
        return [known[name] for name in names] + [one.with_constants(constants) for one in own]

    @property
    def definitions(self) -> list[Condition]:
        """Both, conditions first."""
        return [*self.conditions, *self.exposures]

    @property
    def labels_version(self) -> str:
        return labels_version(self.definitions)

    @property
    def hash(self) -> str:
        """12 hex digits of everything in the profile that rows depend on.

        That leaves out conditions, which can be changed without the recordings (labels depend on
        `labels_version`), their [noise], whose drive it is, and what only the twin needs of it.
        """
        without = msgspec.structs.replace(
            self, shipped_conditions=[], shipped_exposures=[], own_conditions=[]
        )
        values = msgspec.to_builtins(without)
        apart = {"tags", "noise", "robot", "limiter"}
        if self.goal == GoalRules():  # rows are as before there was such a table
            apart |= {"goal"}
        if self.motion is None:
            apart |= {"motion"}
        apart |= {name for name in ("command_sources", "cameras") if not values[name]}
        for signal in values["signals"].values():
            if signal["length"] is None:
                del signal["length"]
        for source in values["command_sources"].values():
            for key in FIX_SETTINGS:
                del source[key]
        if self.command_through is None:
            apart |= {"command_through"}
        if self.inputs.heading is None:
            del values["inputs"]["heading"]
        for source in filter(None, values["inputs"].values()):
            for key in ("stop_holds", "wheelbase_m", *FIX_SETTINGS):
                if not source[key]:
                    del source[key]
        rest = {key: value for key, value in values.items() if key not in apart}
        return hashlib.blake2b(msgspec.json.encode(rest), digest_size=6).hexdigest()

    @property
    def transform_topics(self) -> tuple[str, ...]:
        """The topics of the transforms that `[frames]` asks for."""
        return (self.frames.topic, self.frames.static_topic) if self.frames else ()

    @property
    def sources(self) -> dict[str, Input]:
        """The inputs, and as `command_sources.NAME` those of commands, none of which is needed."""
        optional = {
            f"{COMMAND_SOURCES}.{name}": msgspec.structs.replace(source, optional=True)
            for name, source in self.command_sources.items()
        }
        if self.command_through is not None:
            optional[COMMAND_THROUGH] = msgspec.structs.replace(self.command_through, optional=True)
        return dict(self.inputs.items()) | optional

    @property
    def topics(self) -> list[str]:
        """Every topic that the profile names."""
        named = [source.topic for source in self.sources.values()]
        named += [signal.topic for signal in self.signals.values()]
        named += [camera.topic for camera in self.cameras.values()]
        return list(dict.fromkeys([*named, *self.transform_topics]))

    @property
    def fallbacks(self) -> dict[str, str]:
        """Inputs the profile leaves out -> what is used instead of each."""
        given = dict(self.inputs.items())
        fallbacks = {name: how for name, how in FALLBACKS.items() if name not in given}
        if self.inputs.command.type == MOTION:
            fallbacks["command"] = COMMAND_FALLBACK.format(topic=self.inputs.command.topic)
        for name, source in given.items():
            if source.wheelbase_m is not None:
                how = STEERED.format(wheelbase_m=source.wheelbase_m, topic=source.topic)
                fallbacks[f"{name}.yaw_rate_radps"] = how
        if self.command_sources and "behaviour_policy" in fallbacks:
            names = ", ".join(self.command_sources)
            if (through := self.command_through) is not None:
                names += f" (the one that {through.topic} repeats, which the command follows)"
            fallbacks["behaviour_policy"] = POLICY_FALLBACK.format(names=names)
        if self.inputs.pose is None:
            fallbacks["pose"] = POSE_FALLBACK
        elif self.inputs.pose.by_fix and self.inputs.heading is None:
            fallbacks["heading"] = FIX_FALLBACK.format(track_m=self.inputs.pose.track_m or 1.0)
        if self.motion is not None:
            fallbacks["wheels"] = WHEELS_FALLBACK.format(window_s=self.motion.window_s)
        if self.task.goal == "none":
            fallbacks |= dict.fromkeys(("goal", "plan"), ROUTE_FALLBACK)
        elif self.goal.source == "hindsight":
            fallbacks |= HINDSIGHT
        return fallbacks

    @property
    def goal_source(self) -> GoalSource | None:
        """Where the goals of its rows come from; None: they have none."""
        return self.goal.source if self.task.goal == "route" else None

    def zone_of(self, x_m: NDArray[Any], y_m: NDArray[Any]) -> list[str]:
        """The name of the first zone that holds each point (N,), or `elsewhere`."""
        x, y = np.asarray(x_m, np.float64), np.asarray(y_m, np.float64)
        index = np.full(x.shape, len(self.zones), np.intp)
        for position in reversed(range(len(self.zones))):
            index[self.zones[position].holds(x, y)] = position
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
    profile = _typed(read_toml(path), where=where, folder=path.parent)
    # Of stores too it would shut out those that an older Restock wrote: here, and in the twin.
    refuse_beyond_steering(profile.robot, profile.task.actions, where=where)
    return profile


def parse_profile(text: str, *, where: str, folder: Path | None = None) -> Profile:
    """A profile from its TOML text; `where` names it in errors, `.sql` files lie in `folder`."""
    return _typed(parse_toml(text, where=where), where=where, folder=folder)


def _typed(document: dict[str, Any], *, where: str, folder: Path | None) -> Profile:
    document = with_robot_file(with_files(document, folder, where), folder, where)
    signals = document.get("signals")
    # Each by itself first: msgspec's paths leave out the keys of a table of tables.
    for name, table in signals.items() if isinstance(signals, dict) else ():
        typed(table, CustomSignal, where=where, prefix=f"signals.{name}")
    cameras = document.get("cameras")
    for name, table in cameras.items() if isinstance(cameras, dict) else ():
        typed(table, Camera, where=where, prefix=f"cameras.{name}")
    profile = typed(document, Profile, where=where)
    if profile.inputs.scan is None:
        profile = without_lidar(profile)  # whatever number of sectors it gives
    _check(profile, where)
    return profile


def without_lidar(profile: Profile) -> Profile:
    """The same of a robot without a lidar: no scan, and no sectors in its observation."""
    return msgspec.structs.replace(
        profile,
        inputs=msgspec.structs.replace(profile.inputs, scan=None),
        task=msgspec.structs.replace(profile.task, sectors=0),
    )


def _check(profile: Profile, where: str) -> None:
    """What the types alone do not say."""
    kinds: tuple[tuple[Kind, str, Sequence[str]], ...] = (
        ("outcome", "conditions", profile.shipped_conditions),
        ("exposure", "exposures", profile.shipped_exposures),
    )
    for kind, key, given in kinds:
        known = shipped(kind=kind)
        for name in given:
            if name not in known:
                raise ConfigError(
                    f"`{key}`: no {'condition' if kind == 'outcome' else kind} named {name!r}",
                    where=where,
                    remedy=f"shipped are {', '.join(known)}; write your own as [[condition]]"
                    + (' with kind = "exposure"' if kind == "exposure" else ""),
                )
    names = [condition.name for condition in profile.definitions]
    if doubled := sorted({name for name in names if names.count(name) > 1}):
        raise ConfigError(f"`conditions`: {', '.join(doubled)} given twice", where=where)
    for name, source in profile.inputs.items():
        check_input(name, source, where, framed=profile.frames is not None)
    if profile.inputs.scan is not None and not profile.task.sectors:
        raise ConfigError(
            "`task.sectors` is 0, which is of a robot without a lidar, and `inputs.scan` is given",
            where=where,
            remedy="give the number of sectors (36 by default), or leave [inputs.scan] out",
        )
    for name, source in profile.command_sources.items():
        check_command_source(f"{COMMAND_SOURCES}.{name}", source, profile.inputs.command, where)
    if profile.command_through is not None:
        if not profile.command_sources:
            raise ConfigError(
                "`command_through` is given and no `command_sources`: it says by whom nothing is",
                where=where,
                remedy="name the topics that it chooses among, or leave it out",
            )
        check_command_source(
            COMMAND_THROUGH, profile.command_through, profile.inputs.command, where
        )
    pose = profile.inputs.pose
    if profile.inputs.heading is not None and not (pose is not None and pose.by_fix):
        raise ConfigError(
            "`inputs.heading` is of a pose by latitude and longitude, which has none of its own",
            where=where,
            remedy="leave it out: other poses say where they face",
        )
    if pose is None and profile.frames is None:
        raise ConfigError(
            "`inputs.pose` is missing, and there is no `frames`",
            where=where,
            remedy="name the topic of the pose, or take it from /tf: [frames] fixed and base",
        )
    if (profile.inputs.wheels is None) == (profile.motion is None):
        both = profile.motion is not None
        raise ConfigError(
            "`inputs.wheels` and `motion` are both given"
            if both
            else "`inputs.wheels` is missing, and there is no `motion`",
            where=where,
            remedy="keep one: wheels where odometry is recorded, motion for speeds from poses"
            if both
            else "name the topic of the odometry, or take speeds from poses: [motion] window_s",
        )
    if profile.motion is not None and "wheel_slip" in profile.shipped_conditions:
        raise ConfigError(
            "`conditions`: wheel_slip cannot be seen where speeds come from poses ([motion])",
            where=where,
            remedy="leave wheel_slip out, or name the odometry under [inputs.wheels]",
        )
    _check_goal(profile, where)
    proposed = profile.inputs.nav_command
    if proposed is not None and proposed.topic == profile.inputs.command.topic:
        raise ConfigError(
            f"`inputs.nav_command.topic` is the command's own, {proposed.topic}: an observation"
            " would hold the action that is chosen after it",
            where=where,
            remedy="name the topic on which the navigation stack proposes, ahead of whoever"
            " decides, or leave [inputs.nav_command] out",
        )
    robot, actions = profile.robot, profile.task.actions
    if robot is not None and (problem := beyond_limits(robot, actions)):
        raise ConfigError(
            f"`task.actions`: {problem}",
            where=where,
            remedy="slow the action down, or correct the limit: the robot would not follow it",
        )
    for name in profile.signals:
        if problem := name_problem(name):
            raise ConfigError(f"`signals.{name}`: {problem}", where=where)
    for name in profile.cameras:
        if problem := camera_name_problem(name):
            raise ConfigError(f"`cameras.{name}`: {problem}", where=where)
    _check_conditions(profile, where)


def _check_goal(profile: Profile, where: str) -> None:
    """That goals and plans come from somewhere, and from one place alone."""
    if profile.task.goal == "none":
        if profile.goal.source == "hindsight":
            raise ConfigError(
                "`goal.source` is 'hindsight', and `task.goal` is 'none'",
                where=where,
                remedy='set task.goal = "route", or leave goal.source out',
            )
        return
    by_hindsight = profile.goal.source == "hindsight"
    for name in ("goal", "plan"):
        given = getattr(profile.inputs, name) is not None
        if by_hindsight and given:
            raise ConfigError(
                f"`inputs.{name}` is given, and `goal.source` is 'hindsight': it would not be used",
                where=where,
                remedy=f'leave inputs.{name} out, or set goal.source = "logged"',
            )
        if not by_hindsight and not given:
            raise ConfigError(
                f"`inputs.{name}` is missing, and `task.goal` is 'route'",
                where=where,
                remedy=f"name the topic of the {name}; or take goals by hindsight, [goal]"
                ' source = "hindsight"; or set task.goal = "none"',
            )


def _check_conditions(profile: Profile, where: str) -> None:
    """That every condition of the profile's own binds to the steps that there will be."""
    fields = [signal.field(name) for name, signal in profile.signals.items()]
    steps = steps_schema(fields).empty_table()
    for place, condition in enumerate(profile.own_conditions):
        condition = condition.with_constants(profile.noise.constants)
        try:
            label_with_probabilities(steps, [condition])
        except ConfigError as error:
            raise ConfigError(
                f"`condition[{place}].sql` ({condition.name!r}): {error.what}",
                where=where,
                remedy=error.remedy,
            ) from error
