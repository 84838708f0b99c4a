"""Writes the text of a proposed profile: TOML with a comment at each guess."""

from __future__ import annotations

import json
import math
import textwrap
from collections.abc import Iterator, Sequence

import msgspec
import numpy as np

from restock.errors import visible
from restock.ingest.containers.recording import Recording
from restock.ingest.containers.storage import TopicInfo
from restock.ingest.live.node import TAKEOVER
from restock.ingest.profile.signal_paths import pressed_in
from restock.ingest.profile.tables import CLOUD, FALLBACKS, SCAN_OF_CLOUD, Input
from restock.ingest.propose.clock_choice import ClockChoice
from restock.ingest.propose.commands import Commands
from restock.ingest.propose.footprint import GUESS, TIGHT_PER_WIDTH, range_lines
from restock.ingest.propose.gather import Evidence
from restock.ingest.propose.pose_choice import fix_lines, fix_noise_lines, frame_lines
from restock.ingest.propose.robot_choice import RobotProposal
from restock.ingest.propose.roles import (
    KINDS,
    LATCHED,
    REQUIRED,
    Kind,
    robots_in,
    usable_topics,
)
from restock.ingest.propose.trial import Advice, Trial
from restock.ingest.steps.aligned_inputs import sideways_notes, sideways_path
from restock.ingest.steps.needs import field_paths
from restock.ingest.task.conditions import shipped, signals_named
from restock.ingest.task.robot import Robot
from restock.ingest.task.task import Noise, Rewards, Task

# required input -> the fields that a person must name if no topic fills it
BY_HAND = {"command": ("speed_mps", "yaw_rate_radps"), "pose": ("x_m", "y_m", "yaw_rad")}


def profile_lines(
    seen: Evidence,
    name: str,
    problems: Sequence[str] = (),
    trial: Trial | None = None,
    advice: Sequence[Advice] = (),
) -> list[str]:
    """Write the TOML of a profile, with each piece of `advice` as a comment at its table.

    `problems` are reasons why the profile cannot be used, `trial` its outcome on the recording.
    """
    recording, seconds = seen.recording, seen.recorded_s
    trial = trial or Trial()
    conditions, exposures = _conditions(seen)
    lines = [
        f"# Proposed from {recording.path.name}: check the comments, then run",
        f"# restock profile check THIS_FILE {recording.path.name}",
        *(f"# NOT USABLE YET: {problem}" for problem in problems),
        *_trial_lines(trial),
        "#",
        *_topic_lines(seen),
        *_notes(advice, "name", "origin_m", "conditions"),
        f'name = "{name}"',
        f"conditions = {json.dumps(conditions)}",
        f"exposures = {json.dumps(exposures)}  # situations, whatever the outcome",
        f'behaviour_policy = "{seen.chosen.policy}"  # {seen.chosen.why}',
        *([f"origin_m = {list(seen.origin_m)}"] if seen.origin_m is not None else []),
        "",
        *task_lines(seen, advice),
        *seen.goal.table_lines(),
        *seen.robot.limited(*seen.commands.reached).lines(
            outline_guessed=not seen.footprint.measured
        ),
        *_noise_lines(seen, trial),
        *_clock_lines(seen.clock),
    ]
    for role, fits in seen.roles.items():
        lines += _notes(advice, f"inputs.{role}")
        if role == "pose" and seen.poses_from_frames:
            lines += ["# [inputs.pose]  # from transforms, by [frames]", ""]
        elif fits:
            lines += [*_input_lines(role, fits, seen), ""]
        else:
            lines += [*_unfilled_lines(role, seen), ""]
    for source in seen.chosen.sources:
        lines += source.toml(seen.commands.wheelbase_m)
    lines += _takeover_lines(seen)
    if seen.frames is not None:
        lines += frame_lines(seen.frames, used=seen.poses_from_frames)
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
    # Names of topics are untrusted: a line break in a name must not start a new key.
    return [visible(line) for line in lines]


