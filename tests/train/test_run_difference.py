"""Compare two runs with `restock coverage diff`: settings, panels and evaluation."""

from pathlib import Path

import pytest
from support.finished_runs import document, make_run

from restock.cli import main
from restock.errors import RunError
from restock.train.judge.compare import diff_runs
from restock.train.run.run import Run


def test_diff_shows_changes_of_incomparable_runs(tmp_path, capsys):
    a = make_run(tmp_path / "a", document(0), success=0.2)
    b = make_run(tmp_path / "b", document(1, config__network__layer_norm=False), success=0.7)
    assert main(["coverage", "diff", str(a), str(b)]) == 2
    assert f"`restock compare {a} {b}` compares runs" in " ".join(capsys.readouterr().err.split())
    found = diff_runs(Run.open(a), Run.open(b))
    settings = {row["setting"]: (row["first"], row["second"]) for row in found["settings"]}
    assert settings["config.network.layer_norm"] == (True, False)
    rows = {row["condition"]: row for row in found["evaluation"]}
    assert rows["wheel_slip"]["episodes"] == 40
    assert rows["wheel_slip"]["difference"] == pytest.approx(0.5, abs=0.2)
    assert rows["wheel_slip"]["difference_low"] > 0


def test_runs_without_common_episodes_are_not_paired(tmp_path: Path) -> None:
    first = Run.open(make_run(tmp_path / "a", document(0)))
    second = Run.open(make_run(tmp_path / "b", document(1), first_episode_seed=5))
    assert diff_runs(first, second)["evaluation"] == []
    young = Run.create(tmp_path / "young", document(2))
    assert diff_runs(first, young)["evaluation"] == []


def test_runs_of_different_tasks_are_rejected(tmp_path: Path) -> None:
    first = Run.open(make_run(tmp_path / "a", document(0)))
    second = Run.open(make_run(tmp_path / "b", document(1, task_hash="other")))
    with pytest.raises(RunError, match="task other"):
        diff_runs(first, second)
