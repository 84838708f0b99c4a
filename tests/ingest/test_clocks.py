"""Clock comparison, and log time mapped at another pace so that rows pair simultaneous messages."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.bag_samples import write_mcap
from support.driven_robot import LATENCY_NS, SPEED_MPS, START_NS, Drive, write_bag
from support.ingested import ingested

from restock.errors import RecordingError
from restock.ingest.decoding.columns import TopicColumns, join
from restock.ingest.profile.profile import load_profile
from restock.ingest.profile.tables import Clock
from restock.ingest.steps.align import NS, align
from restock.ingest.steps.clocks import STAMP, ClockMap, topic_clock
from restock.ingest.steps.episodes import steps_of


def topic(stamps: list[int], logs: list[int] | None = None) -> TopicColumns:
    stamp = np.array(stamps, np.int64)
    log = stamp + 5 if logs is None else np.array(logs, np.int64)
    return TopicColumns(log, log - 2, {STAMP: stamp})


def test_set_clock_is_a_jump_and_single_bad_stamp_is_not():
    logs = [NS * n for n in range(1, 41)]
    stamps = [log - (0 if log <= 20 * NS else 30 * NS) for log in logs]
    assert topic_clock("/t", topic(stamps, logs)).jumps == 1
    single_bad = [*logs[:10], logs[10] - 30 * NS, *logs[11:]]
    assert topic_clock("/t", topic(single_bad, logs)).jumps == 0


@given(st.lists(st.integers(0, 20), min_size=1, max_size=30), st.integers(-(10**18), 10**18))
def test_clock_counts_match_plain_python(stamps, offset):
    logs = [stamp + offset for stamp in stamps]
    found = topic_clock("/t", topic(stamps, logs))
    assert found.backsteps == sum(b < a for a, b in itertools.pairwise(stamps))
    reported = [stamp for stamp in stamps if stamp]
    assert found.duplicates == len(reported) - len(set(reported))
    assert found.zero_stamps == len(stamps) - len(reported)


class FaultyOdometryDrive(Drive):
    """Drive whose odometry repeats a stamp, steps back once and reports zero once."""

    def topics(self) -> dict[str, TopicColumns]:
        found = super().topics()
        stamp = found["/odom"].fields[STAMP]
        stamp[10] = stamp[9]
        stamp[20] = stamp[19] - 1
        stamp[30] = 0
        return found


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_bag(FaultyOdometryDrive(), tmp_path_factory.mktemp("clocks") / "bag")


def test_clock_faults_are_stored_and_printed(bag, tmp_path, shell):
    store = tmp_path / "store"
    # the message with the zero stamp is lost
    shown = shell.out("ingest", bag, "--store", store, code=3)
    line = " ".join(shown[shown.index(" /odom ") :].split())  # long cells wrap
    # The stamps step back at 19 -> 20 and 29 -> 30. The zero stamp is off the clock, so it is
    # dropped.
    assert "2 backsteps, 1 repeated stamp, 1 zero stamp, 1 left out" in line
    assert "0.002" in line[: line.index("backsteps")]
    query = "SELECT unnest(clocks, recursive := true) FROM recordings"
    rows = {row["topic"]: row for row in shell.json("sql", store, query)}
    odom = rows["/odom"]
    assert (odom["messages"], odom["offset_ns"], odom["stamped"]) == (300, 2_000_000, True)
    assert (odom["backsteps"], odom["duplicates"], odom["zero_stamps"]) == (2, 1, 1)
    assert (odom["off_clock"], odom["restamped"], odom["log_backsteps"]) == (1, 0, 0)
    assert rows["/cmd_vel"]["stamped"] is False
    assert rows["/cmd_vel"]["offset_ns"] is None


def test_messages_logged_out_of_order_are_counted(tmp_path, shell):
    # Its messages step back in log time once; see bag_samples.
    (recording,) = shell.json("info", write_mcap(tmp_path / "a.mcap"), "--clocks")["recordings"]
    assert recording["topics"]["/odom"]["clock"]["log_backsteps"] == 1


DAY = 1_700_000_000 * NS


def test_clock_map_of_a_pause_and_of_constant_offset() -> None:
    # the simulation was paused for ten seconds
    log = DAY + np.array([0, 1, 2, 12, 13], np.int64) * NS
    stamp = np.array([0, 1, 2, 2, 3], np.int64) * NS
    fitted = ClockMap.through(log, stamp)
    assert fitted.stamped(DAY + np.array([7 * NS, 12 * NS + NS // 2])).tolist() == [
        2 * NS,
        NS * 5 // 2,
    ]
    fixed = ClockMap.constant(DAY)
    assert fixed.is_constant
    assert fixed.stamped(log).tolist() == (log - DAY).tolist()


@given(st.lists(st.tuples(st.integers(0, 10**12), st.integers(0, 10**12)), min_size=1, max_size=40))
def test_clock_map_is_monotonic_and_meets_newest_stamps(pairs: list[tuple[int, int]]) -> None:
    log, stamp = (np.array(column, np.int64) + DAY for column in zip(*pairs, strict=True))
    fitted = ClockMap.through(log, stamp)
    at = np.sort(
        np.concatenate([log, log + 1, np.linspace(log.min(), log.max(), 50).astype(np.int64)])
    )
    assert (np.diff(fitted.stamped(at)) >= 0).all()
    for log_ns in np.unique(log):
        newest = stamp[log <= log_ns].max()
        assert fitted.stamped(np.array([log_ns]))[0] == newest


PACES = [0.5, 0.97, 1.0]


def play_at_pace(
    topics: dict[str, TopicColumns], pace: float, pause: tuple[float, float] | None = None
):
    """Return messages received at `pace` of log time; `pause` is (stamp, log time) in s."""

    def received(times: np.ndarray) -> np.ndarray:
        since = times - START_NS
        late = np.rint(since / pace).astype(np.int64)
        if pause is not None:
            late = late + np.where(since >= round(pause[0] * NS), round(pause[1] * NS), 0)
        return START_NS + late

    return {
        name: TopicColumns(received(c.log_time_ns), received(c.publish_time_ns), c.fields)
        for name, c in topics.items()
    }


def turning_drive(duration_s: float = 30.0) -> dict[str, TopicColumns]:
    """Return a drive whose speed command encodes the x at which it was given, hence its time."""
    topics = Drive(duration_s, goals=[(0.0, 40.0, 1.0)]).topics()
    command = topics["/cmd_vel"]
    given_s = (command.log_time_ns - START_NS) * 1e-9
    command.fields["linear.x"] = 1.0 + SPEED_MPS * given_s
    return topics


@pytest.mark.parametrize("pace", PACES)
def test_command_and_state_of_row_are_within_one_hold(pace: float) -> None:
    profile = load_profile("warehouse_amr")
    whole = steps_of(profile, turning_drive())
    steps = steps_of(profile, play_at_pace(turning_drive(), pace))
    assert len(steps) >= len(whole) - 2
    apart_s = np.abs(steps.signals["command_speed_mps"] - steps.signals["pose_x_m"]) / SPEED_MPS
    assert apart_s.max() <= 0.1 + 0.02  # a pose every 0.1 s, odometry (the reference) every 0.02 s
    assert not steps.clock.off_clock
    if pace != 1.0:
        assert steps.clock.pace == pytest.approx(pace, abs=1e-3)
    else:
        assert steps.clock.pace is None


def reception_s(stamp_ns: np.ndarray, pace: float) -> np.ndarray:
    """Return reception times of these stamps in s from the start, with the drive's latency."""
    return ((stamp_ns - START_NS) + LATENCY_NS) * 1e-9 / pace


