"""Check plans on the known map, and blocks found by the lidar."""

import numpy as np
import pytest

from restock.train.twin.env.navigation import BlockFinder
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.floors.layout import default_warehouse, edges_of, within
from restock.train.twin.floors.planner import CELL_M, PLAN_POINTS, Planner
from restock.train.twin.missions.mission import length_m
from restock.train.twin.physics.episode import EpisodeSpec, draw_episode

FLOOR = default_warehouse()
PLANNER = Planner(FLOOR)


def test_plans_avoid_racks_and_end_at_goal() -> None:
    rng = np.random.default_rng(3)
    for goal in FLOOR.goals[rng.integers(len(FLOOR.goals), size=20)]:
        area = FLOOR.segments[rng.integers(len(FLOOR.segments))].area
        plan = PLANNER.plan(*area.center, tuple(goal))
        assert plan.shape == (PLAN_POINTS, 2)
        np.testing.assert_allclose(plan[-1], goal)
        assert np.hypot(*(plan[0] - area.center)) < 2 * CELL_M
        assert not within(edges_of(FLOOR.racks), *plan.T, -0.25).any()


def test_plan_length_is_near_shortest() -> None:
    # Aisle 1 west to aisle 3 east through the middle cross-aisle: 2.95 + 5.47 + 2.55 by right
    # angles, which cut corners shorten.
    plan = PLANNER.plan(3.0, 0.9, (8.5, 6.37))
    assert np.hypot(5.5, 5.47) < length_m(plan) < 5.5 + 5.47


def test_plan_avoids_closed_aisle() -> None:
    start, goal = (3.0, 0.9), (8.45, 0.9)
    straight = PLANNER.plan(*start, goal)
    around = PLANNER.plan(*start, goal, [(1, 1)])  # aisle 1 east, .3 to .6 m into it
    assert length_m(around) > length_m(straight) + 3.0
    west = FLOOR.segments[1].area.x_min + 0.45
    near = (np.abs(around[:, 0] - west) < 0.15) & (around[:, 1] < 1.8)
    assert not near.any()


def test_latest_closure_reopens_if_goal_is_unreachable() -> None:
    # Both ends of the goal's aisle segment are closed.
    plan = PLANNER.plan(3.0, 3.6, (8.45, 0.9), [(1, 0), (1, 8)])
    np.testing.assert_allclose(plan[-1], (8.45, 0.9))


@pytest.mark.parametrize("block", ["partial", "full"])
def test_lidar_finds_only_full_blocks(block: str) -> None:
    specs = [EpisodeSpec("blocked_aisle", seed) for seed in range(60)]
    specs = [s for s in specs if draw_episode(s, FLOOR, PLANNER).block == block][:12]
    blocked = 0
    env = WarehouseVectorEnv(len(specs))
    env.set_episodes(specs)
    env.reset()
    driver = _WaypointDriver()
    for _ in range(120):
        env.step(driver.act(env))
        blocked = sum(bool(closures) for closures in env.navigation.closures)
    if block == "full":
        assert blocked >= 0.75 * len(specs)
    else:
        assert blocked == 0


class _WaypointDriver:
    """A driver that follows the near waypoint and stops .5 m before anything."""

    def act(self, env: WarehouseVectorEnv) -> np.ndarray:
        near = np.arctan2(env.signals["waypoint_near_y_m"], env.signals["waypoint_near_x_m"])
        action = np.where(np.abs(near) > 0.3, np.where(near > 0, 7, 8), 1)
        stop = (env.signals["clearance_ahead_m"] < 0.5) & (np.abs(near) < 0.3)
        return np.where(stop, 0, action)


def test_person_is_not_a_block() -> None:
    finder = BlockFinder([FLOOR], 1)
    area = FLOOR.segments[0].area
    pose = np.array([[area.x_min, area.center[1], 0.0]])
    around = np.linspace(-0.25, 0.25, 9)
    hits = np.stack([np.full(9, area.x_min + 1.0), area.center[1] + around], axis=-1)[None]
    look = np.array([0]), pose, hits, np.ones((1, 9), np.bool_), np.ones(1), np.zeros(1, np.bool_)
    for _ in range(10):
        assert not finder.update(*look)
