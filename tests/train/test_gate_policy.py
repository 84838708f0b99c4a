"""Check the verdicts of `restock gate`, the conditions that it names, and rejected input."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from support.kept_run import kept_run

from restock.cli import main
from restock.train.evaluation.evaluate import EpisodeResult
from restock.train.evaluation.policies import GreedyPolicy
from restock.train.judge import gate
from restock.train.judge.gate import drive_gate, plan_gate
from restock.train.judge.sequential import NOT_SHOWN, NOT_WORSE, WORSE
from restock.train.twin.physics.episode import EpisodeSpec

Outcome = Callable[[EpisodeSpec, bool], bool]  # (mission, is_agent) -> success


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return kept_run(tmp_path / "a")


@pytest.fixture
def drive_outcomes(monkeypatch: pytest.MonkeyPatch) -> Callable[[Outcome], None]:
    """Replace driving in the twin by a function that returns each episode's success."""

    def install(outcome: Outcome) -> None:
        def run_policy(
            plan: Any, env: Any, driver: Any, specs: list[EpisodeSpec], progress: Any = None
        ) -> list[EpisodeResult]:
            own = isinstance(driver, GreedyPolicy)
            return [result(spec, outcome(spec, own)) for spec in specs]

        monkeypatch.setattr(gate, "run_policy", run_policy)

    return install


def result(spec: EpisodeSpec, success: bool) -> EpisodeResult:
    block = ("partial", "full")[spec.seed % 2] if spec.condition == "blocked_aisle" else "none"
    outcome = (success, int(not success), 10.0, 0.0, 0.0, 0.0, None if success else "bump")
    return EpisodeResult(spec.condition, block, spec.seed, *outcome, distance_m=30.0)


def mostly_successful(spec: EpisodeSpec, own: bool) -> bool:
    """Return success for nine of ten missions, the same for both policies."""
    return bool(np.random.default_rng(spec.seed).random() < 0.9)


def failing_in_slip(spec: EpisodeSpec, own: bool) -> bool:
    return mostly_successful(spec, own) and not (
        own and spec.condition == "wheel_slip" and spec.seed % 2
    )


def test_equal_policies_pass_before_budget_is_spent(run: Path, drive_outcomes: Any) -> None:
    drive_outcomes(mostly_successful)
    assert main(["gate", str(run), "--baseline", "planner"]) == 0
    document = json.loads((run / "gate" / "gate.json").read_text())
    assert document["verdict"] == NOT_WORSE
    assert {cell["verdict"] for cell in document["cells"]} == {NOT_WORSE}
    assert all(cell["pairs"] < 250 for cell in document["cells"])
    conditions = [cell["condition"] for cell in document["cells"]]
    assert {"nominal", "blocked_aisle (partial)", "blocked_aisle (full)"} <= {*conditions}
    episodes = pq.read_table(run / "gate" / "episodes.parquet").to_pylist()
    assert {row["policy"] for row in episodes} == {"agent", "planner"}
    page = (run / "gate" / "gate.html").read_text()
    assert "shown not worse" in page
    assert "<svg" in page
    assert "was not measured" in page  # the twin's gap


def test_worse_condition_is_named(run, drive_outcomes, shell):
    drive_outcomes(failing_in_slip)
    document = shell.json("gate", run, "--baseline", "planner", code=1)
    verdicts = {cell["condition"]: cell["verdict"] for cell in document["cells"]}
    assert document["verdict"] == WORSE
    assert [name for name, verdict in verdicts.items() if verdict != NOT_WORSE] == ["wheel_slip"]
    assert "worse in wheel slip" in document["claim"]


def test_spent_budget_is_inconclusive(run: Path, drive_outcomes: Any) -> None:
    drive_outcomes(
        lambda spec, own: bool(
            np.random.default_rng(2 * spec.seed + own).random() < 0.6 - 0.1 * own
        )
    )
    plan = plan_gate(run, "planner", conditions=("nominal",), budget=160)
    document = drive_gate(plan)
    (cell,) = document["cells"]
    assert (document["verdict"], cell["verdict"]) == (NOT_SHOWN, NOT_SHOWN)
    assert 160 <= cell["pairs"] < 160 + gate.ROUND


def test_each_requested_measure_gets_a_verdict(run: Path, drive_outcomes: Any) -> None:
    drive_outcomes(mostly_successful)
    margins = {"bumps_per_km": 5.0, "time_lost_s": 2.0, "closest_person_m": 0.2}
    plan = plan_gate(run, "planner", margins=margins, conditions=("nominal",), budget=400)
    cells = {cell["measure"]: cell for cell in drive_gate(plan)["cells"]}
    assert cells.keys() == {"success", *margins}
    assert cells["bumps_per_km"]["verdict"] == NOT_WORSE
    assert cells["time_lost_s"]["verdict"] == NOT_WORSE
    nobody = cells["closest_person_m"]
    assert (nobody["verdict"], nobody["pairs"]) == (NOT_SHOWN, 0)
    assert nobody["pairs_unknown"] == nobody["pairs_driven"]


@pytest.mark.parametrize(
    ("options", "where"),
    [
        (["--margins", "success=0"], "--margins success"),
        (["--margins", "success=1.5"], "--margins success"),
        (["--margins", "stopped_s=1"], "--margins stopped_s"),
        (["--budget", "20"], "--budget"),
        (["--conditions", "nominal,fire"], "--conditions"),
        (["--seed", "90000"], "--seed"),  # the seeds that selected the policy
        (["--baseline", "nobody"], "--policies"),
    ],
)
def test_invalid_gate_options_are_rejected(run, options, where, shell):
    base = [] if "--baseline" in options else ["--baseline", "planner"]
    assert shell.err("gate", run, *base, *options).startswith(f"restock: {where}: ")
    assert not (run / "gate").exists()


def test_floor_too_small_for_a_condition_is_rejected(run: Path, tmp_path: Path) -> None:
    hall = tmp_path / "hall.toml"
    hall.write_text("width_m = 12.0\ndepth_m = 10.0\nracks = [[5.8, 0.0, 6.2, 10.0]]\n")
    assert main(["gate", str(run), "--baseline", "planner", "--layouts", str(hall)]) == 2


def test_untrusted_twin_is_rejected(run, monkeypatch, shell):
    class Gap:
        untrusted = ("wheel_slip",)
        verdicts = ()

    monkeypatch.setattr(gate, "find_gap", lambda run: Gap())
    assert "cannot be trusted in wheel_slip" in shell.err("gate", run, "--baseline", "planner")
    assert plan_gate(run, "planner", conditions=("nominal",)).gap is not None


def test_interrupted_run_is_rejected(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Origin:
        env_steps, run_env_steps, text = 20_000, 50_000, "policy of step 20,000 of 50,000"

    monkeypatch.setattr(gate, "kept_policy", lambda run: Origin())
    monkeypatch.setattr(gate, "run_clocks", lambda run: {"env_steps": 50_000, "wall_s": 9.0})
    assert main(["gate", str(run), "--baseline", "planner"]) == 2


@pytest.mark.long
@pytest.mark.timeout(300)
def test_planner_passes_gate_against_itself(run, monkeypatch):
    from restock.train.evaluation.eval_run import reference

    monkeypatch.setattr(gate, "make_policy", lambda name, plan: reference("planner"))
    plan = plan_gate(run, "planner", conditions=("nominal",), budget=200)
    assert drive_gate(plan)["verdict"] == NOT_WORSE
