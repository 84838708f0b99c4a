"""The text of a proposed profile: TOML with a comment at each guess."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Sequence

import msgspec
import numpy as np

from restock.errors import ConfigError, visible
from restock.ingest.containers.topic_reading import TopicInfo
from restock.ingest.live.node_topics import with_node_topics
from restock.ingest.profile.inputs import FALLBACKS
from restock.ingest.profile.profile import parse_profile
from restock.ingest.propose.evidence.candidates import camera_lines
from restock.ingest.propose.evidence.clock_choice import ClockChoice
from restock.ingest.propose.evidence.footprint import Footprint
from restock.ingest.propose.evidence.gather import Evidence
from restock.ingest.propose.evidence.pose_choice import fix_lines, fix_noise_lines
from restock.ingest.propose.evidence.roles import (
    KINDS,
    LATCHED,
    REQUIRED,
    Kind,
    clouds_alone,
    robots_in,
)
from restock.ingest.propose.task_lines import actions_of, task_lines
from restock.ingest.propose.trial import Trial
from restock.ingest.task.condition_files import shipped
from restock.ingest.task.conditions import unseen
from restock.ingest.task.signals import Noise
from restock.toml import toml_value


def node_lines(seen: Evidence, lines: Sequence[str]) -> list[str]:
    """Write the tables for the node's recorded topics that the proposal does not have yet.

    Args:
        seen: with the node's topics.
        lines: the TOML of the proposal so far; where it lacks an input there is nothing to add to.
    """
    if not seen.node_topics:
        return []
    try:
        profile = parse_profile("\n".join(lines), where="the proposal")
    except ConfigError:
        return []
    full, heard = with_node_topics(profile), seen.node_topics.items()
    tables: list[tuple[str, msgspec.Struct]] = [
        (f"[command_sources.{name}]  # who drives while it is true", source)
        for name, source in full.command_sources.items()
        if name not in profile.command_sources and (source.topic, source.type) in heard
    ]
    signals = {
        name: signal
        for name, signal in full.signals.items()
        if name not in profile.signals and (signal.topic, signal.type) in heard
    }
    tables += [(f"[signals.{name}]", signal) for name, signal in signals.items()]
    tables += [
        ("[[condition]]", condition)
        for condition in full.own_conditions
        if condition not in profile.own_conditions and "limiter_rule" in signals
    ]
    added = [line for header, table in tables for line in [header, *_given(table), ""]]
    return ["# Published by Restock's node, or for it:", "", *added] if added else []


def _given(table: msgspec.Struct) -> list[str]:
    """Write the keys of a table that are not at their defaults."""
    values = msgspec.to_builtins(table)
    return [
        f"{one.name} = {toml_value(values[one.encode_name])}"
        for one in msgspec.structs.fields(table)
        if values[one.encode_name] not in (one.default, {})
    ]


# The fields of what nothing fills, for a person to name.
BY_HAND = {"command": ("speed_mps", "yaw_rate_radps"), "pose": ("x_m", "y_m", "yaw_rad")}


def in_one_recording(robots: Sequence[str]) -> str:
    """Say whose profile it is, if a recording is of several robots."""
    others = ", ".join(robots[1:6]) + (", …" if len(robots) > 6 else "")
    return (
        f"of the robot {robots[0]}, one of {len(robots)} in the recording: `restock profile new "
        f"--robot NAME` proposes another profile, for {others}, of another name; ingest with it "
        "into another store, as a store keeps one set of rows of a recording"
    )


def profile_lines(
    seen: Evidence, name: str, problems: list[str], trial: Trial | None = None
) -> list[str]:
    """Write the TOML of a profile, with what a `trial` of it made of the recording."""
    recording, seconds = seen.recording, seen.recorded_s
    trial = trial or Trial()
    robots = robots_in(recording)
    of_one_robot = f"It is {in_one_recording(robots)}." if robots else ""
    lines = [
        f"# Proposed from {recording.path.name}: check the comments, then run",
        f"# restock profile check THIS_FILE {recording.path.name}",
        *(f"# NOT USABLE YET: {problem}" for problem in problems),
        *(f"# {line}" for line in textwrap.wrap(of_one_robot, 98)),
        *_trial_lines(trial),
        "#",
        *_topic_lines(seen),
        f'name = "{name}"',
        f"conditions = {json.dumps(_conditions(seen))}",
        *_unknown_lines(seen),
        *_slip_lines(seen),
        f"exposures = {json.dumps(_exposures(seen))}  # situations, whatever came of them",
        f'behaviour_policy = "{seen.chosen.policy}"  # {seen.chosen.why}',
        *_origin_lines(seen),
        "",
        *task_lines(seen, trial),
        *seen.goal.table_lines(),
        *_robot_lines(seen),
        *_noise_lines(seen, trial),
        *_clock_lines(seen.clock),
    ]
    for role, fitting in seen.roles.items():
        if role == "pose" and seen.poses_from_frames:
            lines += ["# [inputs.pose]  # from transforms, by [frames]", ""]
        else:
            lines += _input_lines(role, fitting, seen, trial)
    lines += seen.chosen.toml(seen.commands.wheelbase_m)
    if seen.frames is not None:
        lines += seen.frames.lines(used=seen.poses_from_frames)
    if seen.motion is not None and not seen.motion.problem:
        lines += seen.motion.lines()
    lines += node_lines(seen, lines)
    if seen.signals:
        lines += [
            "# Custom signals: columns of the table, for conditions and queries. To use one,",
            "# remove the first # of its lines; docs/profile.md describes paths.",
            "",
        ]
    for signal in seen.signals:
        lines += ["# " + line for line in signal.toml(_max_age_s(signal.topic, seconds))] + [""]
    lines += camera_lines(seen.cameras)
    # Names are of a stranger: a line break in one starts no key.
    return [visible(line) for line in [*lines, *_ENDING]]


def _origin_lines(seen: Evidence) -> list[str]:
    if seen.origin_m is None:
        return []
    x, y = seen.origin_m
    return [f"origin_m = [{x}, {y}]  # of all positions: poses are far from 0 (UTM?)"]


def _conditions(seen: Evidence) -> list[str]:
    """Return the shipped conditions that this robot's signals can show."""
    slip = ["wheel_slip"] if _shows_slip(seen) else []
    return ["recovery", "near_collision", *slip, "blocked_aisle"]


