"""A first profile for an unknown robot: from the topics and types of one of its recordings.

What each topic is for is guessed from its type and name; the clock, the speeds of the actions,
maximum ages, the lidar's range, the outline and the frames come from the messages. The proposal is
then tried on the recording, so that it can say what its choices cost. It is TOML with a comment at
each guess. Possible custom signals are commented out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from restock.errors import ConfigError, RecordingError
from restock.ingest.containers.recording import Recording
from restock.ingest.containers.storage import TopicInfo
from restock.ingest.profile.profile import parse_profile
from restock.ingest.profile.tables import Input
from restock.ingest.propose.clock_choice import by_log_time
from restock.ingest.propose.commands import off_the_floor
from restock.ingest.propose.footprint import UPSIDE_DOWN
from restock.ingest.propose.gather import Evidence, Given, GoalChoice, gather, without_first
from restock.ingest.propose.proposal_lines import (
    in_one_recording,
    lidar_guess,
    profile_lines,
    steered_by,
)
from restock.ingest.propose.roles import (
    REQUIRED,
    Kind,
    clouds_alone,
    robots_in,
    several_commands,
    unread_bumpers,
)
from restock.ingest.propose.trial import GAIN, UNEVEN, Advice, Trial, try_profile
from restock.ingest.steps.align import BY_LOG_TIME
from restock.ingest.steps.aligned_inputs import sideways_notes, sideways_path
from restock.ingest.steps.clocks import STAMP
from restock.ingest.steps.consistency import Finding
from restock.ingest.steps.needs import as_recorded, read_topics

# What a recording lacks -> what to do about it.
REMEDIES = {
    "command": "record the topic of the command that drives the robot (geometry_msgs/msg/Twist)",
    "pose": "no topic contains the robot's pose; record localisation, odometry, or the transforms "
    "of /tf and /tf_static",
}
INSTEAD_OF_COMMANDS = (
    "; or, if the measured motion may be used as the command, `profile new --odometry-as-command`"
)


@dataclass(frozen=True)
class RobotKind:
    """Recordings of one kind of robot, and what they say of it."""

    robot: str
    recordings: list[str]


@dataclass(frozen=True)
class Proposal:
    """The TOML of a profile, what in it needs a person, and what it makes of the recording."""

    toml: str
    base: Path  # the recording that it was proposed from, and tried on
    missing: list[str] = field(default_factory=list)  # required inputs that nothing fills
    signals: int = 0  # custom signals that stand in it, commented out
    ticks: int = 0
    transitions: int = 0
    problems: list[str] = field(default_factory=list)  # why it cannot be used as it is
    advice: list[Advice] = field(default_factory=list)  # what choices cost, and what to try
    commands: list[str] = field(default_factory=list)  # topics, if several may drive the robot
    kinds: list[RobotKind] = field(default_factory=list)  # if there are several: its own first
    findings: list[Finding] = field(default_factory=list)  # contradictions in the recording
    wheeled: bool = True  # False: it is taken for a drone's recording, or an arm's, or cameras'


def propose_profile(recording: Recording, name: str, given: Given | None = None) -> Proposal:
    """Propose a profile of this name for recordings like this one, tried on it.

    Raises:
        ConfigError: the URDF cannot be used; says why.
    """
    return propose_from(gather(recording, given or Given()), name)


def propose_from(seen: Evidence, name: str, *, goal_decided: bool = False) -> Proposal:
    """Propose a profile from gathered evidence, tried on the recording that it is from.

    With `goal_decided` its goal is not left out where this recording alone has few in hindsight.
    """
    recording = seen.recording
    missing = [
        role
        for role in REQUIRED
        if not seen.roles[role] and not (role == "pose" and seen.poses_from_frames)
    ]
    problems = []
    for role in missing:
        remedy = REMEDIES[role]
        if role == "command" and seen.roles["wheels"]:
            remedy += INSTEAD_OF_COMMANDS
        problems.append(f"no topic for {role}, which every profile needs: {remedy}")
    located = "pose" not in missing
    if other := no_wheeled_robot(recording, seen.roles["command"], located=located):
        problems = [other]
    elif seen.motion is not None and seen.motion.problem:
        problems.append(seen.motion.problem)
    text = "\n".join(profile_lines(seen, name, problems))
    trial = Trial()
    if not problems:
        trial = tried(recording, text)
        if trial.problem and BY_LOG_TIME in trial.problem and seen.clock.alignment == STAMP:
            seen = replace(seen, clock=by_log_time(seen.clock, seen.gaps, trial.problem))
            trial = tried(recording, "\n".join(profile_lines(seen, name, problems)))
        seen, trial = _without_odd(seen, name, trial)
        seen, trial = _by_rate(recording, seen, name, trial)
        goal = seen.goal.tried(trial.transitions, trial.dropped)
        if goal != seen.goal and not goal_decided:
            seen = replace(seen, goal=goal)
            trial = tried(recording, "\n".join(profile_lines(seen, name, problems)))
        if trial.problem:
            problems.append(trial.problem)
        text = "\n".join(profile_lines(seen, name, problems, trial))
    advice = [*trial.advice]
    if robots := robots_in(recording):
        advice.append(Advice("inputs", in_one_recording(robots)))
    if steered := steered_by(seen):
        advice.append(Advice("inputs.command", steered))
    if seen.robot.guessed_steering and not seen.commands.steered:
        advice.append(Advice("robot.drive", f"it seems to steer like a car: {seen.turned.why}"))
    advice += _odd_commands(seen)
    advice += [Advice(f"inputs.{role}", why) for role, why in seen.unmeasured.items() if why]
    if seen.origin_m is not None:
        why = f"poses are far from 0 (UTM coordinates?): positions are from {list(seen.origin_m)}"
        advice.append(Advice("origin_m", f"{why}, and so are zones and floors"))
    if seen.commands.steered and not seen.robot.described:
        reported = "a guess, and with it every yaw rate that was commanded: measure it"
        advice.append(Advice("inputs.command.wheelbase_m", reported))
    if not seen.footprint.measured and seen.roles["scan"]:
        said = seen.footprint.source.replace("A GUESS", "a guess").replace("MEASURE IT", "")
        advice.append(Advice("task.body", f"{said}--footprint"))
    if not seen.roles["bumper"]:
        advice += [Advice("inputs.bumper", line) for line in unread_bumpers(recording)]
    if clouds := clouds_alone(recording, seen.roles):
        advice.append(Advice("inputs.scan", clouds))
    if reported := lidar_guess(seen.footprint):
        advice.append(Advice("task.body.lidar_yaw_rad", reported.replace("A GUESS", "a guess")))
    if seen.footprint.upside_down and seen.roles["scan"]:
        advice.append(Advice("inputs.scan", UPSIDE_DOWN))
    return Proposal(
        *(text, recording.path, missing, len(seen.signals)),
        *(trial.ticks, trial.transitions, problems, advice),
        several_commands(recording),
        findings=trial.findings,
        wheeled=other is None,
    )


def _odd_commands(seen: Evidence) -> list[Advice]:
    """Advise on commands that no action has, or that ask for nothing at all."""
    if not seen.roles["command"]:
        return []
    topic, kind = seen.roles["command"][0]
    reported = Input(topic.name, topic.type, dict(kind.fields))
    path, found = sideways_path(reported), []
    if path in seen.recording.leaves(topic.name):
        fields = seen.recording.read({topic.name: [path]})[topic.name].fields
        notes = sideways_notes(reported, fields)
        found = [Advice("inputs.command", note.removeprefix("command: ")) for note in notes]
    if seen.commands.still:
        text = f"{topic.name} never asks the robot to move: the actions are a guess"
        found.append(Advice("task.actions", text))
    return found


def _without_odd(seen: Evidence, name: str, trial: Trial) -> tuple[Evidence, Trial]:
    """Leave out odometry and gyros whose speeds are other ones than those of the poses."""
    roles = {"wheels": "wheels", "gyro": "imu"}
    while off := [one for one in trial.findings if one.kind in roles]:
        why = f"{off[0].topic} is not used, as {off[0].what}"
        other = without_first(seen, roles[off[0].kind], why)
        if other is None:
            break
        seen = other
        trial = tried(seen.recording, "\n".join(profile_lines(seen, name, [])))
    return seen, trial


def _by_rate(
    recording: Recording, seen: Evidence, name: str, trial: Trial
) -> tuple[Evidence, Trial]:
    """Use a tick every period instead of one per command, if that pays.

    It does if it makes rows of much more time, or if commands come too unevenly for the twin to
    follow.
    """
    clock = seen.clock
    if clock.steps != "command":
        return seen, trial
    goalless = replace(seen, goal=GoalChoice(None))  # pauses may cost the goals of a drive, too
    rate = replace(seen, clock=clock.at_a_rate())
    now, other = (
        tried(recording, "\n".join(profile_lines(one, name, [])))
        for one in (goalless, replace(goalless, clock=rate.clock))
    )
    if other.problem:
        return seen, trial
    if other.seconds > GAIN * now.seconds:
        why = (
            f"one tick per command gives {now.seconds:.0f} s of rows, one per period "
            f"{other.seconds:.0f} s: commands pause, and hold."
        )
    elif other.even_s > UNEVEN * now.even_s and GAIN * other.seconds > now.seconds:
        why = (
            f"with one tick per command the twin can follow {now.even_s:.0f} s, with one per "
            f"period {other.even_s:.0f} s: commands come unevenly."
        )
    else:
        return seen, trial
    comments = (*clock.comments, why)
    rate = replace(rate, clock=replace(rate.clock, comments=comments))
    return rate, tried(recording, "\n".join(profile_lines(rate, name, [])))


def tried(recording: Recording, toml: str) -> Trial:
    """Try the profile of this TOML on the recording."""
    try:
        profile = as_recorded(parse_profile(toml, where="the proposal"), recording.topics)
        return try_profile(profile, read_topics(recording, profile))
    except (ConfigError, RecordingError) as error:
        return Trial(problem=error.what)


DRONES = ("mavros_msgs/", "px4_msgs/", "mav_msgs/", "ardupilot_msgs/", "crazyflie_interfaces/")
MULTI_DOF = "trajectory_msgs/msg/MultiDOFJointTrajectory"
ON_WHEELS = "Restock is for wheeled robots: give a recording of one, with its velocity commands"


def no_wheeled_robot(
    recording: Recording, command: Sequence[tuple[TopicInfo, Kind]], *, located: bool
) -> str | None:
    """Say what a recording seems to be if it is not of a wheeled robot; else None.

    `command` are the topics that may drive it, `located` whether anything says where it is.
    """
    if command:
        off, requested = off_the_floor(recording, command[0])
        if 2 * off > requested:
            return (
                f"this looks like a robot arm's or a drone's recording ({off:,} of the"
                f" {requested:,} commands to move of {command[0][0].name} have linear.z, angular.x"
                f" or angular.y): {ON_WHEELS}"
            )
        if located:
            return None
    types = {topic.type for topic in recording.topics.values() if topic.expected}
    flying = sorted(kind for kind in types if kind.startswith(DRONES) or kind == MULTI_DOF)
    if not flying:
        return None
    return f"this looks like a drone's recording (it has {', '.join(flying[:3])}): {ON_WHEELS}"
