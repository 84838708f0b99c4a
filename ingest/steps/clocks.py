"""The clocks of a recording's topics compared: log time against header stamps, and their faults.

A recorder stamps a message when it receives it (log time), its sender may say when it sent it
(publish time) and the message when it was measured (`header.stamp`). They can be different
clocks: a constant apart (simulation time), zero, jumping, going back, repeating.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from restock.arrays import Ints
from restock.ingest.decoding.columns import TopicColumns
from restock.words import counted

STAMP = "header.stamp"
WIDE_NS = 100_000_000  # a spread of (log time - stamp) that is worth a look


@dataclass(frozen=True)
class TopicClock:
    """What was seen of one topic's clocks. None: its messages carry no header stamp."""

    topic: str
    messages: int
    publish_offset_ns: int | None  # log time - publish time, median; None without a message
    offset_ns: int | None = None  # log time - header stamp, median, of stamps that are not zero
    spread_ns: int | None = None  # … 1st to 99th percentile
    jumps: int | None = None  # times that this difference changes by more than `jump_s`
    backsteps: int | None = None  # stamps before that of the message received just before
    duplicates: int | None = None  # messages whose stamp another one has, too
    zero_stamps: int | None = None

    def as_row(self) -> dict[str, str | int | bool | None]:
        """Plain values, as `recordings.clocks` holds them (less what aligning found)."""
        return {**asdict(self), "stamped": self.offset_ns is not None}


def topic_clock(topic: str, columns: TopicColumns, jump_s: float) -> TopicClock:
    """Compare one topic's clocks. Messages are in the order of their log time."""
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
        len(jumps(log, delay, round(jump_s * 1e9))),
        backsteps,
        duplicates,
        count - len(stamp),
    )


def odd(row: Mapping[str, Any]) -> str:
    """What of a topic's clocks is worth a look, in words; "" for nothing."""
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


_BLOCK = 1 << 16  # windows sorted at a time: bounds memory


def topic_clocks(topics: Mapping[str, TopicColumns], jump_s: float) -> list[TopicClock]:
    """Every topic's clocks compared."""
    return [topic_clock(name, columns, jump_s) for name, columns in topics.items()]


def median(delay_ns: Ints) -> int:
    """The (upper) median; in integers, for float64 holds a time of day to 256 ns only."""
    middle = len(delay_ns) // 2
    return int(np.partition(delay_ns, middle)[middle])


def smoothed(delay_ns: Ints) -> Ints:
    """The running median of five delays (N,): single bad stamps are gone."""
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
    """The log times at which a topic's clock jumps, single bad stamps aside."""
    change_ns = np.diff(delay_ns)
    if not (np.abs(change_ns, out=change_ns) > jump_ns).any():
        return np.zeros(0, np.int64)  # medians of neighbours differ by no more than neighbours do
    at = np.flatnonzero(np.abs(np.diff(smoothed(delay_ns))) > jump_ns) + 1
    return np.asarray(log_time_ns[at], np.int64)
