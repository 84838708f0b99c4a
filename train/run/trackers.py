"""W&B and MLflow as sinks of a run's curves, its config, and the panel and stores it was fed.

Both stay on this machine unless their own environment variables say otherwise: W&B is offline
(`WANDB_MODE=online`, or `wandb sync` later), MLflow's store is a file in the run's directory
(`MLFLOW_TRACKING_URI`).
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from restock.errors import ConfigError
from restock.imports import install_command, installed
from restock.toml import by_path
from restock.train.run.events import Sink, tracked
from restock.train.run.run import Run

PROJECT = "restock"  # where WANDB_PROJECT or MLFLOW_EXPERIMENT_NAME name no other
_PARAMS = 100  # that MLflow takes at a time
_LONGEST = 500  # characters of a value that every MLflow store takes


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
    """What opens each of these trackers for a run, a new one or one that goes on."""
    kinds: dict[str, Callable[[], Sink]] = {
        "wandb": lambda: WandbSink(run),
        "mlflow": lambda: MlflowSink(run),
    }
    return {name: kinds[name] for name in names}


@dataclass(frozen=True)
class Fed:
    """A panel or store that a run was fed: what trackers call an artifact, a data set, an input."""

    kind: str  # panel | store
    name: str
    id: str  # a panel's id, a store's version
    path: str
    facts: Mapping[str, Any]


def fed_by(document: Mapping[str, Any]) -> list[Fed]:
    """The panel of a run's `config.json`, and the stores that it was made from."""
    panel = document.get("panel")
    if not panel:
        return []
    facts = {key: panel.get(key) for key in ("rows", "n_step", "labels_version", "store_version")}
    fed = [Fed("panel", f"panel-{panel['id']}", panel["id"], panel["path"], facts)]
    stores = [(panel.get("store"), panel.get("store_version"))]
    stores += [(other.get("path"), other.get("version")) for other in panel.get("others", [])]
    for path, version in stores:
        if path and version is not None and version >= 0:
            name = re.sub(r"[^\w.-]+", "-", Path(path).name) or "store"
            facts = {"path": path, "version": version}
            fed.append(Fed("store", f"store-{name}-v{version}", str(version), path, facts))
    return fed


class WandbSink:
    """A run of Weights & Biases, its files in `RUN/wandb`."""

    name = "wandb"

    def __init__(self, run: Run) -> None:
        import wandb

        known = tracked(run.path).get("wandb", {})
        self._mode = os.environ.get("WANDB_MODE", "offline")
        init: Any = wandb.init
        self._run: Any = init(
            project=os.environ.get("WANDB_PROJECT", PROJECT),
            name=run.path.name,
            id=known.get("id"),
            resume="allow" if known else None,
            dir=str(run.path),
            mode=self._mode,
            config=dict(run.document["config"]),
            settings=wandb.Settings(console="off", silent=True, disable_git=True),
        )
        for fed in [] if known else fed_by(run.document):
            artifact = wandb.Artifact(fed.name, type=fed.kind, metadata={"id": fed.id, **fed.facts})
            if Path(fed.path).exists():  # W&B looks at what it refers to
                artifact.add_reference(Path(fed.path).absolute().as_uri(), checksum=False)
            # Offline there is nobody to ask for it: it is recorded as this run's own.
            (self._run.use_artifact if self._mode == "online" else self._run.log_artifact)(artifact)

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        self._run.log(dict(values), step=step)

    def flush(self) -> None:
        """W&B's own process writes as it goes."""

    def close(self) -> None:
        self._run.finish()

    def describe(self) -> dict[str, Any]:
        return {"id": self._run.id, "project": self._run.project, "mode": self._mode}


class MlflowSink:
    """A run of MLflow, in `RUN/mlflow.db` or where MLFLOW_TRACKING_URI says."""

    name = "mlflow"

    def __init__(self, run: Run) -> None:
        os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
        # A server that is gone: its default is seven attempts of two minutes each.
        os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
        os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "10")
        from mlflow.entities import Dataset, DatasetInput, InputTag, Param
        from mlflow.tracking import MlflowClient

        own = f"sqlite:///{run.path.absolute() / 'mlflow.db'}"
        known = tracked(run.path).get("mlflow", {})
        self._uri = known.get("uri") or os.environ.get("MLFLOW_TRACKING_URI", own)
        self._client: Any = MlflowClient(self._uri)
        if known:
            self._id: str = known["run_id"]
            self._client.update_run(self._id, status="RUNNING")
            return
        name = os.environ.get("MLFLOW_EXPERIMENT_NAME", PROJECT)
        experiment = self._client.get_experiment_by_name(name)
        number = experiment.experiment_id if experiment else self._client.create_experiment(name)
        self._id = self._client.create_run(number, run_name=run.path.name).info.run_id
        params = (Param(k, str(v)[:_LONGEST]) for k, v in by_path(run.document["config"]))
        while some := list(islice(params, _PARAMS)):
            self._client.log_batch(self._id, params=some)
        inputs = [
            DatasetInput(
                Dataset(fed.name, fed.id, "local", fed.path),
                [InputTag("mlflow.data.context", f"training, {fed.kind}")],
            )
            for fed in fed_by(run.document)
        ]
        if inputs:
            self._client.log_inputs(self._id, datasets=inputs)

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        from mlflow.entities import Metric

        now_ms = time.time_ns() // 1_000_000
        metrics = [Metric(name, value, now_ms, step) for name, value in values.items()]
        self._client.log_batch(self._id, metrics=metrics)

    def flush(self) -> None:
        """Every call is written at once."""

    def close(self) -> None:
        self._client.set_terminated(self._id)

    def describe(self) -> dict[str, Any]:
        return {"run_id": self._id, "uri": self._uri}


__all__ = ["fed_by", "require_trackers", "tracker_sinks"]
