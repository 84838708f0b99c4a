"""From topics to steps: the signals of each tick, and reasons for unusable ticks."""

import numpy as np
import pytest
from msgspec.structs import replace
from support.driven_robot import (
    FREE_M,
    PERIOD_S,
    SPEED_MPS,
    START_NS,
    Drive,
    columns,
    pose,
    without,
)

from restock.ingest.decoding.columns import Ragged
from restock.ingest.profile.profile import load_profile
from restock.ingest.profile.tables import Clock
from restock.ingest.steps.aligned_inputs import fallbacks_used
from restock.ingest.steps.episodes import explain_no_transitions, split, steps_of
from restock.ingest.steps.filling import parse_policy

PROFILE = load_profile("warehouse_amr")


def test_signals_of_a_straight_drive():
    steps = steps_of(PROFILE, Drive().topics())
    assert len(steps) == 30
    assert set(steps.problem) == set(steps.route_problem) == {""}
    now = steps.signals
    at_s = (now["stamp_ns"] - START_NS) * 1e-9
    assert at_s == pytest.approx(0.005 + np.arange(30) * PERIOD_S, abs=1e-6)
    assert now["pose_x_m"] == pytest.approx(1 + SPEED_MPS * np.arange(30) * PERIOD_S)
    assert now["pose_y_m"] == pytest.approx(np.ones(30))
    assert now["localised_speed_mps"] == pytest.approx(np.full(30, SPEED_MPS))
    assert now["goal_distance_m"] == pytest.approx(11 - now["pose_x_m"])
    assert now["route_remaining_m"] == pytest.approx(11 - now["pose_x_m"])
    assert now["waypoint_near_x_m"] == pytest.approx(np.ones(30))
    assert now["waypoint_far_x_m"] == pytest.approx(np.full(30, 2.2))
    front = PROFILE.task.body.length_m / 2 - PROFILE.task.body.lidar_x_m
    assert now["clearance_ahead_m"] == pytest.approx(np.full(30, FREE_M - front), abs=0.02)
    assert set(steps.action) == {1}  # 0.4 m/s straight ahead
    assert steps.residual == pytest.approx(np.zeros(30))
    assert set(steps.policy) == {"planner"}
    assert steps.follows.tolist() == [False] + [True] * 29


def test_steps_do_not_depend_on_later_messages():
    """Truncating the recording after a tick keeps the steps up to it."""
    topics = Drive().topics()
    whole = steps_of(PROFILE, topics)
    for tick in (3, 11, 20):
        end = whole.signals["stamp_ns"][tick] + 2_000_000  # latency of the tick's command
        cut = {name: without(topic, topic.log_time_ns <= end) for name, topic in topics.items()}
        part = steps_of(PROFILE, cut)
        assert len(part) == tick + 1
        for name, column in part.signals.items():
            np.testing.assert_array_equal(column, whole.signals[name][: tick + 1], name)


def test_topic_not_yet_received_is_reported():
    topics = Drive().topics()
    late = (topics["/imu"].log_time_ns - START_NS) * 1e-9
    topics["/imu"] = without(topics["/imu"], late > 1)
    steps = steps_of(PROFILE, topics)
    assert steps.problem[:5] == ["imu: not yet received"] * 5
    assert steps.problem[6] == ""


SPEED = "twist.twist.linear.x"


@pytest.mark.parametrize(
    ("topic", "field", "values", "problem", "ticks"),
    [
        # Invalid numbers at 2 s: the odometry held at one tick.
        *(("/odom", SPEED, (100, 110, bad), "wheels: not finite", 1) for bad in (np.nan, 1e300)),
        # A zero quaternion for one second.
        ("/amcl_pose", "pose.pose.orientation.w", (30, 40, 0.0), "pose: not finite", 5),
        # Angles in degrees, or not filled in, must not count as free space.
        *(
            ("/scan", field, (30, 40, value), "scan: unusable angles", 5)
            for field, value in (
                *(("angle_increment", value) for value in (np.nan, 0.0, 5.0)),
                *(("angle_min", value) for value in (np.nan, -180.0)),
            )
        ),
    ],
)
def test_invalid_values_make_ticks_unusable(topic, field, values, problem, ticks):
    topics = Drive().topics()
    first, last, value = values
    topics[topic].fields[field][first:last] = value
    steps = steps_of(PROFILE, topics)
    assert steps.problem.count(problem) == ticks
    assert set(steps.problem) == {"", problem}
    assert np.isfinite(steps.signals["wheel_speed_mps"]).all()


