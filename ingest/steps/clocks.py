"""The clocks of a recording: log times and header stamps compared, their faults, and a map.

A message may have three times: when the recorder received it (log time), when its sender sent it
(publish time) and when it was measured (`header.stamp`). They may come from different clocks, and
a clock can have a constant offset (simulation time), be zero, jump, go back, repeat, or run at
another pace. A simulation runs at the pace that its computer allows: at 97 % of real time, a
constant offset is .9 s wrong after half a minute. A topic with both times gives the pace: `/clock`
if it was recorded, else the stamped topic with most messages. Between two of its messages the map
is a line, so a message without a stamp is placed between the stamps that were received around it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from restock.arrays import Ints
from restock.errors import counted
from restock.ingest.decoding.columns import TopicColumns

JUMP_S = 1.0  # a change of (log time - stamp) by more means that a clock was set
STAMP = "header.stamp"
WIDE_NS = 100_000_000  # spread of (log time - stamp) from which `odd` reports it


@dataclass(frozen=True)
class TopicClock:
    """Comparison of one topic's clocks; values are None if messages have no header stamp."""

    topic: str
    messages: int
    publish_offset_ns: int | None  # log time - publish time, median; None without a message
    offset_ns: int | None = None  # log time - header stamp, median over nonzero stamps
    spread_ns: int | None = None  # log time - header stamp, 1st to 99th percentile
    jumps: int | None = None  # how often log time - header stamp changes by more than JUMP_S
    backsteps: int | None = None  # number of stamps below that of the message received before
    duplicates: int | None = None  # messages that repeat the stamp of another message
    zero_stamps: int | None = None

    def as_row(self) -> dict[str, str | int | bool | None]:
        """Return a row of `recordings.clocks`, without the counts that alignment adds."""
        return {**asdict(self), "stamped": self.offset_ns is not None}


def topic_clock(topic: str, columns: TopicColumns) -> TopicClock:
    """Compare one topic's clocks; `columns` must be in the order of log time."""
    log, publish = columns.log_time_ns, columns.publish_time_ns
    count = len(log)
    sent = median(log - publish) if count else None
    stamps = columns.fields.get(STAMP)
    if not isinstance(stamps, np.ndarray) or not count:
        return TopicClock(topic, count, sent)
    stamp = np.asarray(stamps, np.int64)
    backsteps = int((stamp[1:] < stamp[:-1]).sum())
    stamped = stamp != 0
    if not stamped.all():
        log, stamp = log[stamped], stamp[stamped]
    ascending = np.sort(stamp) if backsteps else stamp
    duplicates = int((ascending[1:] == ascending[:-1]).sum())
    del ascending
    delay = log - stamp
    middle = median(delay) if len(delay) else 0
    low, high = np.percentile(delay - middle, [1, 99]) if len(delay) else (0, 0)
    return TopicClock(
        topic,
        count,
        sent,
        middle,
        int(high - low),
        len(jumps(log, delay, round(JUMP_S * 1e9))),
        backsteps,
        duplicates,
        count - len(stamp),
    )


def odd(row: Mapping[str, Any]) -> str:
    """Describe what is unusual in a row of `recordings.clocks`; "" if nothing is."""
    words = {
        "jumps": "jump",
        "log_backsteps": "log time backstep",
        "backsteps": "backstep",
        "duplicates": "repeated stamp",
        "zero_stamps": "zero stamp",
    }
    parts = [counted(row[key], word) for key, word in words.items() if row.get(key)]
    others = {"off_clock": "left out", "restamped": "put at log time"}
    parts += [f"{row[key]:,} {word}" for key, word in others.items() if row.get(key)]
    if (row["spread_ns"] or 0) > WIDE_NS:
        parts.append(f"spread over {row['spread_ns'] * 1e-9:.1f} s")
    return ", ".join(parts)


_BLOCK = 1 << 16  # number of windows sorted at a time, to limit memory


def topic_clocks(topics: Mapping[str, TopicColumns]) -> list[TopicClock]:
    """Compare every topic's clocks."""
    return [topic_clock(name, columns) for name, columns in topics.items()]


def median(delay_ns: Ints) -> int:
    """Return the (upper) median in integers, as float64 rounds epoch times to 256 ns."""
    middle = len(delay_ns) // 2
    return int(np.partition(delay_ns, middle)[middle])


def smoothed(delay_ns: Ints) -> Ints:
    """Return the running median of five delays, (N,), which removes single bad stamps."""
    if len(delay_ns) < 5:
        return delay_ns
    smooth = delay_ns.copy()
    for start in range(0, len(delay_ns), _BLOCK):
        stop = min(start + _BLOCK, len(delay_ns))
        around = delay_ns[max(start - 2, 0) : stop + 2]
        edges = (max(2 - start, 0), max(stop + 2 - len(delay_ns), 0))
        windows = np.lib.stride_tricks.sliding_window_view(np.pad(around, edges, mode="edge"), 5)
        smooth[start:stop] = np.sort(windows, axis=1)[:, 2]
    return smooth


def jumps(log_time_ns: Ints, delay_ns: Ints, jump_ns: int) -> Ints:
    """Return the log times at which a topic's clock jumps, ignoring single bad stamps."""
    change_ns = np.diff(delay_ns)
    if not (np.abs(change_ns, out=change_ns) > jump_ns).any():
        return np.zeros(0, np.int64)  # no jump: smoothing adds no larger change
    at = np.flatnonzero(np.abs(np.diff(smoothed(delay_ns))) > jump_ns) + 1
    return np.asarray(log_time_ns[at], np.int64)


