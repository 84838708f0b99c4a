"""Profiles: how one kind of robot's topics fill the signals, and the task that is learnt on them.

A profile is a TOML file: `name`, the shipped `conditions` and `exposures` it uses, `[[condition]]`
of its own, `[task]`, `[goal]` (logged, or in hindsight), `[clock]`, `[episodes]`, `[inputs.*]`
(topics that fill the signals), `[command_sources.*]` (drivers whose command it may be), `[frames]`
(poses from transforms), `origin_m` (origin of positions), `[motion]` (speeds from poses),
`[signals.*]` (custom columns), `[cameras.*]` (frames to keep), `[tags]` (robot, site and more),
`[robot]` (model for the twin), `[limiter]` (of a policy's commands) and `[[zone]]` (named
rectangles of the map). `load_profile("warehouse_amr")` reads a profile that comes with Restock,
`load_profile("my_robot.toml")` a file.

Stores, panels and runs contain a profile as one TOML text that needs no other file (see
`profile_toml`). It includes the SQL of each `[[condition]]` that was a file, and only the names of
shipped conditions. The text may come from a stranger and is read like a profile file: values are
type-checked and SQL runs in the same sandbox; but no file is opened.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from difflib import get_close_matches
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from restock.errors import ConfigError
from restock.ingest.profile.tables import (
    COMMAND_FALLBACK,
    COMMAND_SOURCES,
    FALLBACKS,
    FIX_FALLBACK,
    HINDSIGHT,
    POLICY_FALLBACK,
    POSE_FALLBACK,
    RECKONED,
    ROUTE_FALLBACK,
    SCANS,
    STEERED,
    WHEELS_FALLBACK,
    Camera,
    Clock,
    CustomSignal,
    Episodes,
    Frames,
    Input,
    Inputs,
    Motion,
    Zone,
    camera_name_problem,
    check_command_source,
    check_input,
    check_scans,
    is_motion,
    name_problem,
)
from restock.ingest.profile.tag_rules import TagRules
from restock.ingest.task.conditions import (
    DRIVEN_PLAN,
    Condition,
    Kind,
    label_with_probabilities,
    labels_version,
    of_kind,
    reported,
    shipped,
    signals_named,
    with_files,
)
from restock.ingest.task.hindsight import GoalRules, GoalSource
from restock.ingest.task.robot import Limiter, Robot, beyond_limits, refuse_beyond_steering
from restock.ingest.task.schema import steps_schema
from restock.ingest.task.task import PLAN_SIGNALS, Noise, Task
from restock.ingest.task.task_sql import Past, own_sql, own_values
from restock.toml import Checked, changed, parse_toml, read_toml, toml_value, typed

ELSEWHERE = "elsewhere"
_NOT_IN_ROWS = ("conditions", "exposures", "condition", "tags", "noise", "robot", "limiter")


class Profile(Checked, frozen=True, dict=True):
    """A profile of one kind of robot. Read it with `load_profile`."""

    name: str
    task: Task
    inputs: Inputs
    doc: str = ""
    goal: GoalRules = GoalRules()
    shipped_conditions: list[str] = msgspec.field(default_factory=list, name="conditions")
    shipped_exposures: list[str] = msgspec.field(default_factory=list, name="exposures")
    own_conditions: list[Condition] = msgspec.field(default_factory=list, name="condition")
    behaviour_policy: str = "unknown"  # who drives, if no topic says so
    # Possible driver (a person, navigation) -> its own commands, before one driver is chosen.
    command_sources: dict[str, Input] = msgspec.field(default_factory=dict)
    clock: Clock = Clock()
    episodes: Episodes = Episodes()
    zones: list[Zone] = msgspec.field(default_factory=list, name="zone")
    # Point that is subtracted from all positions, as UTM coordinates are too large for float32.
    origin_m: tuple[float, float] | None = None
    frames: Frames | None = None
    motion: Motion | None = None
    signals: dict[str, CustomSignal] = msgspec.field(default_factory=dict)
    cameras: dict[str, Camera] = msgspec.field(default_factory=dict)
    tags: TagRules = TagRules()
    noise: Noise = Noise()
    robot: Robot | None = None  # None: the twin's default robot
    limiter: Limiter | None = None  # limits a policy's commands; None: from outline and actions

    @property
    def conditions(self) -> list[Condition]:
        """Return the outcomes that label this robot's steps."""
        return self._conditions_of("outcome", self.shipped_conditions)

    @property
    def exposures(self) -> list[Condition]:
        """Return the exposures (situations known before acting) that label this robot's steps."""
        return self._conditions_of("exposure", self.shipped_exposures)

    @property
    def constants(self) -> dict[str, float]:
        """Return named numbers that the SQL of conditions may use besides the columns of steps."""
        return self.noise.constants | self.task.condition_limits

    def _conditions_of(self, kind: Kind, names: Sequence[str]) -> list[Condition]:
        known = shipped(self.constants, kind)
        own = of_kind(self.own_conditions, kind)
        constants = self.constants
        return [known[name] for name in names] + [one.with_constants(constants) for one in own]

    @property
    def definitions(self) -> list[Condition]:
        """Return outcomes and exposures, outcomes first."""
        return [*self.conditions, *self.exposures]

    def shown_by_logs(self, conditions: Sequence[Condition]) -> list[Condition]:
        """Return those of `conditions` that can be evaluated from this robot's logs."""
        in_hindsight = self.goal_source == "hindsight"
        return reported(conditions, lidar=self.task.lidar, driven_plan=in_hindsight)

    @cached_property
    def labels_version(self) -> str:
        return labels_version(self.definitions)

    @cached_property
    def hash(self) -> str:
        """Return a hash of everything in the profile that rows depend on, 12 hex digits.

        Not hashed are the conditions and their [noise], as rows can be relabelled without the
        recordings and have a `labels_version`; the [tags]; and the tables [robot] and [limiter].
        """
        values = _without_none(msgspec.to_builtins(self))
        rest = {key: value for key, value in values.items() if key not in _NOT_IN_ROWS}
        return hashlib.blake2b(msgspec.json.encode(rest), digest_size=6).hexdigest()

    @property
    def transform_topics(self) -> tuple[str, ...]:
        """Return the topics of transforms that `[frames]` needs."""
        return (self.frames.topic, self.frames.static_topic) if self.frames else ()

    @property
    def sources(self) -> dict[str, Input]:
        """Return all inputs by name, including `command_sources.NAME`.

        Sources of commands are optional, and so are goal and plan if the task has no goal.
        """
        optional = {
            name: msgspec.structs.replace(source, optional=True)
            for name, source in self.inputs.items()
            if name in ("goal", "plan") and self.task.goal == "none"
        }
        optional |= {
            f"{COMMAND_SOURCES}.{name}": msgspec.structs.replace(source, optional=True)
            for name, source in self.command_sources.items()
        }
        return dict(self.inputs.items()) | optional

    @property
    def topics(self) -> list[str]:
        """Return every topic that the profile names."""
        named = [source.topic for source in self.sources.values()]
        named += [signal.topic for signal in self.signals.values()]
        named += [camera.topic for camera in self.cameras.values()]
        return list(dict.fromkeys([*named, *self.transform_topics]))

    @property
    def fallbacks(self) -> dict[str, str]:
        """Return what replaces each input that the profile leaves out, as text."""
        given = dict(self.inputs.items())
        fallbacks = {name: how for name, how in FALLBACKS.items() if name not in given}
        if is_motion(self.inputs.command.type):
            fallbacks["command"] = COMMAND_FALLBACK.format(topic=self.inputs.command.topic)
        for name, source in given.items():
            if source.wheelbase_m is not None:
                how = STEERED.format(wheelbase_m=source.wheelbase_m, topic=source.topic)
                fallbacks[f"{name}.yaw_rate_radps"] = how
        if self.command_sources and "behaviour_policy" in fallbacks:
            names = ", ".join(self.command_sources)
            fallbacks["behaviour_policy"] = POLICY_FALLBACK.format(names=names)
        if self.inputs.pose is None:
            fallbacks["pose"] = POSE_FALLBACK
        elif self.inputs.pose.by_rates:
            fallbacks["pose"] = RECKONED.format(topic=self.inputs.pose.topic)
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
        """Return where the goals of rows come from; None if rows have no goal."""
        return self.goal.source if self.task.goal == "route" else None

    def zone_of(self, x_m: NDArray[Any], y_m: NDArray[Any]) -> list[str]:
        """Return the name of the first zone that contains each point (N,), or `elsewhere`."""
        x, y = np.asarray(x_m, np.float64), np.asarray(y_m, np.float64)
        index = np.full(x.shape, len(self.zones), np.intp)
        for position in reversed(range(len(self.zones))):
            index[self.zones[position].holds(x, y)] = position
        names = [zone.name for zone in self.zones] + [ELSEWHERE]
        return [names[position] for position in index]


