"""Check `restock eval`: arguments, recorded episodes and references."""

import json
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from support.kept_run import kept_run

from restock.cli import main
from restock.files import write_table
from restock.ingest.store.transitions import replaced
from restock.train.evaluation.eval_run import plan_evaluation
from restock.train.run.kept_evaluations import add_evaluation, read_evaluations, shown_evaluation
from restock.train.run.run_tables import EVAL_EPISODES
from restock.train.twin.missions import KINDS


def test_policy_of_another_task_is_rejected(tmp_path, shell):
    run = kept_run(tmp_path / "a")
    other = kept_run(tmp_path / "b", profile="turtlebot3")
    assert "was trained on task" in shell.err(
        "eval", run, "--policies", f"run:{other}", "--dry-run"
    )
    record = ["twin", "record", "--out", str(tmp_path / "a.mcap"), "--missions", "1"]
    assert "was trained on task" in shell.err(*record, "--policy", f"run:{other}")


def test_floor_is_evaluated_on_kinds_that_fit(tmp_path, capsys, shell):
    run = kept_run(tmp_path / "a")
    hall = tmp_path / "hall.toml"
    hall.write_text("width_m = 12.0\ndepth_m = 10.0\nracks = [[5.8, 0.0, 6.2, 10.0]]\n")
    line = ["eval", str(run), "--layouts", str(hall), "--policies", "random", "--episodes", "1"]
    line += ["--perturbations", "none", "--json"]
    assert main(line) == 0
    output = capsys.readouterr()
    document = json.loads(output.out)
    kinds = [kind for kind in KINDS if kind != "blocked_aisle"]
    assert {row["condition"] for row in document["results"]} == set(kinds)
    assert document["kinds"] == kinds
    assert document["left_out"] == {"blocked_aisle": ["hall.toml"]}
    assert "as there is no room for it on the floor 'hall.toml'" in output.err
    hall.write_text("width_m = 2.0\ndepth_m = 2.0\nracks = []\n")
    assert "has no room for episodes of nominal" in shell.err(*line)


def test_zero_episodes_shows_recorded_evaluation(tmp_path, shell):
    run = kept_run(tmp_path / "a")
    line = ["eval", str(run), "--episodes", "0", "--json"]
    error = " ".join(shell.err(*line).split())
    assert "has no recorded evaluation" in error
    assert f"run `restock eval {run}`" in error
    row = {"policy": "agent", "perturbation": "none", "condition": "nominal", "episode_seed": 3}
    row |= {"block": "none", "success": True, "return": 1.0, "bumps": 0, "time_s": 9.0}
    table = pa.Table.from_pylist([row], schema=EVAL_EPISODES)
    write_table(table, run / "eval" / "episodes.parquet")
    document = json.loads(shell.out(*line))
    (shown,) = document["results"]
    assert (shown["policy"], shown["episodes"], shown["success"]) == ("agent", 1, 1.0)
    assert document["recorded"].startswith("1 of 1 episodes")
    assert "1 of 1 episodes" in shell.err(*line[:-1], code=0)


@pytest.mark.long
def test_evaluations_accumulate_and_newest_is_shown(tmp_path, shell):
    run = kept_run(tmp_path / "a")
    hall = tmp_path / "hall.toml"
    hall.write_text("width_m = 12.0\ndepth_m = 10.0\nracks = [[5.8, 0.0, 6.2, 10.0]]\n")
    line = ["eval", str(run), "--perturbations", "none", "--layouts", str(hall)]
    line += ["--episodes", "nominal=1"]
    again = ("random", 50, 3)  # the same episodes
    for policy, seed, rows in (("agent", 1, 1), ("random", 1, 2), again, again):
        assert main([*line, "--policies", policy, "--seed", str(seed)]) == 0
        assert read_evaluations(run).num_rows == rows
    kept = read_evaluations(run)
    other = replaced(kept.slice(0, 1), {"layouts": "elsewhere"})
    add_evaluation(run, other)
    add_evaluation(run, replaced(other, {"version": "a@9"}))
    assert read_evaluations(run).num_rows == 5
    shown, message = shown_evaluation(run)
    assert shown["version"].to_pylist() == ["a@9"]
    assert message == (
        "1 of 5 episodes that `restock eval` drove: floors elsewhere, policy a@9 of step 0, seeds"
        " 1 to 1."
    )
    assert shell.json("sql", run, "SELECT count(*) AS n FROM eval_episodes") == [{"n": 5}]


