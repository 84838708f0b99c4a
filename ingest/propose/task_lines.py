"""The [task] of a proposed profile: its actions, its outline, and what ends an episode."""

from __future__ import annotations

import math
import textwrap

import msgspec

from restock.ingest.containers.recording import Recording
from restock.ingest.profile.inputs import Input
from restock.ingest.profile.signal_paths import pressed_in
from restock.ingest.propose.evidence.commands import Commands
from restock.ingest.propose.evidence.footprint import DESCRIBED, GUESS, TIGHT_PER_WIDTH, Footprint
from restock.ingest.propose.evidence.gather import Evidence
from restock.ingest.propose.evidence.lidars import range_lines
from restock.ingest.propose.evidence.robot_choice import RobotProposal
from restock.ingest.propose.evidence.roles import Roles
from restock.ingest.propose.trial import Trial
from restock.ingest.steps.needs import field_paths
from restock.ingest.task.robot import Robot
from restock.ingest.task.task import Rewards, Task

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
        *trial.comments("task.time_limit_steps"),
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

    Without one nothing changes in logs; in the twin, which knows every contact, a robot would else
    press on against a wall to the end of its time.
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