def advice_of(seen: Evidence) -> Iterator[Advice]:
    """Yield what a person should check in a proposal, each with the key that it concerns."""
    roles, commands, footprint = seen.roles, seen.commands, seen.footprint
    if robots := robots_in(seen.recording):
        others = ", ".join(robots[1:6]) + (", …" if len(robots) > 6 else "")
        yield Advice(
            "name",
            f"of the robot {robots[0]}, one of {len(robots)} in the recording: `restock profile new"
            f" --robot NAME` proposes a profile of another name for {others}; ingest with it into"
            " another store, because a store keeps one set of rows per recording",
        )
    for role, why in seen.unmeasured.items():
        if why:
            yield Advice(f"inputs.{role}", why)
    yield from _command_advice(seen)
    if seen.robot.guessed_steering and not commands.steered:
        yield Advice("robot.drive", seen.robot.drive_why)
    if seen.origin_m is not None:
        yield Advice(
            "origin_m",
            "poses are far from 0 (UTM coordinates?): positions, zones and floors are from this",
        )
    if _odometry_alone(seen):
        yield Advice(
            "conditions",
            f"no wheel_slip: poses and wheel speeds are both of {roles['wheels'][0][0].name}, and"
            " there is no IMU, so slip cannot be detected",
        )
    if not roles["scan"]:
        known = shipped()
        names = ", ".join(signals_named([known[name] for name in _conditions(seen)[0]]))
        yield Advice("conditions", f"no lidar: {names} are unknown (neither true nor false)")
        if (cloud := _cloud(seen)) is not None:
            yield Advice(
                "inputs.scan",
                f"{cloud} is a point cloud, of which a slice can be read as a scan: uncomment"
                " [inputs.scan], set its height_m to what the robot can run into, and remove"
                " `sectors = 0` from [task]",
            )
        return
    if not footprint.measured:
        yield Advice("task.body", f"{footprint.source}, or give --footprint LENGTHxWIDTH")
    if footprint.lidar_unplaced:
        yield Advice(
            "task.body.lidar_yaw_rad",
            "A GUESS: that the lidar's zero points straight ahead, as no transform places its"
            f" frame, {footprint.lidar_unplaced}. If it does not, distances ahead are those of"
            " another side: look at a scan and set lidar_yaw_rad (1.5708: its zero points left)",
        )
    if footprint.upside_down:
        yield Advice(
            "inputs.scan",
            "the lidar hangs upside down by its frame, so its scans are turned over; if its driver"
            " does that already, left and right are now swapped: remove upside_down",
        )


def _cloud(seen: Evidence) -> str | None:
    """Return the first topic of point clouds that can be read as scans."""
    topics = usable_topics(seen.recording).values()
    return next((one.name for one in topics if one.type == CLOUD), None)


def _command_advice(seen: Evidence) -> Iterator[Advice]:
    """Yield what a person should check about the commands."""
    commands = seen.commands
    if not seen.roles["command"]:
        return
    topic, kind = seen.roles["command"][0]
    if commands.measured:
        yield Advice(
            "inputs.command",
            "no command was recorded: the measured motion is used in place of commands",
        )
    elif commands.steered and not seen.robot.described:
        yield Advice(
            "inputs.command.wheelbase_m",
            "a guess, and with it every yaw rate that was commanded: measure it",
        )
    elif seen.robot.values.get("drive") == "ackermann" and not commands.steered:
        yield Advice(
            "inputs.command",
            f"the robot steers as a car, and {kind.fields['yaw_rate_radps']} is read as a yaw rate,"
            " as the message defines it. If it is the angle of the front wheels, write"
            " steering_rad in place of yaw_rate_radps, and add wheelbase_m",
        )
    source = Input(topic.name, topic.type, dict(kind.fields))
    path = sideways_path(source)
    if path in seen.recording.leaves(topic.name):
        fields = seen.recording.read({topic.name: [path]})[topic.name].fields
        for note in sideways_notes(source, fields):
            yield Advice("inputs.command", note.removeprefix("command: "))
    if commands.still:
        why = f"{topic.name} never asks the robot to move: the actions are a guess"
        yield Advice("task.actions", why)