def _shows_slip(seen: Evidence) -> bool:
    """Return whether anything beside its wheels shows how the robot moved."""
    return bool(seen.roles["wheels"]) and seen.motion is None and not _slip_lines(seen)


def _slip_lines(seen: Evidence) -> list[str]:
    """Say why odometry alone shows no slip."""
    pose, wheels = (seen.roles[role][:1] for role in ("pose", "wheels"))
    same = pose and wheels and pose[0][0].name == wheels[0][0].name and not seen.poses_from_frames
    if not same or seen.roles["imu"]:
        return []
    return [
        f"# No wheel_slip: poses and wheel speeds are both of {pose[0][0].name}, and there is no"
        " IMU: nothing would show it."
    ]


def _unknown_lines(seen: Evidence) -> list[str]:
    """Name the conditions that are unknown for a robot without a lidar."""
    if seen.roles["scan"]:
        return []
    known = shipped()
    names = unseen([known[name] for name in _conditions(seen)])
    clouds = clouds_alone(seen.recording, seen.roles)
    return [
        f"# No {'laser scan' if clouds else 'lidar'}: {', '.join(names)} are unknown (null, neither"
        " true nor false).",
        *(f"# {line}" for line in textwrap.wrap(clouds, 96)),
    ]


def _exposures(seen: Evidence) -> list[str]:
    """Return the shipped exposures that this robot's signals can show."""
    slip = ["slippery_floor"] if _shows_slip(seen) else []
    return slip + (["closing_traffic", "plan_blocked"] if seen.roles["scan"] else [])


_ENDING = [
    "# A condition of your own: one SQL expression over the steps of an episode:",
    "# [[condition]]",
    '# name = "tight"',
    '# timing = "pre"  # "post" may look ahead',
    '# sql = "clearance_m < 0.3 AND command_speed_mps > 0"',
    "",
    "# Named rectangles of the map, for coverage by place:",
    "# [[zone]]",
    '# name = "aisle_1"',
    "# box_m = [0.0, 0.0, 10.0, 1.8]  # x0, y0, x1, y1",
    "",
]


def _trial_lines(trial: Trial) -> list[str]:
    """Say what the profile makes of the recording it is proposed from."""
    if not trial.ticks:
        return []
    most = [f"{reason} {count:,}" for reason, count in list(trial.dropped.items())[:3]]
    dropped = f" (dropped: {', '.join(most)})" if most else ""
    found = (f"CONTRADICTS ITSELF: {one}" for one in trial.findings if not one.repaired)
    return [
        f"# It gives {trial.transitions:,} transitions from {trial.ticks:,} ticks{dropped}.",
        *(f"# {line}" for one in found for line in textwrap.wrap(one, 98)),
    ]


