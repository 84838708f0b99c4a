"""Twists that drive a robot which steers as a car: what their turn is read as, by how it turned."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.driven_robot import columns, write_topics

from restock.cli import main
from restock.ingest.profile.profile import load_profile
from restock.ingest.propose.driven.steering import TurnReading, turn_reading
from restock.ingest.steps.motion import PoseSeries

WHEELBASE_M, MAX_RAD, SPEED_MPS = 0.4, 0.5, 0.8
TIME_S = np.arange(0, 20, 0.05)
LINK = "<collision><geometry><{0}/></geometry></collision><inertial><mass value='1'/></inertial>"


def car() -> str:
    """A URDF: rear wheels that roll, front ones that roll on hubs that steer."""

    def link(name: str, shape: str) -> str:
        return f"<link name='{name}'>{LINK.format(shape)}</link>"

    def joint(child: str, parent: str, kind: str, xyz: str, axis: str) -> str:
        return (
            f"<joint name='{child}_joint' type='{kind}'><parent link='{parent}'/>"
            f"<child link='{child}'/><origin xyz='{xyz}'/><axis xyz='{axis}'/>"
            f"<limit lower='-{MAX_RAD}' upper='{MAX_RAD}' effort='1' velocity='9'/></joint>"
        )

    wheel, parts = "cylinder radius='0.05' length='0.03'", []
    for side, y in (("left", 0.15), ("right", -0.15)):
        parts += [link(f"rear_{side}", wheel), link(f"hub_{side}", "box size='.01 .01 .01'")]
        parts += [link(f"front_{side}", wheel)]
        parts += [joint(f"rear_{side}", "base_link", "continuous", f"0 {y} 0", "0 1 0")]
        parts += [joint(f"hub_{side}", "base_link", "revolute", f"{WHEELBASE_M} {y} 0", "0 0 1")]
        parts += [joint(f"front_{side}", f"hub_{side}", "continuous", "0 0 0", "0 1 0")]
    base = link("base_link", "box size='0.6 0.3 0.1'")
    return f"<robot name='car'>{base}{''.join(parts)}</robot>"


def reported() -> tuple[Any, Any]:
    """Speeds (N,) and turns (N,) of the commands at `TIME_S`."""
    return np.full(len(TIME_S), SPEED_MPS), 0.3 * np.sin(TIME_S)


def driven(yaw_rate_radps: Any) -> tuple[Any, Any, Any]:
    """Where a robot comes that turns so at the speed of the commands: x, y, yaw, each (N,)."""
    yaw = np.cumsum(yaw_rate_radps) * 0.05
    return np.cumsum(SPEED_MPS * np.cos(yaw)) * 0.05, np.cumsum(SPEED_MPS * np.sin(yaw)) * 0.05, yaw


def turns(kind: str) -> Any:
    """How a car turns by the commands, if their turn is this."""
    speed, turn = reported()
    late = np.interp(TIME_S - 0.15, TIME_S, turn)
    angle = speed * np.tan(late) / WHEELBASE_M
    return {"rate": late, "angle": angle, "straight": 0 * turn, "mirrored": -late}[kind]


def reading(kind: str) -> TurnReading:
    stamp_ns = (TIME_S * 1e9).astype(np.int64)
    return turn_reading(
        TIME_S, *reported(), PoseSeries(stamp_ns, *driven(turns(kind))), WHEELBASE_M, MAX_RAD
    )


def test_how_it_turned_tells_a_yaw_rate_from_a_steering_angle() -> None:
    assert not reading("rate").is_angle
    assert "a steering angle" in reading("rate").why
    assert reading("angle").is_angle
    assert "neither" in reading("mirrored").problem
    assert reading("straight") == TurnReading(
        too_tight=0, least_m=WHEELBASE_M / float(np.tan(MAX_RAD))
    )  # held up, or no turn at all: as the message says


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    path = tmp_path / "car.urdf"
    path.write_text(car())
    return path


def odometry(kind: str) -> Any:
    """What it measures."""
    x, y, yaw = driven(turns(kind))
    at = {"pose.pose.position.x": x, "pose.pose.position.y": y}
    at |= {"pose.pose.orientation.z": np.sin(yaw / 2), "pose.pose.orientation.w": np.cos(yaw / 2)}
    at |= {"twist.twist.linear.x": reported()[0], "twist.twist.angular.z": turns(kind)}
    return columns(TIME_S, at)


def bag(folder: Path, kind: str) -> Path:
    speed, turn = reported()
    command = {"linear.x": speed, "angular.z": turn}
    command["angular.z"][:3] = 9.0  # tighter than any car
    return write_topics(
        {
            "/odom": ("nav_msgs/msg/Odometry", odometry(kind)),
            "/cmd_vel": ("geometry_msgs/msg/Twist", columns(TIME_S, command, stamped=False)),
        },
        folder,
    )


@pytest.mark.parametrize("kind", ["angle", "mirrored"])
def test_the_wheelbase_of_steering_angles_is_the_one_by_which_it_turned(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Guessed from an outline that is guessed, yaw rates of cars were three times what they are."""
    speed, turn = reported()
    command = columns(TIME_S, {"speed": speed, "steering_angle": turn}, stamped=False)
    topics = {
        "/odom": ("nav_msgs/msg/Odometry", odometry(kind)),
        "/drive": ("ackermann_msgs/msg/AckermannDrive", command),
    }
    source, file = write_topics(topics, tmp_path / "bag"), tmp_path / "car.toml"
    assert main(["profile", "new", str(source), "--out", str(file), "--json"]) == 0
    advice = {one["key"]: one["text"] for one in json.loads(capsys.readouterr().out)["advice"]}
    profile = load_profile(file)
    assert profile.robot is not None
    assert profile.robot.wheelbase_m == profile.inputs.command.wheelbase_m
    if kind == "angle":
        assert profile.robot.wheelbase_m == pytest.approx(WHEELBASE_M, rel=0.03)
        assert file.read_text().count("# by which its steering angles explain best") == 2
        assert "inputs.command.wheelbase_m" not in advice
    else:
        assert profile.robot.origin_of("wheelbase_m") == "default"
        assert "a guess" in advice["inputs.command.wheelbase_m"]


