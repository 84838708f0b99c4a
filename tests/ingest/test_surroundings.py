"""Lidar scans and plans: clearance, approaching objects, and obstacles on the plan."""

from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support.rooms import Disc, ranges_in_room

from restock.errors import RecordingError
from restock.ingest.decoding.columns import FieldColumn, Ragged, offsets_of, take
from restock.ingest.profile.profile import load_profile
from restock.ingest.profile.tables import Input
from restock.ingest.steps import needs
from restock.ingest.steps.needs import BEAMS, BLIND, SECTORS, UNAIMED, scan_reduction
from restock.ingest.task.surroundings import (
    MovedMap,
    SectorMap,
    came_nearer,
    outline_reach,
    pad_plans,
    plan_distances_m,
    returns_on_plan,
    view_route,
)
from restock.ingest.task.task import Body, Task


def test_last_angle_is_equivalent_to_increment() -> None:
    """foxglove.LaserScan has no increment."""
    fields = scans([120, 9, 1, 0], [-3.1, 0.0, -3.1, 0.0], seed=3)
    first, step = (
        np.asarray(fields[name], np.float64) for name in ("angle_min", "angle_increment")
    )
    ends = {"start": first, "end": first + step * np.array([119, 8, 0, 0])}
    by_last = {"ranges_m": "ranges", "angle_min_rad": "start", "angle_max_rad": "end"}
    source = msgspec.structs.replace(SCAN, fields=by_last)
    found = scan_reduction(SHIPPED, source).apply({"ranges": fields["ranges"], **ends})
    expected = REDUCE.apply(fields | {"angle_min": first, "angle_increment": step})
    for name in (SECTORS, BEAMS, BLIND, UNAIMED):
        assert np.allclose(np.asarray(found[name]), np.asarray(expected[name])), name


BODY = Body(length_m=0.7, width_m=0.5)
POINT = Body(length_m=1e-9, width_m=1e-9)
CIRCLE = np.linspace(-np.pi, np.pi, 360, endpoint=False)


def test_sectors_are_counter_clockwise_from_behind():
    sectors = SectorMap.build(CIRCLE, 4, POINT)
    ranges = np.full((1, 360), 3.0)
    ranges[0, 180 + 45] = 1.0  # 45 degrees to the left of straight ahead
    assert sectors.clearance(ranges, 0.05, 4.0)[0] == pytest.approx([3, 3, 1, 3])


@pytest.mark.filterwarnings("error")
def test_signalling_nan_range_is_treated_as_nan():
    ranges = np.full((1, 360), 3.0, np.float32)
    ranges.view(np.uint32)[0, :5] = 0x7F800001  # as in a damaged message
    assert SectorMap.build(CIRCLE, 4, POINT).clearance(ranges, 0.05, 4.0)[0, 0] == pytest.approx(3)


def test_backward_lidar():
    turned = Body(length_m=1e-9, width_m=1e-9, lidar_yaw_rad=np.pi)
    ranges = np.full((1, 360), 3.0)
    ranges[0, 180] = 1.0  # the lidar's zero bearing, which is behind the robot
    sectors = SectorMap.build(CIRCLE, 4, turned).clearance(ranges, 0.05, 4.0)[0]
    assert sectors.argmin() in (0, 3)


@pytest.mark.parametrize("invalid", [np.inf, np.nan, 0.0, 0.049, 4.1, -1.0])
def test_invalid_ranges_count_as_free(invalid):
    sectors = SectorMap.build(CIRCLE, 36, BODY)
    assert (sectors.clearance(np.full((2, 360), invalid), 0.05, 4.0) == 4.0).all()


@pytest.mark.parametrize("at_m", [None, (0.0, 0.0), (0.2, 0.15)])
def test_minus_infinity_range_is_zero_clearance(at_m: tuple[float, float] | None):
    """Test -inf (REP 117) in its beam's sector, for a central and an off-centre lidar."""
    ranges = np.full((2, 360), 2.0)
    ranges[1, 265:275] = -np.inf  # on the robot's left
    if at_m is None:
        found = SectorMap.build(CIRCLE, 36, BODY).clearance(ranges, 0.3, 4.0)
    else:
        found = MovedMap.build(CIRCLE, 36, BODY, at_m).clearance(ranges, 0.3, 4.0)
    left = np.flatnonzero(found[1] != found[0])
    assert found[0].min() > 1.0
    assert (found[1, left] == 0).all()
    assert set(left) <= set(range(22, 30))
    assert len(left)


