"""Where along its plan a robot is."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from restock.ingest.task.surroundings import pad_plans, view_route

L_SHAPE = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0]])


def seen(plan, x, y, yaw, distances=(1.0, 2.2)):
    one = np.ones(1)
    return view_route(pad_plans([np.asarray(plan, float)]), x * one, y * one, yaw * one, distances)


def test_look_ahead_on_a_straight_stretch():
    view = seen(L_SHAPE, 1.0, 0.5, 0.0)
    assert view.look_ahead_m[0] == pytest.approx(np.array([[1.0, -0.5], [2.2, -0.5]]))
    assert view.remaining_m == pytest.approx([6.0])
    assert view.offset_m == pytest.approx([0.5])


def test_look_ahead_goes_round_the_corner():
    view = seen(L_SHAPE, 3.5, 0.0, 0.0)
    assert view.look_ahead_m[0] == pytest.approx(np.array([[0.5, 0.5], [0.5, 1.7]]))


def test_beyond_the_end_is_the_end():
    view = seen(L_SHAPE, 4.0, 2.5, 0.0)
    assert view.look_ahead_m[0] == pytest.approx(np.array([[0.0, 0.5], [0.0, 0.5]]))
    assert view.remaining_m == pytest.approx([0.5])


coordinate = st.floats(-20, 20)
plans = st.lists(st.tuples(coordinate, coordinate), min_size=1, max_size=8)


TWICE_AT_THE_ORIGIN = [(7.203125, 0.0), (-1.0, 0.0), (0.0, 2.0**-23), (0.0, 0.0)]


@given(st.lists(plans, min_size=1, max_size=4), coordinate, coordinate, st.floats(-4, 4))
@example([[(0.0, 0.0)] * 6, TWICE_AT_THE_ORIGIN], 0.0, 0.0, 0.0)
def test_padding_changes_nothing(several, x, y, yaw):
    count = len(several)
    arrays = [np.asarray(plan, float) for plan in several]
    at = [np.full(count, value) for value in (x, y, yaw)]
    together = view_route(pad_plans(arrays), *at, (1.0, 2.2))
    for index, plan in enumerate(arrays):
        alone = seen(plan, x, y, yaw)
        assert together.look_ahead_m[index] == pytest.approx(alone.look_ahead_m[0], abs=1e-6)
        assert together.remaining_m[index] == pytest.approx(alone.remaining_m[0], abs=1e-6)


@given(plans, coordinate, coordinate, st.floats(-4, 4))
def test_the_nearest_point_is_the_nearest_and_the_rest_remains(plan, x, y, yaw):
    view = seen(plan, x, y, yaw, (0.0,))
    # A look-ahead of nothing is the nearest point itself.
    assert np.linalg.norm(view.look_ahead_m[0, 0]) == pytest.approx(view.offset_m[0], abs=1e-6)
    points = np.asarray(plan, float)
    dense = np.concatenate([points[:1]] + [np.linspace(a, b, 60) for a, b in pairwise(points)])
    nearest = np.linalg.norm(dense - [x, y], axis=1).min()
    assert view.offset_m[0] <= nearest + 1e-6
    total = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    assert -1e-6 <= view.remaining_m[0] <= total + 1e-6
