"""The task's observation, action, reward and termination: hand values and invariants."""

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from restock.ingest.profile.profile import load_profile
from restock.ingest.task.task import (
    SIGNALS,
    Body,
    Mirror,
    Rewards,
    Task,
    clearance_ahead,
    localised_velocity,
    nearest_action,
    observe,
    reached_goal,
    reward,
    reward_parts,
    terminated,
    wrap_angle,
    yaw_of,
)

TASK = Task(
    body=Body(length_m=0.7, width_m=0.5),
    actions=((0.0, 0.0), (0.5, 0.0), (1.0, 0.0), (0.0, 1.0), (0.0, -1.0)),
    sectors=4,
)


def signals(count: int = 1, **values: object) -> dict[str, np.ndarray]:
    """Return signals of a robot that stands still in free space, except for these."""
    usual: dict[str, np.ndarray] = {}
    for signal in SIGNALS:
        shape = (count, TASK.sectors) if signal.per_sector else (count,)
        usual[signal.name] = np.zeros(shape, signal.dtype)
    usual["sector_clearance_m"] += 4.0
    for name in ("clearance_m", "clearance_ahead_m", "goal_distance_m", "waypoint_near_x_m"):
        usual[name] += 4.0
    for name, value in values.items():
        usual[name] = np.broadcast_to(value, usual[name].shape).astype(usual[name].dtype)
    return usual


def entry(observation: np.ndarray, name: str) -> float:
    return float(observation[0, TASK.observation_names.index(name)])


def test_observation_by_hand():
    now = signals(
        waypoint_near_x_m=1.0,
        waypoint_near_y_m=1.0,
        waypoint_far_x_m=0.0,
        waypoint_far_y_m=-2.0,
        route_remaining_m=5.0,
        wheel_speed_mps=0.8,
        localised_speed_mps=0.3,
        wheel_yaw_rate_radps=0.5,
        gyro_yaw_rate_radps=0.1,
        localised_lateral_mps=-0.2,
        accel_x_mps2=2.5,
        sector_clearance_m=np.array([[4.0, 1.0, 0.25, 9.0]]),
    )
    before = signals(sector_clearance_m=np.array([[4.0, 4.0, 0.25, 4.0]]))
    found = observe(TASK, now, before, np.array([2]))
    assert found.shape == (1, TASK.observation_size)
    assert found.dtype == np.float32
    half = np.sqrt(0.5)
    assert found[0, :5] == pytest.approx([half, half, -1.0, 0.0, 0.5], abs=1e-6)
    assert found[0, 5:12] == pytest.approx([0.8, 0.1, 0.3, 0.5, 0.4, -0.2, 0.5], abs=1e-6)
    assert found[0, 12:17].tolist() == [0, 0, 1, 0, 0]
    assert found[0, 17:21] == pytest.approx([1.0, 0.5, 0.25, 1.0])
    assert found[0, 21:25] == pytest.approx([0.0, -0.5, 0.0, 0.0])


# Signals whose sign changes if left and right are exchanged.
SIDEWAYS_SIGNALS = (
    "waypoint_near_y_m",
    "waypoint_far_y_m",
    "wheel_yaw_rate_radps",
    "gyro_yaw_rate_radps",
    "localised_lateral_mps",
    "nav_yaw_rate_radps",
)


