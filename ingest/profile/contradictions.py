"""Finds what in a profile contradicts itself: the rules about several of its keys at once.

Each rule yields a problem, which names the key, and a remedy. Rules about a single key belong to
the key's type, and are checked when the TOML is read.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, TypeAlias

from restock.ingest.profile.signal_paths import IN, UNITS, PathProblem, factor_of, pressed_paths
from restock.ingest.profile.tables import (
    BY_FIX,
    BY_RATES,
    CLOUD,
    COMMAND_SOURCES,
    FALLBACKS,
    INPUT_FIELDS,
    SCAN_OF_CLOUD,
    SCANS,
    TURNS,
    Input,
    camera_name_problem,
    name_problem,
)
from restock.ingest.task.conditions import shipped
from restock.ingest.task.robot import beyond_limits
from restock.toml import changed

if TYPE_CHECKING:
    from restock.ingest.profile.profile import Profile

Problem: TypeAlias = "tuple[str, str | None]"  # what is wrong, naming the key; what to do
_COMMAND, _SCAN, _CLOUD, _FIX = (
    *("a command", "a scan", f"a scan of {CLOUD}"),
    "a pose by latitude and longitude",
)
_APPLIES_TO = {  # setting of an input -> the only kind of input that has it
    "stop_holds": _COMMAND,
    **dict.fromkeys(("upside_down", "lidar_at_m", "lidar_yaw_rad"), _SCAN),
    **dict.fromkeys(("height_m", "angle_rad"), _CLOUD),
    **dict.fromkeys(("origin_deg", "max_std_m", "track_m"), _FIX),
}


def contradictions(profile: Profile) -> Iterator[Problem]:
    """Yield each problem of a profile, the SQL of its conditions and its task apart."""
    yield from _named_conditions(profile)
    for name, source in profile.inputs.items():
        yield from _input(f"inputs.{name}", name, source)
        yield from _fields(name, source)
        if source.optional and name not in FALLBACKS and not (name == "pose" and profile.frames):
            yield (
                f"`inputs.{name}.optional`: {name} has no fallback, so it cannot be optional",
                f"optional may be {', '.join(FALLBACKS)}, and pose where there is [frames]",
            )
    yield from _scans(profile)
    for name, source in profile.command_sources.items():
        yield from _command_source(f"{COMMAND_SOURCES}.{name}", source, profile.inputs.command)
    yield from _pose_and_motion(profile)
    yield from _goal(profile)
    proposed = profile.inputs.nav_command
    if proposed is not None and proposed.topic == profile.inputs.command.topic:
        yield (
            f"`inputs.nav_command.topic` is the topic of the command, {proposed.topic}: the "
            "observation would contain the action",
            "give the topic of the navigation stack's proposal, before the command is chosen, or "
            "leave out [inputs.nav_command]",
        )
    robot, actions = profile.robot, profile.task.actions
    if robot is not None and (problem := beyond_limits(robot, actions)):
        yield f"`task.actions`: {problem}", "make the action slower, or correct the limit"
    for name in profile.signals:
        if problem := name_problem(name):
            yield f"`signals.{name}`: {problem}", None
    for name in profile.cameras:
        if problem := camera_name_problem(name):
            yield f"`cameras.{name}`: {problem}", None


def _named_conditions(profile: Profile) -> Iterator[Problem]:
    """Check that the shipped conditions and exposures exist, and that each name occurs once."""
    outcomes, exposures = shipped(kind="outcome"), shipped(kind="exposure")
    for name in profile.shipped_conditions:
        if name not in outcomes:
            ships = f"the shipped ones are {', '.join(outcomes)}"
            remedy = f"{ships}; write your own as [[condition]]"
            yield f"`conditions`: no condition named {name!r}", remedy
    for name in profile.shipped_exposures:
        if name not in exposures:
            ships = f"the shipped ones are {', '.join(exposures)}"
            remedy = f'{ships}; write your own as [[condition]] with kind = "exposure"'
            yield f"`exposures`: no exposure named {name!r}", remedy
    names = [condition.name for condition in profile.definitions]
    if doubled := sorted({name for name in names if names.count(name) > 1}):
        yield f"`conditions`: {', '.join(doubled)} is given twice", None


def _input(key: str, name: str, source: Input) -> Iterator[Problem]:
    """Check the settings and units of an input, or of a source of commands (`name` is "")."""
    kinds = {
        _COMMAND: name == "command",
        _SCAN: name in SCANS,
        _CLOUD: name in SCANS and source.type == CLOUD,
        _FIX: source.by_fix,
    }
    for setting, kind in _APPLIES_TO.items():
        if getattr(source, setting) not in (None, False) and not kinds[kind]:
            yield f"`{key}.{setting}` applies only to {kind}", "leave it out"
    for field, path in source.fields.items():
        if factor_of(field, path) is None:
            units = ", ".join(unit for units in UNITS.values() for unit in units)
            yield (
                f"`{key}.fields.{field}`: {path!r} has an unknown unit",
                f"after a speed or a yaw rate:{IN}{units}",
            )
    if ("steering_rad" in source.fields) != (source.wheelbase_m is not None):
        yield (
            f"`{key}`: steering_rad and wheelbase_m belong together",
            "wheelbase_m is the distance between the axles, in metres",
        )
    try:
        pressed_paths(source.fields.get("pressed", "data"))
    except PathProblem as problem:
        yield (
            f"`{key}.fields.pressed`: {source.fields['pressed']!r} {problem}",
            'give a field, or several: "is_left_pressed or is_right_pressed"',
        )


def _fields(name: str, source: Input) -> Iterator[Problem]:
    """Check that an input has the fields that it needs, and no others."""
    form = INPUT_FIELDS[name]
    if name == "pose" and (source.by_fix or source.by_rates):
        form = BY_FIX if source.by_fix else BY_RATES
    given = [key for key in form.either if key in source.fields]
    missing = sorted(form.needs - source.fields.keys())
    missing += form.either[:1] if not given else []
    problems = [f"unknown {key!r}" for key in sorted(source.fields.keys() - form.known)]
    problems += [f"unknown '{key} beside {given[0]}'" for key in given[1:]]
    problems += [f"missing {key!r}" for key in missing]
    if problems:
        remedy = f"{name} has the fields {', '.join(form.known)}"
        yield f"`inputs.{name}.fields`: {', '.join(problems)}", remedy


def _scans(profile: Profile) -> Iterator[Problem]:
    """Check the settings of all lidars, and that the task has sectors for them."""
    scans = profile.inputs.scans
    for name, source in scans.items():
        if source.lidar_yaw_rad is not None and source.lidar_at_m is None:
            yield (
                f"`inputs.{name}.lidar_yaw_rad` is given without lidar_at_m",
                "give both, or lidar_x_m and lidar_yaw_rad of [task.body]",
            )
        if source.type == CLOUD:
            yield from _cloud(f"inputs.{name}", source)
    if scans and "scan" not in scans:
        remedy = "name the first lidar scan"
        yield f"`inputs.{next(iter(scans))}` is given without `inputs.scan`", remedy
    for name, source in scans.items() if len(scans) > 1 else ():
        if source.lidar_at_m is None:
            yield (
                f"`inputs.{name}.lidar_at_m` is missing: with several lidars, each needs its place",
                "give lidar_at_m = [AHEAD, LEFT], from the middle of the outline, and"
                " lidar_yaw_rad",
            )
        if source.optional:
            yield (
                f"`inputs.{name}.optional`: with several lidars, none is optional: rows would "
                "silently lack what only that one sees",
                "leave it out, and give recordings without it a profile of their own",
            )
    if len({source.topic for source in scans.values()}) < len(scans):
        yield f"`inputs.{list(scans)[-1]}.topic`: two lidars have the same topic", None
    if scans and not profile.task.sectors:
        yield (
            "`task.sectors` is 0 (a robot without a lidar), but `inputs.scan` is given",
            "give the number of sectors (36 by default), or leave [inputs.scan] out",
        )


def _cloud(key: str, source: Input) -> Iterator[Problem]:
    """Check the settings that turn a point cloud into a scan."""
    if source.height_m is None or source.fields != SCAN_OF_CLOUD:
        fields = ", ".join(f'{name} = "{path}"' for name, path in SCAN_OF_CLOUD.items())
        yield (
            f"`{key}`: a point cloud is read as the scan of a slice of it",
            "give the slice, height_m = [LOW, HIGH] above the lidar, at which the robot can hit "
            f"something, and the fields of that scan: fields = {{ {fields} }}",
        )
    for setting in ("height_m", "angle_rad"):
        low, high = getattr(source, setting) or (0, 1)
        if not low < high:
            yield f"`{key}.{setting}` must be [LOW, HIGH], got {[low, high]}", None


def _command_source(key: str, source: Input, command: Input) -> Iterator[Problem]:
    """Check that a source of commands has commands, or a button that is pressed while it drives."""
    by_button = source.fields.keys() == {"pressed"}
    if not by_button and all(source.fields.keys() != {"speed_mps", turn} for turn in TURNS):
        yield (
            f"`{key}.fields`: {', '.join(source.fields) or 'nothing'} does not show when this "
            "source drives",
            "give speed_mps with yaw_rate_radps (or steering_rad), or pressed alone",
        )
    if source.topic == command.topic and not by_button:
        yield (
            f"`{key}.topic` is the topic of the command, {command.topic}: this source would "
            "always be in force",
            "give the topic of this source's commands, before one of several sources is chosen",
        )
    yield from _input(key, "", source)


def _pose_and_motion(profile: Profile) -> Iterator[Problem]:
    """Check that pose and speeds have exactly one source each."""
    pose, wheels = profile.inputs.pose, profile.inputs.wheels
    if profile.inputs.heading is not None and not (pose is not None and pose.by_fix):
        yield (
            "`inputs.heading` applies only to a pose by latitude and longitude, which has no "
            "heading",
            "leave it out: other poses include the heading",
        )
    if pose is None and profile.frames is None:
        yield (
            "`inputs.pose` is missing, and so is `frames`",
            "give the topic of the pose, or take the pose from /tf: [frames] fixed and base",
        )
    if wheels is None and profile.motion is None:
        yield (
            "`inputs.wheels` is missing, and there is no `motion`",
            "give the topic of the odometry, or compute speeds from poses: [motion] window_s",
        )
    if wheels is not None and profile.motion is not None:
        yield (
            "`inputs.wheels` and `motion` are both given",
            "keep one: wheels if odometry is recorded, motion to compute speeds from poses",
        )
    if profile.motion is not None and "wheel_slip" in profile.shipped_conditions:
        yield (
            "`conditions`: wheel_slip cannot be detected if speeds are computed from poses "
            "([motion])",
            "leave out wheel_slip, or give the odometry under [inputs.wheels]",
        )


def _goal(profile: Profile) -> Iterator[Problem]:
    """Check that goals and plans have exactly one source."""
    by_hindsight = profile.goal.source == "hindsight"
    if not by_hindsight and (rules := changed(profile.goal)):
        yield (
            f"`goal.{rules[0]}` is given, and `goal.source` is 'logged': it would not be used",
            'leave it out, or set goal.source = "hindsight"',
        )
    if profile.task.goal == "none":
        if by_hindsight:
            yield (
                "`goal.source` is 'hindsight', and `task.goal` is 'none'",
                'set task.goal = "route", or leave goal.source out',
            )
        return
    for name in ("goal", "plan"):
        given = getattr(profile.inputs, name) is not None
        if by_hindsight and given:
            yield (
                f"`inputs.{name}` is given, and `goal.source` is 'hindsight': it would not be used",
                f'leave inputs.{name} out, or set goal.source = "logged"',
            )
        if not by_hindsight and not given:
            yield (
                f"`inputs.{name}` is missing, and `task.goal` is 'route'",
                f"give the topic of the {name}; or take goals in hindsight, [goal] source ="
                ' "hindsight"; or set task.goal = "none"',
            )
