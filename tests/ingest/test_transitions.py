"""Transition rows: their contents against the schema and hand values."""

import msgspec
import numpy as np
import pyarrow as pa
import pytest
from support.driven_robot import SPEED_MPS, START_NS, Drive, columns, ragged, without

from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.profile.profile import Profile, load_profile
from restock.ingest.steps.episodes import split, steps_of
from restock.ingest.store.transitions import Provenance, episode_rows, transitions
from restock.ingest.task.schema import STEP_BITS, transition_schema
from restock.process import alone

PROFILE = load_profile("warehouse_amr")
TASK = PROFILE.task
PROVENANCE = Provenance("fedcba9876543210", "0011223344556677", "logs/a.mcap", "0.1.0")


def rows_of(topics: dict[str, TopicColumns], profile: Profile = PROFILE) -> pa.Table:
    steps = steps_of(profile, topics)
    episodes = split(profile.task, steps)
    rows = alone(episode_rows(profile, steps, episodes))
    return transitions(profile, steps, episodes, rows, PROVENANCE)


def vector_column(table: pa.Table, name: str) -> np.ndarray:
    column = table[name].combine_chunks()
    return column.flatten().to_numpy().reshape(len(table), -1)


def test_rows_have_the_store_schema():
    table = rows_of(Drive().topics())
    assert table.schema.equals(transition_schema(TASK.observation_size))
    assert len(table) == 29
    for field in table.schema:
        if not field.nullable:
            assert table[field.name].null_count == 0, field.name


def test_next_observation_equals_observation_of_next_row():
    drive = Drive(goals=[(0.0, 3.0, 1.0), (3.2, 11.0, 1.0)])
    table = rows_of(drive.topics())
    before, after = vector_column(table, "observation"), vector_column(table, "next_observation")
    same = np.array(table["episode_index"])[1:] == np.array(table["episode_index"])[:-1]
    assert same.sum() == 27
    assert np.array_equal(after[:-1][same], before[1:][same])
    # Not across goals: the old episode ends with an observation of the old goal.
    assert not np.array_equal(after[:-1][~same], before[1:][~same])
    distance = TASK.observation_names.index("goal_distance")
    assert after[15, distance] == pytest.approx(0.04, abs=0.001)
    assert before[16, distance] == pytest.approx(0.84, abs=0.001)


def test_progress_follows_plan_of_the_action():
    """A new, longer plan to the same goal is not a loss of progress."""
    topics = Drive().topics()
    x, y = (topics["/plan"].fields[f"poses[].pose.position.{axis}"] for axis in "xy")
    detour_x = [np.array([1.0, 2.0]), np.array([1.0, 2.0]), np.array([11.0, 11.0])]
    detour_y = [np.array([1.0, 1.0]), np.array([1.0, 9.0]), np.array([1.0, 1.0])]
    assert len(x) == len(y) == 1
    topics["/plan"] = columns(
        np.array([0.0, 2.0]),
        {"poses[].pose.position.x": ragged(detour_x), "poses[].pose.position.y": ragged(detour_y)},
    )
    table = rows_of(topics)
    remaining = table["route_remaining_m"].to_numpy()
    assert remaining[10] > remaining[9] + 5
    assert np.abs(table["progress_m"].to_numpy()).max() <= 0.11
    assert len(set(table["episode_index"].to_pylist())) == 1


def test_transition_ids_do_not_depend_on_profile():
    topics = Drive().topics()
    whole = rows_of(topics)["transition_id"].to_numpy()
    assert (whole >> STEP_BITS == int("fedcba9876543210", 16) >> 26).all()
    assert (whole & ((1 << STEP_BITS) - 1)).tolist() == list(range(29))
    assert (whole > 0).all()
    shorter = msgspec.structs.replace(TASK, time_limit_steps=7)
    again = rows_of(topics, msgspec.structs.replace(PROFILE, task=shorter))
    assert np.array_equal(again["transition_id"].to_numpy(), whole)


