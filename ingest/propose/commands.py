"""Finds who commands a recording's robot, how fast, and how long each command holds.

A multiplexer's output repeats its inputs: if topic A changes to what topic B has just commanded,
and not the other way round, A comes after B.

Some drivers stop a robot that receives no command for half a second; others continue until the next
command. If commands are rare, this decides the number of rows. It is therefore read from the poses:
in each gap after a command to move, the robot still moved when the gap ended, or it stood still
from some moment on. A command to stop holds until the next one whatever the driver does.

The speed that the robot reached under its fastest commands is measured, too, as a driver scales
down or cuts off what the wheels cannot do. Commands beyond that speed are not actions of the robot:
a twin that obeyed them would not move as the robot did.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from restock.arrays import F64, Ints
from restock.ingest.containers.recording import Recording
from restock.ingest.containers.storage import TopicInfo
from restock.ingest.profile.tables import is_motion
from restock.ingest.propose.clock_choice import Gaps
from restock.ingest.propose.robot_choice import DriveEvidence, drive_evidence
from restock.ingest.propose.roles import BY_HAND, NAVIGATION, Kind
from restock.ingest.steps.frames import PoseSeries
from restock.ingest.task.task import wrap_angle

PASSED_WITHIN_S = 0.5
# Least number and shares of a topic's changes that must repeat another topic's commands.
MIN_PASSED, MIN_SHARE, HALF = 5, 0.02, 0.5
Fit = tuple[TopicInfo, Kind]


@dataclass(frozen=True)
class CommandSource:
    """A topic whose commands the driving topic repeats, and its behaviour policy."""

    policy: str
    fit: Fit
    passed_on: int  # changes of the driving command that come from this topic
    max_age_s: float

    def toml(self, wheelbase_m: float) -> list[str]:
        """Return the TOML lines of its table, with the wheelbase if it has steering angles."""
        topic, kind = self.fit
        fields = ", ".join(f'{key} = "{path}"' for key, path in kind.fields.items())
        steers = "steering_rad" in kind.fields
        return [
            f"[command_sources.{json.dumps(self.policy)}]  # the behaviour policy of its commands",
            f"topic = {json.dumps(topic.name)}  # {self.passed_on:,} of its changes drive",
            f'type = "{topic.type}"',
            f"fields = {{ {fields} }}",
            *([f"wheelbase_m = {round(wheelbase_m, 4):g}"] if steers else []),
            f"max_age_s = {self.max_age_s:g}",
            "",
        ]


@dataclass(frozen=True)
class CommandLog:
    """The finite commands of a topic, in the order of log time."""

    fit: Fit
    log_time_ns: Ints  # (N,)
    values: F64  # (N, 2) speed (m/s), and yaw rate (rad/s) or the angle of the front wheels (rad)
    gaps: Gaps

    @classmethod
    def read(cls, recording: Recording, fit: Fit) -> CommandLog:
        """Read the commands of a topic."""
        topic, kind = fit
        paths = list(kind.fields.values())
        columns = recording.read({topic.name: paths})[topic.name]
        values = np.stack([np.asarray(columns.fields[path], np.float64) for path in paths], axis=1)
        rows = np.argsort(columns.log_time_ns, kind="stable")
        rows = rows[np.isfinite(values[rows]).all(axis=1)]
        return cls(fit, columns.log_time_ns[rows], values[rows], Gaps.of(columns))

    @property
    def measured(self) -> bool:
        """Return whether the topic is odometry, used as commands."""
        return is_motion(self.fit[0].type)

    @property
    def steered(self) -> bool:
        """Return whether the commands contain the angle of the front wheels, as for a car."""
        return "steering_rad" in self.fit[1].fields

    @cached_property
    def changed(self) -> Ints:
        """Return the rows whose command differs from that of the row before."""
        return np.flatnonzero((np.diff(self.values, axis=0) != 0).any(axis=1)) + 1

    def passed_on(self, output: CommandLog) -> int:
        """Count the changes of `output` to the value that this topic had just commanded."""
        times = output.log_time_ns[output.changed]
        at = np.searchsorted(self.log_time_ns, times, "right") - 1
        age_s = (times - self.log_time_ns[np.maximum(at, 0)]) * 1e-9
        same = (self.values[np.maximum(at, 0)] == output.values[output.changed]).all(axis=1)
        return int((same & (at >= 0) & (age_s <= PASSED_WITHIN_S)).sum())

    def feeds(self, output: CommandLog, share: float) -> bool:
        """Return whether at least this share of the changes of `output` repeats this topic."""
        passed = self.passed_on(output)
        enough = passed >= max(MIN_PASSED, share * len(output.changed))
        return enough and passed > output.passed_on(self)

    def max_age_s(self) -> float:
        """Return four times the median gap between commands, limited to 0.2 to 1 s."""
        gaps = np.diff(self.log_time_ns) * 1e-9
        return float(np.clip(round(4 * float(np.median(gaps)), 2), 0.2, 1.0)) if len(gaps) else 0.5


@dataclass(frozen=True)
class CommandChoice:
    """The driving command, its sources, and the behaviour policy of all other commands."""

    log: CommandLog | None = None  # None: no command was recorded
    sources: list[CommandSource] = field(default_factory=list)
    policy: str = "unknown"
    why: str = "the driver, if no topic says so"


def choose_command(recording: Recording, fitting: Sequence[Fit]) -> tuple[list[Fit], CommandChoice]:
    """Put the topic that drives the robot first, and find the sources of its commands.

    If multiplexers pass commands on from topic to topic, the last topic drives the robot.
    """
    logs = [CommandLog.read(recording, fit) for fit in fitting]
    reported = [one for one in logs if len(one.values)]
    if not reported:
        return list(fitting), CommandChoice(next(iter(logs), None))
    first = reported[0]
    for _ in reported:  # follow a chain of multiplexers to its last output
        later = [one for one in reported if one is not first and first.feeds(one, HALF)]
        if not later:
            break
        first = max(later, key=first.passed_on)
    chosen = [first.fit, *(fit for fit in fitting if fit is not first.fit)]
    inputs = [one for one in reported if one is not first and one.feeds(first, MIN_SHARE)]
    sources: dict[str, CommandSource] = {}
    for one in sorted(inputs, key=lambda one: -one.passed_on(first)):
        policy = _policy(one.fit[0].name)
        source = CommandSource(policy, one.fit, one.passed_on(first), one.max_age_s())
        sources.setdefault(policy, source)
    named = _policy(first.fit[0].name)
    if not sources and named in ("teleop", "navigation"):
        return chosen, CommandChoice(first, [], named, f"by the name of {first.fit[0].name}")
    return chosen, CommandChoice(first, [*sources.values()])


def _policy(topic: str) -> str:
    """Guess the behaviour policy from a topic's name."""
    name = topic.lower()
    if any(word in name for word in BY_HAND):
        return "teleop"
    if any(word in name for word in NAVIGATION):
        return "navigation"
    parts = [part for part in name.split("/") if part and part not in ("cmd_vel", "input")]
    return parts[-1][:64] if parts else name


