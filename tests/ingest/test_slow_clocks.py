"""A robot's clock that runs at another pace than log time: rows pair what belonged together."""

import json
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore
from support.driven_robot import LATENCY_NS, SPEED_MPS, START_NS, Drive, write_bag
from support.paths import SHARED

from restock import cli
from restock.errors import RecordingError
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.profile.profile import load_profile
from restock.ingest.profile.tables import Clock
from restock.ingest.steps.align import NS, align
from restock.ingest.steps.episodes import steps_of
from restock.replay.store.store import Store

PACES = [0.5, 0.97, 1.0]


def at_pace(topics: dict[str, TopicColumns], pace: float, pause: tuple[float, float] | None = None):
    """Return messages received at `pace` of log time; `pause` is (stamped, log time) in s."""

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


def turning(duration_s: float = 30.0) -> dict[str, TopicColumns]:
    """Return a drive whose command is the x at which it was given: each row tells when it was."""
    topics = Drive(duration_s, goals=[(0.0, 40.0, 1.0)]).topics()
    command = topics["/cmd_vel"]
    given_s = (command.log_time_ns - START_NS) * 1e-9
    command.fields["linear.x"] = 1.0 + SPEED_MPS * given_s
    return topics


@pytest.mark.parametrize("pace", PACES)
def test_command_and_state_of_a_row_are_within_one_hold(pace: float) -> None:
    profile = load_profile("warehouse_amr")
    whole = steps_of(profile, turning())
    steps = steps_of(profile, at_pace(turning(), pace))
    assert len(steps) >= len(whole) - 2
    apart_s = np.abs(steps.signals["command_speed_mps"] - steps.signals["pose_x_m"]) / SPEED_MPS
    assert apart_s.max() <= 0.1 + 0.02  # a pose each .1 s, odometry (the reference) each .02 s
    assert not steps.clock.off_clock
    if pace != 1.0:
        assert steps.clock.pace == pytest.approx(pace, abs=1e-3)
    else:
        assert steps.clock.pace is None


def logged_s(stamp_ns: np.ndarray, pace: float) -> np.ndarray:
    """When what is stamped so was received, in seconds from the start, with the drive's latency."""
    return ((stamp_ns - START_NS) + LATENCY_NS) * 1e-9 / pace


@pytest.mark.parametrize("pace", [*PACES, 0.3])
def test_the_log_time_of_a_tick_is_that_of_messages_stamped_then(pace: float) -> None:
    steps = steps_of(load_profile("warehouse_amr"), at_pace(turning(), pace))
    stamp_ns = steps.signals["stamp_ns"]
    seen_s = (steps.logged_ns - START_NS) * 1e-9
    assert seen_s == pytest.approx(logged_s(stamp_ns, pace), abs=0.02)


def test_a_clock_that_was_set_has_the_log_times_of_each_part() -> None:
    topics = turning()
    for columns in topics.values():
        late = columns.log_time_ns >= START_NS + 15 * NS
        if "header.stamp" in columns.fields:
            columns.fields["header.stamp"] = columns.fields["header.stamp"] + late * 3600 * NS
    steps = steps_of(load_profile("warehouse_amr"), topics)
    assert steps.clock.jumps == 1
    assert np.diff(steps.logged_ns).max() < NS
    assert np.ptp(steps.logged_ns) * 1e-9 == pytest.approx(29.8, abs=0.5)


class Slow(Drive):
    """A drive in a simulation at .3 of real time."""

    def topics(self) -> dict[str, TopicColumns]:
        return at_pace(super().topics(), 0.3)


def test_rows_have_their_log_time_in_sql(tmp_path: Path) -> None:
    bag = write_bag(Slow(12.0), tmp_path / "bag")
    store = tmp_path / "s"
    assert cli.main(["ingest", str(bag), "--profile", "warehouse_amr", "--store", str(store)]) == 0
    query = "SELECT stamp_ns, logged_ns, epoch_ns(logged_time) AS at_ns FROM transitions"
    with Store(store) as opened:
        rows = opened.sql(query).fetchnumpy()
    assert np.ptp(rows["logged_ns"]) * 1e-9 > 30
    seen_s = (rows["logged_ns"] - START_NS) * 1e-9
    assert seen_s == pytest.approx(logged_s(rows["stamp_ns"], 0.3), abs=0.02)
    assert np.abs(rows["logged_ns"] - rows["at_ns"]).max() < 1000


