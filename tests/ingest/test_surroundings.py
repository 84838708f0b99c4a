"""Who came nearer between two scans, and what lies on the plan: a scan of points, seen by rays."""

from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.rooms import Disc, ranges_in_room

from restock.ingest.task.surroundings import (
    SectorMap,
    came_nearer,
    plan_distances_m,
    returns_on_plan,
)
from restock.ingest.task.task import Body, Task

TASK = Task(body=Body(length_m=0.7, width_m=0.5), actions=((0.0, 0.0), (1.0, 0.0)))
BEARINGS = (np.arange(360) + 0.5) * (2 * np.pi / 360) - np.pi
SECTORS = SectorMap.build(BEARINGS, TASK.sectors, TASK.body)
PERIOD_S = 0.2


def scan(pose: tuple[float, float, float], discs: list[Disc], walls_m: float = 6.0) -> Any:
    """Return the sector clearances (1, K) in a room."""
    ranges = ranges_in_room(BEARINGS, pose, discs, walls_m)
    return SECTORS.clearance(ranges, TASK.range_min_m, TASK.range_max_m)


def signals(step: int, clearance: Any, forward_m: float, turn_rad: float) -> dict[str, Any]:
    return {
        "stamp_ns": np.array([round((step + 1) * PERIOD_S * 1e9)]),
        "gyro_yaw_rate_radps": np.array([turn_rad / PERIOD_S]),
        "localised_speed_mps": np.array([forward_m / PERIOD_S]),
        "localised_lateral_mps": np.zeros(1),
        "sector_clearance_m": clearance,
    }


def between(
    discs: list[Disc], then: list[Disc], forward_m: float = 0.0, turn: float = 0.0
) -> float:
    """Return what came nearer while the robot drove an arc and things moved to `then`."""
    pose = (forward_m * np.cos(turn / 2), forward_m * np.sin(turn / 2), turn)
    before = signals(0, scan((0.0, 0.0, 0.0), discs), forward_m, turn)
    now = signals(1, scan(pose, then), forward_m, turn)
    return float(came_nearer(TASK, now, [before])[0])


@pytest.mark.parametrize("bearing_deg", range(-175, 180, 23))
@pytest.mark.parametrize("step_m", [0.1, 0.2, 0.3])
def test_who_walks_toward_a_robot_comes_nearer_by_what_they_walk(bearing_deg, step_m):
    way = np.array([np.cos(np.radians(bearing_deg)), np.sin(np.radians(bearing_deg))])
    start, end = ((*(way * far), 0.25) for far in (2.0, 2.0 - step_m))
    came = between([start], [end], 0.0)
    assert step_m - 0.06 < came < step_m + 0.02
    assert between([start], [start]) == 0
    assert between([end], [start]) == 0  # goes away
    assert between([(*(way * 3.4), 0.25)], [(*(way * 3.2), 0.25)]) == 0  # beyond 2 m


@given(
    st.lists(
        st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(0.2, 0.6)), min_size=0, max_size=4
    ),
    st.floats(-0.1, 0.2),
    st.floats(-0.24, 0.24),
    st.floats(1.5, 6.0),
)
@settings(max_examples=150)
def test_standing_things_do_not_come_nearer(discs, forward_m, turn, walls):
    """But for what a sector's breadth leaves open: less than what a walk of .5 m/s adds up to."""
    discs = [disc for disc in discs if np.hypot(disc[0], disc[1]) > disc[2] + 0.5]
    pose = (forward_m * np.cos(turn / 2), forward_m * np.sin(turn / 2), turn)
    before = signals(0, scan((0.0, 0.0, 0.0), discs, walls), forward_m, turn)
    now = signals(1, scan(pose, discs, walls), forward_m, turn)
    assert came_nearer(TASK, now, [before])[0] < 0.1


def over(scans: list[Any]) -> float:
    """Return what came nearer at the last of these scans (1, K) of a robot that stands."""
    *earlier, now = (signals(step, one, 0.0, 0.0) for step, one in enumerate(scans))
    return float(came_nearer(TASK, now, earlier[::-1])[0])