def _notes(advice: Sequence[Advice], *tables: str) -> list[str]:
    """Write the advice on these tables and their keys, as comments."""
    return [
        f"# {line}"
        for one in advice
        if any(f"{one.key}.".startswith(f"{table}.") for table in tables)
        for line in textwrap.wrap(one.text, 98)
    ]


def _takeover_lines(seen: Evidence) -> list[str]:
    """Write the table of a takeover button, if it was recorded and `operator` is not taken."""
    topic = seen.recording.topics.get(TAKEOVER)
    named = any(source.policy == "operator" for source in seen.chosen.sources)
    if named or topic is None or topic.type != "std_msgs/msg/Bool" or not topic.expected:
        return []
    return [
        "[command_sources.operator]  # who drives while it is true",
        f'topic = "{TAKEOVER}"',
        f'type = "{topic.type}"',
        'fields = { pressed = "data" }',
        "",
    ]


def _conditions(seen: Evidence) -> tuple[list[str], list[str]]:
    """Return the shipped conditions and exposures that this robot's signals can show."""
    slip = seen.roles["wheels"] and seen.motion is None and not _odometry_alone(seen)
    scan = ["closing_traffic", "plan_blocked"] if seen.roles["scan"] else []
    wheel_slip, slippery = (["wheel_slip"], ["slippery_floor"]) if slip else ([], [])
    return ["recovery", "near_collision", *wheel_slip, "blocked_aisle"], [*slippery, *scan]


def _odometry_alone(seen: Evidence) -> bool:
    """Return whether poses and wheel speeds come from one topic, and nothing else shows motion."""
    pose, wheels = (
        [topic.name for topic, _ in seen.roles[role][:1]] for role in ("pose", "wheels")
    )
    same = bool(wheels) and pose == wheels and not seen.poses_from_frames
    return same and not seen.roles["imu"]


def _trial_lines(trial: Trial) -> list[str]:
    """Write the profile's outcome on the recording that it is proposed from, as comments."""
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


def _noise_lines(seen: Evidence, trial: Trial) -> list[str]:
    """Write the noise of the robot's poses, if that is more than a profile's default."""
    fixes = next(iter(seen.roles["pose"]), None)  # the topic used for poses
    if fixes is None or not fixes[1].by_fix:
        noise_m = trial.pose_noise_m
        slip = "wheel_slip" in _conditions(seen)[0]
        if noise_m is None or noise_m <= Noise().localiser_m or not slip:
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
    """Write the [clock] table."""
    every_s = clock.every_s
    why = "no commands" if every_s is None else f"a command every {every_s:.2f} s, mostly"
    return [
        "[clock]",
        *(f"# {comment}" for comment in clock.comments),
        f'alignment = "{clock.alignment}"',
        f'steps = "{clock.steps}"  # {why}',
        f"max_gap_s = {clock.max_gap_s:g}  # a longer one ends an episode",
        "",
    ]


def _max_age_s(topic: TopicInfo, seconds: float) -> float | None:
    """Return four times a topic's mean period (s); None (latched) if it has few messages."""
    rate = topic.expected / seconds if seconds > 0 else 0.0
    if topic.expected < 3 or rate < 0.05:
        return None
    return float(np.clip(round(4 / rate, 1), 0.2, 10.0))


