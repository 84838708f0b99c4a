"""Alignment of all topics to one clock, the ticks of the control clock on it, and causal holds.

A recording may have three clocks: the times when messages were received (`log_time`), sent, and
measured (`header.stamp`). The profile chooses one as the alignment clock. Every sample of every
topic gets a time on it, and a tick never uses a sample from a later time.

On a `header.stamp` clock, a topic without a header gets log time minus the recording's offset. The
offset is the smallest, over the stamped topics, of the median of (log time - stamp). Topics whose
stamps come from another clock do not count for it, and are timed by their reception. These are
commands with another delay (they take effect when they arrive), and topics that, unlike others, are
stamped later than they were received.

The offset is one constant per clock segment, unless it drifts by more than the tolerance, as in a
simulation that runs slower than real time. Then log time is mapped piecewise (`ClockMap`). Offset
and map are measured over the whole segment, so they depend on the clocks of later messages, but
never on their values. If the clock itself jumps (a simulation restarted, a clock was set), a new
segment starts, and only latched topics are held across.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from restock.arrays import Ints
from restock.errors import RecordingError
from restock.ingest.decoding.columns import FieldColumn, TopicColumns
from restock.ingest.steps.clocks import (
    JUMP_S,
    STAMP,
    ClockMap,
    drift_ns,
    jumps,
    median,
    residual_ns,
    spread_ns,
)

if TYPE_CHECKING:
    from restock.ingest.profile.tables import Clock

NS = 1_000_000_000
AHEAD_NS = 50_000_000  # a transform stamped this long after its reception is timed by the latter
CLOCK_TOPIC, CLOCK_FIELD = "/clock", "clock"  # time of a simulation
BY_LOG_TIME = 'set [clock] alignment = "log_time" in the profile'
TOLERANCE_S = 0.1  # default tolerance of times: half a control period of .2 s
IMPOSSIBLE_S = 0.25  # stamps this long after the reception come from another clock
OFTEN = 20  # fewest messages of a topic that must show when the recorder's clock was set back
LATENCY_S = 1.0  # largest latency of a topic that is stamped by the recorder's clock
MAX_TICKS = 20_000_000  # limit per segment at a fixed rate (46 days at 5 Hz), to protect the memory
Rows: TypeAlias = "slice | NDArray[np.intp]"  # rows of a topic's columns; a slice takes no memory


@dataclass(frozen=True)
class Samples:
    """Messages of one topic, sorted by their time on the alignment clock."""

    stamp_ns: Ints  # (N,) ascending
    row: NDArray[np.intp]  # (N,) rows of the topic's columns

    def hold(self, tick_ns: Ints, max_age_s: float | None) -> LatestMessages:
        """Return the latest sample at or before each tick (T,); ticks may be in any order."""
        at = np.searchsorted(self.stamp_ns, tick_ns, "right") - 1
        known = at >= 0
        if not len(self.stamp_ns):
            zeros = np.zeros(len(tick_ns), np.int64)
            return LatestMessages(zeros.astype(np.intp), zeros, known, known)
        at = np.maximum(at, 0)
        age = np.where(known, tick_ns - self.stamp_ns[at], 0)
        fresh = known if max_age_s is None else known & (age <= round(max_age_s * NS))
        return LatestMessages(self.row[at], age, known, fresh)


@dataclass(frozen=True)
class LatestMessages:
    """The latest message of a topic at each of T ticks."""

    row: NDArray[np.intp]  # (T,) row of the topic's columns; 0 if there is no message yet
    age_ns: Ints  # (T,) time from the message to the tick; 0 if there is no message yet
    known: NDArray[np.bool_]  # (T,) whether there is a message
    fresh: NDArray[np.bool_]  # (T,) whether there is one that is not older than the maximum age

    @classmethod
    def join(cls, parts: Sequence[LatestMessages]) -> LatestMessages:
        """Concatenate the latest messages of several clock segments."""
        names = ("row", "age_ns", "known", "fresh")
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


@dataclass(frozen=True)
class ClockSegment:
    """A stretch of a recording in which the alignment clock does not jump."""

    topics: Mapping[str, Samples]
    clock_map: ClockMap  # maps log time to the alignment clock


@dataclass
class ClockReport:
    """Findings about the clocks of a recording, stored beside the recording's counts."""

    alignment: str
    offset_ns: int = 0  # log time minus stamp in the first segment
    spread_ns: int = 0  # 1st to 99th percentile of the errors of the offset, or of the map
    pace: float | None = None  # seconds of robot time per second of log time; None: no drift
    mapped_by: str | None = None  # topic that the map is fitted to; None: constant offset
    jumps: int = 0  # how often the alignment clock jumps, including `set_back`
    off_clock: dict[str, int] = field(default_factory=dict)  # topic -> messages left out
    restamped: dict[str, int] = field(default_factory=dict)  # topic -> messages put at log time
    set_back: int = 0  # how often the recorder's clock was set back
    by_reception: dict[str, int] = field(default_factory=dict)  # topic -> ns its stamps are ahead


