"""A first profile for an unknown robot: from the topics and types of one of its recordings.

What each topic is for is guessed from its type and name; the clock, the speeds of the actions,
maximum ages, the lidar's range, the outline and the frames come from the messages. The proposal
is then tried on the recording, so that it says what its choices cost. It is TOML with a comment at
each guess, and with all that might become custom signals, commented out.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from restock.arrays import F64, Ints
from restock.errors import ConfigError, RecordingError
from restock.ingest.containers.recording import Recording
from restock.ingest.containers.topic_reading import TopicInfo
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.profile.inputs import MOTION
from restock.ingest.profile.profile import parse_profile
from restock.ingest.propose.cameras import camera_topics
from restock.ingest.propose.candidates import candidates
from restock.ingest.propose.clock_choice import Gaps, by_log_time, choose_clock
from restock.ingest.propose.command_choice import CommandChoice, choose_command
from restock.ingest.propose.driven.command_hold import (
    CommandHold,
    command_hold,
    limit_of,
    settled_speeds,
)
from restock.ingest.propose.driven.steering import (
    DriveEvidence,
    TurnReading,
    drive_evidence,
    turn_reading,
)
from restock.ingest.propose.footprint import GUESS, Footprint, footprint_of
from restock.ingest.propose.goal_choice import GoalChoice
from restock.ingest.propose.kinds import no_wheeled_robot
from restock.ingest.propose.motion_choice import choose_motion, pose_series
from restock.ingest.propose.proposal_lines import (
    Commands,
    Evidence,
    profile_lines,
    steered_by,
)
from restock.ingest.propose.robot_lines import RobotProposal, propose_robot, urdf_footprint
from restock.ingest.propose.roles import (
    FIX,
    KINDS,
    LATCHED,
    ODOMETRY_AS_COMMAND,
    REQUIRED,
    SPENT,
    Kind,
    Roles,
    several_commands,
    topics_for,
    transform_frames,
    usable_topics,
)
from restock.ingest.propose.scanned_outline import lidar_place, scanned_outline, with_lidar
from restock.ingest.propose.trial import GAIN, UNEVEN, Advice, Trial, try_profile
from restock.ingest.steps.clocks import STAMP
from restock.ingest.steps.motion import PoseSeries
from restock.ingest.steps.needs import as_recorded, read_topics
from restock.ingest.task.robot import USUAL_STEERING_RAD

LOG_TIME = 'alignment = "log_time"'  # as refusals of header stamps say

# What a recording lacks -> what to do about it.
REMEDIES = {
    "command": "record the topic that the robot is driven by (geometry_msgs/msg/Twist)",
    "pose": "nothing says where the robot is; record a localisation, odometry, or the transforms"
    " of /tf and /tf_static",
}
INSTEAD_OF_COMMANDS = (
    "; or, where the measured motion may stand in for commands, --odometry-as-command"
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
    missing: list[str] = field(default_factory=list)  # required inputs that nothing fills
    signals: int = 0  # custom signals that stand in it, commented out
    ticks: int = 0
    transitions: int = 0
    problems: list[str] = field(default_factory=list)  # why it cannot be used as it is
    advice: list[Advice] = field(default_factory=list)  # what choices cost, and what to try
    commands: list[str] = field(default_factory=list)  # topics, where several may drive the robot
    kinds: list[RobotKind] = field(default_factory=list)  # where there are several: its own first
    wheeled: bool = True  # False: it is taken for a drone's recording, or an arm's, or cameras'


def propose_profile(
    recording: Recording,
    name: str,
    *,
    footprint: Footprint | None = None,
    urdf: Path | None = None,
    odometry_as_command: bool = False,
) -> Proposal:
    """A profile for recordings like this one.

    Args:
        recording: what it is proposed from, and tried on.
        name: of the profile.
        footprint: the robot's outline, where it is known; else what the recording says of it.
        urdf: a file that describes the robot, in place of the recording's own description.
        odometry_as_command: take the measured motion for commands where none was recorded.

    Raises:
        ConfigError: the URDF cannot be used; says why.
    """
    return propose_from(
        gather(recording, footprint, urdf, odometry_as_command=odometry_as_command), name
    )


def propose_from(seen: Evidence, name: str, *, goal_decided: bool = False) -> Proposal:
    """A profile from what was gathered, tried on the recording that it was gathered from.

    With `goal_decided` its goal is not left out where this recording alone has few by hindsight.
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
    elif seen.turns is not None and seen.turns.problem:
        problems.append(steered_by(seen))
    text = "\n".join(profile_lines(seen, name, problems))
    trial = Trial()
    if not problems:
        trial = tried(recording, text)
        if trial.problem and LOG_TIME in trial.problem and seen.clock.alignment == STAMP:
            seen = replace(seen, clock=by_log_time(seen.clock, seen.gaps, trial.problem))
            trial = tried(recording, "\n".join(profile_lines(seen, name, problems)))
        seen, trial = _by_rate(recording, seen, name, trial)
        goal = seen.goal.tried(trial.transitions, trial.dropped)
        if goal != seen.goal and not goal_decided:
            seen = replace(seen, goal=goal)
            trial = tried(recording, "\n".join(profile_lines(seen, name, problems)))
        if trial.problem:
            problems.append(trial.problem)
        text = "\n".join(profile_lines(seen, name, problems, trial))
    advice = [*trial.advice]
    if seen.turns is not None and not seen.turns.problem:
        advice.append(Advice("inputs.command", steered_by(seen)))
    if seen.robot.guessed_steering and not seen.commands.steered:
        advice.append(Advice("robot.drive", f"it seems to steer as a car: {seen.turned.why}"))
    if not seen.footprint.measured and seen.roles["scan"]:
        said = seen.footprint.source.replace("A GUESS", "a guess").replace("MEASURE IT", "")
        advice.append(Advice("task.body", f"{said}--footprint"))
    return Proposal(
        *(text, missing, len(seen.signals), trial.ticks, trial.transitions, problems, advice),
        several_commands(usable_topics(recording)),
        wheeled=other is None,
    )