def shipped_profiles() -> list[str]:
    """Return the names of the profiles that come with Restock."""
    folder = files("restock.ingest.profile") / "profiles"
    return sorted(e.name.removesuffix(".toml") for e in folder.iterdir() if e.name[-5:] == ".toml")


def load_profile(name_or_path: str | Path) -> Profile:
    """Load a shipped profile by its name, or a profile file by its path.

    Raises:
        ConfigError: there is no such profile, or its TOML is invalid; names the file and the key.
    """
    where = str(name_or_path)
    if where in (names := shipped_profiles()):
        text = (files("restock.ingest.profile") / "profiles" / f"{where}.toml").read_text("utf-8")
        return parse_profile(text, where=f"profile {where!r}")
    path = Path(name_or_path)
    if not path.is_file():
        near = get_close_matches(where, names, n=1)
        raise ConfigError(
            "there is no such profile: it is neither a file nor the name of a shipped profile",
            where=where,
            remedy=f"did you mean {near[0]!r}?"
            if near
            else f"the shipped profiles are: {', '.join(names)}",
        )
    profile = _typed(read_toml(path), where=where, folder=path.parent)
    refuse_beyond_steering(profile.robot, profile.task.actions, where=where)
    return profile


def parse_profile(text: str, *, where: str) -> Profile:
    """Parse a profile from TOML text that refers to no files; `where` names the profile in errors.

    Raises:
        ConfigError: the TOML is invalid.
    """
    return _typed(parse_toml(text, where=where), where=where, folder=None)


