"""Lidar scans to clearance per sector."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from restock.ingest.task.surroundings import MovedMap, SectorMap, outline_reach
from restock.ingest.task.task import Body

BODY = Body(length_m=0.7, width_m=0.5)
POINT = Body(length_m=1e-9, width_m=1e-9)
CIRCLE = np.linspace(-np.pi, np.pi, 360, endpoint=False)


def test_sectors_go_counter_clockwise_from_straight_behind():
    sectors = SectorMap.build(CIRCLE, 4, POINT)
    ranges = np.full((1, 360), 3.0)
    ranges[0, 180 + 45] = 1.0  # 45 degrees to the left of straight ahead
    assert sectors.clearance(ranges, 0.05, 4.0)[0] == pytest.approx([3, 3, 1, 3])


@pytest.mark.filterwarnings("error")
def test_a_range_that_is_a_signalling_nan_is_a_nan():
    ranges = np.full((1, 360), 3.0, np.float32)
    ranges.view(np.uint32)[0, :5] = 0x7F800001  # of a damaged message
    assert SectorMap.build(CIRCLE, 4, POINT).clearance(ranges, 0.05, 4.0)[0, 0] == pytest.approx(3)


def test_a_lidar_that_looks_backward():
    turned = Body(length_m=1e-9, width_m=1e-9, lidar_yaw_rad=np.pi)
    ranges = np.full((1, 360), 3.0)
    ranges[0, 180] = 1.0  # its zero bearing, which is the robot's back
    sectors = SectorMap.build(CIRCLE, 4, turned).clearance(ranges, 0.05, 4.0)[0]
    assert sectors.argmin() in (0, 3)


@pytest.mark.parametrize("nothing", [np.inf, np.nan, 0.0, 0.049, 4.1, -1.0])
def test_no_valid_return_counts_as_free(nothing):
    sectors = SectorMap.build(CIRCLE, 36, BODY)
    assert (sectors.clearance(np.full((2, 360), nothing), 0.05, 4.0) == 4.0).all()


@pytest.mark.parametrize("at_m", [None, (0.0, 0.0), (0.2, 0.15)])
def test_too_close_to_be_measured_is_no_clearance(at_m: tuple[float, float] | None):
    """-inf (REP 117), in the sector of its beam: of a lidar in the middle, and of one beside it."""
    ranges = np.full((2, 360), 2.0)
    ranges[1, 265:275] = -np.inf  # on its left
    if at_m is None:
        found = SectorMap.build(CIRCLE, 36, BODY).clearance(ranges, 0.3, 4.0)
    else:
        found = MovedMap.build(CIRCLE, 36, BODY, at_m).clearance(ranges, 0.3, 4.0)
    left = np.flatnonzero(found[1] != found[0])
    assert found[0].min() > 1.0
    assert (found[1, left] == 0).all()
    assert set(left) <= set(range(22, 30))
    assert len(left)


def test_a_sector_without_beams_is_free():
    front = np.linspace(-0.5, 0.5, 20)
    clearance = SectorMap.build(front, 36, BODY).clearance(np.full((1, 20), 1.0), 0.05, 4.0)[0]
    assert clearance[0] == 4.0
    assert clearance[17:19].max() < 1.0


@given(
    st.integers(2, 40).map(lambda half: 2 * half),
    st.lists(st.floats(0.05, 4.0), min_size=1, max_size=50),
    st.floats(-3, 3),
)
def test_the_smallest_clearance_is_that_of_some_beam(sectors, ranges, first):
    bearings = first + np.arange(len(ranges)) * 0.1
    sector_map = SectorMap.build(bearings, sectors, POINT)
    clearance = sector_map.clearance(np.array([ranges]), 0.05, 4.0)[0]
    assert clearance.min() == pytest.approx(min(ranges), abs=1e-6)
    assert len(clearance) == sectors
    # Each beam's sector is at most as free as the beam.
    sector = ((bearings + np.pi) % (2 * np.pi) * (sectors / (2 * np.pi))).astype(int)
    for beam, range_m in zip(np.minimum(sector, sectors - 1), ranges, strict=True):
        assert clearance[beam] <= range_m + 1e-9


@given(st.floats(-7, 7), st.floats(0.1, 2), st.floats(0.1, 2), st.floats(-0.04, 0.04))
def test_the_reach_ends_on_the_outline(bearing, length, width, lidar_x):
    body = Body(length_m=length, width_m=width, lidar_x_m=lidar_x)
    reach = outline_reach(np.array([bearing]), body)[0]
    x, y = lidar_x + reach * np.cos(bearing), reach * np.sin(bearing)
    on_end = abs(abs(x) - length / 2) < 1e-6 and abs(y) <= width / 2 + 1e-6
    on_side = abs(abs(y) - width / 2) < 1e-6 and abs(x) <= length / 2 + 1e-6
    assert on_end or on_side
