"""The text of a proposed profile: TOML with a comment at each guess."""

from __future__ import annotations

import json
import math
import textwrap

import msgspec
import numpy as np

from restock.errors import visible
from restock.ingest.containers.recording import Recording
from restock.ingest.containers.topic_reading import TopicInfo
from restock.ingest.profile.inputs import FALLBACKS
from restock.ingest.propose.evidence.cameras import camera_lines
from restock.ingest.propose.evidence.clock_choice import ClockChoice
from restock.ingest.propose.evidence.commands import Commands
from restock.ingest.propose.evidence.footprint import GUESS
from restock.ingest.propose.evidence.gather import Evidence
from restock.ingest.propose.evidence.motion_choice import fix_lines, fix_noise_lines
from restock.ingest.propose.evidence.robot_lines import RobotProposal
from restock.ingest.propose.evidence.roles import (
    FIX,
    KINDS,
    LATCHED,
    REQUIRED,
    Kind,
    Roles,
)
from restock.ingest.propose.evidence.scanned_outline import range_lines
from restock.ingest.propose.trial import Trial
from restock.ingest.task.condition_files import shipped
from restock.ingest.task.conditions import unseen
from restock.ingest.task.robot import Robot
from restock.ingest.task.task import Task

GENTLE_MPS, GENTLE_RADPS = 0.45, 1.0  # what a careful driver dares on ice
ROUTE_M = 20.0  # that the time limit leaves room for, at the robot's highest speed
LONGEST_TIME_LIMIT_STEPS = 1000
MOSTLY_FREE = 0.1  # of its messages, at most, in which a bumper is pressed