def _topic_lines(seen: Evidence) -> list[str]:
    """List every topic with its rate and its use, as a comment."""
    recording, seconds = seen.recording, seen.recorded_s
    taken: dict[str, list[str]] = {name: ["Restock's node"] for name in seen.node_topics}
    for role, found in seen.roles.items():
        if found:
            taken.setdefault(found[0][0].name, []).append(role)
    width = max((len(name) for name in recording.topics), default=0)
    kinds = max((len(topic.type) for topic in recording.topics.values()), default=0)
    lines = []
    for name, topic in recording.topics.items():
        rate = f"{topic.expected / seconds:7.1f} Hz" if seconds > 0 else " " * 10
        why = f"skipped: {topic.skipped}" if topic.skipped else ", ".join(taken.get(name, []))
        lines.append(f"# {name:<{width}}  {topic.type:<{kinds}}  {rate}  {why}".rstrip())
    return [*lines, ""]


def steered_by(seen: Evidence) -> str:
    """Say how the Twists of a robot that steers as a car are read; "" of other robots."""
    steers = seen.robot.values.get("drive") == "ackermann"
    if not (steers and seen.roles["command"]) or seen.commands.steered or seen.commands.measured:
        return ""
    path = seen.roles["command"][0][1].fields["yaw_rate_radps"]
    return (
        f"the robot steers as a car, and {path} is read as a yaw rate, as the message defines it."
        " If it is the angle of the front wheels, write steering_rad in place of yaw_rate_radps,"
        " and add wheelbase_m"
    )


def _robot_lines(seen: Evidence) -> list[str]:
    """Write what the twin builds; the actions are within its limits."""
    robot = seen.robot.limited(*seen.commands.reached)
    fastest = np.abs(actions_of(seen.commands, robot)).max(axis=0).tolist()
    return robot.lines(*fastest, outline_guessed=not seen.footprint.measured)


def _fixes(seen: Evidence) -> tuple[TopicInfo, Kind] | None:
    """Return the topic of the fixes that its pose is from, or None."""
    pose = seen.roles["pose"][:1]
    return pose[0] if pose and pose[0][1].by_fix else None


def _noise_lines(seen: Evidence, trial: Trial) -> list[str]:
    """Write how noisy its poses are, if that is more than a profile's default."""
    if (fixes := _fixes(seen)) is None:
        noise_m = trial.pose_noise_m
        if noise_m is None or noise_m <= Noise().localiser_m or not _shows_slip(seen):
            return []
        return [
            "[noise]",
            f"localiser_m = {noise_m:.2g}  # poses and wheels differ by more than the default"
            f" {Noise().localiser_m:g} allows for: less would be taken for slip",
            "",
        ]
    topic, kind = fixes
    apart_s = max(seen.paces_s.get(topic.name, 0.25), seen.clock.period_s)
    driven_m = 2 * seen.commands.speed_mps * apart_s
    return fix_noise_lines(seen.recording, topic.name, kind.fields, driven_m)


def _clock_lines(clock: ClockChoice) -> list[str]:
    offset = ""
    if (ahead_s := clock.ahead_s) is not None:
        where = "ahead of" if ahead_s >= 0 else "behind"
        offset = f"  # log time is {abs(ahead_s):,.3f} s {where} it"
    why = "no commands seen" if clock.every_s is None else f"a command every {clock.every_s:.2f} s"
    return [
        "[clock]",
        *(f"# {comment}" for comment in clock.comments),
        f'alignment = "{clock.alignment}"' + offset,
        f'steps = "{clock.steps}"  # {why}' + ("" if clock.every_s is None else ", mostly"),
        f"max_gap_s = {clock.max_gap_s:g}  # a longer one ends an episode",
        "",
    ]


def _max_age_s(topic: TopicInfo, seconds: float) -> float | None:
    """Return four periods of a topic; None (latched) if it has few messages."""
    rate = topic.expected / seconds if seconds > 0 else 0.0
    if topic.expected < 3 or rate < 0.05:
        return None
    return float(np.clip(round(4 / rate, 1), 0.2, 10.0))


