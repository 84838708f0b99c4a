"""Consistency checks of a recording: compare its signals, find contradictions, suggest remedies.

Each check needs two independent sources of one quantity, and reports a finding only if they differ
for most of the drive: slip, latency and noise cause differences for a while, a wrong unit or clock
throughout. Ingest, `profile new` and `profile check` report these findings; a store keeps them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from restock.arrays import F64, Bools, Ints
from restock.errors import counted
from restock.ingest.steps.align import NS, ClockReport
from restock.ingest.steps.aligned_inputs import AlignedInputs
from restock.ingest.steps.input_columns import InputColumns
from restock.ingest.task.task import Signals, wrap_angle

WINDOW_S = 3.0  # length of the windows in which two sources of a speed are compared
MIN_WINDOWS = 5  # fewest windows with motion; fewer are no evidence
APART = 1.25  # two speeds contradict if they differ by this factor in three of four windows
STILL = 0.05  # a ratio below this means that the source stays at 0
MOVES = 0.2  # the robot moves in a window if its mean speed is above this * the fastest command
TURNS_RAD = 0.3  # smallest turn in a window in which yaw rates are compared
STEPS_PER_WINDOW = 2 / 3  # share of a window's time that joined steps must cover
BEYOND, BEYOND_MPS = 1.5, 0.1  # poses jump above BEYOND * fastest command or wheel + BEYOND_MPS
OFTEN = 0.02  # share of the steps, or messages, from which a problem is reported
SPIKE = 3.0  # a spike is above SPIKE * the fastest command or pose + SPIKE_MARGIN
SPIKE_MARGIN = {"speed_mps": 1.0, "yaw_rate_radps": 3.0}  # m/s, rad/s; a robot may be carried
SPIKES = 0.1  # largest share of messages that are spikes; if more are, the scale is wrong
MIN_STEPS = 5
JUMP_M = 0.2  # a jump is this much farther than possible; less may be the localiser's noise
LEADS, SURE = 0.03, 0.8  # motion is early if an earlier lag correlates by LEADS better, above SURE
MAX_LEAD_S = 1.0
MIN_FOLLOWED = 150  # fewest steps to correlate: in fewer, unrelated motions may look alike


@dataclass(frozen=True)
class Finding:
    """A contradiction between a topic and the rest of its recording."""

    kind: str  # clock, sources, wheels, gyro, rates or order
    topic: str
    what: str  # the contradiction in words, with numbers
    steps: int  # number of ticks affected
    cause: str  # likely cause
    remedy: str
    repaired: bool = False  # False: rows contain the values as recorded

    def __str__(self) -> str:
        return f"{self.topic}: {self.what} ({self.steps:,} steps); {self.cause}; {self.remedy}"

    @property
    def reported(self) -> str:
        """Return the finding as one line for the user."""
        return f"{'repaired' if self.repaired else 'contradicts itself'}: {self}"

    def as_row(self) -> dict[str, str | int | bool]:
        """Return the finding as a row of `recordings.findings`."""
        return asdict(self)


@dataclass(frozen=True)
class Drive:
    """The signals of a recording's T steps, divided into W windows for comparisons."""

    signals: Signals
    joined: Bools  # (T,) whether this step and the one before are usable, without a gap or jump
    seconds: F64  # (T,) time since the step before; 0 if not joined
    window: Ints  # (T,) index of the step's window, which lasts WINDOW_S

    @classmethod
    def of(cls, signals: Signals, segment: Ints, problem: Sequence[str], longest_s: float) -> Drive:
        """Divide `signals` into windows; steps further apart than `longest_s` are not joined."""
        stamp = np.asarray(signals["stamp_ns"], np.int64)
        usable = np.array([each == "" for each in problem], np.bool_)
        gap_s = np.diff(stamp, prepend=stamp[:1]) / NS
        joined = usable & np.roll(usable, 1) & (gap_s > 0) & (gap_s <= longest_s)
        joined &= segment == np.roll(segment, 1)
        joined[:1] = False
        begins = np.diff(segment, prepend=-1) != 0
        first = np.maximum.accumulate(np.where(begins, np.arange(len(stamp)), 0))
        stretch = (stamp - stamp[first]) // round(WINDOW_S * NS)
        window = np.cumsum(begins | (np.diff(stretch, prepend=0) != 0)) - 1
        return cls(signals, joined, np.where(joined, gap_s, 0.0), window)

    def sums(self, values: F64) -> F64:
        """Return the sum (W,) of values (T,) over the joined steps of each window."""
        known = np.where(self.joined, np.nan_to_num(values), 0.0)
        return np.asarray(np.bincount(self.window, known), np.float64)

    def driven(self, name: str) -> F64:
        """Return the signed integral (W,) of a speed or yaw rate over each window."""
        speed = np.asarray(self.signals[name], np.float64)
        return self.sums((speed + np.roll(speed, 1)) / 2 * self.seconds)

    def full(self) -> Bools:
        """Return which windows (W,) have joined steps for enough of their time."""
        return np.asarray(self.sums(self.seconds) > STEPS_PER_WINDOW * WINDOW_S)