def align(
    topics: Mapping[str, TopicColumns],
    clock: Clock,
    latched: frozenset[str] = frozenset(),
    transforms: frozenset[str] = frozenset(),
    commands: frozenset[str] = frozenset(),
    *,
    tolerance_s: float = TOLERANCE_S,
) -> tuple[list[ClockSegment], ClockReport]:
    """Convert every topic's times to the alignment clock, and cut segments where the clock jumps.

    A message whose stamp is more than JUMP_S off its segment's clock is left out and counted. A
    topic that is stamped after its reception is timed by its reception (`report.by_reception`).

    Args:
        topics: in the order of log time; stamped topics have the field `header.stamp`.
        clock: the profile's choice of the alignment clock.
        latched: topics whose messages are put at their log time instead of left out, as they may
            have been published long before the recording began.
        transforms: topics of transforms, and cameras. They do not determine the clock's offset;
            if they are stamped ahead, they are timed by their reception.
        commands: topics that are timed by their reception if their stamps are further than
            `tolerance_s` from the other topics' clock.
        tolerance_s: largest error of the map from log time to stamps.

    Raises:
        RecordingError: the alignment clock is `header.stamp` and no topic has one, all log times
            are equal while stamps advance, or log time cannot be mapped to the stamps within
            `tolerance_s`.
    """
    report = ClockReport(clock.alignment)
    segments: list[ClockSegment] = []
    parts = _split_laps(topics)
    for rows in parts:
        part = {name: _part(one, rows[name]) for name, one in topics.items()} if rows else topics
        for segment in _align(part, clock, latched, transforms, commands, tolerance_s, report):
            samples = {
                name: Samples(one.stamp_ns, rows[name][one.row]) if rows else one
                for name, one in segment.topics.items()
            }
            segments.append(ClockSegment(samples, segment.clock_map))
    report.set_back = len(parts) - 1
    report.jumps += report.set_back
    report.offset_ns = segments[0].clock_map.offset_ns
    _carry_latched(segments, latched)
    return segments, report


def _split_laps(topics: Mapping[str, TopicColumns]) -> list[dict[str, NDArray[np.intp]]]:
    """Split each topic's messages at the points where the recorder's clock was set back.

    At such a point, the log times of all frequent topics go back by about as much, and so repeat
    times of earlier messages. Returns `[{}]` if the clock was never set back.
    """
    laps = {name: one.laps() for name, one in topics.items() if len(one) >= OFTEN}
    if not laps or len(set(laps.values())) > 1 or not max(laps.values()):
        return [{}]
    count = max(laps.values())
    for lap in range(count):
        gone_ns = []
        for name in laps:
            of = topics[name].lap
            before, after = (topics[name].log_time_ns[of == lap + step] for step in (0, 1))
            if not len(before) or not len(after):
                return [{}]
            gone_ns.append(int(before.max() - after.min()))
        if min(gone_ns) <= 0 or max(gone_ns) - min(gone_ns) > round(LATENCY_S * NS):
            return [{}]
    whole = {name: np.zeros(len(one), np.int64) for name, one in topics.items()}
    whole |= {name: one.lap for name, one in topics.items() if one.lap is not None}
    return [
        {name: np.flatnonzero(lap == number) for name, lap in whole.items()}
        for number in range(count + 1)
    ]


def _part(columns: TopicColumns, rows: NDArray[np.intp]) -> TopicColumns:
    """Return the times of some messages of a topic, without other fields."""
    kept = columns.fields.keys() & {STAMP, CLOCK_FIELD}
    fields: dict[str, FieldColumn] = {n: np.asarray(columns.fields[n])[rows] for n in kept}
    return TopicColumns(columns.log_time_ns[rows], columns.publish_time_ns[rows], fields)


