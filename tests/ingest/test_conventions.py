"""Values that messages mark as not measured become null and are counted."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.driven_robot import BEAMS, Drive, columns, ragged, scans, typed_topics, write_topics
from support.ingested import steps_in
from support.profile_texts import WAREHOUSE

from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.live.observer import LiveObserver
from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import load_profile
from restock.ingest.profile.signal_paths import conventions_of
from restock.ingest.steps.episodes import Steps, steps_of

SECONDS, TURN_RADPS = 6.0, 0.4
Topics = dict[str, tuple[str, TopicColumns]]


def covariance(count: int, unknown: Any) -> np.ndarray:
    """Return the covariances (N, 9) of messages, with -1 first if unknown."""
    rows = np.zeros((count, 9))
    rows[unknown, 0] = -1
    return rows


def drive(**unknown: Any) -> Topics:
    """Return a drive whose wheels turn, and whose IMU sometimes reports no measurement."""
    topics = typed_topics(Drive(SECONDS))
    fast = np.arange(0, SECONDS, 0.02)
    covariances = {
        f"{key}_covariance": covariance(len(fast), rows) for key, rows in unknown.items()
    }
    topics["/imu"] = (
        "sensor_msgs/msg/Imu",
        columns(
            fast,
            {
                "angular_velocity.z": np.full(len(fast), 0.1),
                "linear_acceleration.x": np.full(len(fast), 0.3),
                **covariances,
            },
        ),
    )
    odometry = topics["/odom"][1].fields
    odometry["twist.twist.angular.z"] = np.full(len(fast), TURN_RADPS)
    return topics


def steps_from(topics: Topics) -> Steps:
    return steps_of(load_profile("warehouse_amr"), {name: one for name, (_, one) in topics.items()})


def test_imu_without_gyro_falls_back_to_wheels(tmp_path: Path) -> None:
    topics = drive(angular_velocity=slice(None))
    steps = steps_from(topics)
    assert steps.signals["gyro_yaw_rate_radps"] == pytest.approx(TURN_RADPS)
    assert steps.signals["accel_x_mps2"] == pytest.approx(0.3)
    reported = (
        "imu: 300 of 300 messages of /imu have no estimate of angular_velocity "
        "(angular_velocity_covariance[0] is -1): gyro yaw rate taken from the wheels"
    )
    assert reported in steps.notes
    assert set(steps.problem) == {""}
    bag = write_topics(topics, tmp_path / "bag", storage="mcap")
    result = ingest(bag, load_profile("warehouse_amr"), store=None)
    stand_ins = {item["input"]: item["instead"] for item in result.manifest["stand_ins"]}
    assert stand_ins["imu"] == "gyro yaw rate taken from the wheels"


def test_partly_unknown_gyro_falls_back_to_wheels() -> None:
    """The gyroscope fails half way, and there is no accelerometer."""
    half = slice(150, None)
    steps = steps_from(drive(angular_velocity=half, linear_acceleration=slice(None)))
    gyro = steps.signals["gyro_yaw_rate_radps"]
    measured = np.arange(len(gyro)) < len(gyro) // 2 + 1
    assert gyro[measured][:-1] == pytest.approx(0.1)
    assert gyro[~measured][1:] == pytest.approx(TURN_RADPS)
    assert not steps.signals["accel_x_mps2"].any()
    assert any("150 of 300 messages of /imu have no estimate of angular" in n for n in steps.notes)


def test_known_covariance_keeps_gyro() -> None:
    steps = steps_from(drive(angular_velocity=slice(0)))
    assert steps.signals["gyro_yaw_rate_radps"] == pytest.approx(0.1)
    assert not [note for note in steps.notes if "estimate" in note]


def test_odometry_without_speeds_gives_no_rows() -> None:
    topics = drive()
    fields = topics["/odom"][1].fields
    unknown = np.zeros((len(topics["/odom"][1]), 36))
    unknown[:, 0] = -1
    fields["twist.covariance"] = unknown
    steps = steps_from(topics)
    assert set(steps.problem) == {"wheels: no estimate"}


def test_unmeasured_signals_are_null(tmp_path: Path) -> None:
    topics = drive(angular_velocity=slice(None))
    ticks = np.arange(0, SECONDS, 0.1)
    share = np.where(ticks < 3, 0.8, np.nan)
    battery = {"percentage": share, "voltage": np.full(len(ticks), 24.0)}
    topics["/battery"] = ("sensor_msgs/msg/BatteryState", columns(ticks, battery))
    limits = {"min_range": np.full(len(ticks), 0.2), "max_range": np.full(len(ticks), 3.0)}
    near = np.select([ticks < 2, ticks < 4], [-np.inf, 1.5], 5.0)
    topics["/sonar"] = ("sensor_msgs/msg/Range", columns(ticks, {"range": near} | limits))
    beams = np.full((len(ticks), 3), 2.0, np.float32)
    beams[:, 0], beams[::2, 1] = 0.0, -np.inf  # no return, and too close
    scan = {"range_min": np.full(len(ticks), 0.1), "range_max": np.full(len(ticks), 8.0)}
    topics["/aside"] = (
        "sensor_msgs/msg/LaserScan",
        columns(ticks, scan | {"ranges": ragged(list(beams.T))}),
    )
    signals = {
        "gyro": ("/imu", "Imu", "angular_velocity.z", ""),
        "share": ("/battery", "BatteryState", "percentage", ""),
        "voltage": ("/battery", "BatteryState", "voltage", ""),
        "sonar": ("/sonar", "Range", "range", ""),
        "beam": ("/aside", "LaserScan", "ranges[:]", 'reduce = "min"'),
    }
    text = WAREHOUSE + "".join(
        f'\n[signals.{name}]\ntopic = "{topic}"\ntype = "sensor_msgs/msg/{kind}"\n'
        f'path = "{path}"\nunit = "1"\nmax_age_s = 0.5\n{more}\n'
        for name, (topic, kind, path, more) in signals.items()
    )
    steps = steps_in(write_topics(topics, tmp_path / "bag", storage="mcap"), text)
    found = {name: steps.custom.table[name].to_pylist() for name in signals}
    assert set(found["gyro"]) == {None}
    assert found["share"][:15] == pytest.approx([0.8] * 15, abs=1e-6)
    assert set(found["share"][16:]) == {None}
    assert set(found["voltage"]) == {24.0}
    assert found["sonar"][0] == pytest.approx(0.2)  # nearer than the sensor can measure
    assert found["sonar"][12] == 1.5
    assert found["sonar"][-1] is None
    assert {round(beam, 3) for beam in found["beam"]} <= {0.1, 2.0}
    notes = "\n".join(steps.notes)
    assert "signals.share: 30 of 60 messages of /battery mark it as not measured" in notes
    assert "signals.sonar: 20 of 60 messages of /sonar mark" in notes
    assert "signals.voltage" not in notes


def test_minus_infinity_beams_are_near_obstacles() -> None:
    """Compare ranges below 0.3 m as measured with the same ranges as -inf."""
    tenth = np.arange(0, SECONDS, 0.1)
    found = []
    for name, too_close in (("measured", 0.25), ("reported", -np.inf)):
        ranges = np.full((len(tenth), BEAMS), 3.0, np.float32)
        ranges[20:40, BEAMS // 2 - 3 : BEAMS // 2 + 3] = too_close  # ahead, within the outline
        ranges[50] = -np.inf if name == "reported" else 0.0  # covered: no beam has a range
        topics = drive()
        topics["/scan"] = ("sensor_msgs/msg/LaserScan", columns(tenth, scans(ranges)))
        found.append(steps_from(topics))
    measured, reported = found
    usable = np.array(measured.problem) == ""
    assert reported.problem == measured.problem
    expected, near = (one.signals["clearance_m"][usable] for one in found)
    assert near == pytest.approx(expected)
    assert (near == 0).sum() == pytest.approx(10, abs=1)
    assert reported.problem.count("scan: no beam has a valid range") == 1
    expected_note = "scan: 21 of 60 messages of /scan have beams of -inf, too close to be measured"
    assert any(note.startswith(expected_note) for note in reported.notes)
    assert not any("-inf" in note for note in measured.notes)


def test_live_observer_flags_unknown_gyro() -> None:
    """The observer on a robot uses the wheels' yaw rate instead, too."""
    observer = LiveObserver(load_profile("warehouse_amr"))
    point = SimpleNamespace(x=0.0, y=0.0, z=0.1)
    unknown = [-1.0] + [0.0] * 8
    stamp = SimpleNamespace(sec=1, nanosec=0)
    message = SimpleNamespace(
        header=SimpleNamespace(stamp=stamp),
        angular_velocity=point,
        linear_acceleration=point,
        angular_velocity_covariance=unknown,
        linear_acceleration_covariance=[0.0] * 9,
    )
    observer.receive("/imu", message, 10**9)
    kept = observer._buffers["/imu"][-1].fields
    (rule,) = conventions_of("sensor_msgs/msg/Imu", "angular_velocity.z")
    assert rule.flags(kept).tolist() == [True]
