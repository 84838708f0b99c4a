"""Alignment of topics on one clock: causal holds, maximum ages and clock jumps."""

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.driven_robot import START_NS, Drive, columns, typed_topics, write_topics

from restock.cli import main
from restock.errors import RecordingError
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import load_profile
from restock.ingest.profile.tables import Clock
from restock.ingest.steps.align import NS, Samples, align, ticks_of
from restock.ingest.steps.clocks import STAMP

stamps = st.lists(st.integers(0, 10_000), max_size=30).map(sorted)


@given(stamps, stamps, st.one_of(st.none(), st.integers(0, 3000)))
def test_hold_takes_latest_sample_at_or_before_tick(samples, ticks, max_age_ns):
    held = Samples(np.array(samples, np.int64), np.arange(len(samples))).hold(
        np.array(ticks, np.int64), None if max_age_ns is None else max_age_ns / NS
    )
    for index, tick in enumerate(ticks):
        before = [row for row, stamp in enumerate(samples) if stamp <= tick]
        assert held.known[index] == bool(before)
        if before:
            assert held.row[index] == before[-1]
            assert held.age_ns[index] == tick - samples[before[-1]]
            in_time = max_age_ns is None or held.age_ns[index] <= max_age_ns
            assert held.fresh[index] == in_time


def test_headerless_topics_are_mapped_to_header_clock():
    sim_offset = 1_701_217_691_789_000_000
    time = np.arange(0, 5, 0.1)
    stamp = np.rint(time * 1e9).astype(np.int64)
    scan = TopicColumns(stamp + sim_offset, stamp + sim_offset, {"header.stamp": stamp})
    late = 30_000_000  # a topic that is always 30 ms late must not set the offset
    pose = TopicColumns(stamp + sim_offset + late, stamp, {"header.stamp": stamp})
    command = TopicColumns(stamp + sim_offset + 7, stamp, {})
    segments, report = align({"/scan": scan, "/pose": pose, "/cmd": command}, Clock())
    assert len(segments) == 1
    assert report.offset_ns == sim_offset
    assert np.array_equal(segments[0].topics["/cmd"].stamp_ns, stamp + 7)
    assert np.array_equal(segments[0].topics["/pose"].stamp_ns, stamp)


def test_unordered_log_times_are_sorted():
    stamp = np.array([10, 30, 20, 20], np.int64)
    topic = TopicColumns(stamp, stamp, {})
    segments, _ = align({"/t": topic}, Clock(alignment="log_time"))
    samples = segments[0].topics["/t"]
    assert samples.stamp_ns.tolist() == [10, 20, 20, 30]
    assert samples.hold(np.array([25]), None).row.tolist() == [3]


def test_holds_do_not_cross_backward_clock_jumps():
    log = START_NS + np.arange(100, dtype=np.int64) * NS // 10
    stamp = np.concatenate([np.arange(50), np.arange(50)]).astype(np.int64) * NS // 10
    odom = TopicColumns(log, log, {"header.stamp": stamp})
    slow = TopicColumns(log[::20] + 5, log[::20], {"header.stamp": stamp[::20]})
    goal = TopicColumns(log[:1], log[:1], {"header.stamp": stamp[:1]})
    topics = {"/odom": odom, "/slow": slow, "/goal": goal}
    segments, report = align(topics, Clock(), frozenset({"/goal"}))
    assert report.jumps == 1
    assert [len(s.topics["/odom"].row) for s in segments] == [50, 50]
    first_tick = segments[1].topics["/odom"].stamp_ns[:1]
    assert first_tick.tolist() == [0]
    # the earlier segment's sample is not held
    assert not segments[1].topics["/slow"].hold(first_tick, None).known[0]
    assert segments[1].topics["/goal"].hold(first_tick, None).known[0]  # latched, so still held
    # Headerless topics use the clock offset of their own segment.
    assert segments[1].clock_map.offset_ns - segments[0].clock_map.offset_ns == 5 * NS


def test_single_bad_stamp_is_dropped_and_is_not_a_jump():
    time = np.arange(0, 5, 0.1)
    topic = columns(time, {})
    topic.fields["header.stamp"][20] = 0
    segments, report = align({"/odom": topic}, Clock())
    assert (len(segments), report.jumps, report.off_clock) == (1, 0, {"/odom": 1})
    assert 20 not in segments[0].topics["/odom"].row


