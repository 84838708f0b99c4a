"""Check Ackermann and omnidirectional robots: commands, limits and perturbations."""

import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from twin.test_robot import AMR, amr_with, drive_steadily

from restock.errors import ConfigError
from restock.ingest.profile.profile import load_profile, parse_profile, profile_toml
from restock.ingest.task.robot import Robot
from restock.ingest.task.task import Body, Task
from restock.train.twin.calibration.open_loop import OpenLoopStart, drive_open_loop
from restock.train.twin.env.drivers import PlannerFollower
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.physics.model import robot_model
from restock.train.twin.physics.perturbation import Perturbation

CAR = Robot(
    drive="ackermann", wheel_radius_m=0.1, track_m=0.4, wheelbase_m=0.5, mass_kg=40.0,
    max_steering_rad=0.6,
)  # fmt: skip
OUTLINE = Body(0.8, 0.5)
TIGHTEST_M = 0.5 / math.tan(0.6)
CAR_ACTIONS = (
    *((0.0, 0.0), (0.4, 0.0), (1.0, 0.0), (0.8, 0.6), (0.8, -0.6), (0.4, 0.5), (0.4, -0.5)),
    *((-0.4, 0.0), (-0.4, 0.5), (-0.4, -0.5)),
)


@pytest.mark.parametrize("friction", [1.0, 0.25])
def test_ackermann_robot_follows_commands(friction: float) -> None:
    commands = [(1.0, 0.0), (-0.5, 0.0), (0.8, 0.7), (0.4, -0.4), (-0.4, 0.3)]
    sim, steady = drive_steadily(CAR, OUTLINE, commands, friction)
    np.testing.assert_allclose(steady, commands, atol=0.01)
    wheels = np.stack(sim.robot.body_velocity(*sim.wheel_speeds().T), axis=-1)
    np.testing.assert_allclose(wheels, commands, atol=0.02)  # the rear axle's odometry
    assert not sim.diverged.any()


def test_turning_radius_is_limited_by_steering() -> None:
    assert CAR.min_turning_radius_m == pytest.approx(TIGHTEST_M)
    _, steady = drive_steadily(CAR, OUTLINE, [(0.3, 2.0), (0.0, 1.0)])
    assert steady[0] == pytest.approx([0.3, 0.3 / TIGHTEST_M], rel=0.02)
    assert steady[1] == pytest.approx([0.0, 0.0], abs=1e-3)  # the robot stands with turned wheels


def test_steering_rate_is_limited() -> None:
    robot = msgspec.structs.replace(CAR, max_steering_rate_radps=1.0)
    task = Task(body=OUTLINE, actions=((0.0, 0.0), (0.4, 0.5)))
    commands = np.array([[(0.4, 0.5)] * 3 + [(0.0, 0.0)] * 5])  # .6 s, then a stop
    still = {
        name: np.zeros(1)
        for name in (
            *("wheel_speed_mps", "wheel_yaw_rate_radps", "gyro_yaw_rate_radps"),
            *("localised_speed_mps", "localised_lateral_mps"),
        )
    }
    start = OpenLoopStart(np.zeros((1, 3)), still, commands)
    result = drive_open_loop(
        task, start, [Perturbation(latency_s=0.0)], robot=robot_model(robot, OUTLINE)
    )
    turn = result.signals["gyro_yaw_rate_radps"][0, 0]
    # After .2 and .4 s the wheels have steered by .2 and .4 rad, not yet .56 rad.
    assert 0.05 < turn[1] < 0.4 * math.tan(0.2) / 0.5 + 0.01  # the speed ramps up too
    assert 0.25 < turn[2] < 0.4 * math.tan(0.4) / 0.5 + 0.01
    assert turn[-1] == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        ((0.0, 1.2), r"\[0, 1.2\] turns on the spot, which a robot that steers"),
        ((0.4, 0.8), r"a circle of 0.5 m, and the robot's tightest has 0.731 m"),
    ],
)
def test_unsteerable_action_is_rejected(action, message):
    task = msgspec.structs.replace(AMR.task, body=OUTLINE, actions=((0.0, 0.0), action))
    with pytest.raises(ConfigError, match=message):
        WarehouseVectorEnv(1, task=task, robot=CAR)


def test_unsteerable_profile_is_read_from_store_only(tmp_path: Path) -> None:
    """Read such profiles from older stores, whose rows can be learnt from without a twin."""
    text = profile_toml(amr_with('\n[robot]\ndrive = "ackermann"\nwheelbase_m = 0.4\n'))
    (tmp_path / "car.toml").write_text(text)
    with pytest.raises(ConfigError, match="turns on the spot"):
        load_profile(tmp_path / "car.toml")
    assert parse_profile(text, where="a store").robot is not None


def test_planner_drives_ackermann_robot_to_goals() -> None:
    task = msgspec.structs.replace(AMR.task, body=OUTLINE, actions=CAR_ACTIONS)
    env = WarehouseVectorEnv(12, task=task, robot=CAR, seed=7, conditions={"nominal": 1.0})
    observation, _ = env.reset(seed=7)
    policy, ended = PlannerFollower(epsilon=0.0), []
    while len(ended) < 12:
        action, _ = policy.act(env, observation)
        observation, _, terminated, truncated, info = env.step(action)
        done = terminated | truncated
        ended += info["success"][done].tolist()
    assert np.mean(ended) > 0.8
    assert env.diverged == 0


MECANUM = Robot(
    drive="omnidirectional", wheel_radius_m=0.075, track_m=0.4, wheelbase_m=0.4, mass_kg=30.0
)


def test_omnidirectional_robot_follows_commands() -> None:
    commands = [(1.0, 0.0), (-0.5, 0.0), (0.8, 0.7), (0.0, 1.0)]
    _, steady = drive_steadily(MECANUM, Body(0.6, 0.5), commands)
    np.testing.assert_allclose(steady, commands, atol=0.03)


def test_perturbations_apply_to_each_drive_type() -> None:
    """Apply a gain, a smaller wheel and a payload to each drive type."""
    seen = {}
    for robot, body in ((CAR, OUTLINE), (MECANUM, Body(0.6, 0.5))):
        task = Task(body=body, actions=((0.0, 0.0), (0.8, 0.0)))
        motion = dict.fromkeys(
            (
                *("wheel_speed_mps", "wheel_yaw_rate_radps", "gyro_yaw_rate_radps"),
                *("localised_speed_mps", "localised_lateral_mps"),
            ),
            np.zeros(1),
        )
        start = OpenLoopStart(np.zeros((1, 3)), motion, np.full((1, 12, 2), (0.8, 0.0)))
        twins = [
            Perturbation(),
            Perturbation(gain=0.9),
            Perturbation(wheel_radius_scale=0.95),
            Perturbation(left_gain=0.9),
            Perturbation(payload_kg=20.0),
        ]
        result = drive_open_loop(task, start, twins, robot=robot_model(robot, body))
        assert not result.diverged.any()
        distance = result.pose[:, 0, -1, 0] / result.pose[0, 0, -1, 0]
        assert distance[1:3] == pytest.approx([0.9, 0.95], abs=0.015)
        assert distance[4] == pytest.approx(1.0, abs=0.02)
        seen[robot.drive] = result.pose[3, 0, -1, 2]
    assert seen["omnidirectional"] > 0.1  # the left wheels lag, so the robot turns left
    assert abs(seen["ackermann"]) < 0.02  # the front wheels keep it straight
