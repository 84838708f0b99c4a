"""Check robots of profiles in the twin, and that the stand-in is unchanged."""

import hashlib
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from support.paths import ROOT

from restock.errors import ConfigError
from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import (
    Profile,
    load_profile,
    parse_profile,
    profile_toml,
)
from restock.ingest.store.writer import StoreWriter
from restock.ingest.task.robot import Lidar, Robot
from restock.ingest.task.task import Body, Task
from restock.replay.store.store import Store
from restock.train.twin.calibration.logged_steps import robot_of_store
from restock.train.twin.calibration.open_loop import empty_floor
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.floors.layout import Warehouse, default_warehouse
from restock.train.twin.floors.planner import Planner
from restock.train.twin.floors.state_lattice import near_gap, rectangle
from restock.train.twin.physics.episode import Episode, EpisodeSpec, draw_episode, with_room
from restock.train.twin.physics.model import build_model, robot_model
from restock.train.twin.physics.perturbation import Perturbation
from restock.train.twin.physics.robot_model import stand_in
from restock.train.twin.physics.simulation import Simulation

AMR = load_profile("warehouse_amr")
BURGER = Robot(wheel_radius_m=0.033, track_m=0.16, mass_kg=1.0, axle_x_m=0.032, height_m=0.192)
HUSKY = Robot(
    drive="skid_steer", wheel_radius_m=0.165, track_m=0.545, wheelbase_m=0.512, mass_kg=50.0
)
ROBOTS = {
    "burger": (BURGER, Body(0.138, 0.178), 0.22, 2.8),
    "husky": (HUSKY, Body(0.99, 0.67), 1.0, 1.0),
    "by its outline alone": (Robot(), Body(0.5, 0.4), 0.6, 1.0),
}


def drive_steadily(
    robot: Robot | None, body: Body, commands: list[tuple[float, float]], friction: float = 1.0
) -> tuple[Simulation, NDArray[np.float64]]:
    """Return steady forward speeds and yaw rates (N, 2) under commands (N, 2)."""
    task = Task(body=body, actions=((0.0, 0.0), commands[0]))
    model = robot_model(robot, body)
    sim = Simulation(len(commands), task, empty_floor(), 0.01, 1, robot=model)
    for env in range(len(commands)):
        place = Episode(EpisodeSpec("nominal", 0), (30, 30, 0), (1, 1), np.zeros((2, 2)))
        sim.reset(env, place, Perturbation(friction_scale=friction))
    rows = []
    for _ in range(20):
        sim.drive(np.array(commands, np.float64))
        yaw = sim.pose()[:, 2]
        ahead = np.cos(yaw) * sim.qvel[:, 0] + np.sin(yaw) * sim.qvel[:, 1]
        rows.append(np.stack([ahead, sim.qvel[:, 5]], axis=-1))
    return sim, np.mean(rows[15:], axis=0)


def test_stand_in_model_is_unchanged() -> None:
    """Compare a hash of all numbers of the model."""
    model, _ = build_model(default_warehouse(), stand_in(AMR.task.body))
    arrays = [
        np.asarray(getattr(model, name))
        for name in sorted(dir(model))
        if name.startswith(("body_", "geom_", "jnt_", "dof_", "actuator_", "sensor_", "site_"))
        and isinstance(getattr(model, name), np.ndarray)
        and getattr(model, name).dtype == np.float64
    ]
    content = b"".join((np.round(array, 9) + 0.0).tobytes() for array in arrays)
    assert hashlib.sha256(content).hexdigest()[:16] == "6bfb7a4ecdfa934c"


def test_stand_in_drive_is_unchanged() -> None:
    env = WarehouseVectorEnv(6, seed=5)
    observation, _ = env.reset(seed=5)
    rng = np.random.default_rng(1)
    for _ in range(150):
        observation = env.step(rng.integers(0, len(env.task.actions), 6))[0]
    assert observation[0, :7] == pytest.approx(
        [-0.331137, 0.943584, -0.466238, 0.884659, 0.543024, 0.205685, -0.126508], abs=1e-5
    )


