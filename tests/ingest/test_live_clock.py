"""A running robot's clock: what `align` finds in the whole recording, without its future."""

import numpy as np

from restock.arrays import Ints
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.live.observer import LiveClock
from restock.ingest.profile.tables import Clock
from restock.ingest.steps.align import NS, align
from restock.ingest.steps.clocks import STAMP

WARM_UP_NS = 3 * NS


def of_ingest(log_ns: Ints, stamp_ns: Ints, asked_ns: Ints) -> Ints:
    """Where ingest puts messages without a stamp that are received at these log times."""
    topics = {
        "/odom": TopicColumns(log_ns, log_ns, {STAMP: stamp_ns}),
        "/command": TopicColumns(asked_ns, asked_ns, {}),
    }
    (segment,), _ = align(topics, Clock())
    return segment.topics["/command"].stamp_ns


def of_live(log_ns: Ints, stamp_ns: Ints, asked_ns: Ints) -> Ints:
    """Where the live clock puts them, when it has what came before."""
    clock, next_message, found = LiveClock(NS), 0, []
    for at in asked_ns.tolist():
        while next_message < len(log_ns) and log_ns[next_message] <= at:
            clock.receive("/odom", int(log_ns[next_message]), int(stamp_ns[next_message]))
            next_message += 1
        found.append(at - clock.offset_ns)
    return np.array(found, np.int64)


def drive() -> tuple[Ints, Ints, Ints]:
    """30 s of odometry at 20 Hz, some milliseconds late each, and when somebody asks the time."""
    rng = np.random.default_rng(0)
    stamp = np.arange(0, 30 * NS, NS // 20)
    log = np.sort(10**18 + stamp + rng.integers(0, 10**7, len(stamp)))
    return log, stamp, np.arange(log[0] + WARM_UP_NS, log[-1], NS // 5)


def test_a_constant_offset_is_that_of_ingest() -> None:
    log, stamp, requested = drive()
    apart = of_live(log, stamp, requested) - of_ingest(log, stamp, requested)
    assert np.abs(apart).max() < 2_000_000  # a median of the last messages, and of all
    log, stamp = log[:200], stamp[:200]  # as many as the median is of
    requested = log[-1:] + 1000
    np.testing.assert_array_equal(of_live(log, stamp, requested), of_ingest(log, stamp, requested))


def test_single_bad_stamps_move_nothing() -> None:
    log, stamp, requested = drive()
    bad = stamp.copy()
    bad[100::50] += 700_000_000  # less than a jump
    apart = of_live(log, bad, requested) - of_live(log, stamp, requested)
    assert np.abs(apart).max() < 20_000_000
    clock = LiveClock(NS)
    for one_log, one_stamp in zip(log.tolist(), stamp.tolist(), strict=True):
        assert clock.receive("/odom", one_log, one_stamp)
    before = clock.offset_ns
    assert not clock.receive("/odom", int(log[-1]), int(stamp[-1]) + 2 * NS)
    assert clock.offset_ns == before


def test_the_topic_with_the_least_delay_counts() -> None:
    clock = LiveClock(NS)
    for number in range(400):
        stamp = number * NS // 20
        clock.receive("/sooner", 10**18 + stamp, stamp)
        clock.receive("/late", 10**18 + stamp + 80_000_000, stamp)
    assert clock.offset_ns == 10**18
