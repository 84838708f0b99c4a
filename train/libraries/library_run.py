"""The run directory of a training loop that another library owns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from restock.ingest.profile.profile import Profile
from restock.replay.panel.panel import Panel
from restock.train.feed.fresh_log import values_entries
from restock.train.run.run import Run, now_ns, panel_document, software_versions
from restock.train.run.run_tables import TABLES

# Of an episode that ended, by the info of its last step.
_TOLD = ("episode_seed", "perturbation", "block", "success", "bumps")


def create_run(
    path: Path, library: str, profile: Profile, panel: Panel | None, settings: dict[str, Any]
) -> Run:
    """Make the run: its config says which library, buffer settings and panel.

    Raises RunError when something is at `path` already.
    """
    return Run.create(
        path,
        {
            "created_ns": now_ns(),
            "library": {"name": library, "version": version(library)},
            "config": settings,
            "panel": _fed(panel),
            "task_hash": profile.task.hash,
            "labels_version": profile.labels_version,
            "profile": {"name": profile.name, "hash": profile.hash},
            "seeds": {"run": settings["seed"]},
            "versions": software_versions() | {library: version(library)},
        },
    )


class NullsForNaN:
    """A run whose NaNs are nulls: what a library keeps to itself is not known here."""

    def __init__(self, run: Run) -> None:
        self.run = run

    def append(self, table: str, rows: Sequence[Mapping[str, Any]]) -> None:
        self.run.append(table, [{k: known(v) for k, v in row.items()} for row in rows])

    def append_columns(self, table: str, columns: Mapping[str, Any]) -> None:
        self.run.append_columns(table, {k: column(v) for k, v in columns.items()})


def column(values: Any) -> Any:
    """A column, or one value for all rows, without NaNs."""
    if isinstance(values, np.ndarray) and values.dtype.kind == "f" and np.isnan(values).any():
        return [known(value) for value in values.tolist()]
    return known(values)


def known(value: Any) -> Any:
    """A value, or None for NaN."""
    return None if isinstance(value, float) and value != value else value


def _fed(panel: Panel | None) -> dict[str, Any] | None:
    if panel is None:
        return None
    strata = {stratum.name: stratum.share for stratum in panel.strata}
    return {**panel_document(panel), "strata": strata}


def episode_row(env: int, key: int, info: Mapping[str, Any]) -> dict[str, Any]:
    """A row of `episodes`, as far as the last step's info tells."""
    columns = set(TABLES["episodes"].names)
    told = {"env": env, "episode": key, "conditions": []}
    told |= {name: _plain(info[name]) for name in _TOLD if name in info}
    if "episode_condition" in info:
        told["true_condition"] = _plain(info["episode_condition"])
    if "perturbation_values" in info:
        told["perturbation_values"] = values_entries(str(_plain(info["perturbation_values"])))
    if "episode_steps" in info:
        told["steps"] = _plain(info["episode_steps"])
    return {name: value for name, value in told.items() if name in columns}


def _plain(value: Any) -> Any:
    return value.item() if hasattr(value, "item") else value