def findings_of(
    aligned: AlignedInputs, signals: Signals, segment: Ints, problem: Sequence[str]
) -> list[Finding]:
    """Find contradictions in a recording from the signals of its steps (T,)."""
    profile = aligned.profile
    found = clock_findings(aligned.clock, len(problem))
    if not len(problem):
        return found
    period_s = profile.task.control_period_s
    drive = Drive.of(signals, segment, problem, 3 * period_s)
    topics = {name: source.topic for name, source in aligned.inputs.by_name.items()}
    topics.setdefault("pose", profile.frames.topic if profile.frames else "")
    fastest_mps = float(np.abs(signals["command_speed_mps"]).max(initial=0.0))
    noise_mps = 2 * profile.noise.localiser_m / period_s
    found += _frames(aligned.inputs, len(problem))
    jumps = [one for one in found if (one.kind, one.topic) == ("sources", topics["pose"])]
    if not jumps:
        jumps = _jumping_poses(drive, topics["pose"], fastest_mps, noise_mps)
        found += jumps
    if profile.motion is None and not jumps:
        found += _wheels(drive, topics["wheels"], topics["pose"], fastest_mps)
    if "imu" in topics and not jumps:
        turned = _windows_of_turns(drive, "gyro_yaw_rate_radps")
        found += _compared(
            turned, ("gyro", topics["imu"], "its yaw rate", topics["pose"]), len(problem)
        )
    found += _spikes(aligned.inputs, drive)
    return found + _order(drive, topics["command"], topics.get("wheels", topics["pose"]), period_s)


def clock_findings(clock: ClockReport, steps: int) -> list[Finding]:
    """Report if the recorder's clock was set back, and the topics stamped by another clock.

    Alignment has ignored the stamps of these topics.
    """
    found = []
    if clock.set_back:
        what = (
            f"log time goes back {counted(clock.set_back, 'time')} on every topic, which starts a"
            " new episode"
        )
        cause, remedy = "the recorder's clock was set back", "set its clock before a drive"
        found.append(Finding("clock", "all topics", what, steps, cause, remedy, repaired=True))
    for topic, ahead_ns in clock.by_reception.items():
        where = "ahead of" if ahead_ns > 0 else "behind"
        what = (
            f"its stamps are {abs(ahead_ns) / NS:.2f} s {where} the clock of the other topics; its"
            " messages are timed by their reception"
        )
        cause = "the computer that stamps them has another clock"
        remedy = "synchronise the clocks (chrony, PTP)"
        found.append(Finding("clock", topic, what, steps, cause, remedy, repaired=True))
    return found


def _frames(inputs: InputColumns, steps: int) -> list[Finding]:
    """Find topics whose messages name several frames, which shows several publishers."""
    found: dict[str, Finding] = {}
    for name in ("pose", "wheels"):
        counts = Counter(inputs.frames_of(name))
        del counts[""]
        often = [one for one in counts.most_common() if one[1] >= OFTEN * counts.total()]
        if len(often) < 2:
            continue
        topic = inputs.by_name[name].topic
        frames = ", ".join(f"{frame} ({counted(count, 'message')})" for frame, count in often)
        found[topic] = Finding(
            "sources",
            topic,
            f"its messages are in several frames: {frames}",
            steps,
            "two publishers on one topic",
            "record each publisher on a topic of its own",
        )
    return [*found.values()]


