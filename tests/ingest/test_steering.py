"""Robots without a description: detection of car-like steering from how they turned."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.driven_robot import columns, write_topics
from support.long import one_in
from twin.test_robot_drives import CAR, OUTLINE

from restock.ingest.profile.profile import load_profile
from restock.ingest.propose.robot_choice import DriveEvidence, drive_evidence
from restock.ingest.steps.frames import PoseSeries
from restock.ingest.task.robot import Robot
from restock.ingest.task.task import Body, Task
from restock.train.twin.calibration.open_loop import OpenLoopStart, drive_open_loop
from restock.train.twin.physics.model import robot_model
from restock.train.twin.physics.perturbation import Perturbation

PERIOD_S, STEPS = 0.2, 240
SPEEDS, TURNS = (0.2, 0.4, 0.8, -0.4), (0.0, 0.0, 0.6, 1.2, -0.6, -1.2)
ROBOTS = {
    "differential": (Robot(wheel_radius_m=0.1, track_m=0.4, mass_kg=30.0), Body(0.6, 0.5)),
    "skid-steer": (
        Robot(drive="skid_steer", wheel_radius_m=0.1, track_m=0.4, wheelbase_m=0.4, mass_kg=40.0),
        Body(0.7, 0.5),
    ),
    "ackermann": (CAR, OUTLINE),
}


def remote_commands(seed: int, *, spot: bool) -> Any:
    """Return remote-control commands (T, 2), each held for 0.6 to 3 s; `spot` adds pivots."""
    rng, held = np.random.default_rng(seed), []
    if spot:
        held += [(0.0, 1.2)] * 10 + [(0.4, 0.0)] * 10 + [(0.0, -1.2)] * 10
    while len(held) < STEPS:
        held += [(rng.choice(SPEEDS), rng.choice(TURNS))] * rng.integers(3, 16)
    return np.array(held[:STEPS])


def evidence_of(name: str, seed: int, *, spot: bool) -> DriveEvidence:
    """Return the evidence in such a drive of the twin's robot, with localiser poses."""
    robot, body = ROBOTS[name]
    reported = remote_commands(seed, spot=spot)
    still = (
        *("wheel_speed_mps", "wheel_yaw_rate_radps", "gyro_yaw_rate_radps"),
        *("localised_speed_mps", "localised_lateral_mps"),
    )
    start = OpenLoopStart(np.zeros((1, 3)), dict.fromkeys(still, np.zeros(1)), reported[None])
    task = Task(body=body, actions=((0.0, 0.0), (0.4, 0.0)))
    driven = drive_open_loop(task, start, [Perturbation()], robot=robot_model(robot, body))
    poses = driven.pose[0, 0] + np.random.default_rng(seed).normal(0, 0.005, (STEPS + 1, 3))
    at_ns = (np.arange(STEPS + 1) * PERIOD_S * 1e9).astype(np.int64)
    return drive_evidence(np.arange(STEPS) * PERIOD_S, *reported.T, PoseSeries(at_ns, *poses.T))


@pytest.mark.parametrize("seed", one_in(2, range(2)))
@pytest.mark.parametrize("name", ROBOTS)
def test_car_like_steering_is_detected_in_twin_drives(name: str, seed: int) -> None:
    found = evidence_of(name, seed, spot=True)
    assert found.steers is (name == "ackermann")
    assert "commanded to turn on the spot, by" in found.why
    gentle = evidence_of(name, seed, spot=False)
    assert not gentle.steers or name == "ackermann"


def write_pivot_bag(folder: Path, *, pivots: bool) -> Path:
    """Write 20 s of driving ahead with two commands to turn on the spot."""
    time_s = np.arange(0, 20, 0.05)
    spot = (time_s % 10 > 4) & (time_s % 10 < 8)
    speed, turn = np.where(spot, 0.0, 0.4), np.where(spot, 0.8, 0.0)
    rate = turn * pivots
    yaw = np.cumsum(rate) * 0.05
    at = {
        "pose.pose.position.x": np.cumsum(speed * np.cos(yaw)) * 0.05,
        "pose.pose.position.y": np.cumsum(speed * np.sin(yaw)) * 0.05,
        "pose.pose.orientation.z": np.sin(yaw / 2),
        "pose.pose.orientation.w": np.cos(yaw / 2),
        "twist.twist.linear.x": speed,
        "twist.twist.angular.z": rate,
    }
    command = {"linear.x": speed, "angular.z": turn}
    return write_topics(
        {
            "/odom": ("nav_msgs/msg/Odometry", columns(time_s, at)),
            "/cmd_vel": ("geometry_msgs/msg/Twist", columns(time_s, command, stamped=False)),
        },
        folder,
    )


def test_proposal_reports_car_like_steering_with_evidence(tmp_path, shell):
    file = tmp_path / "car.toml"
    source = write_pivot_bag(tmp_path / "bag", pivots=False)
    items = shell.json("profile", "new", source, "--out", file)["advice"]
    advice = {item["key"]: item["text"] for item in items}
    assert "STEERS LIKE A CAR: commanded to turn on the spot, by 6.3" in advice["robot.drive"]
    assert "# CONFIRM THAT IT STEERS LIKE A CAR" in file.read_text()
    assert "angular.z is read as a yaw rate" in advice["inputs.command"]
    profile = load_profile(file)
    assert profile.robot is not None
    assert profile.robot.drive == "ackermann"
    assert profile.robot.origin_of("drive") == "logs"
    assert all(speed or not turn for speed, turn in profile.task.actions)
