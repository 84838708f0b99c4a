"""Check `restock train` and `restock eval` in the twin with small runs and invalid arguments."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from support.long import one_in
from support.paths import ROOT
from support.stores import START_NS, recording_transitions

from restock.cli import main
from restock.ingest.profile.profile import load_profile
from restock.replay.mixture.mixture import parse_mixture
from restock.replay.panel.build import build_panel
from restock.train.dqn.config import TrainConfig
from restock.train.run import checkpoint
from restock.train.run.run import RunLock

TINY = [
    *("--set", "env.num_envs=4", "--set", "schedule.warmup_env_steps=100"),
    *("--set", "schedule.offline_updates=30", "--set", "network.hidden=[32, 32]"),
    *("--set", "evaluation.episodes=1", "--set", "record.every_updates=20"),
    *("--set", "record.trackers=[]", "--set", "replay.batch_size=32"),
    *("--set", "record.audit_share=0.2"),
]

BEGAN_NS = START_NS + 264 * 86_400 * 10**9 + 43_200 * 10**9
MIXTURE = parse_mixture("[each_condition]\nshare = 'natural'\n[evaluation_split]\nby = 'none'\n")


@pytest.fixture(scope="module")
def panel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a panel of random rows of the twin's task."""
    task = load_profile("warehouse_amr").task
    path = tmp_path_factory.mktemp("panels") / "panel"
    rows = recording_transitions(1, episodes=40, task=task)
    build_panel(rows, MIXTURE, path, task=task)
    return path


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory, panel: Path) -> Path:
    """Return a small run that begins 264 days after the logs of its panel."""
    path = tmp_path_factory.mktemp("runs") / "a"
    argv = ["train", "--panel", str(panel), "--out", str(path), "--env-steps", "400", *TINY]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("restock.train.prepare.now_ns", lambda: BEGAN_NS)
        assert main(argv) == 0
    return path


def test_config_json_records_panel_task_and_versions(trained: Path, panel: Path) -> None:
    document = json.loads((trained / "config.json").read_text())
    header = json.loads((panel / "panel.json").read_text())
    assert document["panel"]["id"] == header["id"]
    assert document["panel"]["store"] == header["store"]  # `restock compare` compares it
    assert document["created_ns"] == BEGAN_NS
    assert document["panel"]["newest_ns"] == header["newest_ns"]
    assert document["task_hash"] == load_profile("warehouse_amr").task.hash
    assert document["target"] == {"rule": "polyak", "tau": 0.005, "effective_lag_updates": 200.0}
    assert document["seeds"]["run"] == 0
    assert set(document["versions"]) >= {"restock", "torch", "mujoco", "python"}
    # The forecast is for this run's draws: half logged rows online, all offline.
    forecast, planned = document["panel"]["forecast"], document["panel"]["planned_draws"]
    assert sum(row["wanted_share"] for row in forecast) == pytest.approx(1)
    logged = sum(row["logs_share"] for row in forecast)
    whole = planned["offline"] + planned["online"]
    assert logged == pytest.approx((planned["offline"] + planned["online"] / 2) / whole)
    assert document["config"]["epsilon"]["start"] == 0.2  # lower, after offline training


def test_online_batches_are_half_logged_rows(trained: Path) -> None:
    progress = pq.read_table(trained / "progress.parquet").to_pylist()
    assert list(dict.fromkeys(row["phase"] for row in progress)) == ["offline", "warmup", "online"]
    shares = {row["phase"]: row["logs_share"] for row in progress if row["updates"]}
    assert shares == {"offline": 1.0, "online": 0.5}
    audit = pq.read_table(trained / "audit.parquet").to_pylist()
    assert {row["behaviour_policy"] for row in audit} >= {"planner", "dqn"}


def test_age_of_logs_counts_from_run_start(trained: Path) -> None:
    """Measure age from the start of the run, not from the newest row of the store."""
    audit = pq.read_table(trained / "audit.parquet").to_pylist()
    assert all(264 < row["age_days"] < 265 for row in audit if row["source"] == "logs")
    days = pq.read_table(trained / "ages.parquet", filters=[("unit", "=", "days")]).to_pylist()
    assert {row["bucket"] for row in days} == {8}  # 256 to 511 days
    assert all(264 < row["p50"] < 265 for row in days)


def test_unfillable_quota_is_warned_about(tmp_path, capsys, shell):
    task = load_profile("warehouse_amr").task
    text = (
        "max_replays_per_row = 4\n[[strata]]\nname = 'nominal'\nshare = 0.5\n"
        "[[strata]]\nname = 'wheel_slip'\nshare = 0.5\ncorrection = 'none'\n"
        "[each_condition]\nshare = 'equal'\n"
    )
    rows = recording_transitions(1, episodes=40, task=task)
    few = build_panel(rows, parse_mixture(text), tmp_path / "panel", task=task)
    words = ["train", "--panel", str(few.path), "--out", str(tmp_path / "a"), *TINY, "--dry-run"]
    words += ["--env-steps", "9000"]
    assert "warning" not in shell.err(*words, code=0)  # the twin drives such missions
    assert main([*words, "--set", "env.conditions={nominal=1.0, wheel_slip=0.0}"]) == 0
    captured = capsys.readouterr()
    assert "warning: wheel_slip will be short by" in captured.err
    assert "and the twin has no fresh rows of it" in captured.err
    slip = next(
        row
        for row in json.loads(captured.out)["panel"]["forecast"]
        if row["stratum"] == "wheel_slip"
    )
    assert slip["short_share"] > 0.3


