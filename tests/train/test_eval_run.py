"""`restock eval`: what is asked of it is checked, by name, before anything is driven."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from support.kept_run import kept_run

from restock.cli import main
from restock.train.twin.physics.episode import KINDS


@pytest.mark.parametrize("policy", ["run:", "onnx:", "operator"])
def test_an_unknown_policy_is_refused(
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


def test_a_floor_is_evaluated_on_the_kinds_that_fit_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = kept_run(tmp_path / "a")
    hall = tmp_path / "hall.toml"
    hall.write_text("width_m = 12.0\ndepth_m = 10.0\nracks = [[5.8, 0.0, 6.2, 10.0]]\n")
    line = ["eval", str(run), "--layouts", str(hall), "--policies", "random", "--episodes", "1"]
    line += ["--perturbations", "none", "--json"]
    assert main(line) == 0
    said = capsys.readouterr()
    document = json.loads(said.out)
    kinds = [kind for kind in KINDS if kind != "blocked_aisle"]
    assert {row["condition"] for row in document["results"]} == set(kinds)
    assert document["kinds"] == kinds
    assert document["left_out"] == {"blocked_aisle": ["hall.toml"]}
    assert "left out: blocked_aisle, no room for it on hall.toml" in said.err
    hall.write_text("width_m = 2.0\ndepth_m = 2.0\nracks = []\n")
    assert main(line) == 2
    assert "has no room for episodes of nominal" in capsys.readouterr().err