def test_set_clock_keeps_log_times_of_both_segments() -> None:
    topics = turning_drive()
    for columns in topics.values():
        late = columns.log_time_ns >= START_NS + 15 * NS
        if "header.stamp" in columns.fields:
            columns.fields["header.stamp"] = columns.fields["header.stamp"] + late * 3600 * NS
    steps = steps_of(load_profile("warehouse_amr"), topics)
    assert steps.clock.jumps == 1
    assert np.diff(steps.logged_ns).max() < NS
    assert np.ptp(steps.logged_ns) * 1e-9 == pytest.approx(29.8, abs=0.5)


class SlowSimulationDrive(Drive):
    """Drive in a simulation at 0.3 of real time."""

    def topics(self) -> dict[str, TopicColumns]:
        return play_at_pace(super().topics(), 0.3)


def test_log_time_of_rows_in_sql(tmp_path: Path) -> None:
    bag = write_bag(SlowSimulationDrive(12.0), tmp_path / "bag")
    query = "SELECT stamp_ns, logged_ns, epoch_ns(logged_time) AS at_ns FROM transitions"
    with ingested(bag, "warehouse_amr", tmp_path / "s") as opened:
        rows = opened.sql(query).fetchnumpy()
    assert np.ptp(rows["logged_ns"]) * 1e-9 > 30
    seen_s = (rows["logged_ns"] - START_NS) * 1e-9
    assert seen_s == pytest.approx(reception_s(rows["stamp_ns"], 0.3), abs=0.02)
    assert np.abs(rows["logged_ns"] - rows["at_ns"]).max() < 1000