MIN_GAP_S = 0.4  # gaps between commands that are shorter show little
WITHIN_S = 0.5  # time over which the speed within a gap is measured
MOVES = 0.25  # below this share of the commanded speed, the robot counts as standing
STANDS_M, STANDS_RAD = 0.05, 0.2  # largest movement in a gap of a robot that stands
MAX_S = 60.0
MAX_GAP_S = 3600.0  # if a gap between two commands is longer, log times are wrong
SETTLED_S = 1.0  # after commands have been fast for this long, latency and ramp are over
NEARLY = 0.8  # a command of at least this share of the fastest one counts as fast
MIN_SAMPLES = 10
HELD_BACK = 0.67  # a robot that stays below this share of its command has reached its limit


@dataclass(frozen=True)
class CommandHold:
    """Evidence of how long a robot keeps following a command, in log time."""

    age_s: float | None = None  # None: unknown
    stops_hold: bool = False  # whether a command to stop holds until the next command
    comments: tuple[str, ...] = ()


def command_hold(
    time_s: F64, speed_mps: F64, yaw_rate_radps: F64, poses: PoseSeries
) -> CommandHold:
    """Find how long commands (N,) hold, from the gaps between them.

    `poses` are on the clock of `time_s`, with the same zero.
    """
    at = np.asarray(poses.stamp_ns * 1e-9, np.float64)
    if not len(time_s) or len(at) < 2:
        return CommandHold()
    turned = np.concatenate([[0.0], np.cumsum(wrap_angle(np.diff(poses.yaw_rad)))])
    # Length of the path, not displacement: a robot that returns to its start has moved, too.
    way = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(poses.x_m), np.diff(poses.y_m)))])
    within = max(WITHIN_S, 3 * float(np.median(np.diff(at))))
    ends = np.append(time_s[1:], at[-1])
    on, stopped, stood, went = [], [], 0, 0
    for begin, end, speed, turn in zip(time_s, ends, speed_mps, yaw_rate_radps, strict=True):
        if not MIN_GAP_S <= end - begin <= MAX_GAP_S or at[0] > begin or at[-1] < end - within:
            continue
        if speed == 0 and turn == 0:
            settled = min(begin + 1.0, end)  # the robot brakes first
            moved = [float(np.ptp(np.interp([settled, end], at, c))) for c in (way, turned)]
            still = moved[0] <= STANDS_M and moved[1] <= STANDS_RAD
            stood, went = stood + still, went + (not still)
            continue
        moving = _followed_until(at, way, turned, begin, end, speed, turn, within)
        if moving is None:
            continue  # the robot never moved: it was blocked, or the command is for another one
        if moving >= end - within / 2:
            on.append(end - begin)
        else:
            stopped.append(moving - begin)
    return _hold_shown(on, stopped, stood, went)


