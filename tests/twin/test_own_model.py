"""A robot's own MuJoCo model in the built one's place: it drives, or what it lacks is said."""

import re
from pathlib import Path

import msgspec
import mujoco
import numpy as np
import pytest
from support.paths import ROOT
from twin.test_robot import AMR, driven

from restock.errors import ConfigError
from restock.ingest.profile.description import MAX_BYTES, mjcf_problem
from restock.ingest.profile.profile import load_profile, profile_toml, read_profile_toml
from restock.ingest.task.robot import Robot
from restock.ingest.task.task import Body
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.physics.model import robot_model
from restock.train.twin.physics.perturbation import Perturbation

PAGE = (ROOT / "docs" / "robot.md").read_text()
MODEL = re.findall(r"```xml\n(.*?)```", PAGE, re.DOTALL)[0]
OUTLINE = Body(0.7, 0.5, lidar_x_m=0.1)


def test_the_model_of_the_page_drives_what_it_is_commanded() -> None:
    robot = Robot(mjcf=MODEL)
    commands = [(1.0, 0.0), (-0.5, 0.0), (0.8, 0.7), (0.0, 1.0)]
    sim, steady = driven(robot, OUTLINE, commands)
    np.testing.assert_allclose(steady, commands, rtol=0.03, atol=0.01)
    odometry = np.stack(sim.robot.body_velocity(*sim.wheel_speeds().T), axis=-1)
    np.testing.assert_allclose(odometry, commands, rtol=0.03, atol=0.01)
    assert sim.robot.mass_kg == pytest.approx(24.0)
    assert (sim.robot.wheel_radius_m, sim.robot.track_m) == (0.1, 0.4)


def test_conditions_and_perturbations_apply_to_it() -> None:
    task = msgspec.structs.replace(AMR.task, body=OUTLINE)
    env = WarehouseVectorEnv(
        8, task=task, robot=Robot(mjcf=MODEL), seed=3, conditions={"wheel_slip": 1.0},
        perturbation=Perturbation(
            payload_kg=20.0, wheel_radius_scale=0.95, left_friction_scale=0.5
        ),
    )  # fmt: skip
    env.reset(seed=3)
    slipped = bumped = 0
    for step in range(60):
        *_, info = env.step(np.full(8, 2 + step % 3))
        slipped += sum("wheel_slip" in text for text in info["true_condition"])
        bumped += int(info["bumps"].sum())
    assert env.diverged == 0
    assert slipped > 5
    assert bumped > 0  # its outline touches racks


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name="lidar"', 'name="laser"', "no site named lidar"),
        ("<freejoint/>", "", "0 free joints, but must have one body, the base"),
        ('pos="0.1 0 0.2"', 'pos="0.2 0 0.2"', "site lidar is 0.20 m ahead"),
        ('<geom type="sphere" size="0.1" mass="1.5"', '<geom size=".1" contype="0" conaffinity="0" '
         'mass="1.5"', "wheel left wheel needs one geom with contacts"),
        ('joint="left hinge" kv="8"', 'joint="left hinge" gear="2" kv="8"', "with gear 1"),
        ('joint="left hinge"', 'joint="nowhere"', "MuJoCo says:"),
        ('kv="8"', 'kv="0.001"', r"it drives .* where 0.50 m/s is commanded"),
    ],
)  # fmt: skip
def test_what_a_model_lacks_is_said_by_name(old: str, new: str, message: str) -> None:
    assert old in MODEL
    with pytest.raises(ConfigError, match=message):
        robot_model(Robot(mjcf=MODEL.replace(old, new)), OUTLINE)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('<mujoco><include file="/etc/passwd"/></mujoco>', "has a <include>"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><mujoco/>', "has a DOCTYPE"),
        ('<mujoco><asset><mesh file="a.stl"/></asset></mujoco>', "has a <mesh>"),
        ('<mujoco><worldbody><replicate count="1000000"/></worldbody></mujoco>', "<replicate>"),
        ('<mujoco><option timestep="10"/></mujoco>', "option timestep='10', which must be from"),
        ("<mujoco>" + "<body>" * 101 + "</body>" * 101 + "</mujoco>", "101 of <body>"),
        ("<robot/>", "is not MJCF: its root is <robot>"),
        ("<mujoco>" + " " * MAX_BYTES + "</mujoco>", "is longer than"),
    ],
)  # fmt: skip
def test_a_hostile_file_is_refused_by_name(text: str, message: str) -> None:
    problem = mjcf_problem(text)
    assert problem is not None
    assert message in problem


def test_it_travels_in_the_profile_without_its_file(tmp_path: Path) -> None:
    (tmp_path / "my_robot.xml").write_text(MODEL)
    text = profile_toml(AMR) + '\n[robot]\nmjcf = "my_robot.xml"\n'
    (tmp_path / "mine.toml").write_text(text)
    profile = load_profile(tmp_path / "mine.toml")
    (tmp_path / "my_robot.xml").unlink()
    carried = read_profile_toml(profile_toml(profile), where="a store")
    assert carried.robot is not None
    assert carried.robot.mjcf == MODEL
    assert carried.hash == AMR.hash  # rows do not depend on it
    with pytest.raises(ConfigError, match=r"my_robot\.xml: .*No such file"):
        load_profile(tmp_path / "mine.toml")
    with pytest.raises(ConfigError, match="relative to its folder"):
        read_profile_toml(text, where="a store")
    (tmp_path / "mine.toml").write_text(text.replace("my_robot", "../my_robot"))
    with pytest.raises(ConfigError, match="is outside the profile's folder"):
        load_profile(tmp_path / "mine.toml")


def test_a_warning_of_mujoco_writes_no_log_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    parent, child = mujoco.MjSpec(), mujoco.MjSpec()
    child.option.gravity = [0, 0, 0]
    child.worldbody.add_body(name="body").add_geom(size=[0.1, 0, 0])
    parent.attach(child, frame=parent.worldbody.add_frame(), prefix="x")
    parent.compile()
    assert not list(tmp_path.iterdir())
