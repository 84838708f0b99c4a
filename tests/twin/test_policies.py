"""Check the scripted drivers: success rates, handovers and action probabilities."""

from collections import Counter

import msgspec
import numpy as np
import pytest
from support.long import one_in

from restock.ingest.profile.profile import load_profile
from restock.ingest.task.task import Body, Task
from restock.train.twin.env.drivers import (
    BehaviourPolicy,
    Handover,
    Operator,
    PlannerFollower,
    RandomPolicy,
)
from restock.train.twin.env.vector_env import WarehouseVectorEnv
from restock.train.twin.floors.layout import Rect, Warehouse
from restock.train.twin.physics.episode import EpisodeSpec


def success(
    policy: BehaviourPolicy,
    kind: str,
    count: int = 24,
    task: Task | None = None,
    layouts: str = "default",
) -> dict[str, float]:
    """Return success by block kind ('none' outside blocked aisles), over fixed episodes."""
    env = WarehouseVectorEnv(count, task=task, layouts=layouts)
    env.set_episodes([EpisodeSpec(kind, 500 + index) for index in range(count)])
    observation, _ = env.reset(seed=0)
    result: dict[int, tuple[str, bool]] = {}
    while len(result) < count:
        action, _ = policy.act(env, observation)
        observation, _, terminated, truncated, info = env.step(action)
        for index in np.flatnonzero(terminated | truncated):
            number = int(info["episode_number"][index])
            if number >= 0:
                result[number] = (str(info["block"][index]), bool(info["success"][index]))
    kinds = {block for block, _ in result.values()}
    return {k: float(np.mean([ok for block, ok in result.values() if block == k])) for k in kinds}


@pytest.mark.long
def test_planner_is_stuck_in_partly_blocked_aisles() -> None:
    assert success(PlannerFollower(), "nominal")["none"] >= 0.95
    blocked = success(PlannerFollower(), "blocked_aisle")
    assert blocked["partial"] <= 0.3
    assert blocked["full"] >= 0.8  # it finds the block and goes around


KINDS = ["near_collision", "wheel_slip", "blocked_aisle", "nominal"]


@pytest.mark.parametrize("kind", one_in(2, KINDS))
def test_operator_mostly_succeeds_in_every_condition(kind: str) -> None:
    # 24 episodes: 4 to 10 points of noise below what benchmarks/drivers.py asks over 100.
    assert min(success(Operator(), kind).values()) >= 0.8


@pytest.mark.long
@pytest.mark.parametrize("layouts", ["default", "generated:test"])
def test_operator_gets_past_pallets(layouts: str) -> None:
    """Drive through the gap if there is one, else around the block."""
    passed = success(Operator(epsilon=0.0), "blocked_aisle", layouts=layouts)
    assert min(passed.values()) >= 0.9


class CountingHandover(Handover):
    """Planner and operator with a counter of handovers, keyed by `to_operator`."""

    def __init__(self) -> None:
        super().__init__(PlannerFollower(), Operator())
        self.passed = Counter[bool]()

    def _pass(self, robots: np.ndarray, *, to_operator: bool) -> None:
        self.passed[to_operator] += int(robots.sum())
        super()._pass(robots, to_operator=to_operator)


@pytest.mark.long
def test_operator_takes_over_and_hands_back() -> None:
    policy = CountingHandover()
    assert success(policy, "blocked_aisle")["partial"] >= 0.5
    assert policy.passed[True] >= 8
    assert policy.passed[False] >= 5


def test_nominal_aisles_need_no_handover() -> None:
    policy = CountingHandover()
    success(policy, "nominal", count=12)
    assert policy.passed.total() <= 2


