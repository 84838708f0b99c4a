"""Check practice by mission arm: shares of each rule, updates, records and rejections."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.toy_run import config, session

from restock.errors import ConfigError, RunError
from restock.replay.fleet.missions_file import MissionOrder
from restock.train.dqn.config import PracticeConfig
from restock.train.feed import practice as practice_module
from restock.train.feed.collector import EndedEpisode
from restock.train.feed.practice import (
    FLOOR,
    HALF_LIFE_EPISODES,
    MAX_CHANGE,
    Practice,
    unordered,
    with_floor,
)
from restock.train.twin.env.episode_queue import MissionArm
from restock.train.twin.env.vector_env import WarehouseVectorEnv

ARMS = [
    MissionArm("nominal", "nominal", 0.6),
    MissionArm("wheel_slip", "wheel_slip", 0.2),
    MissionArm("blocked_aisle (partial)", "blocked_aisle", 0.15, block="partial"),
    MissionArm("blocked_aisle (full)", "blocked_aisle", 0.05, block="full"),
]


def ended_episodes(
    kind: str, success: bool, count: int = 1, block: str = "none"
) -> list[EndedEpisode]:
    episode = EndedEpisode(*(0, 0, 0, 0, 0, "nominal", kind, block, 0.0, success, 0, 1), signals={})
    return [episode] * count


def practice(rule: str) -> Practice:
    return Practice(PracticeConfig(rule=rule), ARMS)


def clocks_at(env_steps: int) -> dict[str, int]:
    return {"env_steps": env_steps, "gradient_steps": 0}


@given(st.data())
def test_shares_sum_to_one_and_keep_their_floor(data: st.DataObject) -> None:
    weights = np.array(data.draw(st.lists(st.floats(0, 1), min_size=1, max_size=12)))
    weights += 0 if weights.sum() > 1e-6 else 1
    floor = data.draw(st.floats(0, 1)) / len(weights)  # so that the floors of all arms fit
    shares = with_floor(weights, floor)
    assert math.isclose(shares.sum(), 1.0)
    assert (shares >= floor - 1e-9).all()
    free = np.flatnonzero(shares > floor + 1e-9)
    if weights[free].sum() > 0:
        np.testing.assert_allclose(
            shares[free] / shares[free].sum(), weights[free] / weights[free].sum(), atol=1e-9
        )


def test_natural_and_even_rules_give_fixed_shares() -> None:
    assert practice(rule="natural").shares.tolist() == [0.6, 0.2, 0.15, 0.05]
    assert practice(rule="even").shares.tolist() == [0.25] * 4


def test_success_rule_favours_failing_arms(monkeypatch):
    monkeypatch.setattr(practice_module, "MAX_CHANGE", 1.0)
    found = practice(rule="success")
    np.testing.assert_allclose(found.shares, 0.25)  # without results, all arms count as failing
    found.note(ended_episodes("nominal", True, 50) + ended_episodes("wheel_slip", False, 50))
    found.note(ended_episodes("blocked_aisle", True, 3, "partial"))  # too few to count
    rows = found.advance(clocks_at(1000))
    np.testing.assert_allclose(found.shares.sum(), 1.0)
    nominal, slip, partial, full = found.shares
    assert nominal == pytest.approx(FLOOR)
    assert partial == full == pytest.approx(slip, abs=0.01)
    assert [row["success_rate"] is None for row in rows] == [False, False, True, True]
    assert [row["episodes"] for row in rows] == [50, 50, 3, 0]
    assert sum(row["given_share"] for row in rows) == pytest.approx(1.0)
    assert rows[0]["wanted_share"] == 0.25  # the share of the past interval


def test_arm_with_few_missions_uses_rate_of_its_kind() -> None:
    found = practice(rule="success")
    found.note(ended_episodes("blocked_aisle", True, 6, "partial"))
    found.note(ended_episodes("blocked_aisle", False, 1, "full"))
    rates = found.failure_rate
    assert rates[2] == pytest.approx(0.5 / 7, abs=0.01)  # its own six successes
    assert rates[3] == pytest.approx(1.5 / 8, abs=0.02)  # the kind's rate: one of seven
    assert rates[0] == rates[1] == 1.0  # never driven


def test_old_episodes_decay_with_half_life() -> None:
    found = practice(rule="success")
    found.note(ended_episodes("nominal", False, 200))
    found.note(ended_episodes("nominal", True, round(HALF_LIFE_EPISODES)))
    assert found.failure_rate[0] == pytest.approx(0.5, abs=0.04)


def test_shares_move_at_interval_ends_within_the_limit() -> None:
    reported: list[list[float]] = []
    settings = PracticeConfig(rule="success")
    found = Practice(settings, ARMS, reported.append)
    found.note(ended_episodes("nominal", True, 30))
    assert found.advance(clocks_at(999)) == []
    found.advance(clocks_at(1000))
    found.advance(clocks_at(2500))
    assert len(reported) == 3  # the initial shares and two updates
    steps = np.abs(np.diff(reported, axis=0)).max(axis=1)
    assert steps[0] == pytest.approx(MAX_CHANGE)
    assert steps[1] <= MAX_CHANGE + 1e-9


def test_unordered_merges_orders_into_their_kinds() -> None:
    order = MissionArm("missions[0] wheel_slip aisle_1", "wheel_slip", 0.5, order=0)
    whole = [MissionArm(arm.name, arm.kind, arm.share / 2, arm.block) for arm in ARMS]
    natural = {arm.name: arm.share for arm in unordered([*whole, order])}
    assert natural["wheel_slip"] == pytest.approx(0.6)
    assert sum(natural.values()) == pytest.approx(1.0)


def test_success_rule_needs_a_goal() -> None:
    with pytest.raises(ConfigError, match="the task has no goal"):
        Practice(PracticeConfig(rule="success"), ARMS, goal=False)


PRACTICE = {"rule": "success"}


def test_resume_with_other_arms_is_rejected(tmp_path: Path) -> None:
    first = session(tmp_path / "run", config(practice=PRACTICE))
    first.save()
    first.close()
    nominal_only = {"conditions": {"nominal": 1.0, "wheel_slip": 0.0}}
    with pytest.raises(RunError, match="practised nominal, wheel_slip; now there are nominal"):
        session(tmp_path / "run", config(practice=PRACTICE, env=nominal_only), resume=True)


def test_warehouse_draws_missions_of_the_requested_arms() -> None:
    twin = WarehouseVectorEnv(2, seed=3)
    names = [arm.name for arm in twin.mission_arms()]
    assert names[2:4] == ["blocked_aisle (partial)", "blocked_aisle (full)"]
    twin.set_mission_shares([0, 0, 1, 0, 0])
    _, info = twin.reset(seed=3)
    assert info["block"].tolist() == ["partial"] * 2
    assert info["mission_arm"].tolist() == [2, 2]
    twin.set_mission_shares([0, 1, 0, 0, 0])
    first = [twin.queue.next(0)[0] for _ in range(5)]
    assert {spec.condition for spec in first} == {"wheel_slip"}
    twin.queue.drawn[:] = 1
    assert [twin.queue.next(0)[0] for _ in range(5)] == first  # the same on every call
    with pytest.raises(ValueError, match="shorter"):
        twin.set_mission_shares([0, 1])


def test_mission_order_is_a_named_arm() -> None:
    orders = [MissionOrder(kind="near_collision", missions=2)]
    twin = WarehouseVectorEnv(1, missions=orders, missions_share=0.25, conditions={"nominal": 1})
    arms = twin.mission_arms()
    assert [(arm.name, arm.share) for arm in arms] == [
        ("nominal", 0.75),
        ("missions[0] near_collision", 0.25),
    ]
    twin.set_mission_shares([0, 1])
    _, info = twin.reset(seed=1)
    assert (info["episode_condition"][0], info["mission_arm"][0]) == ("near_collision", 1)