def _typed(document: dict[str, Any], *, where: str, folder: Path | None) -> Profile:
    document = with_files(document, folder, where)
    signals = document.get("signals")
    # Check each table alone first: msgspec's errors in a whole document leave out its name.
    for name, table in signals.items() if isinstance(signals, dict) else ():
        typed(table, CustomSignal, where=where, prefix=f"signals.{name}")
    cameras = document.get("cameras")
    for name, table in cameras.items() if isinstance(cameras, dict) else ():
        typed(table, Camera, where=where, prefix=f"cameras.{name}")
    task = document.get("task")
    terms = task.get("reward_terms") if isinstance(task, dict) else None
    for name, term in terms.items() if isinstance(terms, dict) else ():
        if not isinstance(term, list):
            what = f'`task.reward_terms.{name}` must be [WEIGHT, "SQL"], got {term!r}'
            raise ConfigError(what, where=where)
    profile = typed(document, Profile, where=where)
    if not profile.inputs.scans:
        profile = without_lidar(profile)  # sets the task's number of sectors to 0, too
    check_profile(profile, where)
    return profile


def without_lidar(profile: Profile) -> Profile:
    """Return the profile without lidar: no scans and 0 sectors.

    Raises:
        ConfigError: the profile's task has tracks.
    """
    if profile.task.tracks:
        raise ConfigError(
            "`task.tracks` asks for tracks, which are made from lidar scans, and there are none",
            where=f"profile {profile.name!r}",
            remedy="leave `tracks` out of [task], or give the robot's scans in [inputs.scan]",
        )
    return msgspec.structs.replace(
        profile,
        inputs=msgspec.structs.replace(profile.inputs, **dict.fromkeys(SCANS)),
        task=msgspec.structs.replace(profile.task, sectors=0),
    )