def _followed_until(
    at: F64,
    way: F64,
    turned: F64,
    begin: float,
    end: float,
    speed: float,
    turn: float,
    within: float,
) -> float | None:
    """Return the time until which the robot followed its command in a gap; None if never."""
    checked = np.arange(min(begin + within, end), end + 1e-9, within / 4)
    checked = np.append(checked, end)
    since = np.maximum(checked - within, begin)
    span = np.maximum(checked - since, 1e-3)
    gone = (np.interp(checked, at, way) - np.interp(since, at, way)) / span
    spun = (np.interp(checked, at, turned) - np.interp(since, at, turned)) / span
    drives = gone >= MOVES * abs(speed) if speed else spun * np.sign(turn) >= MOVES * abs(turn)
    # Only times with a new pose show whether the robot drives.
    seen = np.searchsorted(at, checked, "right") > np.searchsorted(at, since, "left")
    moving = np.flatnonzero(drives & seen)
    if not len(moving):
        return None
    # Stop at the first break: later motion has another cause (a hand, another driver).
    broken = np.flatnonzero(~drives & seen & (checked > checked[moving[0]]))
    return float(checked[broken[0] - 1] if len(broken) else checked[moving[-1]])


def _hold_shown(on: list[float], stopped: list[float], stood: int, went: int) -> CommandHold:
    comments, age_s = [], None
    if on or stopped:
        age_s = min(max(on), MAX_S) if on else float(np.median(stopped))
        comments.append(
            f"it drove on to the end of {len(on)} of {len(on) + len(stopped)} gaps between commands"
            f" of {MIN_GAP_S:g} s and more"
        )
    if stood:
        comments.append(f"it stood through {stood} of {stood + went} gaps after a command to stop")
    return CommandHold(age_s, went <= stood, tuple(comments))


@dataclass(frozen=True)
class CommandedDrive:
    """The commands and the odometry of a drive; their columns are m/s and rad/s."""

    command_ns: Ints  # (N,) ascending
    command: F64  # (N, 2)
    odometry_ns: Ints  # (M,)
    odometry: F64  # (M, 2)

    @classmethod
    def of(
        cls, recording: Recording, log: CommandLog, wheels: Sequence[Fit], wheelbase_m: float | None
    ) -> CommandedDrive:
        """Read the odometry of a drive, and combine it with the commands in `log`."""
        speed, turn = log.values.T
        if log.steered:
            turn = speed * np.tan(turn) / (wheelbase_m or Commands.wheelbase_m)
        command = np.stack([speed, turn], axis=1)
        if not wheels or log.measured:
            return cls(log.log_time_ns, command, np.zeros(0, np.int64), np.zeros((0, 2)))
        topic, kind = wheels[0]
        paths = [kind.fields[key] for key in ("speed_mps", "yaw_rate_radps")]
        columns = recording.read({topic.name: paths})[topic.name]
        measured = [np.asarray(columns.fields[path], np.float64) for path in paths]
        return cls(log.log_time_ns, command, columns.log_time_ns, np.stack(measured, axis=1))

    def settled(self, axis: int, fastest: float) -> F64:
        """Return the measured speeds (K,) that the robot settled at under commands near `fastest`.

        Axis 0 is speed, axis 1 yaw rate. Values are positive in the command's direction.
        """
        reported, measured = self.command[:, axis], self.odometry[:, axis]
        if not len(reported):
            return np.zeros(0)
        fast = np.abs(reported) >= NEARLY * fastest
        # For each command: since when all commands have been fast, and in the same direction.
        breaks = (np.diff(fast) != 0) | (np.diff(np.sign(reported)) != 0)
        begins = np.where(np.append(True, breaks), np.arange(len(reported)), 0)
        since_ns = self.command_ns[np.maximum.accumulate(begins)]
        index = np.searchsorted(self.command_ns, self.odometry_ns, "right") - 1
        row = np.maximum(index, 0)
        settled = (index >= 0) & fast[row]
        settled &= (self.odometry_ns - since_ns[row]) * 1e-9 >= SETTLED_S
        settled &= (self.odometry_ns - self.command_ns[row]) * 1e-9 < SETTLED_S  # sent recently
        along = (measured * np.sign(reported[row]))[settled]
        return np.asarray(along[np.isfinite(along)], np.float64)


