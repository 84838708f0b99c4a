"""Log time to the robot's own time, where the two are not a constant apart.

A simulation runs at the pace that its computer allows: at 97 % of real time a constant offset is
.9 s wrong after half a minute. What carries both times (`/clock` where it was recorded, else the
stamped topic with most messages) says at which pace; between two of its messages the map is a
line, so a message without a stamp is placed between the stamps that were received around it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from restock.arrays import Ints
from restock.ingest.steps.clocks import smoothed

WINDOW_NS = 1_000_000_000  # in which a topic's least delay is looked at


@dataclass(frozen=True)
class ClockMap:
    """Log time to stamped time: lines between K knots, never going back.

    A single knot is a constant offset.
    """

    log_ns: Ints  # (K,) ascending, no two equal
    stamp_ns: Ints  # (K,) not descending

    @classmethod
    def constant(cls, offset_ns: int) -> ClockMap:
        """Log time is always `offset_ns` ahead of stamped time."""
        return cls(np.array([offset_ns], np.int64), np.zeros(1, np.int64))

    @classmethod
    def of_delays(cls, log_ns: Ints, delay_ns: Ints) -> ClockMap:
        """Through messages (N >= 1,) of these delays (log time - stamp), less single bad stamps."""
        order = np.argsort(log_ns, kind="stable")
        log = log_ns[order]
        return cls.through(log, log - smoothed(delay_ns[order]))

    @classmethod
    def through(cls, log_ns: Ints, stamp_ns: Ints) -> ClockMap:
        """Through messages (N >= 1,) that carry both times, in any order."""
        order = np.argsort(log_ns, kind="stable")
        log, stamp = log_ns[order], np.maximum.accumulate(stamp_ns[order])
        last = np.append(np.diff(log) > 0, True)  # of messages received at once, the newest stamp
        return cls(log[last], stamp[last])

    def stamped(self, log_ns: Ints) -> Ints:
        """Stamped times (N,) of log times (N,); beyond the knots at the map's mean pace."""
        # Differences alone go through float64, which holds a time of day to 256 ns only.
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
        """Log times (N,) of stamped times (N,): the inverse of `stamped`."""
        if self.is_constant or not self.pace:
            return stamp_ns + self.offset_ns
        last = np.append(np.diff(self.stamp_ns) > 0, True)  # stamps that stand still: the latest
        return ClockMap(self.stamp_ns[last], self.log_ns[last]).stamped(stamp_ns)

    def ahead_by(self, shift_ns: int) -> ClockMap:
        """The same map with stamps that much later."""
        return ClockMap(self.log_ns, self.stamp_ns + shift_ns)

    @property
    def pace(self) -> float:
        """Seconds of stamped time in one of log time, on average."""
        log, stamp = (int(times[-1] - times[0]) for times in (self.log_ns, self.stamp_ns))
        return stamp / log if log else 1.0

    @property
    def offset_ns(self) -> int:
        """Log time less stamped time, at the first knot."""
        return int(self.log_ns[0] - self.stamp_ns[0])

    @property
    def is_constant(self) -> bool:
        return len(self.log_ns) == 1


def drift_ns(log_ns: Ints, delay_ns: Ints) -> int:
    """By how much the delays (N,) of a topic drift over a recording, jitter aside.

    Latency only ever adds to the clocks' offset, so each second's least delay shows the offset;
    the drift is from the 5th to the 95th percentile of those.
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
    """How far messages (N,) that carry both times are from a map through their neighbours.

    Each half is put on a map through the other half, so the spread says how well a message
    between two knots is placed. Empty for fewer than 4 messages.
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
    """From the 1st to the 99th percentile; 0 for no values."""
    values = np.asarray(values_ns, np.int64)
    if not len(values):
        return 0
    low, high = np.percentile(values - values[0], [1, 99])
    return int(high - low)


__all__ = ["ClockMap", "drift_ns", "residual_ns", "spread_ns"]