def profile_toml(profile: Profile) -> str:
    """Format the profile as TOML with every default; `parse_profile` returns an equal profile."""
    values = _without_none(msgspec.to_builtins(profile))
    plain, tables = [], []
    for name, value in values.items():
        if isinstance(value, dict):
            tables += ["", f"[{name}]", *_lines(value)]
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            for entry in value:
                tables += ["", f"[[{name}]]", *_lines(entry)]
        else:
            plain += _lines({name: value})
    return "\n".join([*plain, *tables]) + "\n"


def with_conditions(profile: Profile, conditions: Sequence[Condition]) -> Profile:
    """Return the profile with its conditions replaced by these; shipped ones appear by name."""
    known = shipped(profile.constants) | shipped(profile.constants, "exposure")
    named = [c for c in conditions if known.get(c.name) == c]
    return msgspec.structs.replace(
        profile,
        shipped_conditions=[c.name for c in of_kind(named, "outcome")],
        shipped_exposures=[c.name for c in of_kind(named, "exposure")],
        own_conditions=[c for c in conditions if c not in named],
    )


def _without_none(value: Any) -> Any:
    """Drop None from built-in values: TOML has no null, and None is always the default."""
    if isinstance(value, dict):
        return {key: _without_none(item) for key, item in value.items() if item is not None}
    return [_without_none(item) for item in value] if isinstance(value, list | tuple) else value


def _lines(table: dict[str, Any]) -> list[str]:
    return [f"{name} = {toml_value(value)}" for name, value in table.items()]


def live_problems(profile: Profile) -> dict[str, str]:
    """Return what prevents a profile from running live: each problem, with what to do instead.

    Empty if the profile can run live.
    """
    found: dict[str, str] = {}
    pose = profile.inputs.pose
    named = "name a topic with the pose in the map frame under [inputs.pose]"
    if profile.frames is not None:
        found["its pose from transforms ([frames]), which are not held live"] = named
    elif pose is not None and pose.by_fix:
        found["its pose from satellite fixes, whose frame and heading are not computed live"] = (
            f"{named}, such as that of robot_localization's navsat_transform_node"
        )
    elif pose is not None and pose.by_rates:
        found["its pose by dead reckoning, which is not computed live"] = (
            f"{named}, such as that of its odometry"
        )
    if profile.goal_source == "hindsight":
        found["its goals in hindsight, which is not possible live"] = (
            "name the topics of goal and plan under [inputs.goal] and [inputs.plan], with"
            ' goal.source = "logged"'
        )
    return found


