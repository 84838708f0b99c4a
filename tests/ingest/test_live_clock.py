"""A running robot's clock: what `align` finds in the whole recording, without its future."""

import sqlite3

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore
from support.paths import SHARED

from restock.arrays import Ints
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.live.observer import LiveClock
from restock.ingest.profile.tables import Clock
from restock.ingest.steps.align import NS, align
from restock.ingest.steps.clocks import STAMP

HUSKY, ODOMETRY = SHARED / "sim-time-husky", "/husky_velocity_controller/odom"
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
        found.append(at - clock.offset_ns(at))
    return np.array(found, np.int64)


def drive(pace: float, seed: int = 0) -> tuple[Ints, Ints, Ints]:
    """30 s of odometry at 20 Hz, some milliseconds late each, and when somebody asks the time."""
    rng = np.random.default_rng(seed)
    stamp = np.arange(0, 30 * NS, NS // 20)
    log = np.sort(10**18 + (stamp / pace).astype(np.int64) + rng.integers(0, 10**7, len(stamp)))
    return log, stamp, np.arange(log[0] + WARM_UP_NS, log[-1], NS // 5)


@pytest.mark.parametrize("pace", [0.3, 0.8, 0.97, 1.1])
def test_a_drifting_clock_is_followed_as_ingest_maps_it(pace: float) -> None:
    log, stamp, requested = drive(pace)
    apart = of_live(log, stamp, requested) - of_ingest(log, stamp, requested)
    # Until the drift has become as much as ingest tolerates, a median is taken.
    assert np.abs(apart).max() < 100_000_000
    assert abs(np.median(apart)) < 10_000_000


def test_a_constant_offset_is_that_of_ingest() -> None:
    log, stamp, _ = drive(1.0)
    log, stamp = log[:200], stamp[:200]  # as many as the median is of
    requested = log[-1:] + 1000
    np.testing.assert_array_equal(of_live(log, stamp, requested), of_ingest(log, stamp, requested))


@pytest.mark.parametrize("pace", [0.8, 1.0])
def test_single_bad_stamps_move_nothing(pace: float) -> None:
    log, stamp, requested = drive(pace)
    bad = stamp.copy()
    bad[100::50] += 700_000_000  # less than a jump
    apart = of_live(log, bad, requested) - of_live(log, stamp, requested)
    assert np.abs(apart).max() < 20_000_000
    clock = LiveClock(NS)
    for one_log, one_stamp in zip(log.tolist(), stamp.tolist(), strict=True):
        assert clock.receive("/odom", one_log, one_stamp)  # however far the clocks drift apart
    before = clock.offset_ns(int(log[-1]))
    assert not clock.receive("/odom", int(log[-1]), int(stamp[-1]) + 2 * NS)
    assert clock.offset_ns(int(log[-1])) == before


def test_the_topic_with_the_least_delay_counts() -> None:
    clock = LiveClock(NS)
    for number in range(400):
        stamp = number * NS // 20
        log = round(stamp / 0.8)
        if number < 100:
            clock.receive("/sooner", log, stamp)
        clock.receive("/late", log + 80_000_000, stamp)
    late = log + 80_000_000 - clock.offset_ns(log + 80_000_000)
    assert abs(late - stamp) < 5_000_000


@pytest.mark.skipif(not HUSKY.is_dir(), reason="../shared/bags is not there")
def test_a_slow_simulation_of_strangers_is_followed() -> None:
    types = get_typestore(Stores.ROS2_HUMBLE)
    (file,) = HUSKY.glob("*.db3")
    with sqlite3.connect(f"file:{file}?immutable=1", uri=True) as connection:
        rows = connection.execute(
            "SELECT m.timestamp, m.data FROM messages m JOIN topics t ON t.id = m.topic_id"
            " WHERE t.name = ? ORDER BY m.timestamp, m.id",
            [ODOMETRY],
        ).fetchall()
    log = np.array([at for at, _ in rows], np.int64)
    read = [types.deserialize_cdr(data, "nav_msgs/msg/Odometry").header.stamp for _, data in rows]
    stamp = np.array([s.sec * NS + s.nanosec for s in read], np.int64)
    requested = np.arange(log[0] + WARM_UP_NS, log[-1], NS // 5)
    apart = np.abs(of_live(log, stamp, requested) - of_ingest(log, stamp, requested))
    assert np.percentile(apart, 95) < 100_000_000  # half a control period, which ingest tolerates
    assert apart.max() < 200_000_000