def _jumping_poses(drive: Drive, topic: str, fastest_mps: float, noise_mps: float) -> list[Finding]:
    """Find poses that jump: they step faster than commands and wheels explain."""
    signals, joined = drive.signals, drive.joined
    wheels = np.abs(signals["wheel_speed_mps"])[joined]
    most = max(fastest_mps, float(np.percentile(wheels, 99)) if len(wheels) else 0.0)
    limit = BEYOND * most + BEYOND_MPS + noise_mps
    speed = np.abs(signals["localised_speed_mps"])
    beyond = joined & (speed > limit) & ((speed - most) * drive.seconds > JUMP_M)
    count = int(beyond.sum())
    if count < max(MIN_STEPS, OFTEN * joined.sum()):
        return []
    return [
        Finding(
            "sources",
            topic,
            f"its poses step at {np.median(speed[beyond]):.2g} m/s (median), but neither commands"
            f" nor wheels exceed {most:.2g} m/s",
            count,
            "two publishers on one topic, or a localiser that jumps",
            "record each publisher on a topic of its own, or name another pose in [inputs.pose]",
        )
    ]


def _wheels(drive: Drive, topic: str, poses: str, fastest_mps: float) -> list[Finding]:
    """Find wheels whose speed or yaw rate differs from that of the poses."""
    wheels = drive.driven("wheel_speed_mps")
    along = drive.driven("localised_speed_mps")
    path = np.maximum(np.abs(wheels), np.abs(along))
    moved = drive.full() & (path > MOVES * fastest_mps * WINDOW_S)
    steps = len(drive.joined)
    found = _compared((wheels[moved], along[moved]), ("wheels", topic, "its speed", poses), steps)
    if found:
        return found
    turned = _windows_of_turns(drive, "wheel_yaw_rate_radps")
    return _compared(turned, ("wheels", topic, "its yaw rate", poses), steps)


def _windows_of_turns(drive: Drive, name: str) -> tuple[F64, F64]:
    """Return the angles turned by a yaw rate and by the poses, in windows with enough turn."""
    yaw = np.asarray(drive.signals["pose_yaw_rad"], np.float64)
    by_rate, by_pose = drive.driven(name), drive.sums(wrap_angle(yaw - np.roll(yaw, 1)))
    turned = drive.full() & (np.maximum(np.abs(by_rate), np.abs(by_pose)) > TURNS_RAD)
    if not np.isfinite(drive.signals[name]).any():
        turned[:] = False
    return by_rate[turned], by_pose[turned]


def _compared(windows: tuple[F64, F64], of: tuple[str, str, str, str], steps: int) -> list[Finding]:
    """Find a source that is above the poses, or below them, in three of four windows.

    `windows` are the values of source and poses; `of` are the finding's kind and topic, the
    compared quantity, and the poses' topic.
    """
    source, poses = windows
    kind, topic, what, pose_topic = of
    if len(source) < MIN_WINDOWS:
        return []
    ratio = source / np.where(poses == 0, 1e-9, poses)
    low, middle, high = np.percentile(ratio, [25, 50, 75])
    size, cause = f"is {middle:.2g} times", "another unit, scale or frame, or slip throughout"
    if np.percentile(np.abs(ratio), 90) < STILL:
        size, cause = "stays at 0 beside", "it is not measured"
    elif high < 0:
        cause = "another sign, or another frame"
    elif high >= 1 / APART and low <= APART:
        return []
    text = f"{what} {size} that of the poses of {pose_topic}"
    text += f", in {len(ratio)} stretches of {WINDOW_S:g} s"
    remedy = {
        "wheels": "take the speeds from the poses ([motion] instead of [inputs.wheels]), or"
        " correct their publisher",
        "gyro": "leave out [inputs.imu], or correct its publisher",
    }[kind]
    return [Finding(kind, topic, text, steps, cause, remedy)]