@pytest.mark.parametrize("make", [PlannerFollower, Operator, RandomPolicy])
def test_reported_probabilities_match_actions(make: type[PlannerFollower]) -> None:
    env = WarehouseVectorEnv(64)
    env.reset(seed=1)
    policy = make(seed=3)
    count = len(env.task.actions)
    chosen = make(seed=4).choose(env)
    certain = policy.certain(env)
    for _ in range(20):
        action, probability = policy.act(env, env.observation)
        assert (probability > 0).all()
        epsilon = np.where(certain, 0.0, policy.epsilon)
        expected = epsilon / count + np.where(action == chosen, 1 - epsilon, 0.0)
        if make is not Operator:  # its attempts while standing still are drawn separately
            np.testing.assert_allclose(probability, expected)
        assert (policy.acting == policy.name).all()


def test_lattice_guides_stuck_operator() -> None:
    """Regression: a robot with a Neato's outline was stuck before passages of .5 m."""
    env = WarehouseVectorEnv(4, conditions={"nominal": 1.0})
    first = Operator(seed=6)
    observation, _ = env.reset(seed=3)
    action = first.act(env, observation)[0]
    pose = env.simulation.pose()
    assert not len(first._near_pallets(env, pose))
    first._note_stuck(env, pose, np.array([1, 2]))
    assert first._near_pallets(env, pose).tolist() == [1, 2]
    np.testing.assert_allclose(first._ways[1, -1], env.navigation.goals_m[1], atol=0.15)
    second = Operator(seed=1)
    second.load_state_dict(first.state_dict())
    for step in range(240):
        observation, *_ = env.step(action)
        action = first.act(env, observation)[0]
        np.testing.assert_array_equal(action, second.act(env, observation)[0])
        if step > 60 and (env.episodes_begun >= 2).all():
            break
    assert (env.episodes_begun >= 2).all()
    assert np.isnan(first._stuck_m).all()


def test_slow_moving_robot_is_not_stuck() -> None:
    """Drive so slowly that the robot moves less than .1 m in the steps of the stuck check."""
    task = load_profile("warehouse_amr").task
    slow = tuple((0.28 * v, w) for v, w in task.actions)
    task = msgspec.structs.replace(task, actions=slow)
    env = WarehouseVectorEnv(4, conditions={"nominal": 1.0}, task=task)
    operator = Operator(epsilon=0.0)
    env.reset(seed=3)
    creep = 1  # ahead at .11 m/s
    backwards = np.zeros(len(slow), np.bool_)
    backwards[[v < 0 for v, _ in slow]] = True
    for _ in range(12):
        action, _ = operator.act(env, np.zeros(0, np.float32))
        assert not backwards[action].any()
        env.step(np.full(4, creep))


def small_slow_robot() -> Task:
    """Return a robot like a TurtleBot3 Burger: .14 x .18 m, .22 m/s, a tick every .1 s."""
    speeds = (
        (0, 0),
        (0.11, 0),
        (0.22, 0),
        (0.176, 0.257),
        (0.176, -0.257),
        (0, 0.429),
        (0, -0.429),
    )
    return msgspec.structs.replace(
        load_profile("warehouse_amr").task,
        body=Body(length_m=0.14, width_m=0.18),
        actions=speeds,
        control_period_s=0.1,
        time_limit_steps=600,
        goal_radius_m=0.15,
    )


def test_small_robot_drives_through_narrow_gap() -> None:
    """Regression: the robot turned left and right before gaps too narrow for the stand-in."""
    gap = Rect(1.5, 0.0, 2.5, 0.8), Rect(1.5, 1.2, 2.5, 2.0)
    ends = (3.4, 1.0), (0.6, 1.0)
    floor = Warehouse(
        4.0, 2.0, gap, (), ends, starts_m=ends[1:], room_m=0.12, way_m=(2.0, 6.0), name="gap"
    )
    env = WarehouseVectorEnv(
        6, task=small_slow_robot(), layouts=(floor,), conditions={"nominal": 1.0}
    )
    observation, _ = env.reset(seed=0)
    operator, arrived = Operator(epsilon=0.0), np.zeros(6, np.bool_)
    for _ in range(200):
        observation, _, terminated, _, info = env.step(operator.act(env, observation)[0])
        arrived |= terminated & info["success"]
    assert arrived.all()