@given(st.integers(0, 2**32 - 1), st.sampled_from(["warehouse_amr", "turtlebot3"]))
def test_mirror_image_equals_a_mirrored_world(seed, profile):
    task = load_profile(profile).task
    rng = np.random.default_rng(seed)

    def random_signals() -> dict[str, np.ndarray]:
        shape = {True: (6, task.sectors), False: (6,)}
        return {s.name: rng.normal(size=shape[s.per_sector]) * 2 for s in SIGNALS}

    def mirror_signals(original: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        mirrored = {**original, **{name: -original[name] for name in SIDEWAYS_SIGNALS}}
        return {**mirrored, "sector_clearance_m": original["sector_clearance_m"][:, ::-1]}

    now, before = random_signals(), random_signals()
    now["nav_speed_mps"][:2] = np.nan
    previous = rng.integers(len(task.actions), size=6)
    mirror = Mirror.of(task)
    table = np.asarray(task.actions)
    assert np.allclose(table[mirror.action(previous)], table[previous] * (1, -1))
    found = mirror.observation(observe(task, now, before, previous))
    expected = observe(task, mirror_signals(now), mirror_signals(before), mirror.action(previous))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert np.array_equal(mirror.action(np.array([-1, 0])), [-1, 0])


def test_action_without_opposite_has_no_mirror():
    lopsided = msgspec.structs.replace(TASK, actions=((0.0, 0.0), (0.5, 0.0), (0.0, 1.0)))
    with pytest.raises(ValueError, match=r"action 2, turn left 1, has no opposite"):
        Mirror.of(lopsided)


def test_observation_names_match_entries():
    assert len(TASK.observation_names) == TASK.observation_size == len(set(TASK.observation_names))
    found = observe(TASK, signals(wheel_speed_mps=0.7), signals(), np.array([3]))
    assert entry(found, "wheel_speed") == pytest.approx(0.7)
    assert entry(found, "previous_action_3") == 1
    assert entry(found, "clearance_-135deg") == 1
    for task in (load_profile("warehouse_amr").task, load_profile("turtlebot3").task):
        assert len(set(task.observation_names)) == task.observation_size


def test_route_is_not_observed_without_goal():
    task = msgspec.structs.replace(TASK, goal="none")
    found = observe(task, signals(route_remaining_m=7.0), signals(), np.array([0]))
    assert (found[0, :5] == 0).all()
    assert not reached_goal(task, signals(goal_distance_m=0.0)).any()


def test_nearest_action_and_distance():
    speed = np.array([0.0, 0.6, 2.0, 0.1, 0.25, np.float64(0.0)])
    yaw = np.array([0.0, 0.0, 0.0, -0.7, 0.0, 1.0])
    action, residual = nearest_action(TASK, speed, yaw)
    assert action.tolist() == [0, 1, 2, 4, 0, 3]  # 0.25 lies between stop and 0.5: the first wins
    assert residual == pytest.approx([0, 0.1, 1.0, np.hypot(0.1, 0.3), 0.25, 0])


@pytest.mark.parametrize(
    ("values", "progress", "actions", "expected"),
    [
        ({}, 0.0, (0, 0), -0.02),
        ({}, 0.2, (1, 1), 0.18),
        ({}, 7.0, (1, 1), 0.98),  # progress is clipped
        ({}, -7.0, (1, 1), -1.02),
        ({}, 0.0, (1, 0), -0.03),
        ({"clearance_m": 0.1}, 0.0, (0, 0), -0.07),
        ({"bumped": True}, 0.0, (0, 0), -1.02),
        ({"goal_distance_m": 0.4}, 0.0, (0, 0), 4.98),
        ({"wheel_speed_mps": 0.7, "localised_speed_mps": 0.7}, 0.0, (0, 0), -0.07),  # 3.5 m/s2
        # slip of 0.5 m/s
        ({"wheel_speed_mps": 0.5, "localised_speed_mps": 0.0}, 0.0, (0, 0), -0.05),
    ],
)
def test_reward_by_hand(values, progress, actions, expected):
    task = msgspec.structs.replace(TASK, rewards=Rewards(
        progress_per_m=1.0, step=-0.02, action_change=-0.01, tight=-0.05, tight_clearance_m=0.15,
        harsh=-0.05, harsh_mps2=3.0, slip_per_mps=-0.1, goal=5.0, bump=-1.0,
    ))  # fmt: skip
    found = reward(
        task,
        signals(),
        signals(**values),
        np.array([progress]),
        np.array([actions[0]]),
        np.array([actions[1]]),
    )
    assert found.dtype == np.float32
    assert found[0] == pytest.approx(expected, abs=1e-6)


def test_long_bump_is_charged_once():
    def bump(now: bool, after: bool) -> float:
        found = reward_parts(
            TASK,
            signals(bumped=now),
            signals(bumped=after),
            np.zeros(1),
            np.zeros(1, np.int64),
            np.zeros(1, np.int64),
        )
        return float(found["bump"][0])

    assert bump(False, True) == TASK.rewards.bump
    assert bump(True, True) == bump(True, False) == bump(False, False) == 0


def test_nav_command_is_scaled_by_fastest_action():
    # The actions reach 1 m/s and 1 rad/s.
    def nav_entries(**values):
        now = signals() | {name: np.array([value]) for name, value in values.items()}
        return observe(TASK, now, signals(), np.array([0]))[0, -3:].tolist()

    assert TASK.observation_names[-3:] == ["nav_known", "nav_speed", "nav_yaw_rate"]
    assert nav_entries(nav_speed_mps=0.5, nav_yaw_rate_radps=-0.25) == [1, 0.5, -0.25]
    assert nav_entries(nav_speed_mps=9.0, nav_yaw_rate_radps=-9.0) == [1, 2, -2]
    assert nav_entries(nav_speed_mps=0.5, nav_yaw_rate_radps=np.nan) == [0, 0, 0]
    assert nav_entries(nav_speed_mps=np.nan, nav_yaw_rate_radps=0.5) == [0, 0, 0]


def test_bump_terminates_only_if_configured():
    after = signals(bumped=True)
    assert not terminated(TASK, after).any()
    assert terminated(msgspec.structs.replace(TASK, bump_terminates=True), after).all()
    assert load_profile("warehouse_amr").task.bump_terminates
    assert terminated(TASK, signals(goal_distance_m=0.3)).all()


def test_clearance_ahead_is_towards_waypoint():
    sectors = np.array([[1.0, 2.0, 3.0, 4.0, 0.5, 9.0, 9.0, 9.0]])
    task = msgspec.structs.replace(TASK, sectors=8)
    # Straight ahead and slightly left: sector 4 and its neighbours 3 and 5.
    assert clearance_ahead(task, sectors, np.array([1.0]), np.array([0.1])) == pytest.approx([0.5])
    # Straight behind on the right: sector 0 and, across the seam, 7 and 1.
    assert clearance_ahead(task, sectors, np.array([-1.0]), np.array([-0.1])) == pytest.approx(
        [1.0]
    )


@pytest.mark.parametrize(
    ("before", "now", "expected"),
    [
        ({"pose_yaw_rad": 0.0}, {"pose_yaw_rad": 0.3}, (0, 0)),  # a turn in place
        # +x is to the right of a robot that faces +y.
        (
            {"pose_yaw_rad": np.pi / 2},
            {"pose_yaw_rad": np.pi / 2, "pose_y_m": 0.1, "pose_x_m": 0.02},
            (0.5, -0.1),
        ),
    ],
)
def test_localised_velocity_is_in_the_body_frame(before, now, expected):
    after = signals(pose_stamp_ns=200_000_000, **now)
    forward, lateral = localised_velocity(after, signals(**before))
    assert (forward[0], lateral[0]) == pytest.approx(expected)


def test_wheel_speed_is_used_without_new_pose():
    now = signals(wheel_speed_mps=0.7, pose_stamp_ns=5, pose_x_m=1.0)
    forward, lateral = localised_velocity(now, signals(pose_stamp_ns=5))
    assert (forward[0], lateral[0]) == (pytest.approx(0.7), 0)


@given(st.floats(-100, 100))
def test_wrap_angle(angle):
    wrapped = wrap_angle(np.array([angle]))[0]
    assert -np.pi <= wrapped <= np.pi
    assert np.cos(wrapped) == pytest.approx(np.cos(angle), abs=1e-9)
    assert np.sin(wrapped) == pytest.approx(np.sin(angle), abs=1e-9)


rows = arrays(np.float64, (6,), elements=st.floats(-5, 5))


@given(rows, rows, arrays(np.float64, (6, 4), elements=st.floats(0, 6)))
def test_observation_of_row_is_independent_of_others(speed, waypoint, clearance):
    """Observations are vectorised over steps or environments."""
    now = signals(6, wheel_speed_mps=speed, waypoint_near_y_m=waypoint)
    now["sector_clearance_m"] = clearance
    action = np.arange(6) % 5
    together = observe(TASK, now, signals(6), action)
    for index in range(6):
        alone = {name: column[index : index + 1] for name, column in now.items()}
        single = observe(TASK, alone, signals(1), action[index : index + 1])
        assert np.array_equal(single[0], together[index])
    assert np.isfinite(together).all()


def test_task_hash_depends_on_parameters():
    assert TASK.hash == msgspec.json.decode(msgspec.json.encode(TASK), type=Task).hash
    assert msgspec.structs.replace(TASK, near_m=1.1).hash != TASK.hash
    harsher = msgspec.structs.replace(TASK.rewards, bump=-2.0)
    assert msgspec.structs.replace(TASK, rewards=harsher).hash != TASK.hash


def test_yaw_does_not_depend_on_quaternion_norm():
    turn = np.array([0.1, -0.2, 0.5, 0.8])
    yaw = yaw_of(*(turn / np.linalg.norm(turn))[:, None])[0]
    scaled = yaw_of(*np.outer(turn, [1.0, 1e-6, 40.0, 0.0, 1e300, np.nan]))
    assert scaled == pytest.approx([yaw, yaw, yaw, np.nan, np.nan, np.nan], nan_ok=True)
