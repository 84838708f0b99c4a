"""The limiter only reduces speed, and more so near obstacles."""

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


def limit_one(
    robot_limits: Limits, command: tuple[float, float], clearance: F64, before: tuple[float, float]
) -> Limited:
    return limit(robot_limits, np.array([command]), np.atleast_2d(clearance), np.array([before]))


@settings(max_examples=80)
@given(limits, speeds, clearances, speeds)
def test_limiter_never_increases_or_reverses_speed(robot_limits, command, clearance, before):
    found = limit_one(robot_limits, command, clearance, before)
    allowed, proposed = found.command[0], np.array(command)
    assert np.isfinite(allowed).all()
    assert (np.abs(allowed) <= np.abs(proposed)).all()
    assert (allowed * proposed >= 0).all()
    assert (np.abs(allowed) <= robot_limits.fastest).all()
    # Acceleration from the command in force stays within its limit.
    gained = np.abs(allowed) - np.maximum(np.array(before) * np.sign(allowed), 0.0)
    assert (gained <= np.array(robot_limits.accel) * robot_limits.period_s + 1e-9).all()
    assert found.intervened[0] == (allowed != proposed).any()


@settings(max_examples=80)
@given(limits, speeds, clearances, clearances, speeds)
def test_more_clearance_never_reduces_speed(robot_limits, command, near, more, before):
    tight = limit_one(robot_limits, command, near, before).command
    roomy = limit_one(
        robot_limits, command, np.minimum(near + more, TASK.range_max_m), before
    ).command
    assert (np.abs(roomy) >= np.abs(tight) - 1e-9).all()


@settings(max_examples=80)
@given(limits, speeds, clearances, speeds)
def test_limiting_twice_changes_nothing(robot_limits, command, clearance, before):
    once = limit_one(robot_limits, command, clearance, before).command[0]
    again = limit_one(robot_limits, tuple(once.tolist()), clearance, before).command[0]
    np.testing.assert_allclose(again, once, atol=2e-6)


@settings(max_examples=60)
@given(st.integers(1, 6), st.data())
def test_robots_are_limited_independently(count: int, data: st.DataObject) -> None:
    rows = [data.draw(st.tuples(speeds, clearances, speeds)) for _ in range(count)]
    together = limit(
        LIMITS,
        np.array([row[0] for row in rows]),
        np.stack([row[1] for row in rows]),
        np.array([row[2] for row in rows]),
    )
    alone = [limit_one(LIMITS, *row) for row in rows]
    assert together.rule.tolist() == [int(limited.rule[0]) for limited in alone]
    np.testing.assert_array_equal(together.command, np.concatenate([a.command for a in alone]))


def test_robot_stops_before_wall() -> None:
    """Drive straight at a wall at full speed and brake at the configured limit."""
    speed, gap_m, slowest = 1.0, 3.0, 3.0
    for _ in range(200):
        clearance = FREE.copy()
        clearance[0, AHEAD] = gap_m
        found = limit_one(LIMITS, (1.0, 0.0), clearance, (speed, 0.0))
        gap_m -= TASK.control_period_s * speed  # a command takes effect one period late
        speed = float(found.command[0, 0])
        slowest = min(slowest, gap_m)
    assert speed == 0.0
    assert RULES[found.rule[0]] == "stop"
    assert LIMITS.stop_m - 0.03 < slowest < LIMITS.stop_m + 0.06


@pytest.mark.parametrize(
    ("command", "sectors", "rule"),
    [
        ((1.0, 0.0), AHEAD, "stop"),
        ((-0.4, 0.0), AHEAD, "none"),  # away from the obstacle
        ((-0.4, 0.0), slice(0, 1), "stop"),  # an obstacle behind
        ((1.0, 0.0), slice(26, 28), "none"),  # along a wall on the left
        ((0.0, 1.2), slice(24, 26), "stop"),  # a corner of the robot would sweep into it
        ((0.0, 0.0), slice(0, 36), "none"),
    ],
)
def test_only_obstacles_in_the_way_limit_speed(
    command: tuple[float, float], sectors: slice, rule: str
) -> None:
    clearance = FREE.copy()
    clearance[0, sectors] = 0.03
    found = limit_one(LIMITS, command, clearance, command)
    assert RULES[found.rule[0]] == rule
    assert found.command[0].any() == (rule == "none" and any(command))


@pytest.mark.parametrize("bad", ["command", "clearance", "before"])
def test_unknown_input_stops_robot(bad: str) -> None:
    command, before, clearance = np.array([[1.0, 0.1]]), np.array([[1.0, 0.1]]), FREE.copy()
    {"command": command, "before": before, "clearance": clearance}[bad][0, 1] = np.nan
    found = limit(LIMITS, command, clearance, before)
    assert not found.command.any()
    assert RULES[found.rule[0]] == "unknown"


def test_limiter_table_does_not_change_profile_hash() -> None:
    text = profile_toml(PROFILE) + "\n[limiter]\nstop_m = 0.3\nmax_speed_mps = 0.5\n"
    profile = parse_profile(text, where="mine")
    assert profile.hash == PROFILE.hash
    robot_limits = Limits.of(profile.task, profile.robot, profile.limiter)
    assert (robot_limits.stop_m, robot_limits.fastest) == (0.3, (0.5, 1.2))
    assert robot_limits.hash != LIMITS.hash
    assert limit_one(robot_limits, (1.0, 0.0), FREE, (0.5, 0.0)).command.tolist() == [[0.5, 0.0]]