def _by_rate(
    recording: Recording, seen: Evidence, name: str, trial: Trial
) -> tuple[Evidence, Trial]:
    """A tick every period instead of one a command, where that makes rows of much more time, or
    where commands come too unevenly for the twin to follow."""
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
            f"a tick a command makes rows of {now.seconds:.0f} s, one a period of"
            f" {other.seconds:.0f} s: commands pause, and hold."
        )
    elif other.even_s > UNEVEN * now.even_s and GAIN * other.seconds > now.seconds:
        why = (
            f"a tick a command leaves {now.even_s:.0f} s that the twin can follow, one a period"
            f" {other.even_s:.0f} s: commands come unevenly."
        )
    else:
        return seen, trial
    comments = (*clock.comments, why)
    rate = replace(rate, clock=replace(rate.clock, comments=comments))
    return rate, tried(recording, "\n".join(profile_lines(rate, name, [])))


def tried(recording: Recording, toml: str) -> Trial:
    """What the profile of this TOML makes of the recording."""
    try:
        profile = as_recorded(parse_profile(toml, where="the proposal"), recording.topics)
        return try_profile(profile, read_topics(recording, profile))
    except (ConfigError, RecordingError) as error:
        return Trial(problem=error.what)


def gather(
    recording: Recording,
    footprint: Footprint | None,
    urdf: Path | None = None,
    *,
    odometry_as_command: bool,
) -> Evidence:
    """What a recording says of its robot."""
    topics = usable_topics(recording)
    roles = {role: topics_for(topics, kinds) for role, kinds in KINDS.items()}
    chosen = CommandChoice()
    if not roles["command"] and odometry_as_command:
        roles["command"] = topics_for(topics, ODOMETRY_AS_COMMAND)
    else:
        roles["command"], chosen = choose_command(recording, topics, roles["command"])
    driven = {topic.name for topic, _ in roles["command"][:1]}
    roles["nav_command"] = [fit for fit in roles["nav_command"] if fit[0].name not in driven]
    if not (roles["goal"] and roles["plan"]):
        roles["goal"] = roles["plan"] = []
    frames = transform_frames(recording)
    if frames is not None and all(topic.type == FIX for topic, _ in roles["pose"]):
        roles["pose"] = []  # transforms say where it faces, too
    # Odometry drifts: where transforms lead to a map, they are the better pose.
    drifts = all(topic.type == MOTION for topic, _ in roles["pose"])
    framed = frames is not None and (frames.localised or not roles["pose"]) and drifts
    poses = None
    if framed or roles["pose"]:
        poses, _ = pose_series(recording, roles, frames if framed else None)
    frame = _scan_frame(recording, roles)
    scan = roles["scan"][0][0].name if roles["scan"] else None
    notes: list[str] = []
    if footprint is None and urdf is not None:
        footprint = urdf_footprint(urdf, frame)
    if footprint is None:
        footprint, notes = footprint_of(recording, frame)
    outline = scanned_outline(recording, scan, poses) if scan is not None else None
    if footprint is None:
        footprint = (outline.footprint(GUESS) if outline else None) or GUESS
    if footprint.lidar_x_m is None and scan is not None:
        footprint = with_lidar(footprint, lidar_place(recording, frame))
    robot = propose_robot(recording, scan, frame, urdf)
    turned, told_rad = _turned(recording, roles, poses)
    robot = robot.driven(turned, footprint.length_m, told_rad=told_rad)
    turns = _turns(recording, roles, poses, robot, turned)
    if turns is not None and turns.is_angle:
        roles["command"], chosen = choose_command(recording, topics, _as_angles(roles["command"]))
        if turns.wheelbase_m is not None:
            robot = replace(robot, values=robot.values | {"wheelbase_m": turns.wheelbase_m})
    wheelbase_m = robot.values.get("wheelbase_m")
    commands, gaps, hold = _commands(recording, roles, poses, wheelbase_m)
    commands = replace(commands, wheelbase_known=robot.described and wheelbase_m is not None)
    paces = _paces(recording, roles)
    gaps = replace(gaps, hold_s=hold.age_s, sensor_s=_seldomest(paces, roles, poses))
    motion = None
    if not roles["wheels"] and (framed or roles["pose"]):
        motion = choose_motion(recording, roles, frames, framed=framed)
    best = [(role, *fitting[0]) for role, fitting in roles.items() if fitting]
    return Evidence(
        recording,
        roles,
        frames,
        framed,
        motion,
        commands,
        chosen,
        hold,
        turned,
        turns,
        paces,
        choose_clock(
            recording,
            list(dict.fromkeys(topic.name for _, topic, _ in best)),
            frozenset(topic.name for role, topic, _ in best if role in LATCHED),
            gaps,
            stamped=_stamped(recording, roles, commands),
        ),
        gaps,
        _driven_s(recording, gaps),
        footprint,
        notes,
        outline,
        GoalChoice.of(logged=bool(roles["goal"])),
        candidates(
            recording,
            without={topic.name for role, topic, _ in best if role in SPENT},
            used={(topic.name, path) for _, topic, kind in best for path in kind.fields.values()},
        ),
        camera_topics(recording, _driven_s(recording, gaps)),
        robot,
    )