def test_sector_without_beams_is_free():
    front = np.linspace(-0.5, 0.5, 20)
    clearance = SectorMap.build(front, 36, BODY).clearance(np.full((1, 20), 1.0), 0.05, 4.0)[0]
    assert clearance[0] == 4.0
    assert clearance[17:19].max() < 1.0


@given(
    st.integers(2, 40).map(lambda half: 2 * half),
    st.lists(st.floats(0.05, 4.0), min_size=1, max_size=50),
    st.floats(-3, 3),
)
def test_minimum_clearance_equals_minimum_range(sectors, ranges, first):
    bearings = first + np.arange(len(ranges)) * 0.1
    sector_map = SectorMap.build(bearings, sectors, POINT)
    clearance = sector_map.clearance(np.array([ranges]), 0.05, 4.0)[0]
    assert clearance.min() == pytest.approx(min(ranges), abs=1e-6)
    assert len(clearance) == sectors
    # Each beam's sector has at most the beam's range as clearance.
    sector = ((bearings + np.pi) % (2 * np.pi) * (sectors / (2 * np.pi))).astype(int)
    for beam, range_m in zip(np.minimum(sector, sectors - 1), ranges, strict=True):
        assert clearance[beam] <= range_m + 1e-9


@given(st.floats(-7, 7), st.floats(0.1, 2), st.floats(0.1, 2), st.floats(-0.04, 0.04))
def test_outline_reach_ends_on_outline(bearing, length, width, lidar_x):
    body = Body(length_m=length, width_m=width, lidar_x_m=lidar_x)
    reach = outline_reach(np.array([bearing]), body)[0]
    x, y = lidar_x + reach * np.cos(bearing), reach * np.sin(bearing)
    on_end = abs(abs(x) - length / 2) < 1e-6 and abs(y) <= width / 2 + 1e-6
    on_side = abs(abs(y) - width / 2) < 1e-6 and abs(x) <= length / 2 + 1e-6
    assert on_end or on_side


SHIPPED = load_profile("warehouse_amr").task
FIELDS = {
    "ranges_m": "ranges",
    "angle_min_rad": "angle_min",
    "angle_increment_rad": "angle_increment",
}
SCAN = Input("/scan", "sensor_msgs/msg/LaserScan", FIELDS)
REDUCE = scan_reduction(SHIPPED, SCAN)


def scans(beams: list[int], firsts: list[float], seed: int) -> dict[str, FieldColumn]:
    rng = np.random.default_rng(seed)
    ranges = rng.uniform(-1, 8, sum(beams)).astype(np.float32)
    ranges[rng.random(len(ranges)) < 0.2] = np.inf
    ranges[rng.random(len(ranges)) < 0.1] = np.nan
    return {
        "ranges": Ragged(ranges, offsets_of(np.array(beams, np.int64))),
        "angle_min": np.array(firsts, np.float32),
        "angle_increment": np.full(len(beams), 0.05, np.float32),
    }