@pytest.mark.parametrize("name", ROBOTS)
def test_robot_follows_commands(name: str) -> None:
    robot, body, speed, turn = ROBOTS[name]
    commands = [(speed, 0.0), (-speed / 2, 0.0), (0.0, turn), (0.0, -turn / 2)]
    sim, steady = drive_steadily(robot, body, commands)
    np.testing.assert_allclose(steady, commands, atol=0.06 * max(speed, turn))
    assert steady[0, 0] == pytest.approx(speed, rel=0.02)
    assert steady[2, 1] == pytest.approx(turn, rel=0.03)
    wheels = sim.robot.body_velocity(*sim.wheel_speeds().T)
    np.testing.assert_allclose(wheels[0][:2], [speed, -speed / 2], rtol=0.02)  # its odometry
    assert not sim.diverged.any()


def test_skid_steer_turn_depends_on_friction() -> None:
    """Compare skid steer, whose wheels slide in every turn, with one axle."""
    sim, _ = drive_steadily(HUSKY, Body(0.99, 0.67), [(1.0, 0.0)])
    assert sim.robot.turn_track_m / sim.robot.track_m == pytest.approx(1.96, abs=0.2)
    one_axle = msgspec.structs.replace(HUSKY, drive="differential", wheelbase_m=None)
    turns = {}
    for robot in (HUSKY, one_axle):
        for friction in (1.0, 0.25):
            _, steady = drive_steadily(robot, Body(0.99, 0.67), [(0.8, 0.6)], friction)
            turns[robot.drive, friction] = steady[0, 1]
    assert turns["differential", 0.25] == pytest.approx(turns["differential", 1.0], rel=0.01)
    assert turns["skid_steer", 0.25] > 1.15 * turns["skid_steer", 1.0]


def test_lidar_mounting_follows_profile() -> None:
    """See a wall with the beam that points at it, also if the lidar points backward."""
    body = Body(0.4, 0.4, lidar_x_m=0.1, lidar_yaw_rad=math.pi)
    lidar = Lidar(z_m=0.3, beams=181, angle_min_rad=-math.pi / 2, angle_max_rad=math.pi / 2)
    robot = Robot(axle_x_m=0.05, lidar=lidar)
    task = Task(body=body, actions=((0.0, 0.0), (0.5, 0.0)))
    sim = Simulation(1, task, empty_floor(), 0.01, 1, robot=robot_model(robot, body))
    sim.place_robot(0, 1.0, 30.0, 0.0)  # the wall lies behind it, at x = 0
    sim.batch.forward(np.array([0]))
    ranges = sim.cast(np.array([0]))[0]
    assert len(ranges) == 181
    assert np.argmin(ranges) == 90  # the beam at 0 in the lidar's frame: straight back
    assert ranges[90] == pytest.approx(1.0 + 0.1 - 0.05, abs=1e-6)


@pytest.mark.parametrize("name", ["burger", "husky"])
def test_custom_robot_meets_slip_and_traffic(name: str) -> None:
    robot, body, speed, turn = ROBOTS[name]
    actions = ((0.0, 0.0), (speed, 0.0), (0.5 * speed, turn), (0.0, -turn))
    task = msgspec.structs.replace(AMR.task, body=body, actions=actions)
    kinds = {"wheel_slip": 0.6, "near_collision": 0.2, "blocked_aisle": 0.2}
    env = WarehouseVectorEnv(12, task=task, robot=robot, seed=3, conditions=kinds)
    env.reset(seed=3)
    rng = np.random.default_rng(2)
    truths: list[str] = []
    for _ in range(100):
        *_, info = env.step(rng.integers(0, 4, 12))
        truths += np.unique(info["true_condition"]).tolist()
    assert env.diverged == 0
    assert sum("wheel_slip" in text for text in truths) > 5


@pytest.mark.parametrize("period_s", [0.05, 0.08, 0.12])
def test_short_control_period(period_s: float) -> None:
    robot, body, speed, _ = ROBOTS["burger"]
    task = Task(body=body, actions=((0.0, 0.0), (speed, 0.0)), control_period_s=period_s)
    sim = Simulation(1, task, empty_floor(), 0.01, 1, robot=robot_model(robot, body))
    place = Episode(EpisodeSpec("nominal", 0), (30, 30, 0), (1, 1), np.zeros((2, 2)))
    sim.reset(0, place, Perturbation())
    for _ in range(50):
        sim.drive(np.array([[speed, 0.0]]))
    assert sim.time_s[0] == pytest.approx(50 * period_s)
    assert sim.qpos[0, 0] - 30 == pytest.approx(speed * (50 * period_s - 0.1), rel=0.05)


