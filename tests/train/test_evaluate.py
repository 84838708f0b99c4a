"""Check evaluation: fixed episodes, results in order, and summaries."""

from typing import Any

import numpy as np
import pytest
from support.toy_twin import CELLS, TASK, ToyTwin

from restock.stats import wilson
from restock.train.evaluation.evaluate import (
    EpisodeResult,
    Score,
    fixed_episodes,
    run_episodes,
    score,
)
from restock.train.run.kept_evaluations import cell_name, measures, summary_rows
from restock.train.twin.physics.episode import EpisodeSpec


class ConstantPolicy:
    """Policy that always takes the same action."""

    name, version = "always", "1"

    def __init__(self, action: int) -> None:
        self.action = action

    def act(self, env: Any, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.full(len(observation), self.action), np.ones(len(observation), np.float32)


def drive(env: ToyTwin, action: int, specs: list[EpisodeSpec]) -> list[EpisodeResult]:
    return run_episodes(
        env,
        ConstantPolicy(action),
        specs,
        control_period_s=TASK.control_period_s,
        time_limit_steps=TASK.time_limit_steps,
        discount=0.5,
    )


SPECS = fixed_episodes(["nominal", "wheel_slip"], 7, 100)


def test_results_do_not_depend_on_num_envs() -> None:
    alone = drive(ToyTwin(1), 1, SPECS)
    assert alone == drive(ToyTwin(4), 1, SPECS) == drive(ToyTwin(64), 1, SPECS)
    assert len({result.time_s for result in alone}) > 2  # slipping episodes take different times


def test_episode_result_matches_hand_calculation() -> None:
    (result,) = drive(ToyTwin(2), 1, [EpisodeSpec("nominal", 5)])
    assert result.success
    assert result.failure is None
    assert result.time_s == pytest.approx((CELLS - 1) * 0.2)
    assert result.undiscounted_return == pytest.approx(1.0 - 0.05 * (CELLS - 2))
    assert result.end_x_m == CELLS - 1
    assert result.distance_m == CELLS - 1
    steps = CELLS - 1
    assert result.discounted_return == pytest.approx(
        -0.05 * sum(0.5**step for step in range(steps - 1)) + 0.5 ** (steps - 1)
    )
    assert result.closest_person_m is None
    assert result.bumps == 0


def test_lasting_contact_counts_as_one_bump() -> None:
    (result,) = drive(ToyTwin(1), 2, [EpisodeSpec("nominal", 5)])  # backs into the wall, 20 steps
    assert result.bumps == 1
    assert not result.success
    assert result.failure == "stuck"
    assert result.time_s == pytest.approx(TASK.time_limit_steps * 0.2)


def test_score_weighs_conditions_equally_then_return() -> None:
    def result(condition: str, success: bool, value: float) -> EpisodeResult:
        return EpisodeResult(condition, "none", 0, success, 0, 1.0, value, 0.0, 0.0, None)

    found = score(
        [result("nominal", True, 2.0), result("nominal", True, 4.0), result("slip", False, -1.0)]
    )
    assert found == Score({"nominal": 1.0, "slip": 0.0}, 0.5, 1.0)
    assert found.beats(None)
    assert not found.beats(found)
    assert Score({}, 0.5, 1.1).beats(found)
    assert not Score({}, 0.4, 9.0).beats(found)


def test_summary_separates_partial_and_full_blocks() -> None:
    def result(block: str, success: bool) -> EpisodeResult:
        condition = "nominal" if block == "none" else "blocked_aisle"
        return EpisodeResult(condition, block, 0, success, 1, 3.0, 2.0, 0.0, 0.0, None)

    episodes = [result("full", True), result("partial", False), result("none", True)]
    reported = {"policy": "agent", "time_lost_s": None}
    rows = summary_rows({**one.row, **reported} for one in [*episodes, result("partial", True)])
    assert [row["condition"] for row in rows] == [
        "nominal",
        "blocked_aisle (full)",
        "blocked_aisle (partial)",
    ]
    partial = rows[2]
    assert (partial["success"], partial["episodes"]) == (0.5, 2)
    assert (partial["success_low"], partial["success_high"]) == wilson(1, 2)
    assert partial["time_s"] == 3.0
    assert cell_name("nominal", "none") == "nominal"


def make_result(
    seed: int, success: bool, time_s: float, bumps: int = 0, **more: Any
) -> EpisodeResult:
    return EpisodeResult(
        "nominal", "none", seed, success, bumps, time_s, 1.0, 0.0, 0.0, None, **more
    )


def measure(results: list[EpisodeResult]) -> dict[str, Any]:
    return measures([{**one.row, "time_lost_s": None} for one in results])


def test_bump_rate_is_per_kilometre() -> None:
    far = make_result(1, True, 30.0, distance_m=1500.0)
    near = make_result(2, False, 1.0, bumps=1, distance_m=500.0, closest_person_m=0.2)
    row = measure([far, near])
    assert row["bumps_per_km"] == pytest.approx(0.5)
    assert row["bumps_per_km_low"] <= 0.5 <= row["bumps_per_km_high"]
    assert (row["closest_person_least_m"], row["episodes_with_people"]) == (0.2, 1)
    # Two kilometres without a bump do not prove a rate of 0.
    clean = measure([far, make_result(3, True, 9.0, distance_m=500.0)])
    assert (clean["bumps_per_km"], clean["bumps_per_km_low"]) == (0.0, 0.0)
    assert clean["bumps_per_km_high"] == pytest.approx(3.689 / 2, abs=1e-3)
    assert clean["closest_person_m"] is None