def test_old_latched_messages_get_their_log_time():
    odom, goal = columns(np.arange(0, 5, 0.1), {}), columns(np.array([0.0]), {})
    goal.fields["header.stamp"][0] -= 600 * NS
    segments, report = align({"/odom": odom, "/goal": goal}, Clock(), frozenset({"/goal"}))
    assert report.restamped == {"/goal": 1}
    assert segments[0].topics["/goal"].stamp_ns.tolist() == [START_NS]


def test_recording_without_headers_suggests_log_time():
    time = np.array([1, 2], np.int64)
    with pytest.raises(RecordingError, match='alignment = "log_time"'):
        align({"/cmd": TopicColumns(time, time, {})}, Clock())


def test_fixed_rate_ticks_start_at_first_command():
    command = Samples(np.array([5, 6], np.int64) * NS, np.arange(2))
    ticks, between = ticks_of(command, Clock(steps="rate"), 0.5, 7 * NS)
    assert (ticks / NS).tolist() == [5, 5.5, 6, 6.5, 7]
    assert between == 0


def test_command_ticks_keep_minimum_interval():
    command = Samples(np.array([0, 10, 151, 200, 310], np.int64) * 10**6, np.arange(5))
    ticks, between = ticks_of(command, Clock(steps="command"), 0.2, 0)
    assert (ticks // 10**6).tolist() == [0, 151, 310]
    assert between == 2


# -- faulty log times ------------------------------------------------------------------------------


def with_log_times(drive: Drive, log_time_ns: Callable[[int, int], int]) -> dict[str, Any]:
    """Return the drive's typed topics with log times `log_time_ns(time, index in the topic)`."""
    typed = {}
    for name, (kind, topic) in typed_topics(drive).items():
        times = enumerate(topic.log_time_ns.tolist())
        log = np.array([log_time_ns(time, index) for index, time in times], np.int64)
        typed[name] = kind, TopicColumns(log, log, topic.fields)
    return typed


def test_messages_logged_at_zero_are_dropped_and_counted(tmp_path, shell):
    topics = with_log_times(Drive(8.0), lambda time, index: 0 if index % 40 == 1 else time)
    bag = write_topics(topics, tmp_path / "bag", storage="mcap")
    (row,) = shell.json("ingest", bag, "--dry-run", code=3)["recordings"]
    assert row["transitions"] > 25
    assert any(loss.startswith("/odom: left out, as their stamps") for loss in row["losses"])
    assert any("the alignment clock was set" in note for note in row["notes"])
    for steps in ("command", "rate"):
        for alignment in ("header.stamp", "log_time"):
            clock = Clock(alignment=alignment, steps=steps)
            profile = msgspec.structs.replace(load_profile("warehouse_amr"), clock=clock)
            if (steps, alignment) != ("rate", "log_time"):
                assert ingest(bag, profile, store=None).manifest["transitions"] > 25
                continue
            with pytest.raises(RecordingError, match=r"19,676 days, .* some of its times are wro"):
                ingest(bag, profile, store=None)
    out = tmp_path / "new.toml"
    assert main(["profile", "new", str(bag), "--out", str(out)]) in (0, 3)
    assert out.exists()


def test_zero_header_stamps_are_reported_per_topic(tmp_path, shell):
    topics = typed_topics(Drive(4.0))
    for name in ("/odom", "/imu"):
        topics[name][1].fields[STAMP][:] = 0
    bag = write_topics(topics, tmp_path / "bag")
    stderr = shell.err("ingest", bag, "--dry-run")
    for name in ("/odom", "/imu"):
        assert f"200 of 200 messages of {name} were left out: their header stamps do not" in stderr
    assert 'set [clock] alignment = "log_time" in the profile' in stderr
    assert "200 of 200 messages of /imu were left out" in shell.err(
        "profile", "check", "warehouse_amr", bag
    )


@pytest.mark.parametrize("alignment", ["header.stamp", "log_time"])
def test_identical_log_times_are_rejected(alignment, tmp_path, shell):
    topics = with_log_times(Drive(4.0), lambda time, place: 0)
    bag = write_topics(topics, tmp_path / "bag", storage="mcap")
    profile = msgspec.structs.replace(
        load_profile("warehouse_amr"), clock=Clock(alignment=alignment)
    )
    with pytest.raises(RecordingError, match=r"bag: all [\d,]+ messages on /\w+ have the same log"):
        ingest(bag, profile, store=None)
    assert "have the same log time" in shell.err(
        "profile", "new", bag, "--out", tmp_path / "new.toml", code=3
    )
