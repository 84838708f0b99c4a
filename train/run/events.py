"""One stream of scalars by environment step, and its sinks: TensorBoard, W&B and MLflow.

A sink that fails never ends a run: its failed calls are counted, the first reason is printed, and
after some failures in a row it is disabled. `RUN/tracking.json` has the counts, and the run's ids
in W&B and MLflow.

W&B and MLflow write only to this machine unless you set their environment variables: W&B is offline
(`WANDB_MODE=online`, or `wandb sync` later), MLflow's store is a file in the run's directory
(`MLFLOW_TRACKING_URI`).
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from restock.files import first_line, write_text
from restock.toml import by_path
from restock.train.run.run import Run

TRACKING = "tracking.json"
GIVE_UP_AFTER = 3  # failed calls in a row that disable a sink: each may wait for a server's timeout


class Sink(Protocol):
    """A receiver of one run's curves. Errors of its methods are caught and counted."""

    name: str

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Write numbers by `group/name`, measured after `step` environment steps."""

    def flush(self) -> None:
        """Make everything written so far readable."""

    def close(self) -> None:
        """Close the sink."""

    def describe(self) -> dict[str, Any]:
        """Return the ids and addresses of the run."""


class TensorBoard:
    """Event files in `RUN/tensorboard`."""

    name = "tensorboard"

    def __init__(self, folder: Path, from_step: int | None) -> None:
        from torch.utils.tensorboard import SummaryWriter

        # After a resume, points later than the checkpoint are removed.
        self._writer: Any = SummaryWriter(str(folder), purge_step=from_step)

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)

    def flush(self) -> None:
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()

    def describe(self) -> dict[str, Any]:
        return {}


@dataclass
class _Failures:
    """The number of a sink's failed calls, and the first error."""

    failed: int = 0
    in_a_row: int = 0
    first: str = ""


class Events:
    """A fan-out of numbers to all sinks.

    Args:
        run: the run's directory.
        sinks: name -> a function that opens the sink.
        say: called when a sink first fails, when it is disabled, and at the end with the counts.
    """

    def __init__(
        self,
        run: Path | None = None,
        sinks: Mapping[str, Callable[[], Sink]] | None = None,
        say: Callable[[str], None] | None = None,
    ) -> None:
        self._run, self._say = run, say or _to_stderr
        self._open: list[Sink] = []
        self.failures: dict[str, _Failures] = {name: _Failures() for name in sinks or {}}
        for name, opens in (sinks or {}).items():
            self._try(name, lambda opens=opens: self._open.append(opens()))  # type: ignore[misc]
        self._write()

    def scalars(self, step: int, prefix: str, values: Mapping[str, Any]) -> None:
        """Write every number in `values` as `prefix/name`; other values are ignored."""
        numbers = {
            f"{prefix}/{name}": float(value)
            for name, value in values.items()
            if isinstance(value, int | float) and not isinstance(value, bool)
        }
        for sink in list(self._open):
            self._try(sink.name, lambda sink=sink: sink.scalars(step, numbers))  # type: ignore[misc]

    def flush(self) -> None:
        """Flush every sink, and update `tracking.json`."""
        for sink in list(self._open):
            self._try(sink.name, sink.flush)
        self._write()

    def close(self) -> None:
        """Close every sink, and report failed calls."""
        for sink in list(self._open):
            self._try(sink.name, sink.close)
        for name, count in self.failures.items():
            if count.failed:
                calls = "call" if count.failed == 1 else "calls"
                self._say(f"{name} failed in {count.failed} {calls}; first: {count.first}")
        self._write()
        self._open = []

    def _try(self, name: str, call: Callable[[], object]) -> None:
        count = self.failures[name]
        try:
            call()
        except Exception as error:  # noqa: BLE001 - a tracker's own library may raise anything
            count.failed += 1
            count.in_a_row += 1
            if count.failed == 1:
                count.first = f"{type(error).__name__}: {first_line(error)}"
                self._say(f"{name} failed, training continues: {count.first}")
            if count.in_a_row == GIVE_UP_AFTER:
                self._open = [sink for sink in self._open if sink.name != name]
                self._say(f"{name} failed {GIVE_UP_AFTER} times in a row: disabled from here on")
        else:
            count.in_a_row = 0

    def _write(self) -> None:
        described = {sink.name: sink.describe() for sink in self._open if sink.describe()}
        failed = {
            name: {"failed": count.failed, "first": count.first}
            for name, count in self.failures.items()
            if count.failed
        }
        if self._run is None or not (described or failed):
            return
        known = tracked(self._run)
        known.update(described)
        if failed:
            known["failures"] = failed
        write_text(self._run / TRACKING, json.dumps(known, indent=1) + "\n")


def tracked(run: Path) -> dict[str, Any]:
    """Read `RUN/tracking.json`; empty if it does not exist or cannot be read."""
    try:
        known = json.loads((run / TRACKING).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return known if isinstance(known, dict) else {}


def _to_stderr(text: str) -> None:
    sys.stderr.write(f"{text}\n")


PROJECT = "restock"  # project's name, unless WANDB_PROJECT or MLFLOW_EXPERIMENT_NAME is set
_PANEL = ("id", "path", "store", "store_version", "others")
_MAX_PARAMS = 100  # parameters per call of MLflow
_MAX_VALUE = 500  # longest value of a parameter, in characters, that every MLflow store accepts


def tracker_sinks(
    run: Run, names: Sequence[str], from_step: int | None = None
) -> dict[str, Callable[[], Sink]]:
    """Return a function per tracker that opens it; `from_step` is the step of a resumed run."""
    kinds: dict[str, Callable[[], Sink]] = {
        "tensorboard": lambda: TensorBoard(run.path / "tensorboard", from_step),
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
        """Do nothing: W&B writes continuously, in a process of its own."""

    def close(self) -> None:
        self._run.finish()

    def describe(self) -> dict[str, Any]:
        return {"id": self._run.id, "project": self._run.project}


class MlflowSink:
    """A run of MLflow, in `RUN/mlflow.db` or at MLFLOW_TRACKING_URI."""

    name = "mlflow"

    def __init__(self, run: Run) -> None:
        os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
        # By default, MLflow tries an unreachable server seven times, two minutes each.
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