def test_labels_zone_driver_and_truth_columns():
    drive = Drive(duration_s=4.0, truth="wheel_slip", policies=[(0, '{"policy": "p"}')])
    topics = drive.topics()
    slipping = slice(100, 150)  # wheels at twice the speed from 2 s to 3 s
    topics["/odom"].fields["twist.twist.linear.x"][slipping] = 2 * SPEED_MPS
    table = rows_of(topics)
    slip = np.array([("wheel_slip" in names) for names in table["conditions"].to_pylist()])
    at_s = (table["stamp_ns"].to_numpy() - START_NS) * 1e-9
    assert set(np.flatnonzero(slip)) <= set(np.flatnonzero((at_s > 1.5) & (at_s < 3.3)))
    assert slip.sum() >= 4
    named = np.array(table["condition"].to_pylist())
    assert set(named[slip]) == {"wheel_slip"}
    assert set(named[~slip]) == {"nominal"}
    assert set(table["true_condition"].to_pylist()) == {"wheel_slip"}
    assert set(table["behaviour_policy"].to_pylist()) == {"p"}
    assert table["zone"].to_pylist()[:11] == ["cross_west"] * 11  # up to x = 2.1 m
    assert set(table["zone"].to_pylist()[13:]) == {"aisle_1_west"}


def test_conditions_use_the_last_step_of_an_episode():
    topics = Drive(goals=[(0.0, 3.0, 1.0)]).topics()
    time = (topics["/scan"].log_time_ns - START_NS) * 1e-9
    late = np.repeat(time > 3.15, 72)  # only the end of the episode, at 3.2 s, has the obstacle
    topics["/scan"].fields["ranges"].values[late] = 0.4
    table = rows_of(topics)
    near = ["near_collision" in names for names in table["conditions"].to_pylist()]
    assert near == [False] * 15 + [True]


def test_progress_without_goal_is_forward_displacement():
    profile = msgspec.structs.replace(
        PROFILE, task=msgspec.structs.replace(TASK, goal="none", control_period_s=0.2)
    )
    topics = Drive().topics()
    del topics["/goal_pose"], topics["/plan"]
    table = rows_of(topics, profile)
    assert table["progress_m"].to_numpy() == pytest.approx(np.full(29, 0.1), abs=1e-5)
    assert not vector_column(table, "observation")[:, :5].any()
    assert not np.array(table["terminated"]).any()


@pytest.mark.parametrize("goal", ["route", "none"])
def test_observations_are_finite_for_any_sensor_values(goal):
    rng = np.random.default_rng(0)
    profile = msgspec.structs.replace(PROFILE, task=msgspec.structs.replace(TASK, goal=goal))
    topics = Drive().topics()
    hostile = np.array([np.nan, np.inf, -np.inf, 1e308, -1e308, 1e6, 0.0])
    for topic in ("/odom", "/imu", "/amcl_pose"):
        for path, column in topics[topic].fields.items():
            if path != "header.stamp":
                rows = rng.random(len(column)) < 0.05
                column[rows] = rng.choice(hostile, rows.sum())
    ranges = topics["/scan"].fields["ranges"].values
    ranges[rng.random(len(ranges)) < 0.3] = np.nan
    table = rows_of(topics, profile)
    assert len(table) > 0
    for name in ("observation", "next_observation"):
        assert np.isfinite(vector_column(table, name)).all()
    for name in ("reward", "progress_m", "localised_speed_mps"):
        assert np.isfinite(table[name].to_numpy()).all()


def test_previous_action_is_kept_across_time_limit():
    """At the time limit a new episode starts while driving, not from a stop."""
    profile = msgspec.structs.replace(
        PROFILE, task=msgspec.structs.replace(TASK, time_limit_steps=10)
    )
    table = rows_of(Drive().topics(), profile)
    names = TASK.observation_names
    observation = vector_column(table, "observation")
    assert observation[0, names.index("previous_action_0")] == 1
    assert table["step_index"][10].as_py() == 0
    assert observation[10, names.index("previous_action_1")] == 1


def test_recording_without_usable_steps_gives_no_rows():
    topics = Drive().topics()
    topics["/scan"] = without(topics["/scan"], np.zeros(60, np.bool_))
    table = rows_of(topics)
    assert len(table) == 0
    assert table.schema.equals(transition_schema(TASK.observation_size))