def _align(
    topics: Mapping[str, TopicColumns],
    clock: Clock,
    latched: frozenset[str],
    transforms: frozenset[str],
    commands: frozenset[str],
    tolerance_s: float,
    report: ClockReport,
) -> list[ClockSegment]:
    """Align topics whose log time is never set back."""
    simulated = topics.get(CLOCK_TOPIC)
    if simulated is not None and CLOCK_FIELD in simulated.fields:
        topics = {name: columns for name, columns in topics.items() if name != CLOCK_TOPIC}
    else:
        simulated = None
    every = np.arange(max(map(len, topics.values()), default=0))  # shared row numbers
    if clock.alignment == "log_time":
        samples = {name: _sort(c.log_time_ns, every[: len(c)]) for name, c in topics.items()}
        return [ClockSegment(samples, ClockMap.constant(0))]
    stamped = stamped_topics(topics, latched | transforms)
    if not stamped:
        raise RecordingError(
            "none of the profile's topics has a header stamp (other than zero)", remedy=BY_LOG_TIME
        )
    stamped = {name: one for name, one in stamped.items() if name not in commands} or stamped
    for name, ahead_ns in _stamped_ahead(stamped).items():
        report.by_reception[name] = ahead_ns
        del stamped[name]
    reference = max(stamped, key=lambda name: (len(stamped[name]), name))
    if np.ptp(np.asarray(stamped[reference].fields[STAMP], np.int64)) > JUMP_S * NS:
        refuse_still_log_time(reference, stamped[reference])
    edges = _edges(stamped[reference], round(JUMP_S * NS))
    report.jumps += len(edges)
    drifts = _Drifts(round(tolerance_s * NS), simulated, report)
    segments = []
    for index in range(len(edges) + 1):
        inside = {name: _rows_in(edges, index, columns) for name, columns in topics.items()}
        clock_map, middle = drifts.map_of(topics, stamped, reference, inside, edges, index)
        drifts.place_commands(topics, commands - stamped.keys(), inside, clock_map)
        segments.append(
            _segment(topics, inside, every, clock_map, middle, latched, transforms, report)
        )
    if report.mapped_by is None:
        report.spread_ns = max(report.spread_ns, spread_ns(delay_ns(topics[reference])))
    return segments


def clock_drifts(topics: Mapping[str, TopicColumns], tolerance_s: float) -> bool:
    """Return whether stamps drift from log time, by the stamped topic with the most messages."""
    stamped = stamped_topics(topics, frozenset())
    reference = max(stamped.values(), key=len, default=None)
    if reference is None:
        return False
    return drift_ns(reference.log_time_ns, delay_ns(reference)) > round(tolerance_s * NS)


def stamped_topics(
    topics: Mapping[str, TopicColumns], besides: frozenset[str]
) -> dict[str, TopicColumns]:
    """Return the topics with header stamps, except those in `besides`.

    Topics whose stamps are all zero do not count: their drivers do not fill the stamps in.
    """
    return {
        name: columns
        for name, columns in topics.items()
        if STAMP in columns.fields
        and name not in besides
        and np.any(np.asarray(columns.fields[STAMP]))
    }


def _stamped_ahead(stamped: Mapping[str, TopicColumns]) -> dict[str, int]:
    """Return topics that are stamped after their reception, and by how many ns.

    Empty unless another topic is stamped by the recorder's clock: if all topics are ahead, it is
    the recorder's clock that is behind.
    """
    medians = {name: median(delay_ns(columns)) for name, columns in stamped.items()}
    limit = round(IMPOSSIBLE_S * NS)
    if not any(-limit < each < LATENCY_S * NS for each in medians.values()):
        return {}
    return {name: -each for name, each in medians.items() if each <= -limit}


def delay_ns(columns: TopicColumns, rows: Rows = slice(None)) -> Ints:
    """Return (log time - header stamp) of messages of a stamped topic, (N,).

    Delays are computed where needed: to keep them would take half the memory of all times.
    """
    return columns.log_time_ns[rows] - np.asarray(columns.fields[STAMP], np.int64)[rows]


