"""The limiter takes speed away and never adds any, the more the nearer something is."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from restock.arrays import F64
from restock.ingest.profile.profile import load_profile, parse_profile, profile_toml
from restock.ingest.task.robot import RULES, Limited, Limiter, Limits, Robot, limit

PROFILE = load_profile("warehouse_amr")
TASK = PROFILE.task
LIMITS = Limits.of(TASK)
FREE = np.full((1, TASK.sectors), TASK.range_max_m)
AHEAD = slice(TASK.sectors // 2 - 1, TASK.sectors // 2 + 1)  # the two sectors straight ahead

speeds = st.tuples(st.floats(-3, 3), st.floats(-3, 3))
clearances = arrays(np.float64, TASK.sectors, elements=st.floats(0, TASK.range_max_m))
limits = st.builds(
    Limits.of,
    st.just(TASK),
    st.builds(
        Robot,
        max_accel_mps2=st.none() | st.floats(0.1, 5),
        max_yaw_accel_radps2=st.none() | st.floats(0.1, 5),
        max_speed_mps=st.none() | st.floats(0.1, 2),
        axle_x_m=st.floats(-0.3, 0.3),
    ),
    st.builds(Limiter, stop_m=st.floats(0, 0.5), reaction_s=st.floats(0, 1)),
)


def one(
    of: Limits, command: tuple[float, float], clearance: F64, before: tuple[float, float]
) -> Limited:
    return limit(of, np.array([command]), np.atleast_2d(clearance), np.array([before]))


@settings(max_examples=80)
@given(limits, speeds, clearances, speeds)
def test_limited_speeds_never_grow_or_turn_round(of, command, clearance, before):
    found = one(of, command, clearance, before)
    allowed, proposed = found.command[0], np.array(command)
    assert np.isfinite(allowed).all()
    assert (np.abs(allowed) <= np.abs(proposed)).all()
    assert (allowed * proposed >= 0).all()
    assert (np.abs(allowed) <= of.fastest).all()
    # It accelerates no faster than it may, from what was in force.
    gained = np.abs(allowed) - np.maximum(np.array(before) * np.sign(allowed), 0.0)
    assert (gained <= np.array(of.accel) * of.period_s + 1e-9).all()
    assert found.intervened[0] == (allowed != proposed).any()


@settings(max_examples=80)
@given(limits, speeds, clearances, clearances, speeds)
def test_more_room_never_means_less_speed(of, command, near, more, before):
    tight = one(of, command, near, before).command
    roomy = one(of, command, np.minimum(near + more, TASK.range_max_m), before).command
    assert (np.abs(roomy) >= np.abs(tight) - 1e-9).all()


@settings(max_examples=80)
@given(limits, speeds, clearances, speeds)
def test_what_was_allowed_is_allowed_again(of, command, clearance, before):
    once = one(of, command, clearance, before).command[0]
    again = one(of, tuple(once.tolist()), clearance, before).command[0]
    np.testing.assert_allclose(again, once, atol=2e-6)


@settings(max_examples=60)
@given(st.integers(1, 6), st.data())
def test_robots_do_not_see_each_other(count: int, data: st.DataObject) -> None:
    rows = [data.draw(st.tuples(speeds, clearances, speeds)) for _ in range(count)]
    together = limit(
        LIMITS,
        np.array([row[0] for row in rows]),
        np.stack([row[1] for row in rows]),
        np.array([row[2] for row in rows]),
    )
    alone = [one(LIMITS, *row) for row in rows]
    assert together.rule.tolist() == [int(each.rule[0]) for each in alone]
    np.testing.assert_array_equal(together.command, np.concatenate([a.command for a in alone]))


def test_it_comes_to_a_stand_before_a_wall() -> None:
    """Driven straight at a wall at full speed, braking as hard as it is said to."""
    speed, gap_m, slowest = 1.0, 3.0, 3.0
    for _ in range(200):
        clearance = FREE.copy()
        clearance[0, AHEAD] = gap_m
        found = one(LIMITS, (1.0, 0.0), clearance, (speed, 0.0))
        gap_m -= TASK.control_period_s * speed  # the command takes force a period late
        speed = float(found.command[0, 0])
        slowest = min(slowest, gap_m)
    assert speed == 0.0
    assert RULES[found.rule[0]] == "stop"
    assert LIMITS.stop_m - 0.03 < slowest < LIMITS.stop_m + 0.06


@pytest.mark.parametrize(
    ("command", "sectors", "rule"),
    [
        ((1.0, 0.0), AHEAD, "stop"),
        ((-0.4, 0.0), AHEAD, "none"),  # away from it
        ((-0.4, 0.0), slice(0, 1), "stop"),  # what is behind
        ((1.0, 0.0), slice(26, 28), "none"),  # along a wall on the left
        ((0.0, 1.2), slice(24, 26), "stop"),  # a corner would sweep into it
        ((0.0, 0.0), slice(0, 36), "none"),
    ],
)
def test_what_counts_is_in_the_way(command: tuple[float, float], sectors: slice, rule: str) -> None:
    clearance = FREE.copy()
    clearance[0, sectors] = 0.03
    found = one(LIMITS, command, clearance, command)
    assert RULES[found.rule[0]] == rule
    assert found.command[0].any() == (rule == "none" and any(command))


@pytest.mark.parametrize("bad", ["command", "clearance", "before", "stale"])
def test_what_is_not_known_is_a_stop(bad: str) -> None:
    command, before, clearance = np.array([[1.0, 0.1]]), np.array([[1.0, 0.1]]), FREE.copy()
    {"command": command, "before": before, "clearance": clearance}.get(bad, FREE.copy())[0, 1] = (
        np.nan
    )
    stale = np.array([bad == "stale"])
    found = limit(LIMITS, command, clearance, before, stale)
    assert not found.command.any()
    assert RULES[found.rule[0]] == "unknown"


def test_limits_of_a_profile_do_not_change_rows() -> None:
    text = profile_toml(PROFILE) + "\n[limiter]\nstop_m = 0.3\nmax_speed_mps = 0.5\n"
    profile = parse_profile(text, where="mine")
    assert profile.hash == PROFILE.hash
    of = Limits.of(profile.task, profile.robot, profile.limiter)
    assert (of.stop_m, of.fastest) == (0.3, (0.5, 1.2))
    assert of.hash != LIMITS.hash
    assert one(of, (1.0, 0.0), FREE, (0.5, 0.0)).command.tolist() == [[0.5, 0.0]]
