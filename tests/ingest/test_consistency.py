"""Recordings whose signals contradict each other: findings are repaired, or kept and reported."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.driven_robot import (
    BEAMS,
    FREE_M,
    START_NS,
    columns,
    pose,
    scans,
    without,
    write_topics,
)
from support.ingested import ingested, proposed, steps_in

from restock.ingest.containers.open_recording import open_recording
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.profile.profile import Profile, parse_profile
from restock.ingest.propose.drives import propose_profile
from restock.ingest.propose.gather import Given
from restock.ingest.steps.consistency import Finding
from restock.ingest.steps.episodes import steps_of

NS = 10**9
DURATION_S = 45.0
TYPES = {
    "/cmd_vel": "geometry_msgs/msg/TwistStamped",
    "/odom": "nav_msgs/msg/Odometry",
    "/imu": "sensor_msgs/msg/Imu",
    "/scan": "sensor_msgs/msg/LaserScan",
}
Topics = dict[str, TopicColumns]


def speeds_at(time_s: Any) -> tuple[Any, Any]:
    """Return speed in m/s and yaw rate in rad/s of a robot that winds through a hall."""
    return 0.35 + 0.2 * np.sin(time_s), 0.7 * np.sin(0.6 * time_s) + 0.1


def poses_at(time_s: Any) -> tuple[Any, Any, Any]:
    """Return x, y and yaw of that robot."""
    fine = np.arange(0, DURATION_S + 1, 0.001)
    speed, rate = speeds_at(fine)
    yaw = np.cumsum(rate) * 0.001
    x, y = (np.cumsum(speed * turn(yaw)) * 0.001 for turn in (np.cos, np.sin))
    return tuple(np.interp(time_s, fine, column) for column in (x, y, yaw))


def winding_drive() -> Topics:
    """Return the topics of that drive, with correct clocks."""
    fast, tenth = np.arange(0, DURATION_S, 0.05), np.arange(0, DURATION_S, 0.1)
    (speed, rate), (requested, turned) = speeds_at(fast), speeds_at(tenth)
    x, y, yaw = poses_at(fast)
    odom = pose("pose.pose", x, 0.0) | {"pose.pose.position.y": y}
    odom |= {"pose.pose.orientation.z": np.sin(yaw / 2), "pose.pose.orientation.w": np.cos(yaw / 2)}
    odom |= {"twist.twist.linear.x": speed, "twist.twist.angular.z": rate}
    imu = {"angular_velocity.z": rate, "linear_acceleration.x": np.gradient(speed, fast)}
    return {
        "/cmd_vel": columns(tenth, {"twist.linear.x": requested, "twist.angular.z": turned}),
        "/odom": columns(fast, odom),
        "/imu": columns(fast, imu),
        "/scan": columns(tenth, scans(np.full((len(tenth), BEAMS), FREE_M)) | _ranges(len(tenth))),
    }


def _ranges(count: int) -> dict[str, Any]:
    return {"range_min": np.full(count, 0.1), "range_max": np.full(count, 10.0)}


def shift_stamps(topics: Topics, name: str, seconds: float) -> Topics:
    """Return the topics with the stamps of one topic shifted ahead."""
    topic = topics[name]
    stamp = np.asarray(topic.fields["header.stamp"]) + round(seconds * NS)
    return {**topics, name: replace(topic, fields={**topic.fields, "header.stamp": stamp})}


def scale_fields(topics: Topics, name: str, factor: float, *paths: str) -> Topics:
    """Return the topics with fields of one topic multiplied."""
    topic = topics[name]
    fields = {path: np.asarray(topic.fields[path]) * factor for path in paths}
    return {**topics, name: replace(topic, fields={**topic.fields, **fields})}


def mix_publishers(topics: Topics) -> Topics:
    """Return the topics with every third odometry message displaced, as from another publisher."""
    topic, third = topics["/odom"], np.arange(len(topics["/odom"])) % 3 == 0
    fields = dict(topic.fields)
    for axis, moved in (("x", 7.0), ("y", 2.0)):
        path = f"pose.pose.position.{axis}"
        fields[path] = np.asarray(fields[path]) + 0.1 * moved * third
    return {**topics, "/odom": replace(topic, fields=fields)}


def mix_frames(topics: Topics) -> Topics:
    """Return the topics with every third odometry message in another frame."""
    topic, third = topics["/odom"], np.arange(len(topics["/odom"])) % 3 == 0
    frames = np.where(third, "map", "odom").astype(object)
    return {
        **topics,
        "/odom": replace(topic, fields={**topic.fields, "header.frame_id": frames}),
    }


def wrap_yaw_rate(topics: Topics) -> Topics:
    """Return the topics with three yaw rates of 125 rad/s, from differences across the wrap."""
    topic = topics["/odom"]
    rate = np.asarray(topic.fields[RATE]).copy()
    rate[[100, 301, 500]] -= 2 * np.pi / 0.05
    return {**topics, "/odom": replace(topic, fields={**topic.fields, RATE: rate})}


def add_slip(topics: Topics) -> Topics:
    """Return the topics with wheels that turn twice as fast for a third of the time."""
    topic = topics["/odom"]
    time_s = (np.asarray(topic.fields["header.stamp"]) - START_NS) / NS
    factor = np.where(time_s % 15 < 5, 2.0, 1.0)
    path = "twist.twist.linear.x"
    return {
        **topics,
        "/odom": replace(
            topic, fields={**topic.fields, path: np.asarray(topic.fields[path]) * factor}
        ),
    }


def write_typed(topics: Topics, folder: Path) -> Path:
    return write_topics({name: (TYPES[name], one) for name, one in topics.items()}, folder)


@pytest.fixture(scope="module")
def profile(tmp_path_factory: pytest.TempPathFactory) -> Profile:
    """Return the profile of the clean drive."""
    bag = write_typed(winding_drive(), tmp_path_factory.mktemp("clean") / "bag")
    with open_recording(bag) as recording:
        return parse_profile(
            propose_profile(recording, "r", Given(hindsight_goals=True)).toml, where="t"
        )


def findings_in(topics: Topics, profile: Profile) -> tuple[list[Finding], Any]:
    """Return the findings, and each step's stamp, pose and command."""
    steps = steps_of(profile, topics)
    names = ("stamp_ns", "pose_x_m", "pose_y_m", "command_speed_mps", "command_yaw_rate_radps")
    return steps.findings, {name: steps.signals[name] for name in names}