def test_positions_far_from_origin_are_rejected():
    """UTM northings are finite, but float32 cannot resolve centimetres there."""
    topics = Drive().topics()
    topics["/amcl_pose"].fields["pose.pose.position.y"][:] += 5.2e6
    steps = steps_of(PROFILE, topics)
    assert set(steps.problem) == {"pose: beyond a million"}
    reason, remedy = explain_no_transitions(steps, split(PROFILE.task, steps))
    assert f"pose: beyond a million: {len(steps)} of {len(steps)} ticks" in reason
    assert remedy is not None
    assert "set `origin_m = [X, Y]`" in remedy
    # With an origin near them, poses, goals and plans equal those without the offset.
    for topic, path in (("/goal_pose", "pose.position.y"), ("/plan", "poses[].pose.position.y")):
        column = topics[topic].fields[path]
        (column.values if isinstance(column, Ragged) else column)[:] += 5.2e6
    origin = (0.0, 5.2e6)
    moved = steps_of(replace(PROFILE, origin_m=origin), topics)
    near = steps_of(PROFILE, Drive().topics())
    assert set(moved.problem) == {""}
    assert any("metres from (0, 5200000)" in note for note in moved.notes)
    for name, column in near.signals.items():
        assert moved.signals[name] == pytest.approx(column, abs=1e-6, nan_ok=True), name


def nav_commands(time_s, speed_mps):
    fields = {"linear.x": np.asarray(speed_mps, float), "angular.z": np.full(len(time_s), -0.2)}
    return columns(np.asarray(time_s), fields, stamped=False)


def test_nav_command_is_latest_at_or_before_tick():
    topics = Drive().topics()
    commands_s = 0.005 + np.arange(30) * PERIOD_S  # the ticks
    # One 3 ms before each tick, one at the tick, and one 1 ms after it.
    times = np.sort(np.concatenate([commands_s - 0.003, commands_s, commands_s + 0.001]))
    for keep, expected in (([0, 1, 2], 0.2), ([0, 2], 0.1)):
        chosen = np.isin(np.arange(90) % 3, keep)
        speeds = np.tile([0.1, 0.2, 0.9], 30)
        topics["/cmd_vel_nav"] = nav_commands(times[chosen], speeds[chosen])
        steps = steps_of(PROFILE, topics)
        assert steps.signals["nav_speed_mps"] == pytest.approx(np.full(30, expected))
        assert steps.signals["nav_yaw_rate_radps"] == pytest.approx(np.full(30, -0.2))
        assert not [note for note in steps.notes if "nav_command" in note]


def test_unknown_nav_command_keeps_tick_usable():
    topics = Drive().topics()
    topics["/cmd_vel_nav"] = nav_commands([1.0, 1.2, 1.4, 1.6, 3.0], [0.5, 0.5, np.nan, 0.5, 0.5])
    steps = steps_of(PROFILE, topics)
    known = np.isfinite(steps.signals["nav_speed_mps"])
    assert np.flatnonzero(known).tolist() == [5, 6, 8, 9, 10, 15, 16, 17]
    np.testing.assert_array_equal(known, np.isfinite(steps.signals["nav_yaw_rate_radps"]))
    assert (
        "nav_command: unknown at 22 of 30 ticks (not yet received 5, stale 16, not finite 1)"
        in steps.notes
    )
    assert set(steps.problem) == {""}


def test_repeated_goal_is_not_a_new_goal():
    drive = Drive(goals=[(0.0, 11.0, 1.0), (2.0, 11.0, 1.0), (4.0, 11.0, 1.005)])
    steps = steps_of(PROFILE, drive.topics())
    assert set(steps.routing.goal) == {0}