def _turned(
    recording: Recording, roles: Roles, poses: PoseSeries | None
) -> tuple[DriveEvidence, float | None]:
    """How the robot turned under its Twists; and the sharpest of commands that are angles."""
    if not roles["command"]:
        return DriveEvidence(), None
    topic, kind = roles["command"][0]
    if (path := kind.fields.get("steering_rad")) is not None:
        fields = recording.read({topic.name: [path]})[topic.name].fields
        angles = np.abs(np.asarray(fields[path], np.float64))
        angles = angles[np.isfinite(angles)]
        return DriveEvidence(), float(np.percentile(angles, 98)) if len(angles) else 0.0
    if topic.type == MOTION or poses is None or len(poses) < 2:
        return DriveEvidence(), None
    return drive_evidence(*_since(recording, roles, poses)), None


def _since(
    recording: Recording, roles: Roles, poses: PoseSeries
) -> tuple[F64, F64, F64, PoseSeries]:
    """The commands in order, in seconds (N,), m/s and rad/s, and the poses: both since the first
    pose."""
    _, times, speed, turn = commanded(recording, roles["command"][0], None)
    order, zero = np.argsort(times, kind="stable"), poses.stamp_ns[0]
    since = PoseSeries(poses.stamp_ns - zero, poses.x_m, poses.y_m, poses.yaw_rad)
    return (times[order] - zero) * 1e-9, speed[order], turn[order], since