@pytest.mark.long  # test_loop.py checks it on the corridor
def test_resume_in_twin_is_bit_exact(tmp_path, panel, shell):
    base = ["train", "--panel", str(panel), *TINY]
    assert main([*base, "--out", str(tmp_path / "whole"), "--env-steps", "400"]) == 0
    assert main([*base, "--out", str(tmp_path / "parts"), "--env-steps", "240"]) == 0
    path = tmp_path / "parts"
    # Temporary files that a killed process leaves behind …
    (path / "checkpoints" / f".latest.safetensors.{2**22 + 1}.tmp").write_bytes(b"half")
    (path / f".progress.parquet.{2**22 + 1}.tmp").write_bytes(b"half")
    # … and files of other programs or of running processes.
    kept = [path / ".mine.tmp", path / "checkpoints" / ".mine.safetensors.x.tmp"]
    kept.append(path / f".progress.parquet.{os.getppid()}.tmp")
    for file in kept:
        file.write_bytes(b"not of that process")
    # A raised budget continues the run; only the evaluation at 240 is extra.
    assert "nothing to do: its budget of 240 environment" in shell.err(
        "train", "--resume", tmp_path / "parts", code=0
    )
    assert "nothing to do" not in shell.err(
        "train", "--resume", tmp_path / "parts", "--env-steps", "400", code=0
    )
    assert {file for file in path.rglob(".*") if file.is_file()} == set(kept)
    whole = checkpoint.load(tmp_path / "whole" / "checkpoints" / "latest.safetensors")
    parts = checkpoint.load(tmp_path / "parts" / "checkpoints" / "latest.safetensors")
    for name, value in whole["learner"]["network"].items():
        assert torch.equal(value, parts["learner"]["network"][name]), name
    np.testing.assert_equal(whole["ring"], parts["ring"])
    assert whole["exploration"] == parts["exploration"]


def test_locked_run_is_not_resumed(trained, shell):
    before = {file: file.read_bytes() for file in trained.rglob("*.safetensors")}
    lock = RunLock(trained)
    assert f"is being trained by process {os.getpid()}" in shell.err(
        "train", "--resume", trained, "--env-steps", "440"
    )
    lock.release()
    assert {file: file.read_bytes() for file in trained.rglob("*.safetensors")} == before


@pytest.mark.long
@pytest.mark.parametrize("ended_by", one_in(2, [signal.SIGINT, signal.SIGTERM]))
def test_sigint_and_sigterm_write_a_checkpoint(ended_by: signal.Signals, tmp_path: Path) -> None:
    path = tmp_path / "a"
    command = [sys.executable, "-m", "restock", "train", "--out", str(path), *TINY]
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"}
    )
    try:
        deadline = time.monotonic() + 120
        progress = path / "progress.parquet"
        while time.monotonic() < deadline and process.poll() is None:
            if progress.exists() and pq.read_metadata(progress).num_rows > 1:
                break
            time.sleep(0.2)
        process.send_signal(ended_by)
        _, complaint = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode == 130, complaint
    assert "stopping: a checkpoint is written" in complaint
    assert "restock train --resume" in complaint
    assert "Traceback" not in complaint
    stopped = checkpoint.load(path / "checkpoints" / "latest.safetensors")["progress"]["env_steps"]
    assert stopped > 0
    assert main(["train", "--resume", str(path), "--env-steps", str(stopped + 40)]) == 0


@pytest.mark.slow
@pytest.mark.parametrize("rows", [3, 6, 9])
def test_killed_run_resumes_bit_exactly(tmp_path: Path, rows: int) -> None:
    settings = [*TINY, "--env-steps", "800", "--set", "record.checkpoint_every_env_steps=120"]
    assert main(["train", "--out", str(tmp_path / "whole"), *settings]) == 0
    path = tmp_path / "killed"
    command = [sys.executable, "-m", "restock", "train", "--out", str(path), *settings]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        progress = path / "progress.parquet"
        while process.poll() is None:
            written = pq.read_metadata(progress).num_rows if progress.exists() else 0
            if written >= rows and (path / "checkpoints" / "latest.safetensors").exists():
                break
            time.sleep(0.01)
        process.kill()  # SIGKILL
    for table in path.glob("*.parquet"):
        pq.read_table(table)  # each table is readable
    assert main(["train", "--resume", str(path)]) == 0
    whole, killed = (
        checkpoint.load(tmp_path / name / "checkpoints" / "latest.safetensors")
        for name in ("whole", "killed")
    )
    for name, value in whole["learner"]["network"].items():
        assert torch.equal(value, killed["learner"]["network"][name]), name
    np.testing.assert_equal(whole["ring"], killed["ring"])
    for name in ("strata", "audit", "evaluations", "episodes", "evaluation_buffer"):
        whole_table, killed_table = (
            pq.read_table(tmp_path / run / f"{name}.parquet") for run in ("whole", "killed")
        )
        assert whole_table.equals(killed_table), name