def test_handover_takes_effect_at_its_tick():
    text = '{"policy": "operator", "version": "2", "probability": 0.5}'
    drive = Drive(policies=[(0.0, "planner"), (2.0, text)])
    steps = steps_of(PROFILE, drive.topics())
    assert steps.policy[:10] == ["planner"] * 10
    assert steps.policy[10:] == ["operator"] * 20
    assert steps.policy_version[9:11] == [None, "2"]
    assert steps.probability[9:11] == [None, 0.5]


def test_parse_policy_accepts_json_or_name():
    assert parse_policy('{"policy": "dqn", "version": 3}') == ("dqn", "3", None)
    assert parse_policy(" planner ") == ("planner", None, None)
    assert parse_policy("") == ("unknown", None, None)
    assert parse_policy("3") == ("3", None, None)
    assert parse_policy('{"policy": null, "probability": 1.0000001}') == ("unknown", None, 1.0)
    for text in ("[" * 100_000, "9" * 5_000):
        assert parse_policy(text) == (text, None, None)


@pytest.mark.parametrize("probability", ["-3", "0", "NaN", '"high"', "9" * 400])
def test_invalid_probability_is_unknown_and_counted(probability):
    texts = [(0.0, f'{{"policy": "dqn", "probability": {probability}}}'), (2.0, "planner")]
    steps = steps_of(PROFILE, Drive(policies=texts).topics())
    assert steps.policy[:10] == ["dqn"] * 10
    assert steps.probability == [None] * 30
    assert (
        "behaviour_policy: the probability at 10 of 30 ticks is not in (0, 1], and is treated as "
        "unknown"
    ) in steps.notes


def test_pose_jump_breaks_episode():
    topics = Drive().topics()
    topics["/amcl_pose"].fields["pose.pose.position.x"][30:] += 3.0
    steps = steps_of(PROFILE, topics)
    assert [reason for reason in steps.break_reason if reason] == [
        "start of the recording",
        "pose jump",
    ]
    # The jump adds no speed.
    assert steps.signals["localised_speed_mps"] == pytest.approx(np.full(30, SPEED_MPS))


def test_longest_action_of_a_fixed_rate_step_counts():
    topics, count = Drive().topics(), np.arange(25)
    # Commands every 0.2 s that drift by 4 ms per tick against the ticks, alternating.
    fields = {"linear.x": np.where(count % 2, 1.0, 0.4), "angular.z": np.zeros(25)}
    topics["/cmd_vel"] = columns(0.005 + count * 0.204, fields, stamped=False)
    steps = steps_of(replace(PROFILE, clock=Clock(steps="rate")), topics)
    assert steps.action[:20].tolist() == [1, 2] * 10


def test_fallbacks_replace_missing_topics():
    topics, time = Drive().topics(), np.arange(0, 6, 0.02)
    topics["/odom"].fields.update(pose("pose.pose", 1 + SPEED_MPS * time, 1.0))
    kept = {name: topics[name] for name in ("/cmd_vel", "/scan", "/imu", "/odom")}
    steps = steps_of(load_profile("turtlebot3"), kept)
    assert set(steps.problem) == set(steps.route_problem) == {""}
    assert not steps.signals["bumped"].any()
    assert set(steps.policy) == {"unknown"}
    assert (steps.signals["goal_distance_m"] == 0).all()
    assert (steps.routing.goal == -1).all()


def test_empty_optional_topic_uses_fallback():
    topics = Drive().topics()
    empty = topics | {"/bumper": without(topics["/bumper"], np.zeros(60, np.bool_))}
    bumper = replace(PROFILE.inputs.bumper, optional=True)
    profile = replace(PROFILE, inputs=replace(PROFILE.inputs, bumper=bumper))
    assert set(steps_of(profile, empty).problem) == {""}
    assert "bumper" in fallbacks_used(profile, empty)
    assert "bumper" not in fallbacks_used(profile, topics)
