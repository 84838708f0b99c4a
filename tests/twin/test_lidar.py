"""Compare compiled lidar ranges with MuJoCo's, and check what the lidar sees."""

import math

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.profile_texts import WAREHOUSE

from restock import native
from restock.ingest.profile.profile import load_profile
from restock.ingest.task.robot import Lidar as LidarLimits
from restock.ingest.task.robot import Robot
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.floors.layout import pallet_half_m

needs_native = pytest.mark.skipif(not native.IS_USED, reason=native.state())
TASK = load_profile("warehouse_amr").task
KINDS = {"nominal": 0.2, "wheel_slip": 0.2, "blocked_aisle": 0.3, "near_collision": 0.3}


def environment(layouts: str, robot: Robot | None = None) -> WarehouseVectorEnv:
    """Return eight robots among pallets, people and forklifts, after 30 steps."""
    env = WarehouseVectorEnv(8, task=TASK, robot=robot, layouts=layouts, conditions=KINDS)
    env.reset(seed=5)
    for _ in range(30):
        env.step(np.zeros(8, np.int64))
    return env


@pytest.fixture(scope="module")
def environments() -> list[WarehouseVectorEnv]:
    behind = Robot(lidar=LidarLimits(beams=97, angle_min_rad=-math.pi, angle_max_rad=1.0))
    return [environment("default"), environment("generated:test:3"), environment("default", behind)]


def cast_both_ways(env: WarehouseVectorEnv, monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """Return the ranges (8, beams) of compiled code and of MuJoCo."""
    found = []
    for used in (True, False):
        monkeypatch.setattr(native, "IS_USED", used)
        found.append(env.simulation.cast(np.arange(8)))
    return found


@needs_native
@given(
    which=st.integers(0, 2),
    places=st.lists(
        st.tuples(st.floats(0, 1), st.floats(0, 1), st.floats(-7, 7)), min_size=8, max_size=8
    ),
)
def test_compiled_ranges_match_mujoco(which, places, environments):
    env = environments[which]
    for index, (x, y, yaw) in enumerate(places):
        floor = env.floor_of(index)
        env.simulation.place_robot(index, x * floor.width_m, y * floor.depth_m, yaw)
    with pytest.MonkeyPatch.context() as patch:
        compiled, cast = cast_both_ways(env, patch)
    np.testing.assert_allclose(compiled, cast, rtol=1e-12, atol=1e-12)
    assert np.isfinite(compiled).all()  # the floor is surrounded by walls


@needs_native
def test_lidar_sees_people_pallets_and_forklifts(environments, monkeypatch):
    simulation, floor = environments[0].simulation, environments[0].floor_of(0)
    moving = simulation.scenery
    x, y = floor.goals[0]
    simulation.place_robot(0, x, y, 0.3)
    for kind in (moving.handles.pallets, moving.handles.people, moving.handles.forklifts):
        place = moving.position_m[0, kind.start]
        kept = place.copy()
        place[:] = -40.0, -40.0, 0.3
        without = cast_both_ways(environments[0], monkeypatch)
        place[:] = x + 1.0, y + 0.3, 0.3
        there = cast_both_ways(environments[0], monkeypatch)
        place[:] = kept
        np.testing.assert_allclose(there[0], there[1], rtol=1e-12, atol=1e-12)
        assert (there[0][0] < without[0][0] - 0.1).any()


@needs_native
def test_arrays_of_wrong_shape_or_dtype_are_rejected() -> None:
    place, one, two = np.zeros(2), np.zeros(1), np.zeros(2, np.int64)
    first = np.zeros(1, np.int64)
    arguments = [place, one, place, one, first, first, two, np.zeros(0), np.zeros(6), one.copy()]
    native.compiled.ranges(*arguments)
    for at, wrong, refusal in (
        (0, np.zeros(3), ValueError),
        (4, np.array([1]), IndexError),
        (5, np.array([-1]), IndexError),
        (6, np.array([0, 1]), IndexError),
        (7, np.zeros(3), ValueError),
        (9, np.zeros(1, np.float32), TypeError),
    ):
        with pytest.raises(refusal):
            native.compiled.ranges(*arguments[:at], wrong, *arguments[at + 1 :])


def test_people_and_forklifts_stand_on_the_floor() -> None:
    """Regression: forklifts were .4 m above the floor, where no lidar saw them."""
    env = WarehouseVectorEnv(64, task=TASK, conditions={"near_collision": 1.0})
    env.reset(seed=0)
    simulation, handles = env.simulation, env.simulation.handles
    model, mocap = simulation.model, simulation.scenery.position_m
    for kind in (handles.pallets, handles.people, handles.forklifts):
        body = int(np.flatnonzero(model.body_mocapid == kind.start)[0])
        (geom,) = np.flatnonzero(model.geom_bodyid == body)
        cylinder = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CYLINDER
        half_height_m = model.geom_size[geom, 1 if cylinder else 2]
        np.testing.assert_allclose(mocap[:, kind, 2], half_height_m)
    there = np.flatnonzero(mocap[:, handles.forklifts.start, 0] > 0)
    assert len(there)
    x, y, _ = mocap[there[0], handles.forklifts.start]
    simulation.place_robot(there[0], x - 1.2, y, 0.0)
    assert simulation.cast(there[:1]).min() < 0.7
    for _ in range(8):
        simulation.drive(np.tile([0.5, 0.0], (64, 1)))
        if simulation.bumped[there[0]]:
            break
    assert simulation.bumped[there[0]]


@pytest.mark.parametrize(
    "lidar", [LidarLimits(angle_min_rad=-1.6, angle_max_rad=1.6), LidarLimits(z_m=1.0)]
)
def test_true_clearance_covers_lidar_blind_spot(lidar: LidarLimits) -> None:
    env = WarehouseVectorEnv(1, robot=Robot(lidar=lidar), conditions={"blocked_aisle": 1.0})
    env.reset(seed=2)
    x, y, yaw = env.simulation.pallets[0, 0]
    half = pallet_half_m(np.array([yaw]))[0, 0]
    # The robot's back is .1 m from a pallet.
    env.simulation.place_robot(0, x + half + 0.35 + 0.1, y, 0.0)
    *_, info = env.step(np.zeros(1, np.int64))
    assert "near_collision" in info["true_condition"][0]
    assert env.sensing.true_clearance_m[0] == pytest.approx(0.1, abs=0.02)
    assert info["signals"]["sector_clearance_m"][0, 0] > 0.5  # straight behind


def test_robot_command_shows_lidar_and_warnings(tmp_path, shell):
    robot = "[robot]\ncasters_m = [[0.6, 0.0]]\n[robot.lidar]\nangle_max_rad = 1.5\n"
    text = WAREHOUSE.replace("lidar_x_m = 0.0", "lidar_x_m = -0.5") + robot
    (tmp_path / "amr.toml").write_text(text)
    document = shell.json("twin", "robot", tmp_path / "amr.toml")
    assert {
        key: document["robot"][f"body.{key}"] for key in ("length_m", "width_m", "lidar_x_m")
    } == {
        "length_m": 0.7,
        "width_m": 0.5,
        "lidar_x_m": -0.5,
    }
    assert document["robot"]["lidar.angle_max_rad"] == 1.5
    assert document["outside"] == [
        "the lidar is 0.15 m outside the outline of [task.body]",
        "caster 1 is 0.25 m outside the outline of [task.body]",
    ]
    assert "CHECK" not in shell.out("twin", "robot", "warehouse_amr")
