"""How arms learnt, over seeds, and what that cost: success over environment steps, and time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from restock.errors import RunError
from restock.stats import paired_t
from restock.train.run.run import Run


def learning_curves(arms: dict[str, Sequence[Path]]) -> list[dict[str, Any]]:
    """A row an arm, condition and periodic evaluation: mean success over its runs, and the 95 %
    interval (Student's t over runs), None where `paired_t` has none. Runs that cannot be read are
    left out.

    Partly and wholly blocked aisles count by half each, however many of each were drawn.
    """
    rows = []
    for arm, paths in arms.items():
        values: dict[tuple[str, int], list[float]] = {}
        for path in paths:
            for key, success in _of_run(path).items():
                values.setdefault(key, []).append(success)
        for (condition, step), found in sorted(values.items()):
            interval = paired_t(np.array(found))[0].within(0.0, 1.0)
            known = not np.isnan(interval.low)
            rows.append(
                {
                    **{"arm": arm, "condition": condition, "env_steps": step},
                    **{"runs": len(found), "success": interval.value},
                    "low": interval.low if known else None,
                    "high": interval.high if known else None,
                }
            )
    return rows


def training_cost(arms: dict[str, Sequence[Path]]) -> list[dict[str, Any]]:
    """What a run of each arm took, in the mean: environment steps, updates and seconds."""
    rows = []
    for arm, paths in arms.items():
        last = [row for path in paths if (row := _last(path)) is not None]
        names = ("env_steps", "gradient_steps", "wall_s")
        means = {
            name: float(np.mean([row[name] for row in last]))
            for name in names
            if last and all(row[name] is not None for row in last)
        }
        rows.append({"arm": arm, "runs": len(last), **dict.fromkeys(names), **means})
    return rows


def _of_run(path: Path) -> dict[tuple[str, int], float]:
    """Success by condition and environment steps; of two evaluations at one step the later."""
    at: dict[tuple[str, int], tuple[int, dict[str, list[bool]]]] = {}
    try:
        table = Run.open(path).table("evaluations").to_pylist()
    except RunError:
        return {}
    for row in table:
        if row["success"] is None:
            continue
        key, update = (row["condition"], int(row["env_steps"])), int(row["gradient_steps"])
        if key not in at or at[key][0] < update:
            at[key] = update, {}
        if at[key][0] == update:
            at[key][1].setdefault(row["block"] or "none", []).append(row["success"])
    return {
        key: float(np.mean([np.mean(values) for values in blocks.values()]))
        for key, (_, blocks) in at.items()
    }


def _last(path: Path) -> dict[str, Any] | None:
    try:
        table = Run.open(path).table("progress")
    except RunError:
        return None
    if not table.num_rows:
        return None
    row: dict[str, Any] = table.slice(table.num_rows - 1).to_pylist()[0]
    return row


__all__ = ["learning_curves", "training_cost"]
