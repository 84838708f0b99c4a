"""Pair the episodes that two policies both drove, and compare their success and return.

Differences are paired by episode: both policies drive the same episode, so only the policies
differ.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from restock.stats import mean_over_strata
from restock.train.run.kept_evaluations import cell_name, shown_evaluation
from restock.train.run.run import Run

AGENT = "agent"
Verdict = Literal["better", "worse", "no difference shown", "inconclusive"]
MARGIN = 0.05  # of success: a difference of no more is none
MIN_EPISODES = 10  # of a row; fewer give no interval and no verdict
Cell = tuple[str, str]  # perturbation, condition (with its block)
Key = tuple[int, str]  # of an episode: seed, and the values of the perturbation in force
Episodes = dict[Cell, dict[Key, tuple[float, float]]]  # success (NaN without a goal) and return


def agent_episodes(run: Run, policy: str = AGENT) -> pa.Table | None:
    """Read what `restock eval` wrote of the run's own policy, or of another; None: none drove."""
    table, _ = shown_evaluation(run.path)
    driven = table.filter(pc.equal(table["policy"], policy))
    return driven if len(driven) else None


def by_cell(table: pa.Table) -> Episodes:
    """Return success and return by perturbation and condition, and by episode."""
    cells: Episodes = {}
    for row in table.to_pylist():
        cell = str(row.get("perturbation", "none")), cell_name(row["condition"], row["block"])
        success = float("nan") if row["success"] is None else float(row["success"])
        key = int(row["episode_seed"]), str(sorted(row.get("perturbation_values") or ()))
        cells.setdefault(cell, {})[key] = success, float(row["return"])
    return cells


def paired(first: Episodes, second: Episodes) -> list[dict[str, Any]]:
    """Compare two policies on the episodes of both: a row per perturbation and condition.

    Differences are those of the second, with 95 % intervals over episodes. The second is `worse` if
    its success is lower by more than `MARGIN` and the interval below 0, `better` if the interval is
    above 0. From fewer than `MIN_EPISODES` neither is told: the row is `inconclusive`.
    """
    rngs = [np.random.default_rng(seed) for seed in (0, 1)]
    driven = list(dict.fromkeys(perturbation for perturbation, _ in first))
    rows = []
    for cell in sorted(first, key=lambda cell: (driven.index(cell[0]), cell[1])):
        shared = sorted(first[cell].keys() & second.get(cell, {}).keys())
        if not shared:
            continue
        pairs = np.array([[first[cell][key], second[cell][key]] for key in shared])  # (n, 2, 2)
        row = {"perturbation": cell[0], "condition": cell[1], "episodes": len(shared)}
        for place, (name, prefix) in enumerate((("success", ""), ("return", "return_"))):
            a, b = pairs[:, :, place].T
            means: list[float | None] = [float(a.mean()), float(b.mean()), None, None, None]
            if np.isnan(pairs[:, :, place]).any():  # the task has no goal
                means[:2] = None, None
            else:
                found = mean_over_strata([b - a], rng=rngs[place])
                means[2] = found.value
                if len(shared) >= MIN_EPISODES:
                    means[3:] = found.low, found.high
            names = (f"{prefix}difference{end}" for end in ("", "_low", "_high"))
            row |= dict(zip((f"{name}_a", f"{name}_b", *names), means, strict=True))
        rows.append(row | {"verdict": _verdict(row)})
    return rows


def _verdict(row: Mapping[str, Any]) -> Verdict:
    if row["difference_low"] is None:
        return "inconclusive"
    if row["difference_high"] < 0 and row["difference"] < -MARGIN:
        return "worse"
    return "better" if row["difference_low"] > 0 else "no difference shown"