def check_profile(profile: Profile, where: str) -> None:
    """Raise ConfigError, naming the key, if a profile contradicts itself."""
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
                    remedy=f"the shipped ones are {', '.join(known)}; write your own as "
                    "[[condition]]" + (' with kind = "exposure"' if kind == "exposure" else ""),
                )
    names = [condition.name for condition in profile.definitions]
    if doubled := sorted({name for name in names if names.count(name) > 1}):
        raise ConfigError(f"`conditions`: {', '.join(doubled)} is given twice", where=where)
    for name, source in profile.inputs.items():
        check_input(name, source, where, framed=profile.frames is not None)
    check_scans(profile.inputs.scans, where)
    if profile.inputs.scan is not None and not profile.task.sectors:
        raise ConfigError(
            "`task.sectors` is 0 (a robot without a lidar), but `inputs.scan` is given",
            where=where,
            remedy="give the number of sectors (36 by default), or leave [inputs.scan] out",
        )
    for name, source in profile.command_sources.items():
        check_command_source(f"{COMMAND_SOURCES}.{name}", source, profile.inputs.command, where)
    pose = profile.inputs.pose
    if profile.inputs.heading is not None and not (pose is not None and pose.by_fix):
        raise ConfigError(
            "`inputs.heading` applies only to a pose by latitude and longitude, which has no "
            "heading",
            where=where,
            remedy="leave it out: other poses include the heading",
        )
    if pose is None and profile.frames is None:
        raise ConfigError(
            "`inputs.pose` is missing, and so is `frames`",
            where=where,
            remedy="give the topic of the pose, or take the pose from /tf: [frames] fixed and base",
        )
    if (profile.inputs.wheels is None) == (profile.motion is None):
        both = profile.motion is not None
        raise ConfigError(
            "`inputs.wheels` and `motion` are both given"
            if both
            else "`inputs.wheels` is missing, and there is no `motion`",
            where=where,
            remedy="keep one: wheels if odometry is recorded, motion to compute speeds from poses"
            if both
            else "give the topic of the odometry, or compute speeds from poses: [motion] window_s",
        )
    if profile.motion is not None and "wheel_slip" in profile.shipped_conditions:
        raise ConfigError(
            "`conditions`: wheel_slip cannot be detected if speeds are computed from poses "
            "([motion])",
            where=where,
            remedy="leave out wheel_slip, or give the odometry under [inputs.wheels]",
        )
    _check_goal(profile, where)
    proposed = profile.inputs.nav_command
    if proposed is not None and proposed.topic == profile.inputs.command.topic:
        raise ConfigError(
            f"`inputs.nav_command.topic` is the topic of the command, {proposed.topic}: the "
            "observation would contain the action",
            where=where,
            remedy="give the topic of the navigation stack's proposal, before the command is "
            "chosen, or leave out [inputs.nav_command]",
        )
    robot, actions = profile.robot, profile.task.actions
    if robot is not None and (problem := beyond_limits(robot, actions)):
        raise ConfigError(
            f"`task.actions`: {problem}",
            where=where,
            remedy="make the action slower, or correct the limit",
        )
    for name in profile.signals:
        if problem := name_problem(name):
            raise ConfigError(f"`signals.{name}`: {problem}", where=where)
    for name in profile.cameras:
        if problem := camera_name_problem(name):
            raise ConfigError(f"`cameras.{name}`: {problem}", where=where)
    _check_conditions(profile, where)


def _check_goal(profile: Profile, where: str) -> None:
    """Check that goals and plans have exactly one source."""
    rules = changed(profile.goal)
    if profile.goal.source == "logged" and rules:
        raise ConfigError(
            f"`goal.{rules[0]}` is given, and `goal.source` is 'logged': it would not be used",
            where=where,
            remedy='leave it out, or set goal.source = "hindsight"',
        )
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
                remedy=f"give the topic of the {name}; or take goals in hindsight, [goal] source ="
                ' "hindsight"; or set task.goal = "none"',
            )


def _check_conditions(profile: Profile, where: str) -> None:
    """Check that the SQL of own conditions, reward terms and observation entries runs on steps."""
    fields = [signal.field(name) for name, signal in profile.signals.items()]
    steps = steps_schema(fields).empty_table()
    for place, condition in enumerate(profile.own_conditions):
        condition = condition.with_constants(profile.constants)
        try:
            label_with_probabilities(steps, [condition])
        except ConfigError as error:
            raise ConfigError(
                f"`condition[{place}].sql` ({condition.name!r}): {error.what}",
                where=where,
                remedy=error.remedy,
            ) from error
    task = profile.task
    own = own_sql(task, "reward_terms") if task.reward_terms else []
    own += own_sql(task, "observed") if task.observed else []
    if profile.goal_source == "hindsight":
        for name, plan in signals_named(own, PLAN_SIGNALS).items():
            what = f"the SQL of {name!r} in [task] names {plan[0]}, and {DRIVEN_PLAN}"
            raise ConfigError(what, where=where, remedy="leave it out: nothing stood on it")
    try:
        if task.reward_terms:
            own_values(task, "reward_terms", steps)
        if task.observed:
            Past(task, "observed", 1, "a running robot")
    except ConfigError as error:
        what = f"{error.where}: {error.what}"
        raise ConfigError(what, where=where, remedy=error.remedy) from error