def ticks_of(command: Samples, clock: Clock, period_s: float, end_ns: int) -> tuple[Ints, int]:
    """Return a segment's control ticks (T,), and the number of commands that have no tick.

    `steps = "command"`: one tick per command, except commands closer than 3/4 of the period to the
    last tick. `steps = "rate"`: one tick per period, from the first command to `end_ns`.

    Raises:
        RecordingError: a fixed rate gives more than MAX_TICKS, due to a wrong time.
    """
    stamps = command.stamp_ns
    if not len(stamps):
        return np.zeros(0, np.int64), 0
    period_ns = round(period_s * NS)
    if clock.steps == "rate":
        if (span_ns := end_ns - int(stamps[0])) > MAX_TICKS * period_ns:
            raise RecordingError(
                f"from its first command ({int(stamps[0]) / NS:.0f} s since 1970) to its last "
                f"message ({end_ns / NS:.0f} s) are {span_ns / 86_400 / NS:,.0f} days, so a tick "
                f"every {period_s:g} s would be {span_ns // period_ns:,} steps: some of its times "
                "are wrong",
                remedy="write the file again with the right log times, or set [clock] steps = "
                '"command" in the profile',
            )
        return np.arange(stamps[0], max(end_ns, int(stamps[0])) + 1, period_ns), 0
    kept, last = [], None
    for stamp in stamps.tolist():
        if last is None or stamp - last >= 0.75 * period_ns:
            kept.append(stamp)
            last = stamp
    return np.array(kept, np.int64), len(stamps) - len(kept)


def refuse_still_log_time(topic: str, columns: TopicColumns) -> None:
    """Raise RecordingError if a topic has several messages that all have the same log time."""
    log = columns.log_time_ns
    if len(log) > 1 and log.max() == log.min():
        raise RecordingError(
            f"all {len(log):,} messages on {topic} have the same log time "
            f"({int(log[0]) / NS:g} s since 1970), so it is unknown when they were received",
            remedy="record it again, or write the file again with the times at which its "
            "messages were received",
        )


def _edges(columns: TopicColumns, jump_ns: int) -> Ints:
    """Return the log times (K,), ascending, at which a topic's clock jumps and segments begin.

    Each segment contains a message of the topic. Messages with the same log time share a segment.
    """
    edges = np.unique(jumps(columns.log_time_ns, delay_ns(columns), jump_ns))
    return np.asarray(edges[edges > columns.log_time_ns.min()], np.int64)


def _rows_in(edges: Ints, index: int, columns: TopicColumns) -> Rows:
    """Return the rows of a topic's messages that were received in segment `index`."""
    if not len(edges):
        return slice(0, len(columns))
    return np.flatnonzero(np.searchsorted(edges, columns.log_time_ns, "right") == index)


def _sort(stamp_ns: Ints, row: NDArray[np.intp]) -> Samples:
    """Return samples in stamp order; if the input is in that order, they share its memory."""
    if (stamp_ns[1:] < stamp_ns[:-1]).any():
        order = np.argsort(stamp_ns, kind="stable")  # among equal stamps, the last received wins
        stamp_ns, row = stamp_ns[order], row[order]
    return Samples(stamp_ns, row)


