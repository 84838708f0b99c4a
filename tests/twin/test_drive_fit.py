"""Run `restock twin fit` and `gap` for a custom robot, recorded in the twin and ingested."""

from pathlib import Path

import msgspec
import numpy as np
import pytest
from support.driven_robot import BEAMS, FREE_M, columns, scans, typed_columns, write_topics
from twin.test_robot_drives import CAR, CAR_ACTIONS, OUTLINE

from restock import cli
from restock.errors import ExitCode
from restock.ingest.profile.profile import Profile, load_profile, profile_toml
from restock.ingest.task.robot import Robot
from restock.ingest.task.task import Body
from restock.train.twin.calibration.open_loop import empty_floor
from restock.train.twin.physics.episode import Episode, EpisodeSpec
from restock.train.twin.physics.model import robot_model
from restock.train.twin.physics.perturbation import Perturbation, load_perturbation
from restock.train.twin.physics.simulation import BodyState, Simulation

TRUE = Perturbation(latency_s=0.12, gain=0.94)
SECONDS = 100


def profile_of(robot: Robot, body: Body) -> Profile:
    amr = load_profile("warehouse_amr")
    kept = {name: source for name, source in amr.inputs.items() if name in _INPUTS}
    inputs = type(amr.inputs)(**kept)
    task = msgspec.structs.replace(amr.task, body=body, actions=CAR_ACTIONS, goal="none")
    return msgspec.structs.replace(
        amr, name="own", task=task, inputs=inputs, robot=robot, zones=[],
        shipped_conditions=["wheel_slip"], shipped_exposures=[],
    )  # fmt: skip


_INPUTS = ("command", "pose", "wheels", "imu", "scan")


def record_drive(profile: Profile, folder: Path) -> Path:
    """Record a drive under `TRUE` on an empty floor, with each command held for a second."""
    robot = robot_model(profile.robot, profile.task.body)
    sim = Simulation(1, profile.task, empty_floor(), 0.01, 1, robot=robot)
    spec = EpisodeSpec("nominal", 0)
    sim.reset(0, Episode(spec, (30, 30, 0), (1, 1), np.zeros((2, 2))), TRUE)
    states: list[BodyState] = []
    sim.callback = states.append
    rng = np.random.default_rng(4)
    table, commands = np.asarray(profile.task.actions), []
    for step in range(5 * SECONDS):
        if step % 5 == 0:
            command = table[rng.integers(len(table))]
        commands.append(command)
        sim.drive(command[None])
    at = np.array([state.time_s[0] for state in states])
    yaw = np.array([state.yaw_rad[0] for state in states])
    wheels = np.array([robot.body_velocity(*state.wheel_speed_radps[0]) for state in states])
    ticks = np.arange(len(commands)) * 0.2
    commanded, slow = np.array(commands), slice(4, None, 5)
    place = {
        "pose.pose.position.x": np.array([state.x_m[0] for state in states])[slow],
        "pose.pose.position.y": np.array([state.y_m[0] for state in states])[slow],
        "pose.pose.orientation.z": np.sin(yaw / 2)[slow],
        "pose.pose.orientation.w": np.cos(yaw / 2)[slow],
    }
    measured = {"angular_velocity.z": np.array([state.yaw_rate_radps[0] for state in states])}
    velocity = {"linear.x": commanded[:, 0], "angular.z": commanded[:, 1]}
    turned = {"twist.twist.linear.x": wheels[:, 0], "twist.twist.angular.z": wheels[:, 1]}
    topics = {
        "/cmd_vel": columns(ticks + 0.003, velocity, stamped=False),
        "/amcl_pose": columns(at[slow], place),
        "/odom": columns(at, turned),
        "/imu": columns(at, measured | {"linear_acceleration.x": np.zeros(len(at))}),
        "/scan": columns(ticks, scans(np.full((len(ticks), BEAMS), FREE_M))),
    }
    return write_topics(typed_columns(topics), folder)


@pytest.mark.slow
def test_latency_and_gain_of_steering_robot_are_recovered(tmp_path, capsys):
    profile = profile_of(CAR, OUTLINE)
    (tmp_path / "own.toml").write_text(profile_toml(profile))
    bag = record_drive(profile, tmp_path / "bag")
    store = tmp_path / "store"
    arguments = ["--profile", str(tmp_path / "own.toml"), "--store", str(store)]
    assert cli.main(["ingest", str(bag), *arguments]) == ExitCode.OK
    out = tmp_path / "fitted.toml"
    assert cli.main(["twin", "fit", str(store), "--out", str(out)]) == ExitCode.OK
    fitted = load_perturbation(out)
    assert fitted.latency_s == pytest.approx(TRUE.latency_s, abs=0.015)
    assert fitted.gain == pytest.approx(TRUE.gain, abs=0.01)
    text = " ".join(out.read_text().split()) + " ".join(capsys.readouterr().out.split())
    assert "a robot that steers turns by its steering angle" in text
    assert cli.main(["twin", "gap", str(store), "--perturbation", str(out)]) == ExitCode.OK