def test_a_proposal_says_what_it_does_with_twists(
    tmp_path: Path, urdf: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "car.toml"
    argv = ["profile", "new", str(bag(tmp_path / "bag", "rate")), "--urdf", str(urdf)]
    assert main([*argv, "--out", str(file), "--json"]) == 0
    advice = {one["key"]: one["text"] for one in json.loads(capsys.readouterr().out)["advice"]}
    assert "angular.z is read as a yaw rate" in advice["inputs.command"]
    assert "3 of its commands turn tighter" in advice["inputs.command"]
    assert load_profile(file).inputs.command.fields["yaw_rate_radps"] == "angular.z"
    assert "the robot steers as a car" in file.read_text()


def test_steering_angles_in_twists_are_read_as_such(tmp_path: Path, urdf: Path) -> None:
    file = tmp_path / "car.toml"
    argv = ["profile", "new", str(bag(tmp_path / "bag", "angle")), "--urdf", str(urdf)]
    assert main([*argv, "--out", str(file)]) == 0
    command = load_profile(file).inputs.command
    assert command.fields == {"speed_mps": "linear.x", "steering_rad": "angular.z"}
    assert command.wheelbase_m == pytest.approx(WHEELBASE_M)


def test_what_tells_neither_is_refused_with_what_to_write(
    tmp_path: Path, urdf: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["profile", "new", str(bag(tmp_path / "bag", "mirrored")), "--urdf", str(urdf), "--json"]
    assert main(argv) == 3
    (problem,) = json.loads(capsys.readouterr().out)["problems"]
    assert "neither a yaw rate nor a steering angle explains how it turned" in problem
    assert "[inputs.command]" in problem
