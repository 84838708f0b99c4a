"""Match drives with floors by the poses and by the walls that the lidar saw."""

from dataclasses import replace

import numpy as np
import pytest

from restock.ingest.profile.profile import load_profile
from restock.train.twin.env.drivers import PlannerFollower
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.floors.floors import open_floors
from restock.train.twin.floors.layout import is_free
from restock.train.twin.floors.placed import Drive, drive_of, placed_on

TASK = load_profile("warehouse_amr").task
(FLOOR,) = open_floors("default")
(OTHER,) = open_floors("generated:1")


@pytest.fixture(scope="module")
def drive() -> Drive:
    """Return the drive of a robot on FLOOR among people and pallets, with sensor noise."""
    env = WarehouseVectorEnv(1, task=TASK, seed=5)
    env.reset(seed=5)
    driver = PlannerFollower(epsilon=0.1, seed=5)
    poses, clearances = [], []
    for _ in range(300):
        signals = env.signals
        names = ("pose_x_m", "pose_y_m", "pose_yaw_rad")
        poses.append([float(signals[name][0]) for name in names])
        clearances.append(signals["sector_clearance_m"][0].copy())
        env.step(driver.choose(env))
    return drive_of(TASK, np.array(poses), np.array(clearances))


def test_drive_matches_its_own_floor(drive: Drive) -> None:
    assert placed_on(FLOOR, drive)


def test_other_walls_rule_a_floor_out(drive: Drive) -> None:
    hall = replace(FLOOR, racks=())  # open ground: all of its poses fit
    assert is_free(hall, *drive.places_m.T).all()
    assert not placed_on(hall, drive)
    assert placed_on(hall, Drive(drive.places_m, np.empty((0, 2))))  # without a lidar
    assert not placed_on(OTHER, drive)


def test_shifted_or_rotated_frame_rules_a_floor_out(drive: Drive) -> None:
    x, y, yaw = FLOOR.map_origin
    assert not placed_on(replace(FLOOR, map_origin=(x + 1.5, y, yaw)), drive)
    assert not placed_on(replace(FLOOR, map_origin=(x, y, yaw + 0.4)), drive)
    assert not placed_on(FLOOR, Drive(np.empty((0, 2)), np.empty((0, 2))))
