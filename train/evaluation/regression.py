"""Compare two evaluated policies per perturbation and condition, on the same episodes.

Differences are paired by episode: both policies drive the same episode, so only the policies
differ.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from restock.errors import RunError, counted, quoted
from restock.stats import iqm, mean_over_strata, paired_improvement
from restock.train.run.kept_evaluations import cell_name, shown_evaluation
from restock.train.run.run import Run

AGENT = "agent"
EVERY = "all"
Verdict = Literal["better", "worse", "no difference shown", "inconclusive", "refused"]
MARGIN = 0.05  # of success: a difference of no more is none
MIN_EPISODES = 10  # of a row; fewer give no interval and no verdict
MIN_OF_A_KIND = 5  # … and of each condition in the row of all, whose spreads are added up
_Key = tuple[int, str]  # seed, and the values of the perturbation in force
_Episodes = dict[_Key, tuple[float, float]]  # success and return


@dataclass(frozen=True)
class Evaluated:
    """A policy's episodes."""

    name: str
    cells: dict[tuple[str, str], _Episodes]  # by perturbation and condition (with its block)


def read_run_evaluation(path: Path, policy: str = AGENT) -> Evaluated:
    """Read what `restock eval` wrote of a run's own policy, or of another that it drove beside it.

    Raises:
        RunError: no run, or it was not evaluated.
    """
    run = Run.open(path)
    name = str(path) if policy == AGENT else policy
    return Evaluated(name, _cells(_driven(run, policy)))


def regression(
    baseline: Evaluated, candidate: Evaluated, *, margin: float = MARGIN, seed: int = 0
) -> list[dict[str, Any]]:
    """Compare with a baseline: a row per perturbation and condition, and one over all conditions.

    `worse` is a success lower by more than `margin`, with the paired 95 % interval below 0;
    `better` is an interval above 0. From fewer than `MIN_EPISODES` neither is told: the row is
    `inconclusive`. A cell whose episodes are not the same is `refused`.
    """
    rng = np.random.default_rng(seed)
    rows = []
    for perturbation in dict.fromkeys(cell[0] for cell in baseline.cells):
        pairs = []
        for cell in sorted(key for key in baseline.cells if key[0] == perturbation):
            before, after = baseline.cells[cell], candidate.cells.get(cell, {})
            if not before.keys() <= after.keys():  # more of them are no hindrance
                rows.append(_refused(cell, before, after))
                continue
            pair = np.array([[before[key], after[key]] for key in sorted(before)])
            pairs.append(pair)
            rows.append(_row(cell, [pair], margin, rng))
        if len(pairs) > 1:
            rows.append(_row((perturbation, EVERY), pairs, margin, rng))
    return rows


def _row(
    cell: tuple[str, str], pairs: list[NDArray[Any]], margin: float, rng: np.random.Generator
) -> dict[str, Any]:
    """Conditions count the same, however many episodes they have.

    Args:
        pairs: of each condition (n, 2, 2): episodes x (baseline, candidate) x (success, return).
    """
    difference = mean_over_strata([pair[:, 1, 0] - pair[:, 0, 0] for pair in pairs], rng=rng)
    success = [float(np.mean([pair[:, arm, 0].mean() for pair in pairs])) for arm in (0, 1)]
    together = np.concatenate(pairs)[:, :, 1]
    few = _too_few([len(pair) for pair in pairs])
    verdict: Verdict = "no difference shown"
    if few:
        verdict = "inconclusive"
    elif difference.high < 0 and difference.value < -margin:
        verdict = "worse"
    elif difference.low > 0:
        verdict = "better"
    return {
        "perturbation": cell[0],
        "condition": cell[1],
        "episodes": len(together),
        "baseline": success[0],
        "candidate": success[1],
        "difference": difference.value,
        "difference_low": None if few else difference.low,
        "difference_high": None if few else difference.high,
        "return_iqm": [iqm(together[:, 0]), iqm(together[:, 1])],
        "improvement": float(
            np.mean([paired_improvement(pair[:, 1, 1], pair[:, 0, 1]) for pair in pairs])
        ),
        "verdict": verdict,
        "reason": few,
    }


def _too_few(episodes: Sequence[int]) -> str | None:
    """Return why this many episodes of each condition are too few for an interval, or None."""
    total, least = sum(episodes), min(episodes)
    if total < MIN_EPISODES:
        return f"{counted(total, 'episode')}, at least {MIN_EPISODES} are needed"
    if len(episodes) > 1 and least < MIN_OF_A_KIND:
        return f"{least} of a condition, at least {MIN_OF_A_KIND} are needed"
    return None


def _refused(cell: tuple[str, str], before: _Episodes, after: _Episodes) -> dict[str, Any]:
    shared = len(before.keys() & after.keys())
    unknown = ("baseline", "candidate", "difference", "difference_low", "difference_high")
    return {
        "perturbation": cell[0],
        "condition": cell[1],
        "episodes": shared,
        **dict.fromkeys((*unknown, "return_iqm", "improvement")),
        "verdict": "refused",
        "reason": f"not the same episodes: {len(before)} of the baseline, {len(after)} of the"
        f" candidate, {shared} in both",
    }


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


def _cells(table: pa.Table) -> dict[tuple[str, str], _Episodes]:
    cells: dict[tuple[str, str], _Episodes] = {}
    for row in table.to_pylist():
        cell = row["perturbation"], cell_name(row["condition"], row["block"])
        if row["success"] is None:
            raise RunError(
                "its task has no goal: there is no success to compare",
                where="restock eval",
                remedy="compare the returns, which `restock eval RUN --json` prints",
            )
        result = float(row["success"]), float(row["return"])
        key = int(row["episode_seed"]), str(sorted(row["perturbation_values"] or ()))
        cells.setdefault(cell, {})[key] = result
    return cells