@pytest.mark.parametrize("pace", PACES)
def test_pause_loses_no_row_and_keeps_pairs(pace: float) -> None:
    profile = load_profile("warehouse_amr")
    steps = steps_of(profile, play_at_pace(turning_drive(), pace, pause=(12.0, 0.6)))
    apart_s = np.abs(steps.signals["command_speed_mps"] - steps.signals["pose_x_m"]) / SPEED_MPS
    assert len(steps) >= 148
    assert apart_s.max() <= 0.12


def test_simulation_reset_starts_segment_with_own_map() -> None:
    profile = load_profile("warehouse_amr")
    first = play_at_pace(turning_drive(20.0), 0.5)
    second = play_at_pace(turning_drive(20.0), 0.9)
    end = max(int(c.log_time_ns[-1]) for c in first.values()) + NS - START_NS
    topics = {
        name: TopicColumns(
            np.concatenate([c.log_time_ns, second[name].log_time_ns + end]),
            np.concatenate([c.publish_time_ns, second[name].publish_time_ns + end]),
            {path: join([column, second[name].fields[path]]) for path, column in c.fields.items()},
        )
        for name, c in first.items()
    }
    steps = steps_of(profile, topics)
    assert steps.clock.jumps == 1
    assert set(steps.segment.tolist()) == {0, 1}
    apart_s = np.abs(steps.signals["command_speed_mps"] - steps.signals["pose_x_m"]) / SPEED_MPS
    assert apart_s.max() <= 0.12
    assert len(steps) >= 195


def test_recorded_clock_topic_maps_log_time() -> None:
    stamp = np.arange(0, 20 * NS, NS // 2, dtype=np.int64)  # a stamped topic at 2 Hz
    time = np.arange(0, 20 * NS, NS // 50, dtype=np.int64)  # /clock at 50 Hz
    pace = np.where(time < 10 * NS, 2.0, 1.25)  # half speed, then four fifths
    log = START_NS + np.concatenate([[0], np.cumsum(np.diff(time) * pace[:-1])]).astype(np.int64)
    topics = {
        "/odom": TopicColumns(log[::25], log[::25], {"header.stamp": stamp}),
        "/cmd": TopicColumns(log[7::10], log[7::10], {}),
    }
    clock = {"/clock": TopicColumns(log, log, {"clock": time})}
    (segment,), report = align(topics | clock, Clock())
    assert report.mapped_by == "/clock"
    assert np.abs(segment.topics["/cmd"].stamp_ns - time[7::10]).max() <= 1
    assert "/clock" not in segment.topics


def test_unmappable_log_time_is_rejected_with_remedy() -> None:
    rng = np.random.default_rng(0)
    stamp = np.arange(0, 60 * NS, NS // 2, dtype=np.int64)
    log = START_NS + np.sort(stamp * 3 // 2 + rng.integers(0, 600_000_000, len(stamp)))
    topics = {
        "/odom": TopicColumns(log, log, {"header.stamp": stamp}),
        "/cmd": TopicColumns(log, log, {}),
    }
    with pytest.raises(
        RecordingError, match=r"/odom gives the time of a message only within 0\.\d+ s"
    ) as e:
        align(topics, Clock())
    assert e.value.remedy == 'set [clock] alignment = "log_time" in the profile'
    del topics["/cmd"]  # every remaining topic is stamped, so no map is needed
    assert len(align(topics, Clock())[0][0].topics["/odom"].row) == 120