def test_time_lost_is_relative_to_planner(tmp_path, shell):
    run = kept_run(tmp_path / "a")
    line = ["eval", str(run), "--episodes", "1", "--perturbations", "none", "--json"]
    line += ["--episodes", "nominal=1"]

    def results(policies: str) -> dict[tuple[str, str], dict[str, Any]]:
        rows = json.loads(shell.out(*line, "--policies", policies))["results"]
        return {(row["policy"], row["condition"]): row for row in rows}

    planner = results("planner")["planner", "nominal"]
    assert planner["time_lost_s"] == 0.0
    operator = results("operator")["operator", "nominal"]  # relative to the recorded planner
    assert operator["success"] == 1.0
    assert operator["time_lost_s"] == pytest.approx(operator["time_s"] - planner["time_s"])
    # Episodes recorded before the planner drove get their lost time too.
    assert main([*line, "--policies", "random"]) == 0
    alone = {(row["policy"], row["condition"]): row for row in read_evaluations(run).to_pylist()}
    assert alone["operator", "nominal"]["time_lost_s"] == operator["time_lost_s"]
    assert alone["random", "nominal"]["time_lost_s"] is None  # it did not arrive


def test_episodes_per_kind(tmp_path, shell):
    run = kept_run(tmp_path / "a")
    line = ["eval", str(run), "--policies", "agent", "--perturbations", "none", "--dry-run"]
    planned = json.loads(shell.out(*line, "--episodes", "nominal=1000, wheel_slip=300"))
    assert (planned["episodes"], planned["kinds"]) == (1300, ["nominal", "wheel_slip"])
    for wrong, message in (
        ("nominal=ten", "is neither a number nor kind=number"),
        ("ice=3", "there is no kind 'ice'"),
        ("nominal=0", "must be at least 1, got 0"),
        ("nominal=2,nominal=3", "names 'nominal' twice"),
    ):
        assert message in " ".join(shell.err(*line, "--episodes", wrong).split())


def test_seeds_that_selected_the_policy_are_warned_about(tmp_path: Path) -> None:
    run = kept_run(tmp_path / "a")  # its evaluation seeds are 90000 to 90009
    assert plan_evaluation(run, episodes=1000).warnings == []
    assert plan_evaluation(run, first_seed=90_000, policies=["planner"]).warnings == []
    (text,) = plan_evaluation(run, first_seed=89_991, episodes=10).warnings
    assert "among those that selected the run's policy (90000 to 90009)" in text


def test_limiter_interventions_are_counted(tmp_path, shell):
    run, limits = kept_run(tmp_path / "a"), tmp_path / "limits.toml"
    limits.write_text("[limiter]\nmax_speed_mps = 0.5\n", encoding="utf-8")
    line = ["eval", str(run), "--policies", "planner", "--perturbations", "none", "--json"]
    line += ["--episodes", "nominal=2", "--limiter"]
    document = json.loads(shell.out(*line, limits))
    assert document["limiter"]["fastest"] == [0.5, 1.2]
    free, limited = document["results"]
    assert (free["policy"], free["limited_share"]) == ("planner", None)
    assert limited["policy"] == "limited:planner"
    assert 0 < limited["limited_share"] <= 1
    assert limited["time_s"] > free["time_s"] * 1.2
    # Other limits count as another driver, and the newest is shown.
    assert main([*line, "profile"]) == 0
    shown = shown_evaluation(run)[0].to_pylist()
    assert sorted(row["policy"] for row in shown) == ["limited:planner"] * 2 + ["planner"] * 2
    assert all((row["limited_s"] is None) == (row["policy"] == "planner") for row in shown)
    bad = tmp_path / "bad.toml"
    bad.write_text("[limiter]\nstop_m = -1\n", encoding="utf-8")
    assert "limiter.stop_m" in shell.err(*line, bad)
