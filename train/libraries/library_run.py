"""The run directory of another library's loop: what it says of itself, and tables with gaps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from restock.ingest.profile.profile import Profile
from restock.replay.panel.panel import Panel
from restock.train.feed.collector import conditions_in_twin
from restock.train.feed.fresh_log import values_entries
from restock.train.run.run import Run, now_ns, panel_document, software_versions
from restock.train.run.run_profile import profile_document
from restock.train.run.run_tables import TABLES

# Of an episode that ended, by the info of its last step.
_INFO = ("episode_seed", "perturbation", "block", "success", "bumps")


def create_run(
    path: Path,
    library: Mapping[str, Any],
    profile: Profile,
    panel: Panel | None,
    config: Any,
    *,
    seeds: Mapping[str, int],
    **more: Any,
) -> Run:
    """Make the run of a library by its distribution's `name`: its `config.json` says all of this.

    Raises RunError when something is at `path` already.
    """
    name = library["name"]
    mixed = None
    if panel is not None:
        strata = {stratum.name: stratum.share for stratum in panel.strata}
        mixed = {**panel_document(panel), "strata": strata}
    return Run.create(
        path,
        {
            "created_ns": now_ns(),
            "library": {"version": version(name), **library},
            "config": config,
            "panel": mixed,
            **more,
            **profile_document(profile),
            "not_evaluated": conditions_in_twin(
                profile.conditions, profile.signals, lidar=profile.task.lidar
            )[1],
            "seeds": seeds,
            "versions": software_versions() | {name: version(name)},
        },
    )


class PartialTables:
    """A run's tables, null where a value is missing or NaN: what a library keeps to itself."""

    def __init__(self, run: Run) -> None:
        self.run = run

    def append(self, table: str, rows: Sequence[Mapping[str, Any]]) -> None:
        blank = dict.fromkeys(TABLES[table].names)
        self.run.append(table, [blank | {k: known(v) for k, v in row.items()} for row in rows])

    def append_columns(self, table: str, columns: Mapping[str, Any]) -> None:
        self.run.append_columns(table, {k: column(v) for k, v in columns.items()})


def column(values: Any) -> Any:
    """Return a column, or one value for all rows, without NaNs."""
    if isinstance(values, np.ndarray) and values.dtype.kind == "f" and np.isnan(values).any():
        values = values.tolist()
    return [known(value) for value in values] if isinstance(values, list) else known(values)


def known(value: Any) -> Any:
    """Return a value, or None for NaN."""
    return None if isinstance(value, float) and value != value else value


def episode_row(env: int, key: int, info: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row of `episodes`, as far as the last step's info tells."""
    columns = set(TABLES["episodes"].names)
    row = {"env": env, "episode": key, "conditions": []}
    row |= {name: _plain(info[name]) for name in _INFO if name in info}
    if "episode_condition" in info:
        row["true_condition"] = _plain(info["episode_condition"])
    if "perturbation_values" in info:
        row["perturbation_values"] = values_entries(str(_plain(info["perturbation_values"])))
    if "episode_steps" in info:
        row["steps"] = _plain(info["episode_steps"])
    return {name: value for name, value in row.items() if name in columns}


def _plain(value: Any) -> Any:
    return value.item() if hasattr(value, "item") else value


__all__ = ["PartialTables", "create_run", "episode_row"]