@pytest.mark.parametrize("pace", PACES)
def test_a_pause_costs_no_row_and_pairs_nothing_wrongly(pace: float) -> None:
    profile = load_profile("warehouse_amr")
    steps = steps_of(profile, at_pace(turning(), pace, pause=(12.0, 0.6)))
    apart_s = np.abs(steps.signals["command_speed_mps"] - steps.signals["pose_x_m"]) / SPEED_MPS
    assert len(steps) >= 148
    assert apart_s.max() <= 0.12


def test_a_simulation_reset_starts_a_segment_with_its_own_map() -> None:
    profile = load_profile("warehouse_amr")
    first = at_pace(turning(20.0), 0.5)
    second = at_pace(turning(20.0), 0.9)
    end = max(int(c.log_time_ns[-1]) for c in first.values()) + NS - START_NS
    topics = {
        name: TopicColumns(
            np.concatenate([c.log_time_ns, second[name].log_time_ns + end]),
            np.concatenate([c.publish_time_ns, second[name].publish_time_ns + end]),
            {path: _joined(column, second[name].fields[path]) for path, column in c.fields.items()},
        )
        for name, c in first.items()
    }
    steps = steps_of(profile, topics)
    assert steps.clock.jumps == 1
    assert set(steps.segment.tolist()) == {0, 1}
    apart_s = np.abs(steps.signals["command_speed_mps"] - steps.signals["pose_x_m"]) / SPEED_MPS
    assert apart_s.max() <= 0.12
    assert len(steps) >= 195


def _joined(first: Any, second: Any) -> Any:
    from restock.ingest.decoding.columns import join

    return join([first, second])


