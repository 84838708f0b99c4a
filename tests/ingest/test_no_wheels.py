"""Recordings of no robot on wheels: one sentence that says what they are taken for."""

from __future__ import annotations

import json

import numpy as np
import pytest
from support.driven_robot import columns, pose, write_topics

from restock.cli import main
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.profile.profile import parse_profile

SECONDS = np.arange(0, 8, 0.1)
RISING = np.clip(SECONDS, 0, 6)


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


def servoed(**speeds: object) -> dict[str, tuple[str, TopicColumns]]:
    """As MoveIt Servo drives an arm: twists of its tool, which is located in the base's frame."""
    at = pose("pose", 0.4 + 0.1 * np.sin(SECONDS), 0.1) | {"pose.position.z": 0.5 + 0 * SECONDS}
    reported = {"twist.linear.x": 0.1 * np.sin(SECONDS)}
    reported |= {f"twist.{path}": value + 0 * SECONDS for path, value in speeds.items()}
    return {
        "/joint_states": ("sensor_msgs/msg/JointState", columns(SECONDS, {})),
        "/servo/twists": ("geometry_msgs/msg/TwistStamped", columns(SECONDS, reported)),
        "/tool_pose": ("geometry_msgs/msg/PoseStamped", columns(SECONDS, at)),
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
        (flight("/mavros/setpoint_velocity/cmd_vel"), "a robot arm's or a drone's recording ("),
        (flight(None), "a drone's recording (it has trajectory_msgs/msg/MultiDOF"),
        (arm(), "a robot arm's recording (it has trajectory_msgs/msg/JointTrajectory"),
        (
            servoed(**{"linear.y": 0.1, "linear.z": 0.05, "angular.y": 0.1}),
            "a robot arm's or a drone's recording (80 of the 80 commands to move of /servo/twists"
            " have linear.z, angular.x or angular.y)",
        ),
        (servoed(**{"angular.x": -0.2}), "a robot arm's or a drone's recording (80 of the 80"),
        (
            servoed(**{"linear.z": np.where(SECONDS < 4.2, 0.1, 0.0)}),
            "a robot arm's or a drone's recording (42 of",
        ),
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


@pytest.mark.parametrize("speeds", [{}, {"linear.z": np.where(SECONDS < 3, 0.1, 0.0)}])
def test_commands_mostly_on_the_floor_are_of_a_wheeled_robot(speeds, tmp_path, capsys):
    bag = write_topics(servoed(**speeds), tmp_path / "bag")
    assert main(["profile", "new", str(bag), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["problems"] == []


def test_noise_off_the_floor_tells_no_arm(tmp_path, capsys):
    noise = np.random.default_rng(0).normal(0, 1e-3, len(SECONDS))
    bag = write_topics(servoed(**{"linear.z": noise, "angular.y": noise}), tmp_path / "bag")
    assert main(["profile", "new", str(bag), "--json"]) == 0


def test_the_base_below_an_arm_is_what_drives(tmp_path, capsys):
    """Its commands are far fewer than the arm's, and their topic's name tells nothing."""
    topics = servoed(**{"linear.z": 0.05, "angular.y": 0.1})
    seldom = SECONDS[::4]
    reported = {"twist.linear.x": 0.1 * np.sin(seldom), "twist.angular.z": 0.2 * np.cos(seldom)}
    topics["/wheels/speeds"] = ("geometry_msgs/msg/TwistStamped", columns(seldom, reported))
    bag = write_topics(topics, tmp_path / "bag")
    assert main(["profile", "new", str(bag), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["problems"] == []
    assert parse_profile(said["toml"], where="p").inputs.command.topic == "/wheels/speeds"


def test_measured_motion_that_sways_is_of_a_robot_on_wheels(tmp_path, capsys):
    """Odometry in three dimensions, in place of commands: rough floor pitches and rolls it."""
    topics = servoed()
    del topics["/servo/twists"], topics["/tool_pose"]
    sways = 0.2 * np.sin(9 * SECONDS)
    motion = {"twist.twist.linear.x": 0.1 + 0 * SECONDS, "twist.twist.linear.z": sways}
    motion |= {"twist.twist.angular.x": sways, "twist.twist.angular.y": sways}
    at = pose("pose.pose", 0.1 * SECONDS, 1.0)
    topics["/odom"] = ("nav_msgs/msg/Odometry", columns(SECONDS, motion | at))
    bag = write_topics(topics, tmp_path / "bag")
    assert main(["profile", "new", str(bag), "--odometry-as-command", "--json"]) == 0


def test_start_says_so_and_leaves_no_profile_to_edit(tmp_path, capsys):
    out = tmp_path / "out"
    drone = flight("/mavros/setpoint_velocity/cmd_vel")
    for number, topics in enumerate((drone, arm(), servoed(**{"linear.z": 0.05}))):
        bag = write_topics(topics, tmp_path / f"bag{number}")
        assert main(["start", str(bag), "--out", str(out), "--json"]) == 3
        stopped = json.loads(capsys.readouterr().out)["stopped"]
        assert stopped["why"].startswith("this looks like a")
        assert stopped["remedies"] == ["give recordings of a robot on wheels"]
        assert not (out / "profile.toml").exists()