@settings(max_examples=60)
@given(
    st.lists(
        st.tuples(st.sampled_from([0, 1, 9, 120]), st.sampled_from([-3.1, 0.0, np.nan])),
        min_size=1,
        max_size=12,
    ),
    st.integers(0, 12),
    st.sampled_from([1, 100, 1 << 18]),
    st.integers(0, 99),
)
def test_scan_reduction_does_not_depend_on_batch(kinds, at, values, seed):
    fields = scans([beams for beams, _ in kinds], [first for _, first in kinds], seed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(needs, "_VALUES", values)
        whole = REDUCE.apply(fields)
        rows = np.arange(len(kinds))
        parts = [
            REDUCE.apply({name: take(column, part_rows) for name, column in fields.items()})
            for part_rows in (rows[:at], rows[at:])
        ]
    for name in (SECTORS, BEAMS, BLIND, UNAIMED):
        together = np.concatenate([np.asarray(part[name]) for part in parts])
        assert np.array_equal(np.asarray(whole[name]), together)
    for row, (beams, first) in enumerate(kinds):
        expected = np.full(SHIPPED.sectors, SHIPPED.range_max_m)
        blind = beams > 0 and np.isfinite(first)
        if beams and np.isfinite(first):
            bearings = float(np.float32(first)) + float(np.float32(0.05)) * np.arange(beams)
            sectors = SectorMap.build(bearings, SHIPPED.sectors, SHIPPED.body)
            ranges = fields["ranges"]
            assert isinstance(ranges, Ragged)
            ranges_m = np.asarray(ranges[row])[None]
            expected = sectors.clearance(ranges_m, SHIPPED.range_min_m, SHIPPED.range_max_m)[0]
            blind = not (ranges_m >= SHIPPED.range_min_m).any()
        assert np.array_equal(np.asarray(whole[SECTORS])[row], expected)
        assert np.asarray(whole[BEAMS])[row] == beams
        assert np.asarray(whole[BLIND])[row] == blind
        assert np.asarray(whole[UNAIMED])[row] == (beams > 0 and np.isnan(first))


def test_non_scalar_angle_is_reported() -> None:
    fields = scans([30], [-3.0], 4)
    with pytest.raises(RecordingError, match="'angle_min' of /scan is not one number per message"):
        REDUCE.apply({**fields, "angle_min": fields["ranges"]})


L_SHAPE = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0]])


def view_of(plan, x, y, yaw, distances=(1.0, 2.2)):
    ones = np.ones(1)
    return view_route(
        pad_plans([np.asarray(plan, float)]), x * ones, y * ones, yaw * ones, distances
    )


def test_look_ahead_follows_corner_of_plan():
    view = view_of(L_SHAPE, 3.5, 0.0, 0.0)
    assert view.look_ahead_m[0] == pytest.approx(np.array([[0.5, 0.5], [0.5, 1.7]]))


def test_look_ahead_stops_at_end_of_plan():
    view = view_of(L_SHAPE, 4.0, 2.5, 0.0)
    assert view.look_ahead_m[0] == pytest.approx(np.array([[0.0, 0.5], [0.0, 0.5]]))
    assert view.remaining_m == pytest.approx([0.5])


coordinate = st.floats(-20, 20)
plans = st.lists(st.tuples(coordinate, coordinate), min_size=1, max_size=8)


TWICE_AT_THE_ORIGIN = [(7.203125, 0.0), (-1.0, 0.0), (0.0, 2.0**-23), (0.0, 0.0)]


@given(st.lists(plans, min_size=1, max_size=4), coordinate, coordinate, st.floats(-4, 4))
@example([[(0.0, 0.0)] * 6, TWICE_AT_THE_ORIGIN], 0.0, 0.0, 0.0)
def test_padding_does_not_change_route_view(several, x, y, yaw):
    count = len(several)
    arrays = [np.asarray(plan, float) for plan in several]
    at = [np.full(count, value) for value in (x, y, yaw)]
    together = view_route(pad_plans(arrays), *at, (1.0, 2.2))
    for index, plan in enumerate(arrays):
        alone = view_of(plan, x, y, yaw)
        assert together.look_ahead_m[index] == pytest.approx(alone.look_ahead_m[0], abs=1e-6)
        assert together.remaining_m[index] == pytest.approx(alone.remaining_m[0], abs=1e-6)


@given(plans, coordinate, coordinate, st.floats(-4, 4))
def test_offset_and_remaining_length_of_plan(plan, x, y, yaw):
    view = view_of(plan, x, y, yaw, (0.0,))
    # A look-ahead of zero is the nearest point itself.
    assert np.linalg.norm(view.look_ahead_m[0, 0]) == pytest.approx(view.offset_m[0], abs=1e-6)
    points = np.asarray(plan, float)
    dense = np.concatenate([points[:1]] + [np.linspace(a, b, 60) for a, b in pairwise(points)])
    nearest = np.linalg.norm(dense - [x, y], axis=1).min()
    assert view.offset_m[0] <= nearest + 1e-6
    total = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    assert -1e-6 <= view.remaining_m[0] <= total + 1e-6


