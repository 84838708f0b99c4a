"""Recordings of no robot on wheels: one sentence that says what they are taken for."""

from __future__ import annotations

import json

import numpy as np
import pytest
from support.driven_robot import columns, pose, write_topics
from support.paths import SHARED

from restock.cli import main
from restock.ingest.decoding.columns import TopicColumns

SECONDS = np.arange(0, 8, 0.1)
RISING = np.clip(SECONDS, 0, 3)


def flight(command: str | None) -> dict[str, tuple[str, TopicColumns]]:
    """As mavros publishes it: local pose, velocity set points, a setpoint trajectory."""
    at = pose("pose", SECONDS * 0.3, 1.0) | {"pose.position.z": RISING}
    found = {"/mavros/local_position/pose": ("geometry_msgs/msg/PoseStamped", columns(SECONDS, at))}
    if command is None:
        empty = columns(SECONDS, {})
        found["/hummingbird/command/trajectory"] = (
            "trajectory_msgs/msg/MultiDOFJointTrajectory",
            empty,
        )
    else:
        speeds = {
            "twist.linear.x": np.full(len(SECONDS), 0.3),
            "twist.linear.z": np.gradient(RISING, SECONDS),
        }
        found[command] = ("geometry_msgs/msg/TwistStamped", columns(SECONDS, speeds))
    return found


def arm() -> dict[str, tuple[str, TopicColumns]]:
    empty = columns(SECONDS, {})
    return {
        "/joint_states": ("sensor_msgs/msg/JointState", empty),
        "/arm_controller/joint_trajectory": ("trajectory_msgs/msg/JointTrajectory", empty),
    }


def cameras() -> dict[str, tuple[str, TopicColumns]]:
    empty = columns(SECONDS, {})
    return {
        "/camera/color": ("sensor_msgs/msg/Image", empty),
        "/camera/info": ("sensor_msgs/msg/CameraInfo", empty),
    }


@pytest.mark.parametrize(
    ("topics", "said"),
    [
        (flight("/mavros/setpoint_velocity/cmd_vel"), "a drone's recording (it rises by 2.6 m"),
        (flight(None), "a drone's recording (it has trajectory_msgs/msg/MultiDOF"),
        (arm(), "a robot arm's recording (it has trajectory_msgs/msg/JointTrajectory"),
        (cameras(), "a recording of sensors alone"),
    ],
)
def test_it_is_said_once_what_it_is_taken_for(topics, said, tmp_path, capsys):
    bag = write_topics(topics, tmp_path / "bag", storage="mcap")
    assert main(["profile", "new", str(bag), "--json"]) == 3
    (problem,) = json.loads(capsys.readouterr().out)["problems"]
    assert f"this looks like {said}" in problem
    assert problem.endswith(("with its velocity commands", "and a pose"))


def test_a_robot_on_a_ramp_is_on_wheels(tmp_path, capsys):
    topics = flight("/cmd_vel")
    topics["/cmd_vel"][1].fields["twist.linear.z"][:] = 0
    bag = write_topics(topics, tmp_path / "bag")
    assert main(["profile", "new", str(bag), "--json"]) == 0


def test_start_says_so_and_leaves_no_profile_to_edit(tmp_path, capsys):
    out = tmp_path / "out"
    for number, topics in enumerate((flight("/mavros/setpoint_velocity/cmd_vel"), arm())):
        bag = write_topics(topics, tmp_path / f"bag{number}")
        assert main(["start", str(bag), "--out", str(out), "--json"]) == 3
        stopped = json.loads(capsys.readouterr().out)["stopped"]
        assert stopped["why"].startswith("this looks like a")
        assert stopped["remedies"] == ["give recordings of a robot on wheels"]
        assert not (out / "profile.toml").exists()


@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/bags is absent")
def test_a_base_with_an_arm_is_on_wheels(capsys):
    assert main(["profile", "new", str(SHARED / "sim-time-husky"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["problems"] == []