def _limit(settled: F64, fastest: float) -> float | None:
    """Return the robot's limit by its settled speeds (K,); None if it follows its commands.

    The limit is the 90th percentile: driving and turning share the wheels, so the robot is fastest
    on one axis when it needs least for the other.
    """
    if len(settled) < MIN_SAMPLES:
        return None
    reached = float(np.percentile(settled, 90))
    return float(f"{reached:.3g}") if 0.01 < reached < HELD_BACK * fastest else None


MOSTLY, RARELY = 98, 2  # percentiles of speeds; values beyond are outliers
APART = 0.25  # largest distance of a command to the nearest action, as a share of the top speed


@dataclass(frozen=True)
class Commands:
    """The speeds, yaw rates and kind of a recording's commands."""

    speed_mps: float = 0.5
    yaw_rate_radps: float = 1.0
    reverse_mps: tuple[float, ...] = ()  # slowest first; empty if it never backed up
    still: bool = False  # whether all commands are 0
    count: int = 0
    topic: str = ""
    measured: bool = False  # whether odometry is used as commands
    steered: bool = False  # whether commands contain the angle of the front wheels, as for a car
    wheelbase_m: float = 0.3
    reached: tuple[float | None, float | None] = (None, None)  # limits found: m/s, rad/s

    @classmethod
    def of(cls, drives: Sequence[CommandedDrive], **known: Any) -> Commands:
        """Find the fastest commands of these drives, and the speeds that the robot reached.

        `known` sets other fields.
        """
        command = np.concatenate([one.command for one in drives])
        found = replace(cls().fastest(*command.T), count=len(command), **known)
        fastest = found.speed_mps, found.yaw_rate_radps
        speed, turn = (
            _limit(np.concatenate([one.settled(axis, most) for one in drives]), most)
            for axis, most in enumerate(fastest)
        )
        most = speed or found.speed_mps
        return replace(
            found,
            speed_mps=most,
            yaw_rate_radps=turn or found.yaw_rate_radps,
            reverse_mps=tuple(sorted({min(back, most) for back in found.reverse_mps})),
            reached=(speed, turn),
        )

    def fastest(self, speed_mps: F64, yaw_rate_radps: F64) -> Commands:
        """Set the speeds to the fastest of these commands (N,), ignoring outliers."""
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
    """Return the fastest reverse speed without outliers, at most `most_mps`.

    Half this speed is added if slow commands would otherwise be far from every action.
    """
    if not len(back_mps):
        return ()
    slow, fast = (min(float(np.percentile(back_mps, p)), most_mps) for p in (RARELY, MOSTLY))
    return (fast / 2, fast) if fast - slow > APART * most_mps else (fast,)


def read_commands(
    recording: Recording,
    log: CommandLog | None,
    wheels: Sequence[Fit],
    poses: PoseSeries | None,
    wheelbase_m: float | None,
) -> tuple[CommandedDrive | None, Commands, CommandHold]:
    """Return a drive's commands with odometry, their fastest speeds, and how long they hold."""
    if log is None:
        return None, Commands(), CommandHold()
    drive = CommandedDrive.of(recording, log, wheels, wheelbase_m)
    commands = Commands.of(
        [drive],
        topic=log.fit[0].name,
        measured=log.measured,
        steered=log.steered,
        wheelbase_m=wheelbase_m or Commands.wheelbase_m,
    )
    if poses is None or len(poses) < 2 or log.measured:
        return drive, commands, CommandHold()
    hold = command_hold(*_from_first_pose(drive.command_ns, drive.command, poses))
    return drive, commands, hold


def turning_evidence(
    log: CommandLog | None, poses: PoseSeries | None
) -> tuple[DriveEvidence, float | None]:
    """Return how the robot turned under Twist commands.

    Also return the sharpest steering angle, if the commands are steering angles.
    """
    if log is not None and log.steered:
        angles = np.abs(log.values[:, 1])
        return DriveEvidence(), float(np.percentile(angles, MOSTLY)) if len(angles) else 0.0
    if log is None or log.measured or poses is None or len(poses) < 2:
        return DriveEvidence(), None
    return drive_evidence(*_from_first_pose(log.log_time_ns, log.values, poses)), None


def _from_first_pose(
    times_ns: Ints, values: F64, poses: PoseSeries
) -> tuple[F64, F64, F64, PoseSeries]:
    """Return command times (s), the two columns of commands, and poses; the first pose is at 0."""
    zero = poses.stamp_ns[0]
    since = PoseSeries(poses.stamp_ns - zero, poses.x_m, poses.y_m, poses.yaw_rad)
    return (times_ns - zero) * 1e-9, values[:, 0], values[:, 1], since
