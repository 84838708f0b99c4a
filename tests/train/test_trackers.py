"""Check tracking in W&B and MLflow, and failing trackers."""

import importlib.util
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import pytest
from support.toy_run import config as toy_config
from support.toy_run import run_to_end

from restock.process import install_command
from restock.train.dqn.config import TrainConfig
from restock.train.run.events import GIVE_UP_AFTER, Events, tracked, tracker_sinks
from restock.train.run.run import Run

PANEL = {
    **{"id": "2564c94a221d4c16", "path": "/data/panel", "store": "/data/store"},
    **{"store_version": 3, "rows": 10, "n_step": 3, "labels_version": "l"},
    "others": [{"path": "s3://bucket/fleet", "version": 8}],
}
CURVES = [(100, {"loss": 2.0, "phase": "online"}), (200, {"loss": 0.5, "q_mean": 1.5})]


class FailingTracker:
    """Tracker that fails on every value."""

    name = "mlflow"

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        raise ConnectionError("the server is gone")

    def flush(self) -> None:
        pass

    def close(self) -> None:
        pass

    def describe(self) -> dict[str, Any]:
        return {"uri": "http://tracker"}


def make_run(path: Path) -> Run:
    panel = path.with_name("panel")
    panel.mkdir()
    (panel / "panel.json").write_text("{}")
    config = msgspec.to_builtins(TrainConfig())
    return Run.create(path, {"config": config, "panel": PANEL | {"path": str(panel)}})


def log_curves(run: Run, name: str) -> Events:
    """Log CURVES of a run to one tracker."""
    events = Events(run.path, tracker_sinks(run, [name]))
    for step, values in CURVES:
        events.scalars(step, "train", values)
    events.close()
    return events


def test_failing_tracker_does_not_stop_training(tmp_path, monkeypatch, capsys):
    def refuses() -> FailingTracker:
        raise OSError("no route to host")

    def sinks(run: Run, names: Any, from_step: int | None) -> dict[str, Any]:
        return {"wandb": refuses, "mlflow": FailingTracker} if names else {}

    monkeypatch.setattr("restock.train.session.tracker_sinks", sinks)
    budget = {"env_steps": 240, "warmup_env_steps": 60, "offline_updates": 10}
    settings = toy_config(
        schedule=budget, record={"trackers": ["wandb", "mlflow"], "every_updates": 10}
    )
    ended = run_to_end(tmp_path / "a", settings)
    assert ended.progress.env_steps == 240
    assert ended.run.table("progress").num_rows > GIVE_UP_AFTER
    failures = tracked(tmp_path / "a")["failures"]
    assert failures["wandb"] == {"failed": 1, "first": "OSError: no route to host"}
    assert failures["mlflow"]["failed"] == GIVE_UP_AFTER
    assert "wandb failed, training continues" in capsys.readouterr().err


def test_missing_tracker_is_reported_before_training(tmp_path, monkeypatch, shell):
    find = importlib.util.find_spec

    def absent(name: str, package: str | None = None) -> Any:
        return None if name == "wandb" else find(name, package)

    monkeypatch.setattr(importlib.util, "find_spec", absent)
    words = ["train", "--out", str(tmp_path / "run"), "--set", 'record.trackers=["wandb"]']
    reported = shell.err(*words)
    assert "needs wandb, which is not installed" in reported
    assert install_command("track") in reported
    assert not (tmp_path / "run").exists()


def test_mlflow_has_the_curves_config_and_panel(tmp_path, monkeypatch):
    pytest.importorskip("mlflow", reason="mlflow is not installed: restock[track]")
    from mlflow.tracking import MlflowClient

    uri = (tmp_path / "mlruns").as_uri()
    monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    run = make_run(tmp_path / "a")
    events = log_curves(run, "mlflow")
    assert events.failures["mlflow"].failed == 0
    known = tracked(run.path)["mlflow"]
    assert known["uri"] == uri
    client = MlflowClient(uri)
    kept = client.get_run(known["run_id"])
    history = client.get_metric_history(known["run_id"], "train/loss")
    assert [(metric.step, metric.value) for metric in history] == [(100, 2.0), (200, 0.5)]
    assert kept.data.metrics == {"train/loss": 0.5, "train/q_mean": 1.5}
    assert kept.data.params["loss.discount"] == "0.99"
    assert kept.info.status == "FINISHED"
    assert kept.data.params["panel.id"] == PANEL["id"]
    assert kept.data.params["panel.store_version"] == "3"
    # A resumed run continues the same MLflow run.
    again = Events(run.path, tracker_sinks(run, ["mlflow"]))
    again.scalars(300, "train", {"loss": 0.25})
    again.close()
    assert tracked(run.path)["mlflow"] == known
    history = client.get_metric_history(known["run_id"], "train/loss")
    assert [metric.step for metric in history] == [100, 200, 300]
