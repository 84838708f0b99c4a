"""Compare two evaluated policies per perturbation and condition, on the same episodes.

Differences are paired by episode: both policies drive the same episode, so only the policies
differ.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from restock.arrays import F64
from restock.errors import RunError, quoted
from restock.stats import mean_over_strata
from restock.train.run.kept_evaluations import cell_name, shown_evaluation
from restock.train.run.run import Run

AGENT = "agent"
Verdict = Literal["better", "worse", "no difference shown", "inconclusive", "refused"]
MARGIN = 0.05  # of success: a difference of no more is none
MIN_EPISODES = 10  # of a row; fewer give no interval and no verdict
Cell = tuple[str, str]  # perturbation, condition (with its block)
_Episodes = dict[tuple[int, str], float]  # seed, perturbation's values in force -> success


def read_run_evaluation(path: Path, policy: str = AGENT) -> dict[Cell, _Episodes]:
    """Read what `restock eval` wrote of a run's own policy, or of another that it drove beside it.

    Raises:
        RunError: no run, or it was not evaluated.
    """
    return _cells(_driven(Run.open(path), policy))


def regression(
    baseline: Mapping[Cell, _Episodes], candidate: Mapping[Cell, _Episodes]
) -> list[dict[str, Any]]:
    """Compare with a baseline: a row per perturbation and condition.

    `worse` is a success lower by more than `MARGIN`, with the paired 95 % interval below 0;
    `better` is an interval above 0. From fewer than `MIN_EPISODES` neither is told: the row is
    `inconclusive`. A cell whose episodes are not the same is `refused`.
    """
    rng = np.random.default_rng(0)
    driven = list(dict.fromkeys(perturbation for perturbation, _ in baseline))
    rows = []
    for cell in sorted(baseline, key=lambda cell: (driven.index(cell[0]), cell[1])):
        before, after = baseline[cell], candidate.get(cell, {})
        if before.keys() <= after.keys():  # more of them are no hindrance
            pair = np.array([[before[key], after[key]] for key in sorted(before)])
            rows.append({**_named(cell), **_difference(pair, rng)})
        else:
            rows.append({**_named(cell), **_refused(before, after)})
    return rows


def _named(cell: Cell) -> dict[str, str]:
    return {"perturbation": cell[0], "condition": cell[1]}


def _difference(pair: F64, rng: np.random.Generator) -> dict[str, Any]:
    """Return the difference in success of episodes (n, 2): the baseline's, the candidate's."""
    difference = mean_over_strata([pair[:, 1] - pair[:, 0]], rng=rng)
    few = len(pair) < MIN_EPISODES
    verdict: Verdict = "no difference shown"
    if few:
        verdict = "inconclusive"
    elif difference.high < 0 and difference.value < -MARGIN:
        verdict = "worse"
    elif difference.low > 0:
        verdict = "better"
    return {
        "episodes": len(pair),
        "baseline": float(pair[:, 0].mean()),
        "candidate": float(pair[:, 1].mean()),
        "difference": difference.value,
        "difference_low": None if few else difference.low,
        "difference_high": None if few else difference.high,
        "verdict": verdict,
    }


def _refused(before: _Episodes, after: _Episodes) -> dict[str, Any]:
    unknown = ("baseline", "candidate", "difference", "difference_low", "difference_high")
    shared = len(before.keys() & after.keys())
    return {"episodes": shared, **dict.fromkeys(unknown), "verdict": "refused"}


def agent_episodes(run: Run, policy: str = AGENT) -> pa.Table | None:
    """Read what `restock eval` wrote of the run's own policy, or of another; None: none drove."""
    table, _ = shown_evaluation(run.path)
    driven = table.filter(pc.equal(table["policy"], policy))
    return driven if len(driven) else None


def _driven(run: Run, policy: str) -> pa.Table:
    if (episodes := agent_episodes(run, policy)) is not None:
        return episodes
    raise RunError(
        f"has no evaluation of {'its own policy' if policy == AGENT else policy}",
        where=str(run.path),
        remedy=f"run `restock eval {quoted(run.path)} --policies {policy}`",
    )


def _cells(table: pa.Table) -> dict[Cell, _Episodes]:
    cells: dict[Cell, _Episodes] = {}
    for row in table.to_pylist():
        cell = row["perturbation"], cell_name(row["condition"], row["block"])
        if row["success"] is None:
            raise RunError(
                "its task has no goal: there is no success to compare",
                where="restock eval",
                remedy="compare the returns, which `restock eval RUN --json` prints",
            )
        key = int(row["episode_seed"]), str(sorted(row["perturbation_values"] or ()))
        cells.setdefault(cell, {})[key] = float(row["success"])
    return cells
