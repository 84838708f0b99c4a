"""How two arms did on the same episodes: differences with intervals, paired by episode.

Runs (seeds) are resampled within each arm and episodes jointly for both (the pairing), so that an
interval holds both what another seed and what other episodes would have changed. The probability
of improvement and the interquartile mean are those of arXiv:2108.13264.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from restock.errors import RunError
from restock.stats import difference_of_arms, iqm, probability_of_improvement
from restock.train.comparison.arms import Arm
from restock.train.run.run import Run

Cell = tuple[str, str]  # perturbation, condition (with the kind of block)


def outcomes(first: Arm, second: Arm, rng: np.random.Generator) -> tuple[str, list[dict[str, Any]]]:
    """Where the episodes are from, and one row a perturbation and condition that both arms drove.

    Raises:
        RunError: a run has no evaluation, or the arms share no episode.
    """
    arms = [[_episodes(run) for run in arm.runs] for arm in (first, second)]
    source = "restock eval" if all(e is not None for arm in arms for e in arm) else "training"
    if source == "training":
        arms = [[_last_evaluation(run) for run in arm.runs] for arm in (first, second)]
    scores = [_scores([e for e in arm if e is not None]) for arm in arms]
    rows = []
    for cell in scores[0]:
        seeds = sorted(scores[0][cell].keys() & scores[1].get(cell, {}).keys())
        if seeds:
            a, b = (np.stack([score[cell][seed] for seed in seeds], 1) for score in scores)
            rows.append(_row(cell, a, b, rng))
    if not rows:
        raise RunError(
            f"was evaluated on none of the episodes of {first.runs[0].path}",
            where=str(second.runs[0].path),
            remedy="run `restock eval` on both with the same --seed",
        )
    return source, rows


def _row(
    cell: Cell,
    a: NDArray[np.float64],  # (runs, episodes, 2) success and return
    b: NDArray[np.float64],
    rng: np.random.Generator,
) -> dict[str, Any]:
    difference = difference_of_arms(a[..., 0], b[..., 0], rng=rng)
    # Episode by episode, over all pairs of runs.
    better = [
        probability_of_improvement(b[:, index, 1], a[:, index, 1]) for index in range(a.shape[1])
    ]
    return {
        "perturbation": cell[0],
        "condition": cell[1],
        "episodes": a.shape[1],
        "runs": [len(a), len(b)],
        "success": [float(a[..., 0].mean()), float(b[..., 0].mean())],
        "difference": difference.value,
        "difference_low": difference.low,
        "difference_high": difference.high,
        "return_iqm": [iqm(a[..., 1]), iqm(b[..., 1])],
        "improvement": float(np.mean(better)),
    }


def _scores(tables: Iterable[pa.Table]) -> dict[Cell, dict[int, NDArray[np.float64]]]:
    """Cell -> episode seed -> (runs, 2) success and return; episodes that every run drove."""
    runs: list[dict[Cell, dict[int, tuple[float, float]]]] = []
    for table in tables:
        cells: dict[Cell, dict[int, tuple[float, float]]] = {}
        for row in table.to_pylist():
            block = f" ({row['block']})" if row["block"] in ("partial", "full") else ""
            cell = (row.get("perturbation", "none"), row["condition"] + block)
            result = float(row["success"]), float(row["return"])
            cells.setdefault(cell, {})[int(row["episode_seed"])] = result
        runs.append(cells)
    shared: dict[Cell, dict[int, NDArray[np.float64]]] = {}
    for cell, episodes in runs[0].items():
        for seed in episodes:
            if all(seed in run.get(cell, {}) for run in runs):
                values = np.array([run[cell][seed] for run in runs], np.float64)
                shared.setdefault(cell, {})[seed] = values
    return shared


def _episodes(run: Run) -> pa.Table | None:
    """What `restock eval` wrote of the run's own policy."""
    path = run.path / "eval" / "episodes.parquet"
    if not path.exists():
        return None
    table = pq.read_table(path)
    own = table.filter(pa.compute.equal(table["policy"], "agent"))
    return own if len(own) else None


def _last_evaluation(run: Run) -> pa.Table:
    """The last periodic evaluation in training."""
    table = run.table("evaluations")
    if not len(table):
        raise RunError(
            "has no evaluation", where=str(run.path), remedy=f"run `restock eval {run.path}`"
        )
    last = pa.compute.max(table["gradient_steps"])
    return table.filter(pa.compute.equal(table["gradient_steps"], last))


__all__ = ["outcomes"]
