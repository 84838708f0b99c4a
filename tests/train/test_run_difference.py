"""`restock coverage diff` of runs: settings, feed and evaluation side by side."""

import json
from pathlib import Path

import pytest
from support.finished_runs import document, make_run

from restock.cli import main
from restock.errors import RunError
from restock.train.judge.compare import diff_runs
from restock.train.run.run import Run

pytestmark = pytest.mark.usefixtures("few_resamples")


def test_what_moved_is_shown_where_compare_refuses(tmp_path, capsys):
    first = make_run(tmp_path / "a", document(0), success=0.2)
    second = make_run(
        tmp_path / "b", document(1, config__network__layer_norm=False), success=0.7, slip_share=0.1
    )
    assert main(["compare", str(first), "--against", str(second), "--json"]) == 1
    capsys.readouterr()
    assert main(["coverage", "diff", str(first), str(second), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    settings = {row["setting"]: (row["first"], row["second"]) for row in found["settings"]}
    assert settings["config.network.layer_norm"] == (True, False)
    fed = {(row["source"], row["condition"]): row for row in found["fed"]}
    slip = fed["logs", "wheel_slip"]
    assert (slip["share_a"], slip["share_b"]) == pytest.approx((0.15, 0.05))
    assert sum(row["share_a"] for row in found["fed"]) == pytest.approx(1)
    rows = {row["condition"]: row for row in found["evaluation"]}
    assert rows["wheel_slip"]["episodes"] == 40
    assert rows["wheel_slip"]["difference"] == pytest.approx(0.5, abs=0.2)
    assert rows["wheel_slip"]["difference_low"] > 0
    assert found["evaluated_by"] == "training"
    assert found["different"]
    assert main(["coverage", "diff", str(first), str(second)]) == 0
    assert "what the critics were fed" in capsys.readouterr().out


def test_runs_that_share_no_episode_or_have_no_evaluation_say_so(tmp_path: Path) -> None:
    first = make_run(tmp_path / "a", document(0))
    second = make_run(tmp_path / "b", document(1), first_episode_seed=5)
    found = diff_runs(first, second)
    assert found["evaluation"] == []
    assert "no episode in common" in found["evaluation_note"]
    young = Run.create(tmp_path / "young", document(2)).path
    found = diff_runs(first, young)
    assert "has no evaluation" in found["evaluation_note"]
    assert all(row["drawn_b"] == 0 for row in found["fed"])


def test_runs_of_two_tasks_are_refused(tmp_path: Path) -> None:
    first = make_run(tmp_path / "a", document(0))
    second = make_run(tmp_path / "b", document(1, task_hash="other"))
    with pytest.raises(RunError, match="task other"):
        diff_runs(first, second)
