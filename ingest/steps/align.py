"""One clock for all topics, the ticks of the control clock on it, and causal holds.

Three clocks may be in a recording: when a message was received (`log_time`), sent, and measured
(`header.stamp`). The profile names one, the alignment clock; every sample of every topic is put
on it, and nothing is ever taken from a time after the tick that asks.

A topic without a header is put on a `header.stamp` clock by subtracting the recording's offset:
the smallest, over the stamped topics, of the median of (log time - stamp). That offset is one
constant a clock segment. It is measured over the whole segment, so it looks at later messages'
clocks, but at nobody's values.

Where the clock itself jumps (a simulation restarted, a clock set) a new segment starts, and no
hold reaches across but that of latched topics.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from restock.errors import RecordingError
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.steps.clocks import STAMP, jumps, median

if TYPE_CHECKING:
    from restock.ingest.profile.profile import Clock

I64 = NDArray[np.int64]
NS = 1_000_000_000
AHEAD_NS = 50_000_000  # a transform stamped further ahead counts from when it was received


@dataclass(frozen=True)
class Samples:
    """One topic's messages on the alignment clock, in its order."""

    stamp_ns: I64  # (N,) ascending
    row: NDArray[np.intp]  # (N,) of the topic's columns

    def hold(self, tick_ns: I64, max_age_s: float | None) -> LatestMessages:
        """At each tick (T,) ascending or not, the latest sample at or before it."""
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
    """The latest message of a topic, at each of T ticks."""

    row: NDArray[np.intp]  # (T,) of the topic's columns; 0 where nothing is known
    age_ns: I64  # (T,)
    known: NDArray[np.bool_]  # (T,) something had been received
    fresh: NDArray[np.bool_]  # (T,) and not longer ago than its maximum age

    @classmethod
    def join(cls, parts: Sequence[LatestMessages]) -> LatestMessages:
        """Those of several clock segments, one after the other."""
        names = ("row", "age_ns", "known", "fresh")
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


@dataclass(frozen=True)
class ClockSegment:
    """A stretch of a recording in which the alignment clock does not jump."""

    topics: Mapping[str, Samples]
    offset_ns: int  # log time - alignment clock


@dataclass
class ClockReport:
    """What was seen of the clocks; kept with the recording's counts."""

    alignment: str
    offset_ns: int = 0  # of the first segment
    spread_ns: int = 0  # 1st to 99th percentile of (log time - stamp), of the reference topic
    jumps: int = 0
    off_clock: dict[str, int] = field(default_factory=dict)  # messages left out, per topic
    restamped: dict[str, int] = field(default_factory=dict)  # latched ones put at their log time


