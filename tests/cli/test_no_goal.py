"""A task without a goal has no success: null and "no goal" everywhere, instead of 0 %."""

import json
import re
from importlib.resources import files
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from restock import cli

TINY = [
    *("--env-steps", "400", "--set", "env.num_envs=8", "--set", "schedule.warmup_env_steps=40"),
    *("--set", "schedule.offline_updates=0", "--set", "network.hidden=[8]"),
    *("--set", "evaluation.episodes=1", "--set", "record.every_updates=10"),
    *("--set", "record.trackers=[]", "--set", "replay.batch_size=16"),
    *("--set", "env.conditions={nominal=1.0}"),
]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the run of a short training whose profile has no goal."""
    root = tmp_path_factory.mktemp("no_goal")
    text = (files("restock.ingest.profile") / "profiles" / "warehouse_amr.toml").read_text("utf-8")
    text = text.replace('goal = "route"', 'goal = "none"')
    text = text.replace("time_limit_steps = 240", "time_limit_steps = 30")
    profile = root / "wander.toml"
    profile.write_text(text)
    argv = ["train", "--out", str(root / "run"), "--set", f"profile={json.dumps(str(profile))}"]
    assert cli.main([*argv, *TINY]) == 0
    return root / "run"


def test_training_records_null_success(run: Path) -> None:
    for name in ("progress", "episodes", "evaluations"):
        table = pq.read_table(run / f"{name}.parquet")
        assert len(table), name
        assert set(table["success"].to_pylist()) == {None}, name


@pytest.mark.long
def test_eval_report_and_card_show_no_goal(run, shell):
    evaluate = ["eval", str(run), "--episodes", "1", "--perturbations", "none"]
    results = shell.json(*evaluate, "--policies", "agent,planner")["results"]
    assert results
    for row in results:
        assert (row["success"], row["success_low"], row["success_high"]) == (None, None, None)
        assert row["return"] is not None
    shown = shell.out(*evaluate, "--policies", "agent")
    assert "no goal" in shown
    assert "0.00 [" not in shown

    assert cli.main(["report", str(run)]) == 0
    page = (run / "report.html").read_text("utf-8")
    assert "No goal, so no success" in page
    assert "success is not defined" in page
    assert not re.search(r"(?i)success[^.<]{0,40}\b\d+\s?%", page.split("<main")[-1])
    assert "Wilson" not in page
    assert "The task has no goal" in shell.out("report", run, "--card")