@pytest.mark.parametrize("change", [lambda topics: topics, add_slip], ids=["clean", "slip"])
def test_clean_and_slipping_drives_have_no_findings(profile, change):
    assert findings_in(change(winding_drive()), profile)[0] == []


@pytest.mark.parametrize(
    ("topic", "ahead_s"), [("/cmd_vel", 0.4), ("/cmd_vel", -0.7), ("/scan", 0.8)]
)
def test_topic_with_offset_clock_is_repaired(profile, topic, ahead_s):
    topics = shift_stamps(winding_drive(), topic, ahead_s)
    found, steps = findings_in(topics, profile)
    ((kind, name, repaired),) = [(one.kind, one.topic, one.repaired) for one in found]
    assert (kind, name, repaired) == ("clock", topic, True)
    assert f"{abs(ahead_s):.2f} s {'ahead of' if ahead_s > 0 else 'behind'}" in str(found[0])
    # The command of each step is the one in force when its pose was measured.
    time_s = _pose_times(steps)
    requested, turned = speeds_at(np.floor(time_s / 0.1 + 1e-3) * 0.1)
    known = np.abs(steps["command_speed_mps"]) > 0
    assert known.mean() > 0.95
    off = np.abs(steps["command_speed_mps"] - requested) + np.abs(
        steps["command_yaw_rate_radps"] - turned
    )
    assert np.percentile(off[known], 95) < 0.08  # a step of 0.1 s changes them by less


def _pose_times(steps: Any) -> Any:
    """Return the time at which the robot was at each step's pose."""
    fine = np.arange(0, DURATION_S, 0.01)
    x, y, _ = poses_at(fine)
    away = np.hypot(
        steps["pose_x_m"][:, None] - x[None, :], steps["pose_y_m"][:, None] - y[None, :]
    )
    return fine[np.argmin(away, axis=1)]


def test_recorder_clock_offset_gives_no_finding(profile):
    assert findings_in(shift_all_stamps(winding_drive(), 3.0), profile)[0] == []


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
@pytest.mark.parametrize("back_s", [0.6, 10.0])
def test_recorder_clock_set_back_starts_segment(profile, tmp_path, back_s, storage):
    topics, middle = winding_drive(), START_NS + 20 * NS
    before = {n: without(one, one.log_time_ns < middle) for n, one in topics.items()}
    after = {
        name: replace(one, log_time_ns=one.log_time_ns - round(back_s * NS))
        for name, one in shift_all_stamps(topics, -back_s).items()
    }
    after = {name: without(one, topics[name].log_time_ns >= middle) for name, one in after.items()}
    bag = write_topics(
        {name: (TYPES[name], one) for name, one in before.items()},
        tmp_path / "bag",
        after,
        storage=storage,
    )
    with open_recording(bag) as recording:
        proposed = propose_profile(recording, "r", Given(hindsight_goals=True))
    steps = steps_in(bag, profile)
    assert parse_profile(proposed.toml, where="t").task.control_period_s == 0.1
    (found,) = steps.findings
    assert (found.kind, found.topic, found.repaired) == ("clock", "all topics", True)
    assert len(steps) == len(topics["/cmd_vel"])  # all steps are kept
    assert steps.segment.max() == 1
    assert np.abs(steps.signals["localised_speed_mps"]).max() < 0.7


