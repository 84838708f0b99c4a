"""W&B and MLflow as sinks of a run's curves, its config, and the panel that it was fed.

Both stay on this machine unless their own environment variables say otherwise: W&B is offline
(`WANDB_MODE=online`, or `wandb sync` later), MLflow's store is a file in the run's directory
(`MLFLOW_TRACKING_URI`).
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from restock.errors import ConfigError
from restock.imports import install_command, installed
from restock.toml import by_path
from restock.train.run.events import Sink, tracked
from restock.train.run.run import Run

PROJECT = "restock"  # unless WANDB_PROJECT or MLFLOW_EXPERIMENT_NAME names another
_PANEL = ("id", "path", "store", "store_version", "others")
_MAX_PARAMS = 100  # that MLflow takes at a time
_MAX_VALUE = 500  # characters that every MLflow store takes


def require_trackers(names: Sequence[str]) -> None:
    """Refuse trackers that are not installed, before anything is written.

    Raises:
        ConfigError: names the first, and how it is installed.
    """
    for name in names:
        if not installed(name):
            raise ConfigError(
                f"{name} is not installed",
                where="record.trackers",
                remedy=f"{install_command('track')}, or leave it out",
            )


def tracker_sinks(run: Run, names: Sequence[str]) -> dict[str, Callable[[], Sink]]:
    """Return what opens each of these trackers for a run, a new one or one that goes on."""
    kinds: dict[str, Callable[[], Sink]] = {
        "wandb": lambda: WandbSink(run),
        "mlflow": lambda: MlflowSink(run),
    }
    return {name: kinds[name] for name in names}


def _settings(run: Run) -> dict[str, Any]:
    """Return the run's config, and the panel and stores that it was fed."""
    panel = run.document.get("panel") or {}
    return {**run.document["config"], "panel": {key: panel.get(key) for key in _PANEL}}


class WandbSink:
    """A run of Weights & Biases, its files in `RUN/wandb`."""

    name = "wandb"

    def __init__(self, run: Run) -> None:
        import wandb

        known = tracked(run.path).get("wandb", {})
        init: Any = wandb.init
        self._run: Any = init(
            project=os.environ.get("WANDB_PROJECT", PROJECT),
            name=run.path.name,
            id=known.get("id"),
            resume="allow" if known else None,
            dir=str(run.path),
            mode=os.environ.get("WANDB_MODE", "offline"),
            config=_settings(run),
            settings=wandb.Settings(console="off", silent=True, disable_git=True),
        )

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        self._run.log(dict(values), step=step)

    def flush(self) -> None:
        """Do nothing: W&B's own process writes as it goes."""

    def close(self) -> None:
        self._run.finish()

    def describe(self) -> dict[str, Any]:
        return {"id": self._run.id, "project": self._run.project}


class MlflowSink:
    """A run of MLflow, in `RUN/mlflow.db` or where MLFLOW_TRACKING_URI says."""

    name = "mlflow"

    def __init__(self, run: Run) -> None:
        os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
        # With a server that is gone, its default is seven attempts of two minutes each.
        os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
        os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "10")
        from mlflow.entities import Param
        from mlflow.tracking import MlflowClient

        own = f"sqlite:///{run.path.absolute() / 'mlflow.db'}"
        known = tracked(run.path).get("mlflow", {})
        self._uri = known.get("uri") or os.environ.get("MLFLOW_TRACKING_URI", own)
        self._client: Any = MlflowClient(self._uri)
        self._id: str = known.get("run_id", "")
        if self._id:
            self._client.update_run(self._id, status="RUNNING")
            return
        name = os.environ.get("MLFLOW_EXPERIMENT_NAME", PROJECT)
        experiment = self._client.get_experiment_by_name(name)
        number = experiment.experiment_id if experiment else self._client.create_experiment(name)
        self._id = self._client.create_run(number, run_name=run.path.name).info.run_id
        params = [Param(key, str(value)[:_MAX_VALUE]) for key, value in by_path(_settings(run))]
        for begin in range(0, len(params), _MAX_PARAMS):
            self._client.log_batch(self._id, params=params[begin : begin + _MAX_PARAMS])

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        from mlflow.entities import Metric

        now_ms = time.time_ns() // 1_000_000
        metrics = [Metric(name, value, now_ms, step) for name, value in values.items()]
        self._client.log_batch(self._id, metrics=metrics)

    def flush(self) -> None:
        """Do nothing: every call is written at once."""

    def close(self) -> None:
        self._client.set_terminated(self._id)

    def describe(self) -> dict[str, Any]:
        return {"run_id": self._id, "uri": self._uri}


__all__ = ["require_trackers", "tracker_sinks"]
