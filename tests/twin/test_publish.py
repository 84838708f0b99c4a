"""Check the messages of a drive: rates, the three times of a message, and frames."""

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from restock.train.twin.recording.bag_writer import Message, typestore
from restock.train.twin.recording.publish import Rates, Robot
from restock.train.twin.recording.recorder import NOISELESS
from restock.train.twin.recording.robot_topics import TOPICS, Drive, Lidar, Motion, Odometer

START_NS = 1_772_000_000_000_000_000
TYPES = {topic.name: topic.type_name for topic in TOPICS}
SECONDS = 4.0


def _drive(rng: np.random.Generator) -> Drive:
    """Drive a left-hand circle of 1 m radius at .5 m/s, bumped at 1.05 s, replanned at 2 s."""
    time = np.arange(0, SECONDS + 1e-9, 0.01)
    yaw = 0.5 * time
    pose = np.stack([np.sin(yaw), 1 - np.cos(yaw), yaw], axis=-1)
    rate = np.tile([(0.5 - 0.11) / 0.1, (0.5 + 0.11) / 0.1], (len(time), 1))
    motion = Motion(
        time_s=time,
        pose=pose,
        wheel_angle_rad=rate * time[:, None],
        wheel_rate_radps=rate,
        yaw_rate_radps=np.full(len(time), 0.5),
        accel_mps2=np.tile([0.0, 0.25], (len(time), 1)),
        bumped=np.isclose(time, 1.05),
    )
    tick = np.arange(21) * 0.2
    noisy = pose[::20] + rng.normal(0, 0.01, (21, 3))
    stamp = (tick * 1e9).astype(np.int64)
    return Drive(
        goal_m=(3.0, 4.0),
        motion=motion,
        tick_s=tick,
        signals={
            "stamp_ns": stamp,
            "pose_stamp_ns": stamp,
            "pose_x_m": noisy[:, 0],
            "pose_y_m": noisy[:, 1],
            "pose_yaw_rad": noisy[:, 2],
            "wheel_speed_mps": 0.5 + rng.normal(0, 0.01, 21),
            "wheel_yaw_rate_radps": np.full(21, 0.5),
            "gyro_yaw_rate_radps": np.full(21, 0.48),
            "accel_x_mps2": np.full(21, 0.1),
            "nav_speed_mps": np.full(21, 0.4),
            "nav_yaw_rate_radps": np.zeros(21),
        },
        scan_s=np.arange(41) * 0.1,
        ranges_m=rng.uniform(0.3, 9, (41, 90)),
        command=np.tile([0.5, 0.5], (20, 1)),
        true_condition=["nominal"] * 20,
        true_exposure=["nominal"] * 20,
        policy=[("planner", "1", 0.98)] * 12 + [("operator", "1", 0.97)] * 8,
        plans=[(0, np.zeros((5, 2))), (10, np.ones((7, 2)))],
        pallets=np.zeros((0, 3)),
        patches=np.zeros((0, 5)),
        traffic=np.zeros((1, 0, 3)),
        perturbation=NOISELESS,
        goal_radius_m=0.4,
        body_m=(0.7, 0.5, 0.3),
    )


@pytest.fixture(scope="module")
def drive() -> Drive:
    return _drive(np.random.default_rng(4))


def _robot() -> Robot:
    lidar = Lidar(-3.1, 0.07, 0.05, 10.0)
    return Robot(
        np.random.default_rng(3), lidar, Rates(), Odometer(wheel_radius_m=0.1, track_m=0.44)
    )


@pytest.fixture(scope="module")
def messages(drive: Drive) -> list[Message]:
    return _robot().publish(drive, START_NS)


def _decoded(messages: list[Message]) -> dict[str, list[tuple[int, object]]]:
    by_topic = defaultdict(list)
    for message in messages:
        value = typestore().deserialize_cdr(message.data, TYPES[message.topic])
        by_topic[message.topic].append((message.log_ns, value))
    return by_topic


def _stamps(rows: list[tuple[int, object]]) -> NDArray[np.int64]:
    return np.array([v.header.stamp.sec * 10**9 + v.header.stamp.nanosec for _, v in rows])


def test_topics_have_their_rates(messages: list[Message]) -> None:
    counts = {topic: len(rows) for topic, rows in _decoded(messages).items()}
    assert counts == {
        "/goal_pose": 1,
        "/plan": 4,  # at 0 and 1 s, and again at 2 and 3 s
        "/behaviour_policy": 2,  # the start and the handover
        "/odom": 201,
        "/imu": 201,
        "/joint_states": 81,
        "/scan": 41,
        "/amcl_pose": 41,
        "/tf": 81,
        "/bumper": 43,  # 41 at 10 Hz, pressed and released between
        "/ground_truth/condition": 21,
        "/ground_truth/exposure": 21,
        "/cmd_vel_nav": 21,
        "/cmd_vel": 21,  # 20 steps and the stop at the end
        "/diagnostics": 5,
        "/ground_truth/perturbation": 1,
        "/ground_truth/markers": 1,
        "/ground_truth/traffic": 1,
    }


def test_stamp_precedes_publish_and_log_time(messages: list[Message]) -> None:
    assert all(m.publish_ns < m.log_ns for m in messages)
    assert [m.log_ns for m in messages] == sorted(m.log_ns for m in messages)
    for topic, rows in _decoded(messages).items():
        if hasattr(rows[0][1], "header"):
            delay = np.array([log_ns for log_ns, _ in rows]) - _stamps(rows)
            assert delay.min() > 0, topic
            assert delay.max() < 11_000_000, topic
            assert topic == "/goal_pose" or len(set(delay.tolist())) > 1, topic


def test_replaced_plan_is_not_repeated(drive: Drive) -> None:
    # In floating point, the plan of 1.2 s is due again one bit before 2.2 s.
    changed = replace(drive, plans=[(6, np.zeros((5, 2))), (11, np.ones((7, 2)))])
    plans = _decoded(_robot().publish(changed, START_NS))["/plan"]
    assert [len(value.poses) for _, value in plans] == [5, 7, 7]


def test_odometry_and_tf_match_the_drive(drive, messages):
    by_topic = _decoded(messages)
    last = by_topic["/odom"][-1][1].pose.pose.position
    assert (last.x, last.y) == pytest.approx(drive.motion.pose[-1, :2], abs=5e-3)
    to_odom, to_base = by_topic["/tf"][-1][1].transforms
    assert (to_odom.header.frame_id, to_odom.child_frame_id) == ("map", "odom")
    assert (to_base.header.frame_id, to_base.child_frame_id) == ("odom", "base_link")
    yaw = 2 * np.arctan2(to_odom.transform.rotation.z, to_odom.transform.rotation.w)
    x, y = to_base.transform.translation.x, to_base.transform.translation.y
    in_map = (
        to_odom.transform.translation.x + np.cos(yaw) * x - np.sin(yaw) * y,
        to_odom.transform.translation.y + np.sin(yaw) * x + np.cos(yaw) * y,
    )
    seen = drive.signals["pose_x_m"][-1], drive.signals["pose_y_m"][-1]
    assert in_map == pytest.approx(seen, abs=1e-5)
