"""Compare two policies in pairs, on the episodes that both drove."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from restock.files import write_table
from restock.train.evaluation.paired import agent_episodes, by_cell, paired
from restock.train.run.run import Run
from restock.train.run.run_tables import EVAL_EPISODES

CONDITIONS = ("nominal", "wheel_slip", "blocked_aisle")


def evaluated_run(
    path: Path,
    success: dict[str, float],
    *,
    episodes: int = 60,
    first_seed: int = 10_000,
    perturbations: tuple[str, ...] = ("none", "friction"),
    shuffle: int = 0,
    friction: float = 0.5,
) -> Path:
    """Write a run whose evaluation has these success rates per condition."""
    run = Run.create(path, {"config": {}, "panel": None, "task_hash": "t"})
    rows = [
        {
            "policy": policy,
            "perturbation": perturbation,
            "perturbation_values": [("floor_friction", friction)]
            if perturbation == "friction"
            else None,
            "condition": condition,
            "block": ("partial" if index % 2 else "full")
            if condition == "blocked_aisle"
            else "none",
            "episode_seed": first_seed + index,
            "success": (index // 2 % 10) < 10 * success[condition] and policy == "agent",
            "bumps": 0,
            "time_s": 10.0,
            "return": float((index // 2 % 10) < 10 * success[condition]) + 0.001 * index,
        }
        for policy in ("agent", "random")
        for perturbation in perturbations
        for condition in CONDITIONS
        for index in range(episodes)
    ]
    order = np.random.default_rng(shuffle).permutation(len(rows)) if shuffle else range(len(rows))
    table = pa.Table.from_pylist([rows[place] for place in order], EVAL_EPISODES)
    write_table(table, run.path / "eval" / "episodes.parquet")
    return path


GOOD = {"nominal": 1.0, "wheel_slip": 0.6, "blocked_aisle": 0.5}


@pytest.fixture
def baseline(tmp_path: Path) -> Path:
    return evaluated_run(tmp_path / "good", GOOD)


def verdicts(rows: list[dict[str, object]], perturbation: str = "none") -> dict[object, object]:
    return {r["condition"]: r["verdict"] for r in rows if r["perturbation"] == perturbation}


def compared(first: Path, second: Path) -> list[dict[str, Any]]:
    """Compare the policies of two runs on their common episodes."""
    driven = [agent_episodes(Run.open(path)) for path in (first, second)]
    tables = [table for table in driven if table is not None]
    return paired(*map(by_cell, tables))


def test_paired_verdicts_per_condition(baseline: Path, tmp_path: Path) -> None:
    other = evaluated_run(
        tmp_path / "b", {"nominal": 1.0, "wheel_slip": 0.2, "blocked_aisle": 0.9}, shuffle=3
    )
    rows = compared(baseline, other)
    assert verdicts(rows) == {
        "blocked_aisle (full)": "better",
        "blocked_aisle (partial)": "better",
        "nominal": "no difference shown",
        "wheel_slip": "worse",
    }
    slip = next(row for row in rows if row["condition"] == "wheel_slip")
    assert (slip["success_a"], slip["success_b"]) == pytest.approx((0.6, 0.2))
    assert slip["difference"] == pytest.approx(-0.4)
    assert slip["difference_low"] < -0.4 < slip["difference_high"] < 0


def test_pairing_detects_small_drop(tmp_path: Path) -> None:
    """Detect 6 of 60 episodes that became failures, which unpaired shares do not show."""
    first = evaluated_run(tmp_path / "a", GOOD)
    second = evaluated_run(tmp_path / "b", {**GOOD, "wheel_slip": 0.5})
    assert verdicts(compared(first, second))["wheel_slip"] == "worse"


def test_few_episodes_are_inconclusive(tmp_path: Path) -> None:
    """Report values without interval or verdict for few episodes."""
    good = evaluated_run(tmp_path / "a", dict.fromkeys(CONDITIONS, 1.0), episodes=9)
    bad = evaluated_run(tmp_path / "b", dict.fromkeys(CONDITIONS, 0.0), episodes=9)
    rows = compared(good, bad)
    few = {row["condition"]: row for row in rows if row["perturbation"] == "none"}
    assert {few[name]["verdict"] for name in ("nominal", "wheel_slip")} == {"inconclusive"}
    assert (few["nominal"]["difference"], few["nominal"]["difference_low"]) == (-1.0, None)


@pytest.mark.parametrize(
    ("changes", "episodes"),
    [
        ({"first_seed": 10_001}, {"none": 59, "friction": 59}),
        ({"episodes": 40}, {"none": 40, "friction": 40}),
        ({"perturbations": ("none",)}, {"none": 60}),
        ({"friction": 0.7}, {"none": 60}),
    ],
    ids=str,
)
def test_only_common_episodes_are_compared(baseline, tmp_path, changes, episodes) -> None:
    rows = compared(baseline, evaluated_run(tmp_path / "b", GOOD, **changes))
    nominal = [row for row in rows if row["condition"] == "nominal"]
    assert {row["perturbation"]: row["episodes"] for row in nominal} == episodes