def _input_lines(
    role: str, fitting: list[tuple[TopicInfo, Kind]], seen: Evidence, trial: Trial
) -> list[str]:
    why = seen.unmeasured.get(role, "")
    if not fitting:
        reported = [f"# {line}" for line in textwrap.wrap(why, 96)]
        if role in REQUIRED:
            fits = " or ".join(dict.fromkeys(kind.type for kind in KINDS[role]))
            if role == "pose":
                fits += ", or transforms that join two frames"
            named = ", ".join(f'{key} = "FIELD"' for key in BY_HAND[role])
            return [
                *reported,
                f"# MISSING, and required: no topic of {fits}.",
                "# If one of another type has it (JSON, protobuf, the robot's own), name it here:",
                f"# [inputs.{role}]",
                '# topic = "/TOPIC"',
                '# type = "ITS TYPE"',
                f"# fields = {{ {named} }}",
                "# max_age_s = 0.5",
                "",
            ]
        if role == "wheels":
            by_hand = ["# [motion]", "# window_s = 0.5"] if seen.motion is None else []
            return [
                *reported,
                "# [inputs.wheels]  # no usable odometry; instead: speeds from poses",
                *by_hand,
                "",
            ]
        fallback = FALLBACKS.get(role) or seen.goal.fallback(role)
        none = "none of use" if why else "no topic seen"
        return [*reported, f"# [inputs.{role}]  # {none}; instead: {fallback}", ""]
    topic, kind = fitting[0]
    rate = topic.expected / seen.recorded_s if seen.recorded_s > 0 else 0.0
    beside = dict.fromkeys(other.name for other, _ in fitting if other.name != topic.name)
    others = ", ".join([*beside][:3])
    fields = ", ".join(f'{key} = "{path}"' for key, path in kind.fields.items())
    lines = [
        *(f"# Not used: {line}" for line in textwrap.wrap(why, 86)),
        *(
            ["# No command was recorded: the measured motion is used in place of commands."]
            if role == "command" and seen.commands.measured
            else []
        ),
        *(
            [
                "# The navigation stack's proposal, by its name. It is part of the observation,",
                f"# beside the command that is driven ({seen.commands.topic}). Remove it if it"
                " comes after that command.",
            ]
            if role == "nav_command"
            else []
        ),
        f"[inputs.{role}]  # {rate:.1f} Hz" + (f"; or {others}?" if others else ""),
        f"topic = {json.dumps(topic.name)}",
        f'type = "{topic.type}"',
        f"fields = {{ {fields} }}",
    ]
    if role == "pose" and kind.by_fix:
        lines += fix_lines(seen.recording, topic.name, kind.fields)
    if role == "command":
        lines += [f"# {line}" for line in textwrap.wrap(steered_by(seen), 96)]
    if "steering_rad" in kind.fields:
        lines += [
            "# Its yaw rate is speed x tan(steering_rad) / wheelbase_m.",
            f"wheelbase_m = {round(seen.commands.wheelbase_m, 4):g}"
            f"  # {seen.commands.wheelbase_from}",
        ]
    if role == "scan" and seen.footprint.lidar_aside:
        lines += _lidar_lines(seen.footprint)
    if role == "scan" and seen.footprint.upside_down:
        lines.append("upside_down = true  # by its frame; not if its driver turns the scans over")
    if kind.at_changes:
        lines += [
            "# A message comes when it changes: the last one holds, and there is no max_age_s.",
            "# Where several bumpers are pressed, the release of one counts as that of all.",
        ]
    elif role not in LATCHED:
        pace_s = seen.paces_s.get(topic.name, 0.25)
        age = float(np.clip(round(seen.clock.pace * 4 * pace_s, 2), 0.2, 1.0))
        if role == "command":
            age = max(age, seen.clock.command_age_s)
            lines += [f"# {comment}" for comment in seen.hold.comments]
            if seen.hold.stops_hold:
                lines.append("stop_holds = true  # a command to stop, until the next one")
        lines += [*trial.comments(f"inputs.{role}.max_age_s"), f"max_age_s = {age:g}"]
    if role in FALLBACKS:
        lines.append("optional = true")
    return [*lines, ""]


def _lidar_lines(footprint: Footprint) -> list[str]:
    """Write the place of a lidar that is beside the middle."""
    x, y, yaw = footprint.lidar_x_m or 0.0, footprint.lidar_y_m, footprint.lidar_yaw_rad or 0.0
    return [
        f"lidar_at_m = [{round(x, 3) + 0.0:g}, {round(y, 3) + 0.0:g}]  # ahead, to the left",
        f"lidar_yaw_rad = {round(yaw, 4) + 0.0:g}",
    ]