def _unfilled_lines(role: str, seen: Evidence) -> list[str]:
    """Write the table of an input that no topic fills, in comments."""
    if role in REQUIRED:
        fits = " or ".join(dict.fromkeys(kind.type for kind in KINDS[role]))
        transforms = ", nor transforms that join two frames" if role == "pose" else ""
        named = ", ".join(f'{key} = "FIELD"' for key in BY_HAND[role])
        return [
            f"# MISSING, and required: no topic of {fits}{transforms}.",
            "# If one of another type has it (JSON, protobuf, the robot's own), name it here:",
            f"# [inputs.{role}]",
            '# topic = "/TOPIC"',
            '# type = "ITS TYPE"',
            f"# fields = {{ {named} }}",
        ]
    if role == "wheels":
        by_hand = ["# [motion]", "# window_s = 0.5"] if seen.motion is None else []
        return ["# [inputs.wheels]  # no usable odometry; instead: speeds from poses", *by_hand]
    fallback = FALLBACKS.get(role) or seen.goal.fallback(role)
    lines = [f"# [inputs.{role}]  # nothing usable; instead: {fallback}"]
    if role == "scan" and (cloud := _cloud(seen)) is not None:
        fields = ", ".join(f'{key} = "{path}"' for key, path in SCAN_OF_CLOUD.items())
        lines += [
            f'# topic = "{cloud}"',
            f'# type = "{CLOUD}"',
            f"# fields = {{ {fields} }}",
            "# height_m = [LOW, HIGH]  # above the lidar: what the robot can run into",
            "# max_age_s = 0.5",
        ]
    return lines


def _input_lines(role: str, fits: Sequence[tuple[TopicInfo, Kind]], seen: Evidence) -> list[str]:
    """Write the table of an input."""
    (topic, kind), footprint = fits[0], seen.footprint
    rate = topic.expected / seen.recorded_s if seen.recorded_s > 0 else 0.0
    others = dict.fromkeys(other.name for other, _ in fits if other.name != topic.name)
    beside = f"; or {', '.join([*others][:3])}?" if others else ""
    fields = ", ".join(f'{key} = "{path}"' for key, path in kind.fields.items())
    lines = [
        f"[inputs.{role}]  # {rate:.1f} Hz{beside}",
        f"topic = {json.dumps(topic.name)}",
        f'type = "{topic.type}"',
        f"fields = {{ {fields} }}",
    ]
    if role == "nav_command":
        lines.append(
            "# The navigation stack's proposal, by its name. It is part of the observation,"
            f" beside the command that is driven ({seen.commands.topic}): remove it if it comes"
            " after that command."
        )
    if role == "pose" and kind.by_fix:
        lines += fix_lines(seen.recording, topic.name, kind.fields)
    if "steering_rad" in kind.fields:
        wheelbase_m = round(seen.commands.wheelbase_m, 4)
        lines.append(f"wheelbase_m = {wheelbase_m:g}  # yaw rate = speed x tan(steering) / this")
    if role == "scan" and footprint.lidar_aside:
        x, y = (round(at, 3) + 0.0 for at in (footprint.lidar_x_m or 0.0, footprint.lidar_y_m))
        lines += [
            f"lidar_at_m = [{x:g}, {y:g}]  # ahead, to the left",
            f"lidar_yaw_rad = {round(footprint.lidar_yaw_rad or 0.0, 4) + 0.0:g}",
        ]
    if role == "scan" and footprint.upside_down:
        lines.append("upside_down = true")
    if kind.at_changes:
        lines.append("# no max_age_s: a message comes at each change, and the last one holds")
    elif role not in LATCHED:
        pace_s = seen.paces_s.get(topic.name, 0.25)
        age = float(np.clip(round(seen.clock.pace * 4 * pace_s, 2), 0.2, 1.0))
        if role == "command":
            age = max(age, seen.clock.command_age_s)
            lines += [f"# {comment}" for comment in seen.hold.comments]
            if seen.hold.stops_hold:
                lines.append("stop_holds = true  # a command to stop, until the next one")
        lines.append(f"max_age_s = {age:g}")
    return [*lines, "optional = true"] if role in FALLBACKS else lines


GENTLE_MPS, GENTLE_RADPS = 0.45, 1.0  # speed and yaw rate of a careful curve on ice
ROUTE_M = 20.0  # length of a route that the robot must be able to drive within the time limit
MAX_TIME_LIMIT_STEPS = 1000
MOSTLY_FREE = 0.1  # a topic that is "pressed" in a larger share of messages is no bumper
MIN_TIGHT_M = 0.05  # smallest tight clearance: less is within a lidar's noise