@pytest.mark.parametrize(
    ("argv", "complaint"),
    [
        (["train"], "give --out RUN"),
        (["train", "--out", "{new}", "--set", "loss.gamma=1"], "unknown key `loss.gamma`"),
        (
            ["train", "--out", "{new}", "--set", "nonsense"],
            "'nonsense' is not of the form key=value",
        ),
        (["train", "--out", "{new}", "--config", "{missing}"], "cannot be read"),
        (["train", "--out", "{new}", "--device", "cuda"], "sees no CUDA device"),
        (["train", "--out", "{new}", "--panel", "{missing}"], "no such panel"),
        (["train", "--out", "{trained}"], "already exists"),
        (["train", "--resume", "{missing}"], "no such run"),
        (["train", "--resume", "{trained}", "--seed", "3"], "own panel, config and seed"),
        (["train", "--out", "{new}", "--panel", "{panel}", "--set", "loss.discount=0.9"], "0.99"),
        (["eval", "{missing}"], "no such run"),
        (["eval", "{trained}", "--policies", "nobody"], "there is no 'nobody'"),
        (["eval", "{trained}", "--perturbations", "rain"], "choose from none, friction"),
        (["eval", "{trained}", "--episodes", "-1"], "must be at least 1"),
    ],
)
def test_invalid_arguments_are_rejected_before_writing(
    argv, complaint, trained, panel, tmp_path, shell
):
    if "cuda" in argv and torch.cuda.is_available():
        pytest.skip("there is a CUDA device")
    places = {"new": tmp_path / "new", "missing": tmp_path / "no"}
    places |= {"trained": trained, "panel": panel}
    error = shell.err(*[part.format(**places) for part in argv])
    assert complaint in error
    assert "Traceback" not in error
    assert not (tmp_path / "new").exists()


def test_moved_panel_is_found_through_symlink(trained, panel, tmp_path, shell):
    run, moved = tmp_path / "run", tmp_path / "moved"
    shutil.copytree(trained, run)
    text = (run / "config.json").read_text().replace(str(panel), str(tmp_path / "panel"))
    (run / "config.json").write_text(text)
    shutil.copytree(panel, moved)
    resume = ["train", "--resume", str(run), "--dry-run"]
    assert "there is no panel here any more" in shell.err(*resume)
    (tmp_path / "panel").symlink_to(moved)
    assert main(resume) == 0


def test_panel_of_unknown_task_is_rejected(tmp_path, shell):
    build_panel(recording_transitions(1, episodes=40), MIXTURE, tmp_path / "panel")
    argv = ["train", "--panel", str(tmp_path / "panel"), "--out", str(tmp_path / "run")]
    error = shell.err(*argv)
    assert "no shipped profile has this task" in error
    assert "--set profile=my_robot.toml" in error
    error = shell.err(*argv, "--set", "profile=warehouse_amr")
    assert "observation, action or reward differ" in error
    assert "leave out `profile` in the config" in error
    assert load_profile("warehouse_amr").task.hash in error
    assert not (tmp_path / "run").exists()


def test_dry_run_writes_nothing(tmp_path, panel, shell):
    argv = ["train", "--panel", str(panel), "--out", str(tmp_path / "run"), "--seed", "7"]
    shown = json.loads(shell.out(*argv, "--dry-run"))
    assert shown["config"]["seed"] == 7
    assert not (tmp_path / "run").exists()


def test_docs_list_every_config_key_and_default() -> None:
    def flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name, value in values.items():
            nested = isinstance(value, dict) and value and name != "conditions"
            found |= flat(value, f"{prefix}{name}.") if nested else {f"{prefix}{name}": value}
        return found

    known = flat(msgspec.to_builtins(TrainConfig())) | {"target.every": None}
    page = (ROOT / "docs" / "train.md").read_text(encoding="utf-8")
    page = page.partition("## Every key of the config")[2].partition("\n## ")[0]
    rows = [line for line in page.splitlines() if line.startswith("| `")]
    listed = {line.split("`")[1]: line.split("|")[2].strip() for line in rows}
    assert listed.keys() == known.keys()
    numbers = {key: value for key, value in known.items() if type(value) in (int, float)}
    assert len(numbers) > 20
    assert {key: float(listed[key]) for key in numbers} == numbers
