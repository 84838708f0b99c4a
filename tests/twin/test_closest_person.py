"""Check the distance from the robot to the closest person or forklift."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from restock.train.twin.floors.layout import FORKLIFT_HALF_M, PARKED_M, PEOPLE, PERSON_RADIUS_M
from restock.train.twin.physics.scenery import HIDDEN, WALKING, Traffic

ROBOT_HALF_M = (0.35, 0.25)
places = st.floats(-4.0, 4.0)
angles = st.floats(-3.1, 3.1)


def outline(x: float, y: float, yaw: float, half: tuple[float, float]) -> np.ndarray:
    """Return points along the edge of a rectangle."""
    along = np.linspace(-1, 1, 201)
    edge = np.full_like(along, 1.0)
    local = np.concatenate(
        [np.stack(side, -1) for side in ((along, edge), (along, -edge), (edge, along))]
        + [np.stack((-edge, along), -1)]
    ) * np.array(half)
    cos, sin = np.cos(yaw), np.sin(yaw)
    turned: np.ndarray = local @ np.array([[cos, sin], [-sin, cos]]) + (x, y)
    return turned


def closest(
    robot: tuple[float, float, float], agents: dict[int, tuple[float, float, float]]
) -> Traffic:
    traffic = Traffic(1, ROBOT_HALF_M)
    traffic.active[0] = True
    traffic.closest_m[0] = np.inf
    traffic.position_m[0] = PARKED_M[0]
    for agent, (x, y, heading) in agents.items():
        traffic.state[0, agent] = WALKING
        traffic.position_m[0, agent], traffic.heading_rad[0, agent] = (x, y), heading
    pose = np.array([robot])
    traffic.note_closest(pose)
    return traffic


@settings(max_examples=60)
@given(places, places, angles, places, places, angles, st.booleans())
def test_distance_matches_outlines(x, y, yaw, px, py, heading, truck):
    found = closest((x, y, yaw), {PEOPLE if truck else 0: (px, py, heading)}).closest_m[0]
    mine = outline(x, y, yaw, ROBOT_HALF_M)
    if truck:
        theirs = outline(px, py, heading, FORKLIFT_HALF_M[:2])
        true = np.hypot(*(mine[:, None] - theirs[None]).transpose(2, 0, 1)).min()
    else:
        true = np.hypot(*(mine - (px, py)).T).min() - PERSON_RADIUS_M
    if true > 0.4:  # closer, the outlines may overlap
        assert found == pytest.approx(true, abs=2e-3)
    assert found <= max(true, 0) + 2e-3


def test_hidden_people_do_not_count_as_closest() -> None:
    traffic = closest((0.0, 0.0, 0.0), {0: (1.6, 0.0, 0.0), 1: (0.0, 2.5, 0.0)})
    assert traffic.closest_m[0] == pytest.approx(1.6 - 0.35 - PERSON_RADIUS_M)
    traffic.position_m[0, 0] = (9.0, 9.0)
    traffic.note_closest(np.zeros((1, 3)))
    assert traffic.closest_m[0] == pytest.approx(1.0)
    traffic.state[0] = HIDDEN
    traffic.closest_m[0] = np.inf
    traffic.note_closest(np.zeros((1, 3)))
    assert np.isinf(traffic.closest_m[0])
