"""The text of a proposed profile: TOML with a comment at each guess."""

from __future__ import annotations

import json
import math
import textwrap
from collections.abc import Sequence

import msgspec
import numpy as np

from restock.errors import visible
from restock.ingest.containers.recording import Recording
from restock.ingest.containers.storage import TopicInfo
from restock.ingest.live.node import TAKEOVER
from restock.ingest.profile.signal_paths import pressed_in
from restock.ingest.profile.tables import CLOUD, FALLBACKS, SCAN_OF_CLOUD, Input
from restock.ingest.propose.candidates import camera_lines
from restock.ingest.propose.clock_choice import ClockChoice
from restock.ingest.propose.commands import Commands
from restock.ingest.propose.footprint import (
    DESCRIBED,
    GUESS,
    TIGHT_PER_WIDTH,
    Footprint,
    range_lines,
)
from restock.ingest.propose.gather import Evidence
from restock.ingest.propose.pose_choice import fix_lines, fix_noise_lines
from restock.ingest.propose.robot_choice import RobotProposal
from restock.ingest.propose.roles import (
    KINDS,
    LATCHED,
    REQUIRED,
    Kind,
    Roles,
    clouds_alone,
    robots_in,
    usable_topics,
)
from restock.ingest.propose.trial import Trial
from restock.ingest.steps.needs import field_paths
from restock.ingest.task.conditions import shipped, unseen
from restock.ingest.task.robot import Robot
from restock.ingest.task.task import Noise, Rewards, Task


def _takeover_lines(recording: Recording, lines: Sequence[str]) -> list[str]:
    """Write the button of whoever takes over, if it was recorded and nothing has its name yet."""
    topic = recording.topics.get(TAKEOVER)
    named = any(line.startswith('[command_sources."operator"]') for line in lines)
    if named or topic is None or topic.type != "std_msgs/msg/Bool" or not topic.expected:
        return []
    return [
        "[command_sources.operator]  # who drives while it is true",
        f'topic = "{TAKEOVER}"',
        f'type = "{topic.type}"',
        'fields = { pressed = "data" }',
        "",
    ]


# The fields of what nothing fills, for a person to name.
BY_HAND = {"command": ("speed_mps", "yaw_rate_radps"), "pose": ("x_m", "y_m", "yaw_rad")}


