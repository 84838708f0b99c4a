"""The robot's clock against log time, from the messages that have come: what `align` works out of
a whole recording, with nothing of the future.

Where the two are a constant apart the offset is a median, as in a recording. Where they drift, as
while a simulation runs slower than real time, it is a line through the delays of the last seconds,
drawn on to the moment that asks.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from restock.ingest.steps.align import NS, TOLERANCE_S
from restock.ingest.steps.clocks import WINDOW_NS, median

_DELAYS = 200  # of each topic, of which the median counts
_MINUTES = 10  # over which drift is looked for
_PACE_NS = 4_000_000_000  # of the messages that say how fast the offset grows
_LEVEL_NS = 300_000_000  # … and of those that say where it is
_MOMENT_NS = 100_000_000
_FEWEST = 4  # messages that either takes at least


class LiveClock:
    """Takes the times of stamped messages as they come, in order of log time.

    A message whose stamp is more than `jump_ns` from where the clock has it is off the clock.
    """

    def __init__(self, jump_ns: int) -> None:
        self._jump_ns = jump_ns
        self._topics: dict[str, _Delays] = {}
        self._line: tuple[int, int, float] | None = None  # log time, offset there, its growth
        self._fitted = False  # to every message

    def receive(self, topic: str, log_time_ns: int, stamp_ns: int) -> bool:
        """Whether a message is on the clock; one that is tells the time."""
        if not self.agrees(log_time_ns, stamp_ns):
            return False
        self._topics.setdefault(topic, _Delays()).add(log_time_ns, log_time_ns - stamp_ns)
        self._fitted = False
        return True

    def agrees(self, log_time_ns: int, stamp_ns: int) -> bool:
        """Whether a stamp is near the clock; any is, before the first message.

        For that the clock of a moment ago will do: a fit to every message takes longer.
        """
        if not self._topics:
            return True
        line = self._line
        if line is None or abs(log_time_ns - line[0]) > _MOMENT_NS:
            line = self._fit()
        return abs(log_time_ns - stamp_ns - _at(line, log_time_ns)) <= self._jump_ns

    def offset_ns(self, log_time_ns: int) -> int:
        """Log time less the robot's time at this log time: of the topic that comes with the least
        delay. 0 before the first message."""
        if not self._topics:
            return 0
        line = self._line if self._fitted else None
        return _at(line or self._fit(), log_time_ns)

    @property
    def drifts(self) -> bool:
        """Whether the clocks drifted apart by more than `align` tolerates."""
        return self._reference.drift_ns > round(TOLERANCE_S * NS)

    @property
    def _reference(self) -> _Delays:
        """Of the topic with most messages."""
        return max(self._topics.values(), key=lambda delays: delays.count)

    def _fit(self) -> tuple[int, int, float]:
        """Draw the line through the messages so far."""
        topics, growth = self._topics.values(), 0.0
        now_ns = max(delays.newest_ns for delays in topics)
        if self.drifts:
            growth = self._reference.growth()
            heard = [delays for delays in topics if now_ns - delays.newest_ns <= _PACE_NS]
            offset_ns = min(delays.at_ns(now_ns, growth) for delays in heard)
        else:
            offset_ns = min(delays.median_ns for delays in topics)
        self._line, self._fitted = (now_ns, offset_ns, growth), True
        return self._line


def _at(line: tuple[int, int, float], log_time_ns: int) -> int:
    at_ns, offset_ns, growth = line
    return offset_ns + round(growth * (log_time_ns - at_ns))


class _Delays:
    """Log time less stamp of one topic's last messages."""

    def __init__(self) -> None:
        self.count = 0
        self._log_ns: deque[int] = deque(maxlen=_DELAYS)
        self._delay_ns: deque[int] = deque(maxlen=_DELAYS)
        # Latency only ever adds to the offset: each second's least delay shows how that drifts.
        self._least_ns: deque[int] = deque(maxlen=60 * _MINUTES)
        self._second = -1
        self.drift_ns = 0

    def add(self, log_time_ns: int, delay_ns: int) -> None:
        self.count += 1
        self._log_ns.append(log_time_ns)
        self._delay_ns.append(delay_ns)
        # The median of the last three: a single bad stamp is none of it.
        lately = median(np.array(list(self._delay_ns)[-3:], np.int64))
        second = log_time_ns // WINDOW_NS
        if second == self._second:
            self._least_ns[-1] = min(self._least_ns[-1], lately)
            return
        self._second = second
        if len(self._least_ns) > 1:
            values = np.array(self._least_ns, np.int64)
            low, high = np.percentile(values - values[0], [5, 95])
            self.drift_ns = int(high - low)
        self._least_ns.append(lately)

    @property
    def newest_ns(self) -> int:
        return self._log_ns[-1]

    @property
    def median_ns(self) -> int:
        return median(np.array(self._delay_ns, np.int64))

    def growth(self) -> float:
        """Seconds that the delay grows by in one: between the halves of the last messages."""
        log, delay = self._recent(_PACE_NS)
        half = len(log) // 2
        if not half:
            return 0.0
        apart = np.median(log[half:]) - np.median(log[:half])
        grown = np.median(delay[half:]) - np.median(delay[:half])
        return float(grown / apart) if apart > 0 else 0.0

    def at_ns(self, log_time_ns: int, growth: float) -> int:
        """The delay at a log time, by the last messages."""
        log, delay = self._recent(_LEVEL_NS)
        ahead = float(np.median(delay - growth * log)) + growth * (log_time_ns - self.newest_ns)
        return self._delay_ns[-1] + round(ahead)

    def _recent(self, length_ns: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Times and delays of the last messages, less those of the newest: floats hold them."""
        log, delay = (np.array(times, np.int64) for times in (self._log_ns, self._delay_ns))
        first = min(int(np.searchsorted(log, log[-1] - length_ns)), max(len(log) - _FEWEST, 0))
        log, delay = log[first:] - log[-1], delay[first:] - delay[-1]
        return log.astype(np.float64), delay.astype(np.float64)