def test_indivisible_control_period_is_rejected() -> None:
    task = Task(body=Body(0.5, 0.4), actions=((0.0, 0.0),), control_period_s=0.133)
    with pytest.raises(ConfigError, match=r"control_period_s = 0\.133 is not a whole number"):
        Simulation(1, task, empty_floor(), 0.01, 1)


@pytest.mark.parametrize(
    ("robot", "message"),
    [
        (Robot(drive="ackermann", wheelbase_m=0.6), "longer than the outline"),
        (Robot(track_m=2.0), "more than twice the outline's width"),
        (Robot(casters_m=((0.3, 0.0),), axle_x_m=0.2), "tips over"),
    ],
)
def test_unbuildable_robot_is_rejected(robot: Robot, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        robot_model(robot, Body(0.5, 0.4))


def test_robot_wider_than_aisle_is_rejected() -> None:
    task = msgspec.structs.replace(AMR.task, body=Body(2.5, 1.9))
    with pytest.raises(ConfigError, match=r"1\.9 m wide, but aisle_.* only 1\.80 m: it does"):
        WarehouseVectorEnv(1, task=task, robot=Robot())


ROBOT_TOML = """
[robot]
wheel_radius_m = 0.1
mass_kg = 55.0
max_speed_mps = 1.0
[robot.lidar]
beams = 360
[robot.origin]
mass_kg = "urdf"
"lidar.beams" = "logs"
"""


def amr_with(text: str) -> Profile:
    plain = profile_toml(AMR)
    return parse_profile(plain + text, where="here")


def test_profile_carries_robot() -> None:
    profile = amr_with(ROBOT_TOML)
    assert profile.robot is not None
    origins = [
        profile.robot.origin_of(name)
        for name in ("wheel_radius_m", "mass_kg", "track_m", "lidar.beams", "lidar.z_m")
    ]
    assert origins == ["profile", "urdf", "default", "logs", "default"]
    assert parse_profile(profile_toml(profile), where="here") == profile
    assert profile.hash == AMR.hash  # rows do not depend on it
    assert "robot" not in profile_toml(AMR)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("max_speed_mps = 1.0", "max_speed_mps = 0.5", r"beyond robot.max_speed_mps = 0.5 m/s"),
        ("beams = 360", "beans = 360", "beans"),
        ('mass_kg = "urdf"', 'mass = "urdf"', "origin refers to a value"),
        ("mass_kg = 55.0", 'mass_kg = 55.0\ndrive = "ackermann"', "needs wheelbase_m"),
    ],
)
def test_invalid_robot_key_is_named(old: str, new: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        amr_with(ROBOT_TOML.replace(old, new, 1))


@pytest.mark.parametrize("axle_x_m", [0.0, -0.4])
def test_long_robot_does_not_start_in_rack(axle_x_m: float) -> None:
    floor, outline = default_warehouse(), rectangle(1.2, 0.8, axle_x_m, 25)
    planner, turned = Planner(floor), 0
    for seed in range(25):
        drawn = draw_episode(EpisodeSpec("nominal", seed), floor, planner)
        fitted = with_room(drawn, floor, outline)
        assert room_m(fitted, floor, outline) > 0
        assert fitted.start[:2] == drawn.start[:2]  # these aisles are wide enough
        turned += fitted.start != drawn.start
        if room_m(drawn, floor, outline) > 0:
            assert fitted.start == drawn.start
        assert with_room(drawn, floor, rectangle(0.7, 0.5, points=15)).start == drawn.start
    assert turned


def room_m(episode: Episode, floor: Warehouse, outline_m: NDArray[np.float64]) -> float:
    x, y, yaw = episode.start
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    points = (outline_m @ turn + (x, y)).T[:, None]
    return float(near_gap(floor, np.empty((1, 0, 4)), *points, np.inf).min())


def test_changed_robot_retags_the_store(tmp_path: Path) -> None:
    writer = StoreWriter(tmp_path / "store")
    kept = []
    for table in ("", "\n[robot]\nmass_kg = 40.0\n", "\n[robot]\nmass_kg = 45.0\n"):
        profile = amr_with(table)
        outcome = ingest(ROOT / "sample_logs" / "amr_tuesday", profile, store=writer)
        with Store(tmp_path / "store") as store:
            robot = robot_of_store(store, profile.task.hash)
        kept.append((outcome.status, robot.mass_kg if robot else None))
    assert kept[0][1] is None
    assert kept[1:] == [("tagged", 40.0), ("tagged", 45.0)]