@dataclass
class _Drifts:
    """The choice, per segment, between a constant offset and a piecewise map of log time."""

    tolerance_ns: int
    simulated: TopicColumns | None  # `/clock`, if it was read
    report: ClockReport

    def map_of(
        self,
        topics: Mapping[str, TopicColumns],
        stamped: Mapping[str, TopicColumns],
        reference: str,
        inside: Mapping[str, Rows],
        edges: Ints,
        index: int,
    ) -> tuple[ClockMap, int]:
        """Return the map of one segment, and the reference topic's median delay in it."""
        jump_ns, rows = round(JUMP_S * NS), inside[reference]
        log = stamped[reference].log_time_ns[rows]
        delay = delay_ns(stamped[reference], rows)
        middle = median(delay)
        if drift_ns(log, delay) <= self.tolerance_ns:
            medians = [middle]
            for name in stamped.keys() - {reference}:
                if len(delay := delay_ns(stamped[name], inside[name])):
                    medians.append(median(delay))
            # A delay is the clocks' offset plus latency, so the least delay is nearest the offset.
            offset = min(each for each in medians if abs(each - middle) <= jump_ns)
            return ClockMap.constant(offset), middle
        source, knots = reference, (log, delay)
        if self.simulated is not None:
            times = self.simulated.log_time_ns
            behind = times - np.asarray(self.simulated.fields[CLOCK_FIELD], np.int64)
            during = np.searchsorted(edges, times, "right") == index
            if during.sum() > 1:
                by_clock = ClockMap.of_delays(times[during], behind[during])
                if abs(median(by_clock.stamped(log) - (log - delay))) <= jump_ns:
                    source, knots = CLOCK_TOPIC, (times[during], behind[during])
        fitted = ClockMap.of_delays(*knots)
        spread = spread_ns(residual_ns(knots[0], knots[0] - knots[1]))
        unstamped = any(
            STAMP not in columns.fields and len(columns.log_time_ns[inside[name]])
            for name, columns in topics.items()
        )
        if unstamped and spread > self.tolerance_ns:
            raise RecordingError(
                f"log time and header stamps drift apart, and {source} gives the time of a "
                f"message only within {spread / NS:.2f} s (1st to 99th percentile), more than"
                f" the {self.tolerance_ns / NS:g} s of half a control period",
                remedy=BY_LOG_TIME,
            )
        ahead = []  # how far each topic's stamps are ahead of the map; most with least latency
        for name, columns in stamped.items():
            log = columns.log_time_ns[inside[name]]
            if len(log):
                delay = delay_ns(columns, inside[name])
                ahead.append(median(log - delay - fitted.stamped(log)))
        shift = max((each for each in ahead if abs(each) <= jump_ns), default=0)
        report = self.report
        report.mapped_by = source
        report.spread_ns = max(report.spread_ns, spread)
        report.pace = fitted.pace if report.pace is None else report.pace
        return fitted.ahead_by(max(shift, 0)), middle

    def place_commands(
        self,
        topics: Mapping[str, TopicColumns],
        commands: frozenset[str],
        inside: Mapping[str, Rows],
        clock_map: ClockMap,
    ) -> None:
        """Add to `report.by_reception` the commands that are stamped by another clock."""
        for name in commands & topics.keys():
            if name in self.report.by_reception or STAMP not in topics[name].fields:
                continue
            log = topics[name].log_time_ns[inside[name]]
            stamp = np.asarray(topics[name].fields[STAMP], np.int64)[inside[name]]
            if not stamp.any():
                continue
            ahead = -median(clock_map.stamped(log) - stamp)
            if self.tolerance_ns < abs(ahead) <= round(JUMP_S * NS):
                self.report.by_reception[name] = ahead


def _segment(
    topics: Mapping[str, TopicColumns],
    inside: Mapping[str, Rows],
    every: NDArray[np.intp],
    clock_map: ClockMap,
    middle: int,
    latched: frozenset[str],
    transforms: frozenset[str],
    report: ClockReport,
) -> ClockSegment:
    jump_ns = round(JUMP_S * NS)
    samples = {}
    for name, rows in inside.items():
        columns, numbers = topics[name], every[rows]
        log_time = columns.log_time_ns[rows]
        if STAMP not in columns.fields or name in report.by_reception:
            samples[name] = _sort(clock_map.stamped(log_time), numbers)
            continue
        stamp = np.asarray(columns.fields[STAMP], np.int64)[rows]
        if name in transforms:
            received = clock_map.stamped(log_time)  # reception, on the alignment clock
            stamp = np.where(stamp - received > AHEAD_NS, received, stamp)
        away = log_time - middle if clock_map.is_constant else clock_map.stamped(log_time)
        away -= stamp
        off = np.abs(away, out=away) > jump_ns
        del away
        if off.any() and name in latched:
            report.restamped[name] = report.restamped.get(name, 0) + int(off.sum())
            stamp = np.where(off, clock_map.stamped(log_time), stamp)
        elif off.any():
            report.off_clock[name] = report.off_clock.get(name, 0) + int(off.sum())
            stamp, numbers = stamp[~off], numbers[~off]
        samples[name] = _sort(stamp, numbers)
    return ClockSegment(samples, clock_map)


def _carry_latched(segments: list[ClockSegment], latched: frozenset[str]) -> None:
    """Repeat each latched topic's latest message at the start of the next segment."""
    for index in range(1, len(segments)):
        topics = dict(segments[index].topics)
        start = min(int(samples.stamp_ns[0]) for samples in topics.values() if len(samples.row))
        for name in latched & topics.keys():
            before, now = segments[index - 1].topics[name], topics[name]
            if len(before.row):
                stamp = np.concatenate([[start], now.stamp_ns]).astype(np.int64)
                topics[name] = Samples(stamp, np.concatenate([before.row[-1:], now.row]))
        segments[index] = ClockSegment(topics, segments[index].clock_map)