def task_lines(seen: Evidence, advice: Sequence[Advice]) -> list[str]:
    """Write the [task] table and its subtables."""
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
        _bump_line(seen.recording, roles["bumper"]),
        *seen.goal.task_lines((seen.footprint if seen.footprint.measured else GUESS).length_m),
        f"control_period_s = {seen.clock.period_s:g}",
        *_time_limit_lines(seen, max(speed for speed, _ in actions)),
        *(
            range_lines(seen.recording, roles["scan"][0][0].name, seen.outline)
            if roles["scan"]
            else ["sectors = 0  # no lidar: clearance is not part of the observation"]
        ),
        *held_back,
        *_notes(advice, "task.actions"),
        f"actions = [  # (m/s, rad/s), {origin}; the first must be stop",
        *(f"  [{v:.3g}, {w:.3g}]," for v, w in actions),
        "]",
        "",
        *_body_lines(seen, advice),
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
    if 0.8 * speed > GENTLE_MPS:  # add a slower curve for slippery floors
        slow, bend = min(0.35 * speed, GENTLE_MPS), min(0.5 * turn, GENTLE_RADPS)
        actions += [(slow, bend), (slow, -bend)]
    return actions + [(-back, 0.0) for back in commands.reverse_mps]


def _steered_actions(commands: Commands, robot: RobotProposal) -> list[tuple[float, float]]:
    """Return actions for a robot that steers like a car.

    No action turns on the spot, or in a tighter curve than the steering allows.
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


def _bump_line(recording: Recording, fits: Sequence[tuple[TopicInfo, Kind]]) -> str:
    """Write that a bump ends an episode, unless the bumper is pressed too often to be one."""
    if not fits:
        return "bump_terminates = true  # no bumper seen: in the twin, a contact ends the episode"
    topic, kind = fits[0]
    wanted = field_paths(Input(topic.name, topic.type, kind.fields))
    columns = recording.read({topic.name: wanted})[topic.name]
    pressed = pressed_in(columns.fields, kind.fields["pressed"], len(columns))
    if len(pressed) and pressed.mean() > MOSTLY_FREE and not kind.at_changes:
        share = f"{pressed.mean():.0%} of its messages"
        return f"# bump_terminates = true  # CHECK the bumper: it is pressed in {share}"
    return "bump_terminates = true  # a protective stop"


def _body_lines(seen: Evidence, advice: Sequence[Advice]) -> list[str]:
    """Write the outline; also the tight clearance if the robot is too narrow for the default."""
    footprint = seen.footprint
    x, yaw = footprint.lidar_x_m, footprint.lidar_yaw_rad
    aside = bool(seen.roles["scan"]) and footprint.lidar_aside
    lines = [
        "[task.body]  # the outline, from which clearance is measured",
        *([f"# {footprint.source}"] if footprint.measured or not seen.roles["scan"] else []),
        *(f"# {note}" for note in seen.footprint_notes),
        *_notes(advice, "task.body"),
        f"length_m = {round(footprint.length_m, 4):g}",
        f"width_m = {round(footprint.width_m, 4):g}",
    ]
    if aside:
        lines.append("# Clearance is as from the middle: lidar_at_m of the inputs.")
    elif seen.roles["scan"]:
        why = f"ahead of the middle; {footprint.lidar_source}"
        lines.append(f"lidar_x_m = {round(x or 0.0, 3):g}  # {why}")
    if yaw and abs(yaw) > 1e-3 and not aside:
        lines.append(f"lidar_yaw_rad = {round(yaw, 4):g}")
    near_m = round(max(TIGHT_PER_WIDTH * footprint.width_m, MIN_TIGHT_M), 3)
    if near_m < Rewards().tight_clearance_m:
        lines += ["", "[task.rewards]", f"tight_clearance_m = {near_m:g}  # by the robot's width"]
    return [*lines, ""]