def in_one_recording(robots: Sequence[str]) -> str:
    """Say whose profile it is, if a recording is of several robots."""
    others = ", ".join(robots[1:6]) + (", …" if len(robots) > 6 else "")
    return (
        f"of the robot {robots[0]}, one of {len(robots)} in the recording: `restock profile new "
        f"--robot NAME` proposes a profile of another name for {others}; ingest with it into "
        "another store, because a store keeps one set of rows per recording"
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
        f"exposures = {json.dumps(_exposures(seen))}  # situations, whatever the outcome",
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
    lines += _takeover_lines(recording, lines)
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
    lines += camera_lines(usable_topics(recording).values(), seconds)
    # Names are of a stranger: a line break in one starts no key.
    return [visible(line) for line in lines]


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
        " IMU: slip cannot be detected."
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
    taken: dict[str, list[str]] = {}
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
    return robot.lines(outline_guessed=not seen.footprint.measured)


def _noise_lines(seen: Evidence, trial: Trial) -> list[str]:
    """Write how noisy its poses are, if that is more than a profile's default."""
    fixes = next(iter(seen.roles["pose"]), None)  # its pose's topic
    if fixes is None or not fixes[1].by_fix:
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
        lines = [*reported, f"# [inputs.{role}]  # {none}; instead: {fallback}"]
        clouds = [one for one in usable_topics(seen.recording).values() if one.type == CLOUD]
        if role == "scan" and clouds:
            fields = ", ".join(f'{key} = "{path}"' for key, path in SCAN_OF_CLOUD.items())
            lines += [
                f'# topic = "{clouds[0].name}"',
                f'# type = "{CLOUD}"',
                f"# fields = {{ {fields} }}",
                "# height_m = [LOW, HIGH]  # above the lidar: what the robot can run into",
                "# max_age_s = 0.5",
            ]
        return [*lines, ""]
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


GENTLE_MPS, GENTLE_RADPS = 0.45, 1.0  # what a careful driver dares on ice
ROUTE_M = 20.0  # that the time limit leaves room for, at the robot's highest speed
MAX_TIME_LIMIT_STEPS = 1000
MOSTLY_FREE = 0.1  # of its messages, at most, in which a bumper is pressed
MIN_TIGHT_M = 0.05  # a lidar's noise hides what is less


def task_lines(seen: Evidence, trial: Trial) -> list[str]:
    """Write the [task] table and those in it, with comments at guesses."""
    roles, commands = seen.roles, seen.commands
    kind = "speeds" if commands.measured else "commands"
    held_back = [
        f"# {reported} beyond {reached:g} {unit} were commanded, but not reached by the robot."
        for reported, reached, unit in zip(
            ("Speeds", "Yaw rates"), commands.reached, ("m/s", "rad/s"), strict=True
        )
        if reached is not None
    ]
    origin = f"from {commands.count} {kind} of {commands.topic}" if commands.count else "a guess"
    actions = actions_of(commands, seen.robot)
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
    """Write the time limit of a robot that is too slow for the default one."""
    if seen.goal.source is None or speed_mps <= 0.0:
        return []
    steps = 10 * math.ceil(ROUTE_M / (speed_mps * seen.clock.period_s) / 10)
    (default,) = (f.default for f in msgspec.structs.fields(Task) if f.name == "time_limit_steps")
    if steps <= default:
        return []
    steps = min(steps, MAX_TIME_LIMIT_STEPS)
    reach_m = steps * seen.clock.period_s * speed_mps
    return [f"time_limit_steps = {steps}  # {reach_m:.0f} m at {speed_mps:.3g} m/s"]


def actions_of(commands: Commands, robot: RobotProposal) -> list[tuple[float, float]]:
    """Return speeds (m/s) and yaw rates (rad/s) up to the fastest that were commanded.

    The first action is stop.
    """
    speed, turn = commands.speed_mps, commands.yaw_rate_radps
    if robot.values.get("drive") == "ackermann":
        return _steered_actions(commands, robot)
    actions = [(0.0, 0.0), (speed / 2, 0.0), (speed, 0.0)]
    actions += [(0.8 * speed, 0.6 * turn), (0.8 * speed, -0.6 * turn), (0.0, turn), (0.0, -turn)]
    if 0.8 * speed > GENTLE_MPS:  # over slippery floor it needs a curve, too, that is none of these
        slow, bend = min(0.35 * speed, GENTLE_MPS), min(0.5 * turn, GENTLE_RADPS)
        actions += [(slow, bend), (slow, -bend)]
    return actions + [(-back, 0.0) for back in commands.reverse_mps]


def _steered_actions(commands: Commands, robot: RobotProposal) -> list[tuple[float, float]]:
    """Return actions that a robot that steers can drive.

    None turns on the spot, or tighter than its steering allows.
    """
    speed, turn = commands.speed_mps, commands.yaw_rate_radps
    known = {key: robot.values[key] for key in ("max_steering_rad",) if key in robot.values}
    wheelbase_m = robot.values.get("wheelbase_m", commands.wheelbase_m)
    least_m = Robot(drive="ackermann", wheelbase_m=wheelbase_m, **known).min_turning_radius_m
    slow = 0.4 * speed
    wide, tight = min(0.6 * turn, 0.8 * speed / least_m), min(turn, slow / least_m)
    curves = [(0.8 * speed, wide), (slow, tight)]
    curves += [(-back, min(turn, back / least_m)) for back in commands.reverse_mps[:1]]
    actions = [(0.0, 0.0), (speed / 2, 0.0), (speed, 0.0)]
    actions += [(v, side * 0.99 * w) for v, w in curves for side in (1, -1)]
    return actions + [(-back, 0.0) for back in commands.reverse_mps]


def _bump_lines(recording: Recording, roles: Roles) -> list[str]:
    """Let a bumper stop the robot, unless it is pressed too often to be one.

    Without a bumper nothing changes in logs. In the twin, which knows every contact, a robot would
    otherwise push against a wall until its time is up.
    """
    if not roles["bumper"]:
        return ["bump_terminates = true  # no bumper seen: in the twin, a contact ends the episode"]
    topic, kind = roles["bumper"][0]
    path = kind.fields["pressed"]
    wanted = field_paths(Input(topic.name, topic.type, kind.fields))
    columns = recording.read({topic.name: wanted})[topic.name]
    pressed = pressed_in(columns.fields, path, len(columns))
    if len(pressed) and pressed.mean() > MOSTLY_FREE and not kind.at_changes:
        return [
            f"# {topic.name} is pressed in {pressed.mean():.0%} of its messages: CHECK its meaning",
            "# bump_terminates = true  # a protective stop; what follows is another episode",
        ]
    return ["bump_terminates = true  # a protective stop; what follows is another episode"]


def _body_lines(seen: Evidence, trial: Trial) -> list[str]:
    footprint = seen.footprint
    x, yaw = footprint.lidar_x_m, footprint.lidar_yaw_rad
    placed = footprint.lidar_source != DESCRIBED
    aside = bool(seen.roles["scan"]) and footprint.lidar_aside
    return [
        "[task.body]  # the outline, from which clearance is measured",
        f"# {footprint.source}"
        + ("" if footprint.measured else ", or give --footprint LENGTHxWIDTH"),
        *(f"# {note}" for note in seen.footprint_notes),
        *trial.comments("task.body"),
        f"length_m = {round(footprint.length_m, 4):g}",
        f"width_m = {round(footprint.width_m, 4):g}",
        *(
            [
                f"lidar_x_m = {round(x or 0.0, 3):g}  # of the lidar, ahead of the middle"
                + ("; a guess" if x is None else "")
                + ("" if x is None and not placed else f"; {footprint.lidar_source}")
            ]
            if seen.roles["scan"] and not aside
            else []
        ),
        *(["# Clearance is as from the middle: lidar_at_m of the inputs."] if aside else []),
        *(f"# {line}" for line in textwrap.wrap(lidar_guess(footprint), 96)),
        *([f"lidar_yaw_rad = {round(yaw, 4):g}"] if yaw and abs(yaw) > 1e-3 and not aside else []),
        "",
        *_reward_lines(footprint.width_m),
    ]


def lidar_guess(footprint: Footprint) -> str:
    """Say that the direction of the lidar is a guess; "" where something says which it is."""
    if not footprint.lidar_unplaced:
        return ""
    return (
        "A GUESS: that the lidar's zero points straight ahead, as no transform places its frame,"
        f" {footprint.lidar_unplaced}. If it does not, distances ahead are those of another side:"
        " look at a scan and set lidar_yaw_rad (1.5708: its zero points left)"
    )


def _reward_lines(width_m: float) -> list[str]:
    """Write how near is near, for a robot narrower than the one that suits the default."""
    near_m = round(max(TIGHT_PER_WIDTH * width_m, MIN_TIGHT_M), 3)
    if near_m >= Rewards().tight_clearance_m:
        return []
    return [
        "[task.rewards]",
        f"tight_clearance_m = {near_m:g}  # nearer than this is a near collision; by its width",
        "",
    ]


def _range_lines(seen: Evidence) -> list[str]:
    if not seen.roles["scan"]:
        return ["sectors = 0  # no lidar: clearance is unknown, and no part of the observation"]
    return range_lines(seen.recording, seen.roles["scan"][0][0].name, seen.outline)
