"""What a profile must say beyond its types: keys that fit, names that exist, SQL that binds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from restock.errors import ConfigError
from restock.ingest.profile.custom_signal import name_problem
from restock.ingest.profile.inputs import (
    COMMAND_SOURCES,
    COMMAND_THROUGH,
    check_command_source,
    check_input,
    check_scans,
)
from restock.ingest.profile.tables import camera_name_problem
from restock.ingest.task.condition_files import shipped
from restock.ingest.task.conditions import Kind, label_with_probabilities
from restock.ingest.task.robot import beyond_limits
from restock.ingest.task.schema import steps_schema
from restock.toml import changed

if TYPE_CHECKING:
    from restock.ingest.profile.profile import Profile


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
    if profile.command_through is not None:
        if not profile.command_sources:
            raise ConfigError(
                "`command_through` is given without `command_sources`",
                where=where,
                remedy="give the topics among which it chooses, or leave it out",
            )
        check_command_source(
            COMMAND_THROUGH, profile.command_through, profile.inputs.command, where
        )
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
    _check_goal_rules(profile, where)
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
    """Check that goals and plans come from somewhere, and from one place alone."""
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


def _check_goal_rules(profile: Profile, where: str) -> None:
    """Raise ConfigError if a profile says how goals are found, and they are not found so."""
    goal, source = profile.task.goal, profile.goal.source
    rules = [f"goal.{key}" for key in changed(profile.goal)]
    limits = changed(profile.episodes, ("goal_moved_m", "plan_goal_tolerance_m"))
    limits = [f"episodes.{key}" for key in limits]
    for unused, keys, decides, now, instead in (
        (source == "logged", rules, "goal.source", source, "hindsight"),
        (source == "hindsight", limits, "goal.source", source, "logged"),
        (goal == "none", limits, "task.goal", goal, "route"),
    ):
        if unused and keys:
            raise ConfigError(
                f"`{keys[0]}` is given, and `{decides}` is {now!r}: it would not be used",
                where=where,
                remedy=f'leave {keys[0]} out, or set {decides} = "{instead}"',
            )


def _check_conditions(profile: Profile, where: str) -> None:
    """Check that each condition of the profile's own binds to the columns of steps."""
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
