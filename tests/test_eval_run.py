"""`restock eval`: what is asked of it is checked, by name, before anything is driven."""

from __future__ import annotations

from pathlib import Path

import pytest
from kept_run import kept_run

from restock.cli import main


@pytest.mark.parametrize("policy", ["run:", "onnx:", "operator"])
def test_a_policy_that_is_none_is_refused(
    policy: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = kept_run(tmp_path / "a")
    assert main(["eval", str(run), "--policies", policy, "--dry-run"]) == 2
    assert f"there is no {policy!r}" in capsys.readouterr().err


def test_a_policy_of_another_task_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = kept_run(tmp_path / "a")
    other = kept_run(tmp_path / "b", profile="turtlebot3")
    assert main(["eval", str(run), "--policies", f"run:{other}", "--dry-run"]) == 2
    assert "was trained on task" in capsys.readouterr().err
    record = ["record", "--out", str(tmp_path / "a.mcap"), "--missions", "1"]
    assert main([*record, "--policy", f"run:{other}"]) == 2
    assert "was trained on task" in capsys.readouterr().err