def test_a_flickering_edge_does_not_come_nearer():
    """Chair legs and the rims of things, with something behind them."""
    seen, missed = (scan((0.0, 0.0, 0.0), discs, 2.0) for discs in ([(1.7, 0.3, 0.1)], []))
    assert over([missed, seen]) > 0.2  # of two scans alone it looks so
    assert over([seen, missed, seen]) == 0
    assert over([seen, missed, missed, missed, seen]) == 0


def test_who_comes_on_does_so_against_all_that_was_seen_before():
    at = [scan((0.0, 0.0, 0.0), [(far, 0.0, 0.25)], 3.0) for far in (2.0, 1.8, 1.6, 1.4, 1.2)]
    assert over(at) == pytest.approx(0.2, abs=0.06)


def test_what_is_suddenly_much_nearer_was_hidden_before():
    """Behind a corner, or from a beam that was lost: nobody walks a metre in a step."""
    empty, near = (scan((0.0, 0.0, 0.0), discs, 2.5) for discs in ([], [(1.2, 0.0, 0.25)]))
    assert over([empty, empty, near]) == 0


def test_where_no_beam_came_back_nothing_is_known():
    near = scan((0.0, 0.0, 0.0), [(1.9, 0.0, 0.25)], 3.0)
    lost = np.full_like(near, TASK.range_max_m)
    assert over([lost, near]) == 0


def test_a_slow_lidar_sees_nobody_come():
    """Its scans are held: the last one is then of where the robot was steps ago."""
    at_m = np.arange(8) * 0.15
    scans = [scan((x, 0.0, 0.0), [(3.0, 0.2, 0.4)]) for x in at_m]
    held = [signals(step, scans[step - step % 2], 0.15, 0.0) for step in range(8)]
    for step in range(2, 8):
        assert came_nearer(TASK, held[step], held[:step][::-1])[0] < 0.02


def test_a_return_on_the_plan_is_found():
    near, far = np.array([1.0, 0.0]), np.array([1.8, 0.9])  # a plan that bends left
    at_m = np.array(plan_distances_m(TASK))[:, None]
    beyond = (at_m - TASK.near_m) / (TASK.far_m - TASK.near_m)
    plan = np.where(at_m <= TASK.near_m, at_m * near, near + beyond * (far - near))[None]

    def seen(discs: list[Disc]) -> tuple[float, float]:
        way_m, gap_m = returns_on_plan(TASK, scan((0.0, 0.0, 0.0), discs), plan)
        return float(way_m[0]), float(gap_m[0])

    def way(discs: list[Disc]) -> float:
        return seen(discs)[0]

    assert way([]) == TASK.range_max_m
    assert way([(1.0, 0.0, 0.2)]) == pytest.approx(0.8, abs=0.05)
    assert way([(1.6, 0.68, 0.2)]) == pytest.approx(1.0 + 0.9 - 0.2, abs=0.15)
    assert way([(2.0, -0.3, 0.2)]) == TASK.range_max_m  # straight on, where the plan does not go
    assert way([(0.5, 0.7, 0.2)]) == TASK.range_max_m  # beside it
    free = msgspec.structs.replace(TASK, goal="none")
    ahead = scan((0.0, 0.0, 0.0), [(1.0, 0.0, 0.2)])
    assert [one[0] for one in returns_on_plan(free, ahead, plan)] == [TASK.range_max_m] * 2


def test_the_gap_is_to_the_nearest_beside_the_plan():
    plan = np.stack([np.array(plan_distances_m(TASK)), np.zeros(7)], axis=-1)[None]

    def gap(discs: list[Disc]) -> float:
        return float(returns_on_plan(TASK, scan((0.0, 0.0, 0.0), discs), plan)[1][0])

    assert gap([]) == TASK.range_max_m
    assert gap([(0.9, 0.0, 0.2)]) == pytest.approx(0.0, abs=0.1)
    assert gap([(0.9, 0.8, 0.3)]) == pytest.approx(0.5, abs=0.1)
    assert gap([(0.9, -0.8, 0.3), (0.9, 0.6, 0.2)]) == pytest.approx(0.4, abs=0.1)
    assert gap([(2.0, 0.0, 0.2)]) == TASK.range_max_m  # farther on