def align(
    topics: Mapping[str, TopicColumns],
    clock: Clock,
    latched: frozenset[str] = frozenset(),
    transforms: frozenset[str] = frozenset(),
) -> tuple[list[ClockSegment], ClockReport]:
    """Every topic on the alignment clock, cut where that clock jumps.

    `topics` are in the order of their log time; stamped ones hold the field `header.stamp`.
    A message whose stamp is more than `clock.jump_s` from where its segment's clock has it is
    left out and counted, but one of a `latched` topic (it may have been published long before
    the recording began) is put at its log time instead. `transforms` may be stamped ahead: they
    do not say what time it is, and count from when they were received.

    Raises:
        RecordingError: the alignment clock is `header.stamp` and no topic has one.
    """
    report = ClockReport(clock.alignment)
    if clock.alignment == "log_time":
        samples = {name: _ordered(c.log_time_ns, np.arange(len(c))) for name, c in topics.items()}
        return [ClockSegment(samples, 0)], report
    delay = {
        name: columns.log_time_ns - np.asarray(columns.fields[STAMP], np.int64)
        for name, columns in topics.items()
        if STAMP in columns.fields and name not in latched | transforms and len(columns)
    }
    if not delay:
        raise RecordingError(
            "none of the profile's topics has a header stamp",
            remedy='set [clock] alignment = "log_time" in the profile',
        )
    jump_ns = round(clock.jump_s * NS)
    reference = max(delay, key=lambda name: (len(delay[name]), name))
    edges = jumps(topics[reference].log_time_ns, delay[reference], jump_ns)
    report.jumps = len(edges)

    def segment(index: int) -> ClockSegment:
        inside = {
            name: np.flatnonzero(np.searchsorted(edges, columns.log_time_ns, "right") == index)
            for name, columns in topics.items()
        }
        middle = median(delay[reference][inside[reference]])
        medians = [median(delay[name][inside[name]]) for name in delay if len(inside[name])]
        # Latency only ever adds to the clocks' offset, so the least delayed topic shows it best.
        offset = min(median for median in medians if abs(median - middle) <= jump_ns)
        samples = {}
        for name, rows in inside.items():
            columns = topics[name]
            log_time = columns.log_time_ns[rows]
            if STAMP not in columns.fields:
                samples[name] = _ordered(log_time - offset, rows)
                continue
            stamp = np.asarray(columns.fields[STAMP], np.int64)[rows]
            if name in transforms:
                ahead = stamp - (log_time - offset) > AHEAD_NS
                stamp = np.where(ahead, log_time - offset, stamp)
            off = np.abs(log_time - stamp - middle) > jump_ns
            if off.any() and name in latched:
                report.restamped[name] = report.restamped.get(name, 0) + int(off.sum())
                stamp = np.where(off, log_time - offset, stamp)
            elif off.any():
                report.off_clock[name] = report.off_clock.get(name, 0) + int(off.sum())
                stamp, rows = stamp[~off], rows[~off]
            samples[name] = _ordered(stamp, rows)
        return ClockSegment(samples, offset)

    segments = [segment(index) for index in range(len(edges) + 1)]
    report.offset_ns = segments[0].offset_ns
    low, high = np.percentile(delay[reference] - median(delay[reference]), [1, 99])
    report.spread_ns = int(high - low)
    _carry_latched(segments, latched)
    return segments, report


def ticks_of(command: Samples, clock: Clock, period_s: float, end_ns: int) -> tuple[I64, int]:
    """The ticks (T,) of the control clock in a segment, and how many commands got none.

    `steps = "command"`: one tick a command, but none closer than 3/4 of the period to the last.
    `steps = "rate"`: every period, from the first command to `end_ns`.
    """
    stamps = command.stamp_ns
    if not len(stamps):
        return np.zeros(0, np.int64), 0
    period_ns = round(period_s * NS)
    if clock.steps == "rate":
        return np.arange(stamps[0], max(end_ns, int(stamps[0])) + 1, period_ns), 0
    kept, last = [], None
    for stamp in stamps.tolist():
        if last is None or stamp - last >= 0.75 * period_ns:
            kept.append(stamp)
            last = stamp
    return np.array(kept, np.int64), len(stamps) - len(kept)


def _ordered(stamp_ns: I64, row: NDArray[np.intp]) -> Samples:
    order = np.argsort(stamp_ns, kind="stable")  # of equal stamps the last received wins
    return Samples(np.asarray(stamp_ns, np.int64)[order], row[order])


def _carry_latched(segments: list[ClockSegment], latched: frozenset[str]) -> None:
    """The latest message of a latched topic still holds at the start of the next segment."""
    for index in range(1, len(segments)):
        topics = dict(segments[index].topics)
        start = min(int(samples.stamp_ns[0]) for samples in topics.values() if len(samples.row))
        for name in latched & topics.keys():
            before, now = segments[index - 1].topics[name], topics[name]
            if len(before.row):
                stamp = np.concatenate([[start], now.stamp_ns]).astype(np.int64)
                topics[name] = Samples(stamp, np.concatenate([before.row[-1:], now.row]))
        segments[index] = ClockSegment(topics, segments[index].offset_ns)
