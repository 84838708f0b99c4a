"""What the commands of a recording say of its robot: how fast, which way, how long each holds.

And whether the robot turned by them as a car does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from restock.arrays import F64, Ints
from restock.ingest.containers.recording import Recording
from restock.ingest.containers.topic_reading import TopicInfo
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.profile.inputs import is_motion
from restock.ingest.propose.driven.command_hold import (
    CommandHold,
    command_hold,
    limit_of,
    settled_speeds,
)
from restock.ingest.propose.driven.steering import (
    DriveEvidence,
    drive_evidence,
    shown_wheelbase_m,
)
from restock.ingest.propose.evidence.clock_choice import Gaps
from restock.ingest.propose.evidence.robot_lines import RobotProposal
from restock.ingest.propose.evidence.roles import Kind, Roles
from restock.ingest.steps.motion import PoseSeries

MOSTLY, RARELY = 98, 2  # percentiles of speeds: what is beyond is an outlier
APART = 0.25  # of the fastest command; a command that is further from every action is far off it
SLIGHT = 0.05  # of the largest speed of commands: noise, or what was rounded


@dataclass(frozen=True)
class Commands:
    """What the commands of a recording say about the robot."""

    speed_mps: float = 0.5
    yaw_rate_radps: float = 1.0
    reverse_mps: tuple[float, ...] = ()  # slowest first; none where it was never told to back up
    still: bool = False  # it was told nothing but to stand
    count: int = 0
    topic: str = ""
    measured: bool = False  # they are odometry, in place of commands
    steered: bool = False  # by the angle of the front wheels, as a car
    wheelbase_m: float = 0.3
    wheelbase_from: str = "A GUESS: MEASURE IT"
    reached: tuple[float | None, float | None] = (None, None)  # m/s, rad/s: at most, if below

    def limited(self, speed_mps: float | None, yaw_rate_radps: float | None) -> Commands:
        """The same for a robot that stays below these commands; None: it does what they say."""
        most = speed_mps or self.speed_mps
        return replace(
            self,
            speed_mps=most,
            yaw_rate_radps=yaw_rate_radps or self.yaw_rate_radps,
            reverse_mps=tuple(sorted({min(back, most) for back in self.reverse_mps})),
            reached=(speed_mps, yaw_rate_radps),
        )

    def fastest(self, speed_mps: F64, yaw_rate_radps: F64) -> Commands:
        """The fastest of these (N,) that is commanded now and then; an outlier is no action."""
        if not len(speed_mps):
            return self
        fast, sharp = (float(np.percentile(np.abs(c), MOSTLY)) for c in (speed_mps, yaw_rate_radps))
        most = fast or Commands.speed_mps
        return replace(
            self,
            speed_mps=most,
            yaw_rate_radps=sharp or Commands.yaw_rate_radps,
            reverse_mps=_reverse_speeds(-speed_mps[speed_mps < -0.05 * fast], most),
            still=not (speed_mps.any() or yaw_rate_radps.any()),
        )


def _reverse_speeds(back_mps: F64, most_mps: float) -> tuple[float, ...]:
    """The fastest of these speeds in reverse (N,) that is commanded now and then, at most
    `most_mps`; half of it, too, where others are so slow that they would be far off that one."""
    if not len(back_mps):
        return ()
    slow, fast = (min(float(np.percentile(back_mps, p)), most_mps) for p in (RARELY, MOSTLY))
    return (fast / 2, fast) if fast - slow > APART * most_mps else (fast,)


def read_commands(
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
        measured=is_motion(topic.type),
        steered="steering_rad" in kind.fields,
        wheelbase_m=wheelbase_m or Commands.wheelbase_m,
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
    recording: Recording,
    fit: tuple[TopicInfo, Kind],
    wheelbase_m: float | None,
    *,
    angles: bool = False,
) -> tuple[TopicColumns, Ints, F64, F64]:
    """The commands of a topic; of those that are numbers log time (N,), m/s (N,), rad/s (N,), or
    of steering angles, with `angles`, rad."""
    topic, kind = fit
    paths = list(kind.fields.values())
    columns = recording.read({topic.name: paths})[topic.name]
    speed, turn = (np.asarray(columns.fields[path], np.float64) for path in paths)
    if "steering_rad" in kind.fields and not angles:
        turn = speed * np.tan(turn) / (wheelbase_m or Commands.wheelbase_m)
    sane = np.isfinite(speed) & np.isfinite(turn)
    return columns, columns.log_time_ns[sane], speed[sane], turn[sane]


def off_the_floor(recording: Recording, fit: tuple[TopicInfo, Kind]) -> tuple[int, int]:
    """Of the Twists of a topic that ask for motion, how many ask for some that no wheels make: up
    and down, roll or pitch; and how many there are. (0, 0) of other types, and of odometry, which
    was measured on floors that are not even."""
    topic, kind = fit
    message = kind.fields["speed_mps"].removesuffix("linear.x")
    leaves = [f"{message}{part}.{axis}" for part in ("linear", "angular") for axis in "xyz"]
    if is_motion(topic.type) or not set(leaves) <= set(recording.leaves(topic.name)):
        return 0, 0
    fields = recording.read({topic.name: leaves})[topic.name].fields
    requested = np.abs(np.stack([np.asarray(fields[leaf], np.float64) for leaf in leaves], axis=1))
    requested = requested[np.isfinite(requested).all(axis=1) & (requested > 0).any(axis=1)]
    if not len(requested):
        return 0, 0
    least = SLIGHT * float(np.percentile(requested.max(axis=1), MOSTLY))
    return int((requested[:, [2, 3, 4]] > least).any(axis=1).sum()), len(requested)


def leaves_the_floor(recording: Recording, fit: tuple[TopicInfo, Kind]) -> bool:
    """Whether most commands of a topic are for an arm or a drone."""
    off, requested = off_the_floor(recording, fit)
    return 2 * off > requested


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
            told_s, reported[order], at_s, np.asarray(columns.fields[path], np.float64), most
        )
        for reported, path, most in zip((speed, turn), paths, fastest, strict=True)
    ]
    return found[0], found[1]


def how_it_turned(
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
    if is_motion(topic.type) or poses is None or len(poses) < 2:
        return DriveEvidence(), None
    return drive_evidence(*_since(recording, roles, poses)), None


def wheelbase_of(
    recording: Recording, roles: Roles, poses: PoseSeries | None, robot: RobotProposal
) -> RobotProposal:
    """The robot with the wheelbase by which steering angles explain how it turned, where nothing
    describes it and they do."""
    angled = bool(roles["command"]) and "steering_rad" in roles["command"][0][1].fields
    if robot.described or not angled or poses is None or len(poses) < 2:
        return robot
    told_s, _, told_rad, since = _since(recording, roles, poses, angles=True)
    wheelbase_m = shown_wheelbase_m(told_s, told_rad, since, robot.values.get("max_steering_rad"))
    return robot if wheelbase_m is None else robot.with_wheelbase(wheelbase_m)


def _since(
    recording: Recording, roles: Roles, poses: PoseSeries, *, angles: bool = False
) -> tuple[F64, F64, F64, PoseSeries]:
    """The commands in order, in seconds (N,), m/s and rad/s, and the poses: both since the first
    pose. With `angles` the steering angles themselves, in rad."""
    _, times, speed, turn = commanded(recording, roles["command"][0], None, angles=angles)
    order, zero = np.argsort(times, kind="stable"), poses.stamp_ns[0]
    since = PoseSeries(poses.stamp_ns - zero, poses.x_m, poses.y_m, poses.yaw_rad)
    return (times[order] - zero) * 1e-9, speed[order], turn[order], since
