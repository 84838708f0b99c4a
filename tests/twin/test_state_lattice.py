"""Check the state lattice: gaps that the body fits through, and the yaw that it needs."""

import numpy as np
import pytest

from restock import native
from restock.train.twin.floors.floors import open_floors
from restock.train.twin.floors.layout import default_warehouse
from restock.train.twin.floors.planner import Planner
from restock.train.twin.floors.state_lattice import (
    Motion,
    StateLattice,
    Window,
    box_gap,
    lattice_around,
    near_gap,
    rectangle,
)
from restock.train.twin.missions.mission import length_m

FLOOR = default_warehouse()
AISLE = FLOOR.segments[1].area  # aisle 1 east: x from west to east
BODY = Motion(rectangle(0.7, 0.5), ahead_mps=1.0, back_mps=0.4, turn_radps=1.2)
GOAL = (AISLE.x_max + 1.2, AISLE.center[1])  # in the cross-aisle behind it


def with_gap(gap_m: float, motion: Motion = BODY, goal: tuple[float, float] = GOAL) -> StateLattice:
    """Return aisle 1 east with a pallet at its north rack and a gap of `gap_m` south of it."""
    half = np.array([[0.6, (AISLE.y_max - AISLE.y_min - gap_m) / 2]])
    box = np.array([[AISLE.center[0], AISLE.y_max - half[0, 1], 0.0]])
    planner = Planner(FLOOR)
    start = (AISLE.x_min + 0.2, AISLE.center[1])
    graph = planner.graph_around(*start, goal, box, (half[0, 0], half[0, 1]))
    window = Window.around(box[:, :2], 2.3, planner.shape)
    return lattice_around(FLOOR, graph, box[:, :2], half, goal, 0.4, motion, window)


def test_lattice_avoids_narrow_gap_only() -> None:
    start = (AISLE.x_min + 0.2, AISLE.center[1], 0.0)
    through, around = with_gap(0.9).plan(*start), with_gap(0.45).plan(*start)
    assert through is not None
    assert around is not None
    assert length_m(through) < 1.2 * (GOAL[0] - start[0])
    assert length_m(around) > 2.0 * length_m(through)
    for plan in (through, around):
        np.testing.assert_allclose(plan[-1], GOAL)
        assert np.hypot(*(plan[0] - start[:2])) < 0.15


def test_tight_gap_needs_straight_entry() -> None:
    """Pass a .75 m gap with a .7 x .5 m body in line with it, but not askew."""
    lattice = with_gap(0.75)
    in_gap = (AISLE.center[0], AISLE.y_min + 0.375)
    straight, askew = (lattice.time_s(np.array([*in_gap, yaw])) for yaw in (0.0, 1.2))
    assert askew > straight + 0.5
    assert lattice.time_s(np.array([*in_gap, np.pi])) > straight  # it must reverse out


def test_remaining_time_scales_with_speed() -> None:
    inside = (AISLE.x_max - 0.3, AISLE.center[1])
    assert with_gap(0.9, goal=inside).time_s(np.array([*inside, 1.0])) < 0.3
    slow = Motion(BODY.outline_m, ahead_mps=0.25, back_mps=0.1, turn_radps=0.3)
    pose = np.array([AISLE.x_min + 0.2, AISLE.center[1], 0.0])
    assert with_gap(0.9, slow).time_s(pose) == pytest.approx(4 * with_gap(0.9).time_s(pose))


@pytest.mark.parametrize(("layouts", "way"), [("default", True), ("generated:test", False)])
def test_near_clearance_is_exact(layouts, way, monkeypatch):
    monkeypatch.setattr(native, "IS_USED", way and native.IS_USED)
    floor = open_floors(layouts)[-1]
    rng = np.random.default_rng(0)
    middle = rng.uniform((0.0, 0.0), (floor.width_m, floor.depth_m), (200, 2))
    x, y = np.moveaxis(middle[:, None] + rng.uniform(-0.6, 0.6, (200, 12, 2)), -1, 0)
    own = np.concatenate([middle + 0.5, np.full((200, 2), 0.2)], axis=1)
    own[100:, :2] = np.inf  # absent
    of_own = box_gap(x, y, own[:, :2].T[..., None], own[:, 2:].T[..., None])
    racks = floor.rack_boxes.T
    of_racks = box_gap(x[..., None], y[..., None], racks[:2], racks[2:]).min(axis=-1, initial=9.0)
    exact = np.minimum.reduce([x, floor.width_m - x, y, floor.depth_m - y, of_racks, of_own])
    near = near_gap(floor, own[:, None], x, y, 0.3)
    close = exact < 0.3
    assert 0.2 < close.mean() < 1.0
    np.testing.assert_array_equal(near[close], exact[close])
    assert (near[~close] >= 0.3).all()