def test_clock_is_followed_where_it_was_recorded() -> None:
    stamp = np.arange(0, 20 * NS, NS // 2, dtype=np.int64)  # a stamped topic, twice a second
    time = np.arange(0, 20 * NS, NS // 50, dtype=np.int64)  # /clock, fifty times
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


def test_what_cannot_be_mapped_is_refused_with_the_remedy() -> None:
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
    del topics["/cmd"]  # nothing is without a stamp: there is nothing to map
    assert len(align(topics, Clock())[0][0].topics["/odom"].row) == 120


# The three recordings of simulations slower than real time, recomputed: rosbags and plain loops.

PROFILE = """
name = "sim"
conditions = []
behaviour_policy = "unknown"
[task]
goal = "none"
control_period_s = {period}
actions = [[0.0, 0.0], [0.2, 0.0], [0.5, 0.0]]
[task.body]
length_m = 0.6
width_m = 0.5
[clock]
alignment = "header.stamp"
steps = "command"
max_gap_s = 2.0
[inputs.command]
topic = "{command}"
type = "{command_type}"
fields = {command_fields}
max_age_s = 0.5
[inputs.pose]
topic = "{odom}"
type = "nav_msgs/msg/Odometry"
fields.x_m = "pose.pose.position.x"
fields.y_m = "pose.pose.position.y"
fields.orientation = "pose.pose.orientation"
max_age_s = 0.5
[inputs.wheels]
topic = "{odom}"
type = "nav_msgs/msg/Odometry"
fields = {{speed_mps = "twist.twist.linear.x", yaw_rate_radps = "twist.twist.angular.z"}}
max_age_s = 0.5
"""
TWIST = '{speed_mps = "linear.x", yaw_rate_radps = "angular.z"}'
MEASURED = '{speed_mps = "twist.twist.linear.x", yaw_rate_radps = "twist.twist.angular.z"}'


def messages(bag: Path, topic: str) -> list[tuple[int, Any]]:
    """(log time, message) of a topic, by rosbags' types and plain SQLite or mcap."""
    types = get_typestore(Stores.ROS2_HUMBLE)
    if file := next(bag.glob("*.db3"), None):
        with sqlite3.connect(f"file:{file}?immutable=1", uri=True) as connection:
            rows = connection.execute(
                "SELECT m.timestamp, m.data, t.type FROM messages m JOIN topics t"
                " ON t.id = m.topic_id WHERE t.name = ? ORDER BY m.timestamp, m.id",
                [topic],
            ).fetchall()
        return [(at, types.deserialize_cdr(data, kind)) for at, data, kind in rows]
    from mcap.reader import make_reader

    with next(bag.glob("*.mcap")).open("rb") as file:
        return [
            (message.log_time, types.deserialize_cdr(message.data, schema.name))
            for schema, _, message in make_reader(file).iter_messages(topics=[topic])
        ]


def stamp_of(message: Any) -> int:
    return message.header.stamp.sec * NS + message.header.stamp.nanosec


@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/bags is not there")
@pytest.mark.parametrize(
    ("bag", "odom", "command", "period"),
    [
        (
            "sim-time-husky",
            "/husky_velocity_controller/odom",
            "/husky_velocity_controller/cmd_vel_unstamped",
            0.1,
        ),
        ("sim-time-mobrob", "/odom", "/odom", 0.05),
        ("sim-time-robot-kf", "/odom", "/odom", 0.04),
    ],
)
def test_rows_of_slow_simulations_are_those_of_plain_loops(
    bag, odom, command, period, tmp_path, capsys
):
    stamped = command == odom
    profile = tmp_path / "sim.toml"
    profile.write_text(
        PROFILE.format(
            period=period,
            odom=odom,
            command=command,
            command_type="nav_msgs/msg/Odometry" if stamped else "geometry_msgs/msg/Twist",
            command_fields=MEASURED if stamped else TWIST,
        )
    )
    arguments = ["--profile", str(profile), "--store", str(tmp_path / "s"), "--json"]
    code = cli.main(["ingest", str(SHARED / bag), *arguments])
    (report,) = json.loads(capsys.readouterr().out)["recordings"]
    # robot-kf's metadata names its file otherwise: no message is lost by that.
    assert (code, len(report["losses"])) == (0, 0)
    columns = "stamp_ns, pose_x_m, pose_y_m, command_speed_mps"
    query = f"SELECT {columns} FROM transitions ORDER BY stamp_ns"
    assert cli.main(["sql", str(tmp_path / "s"), query, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)

    poses = [(log, stamp_of(m), m) for log, m in messages(SHARED / bag, odom)]
    ticks: list[tuple[int, float]] = []
    for log, message in messages(SHARED / bag, command):
        if stamped:
            at, speed = stamp_of(message), message.twist.twist.linear.x
        else:  # between the stamps of the poses that were received around it
            before = [p for p in poses if p[0] <= log]
            after = [p for p in poses if p[0] > log]
            if not before or not after:
                continue
            (log_a, stamp_a, _), (log_b, stamp_b, _) = before[-1], after[0]
            at = stamp_a + (stamp_b - stamp_a) * (log - log_a) // (log_b - log_a)
            speed = message.linear.x
        if not ticks or at - ticks[-1][0] >= 0.75 * period * NS:
            ticks.append((at, speed))
    assert len(rows) == len(ticks) - 1  # the last tick only ends the episode
    for row, (at, speed) in zip(rows, ticks, strict=False):
        assert abs(row["stamp_ns"] - at) <= (0 if stamped else 50_000_000)  # half a pose apart
        assert row["command_speed_mps"] == pytest.approx(speed, abs=1e-6)
        held = [m for _, stamp, m in poses if stamp <= row["stamp_ns"]][-1]
        assert row["pose_x_m"] == pytest.approx(held.pose.pose.position.x, abs=1e-5)
        assert row["pose_y_m"] == pytest.approx(held.pose.pose.position.y, abs=1e-5)