def _spikes(inputs: InputColumns, drive: Drive) -> list[Finding]:
    """Find single messages whose speed or yaw rate is far beyond that of commands and poses."""
    yaw = np.asarray(drive.signals["pose_yaw_rad"], np.float64)
    turned = wrap_angle(yaw - np.roll(yaw, 1)) / np.where(drive.joined, drive.seconds, np.inf)
    of_poses = {"speed_mps": drive.signals["localised_speed_mps"], "yaw_rate_radps": turned}
    found = []
    for name, key, signal in (
        ("wheels", "speed_mps", "wheel_speed_mps"),
        ("wheels", "yaw_rate_radps", "wheel_yaw_rate_radps"),
        ("imu", "yaw_rate_radps", "gyro_yaw_rate_radps"),
    ):
        source = inputs.by_name.get(name)
        if source is None or key not in source.fields or not drive.joined.any():
            continue
        moved = np.percentile(np.abs(of_poses[key])[drive.joined], 99)
        most = max(float(np.abs(drive.signals[f"command_{key}"]).max()), float(moved))
        reported = inputs.numbers(name, key)
        limit = SPIKE * most + SPIKE_MARGIN[key]
        beyond = np.abs(reported) > limit
        if not 0 < beyond.sum() <= SPIKES * len(reported):
            continue
        size, unit = float(np.median(np.abs(reported[beyond]))), key.split("_")[-1]
        period_s = float(np.median(np.diff(inputs.topics[source.topic].log_time_ns))) / NS
        wraps = unit == "radps" and abs(size * period_s - 2 * np.pi) < 0.1 * 2 * np.pi
        found.append(
            Finding(
                "rates",
                source.topic,
                f"{int(beyond.sum()):,} of {counted(len(reported), 'message')} report"
                f" {size:.3g} {unit[:-2]}/s (median), but commands and poses stay below"
                f" {most:.2g} {unit[:-2]}/s",
                int((np.abs(drive.signals[signal]) > limit).sum()),
                "the driver differentiates a heading across its wrap at pi"
                if wraps
                else "single values that no other source confirms",
                "correct its publisher, or take the speeds from the poses ([motion])",
            )
        )
    return found


def _order(drive: Drive, command: str, wheels: str, period_s: float) -> list[Finding]:
    """Find motion that is stamped before the command that caused it."""
    for name in ("speed_mps", "yaw_rate_radps"):
        requested, motion = (
            np.asarray(drive.signals[f"{by}_{name}"]) for by in ("command", "wheel")
        )
        by_lag, most = _by_lag(requested, motion, drive.joined, period_s)
        best = int(np.argmax(by_lag))
        lead = most - best  # steps by which the motion is early
        # A lead of one step is no evidence: a command may be sent at the end of its step.
        if lead > 1 and by_lag[best] > max(SURE, max(by_lag[most:]) + LEADS):
            return [
                Finding(
                    "order",
                    wheels,
                    f"its motion comes {lead * period_s:.1f} s before the commands of {command}"
                    f" that it follows (correlation {by_lag[best]:.2f}, {by_lag[most]:.2f} as"
                    " stamped)",
                    len(requested),
                    "one of the two is stamped by another clock",
                    'set [clock] alignment = "log_time" in the profile, and synchronise the clocks',
                )
            ]
    return []


def _by_lag(requested: F64, motion: F64, joined: Bools, period_s: float) -> tuple[list[float], int]:
    """Return `_correlation` at each lag from -n to n steps, and n, which is MAX_LEAD_S in steps."""
    most = max(1, round(MAX_LEAD_S / period_s))
    return [_correlation(requested, motion, joined, lag) for lag in range(-most, most + 1)], most


def _correlation(requested: F64, motion: F64, joined: Bools, lag: int) -> float:
    """Return the correlation of a command (T,) with the motion (T,) `lag` steps later.

    -1 if there are too few steps, or one of the two hardly varies.
    """
    if lag > 0:
        requested, motion, joined = requested[:-lag], motion[lag:], joined[:-lag] & joined[lag:]
    elif lag < 0:
        requested, motion, joined = requested[-lag:], motion[:lag], joined[-lag:] & joined[:lag]
    pair = np.asarray([requested[joined], motion[joined]], np.float64)  # (2, N)
    if pair.shape[1] < MIN_FOLLOWED:
        return -1.0
    pair -= pair.mean(axis=1, keepdims=True)
    (own, shared), (_, other) = (pair @ pair.T).tolist()
    if min(own, other) < 1e-6 * pair.shape[1]:  # standard deviation below 1e-3
        return -1.0
    return float(shared / np.sqrt(own * other))