def _turns(
    recording: Recording,
    roles: Roles,
    poses: PoseSeries | None,
    robot: RobotProposal,
    turned: DriveEvidence,
) -> TurnReading | None:
    """What the turns of Twists are to a robot that steers; None where it does not, or is driven
    by steering angles."""
    steers = robot.values.get("drive") == "ackermann"
    if not (steers and roles["command"]):
        return None
    topic, kind = roles["command"][0]
    if topic.type == MOTION or "steering_rad" in kind.fields:
        return None
    if poses is None or len(poses) < 2:
        return TurnReading()
    told, most = _since(recording, roles, poses), robot.values.get("max_steering_rad")
    wheelbase_m = robot.values["wheelbase_m"]
    if not robot.guessed_steering:
        return turn_reading(*told, wheelbase_m, most)
    least_m = turned.turning_m or wheelbase_m / float(np.tan(most or USUAL_STEERING_RAD))
    reading = turn_reading(*told, None, least_m=least_m)
    # That it steers is only a guess: that it is told in no known way is no reason to refuse it.
    return reading if not reading.problem else TurnReading(least_m=least_m)


def _as_angles(fitting: list[tuple[TopicInfo, Kind]]) -> list[tuple[TopicInfo, Kind]]:
    """The same topics, their turns read as steering angles."""
    return [
        (topic, replace(kind, fields={_ANGLES.get(k, k): v for k, v in kind.fields.items()}))
        for topic, kind in fitting
    ]


_ANGLES = {"yaw_rate_radps": "steering_rad"}


def _commands(
    recording: Recording, roles: Roles, poses: PoseSeries | None, wheelbase_m: float | None
) -> tuple[Commands, Gaps, CommandHold]:
    """Read the commands: how fast, which way, how often, and how long each holds."""
    if not roles["command"]:
        return Commands(), Gaps(), CommandHold()
    topic, kind = roles["command"][0]
    columns, times, speed, turn = commanded(recording, (topic, kind), wheelbase_m)
    commands = replace(
        Commands().fastest(speed, turn),
        count=len(columns),
        topic=topic.name,
        measured=topic.type == MOTION,
        steered="steering_rad" in kind.fields,
        wheelbase_m=wheelbase_m or Commands.wheelbase_m,
        wheelbase_known=wheelbase_m is not None,
    )
    settled = settled_at_most(recording, roles, commands, times, speed, turn)
    commands = commands.limited(
        limit_of(settled[0], commands.speed_mps), limit_of(settled[1], commands.yaw_rate_radps)
    )
    hold = CommandHold()
    if poses is not None and len(poses) > 1 and not commands.measured:
        order, zero = np.argsort(times, kind="stable"), poses.stamp_ns[0]
        seconds = (times[order] - zero) * 1e-9
        since = PoseSeries(poses.stamp_ns - zero, poses.x_m, poses.y_m, poses.yaw_rad)
        hold = command_hold(seconds, speed[order], turn[order], since)
    return commands, Gaps.of(columns), hold


