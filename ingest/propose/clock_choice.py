"""The clock of a proposed profile: which time, which ticks, and how long a command holds.

All of it comes from the recording: the gaps between commands determine how often there is a tick,
how long a command may hold and which gap ends an episode. If header stamps run at another pace than
log time, gaps are measured in the robot's own (stamped) time, provided that messages without a
stamp can be placed in it within half a control period. Otherwise log time is proposed, with the
reason.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from restock.errors import RecordingError
from restock.ingest.containers.recording import Recording
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.profile.tables import Clock
from restock.ingest.steps.align import CLOCK_FIELD, CLOCK_TOPIC, align
from restock.ingest.steps.clocks import STAMP

FASTEST_S, SLOWEST_S = 0.08, 0.5  # limits of the proposed control period
EVENTS_S = 0.2  # the control period if commands are not steady
STEADY_S = (0.08, 0.5)  # if the median gap between commands is in this range, each one is a tick
PAUSE = 5.0  # a gap longer than this multiple of the median gap is a pause in driving
MAX_HOLD_S = 5.0
MAX_OFF_CLOCK = 0.05  # largest share of a topic's messages whose stamps may disagree with the clock


@dataclass(frozen=True)
class Gaps:
    """The times between the commands of a recording, in log time."""

    count: int = 0  # number of commands
    period_s: float | None = None  # the median gap
    driving_s: float = 0.0  # the longest gap that is not a pause
    mean_s: float = 0.0
    hold_s: float | None = None  # how long the robot keeps following a command
    sensor_s: float = 0.0  # time between two messages of pose or of wheels, the rarer of the two

    @classmethod
    def of(cls, columns: TopicColumns) -> Gaps:
        gaps = columns.gaps_s()
        if not len(gaps):
            return cls(len(columns))
        period = float(np.median(gaps))
        driving = gaps[gaps <= PAUSE * max(period, 0.02)]
        mean = float(gaps.mean())
        return cls(len(columns), period, float(driving.max(initial=period)), mean)


@dataclass(frozen=True)
class ClockChoice:
    """The proposed `[clock]`, control period and hold of a command, with the reasons."""

    alignment: str
    steps: str
    period_s: float  # control period, on the alignment clock
    max_gap_s: float
    command_age_s: float
    pace: float = 1.0  # seconds of the alignment clock per second of log time
    every_s: float | None = None  # median gap between commands, on the alignment clock
    comments: tuple[str, ...] = ()

    @classmethod
    def of(cls, gaps: Gaps, alignment: str, pace: float = 1.0) -> ClockChoice:
        """Choose a clock from the gaps between commands; `pace` converts them to alignment time."""
        middle = None if gaps.period_s is None else gaps.period_s * pace
        steady = middle is not None and STEADY_S[0] <= middle <= STEADY_S[1]
        # Commands from key presses or in bursts do not show a control period; streamed ones do.
        streamed = middle is not None and gaps.mean_s * pace <= 2 * middle < 2 * STEADY_S[0]
        usual = (middle if steady or streamed else EVENTS_S) or EVENTS_S
        least = FASTEST_S if steady else max(FASTEST_S, gaps.sensor_s * pace)
        period = drivable(float(np.clip(max(usual, least), FASTEST_S, SLOWEST_S)))
        driving = gaps.driving_s * pace
        return cls(
            alignment,
            "command" if steady else "rate",
            period,
            max(0.5, _up(max(2.5 * period, 1.2 * driving if steady else 0.0))),
            max(
                float(np.clip(_up(max(2.5 * period, 1.2 * driving)), 0.2, MAX_HOLD_S)),
                _up((gaps.hold_s or 0.0) * pace),
            ),
            pace,
            middle,
        )

    def at_a_rate(self) -> ClockChoice:
        """Return this choice with one tick per control period instead of one per command."""
        return replace(self, steps="rate", max_gap_s=max(0.5, _up(2.5 * self.period_s)))


def drivable(period_s: float) -> float:
    """Return the nearest control period that the twin can simulate.

    The twin divides a period into equal parts of at most 0.1 s, each a whole number of hundredths.
    """
    parts = int(np.ceil(round(period_s * 10, 6)))
    # Also try one part fewer: 0.2015 s is nearer to 2 x 0.1 s = 0.2 s than to 3 x 0.07 s = 0.21 s.
    near = {
        count: round(period_s * 100 / count)
        for count in (parts - 1, parts)
        if count and round(period_s * 100 / count) <= 10
    }
    periods = (count * each / 100 for count, each in near.items())
    return min(periods, key=lambda each_s: abs(each_s - period_s))


def _up(seconds: float) -> float:
    """Round up to a tenth of a second."""
    return float(np.ceil(round(seconds * 10, 6)) / 10)


def choose_clock(
    recording: Recording, used: Sequence[str], latched: frozenset[str], gaps: Gaps, *, stamped: bool
) -> ClockChoice:
    """Choose the clock that works for the topics `used`; `stamped` if sensors carry header stamps.

    `latched` topics may have been published before the recording began.
    """
    if not stamped:
        return ClockChoice.of(gaps, "log_time")
    with_stamp = {name for name in used if STAMP in recording.leaves(name)}
    clock = recording.topics.get(CLOCK_TOPIC)
    wanted = {name: [STAMP] if name in with_stamp else [] for name in used}
    if clock is not None and clock.skipped is None and CLOCK_FIELD in recording.leaves(CLOCK_TOPIC):
        wanted[CLOCK_TOPIC] = [CLOCK_FIELD]
    choice, why_not = _by_stamp(recording.read(wanted), latched, gaps)
    if why_not:
        return by_log_time(gaps, why_not)
    if choice.pace == 1.0:
        return choice
    why = f"Header stamps run at {choice.pace:.2%} of log time: all times are the robot's own."
    return replace(choice, comments=(why,))


def by_log_time(gaps: Gaps, why: str) -> ClockChoice:
    """Choose log time because header stamps do not work."""
    why = f"Log time, as header stamps do not work: {why}."
    return replace(ClockChoice.of(gaps, "log_time"), comments=(why,))


def _by_stamp(
    columns: dict[str, TopicColumns], latched: frozenset[str], gaps: Gaps
) -> tuple[ClockChoice, str]:
    """Choose a clock by header stamps; also return why the stamps do not work, or ""."""
    choice = ClockChoice.of(gaps, STAMP)
    for _ in range(3):  # repeated, as the period depends on the pace, and the pace on the period
        try:
            _, report = align(columns, Clock(), latched, tolerance_s=choice.period_s / 2)
        except RecordingError as error:
            return choice, error.what
        pace = 1.0 if report.pace is None else report.pace
        if pace <= 0:
            return choice, f"they run at {pace:.1%} of log time"
        before, choice = choice, ClockChoice.of(gaps, STAMP, pace)
        if before.period_s == choice.period_s:
            break
    lost = [
        f"{count:,} of {len(columns[topic]):,} of {topic} are off the clock"
        for topic, count in report.off_clock.items()
        if count > MAX_OFF_CLOCK * len(columns[topic])
    ]
    return choice, ", ".join(lost)
