"""Robots that record Foxglove or ROS message types as JSON or protobuf: proposed profiles."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.foxglove_robot import (
    BEAMS,
    FIELD_RAD,
    SPEED_MPS,
    START_NS,
    WALL_M,
    YAW_RATE_RADPS,
    Message,
    drive,
    fix,
    place,
    pose,
    write_robot,
)
from support.ingested import steps_in
from support.shell import Shell

from restock.ingest.containers.open_recording import open_recording
from restock.ingest.profile.profile import parse_profile
from restock.ingest.propose.drives import robot_traits


def proposed(shell: Shell, path: Path) -> str:
    """Return the TOML of the proposal, after checking that it is usable."""
    proposal = shell.json("profile", "new", path)
    assert proposal["problems"] == []
    return str(proposal["toml"])


@pytest.mark.parametrize("encoding", ["json", "protobuf"])
def test_scan_pose_odometry_and_command_are_proposed(tmp_path, encoding, shell):
    path = write_robot(tmp_path / "run.mcap", encoding, drive())
    profile = parse_profile(proposed(shell, path), where="p")
    steps = steps_in(path, profile)
    assert {name: source.topic for name, source in profile.inputs.items()} == {
        "command": "/cmd_vel",
        "pose": "/pose",
        "wheels": "/odom",
        "scan": "/scan",
    }
    assert profile.robot.lidar.beams == BEAMS
    assert profile.robot.lidar.angle_max_rad == pytest.approx(FIELD_RAD / 2, abs=1e-4)
    usable = np.array([problem == "" for problem in steps.problem])
    assert usable.sum() > 190
    seconds = (steps.signals["stamp_ns"][usable] - START_NS) * 1e-9
    expected = np.array([place(time_s) for time_s in seconds.tolist()])
    for name, column in (("pose_x_m", expected[:, 0]), ("pose_y_m", expected[:, 1])):
        # A pose is at most one period plus its logging delay old.
        assert np.abs(steps.signals[name][usable] - column).max() < 0.1 * SPEED_MPS
    assert np.allclose(steps.signals["command_yaw_rate_radps"][usable], YAW_RATE_RADPS)
    ahead_m = steps.signals["sector_clearance_m"][usable].min(axis=1)
    assert np.allclose(ahead_m, WALL_M - profile.task.body.length_m / 2, atol=0.15)
    with open_recording(path) as recording:
        traits = robot_traits(recording)
    assert traits.frames == "odom -> base_link"
    assert str(traits.lidar) == f"lidar laser, {BEAMS} beams"


def test_fixes_are_proposed_without_other_poses(tmp_path, shell):
    messages: list[Message] = [
        message for message in drive() if message[1] in ("/cmd_vel", "/scan")
    ]
    for time_s in np.arange(0, 20, 0.2).tolist():
        messages.append((time_s, "/gps/fix", "foxglove.LocationFix", fix(time_s, 0.02)))
    path = write_robot(
        tmp_path / "run.mcap", "protobuf", sorted(messages, key=lambda message: message[0])
    )
    toml = proposed(shell, path)
    assert "Fixes of 0.02 m, mostly" in toml
    assert parse_profile(toml, where="p").inputs.pose.topic == "/gps/fix"
    steps = steps_in(path, toml)
    usable = np.array([problem == "" for problem in steps.problem])
    radius = SPEED_MPS / YAW_RATE_RADPS
    x, y = (steps.signals[f"pose_{axis}_m"][usable] for axis in "xy")
    assert usable.sum() > 150
    assert np.allclose(np.hypot(x, y - radius), radius, atol=0.02)


def test_goals_and_plans_are_not_proposed_as_poses(tmp_path, shell):
    at = {"timestamp": 0.0, "frame_id": "map"}
    plan = {**at, "poses": [pose(), pose(2.0, 2.0)]}
    messages: list[Message] = [
        (0.0, "/goal_pose", "foxglove.PoseInFrame", {**at, "pose": pose(2.0, 2.0)}),
        (0.0, "/plan", "foxglove.PosesInFrame", plan),
        *drive(),
    ]
    toml = proposed(shell, write_robot(tmp_path / "run.mcap", "json", messages))
    inputs = parse_profile(toml, where="p").inputs
    topics = inputs.goal.topic, inputs.plan.topic, inputs.pose.topic
    assert topics == ("/goal_pose", "/plan", "/pose")


@pytest.mark.parametrize(("encoding", "together"), [("json", True), ("protobuf", False)])
def test_pose_and_lidar_mounting_from_transforms(tmp_path, encoding, together, shell):
    def transform(time_s: float, parent: str, child: str, at: tuple[float, ...]) -> dict[str, Any]:
        where = pose(*at)
        return {
            **{"timestamp": time_s, "parent_frame_id": parent, "child_frame_id": child},
            **{"translation": where["position"], "rotation": where["orientation"]},
        }

    messages: list[Message] = [
        message for message in drive() if message[1] in ("/cmd_vel", "/scan")
    ]
    for time_s in np.arange(0, 20, 0.05).tolist():
        links = [
            transform(time_s, "map", "odom", (1.0, 0.0)),
            transform(time_s, "odom", "base_link", place(time_s)),
            transform(time_s, "base_link", "laser", (0.2, 0.0, np.pi)),
        ]
        if together:
            messages.append((time_s, "/tf", "foxglove.FrameTransforms", {"transforms": links}))
        else:
            messages += [(time_s, "/moves", "foxglove.FrameTransform", link) for link in links]
    path = write_robot(
        tmp_path / "run.mcap", encoding, sorted(messages, key=lambda message: message[0])
    )
    profile = parse_profile(proposed(shell, path), where="p")
    steps = steps_in(path, profile)
    assert profile.inputs.pose is None
    assert (profile.frames.fixed, profile.frames.base) == ("map", "base_link")
    assert profile.frames.topic == ("/tf" if together else "/moves")
    assert profile.task.body.lidar_x_m == pytest.approx(0.2)
    assert abs(profile.task.body.lidar_yaw_rad) == pytest.approx(np.pi, abs=1e-3)
    usable = np.array([problem == "" for problem in steps.problem])
    assert usable.sum() > 180
    seconds = (steps.signals["stamp_ns"][usable] - START_NS) * 1e-9
    expected_m = np.array([place(time_s) for time_s in seconds.tolist()])[:, 0] + 1.0
    assert np.abs(steps.signals["pose_x_m"][usable] - expected_m).max() < 0.1 * SPEED_MPS