def profile_lines(
    seen: Evidence, name: str, problems: list[str], trial: Trial | None = None
) -> list[str]:
    """The TOML of a profile; with what a `trial` of it made of the recording."""
    recording, seconds = seen.recording, seen.recorded_s
    trial = trial or Trial()
    lines = [
        f"# Proposed from {recording.path.name}: check the comments, then run",
        f"# restock profile check THIS_FILE {recording.path.name}",
        *(f"# NOT USABLE YET: {problem}" for problem in problems),
        *_trial_lines(trial),
        "#",
        *_topic_lines(recording, seen.roles, seconds),
        f'name = "{name}"',
        f"conditions = {json.dumps(_conditions(seen))}",
        *_unknown_lines(seen),
        f"exposures = {json.dumps(_exposures(seen))}  # situations, whatever came of them",
        f'behaviour_policy = "{seen.chosen.policy}"  # {seen.chosen.why}',
        "",
        *_task_lines(seen, trial),
        *seen.goal.table_lines(),
        *_robot_lines(seen),
        *_noise_lines(seen),
        *_clock_lines(seen.clock, trial),
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


def _conditions(seen: Evidence) -> list[str]:
    """The shipped conditions that this robot's signals can show."""
    slip = ["wheel_slip"] if seen.motion is None else []
    return ["recovery", "near_collision", *slip, "blocked_aisle"]


def _unknown_lines(seen: Evidence) -> list[str]:
    """Which of them nothing tells of a robot without a lidar."""
    if seen.roles["scan"]:
        return []
    known = shipped()
    names = unseen([known[name] for name in _conditions(seen)])
    return [f"# No lidar: {', '.join(names)} are unknown (null, neither true nor false)."]


def _exposures(seen: Evidence) -> list[str]:
    """The shipped exposures that this robot's signals can show."""
    slip = ["slippery_floor"] if seen.motion is None else []
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
    """What the profile makes of the recording it is proposed from."""
    if not trial.ticks:
        return []
    most = [f"{reason} {count:,}" for reason, count in list(trial.dropped.items())[:3]]
    dropped = f" (dropped: {', '.join(most)})" if most else ""
    return [f"# It gives {trial.transitions:,} transitions from {trial.ticks:,} ticks{dropped}."]


def _said(trial: Trial, *keys: str) -> list[str]:
    """What the trial says of these keys, as comments."""
    return [f"# {each.text}." for each in trial.advice if each.key in keys]


def _topic_lines(recording: Recording, roles: Roles, seconds: float) -> list[str]:
    """Every topic with its rate and what it is taken for, as a comment."""
    taken: dict[str, list[str]] = {}
    for role, found in roles.items():
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


def _task_lines(seen: Evidence, trial: Trial) -> list[str]:
    roles, commands = seen.roles, seen.commands
    kind = "speeds" if commands.measured else "commands"
    held_back = [
        f"# {told} beyond {reached:g} {unit} were commanded, but not reached by the robot."
        for told, reached, unit in zip(
            ("Speeds", "Yaw rates"), commands.reached, ("m/s", "rad/s"), strict=True
        )
        if reached is not None
    ]
    origin = f"from {commands.count} {kind} of {commands.topic}" if commands.count else "a guess"
    actions = _actions(commands, seen.robot)
    return [
        "[task]",
        *_bump_lines(seen.recording, roles),
        *seen.goal.task_lines((seen.footprint if seen.footprint.measured else GUESS).length_m),
        f"control_period_s = {seen.clock.period_s:g}",
        *_time_limit_lines(seen, max(speed for speed, _ in actions)),
        *_range_lines(seen),
        *held_back,
        f"actions = [  # (m/s, rad/s), {origin}; the first must be stop",
        *(f"  [{v:.3g}, {w:.3g}]," for v, w in actions),
        "]",
        "",
        *_body_lines(seen, trial),
    ]


def _time_limit_lines(seen: Evidence, speed_mps: float) -> list[str]:
    """The time limit of a robot that is too slow for the one that a task has otherwise."""
    if seen.goal.source is None or speed_mps <= 0.0:
        return []
    steps = 10 * math.ceil(ROUTE_M / (speed_mps * seen.clock.period_s) / 10)
    (default,) = (f.default for f in msgspec.structs.fields(Task) if f.name == "time_limit_steps")
    if steps <= default:
        return []
    steps = min(steps, LONGEST_TIME_LIMIT_STEPS)
    reach_m = steps * seen.clock.period_s * speed_mps
    return [f"time_limit_steps = {steps}  # {reach_m:.0f} m at {speed_mps:.3g} m/s"]


def _actions(commands: Commands, robot: RobotProposal) -> list[tuple[float, float]]:
    """Speeds (m/s) and yaw rates (rad/s) by the fastest that were commanded; the first is stop."""
    speed, turn = commands.speed_mps, commands.yaw_rate_radps
    if robot.values.get("drive") == "ackermann":
        return _steered_actions(commands, robot)
    actions = [(0.0, 0.0), (speed / 2, 0.0), (speed, 0.0)]
    actions += [(0.8 * speed, 0.6 * turn), (0.8 * speed, -0.6 * turn), (0.0, turn), (0.0, -turn)]
    if 0.8 * speed > GENTLE_MPS:  # over slippery floor it needs a curve, too, that is none of these
        slow, bend = min(0.35 * speed, GENTLE_MPS), min(0.5 * turn, GENTLE_RADPS)
        actions += [(slow, bend), (slow, -bend)]
    actions += [(-speed / 2, 0.0)] if commands.backs else []
    return actions


def _steered_actions(commands: Commands, robot: RobotProposal) -> list[tuple[float, float]]:
    """Of a robot that steers: no turn on the spot, nor one tighter than its steering allows."""
    speed, turn = commands.speed_mps, commands.yaw_rate_radps
    known = {key: robot.values[key] for key in ("max_steering_rad",) if key in robot.values}
    wheelbase_m = robot.values.get("wheelbase_m", commands.wheelbase_m)
    least_m = Robot(drive="ackermann", wheelbase_m=wheelbase_m, **known).min_turning_radius_m
    slow = 0.4 * speed
    wide, tight = min(0.6 * turn, 0.8 * speed / least_m), min(turn, slow / least_m)
    curves = [(0.8 * speed, wide), (slow, tight), *([(-slow, tight)] if commands.backs else [])]
    actions = [(0.0, 0.0), (speed / 2, 0.0), (speed, 0.0)]
    actions += [(v, side * 0.99 * w) for v, w in curves for side in (1, -1)]
    return actions + ([(-slow, 0.0)] if commands.backs else [])


def steered_by(seen: Evidence) -> str:
    """What is done with the Twists of a robot that steers, and why."""
    assert seen.turns is not None
    topic, kind = seen.roles["command"][0]
    if seen.turns.problem:
        return (
            f"{topic.name} drives a robot that steers as a car, and {seen.turns.problem}: set in "
            "[inputs.command] which one it is, yaw_rate_radps, or steering_rad with wheelbase_m"
        )
    path = kind.fields["steering_rad" if seen.turns.is_angle else "yaw_rate_radps"]
    if seen.turns.is_angle:
        return f"the robot steers as a car: {path} is read as its steering angle, {seen.turns.why}"
    return (
        f"the robot steers as a car: {path} is read as a yaw rate, {seen.turns.why};"
        f" {seen.turns.too_tight:,} of its commands turn tighter than the"
        f" {seen.turns.least_m:.2g} m that its steering allows, and count as the nearest action"
        " that it can drive"
    )


def _robot_lines(seen: Evidence) -> list[str]:
    """What the twin builds; the actions are within its limits."""
    robot = seen.robot.limited(*seen.commands.reached)
    return robot.lines(*np.abs(_actions(seen.commands, robot)).max(axis=0).tolist())


def _bump_lines(recording: Recording, roles: Roles) -> list[str]:
    """A bumper stops the robot, unless it is pressed so often that it hardly is one.

    Without one nothing changes in logs; in the twin, which knows every contact, a robot would else
    press on against a wall to the end of its time.
    """
    if not roles["bumper"]:
        return ["bump_terminates = true  # no bumper seen: in the twin, a contact ends the episode"]
    topic, kind = roles["bumper"][0]
    fields = recording.read({topic.name: [kind.fields["pressed"]]})[topic.name].fields
    pressed = np.asarray(fields[kind.fields["pressed"]], np.float64) > 0
    if len(pressed) and pressed.mean() > MOSTLY_FREE:
        return [
            f"# {topic.name} is pressed in {pressed.mean():.0%} of its messages: CHECK its meaning",
            "# bump_terminates = true  # a protective stop; what follows is another episode",
        ]
    return ["bump_terminates = true  # a protective stop; what follows is another episode"]


def _body_lines(seen: Evidence, trial: Trial) -> list[str]:
    footprint = seen.footprint
    x, yaw = footprint.lidar_x_m, footprint.lidar_yaw_rad
    return [
        "[task.body]  # the outline, from which clearance is measured",
        f"# {footprint.source}"
        + ("" if footprint.measured else ", or give --footprint LENGTHxWIDTH"),
        *(f"# {note}" for note in seen.footprint_notes),
        *_said(trial, "task.body"),
        f"length_m = {round(footprint.length_m, 4):g}",
        f"width_m = {round(footprint.width_m, 4):g}",
        *(
            [
                f"lidar_x_m = {round(x or 0.0, 3):g}  # of the lidar, ahead of the middle"
                + ("; a guess" if x is None else f"; {footprint.lidar_source}")
            ]
            if seen.roles["scan"]
            else []
        ),
        *([f"lidar_yaw_rad = {round(yaw, 4):g}"] if yaw and abs(yaw) > 1e-3 else []),
        "",
    ]


def _range_lines(seen: Evidence) -> list[str]:
    if not seen.roles["scan"]:
        return ["sectors = 0  # no lidar: clearance is unknown, and no part of the observation"]
    return range_lines(seen.recording, seen.roles["scan"][0][0].name, seen.outline)


def _fix_topic(seen: Evidence) -> str:
    """The topic of the fixes that its pose is from, or ""."""
    pose = seen.roles["pose"][:1]
    return pose[0][0].name if pose and pose[0][0].type == FIX else ""


def _noise_lines(seen: Evidence) -> list[str]:
    if not (topic := _fix_topic(seen)):
        return []
    apart_s = max(seen.paces_s.get(topic, 0.25), seen.clock.period_s)
    return fix_noise_lines(seen.recording, topic, 2 * seen.commands.speed_mps * apart_s)


def _clock_lines(clock: ClockChoice, trial: Trial) -> list[str]:
    offset = "" if clock.ahead_s is None else f"  # log time is {clock.ahead_s:,.3f} s ahead of it"
    why = "no commands seen" if clock.every_s is None else f"a command every {clock.every_s:.2f} s"
    return [
        "[clock]",
        *(f"# {comment}" for comment in clock.comments),
        f'alignment = "{clock.alignment}"' + offset,
        *_said(trial, "clock.steps"),
        f'steps = "{clock.steps}"  # {why}' + ("" if clock.every_s is None else ", mostly"),
        *_said(trial, "clock.max_gap_s"),
        f"max_gap_s = {clock.max_gap_s:g}  # a longer one ends an episode",
        "",
    ]


def _max_age_s(topic: TopicInfo, seconds: float) -> float | None:
    """Four periods of a topic, or None (latched) for one with few messages."""
    rate = topic.expected / seconds if seconds > 0 else 0.0
    if topic.expected < 3 or rate < 0.05:
        return None
    return float(np.clip(round(4 / rate, 1), 0.2, 10.0))


def _input_lines(
    role: str, fitting: list[tuple[TopicInfo, Kind]], seen: Evidence, trial: Trial
) -> list[str]:
    if not fitting:
        if role in REQUIRED:
            fits = " or ".join(dict.fromkeys(kind.type for kind in KINDS[role]))
            if role == "pose":
                fits += ", or transforms that join two frames"
            return [
                f"# MISSING, and required: no topic of {fits}.",
                f"# [inputs.{role}]",
                "",
            ]
        if role == "wheels":
            return ["# [inputs.wheels]  # no odometry seen; instead: speeds from poses", ""]
        fallback = FALLBACKS.get(role) or seen.goal.fallback(role)
        return [f"# [inputs.{role}]  # no topic seen; instead: {fallback}", ""]
    topic, kind = fitting[0]
    rate = topic.expected / seen.recorded_s if seen.recorded_s > 0 else 0.0
    others = ", ".join(other.name for other, _ in fitting[1:4])
    fields = ", ".join(f'{key} = "{path}"' for key, path in kind.fields.items())
    lines = [
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
    if role == "pose" and _fix_topic(seen):
        lines += fix_lines(seen.recording, topic.name)
    if role == "command" and seen.turns is not None:
        lines += [f"# {line}" for line in textwrap.wrap(steered_by(seen), 96)]
    if "steering_rad" in kind.fields:
        origin = "of [robot]" if seen.commands.wheelbase_known else "A GUESS: MEASURE IT"
        lines += [
            "# Its yaw rate is speed x tan(steering_rad) / wheelbase_m.",
            f"wheelbase_m = {round(seen.commands.wheelbase_m, 4):g}  # {origin}",
        ]
    if role not in LATCHED:
        pace_s = seen.paces_s.get(topic.name, 0.25)
        age = float(np.clip(round(seen.clock.pace * 4 * pace_s, 2), 0.2, 1.0))
        if role == "command":
            age = max(age, seen.clock.command_age_s)
            lines += [f"# {comment}" for comment in seen.hold.comments]
            if seen.hold.stops_hold:
                lines.append("stop_holds = true  # a command to stop, until the next one")
        lines += [*_said(trial, f"inputs.{role}.max_age_s"), f"max_age_s = {age:g}"]
    if role in FALLBACKS:
        lines.append("optional = true")
    return [*lines, ""]