WINDOW_NS = 1_000_000_000  # window over which `drift_ns` takes the least delay


@dataclass(frozen=True)
class ClockMap:
    """Map from log time to stamped time: piecewise linear between K knots, never decreasing.

    A single knot is a constant offset.
    """

    log_ns: Ints  # (K,) strictly ascending
    stamp_ns: Ints  # (K,) not descending

    @classmethod
    def constant(cls, offset_ns: int) -> ClockMap:
        """Build the map with log time always `offset_ns` ahead of stamped time."""
        return cls(np.array([offset_ns], np.int64), np.zeros(1, np.int64))

    @classmethod
    def of_delays(cls, log_ns: Ints, delay_ns: Ints) -> ClockMap:
        """Fit the map through messages (N >= 1,) with these delays (log time - stamp)."""
        order = np.argsort(log_ns, kind="stable")
        log = log_ns[order]
        return cls.through(log, log - smoothed(delay_ns[order]))

    @classmethod
    def through(cls, log_ns: Ints, stamp_ns: Ints) -> ClockMap:
        """Fit the map through messages (N >= 1,) that carry both times, in any order."""
        order = np.argsort(log_ns, kind="stable")
        log, stamp = log_ns[order], np.maximum.accumulate(stamp_ns[order])
        last = np.append(np.diff(log) > 0, True)  # among messages of one log time, the newest stamp
        return cls(log[last], stamp[last])

    def stamped(self, log_ns: Ints) -> Ints:
        """Convert log times (N,) to stamped times (N,); outside the knots, at the mean pace."""
        # Only differences are converted to float64, which would round epoch times to 256 ns.
        first, last = int(self.log_ns[0]), int(self.log_ns[-1])
        start = int(self.stamp_ns[0])
        if first == last:
            return np.asarray(log_ns - first + start, np.int64)
        at = np.asarray(log_ns - first, np.float64)
        inside = np.interp(at, self.log_ns - first, self.stamp_ns - start)
        outside = np.minimum(at, 0) + np.maximum(at - (last - first), 0)
        inside += outside * self.pace
        return np.rint(inside).astype(np.int64) + start

    def logged(self, stamp_ns: Ints) -> Ints:
        """Convert stamped times (N,) to log times (N,): the inverse of `stamped`."""
        if self.is_constant or not self.pace:
            return stamp_ns + self.offset_ns
        last = np.append(np.diff(self.stamp_ns) > 0, True)  # of equal stamps, the last log time
        return ClockMap(self.stamp_ns[last], self.log_ns[last]).stamped(stamp_ns)

    def ahead_by(self, shift_ns: int) -> ClockMap:
        """Return the map with all stamps later by `shift_ns`."""
        return ClockMap(self.log_ns, self.stamp_ns + shift_ns)

    @property
    def pace(self) -> float:
        """Return the seconds of stamped time per second of log time, on average."""
        log, stamp = (int(times[-1] - times[0]) for times in (self.log_ns, self.stamp_ns))
        return stamp / log if log else 1.0

    @property
    def offset_ns(self) -> int:
        """Return log time minus stamped time at the first knot."""
        return int(self.log_ns[0] - self.stamp_ns[0])

    @property
    def is_constant(self) -> bool:
        return len(self.log_ns) == 1


def drift_ns(log_ns: Ints, delay_ns: Ints) -> int:
    """Return by how much a topic's delays (N,) drift over a recording, without jitter.

    Latency only adds to the clocks' offset, so the least delay in each second estimates the offset.
    The drift is the span from the 5th to the 95th percentile of these estimates.
    """
    if not len(log_ns):
        return 0
    smooth = smoothed(delay_ns)
    window = log_ns - log_ns.min()
    window //= WINDOW_NS
    if (window[1:] < window[:-1]).any():
        order = np.argsort(window, kind="stable")
        window, smooth = window[order], smooth[order]
    begins = np.flatnonzero(window[1:] != window[:-1]) + 1
    least = np.minimum.reduceat(smooth, np.append(0, begins))
    low, high = np.percentile(least - least[0], [5, 95])
    return int(high - low)


def residual_ns(log_ns: Ints, stamp_ns: Ints) -> Ints:
    """Return the errors (N,), in ns, of a clock map at messages that it was not fitted to.

    A map through every other of the N messages is compared with the rest, and the reverse. Empty
    for fewer than 4 messages.
    """
    if len(log_ns) < 4:
        return np.zeros(0, np.int64)
    order = np.argsort(log_ns, kind="stable")
    log, stamp = log_ns[order], stamp_ns[order]
    parts = []
    for start in (0, 1):
        fitted = ClockMap.through(log[start::2], stamp[start::2])
        parts.append(stamp[1 - start :: 2] - fitted.stamped(log[1 - start :: 2]))
    return np.concatenate(parts)


def spread_ns(values_ns: Iterable[int] | Ints) -> int:
    """Return the span from the 1st to the 99th percentile; 0 for no values."""
    values = np.asarray(values_ns, np.int64)
    if not len(values):
        return 0
    low, high = np.percentile(values - values[0], [1, 99])
    return int(high - low)
