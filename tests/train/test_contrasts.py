"""Check the contrasts of a study, which pair the measures of runs by seed."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.finished_runs import document, make_run

from restock.report import study_page, write_page
from restock.train.judge.compare import compare
from restock.train.run.kept_evaluations import add_evaluation
from restock.train.run.run import Run
from restock.train.run.run_tables import EVAL_EPISODES
from restock.train.study.contrasts import RunCurve, area, contrast
from restock.train.study.study import StudyPlan, load_study
from restock.train.study.study_run import contrasts, findings

PRIMARY = 'primary = { arm = "quotas", measure = "auc_wheel_slip" }\n'
STUDY = f"""
seeds = [0, 1, 2, 3]
{PRIMARY}measures = ["auc_rare", "success_rare", "auc_nominal"]
[[arms]]
name = "uniform"
[[arms]]
name = "quotas"
"""


def write_curve(path: Path, seed: int, success: dict[int, float], *, full: bool = True) -> Path:
    """Write a run with these success rates on slippery missions, keyed by environment step."""
    run = Run.create(path, document(seed))
    for step, share in success.items():
        for cell, of in ((("nominal", "none"), 1.0), (("wheel_slip", "none"), share)):
            for number in range(10):
                _append(run, step, cell, number, number < round(10 * of))
        _append(run, step, ("blocked_aisle", "partial"), 1, False)
        if full:
            for number in (2, 3, 4):
                _append(run, step, ("blocked_aisle", "full"), number, True)
    run.flush()
    return path


def _append(run: Run, step: int, cell: tuple[str, str], number: int, success: bool) -> None:
    row = dict.fromkeys(run.table("evaluations").schema.names)
    clocks = {"env_steps": step, "gradient_steps": step + 5}
    reported = {"condition": cell[0], "block": cell[1], "episode_seed": number, "success": success}
    run.append("evaluations", [{**row, **clocks, **reported}])


@given(st.lists(st.floats(0, 1), min_size=2, max_size=9), st.floats(0, 1))
def test_area_lies_between_min_and_max(values: list[float], level: float) -> None:
    steps = np.cumsum(np.arange(1, len(values) + 1)).astype(float)
    found = area(steps, np.array(values))
    assert min(values) - 1e-9 <= found <= max(values) + 1e-9
    assert area(steps, np.full(len(values), level)) == pytest.approx(level)


def test_partial_and_full_blocks_weigh_equally(tmp_path: Path) -> None:
    run = RunCurve(write_curve(tmp_path / "a", 0, {0: 0.5, 100: 0.7}))
    assert run.value("auc_blocked_aisle") == 0.5  # one partial block, three full blocks
    assert run.value("auc_partly_blocked") == 0.0
    assert run.value("auc_rare") == pytest.approx((0.6 + 0.5) / 2)
    assert np.isnan(run.value("success_rare"))  # `restock eval` has not driven it
    alone = RunCurve(write_curve(tmp_path / "b", 0, {0: 0.5, 100: 0.7}, full=False))
    assert alone.value("auc_blocked_aisle") == 0.0


def test_curves_are_compared_over_common_steps(tmp_path: Path) -> None:
    whole = RunCurve(write_curve(tmp_path / "a", 0, {0: 0.0, 100: 1.0, 200: 1.0}))
    late = RunCurve(write_curve(tmp_path / "b", 0, {100: 0.5, 200: 0.5}))
    found = contrast("a", "b", "auc_wheel_slip", [(whole, late)])
    assert found is not None
    assert (found.arm_mean, found.baseline_mean) == (1.0, 0.5)
    assert (found.low, found.p) == (None, None)
    assert found.no_interval == "1 seed, at least 3 are needed"
    assert contrast("a", "b", "success_wheel_slip", [(whole, late)]) is None


def make_plan(tmp_path: Path, text: str = STUDY) -> StudyPlan:
    (tmp_path / "s.toml").write_text(text)
    plan = StudyPlan(load_study(tmp_path / "s.toml"), tmp_path, tmp_path / "out")
    (tmp_path / "out" / "runs").mkdir(parents=True)
    return plan


def finish_runs(plan: StudyPlan, ahead: tuple[float, ...]) -> None:
    for job in plan.jobs:
        more = ahead[job.seed] if job.arm.name == "quotas" else 0.0
        level = 0.3 + 0.1 * (job.seed % 2)
        write_curve(job.path, job.seed, {0: level, 400: level + more})
        job.done.write_text(plan.fingerprint(job))


def test_holm_adjusts_all_but_primary_contrast(tmp_path: Path) -> None:
    plan = make_plan(tmp_path)
    finish_runs(plan, (0.2, 0.4, 0.4, 0.2))
    first, *others = contrasts(plan, set())
    assert (first.primary, first.measure, first.pairs) == (True, "auc_wheel_slip", 4)
    assert first.difference == pytest.approx(0.15)
    assert first.low is not None
    assert first.high is not None
    assert first.low < 0.15 < first.high
    assert first.p_holm is None
    assert [one.measure for one in others] == ["auc_rare", "auc_nominal"]  # no final evaluation
    assert others[0].p is not None
    assert others[0].p_holm == pytest.approx(others[0].p)  # the other has no p
    assert (others[1].difference, others[1].p_holm) == (0.0, None)  # all differences are 0
    assert others[1].no_interval == "the same in every seed: nothing varies"
    assert contrasts(plan, {("quotas", "uniform")}) == []  # the comparison was refused


def evaluation_episodes(policy: str, success: float, time_s: float) -> pa.Table:
    rows: list[dict[str, object]] = []
    for condition, block in (("nominal", "none"), ("wheel_slip", "none")):
        for number in range(20):
            row = dict.fromkeys(EVAL_EPISODES.names)
            won = condition == "nominal" or number < 20 * success
            row |= {"policy": policy, "condition": condition, "block": block, "success": won}
            row |= {"episode_seed": 10_000 + number, "perturbation": "none", "layouts": "default"}
            row |= {"version": "1", "bumps": int(not won), "time_s": time_s, "return": 1.0}
            rows.append({**row, "distance_m": 10.0, "perturbation_values": []})
    return pa.Table.from_pylist(rows, schema=EVAL_EPISODES)


def test_study_page_lists_contrasts_and_safety(tmp_path: Path) -> None:
    text = STUDY.replace("[0, 1, 2, 3]", "[0, 1, 2]").replace("auc_wheel_slip", "success_rare")
    plan = make_plan(tmp_path, text)
    for job in plan.jobs:
        level = 0.2 if job.arm.name == "uniform" else 0.7 + 0.05 * job.seed
        own = {} if job.arm.name == "uniform" else {"config__replay__logs_share": 0.9}
        make_run(job.path, document(job.seed, **own), success=level)
        add_evaluation(job.path, evaluation_episodes("agent", level, 12.0))
        job.done.write_text(plan.fingerprint(job))
    add_evaluation(plan.jobs[0].path, evaluation_episodes("planner", 0.5, 10.0))
    uniform, quotas = plan.study.arms
    found = findings(plan, [compare(plan.runs(uniform), plan.runs(quotas), treatment="mixture")])
    primary = found["contrasts"][0]
    assert (primary["measure"], primary["difference"]) == ("success_rare", pytest.approx(0.55))
    rows = {row["arm"]: row for row in found["arms"]}
    assert rows["quotas"]["success wheel_slip"][0] == pytest.approx(0.75)
    assert rows["uniform"]["bumps_per_km"][0] == pytest.approx(80.0)  # 16 in 200 m
    assert rows["quotas"]["time_lost_s"][0] == pytest.approx(2.0)
    assert rows["planner"]["success wheel_slip"] == [
        0.5,
        None,
        None,
    ]  # a single policy
    html = write_page(study_page(found), tmp_path / "study.html", markdown=True).read_text("utf-8")
    assert "Treatment: mixture; what differs: replay.logs_share." in html
    assert " | 0.750 | 0.200 | 3 |" in (tmp_path / "study.md").read_text(encoding="utf-8")
