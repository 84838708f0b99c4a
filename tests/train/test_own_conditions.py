"""Training with conditions of one's own: those over custom signals label logs, not the twin."""

import json
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from support.paths import ROOT
from support.profile_texts import WAREHOUSE

from restock.cli import main

OWN = """
[[condition]]
name = "sagging"
timing = "pre"
priority = 30
sql = "battery_v < {volts}"

[[condition]]
name = "creeping"
timing = "pre"
priority = 35
sql = "abs(wheel_speed_mps) < 0.3"

[signals.battery_v]
topic = "/diagnostics"
type = "diagnostic_msgs/msg/DiagnosticArray"
path = "status[name=battery].values[key=voltage].value"
unit = "V"
"""
SMALL = [
    *("schedule.env_steps=500", "schedule.offline_updates=10", "schedule.warmup_env_steps=100"),
    *("env.num_envs=4", "evaluation.episodes=1", "evaluation.every_env_steps=500"),
    *("record.trackers=[]", "network.hidden=[16]"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a profile of one's own, a store that it labelled, and a panel of that."""
    folder = tmp_path_factory.mktemp("own")
    text = WAREHOUSE.replace('name = "warehouse_amr"', 'name = "mine"', 1)
    (folder / "mine.toml").write_text(text + OWN.format(volts=26.395))
    profile, store = str(folder / "mine.toml"), str(folder / "store")
    tuesday = str(ROOT / "sample_logs" / "amr_tuesday")
    assert main(["ingest", tuesday, "--profile", profile, "--store", store]) == 0
    assert main(["mix", store, "--out", str(folder / "panel")]) == 0
    return folder


def train(folder: Path, run: str, *more: str) -> int:
    settings = [word for text in SMALL for word in ("--set", text)]
    given = ["--panel", str(folder / "panel"), "--out", str(folder / run)]
    profile = ["--set", f"profile={folder / 'mine.toml'}"]
    return main(["train", *given, *profile, *settings, *more])


def test_dry_run_names_conditions_the_twin_cannot_evaluate(folder, capsys):
    capsys.readouterr()
    assert train(folder, "dry", "--dry-run") == 0
    document: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert document["not_evaluated"] == {"sagging": ["battery_v"]}
    assert not (folder / "dry").exists()


@pytest.mark.long
def test_a_run_says_which_conditions_its_twin_cannot_evaluate(folder, capsys):
    capsys.readouterr()
    assert train(folder, "run") == 0
    said = capsys.readouterr().err
    assert said.count("condition 'sagging' is not evaluated in the twin") == 1
    assert json.loads((folder / "run" / "config.json").read_text())["not_evaluated"] == {
        "sagging": ["battery_v"]
    }
    # What the twin's own signals say is evaluated there; the logs keep their stored labels.
    labels = pq.read_table(folder / "run" / "episodes.parquet")["conditions"].to_pylist()
    assert {name for names in labels for name in names} >= {"creeping"}
    assert "sagging" not in {name for names in labels for name in names}
    observed = pq.read_table(folder / "run" / "conditions.parquet").to_pylist()
    assert "sagging" in {row["condition"] for row in observed if row["source"] == "logs"}
    assert "sagging" not in {row["condition"] for row in observed if row["source"] == "fresh"}

    few = ["--episodes", "nominal=1", "--policies", "agent", "--perturbations", "none"]
    assert main(["eval", str(folder / "run"), *few]) == 0
    assert main(["report", str(folder / "run")]) == 0
    page = (folder / "run" / "report.html").read_text()
    assert "Conditions of the logs that the twin cannot show" in page
    assert "battery_v" in page
