"""Pair the episodes that two policies both drove, and compare their success.

As both policies drove the same episodes, differences are due to the policies alone.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from restock.stats import ConfidenceInterval, mean_over_strata
from restock.train.run.kept_evaluations import cell_name, shown_evaluation
from restock.train.run.run import Run

AGENT = "agent"
Verdict = Literal["better", "worse", "no difference shown", "inconclusive"]
MARGIN = 0.05  # a policy is not called worse if its success is lower by up to this
MIN_EPISODES = 10  # with fewer episodes there is no interval and no verdict
Cell = tuple[str, str]  # perturbation, condition (with its block)
Key = tuple[int, str]  # identifies an episode: seed, values of its perturbation
Episodes = dict[Cell, dict[Key, tuple[float, float]]]  # success (NaN without a goal) and return


def agent_episodes(run: Run, policy: str = AGENT) -> pa.Table | None:
    """Read the episodes that `policy` drove in a run's `restock eval`; None if there are none."""
    table, _ = shown_evaluation(run.path)
    driven = table.filter(pc.equal(table["policy"], policy))
    return driven if len(driven) else None


def by_cell(table: pa.Table) -> Episodes:
    """Return the success and return of each episode, by cell."""
    cells: Episodes = {}
    for row in table.to_pylist():
        cell = str(row.get("perturbation", "none")), cell_name(row["condition"], row["block"])
        success = float("nan") if row["success"] is None else float(row["success"])
        key = int(row["episode_seed"]), str(sorted(row.get("perturbation_values") or ()))
        cells.setdefault(cell, {})[key] = success, float(row["return"])
    return cells


def paired(first: Episodes, second: Episodes) -> list[dict[str, Any]]:
    """Compare success on the episodes that both policies drove: a row per cell.

    Differences are the second's success less the first's, with 95 % intervals over episodes. The
    second is `worse` if its success is lower by more than `MARGIN` and the interval is below 0,
    `better` if the interval is above 0. With fewer than `MIN_EPISODES` the row is `inconclusive`.
    A task without a goal has no rows.
    """
    rng = np.random.default_rng(0)
    driven = list(dict.fromkeys(perturbation for perturbation, _ in first))
    rows = []
    for cell in sorted(first, key=lambda cell: (driven.index(cell[0]), cell[1])):
        shared = sorted(first[cell].keys() & second.get(cell, {}).keys())
        a, b = (np.array([of[cell][key][0] for key in shared]) for of in (first, second))
        if not len(shared) or np.isnan(a + b).any():
            continue
        difference = mean_over_strata([b - a], rng=rng)
        few = len(shared) < MIN_EPISODES
        rows.append(
            {
                "perturbation": cell[0],
                "condition": cell[1],
                "episodes": len(shared),
                "success_a": float(a.mean()),
                "success_b": float(b.mean()),
                "difference": difference.value,
                "difference_low": None if few else difference.low,
                "difference_high": None if few else difference.high,
                "verdict": "inconclusive" if few else _verdict(difference),
            }
        )
    return rows


def _verdict(difference: ConfidenceInterval) -> Verdict:
    if difference.high < 0 and difference.value < -MARGIN:
        return "worse"
    return "better" if difference.low > 0 else "no difference shown"