TASK = Task(body=Body(length_m=0.7, width_m=0.5), actions=((0.0, 0.0), (1.0, 0.0)))
BEARINGS = (np.arange(360) + 0.5) * (2 * np.pi / 360) - np.pi
SECTOR_MAP = SectorMap.build(BEARINGS, TASK.sectors, TASK.body)
PERIOD_S = 0.2


def room_clearance(
    pose: tuple[float, float, float], discs: list[Disc], walls_m: float = 6.0
) -> Any:
    """Return sector clearances (1, K) in a room."""
    ranges = ranges_in_room(BEARINGS, pose, discs, walls_m)
    return SECTOR_MAP.clearance(ranges, TASK.range_min_m, TASK.range_max_m)


def signals(step: int, clearance: Any, forward_m: float, turn_rad: float) -> dict[str, Any]:
    return {
        "stamp_ns": np.array([round((step + 1) * PERIOD_S * 1e9)]),
        "gyro_yaw_rate_radps": np.array([turn_rad / PERIOD_S]),
        "localised_speed_mps": np.array([forward_m / PERIOD_S]),
        "localised_lateral_mps": np.zeros(1),
        "sector_clearance_m": clearance,
    }


def approach_m(
    discs: list[Disc], moved: list[Disc], forward_m: float = 0.0, turn: float = 0.0
) -> float:
    """Return the approach measured while the robot drove an arc and objects moved to `then`."""
    pose = (forward_m * np.cos(turn / 2), forward_m * np.sin(turn / 2), turn)
    before = signals(0, room_clearance((0.0, 0.0, 0.0), discs), forward_m, turn)
    now = signals(1, room_clearance(pose, moved), forward_m, turn)
    return float(came_nearer(TASK, now, [before])[0])


@pytest.mark.parametrize("bearing_deg", range(-175, 180, 23))
@pytest.mark.parametrize("step_m", [0.1, 0.2, 0.3])
def test_approach_of_walking_person(bearing_deg, step_m):
    direction = np.array([np.cos(np.radians(bearing_deg)), np.sin(np.radians(bearing_deg))])
    start, end = ((*(direction * far), 0.25) for far in (2.0, 2.0 - step_m))
    came = approach_m([start], [end], 0.0)
    assert step_m - 0.06 < came < step_m + 0.02
    assert approach_m([start], [start]) == 0
    assert approach_m([end], [start]) == 0  # moves away
    assert approach_m([(*(direction * 3.4), 0.25)], [(*(direction * 3.2), 0.25)]) == 0  # beyond 2 m


@given(
    st.lists(
        st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(0.2, 0.6)), min_size=0, max_size=4
    ),
    st.floats(-0.1, 0.2),
    st.floats(-0.24, 0.24),
    st.floats(1.5, 6.0),
)
@settings(max_examples=150)
def test_standing_objects_do_not_approach(discs, forward_m, turn, walls):
    """Sector width leaves an error below the approach of a person at 0.5 m/s."""
    discs = [disc for disc in discs if np.hypot(disc[0], disc[1]) > disc[2] + 0.5]
    pose = (forward_m * np.cos(turn / 2), forward_m * np.sin(turn / 2), turn)
    before = signals(0, room_clearance((0.0, 0.0, 0.0), discs, walls), forward_m, turn)
    now = signals(1, room_clearance(pose, discs, walls), forward_m, turn)
    assert came_nearer(TASK, now, [before])[0] < 0.1


def last_approach_m(scans: list[Any]) -> float:
    """Return the approach at the last of these scans (1, K) of a standing robot."""
    *earlier, now = (signals(step, clearance, 0.0, 0.0) for step, clearance in enumerate(scans))
    return float(came_nearer(TASK, now, earlier[::-1])[0])


