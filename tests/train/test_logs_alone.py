"""Train with `env.twin = false`, from the logs alone."""

from pathlib import Path

import pytest
from support.paths import ROOT

from restock.cli import main
from restock.train.run.run import Run
from restock.train.twin.env import vector_env

TINY = [
    *("schedule.offline_updates=30", "network.hidden=[8]", "replay.batch_size=16"),
    *("record.trackers=[]", "record.every_updates=10"),
]


def flags(*settings: str) -> list[str]:
    return [word for text in (*settings, *TINY) for word in ("--set", text)]


@pytest.fixture(scope="module")
def panel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs_alone")
    recording, store = str(ROOT / "sample_logs" / "amr_tuesday"), str(folder / "store")
    assert main(["ingest", recording, "--store", store]) == 0
    mixture = folder / "mix.toml"
    mixture.write_text("[each_condition]\nshare = 'natural'\n[evaluation_split]\nshare = 0.3\n")
    assert main(["mix", store, "--mixture", str(mixture), "--out", str(folder / "panel")]) == 0
    return folder / "panel"


@pytest.mark.long
def test_training_without_twin_keeps_last_policy(panel, tmp_path, monkeypatch, quick_models, shell):
    def refuse(*given: object, **named: object) -> None:
        raise AssertionError("a twin was made")

    monkeypatch.setattr(vector_env, "WarehouseVectorEnv", refuse)
    out = tmp_path / "run"
    argv = ["train", "--panel", str(panel), "--out", str(out)]
    document = shell.json(*argv, *flags("env.twin=false", "teacher.source=logs"))
    assert (document["env_steps"], document["gradient_steps"]) == (0, 30)
    assert document["best"] is document["last"] is None
    run = Run.open(out)
    assert run.best.is_file()
    assert not run.table("evaluations").num_rows
    assert run.document["config"]["schedule"]["env_steps"] == 0
    assert shell.json("train", "--resume", out)["gradient_steps"] == 30  # already finished

    assert main(["eval", str(out), "--on-logs", "own"]) == 0
    assert main(["report", str(out)]) == 0
    page = (out / "report.html").read_text("utf-8")
    assert "0 environment steps" not in page
    title = page.split("<h1>")[1].split("</h1>")[0]
    assert "held-out logs alone: success" in title or "too few to evaluate it" in title
    assert "success per condition" not in page
    assert main(["report", str(out), "--card"]) == 0


def test_training_without_twin_needs_logs(panel, tmp_path, shell):
    argv = ["train", "--out", str(tmp_path / "run")]
    assert "there is no panel" in shell.err(*argv, *flags("env.twin=false"))
    requested = flags("env.twin=false", "teacher.source=operator")
    assert "needs the twin" in shell.err(*argv, "--panel", panel, *requested)
    assert not (tmp_path / "run").exists()