def commanded(
    recording: Recording, fit: tuple[TopicInfo, Kind], wheelbase_m: float | None
) -> tuple[TopicColumns, Ints, F64, F64]:
    """The commands of a topic; of those that are numbers log time (N,), m/s (N,), rad/s (N,)."""
    topic, kind = fit
    paths = list(kind.fields.values())
    columns = recording.read({topic.name: paths})[topic.name]
    speed, turn = (np.asarray(columns.fields[path], np.float64) for path in paths)
    if "steering_rad" in kind.fields:
        turn = speed * np.tan(turn) / (wheelbase_m or Commands.wheelbase_m)
    sane = np.isfinite(speed) & np.isfinite(turn)
    return columns, columns.log_time_ns[sane], speed[sane], turn[sane]


def settled_at_most(
    recording: Recording, roles: Roles, commands: Commands, times: Ints, speed: F64, turn: F64
) -> tuple[F64, F64]:
    """What odometry measured, in m/s (K,) and rad/s (L,), once the fastest commands had settled."""
    nothing = np.zeros(0), np.zeros(0)
    if not roles["wheels"] or commands.measured or not len(times):
        return nothing
    topic, kind = roles["wheels"][0]
    paths = list(kind.fields.values())
    columns = recording.read({topic.name: paths})[topic.name]
    order = np.argsort(times, kind="stable")
    told_s = np.asarray((times[order] - times[order[0]]) * 1e-9, np.float64)
    at_s = np.asarray((columns.log_time_ns - times[order[0]]) * 1e-9, np.float64)
    fastest = commands.speed_mps, commands.yaw_rate_radps
    found = [
        settled_speeds(
            told_s, told[order], at_s, np.asarray(columns.fields[path], np.float64), most
        )
        for told, path, most in zip((speed, turn), paths, fastest, strict=True)
    ]
    return found[0], found[1]


def _paces(recording: Recording, roles: Roles) -> dict[str, float]:
    """Of each topic that fills an input, how far apart its messages mostly are (s, log time)."""
    names = {fitting[0][0].name for fitting in roles.values() if fitting}
    found = {}
    for name, columns in recording.read({name: [] for name in sorted(names)}).items():
        gaps = np.diff(np.sort(columns.log_time_ns)) * 1e-9
        if len(gaps) > 1:
            # The median, or the mean of half of them where messages come in bursts.
            found[name] = max(float(np.median(gaps)), float(np.percentile(gaps, 90)) / 2)
    return found


def _seldomest(paces: dict[str, float], roles: Roles, poses: PoseSeries | None) -> float:
    """The time between two messages of pose or wheels, whichever come less often."""
    names = [
        fitting[0][0].name for role in ("pose", "wheels") for fitting in [roles[role]] if fitting
    ]
    known = [paces[name] for name in names if name in paces]
    if poses is not None and len(poses) > 1 and not names:
        known.append(float(np.median(np.diff(poses.stamp_ns))) * 1e-9)
    return max(known, default=0.0)


def _stamped(recording: Recording, roles: Roles, commands: Commands) -> bool:
    """Whether the sensors carry header stamps."""
    sensors = [
        fitting[0][0] for role, fitting in roles.items() if fitting and role in (*REQUIRED, "scan")
    ]
    sensing = [t for t in sensors if t.name != commands.topic or commands.measured]
    return bool(sensing) and all(STAMP in recording.leaves(t.name) for t in sensing)


def _driven_s(recording: Recording, gaps: Gaps) -> float:
    """How long the robot drove: recordings may pause between drives."""
    span = recording.span_ns
    whole = (span[1] - span[0]) * 1e-9 if span else 0.0
    if gaps.period_s is None:
        return whole
    driven = gaps.period_s * gaps.count
    return min(driven, whole) if driven > whole / 10 else whole


def _scan_frame(recording: Recording, roles: Roles) -> str:
    """The frame that scans say they are in."""
    path = "header.frame_id"
    if not roles["scan"] or path not in recording.leaves(roles["scan"][0][0].name):
        return ""
    topic = roles["scan"][0][0].name
    frames = np.asarray(recording.read({topic: [path]})[topic].fields[path], object)
    return str(frames[0]) if len(frames) else ""