def test_flickering_edge_does_not_approach():
    """Chair legs and edges flicker against the background."""
    visible, missed = (
        room_clearance((0.0, 0.0, 0.0), discs, 2.0) for discs in ([(1.7, 0.3, 0.1)], [])
    )
    assert last_approach_m([missed, visible]) > 0.2  # two scans alone look like an approach
    assert last_approach_m([visible, missed, visible]) == 0
    assert last_approach_m([visible, missed, missed, missed, visible]) == 0


def test_steady_approach_is_measured_against_all_scans():
    at = [
        room_clearance((0.0, 0.0, 0.0), [(far, 0.0, 0.25)], 3.0)
        for far in (2.0, 1.8, 1.6, 1.4, 1.2)
    ]
    assert last_approach_m(at) == pytest.approx(0.2, abs=0.06)


def test_sudden_large_approach_is_ignored():
    """The object was behind a corner or in a lost beam: nobody walks a metre in one step."""
    empty, near = (
        room_clearance((0.0, 0.0, 0.0), discs, 2.5) for discs in ([], [(1.2, 0.0, 0.25)])
    )
    assert last_approach_m([empty, empty, near]) == 0


def test_sector_without_return_gives_no_approach():
    near = room_clearance((0.0, 0.0, 0.0), [(1.9, 0.0, 0.25)], 3.0)
    lost = np.full_like(near, TASK.range_max_m)
    assert last_approach_m([lost, near]) == 0


def test_held_scans_give_no_approach():
    """Held scans show the surroundings of the robot's position some steps earlier."""
    at_m = np.arange(8) * 0.15
    scans = [room_clearance((x, 0.0, 0.0), [(3.0, 0.2, 0.4)]) for x in at_m]
    held = [signals(step, scans[step - step % 2], 0.15, 0.0) for step in range(8)]
    for step in range(2, 8):
        assert came_nearer(TASK, held[step], held[:step][::-1])[0] < 0.02


def test_return_on_plan_is_found():
    near, far = np.array([1.0, 0.0]), np.array([1.8, 0.9])  # a plan that bends left
    at_m = np.array(plan_distances_m(TASK))[:, None]
    beyond = (at_m - TASK.near_m) / (TASK.far_m - TASK.near_m)
    plan = np.where(at_m <= TASK.near_m, at_m * near, near + beyond * (far - near))[None]

    def distance_and_gap(discs: list[Disc]) -> tuple[float, float]:
        distance_m, gap_m = returns_on_plan(TASK, room_clearance((0.0, 0.0, 0.0), discs), plan)
        return float(distance_m[0]), float(gap_m[0])

    def distance(discs: list[Disc]) -> float:
        return distance_and_gap(discs)[0]

    assert distance([]) == TASK.range_max_m
    assert distance([(1.0, 0.0, 0.2)]) == pytest.approx(0.8, abs=0.05)
    assert distance([(1.6, 0.68, 0.2)]) == pytest.approx(1.0 + 0.9 - 0.2, abs=0.15)
    assert distance([(2.0, -0.3, 0.2)]) == TASK.range_max_m  # straight ahead, off the plan
    assert distance([(0.5, 0.7, 0.2)]) == TASK.range_max_m  # beside the plan
    free = msgspec.structs.replace(TASK, goal="none")
    ahead = room_clearance((0.0, 0.0, 0.0), [(1.0, 0.0, 0.2)])
    assert [values[0] for values in returns_on_plan(free, ahead, plan)] == [TASK.range_max_m] * 2


def test_gap_is_to_nearest_return_beside_plan():
    plan = np.stack([np.array(plan_distances_m(TASK)), np.zeros(7)], axis=-1)[None]

    def gap(discs: list[Disc]) -> float:
        return float(returns_on_plan(TASK, room_clearance((0.0, 0.0, 0.0), discs), plan)[1][0])

    assert gap([]) == TASK.range_max_m
    assert gap([(0.9, 0.0, 0.2)]) == pytest.approx(0.0, abs=0.1)
    assert gap([(0.9, 0.8, 0.3)]) == pytest.approx(0.5, abs=0.1)
    assert gap([(0.9, -0.8, 0.3), (0.9, 0.6, 0.2)]) == pytest.approx(0.4, abs=0.1)
    assert gap([(2.0, 0.0, 0.2)]) == TASK.range_max_m  # beyond the considered length
