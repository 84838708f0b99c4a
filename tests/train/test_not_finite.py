"""Check that non-finite numbers stop a run, name the rows and leave its files intact."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from support.kept_run import TASK
from support.stores import recording_transitions
from support.toy_run import assert_same_run, config, logs, run_to_end, session

from restock.cli import main
from restock.replay.mixture.mixture import parse_mixture
from restock.replay.panel.build import build_panel
from restock.train.feed.batch_record import STOPPED, NotFinite
from restock.train.loop import check_parameters, train
from restock.train.run import checkpoint
from restock.train.run.run import Run

TINY = [
    *("--set", "env.num_envs=4", "--set", "schedule.offline_updates=30"),
    *("--set", "network.hidden=[32, 32]", "--set", "evaluation.episodes=1"),
    *("--set", "record.every_updates=20", "--set", "record.trackers=[]"),
    *("--set", "replay.batch_size=32", "--env-steps", "80"),
]


@pytest.fixture(scope="module")
def panel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("panels") / "panel"
    mixture = parse_mixture(
        "[each_condition]\nshare = 'natural'\n[evaluation_split]\nby = 'none'\n"
    )
    build_panel(recording_transitions(1, episodes=40, task=TASK), mixture, path, task=TASK)
    return path


def test_changed_panel_byte_is_rejected_before_training(panel, tmp_path, shell):
    out = tmp_path / "run"
    rows = panel / "rows.f32"
    whole = rows.read_bytes()
    rows.chmod(0o644)
    try:
        at = 6003  # in an exponent, between two blocks that are checked on every open
        rows.write_bytes(whole[:at] + bytes([whole[at] ^ 0x7F]) + whole[at + 1 :])
        for argv in (["--dry-run"], []):
            error = shell.err("train", "--panel", panel, "--out", out, *TINY, *argv)
            assert f"{rows}: its checksum is" in error
            assert "make it again with `restock mix`" in error
            assert not out.exists()
    finally:
        rows.write_bytes(whole)
    assert main(["train", "--panel", str(panel), "--out", str(out), *TINY]) == 0
    header = json.loads((panel / "panel.json").read_text())
    recorded = json.loads((out / "config.json").read_text())["panel"]["blake3"]
    assert recorded == {name: file["blake3"] for name, file in header["files"].items()}

    # Resuming reads the rows, so it checks them again.
    rows.write_bytes(whole[:at] + bytes([whole[at] ^ 0x7F]) + whole[at + 1 :])
    try:
        assert "its checksum is" in shell.err("train", "--resume", out, "--env-steps", "120")
    finally:
        rows.write_bytes(whole)


def test_nonfinite_loss_exits_with_code_2(panel, tmp_path, shell):
    out = tmp_path / "run"
    argv = ["train", "--panel", str(panel), "--out", str(out), *TINY]
    error = shell.err(*argv, "--set", "optimizer.learning_rate=1e30")
    assert f"{out}: the loss is " in error
    assert "panel row" in error
    assert "lower optimizer.learning_rate" in error
    assert "Traceback" not in error
    stopped = json.loads((out / STOPPED).read_text())
    assert len(stopped["rows"]) == len(stopped["rows_before"]) == 32
    Run.open(out)  # every table is there
    assert main(["sql", str(out), "FROM progress"]) == 0
    assert not (out / "checkpoints").exists()  # no checkpoint was written


def test_nonfinite_logged_row_is_named(tmp_path: Path) -> None:
    given = logs()
    rows = given.rows.clone()
    rows[77, 2] = float("nan")
    live = session(tmp_path / "run", config(), logs=dataclasses.replace(given, rows=rows))
    with pytest.raises(NotFinite, match=r"1 of the 32 rows .* panel row 77 \(transition 1077\)"):
        train(live)
    live.close()
    stopped = json.loads((live.run.path / STOPPED).read_text())
    assert [row["panel_row"] for row in stopped["rows"] if row["named"]] == [77]
    assert stopped["gradient_steps"] == live.learner.gradient_steps


def test_nonfinite_fresh_row_names_episode_and_step(tmp_path: Path) -> None:
    live = session(tmp_path / "run", config(), logs=None)
    ring = live.ring

    def break_one(event: str, values: dict[str, object]) -> None:
        if event == "progress" and values["phase"] == "warmup":
            ring.rows[5, 0] = np.inf

    with pytest.raises(NotFinite, match=r"hold values that are not finite: step \d+ of the twin's"):
        train(live, notify=break_one)
    live.close()
    stopped = json.loads((live.run.path / STOPPED).read_text())
    named = {(row["episode"], row["episode_step"]) for row in stopped["rows"] if row["named"]}
    assert named == {(int(ring.meta["episode"][5]), int(ring.meta["episode_step"][5]))}


def test_nonfinite_network_is_not_saved(tmp_path: Path) -> None:
    settings = config(schedule={"env_steps": 800})
    live = session(tmp_path / "run", settings)
    seen: list[str] = []

    def break_it(event: str, values: dict[str, object]) -> None:
        seen.append(event)
        if len(seen) == 6:
            with torch.no_grad():
                next(live.learner.network.parameters())[0, 0] = float("nan")

    with pytest.raises(NotFinite):
        train(live, notify=break_it)
    with pytest.raises(NotFinite, match=r"the gradient was not finite.* rows of the batch gave it"):
        check_parameters(live)
    live.close()
    for kept in (live.run.latest, live.run.best):
        state = checkpoint.load(kept)
        network = state["learner"]["network"] if "learner" in state else state["network"]
        assert all(torch.isfinite(value).all() for value in network.values())
    losses = pq.read_table(live.run.path / "progress.parquet")["loss"].drop_null().to_numpy()
    assert np.isfinite(losses).all()
    # The run resumes from its last finite state, like an uninterrupted one.
    again = session(tmp_path / "run", settings, resume=True)
    train(again)
    again.close()
    assert_same_run(run_to_end(tmp_path / "whole", settings), again)