def test_single_topic_out_of_order_starts_no_segment(profile, tmp_path):
    topics, middle = winding_drive(), START_NS + 20 * NS
    late = without(topics["/imu"], topics["/imu"].log_time_ns < middle)
    rest = without(topics["/imu"], topics["/imu"].log_time_ns >= middle)
    typed = {name: (TYPES[name], one) for name, one in (topics | {"/imu": rest}).items()}
    steps = steps_in(write_topics(typed, tmp_path / "bag", {"/imu": late}), profile)
    assert steps.findings == []
    assert steps.segment.max() == 0


def shift_all_stamps(topics: Topics, seconds: float) -> Topics:
    """Return the topics with all stamps shifted ahead."""
    for name in topics:
        topics = shift_stamps(topics, name, seconds)
    return topics


SPEED, RATE = "twist.twist.linear.x", "twist.twist.angular.z"
GYRO = "angular_velocity.z"
CONTRADICTIONS = {
    "two publishers": (mix_publishers, "sources", "/odom", "two publishers"),
    "two frames": (mix_frames, "sources", "/odom", "in several frames: odom ("),
    "no speed": (
        lambda t: scale_fields(t, "/odom", 0, SPEED, RATE),
        "wheels",
        "/odom",
        "stays at 0",
    ),
    "km/h": (lambda t: scale_fields(t, "/odom", 3.6, SPEED), "wheels", "/odom", "is 3.6 times"),
    "sign": (lambda t: scale_fields(t, "/odom", -1, SPEED), "wheels", "/odom", "another sign"),
    "rate": (lambda t: scale_fields(t, "/odom", -1, RATE), "wheels", "/odom", "its yaw rate is -1"),
    "degrees": (lambda t: scale_fields(t, "/imu", 57.3, GYRO), "gyro", "/imu", "57 times"),
    "no gyro": (lambda t: scale_fields(t, "/imu", 0, GYRO), "gyro", "/imu", "stays at 0"),
    "wrapped": (
        wrap_yaw_rate,
        "rates",
        "/odom",
        "3 of 900 messages report 125 rad/s (median), but",
    ),
    "late odometry": (
        lambda t: shift_stamps(t, "/odom", -0.6),
        "order",
        "/odom",
        "before the commands",
    ),
}


@pytest.mark.parametrize("case", CONTRADICTIONS)
def test_contradiction_is_reported_and_kept(profile, case):
    change, kind, topic, message = CONTRADICTIONS[case]
    found, steps = findings_in(change(winding_drive()), profile)
    assert kind in {finding.kind for finding in found}, found
    finding = next(finding for finding in found if finding.kind == kind)
    assert (finding.topic, finding.repaired) == (topic, False)
    assert message in str(finding)
    assert 0 < finding.steps <= len(steps["stamp_ns"])


def test_contradiction_is_printed_stored_and_exits_with_3(tmp_path, shell):
    clean, wrong = (
        write_typed(one, tmp_path / name)
        for name, one in (("clean", winding_drive()), ("wrong", mix_publishers(winding_drive())))
    )
    file, store = tmp_path / "p.toml", tmp_path / "store"
    proposed(clean, file, "--hindsight-goals")
    assert "contradicts itself: /odom: its poses step at" in shell.out(
        "profile", "check", file, wrong, code=3
    )
    ingest = ["ingest", str(clean), str(wrong), "--profile", str(file), "--store", str(store)]
    assert shell.out(*ingest, "--verbose", code=3).count("contradicts itself: /odom") == 1
    query = "SELECT kind, topic, repaired FROM (SELECT unnest(findings, recursive := true)"
    (row,) = shell.json("sql", store, f"{query} FROM recordings)")
    assert row == {"kind": "sources", "topic": "/odom", "repaired": False}
    audits = shell.json("audit", store, code={0, 1, 3})["audits"]
    (audit,) = [each for each in audits if each["audit"] == "contradictions"]
    assert (audit["status"], audit["rows"]) == ("warn", 1)


def test_profile_new_ignores_odometry_without_speed(tmp_path):
    bag = write_typed(scale_fields(winding_drive(), "/odom", 0, SPEED, RATE), tmp_path / "bag")
    made = proposed(bag, file := tmp_path / "p.toml", "--hindsight-goals")
    assert (made.inputs.wheels, made.motion is None) == (None, False)
    with ingested(bag, file, tmp_path / "store") as opened:
        ((mean,),) = opened.sql("SELECT avg(wheel_speed_mps) FROM transitions").fetchall()
    assert mean == pytest.approx(speeds_at(np.arange(0, DURATION_S, 0.1))[0].mean(), abs=0.02)


def test_profile_new_reports_two_publishers(tmp_path):
    wrong, file = (
        write_typed(mix_publishers(winding_drive()), tmp_path / "wrong"),
        tmp_path / "p.toml",
    )
    proposed(wrong, file, "--hindsight-goals", codes=(3,))
    assert "localiser_m" not in file.read_text()
    assert "# CONTRADICTS ITSELF: /odom: its poses step" in file.read_text()
