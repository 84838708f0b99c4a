"""A run against a baseline: paired, refused where the episodes differ, and an exit code."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from restock.cli import main
from restock.errors import RunError
from restock.files import write_table
from restock.train.evaluation import eval_run
from restock.train.evaluation.regression import (
    read_baseline,
    read_run_evaluation,
    regression,
    save_baseline,
)
from restock.train.run.run import Run
from restock.train.run.run_tables import EVAL_EPISODES

CONDITIONS = ("nominal", "wheel_slip", "blocked_aisle")


def evaluated(
    path: Path,
    success: dict[str, float],
    *,
    episodes: int = 60,
    first_seed: int = 10_000,
    task_hash: str = "t",
    perturbations: tuple[str, ...] = ("none", "friction"),
    shuffle: int = 0,
    friction: float = 0.5,
) -> Path:
    """Return a run with an evaluation of which that share of each condition succeeded."""
    run = Run.create(path, {"config": {}, "panel": None, "task_hash": task_hash})
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
            "end_x_m": 0.0,
            "end_y_m": 0.0,
            "failure": None,
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
    return evaluated(tmp_path / "good", GOOD)


def verdicts(rows: list[dict[str, object]], perturbation: str = "none") -> dict[object, object]:
    return {r["condition"]: r["verdict"] for r in rows if r["perturbation"] == perturbation}


def test_regression_is_worse_better_or_left_open(baseline: Path, tmp_path: Path) -> None:
    other = evaluated(
        tmp_path / "b", {"nominal": 1.0, "wheel_slip": 0.2, "blocked_aisle": 0.9}, shuffle=3
    )
    rows = regression(read_run_evaluation(baseline), read_run_evaluation(other))
    assert verdicts(rows) == {
        "blocked_aisle (full)": "better",
        "blocked_aisle (partial)": "better",
        "nominal": "no difference shown",
        "wheel_slip": "worse",
        "all": "better",
    }
    slip = next(row for row in rows if row["condition"] == "wheel_slip")
    assert (slip["baseline"], slip["candidate"]) == pytest.approx((0.6, 0.2))
    assert slip["difference"] == pytest.approx(-0.4)
    assert slip["difference_low"] < -0.4 < slip["difference_high"] < 0
    assert slip["improvement"] == pytest.approx(0.3)  # 0.4 fell, 0.6 are ties
    assert slip["return_iqm"][1] < slip["return_iqm"][0]
    every = next(row for row in rows if row["condition"] == "all")
    assert every["difference"] == pytest.approx((0 - 0.4 + 0.4 + 0.4) / 4)


def test_pairing_tells_what_unpaired_shares_would_not(tmp_path: Path) -> None:
    """Six of sixty fell and none rose: paired that is sure, for two shares it is not."""
    first = evaluated(tmp_path / "a", GOOD)
    second = evaluated(tmp_path / "b", {**GOOD, "wheel_slip": 0.5})
    slip = verdicts(regression(read_run_evaluation(first), read_run_evaluation(second)))[
        "wheel_slip"
    ]
    assert slip == "worse"
    tolerant = regression(read_run_evaluation(first), read_run_evaluation(second), margin=0.2)
    assert verdicts(tolerant)["wheel_slip"] == "no difference shown"


def test_few_episodes_say_nothing_of_better_or_worse(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One episode that fell is no regression: values, without interval and verdict, and exit 0."""
    good = evaluated(tmp_path / "a", dict.fromkeys(CONDITIONS, 1.0), episodes=9)
    bad = evaluated(tmp_path / "b", dict.fromkeys(CONDITIONS, 0.0), episodes=9)
    rows = regression(read_run_evaluation(good), read_run_evaluation(bad))
    few = {row["condition"]: row for row in rows if row["perturbation"] == "none"}
    assert {few[name]["verdict"] for name in ("nominal", "wheel_slip")} == {"inconclusive"}
    assert (few["nominal"]["difference"], few["nominal"]["difference_low"]) == (-1.0, None)
    assert few["nominal"]["reason"] == "9 episodes, at least 10 are needed"
    # 27 episodes together, but one kind has 4: its spread would count for nothing.
    assert few["blocked_aisle (full)"]["episodes"] + few["blocked_aisle (partial)"]["episodes"] == 9
    assert few["all"]["verdict"] == "inconclusive"
    assert "at least 5" in str(few["all"]["reason"])

    monkeypatch.setattr(eval_run, "plan_evaluation", lambda *_, **__: None)  # nothing drives
    assert main(["eval", str(bad), "--no-drive", "--baseline", str(good)]) == 0
    said = capsys.readouterr()
    assert "inconclusive" in said.out
    assert "9 episodes, at least 10 are needed" in said.err


@pytest.mark.parametrize(
    "changes",
    [
        {"first_seed": 10_001},
        {"episodes": 40},
        {"perturbations": ("none",)},
        {"friction": 0.7},
    ],
    ids=str,
)
def test_other_episodes_are_refused(baseline: Path, tmp_path: Path, changes: dict) -> None:
    other = evaluated(tmp_path / "b", GOOD, **changes)
    rows = regression(read_run_evaluation(baseline), read_run_evaluation(other))
    refused = [row for row in rows if row["verdict"] == "refused"]
    assert refused
    assert all("not the same episodes" in row["reason"] for row in refused)
    assert all(row["difference"] is None for row in refused)
    assert {row["perturbation"] for row in rows} == {"none", "friction"}


def test_another_task_is_refused(baseline: Path, tmp_path: Path) -> None:
    other = evaluated(tmp_path / "b", GOOD, task_hash="u")
    with pytest.raises(RunError, match="is of task u, the baseline"):
        regression(read_run_evaluation(baseline), read_run_evaluation(other))


def test_a_saved_baseline_outlives_its_run(
    baseline: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    file = save_baseline(baseline, "main")
    assert file == Path("baselines/main.parquet")
    before = read_run_evaluation(baseline)
    baseline.rename(tmp_path / "gone")
    kept = read_baseline("main")
    assert kept.cells == before.cells
    assert kept.task_hash == "t"
    assert kept.name == "main (good)"
    assert read_baseline(str(file)).cells == before.cells
    with pytest.raises(RunError, match="there are main in"):
        read_baseline("mian")
    Path("baselines/text.parquet").write_text("hello")
    with pytest.raises(RunError, match="is not a baseline"):
        read_baseline("text")


def test_a_saved_baseline_is_compared_by_the_verb(
    baseline: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)

    monkeypatch.setattr(eval_run, "plan_evaluation", lambda *_, **__: None)  # nothing drives
    worse = evaluated(tmp_path / "b", {**GOOD, "wheel_slip": 0.2})
    argv = ["eval", str(baseline), "--no-drive", "--save-as-baseline", "main"]
    assert main(argv) == 0
    argv = ["eval", str(worse), "--no-drive", "--baseline", "main"]
    assert main(argv) == 0
    assert "no difference shown" in capsys.readouterr().out
    assert main([*argv, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["baseline"] == "main (good)"
    assert {row["verdict"] for row in document["regression"]} == {"worse", "no difference shown"}
