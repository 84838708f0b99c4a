"""Compute measures of each run of a study, and contrast arms in a measure, paired by seed.

A measure is named `auc_WHAT` or `success_WHAT`. `auc` is the area under the run's curve of success
over environment steps (by trapezoids, divided by the steps, so it is a mean success in training).
`success` is that of the kept policy, on the episodes of the study's evaluation, which did not
select it. WHAT is a cell (`CELLS`), or `rare`, the mean over the rare conditions. Partly and wholly
blocked aisles count half each, however many of each were drawn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from restock.arrays import F64
from restock.errors import RunError, counted
from restock.stats import MIN_PAIRS, holm, nothing_varies, paired_t
from restock.train.evaluation.paired import agent_episodes
from restock.train.run.run import Run
from restock.train.twin.missions import MISSIONS

# WHAT of a measure -> the cells (condition, block) whose success it averages; None: no block.
CELLS: dict[str, tuple[tuple[str, str | None], ...]] = {
    **{
        name: tuple((name, block) for block in mission.blocks or (None,))
        for name, mission in MISSIONS.items()
    },
    **{
        measure: ((name, block),)
        for name, mission in MISSIONS.items()
        for measure, block in mission.block_measures.items()
    },
}
RARE = tuple(name for name, mission in MISSIONS.items() if mission.is_true is not None)
KINDS_OF_MEASURE = ("auc", "success")


def unknown_measure(name: str) -> str | None:
    """Return what is wrong with the name of a measure; None if it is valid."""
    kind, _, what = name.partition("_")
    if kind in KINDS_OF_MEASURE and what in (*CELLS, "rare"):
        return None
    return (
        f"measure {name!r} must be {' or '.join(f'{kind}_WHAT' for kind in KINDS_OF_MEASURE)}, and"
        f" WHAT rare, {', '.join(CELLS)}"
    )


@dataclass(frozen=True)
class Contrast:
    """The difference of an arm from its baseline in one measure, paired by seed."""

    arm: str
    baseline: str
    measure: str
    primary: bool
    pairs: int  # seeds with both runs
    arm_mean: float
    baseline_mean: float
    difference: float
    low: float | None  # lower end of the difference's 95 % t interval; None: see `no_interval`
    high: float | None
    sd: float | None  # standard deviation of the paired differences
    p: float | None  # p value of the hypothesis that there is no difference
    p_holm: float | None = None  # p adjusted by Holm's method; None for the primary contrast
    no_interval: str | None = None  # why there is neither an interval nor a p value

    def as_json(self) -> dict[str, Any]:
        return asdict(self)


class RunCurve:
    """A finished run's success by cell, in training and of the kept policy."""

    def __init__(self, path: Path) -> None:
        self._run = Run.open(path)
        self._at = _success_by_step(self._run.table("evaluations"))
        self.steps = np.array(sorted(self._at))

    @cached_property
    def end(self) -> dict[tuple[str, str], float]:
        """Return the kept policy's success by condition and block."""
        return _clean_success(agent_episodes(self._run))

    @property
    def conditions(self) -> list[tuple[str, int, float]]:
        """Return condition, environment steps and success of each evaluation in training.

        Partly and wholly blocked aisles count half each, however many of each were drawn.
        """
        found = []
        for step, cells in self._at.items():
            for condition in sorted({condition for condition, _ in cells}):
                blocks = [success for (name, _), success in cells.items() if name == condition]
                found.append((condition, step, _mean(blocks)))
        return found

    def value(self, measure: str, reach: tuple[float, float] | None = None) -> float:
        """Return the run's value of a measure, NaN if unknown; `reach` is the range of an `auc`."""
        kind, _, what = measure.partition("_")
        if kind == "success":
            return self._cells_mean(self.end, what)
        return area(self.steps, np.array(list(self.curve(what).values())), reach)

    def curve(self, what: str) -> dict[int, float]:
        """Return environment steps -> success in the cells of `what`, per periodic evaluation."""
        return {step: self._cells_mean(self._at[step], what) for step in self.steps.tolist()}

    def _cells_mean(self, success: Mapping[tuple[str, str], float], what: str) -> float:
        if what == "rare":
            own = [self._cells_mean(success, kind) for kind in RARE]
        else:
            own = [
                success.get((condition, block or "none"), float("nan"))
                for condition, block in CELLS[what]
            ]
        # The mean is over the cells that were driven: a study may leave out kinds of missions, and
        # if it has few blocked aisles, all of them may be blocked partly, or all wholly.
        known = [value for value in own if not np.isnan(value)]
        return _mean(known) if known else float("nan")


def area(steps: F64, values: F64, reach: tuple[float, float] | None = None) -> float:
    """Return the mean of a curve over a range of steps, by trapezoids; NaN if it has one point.

    Args:
        steps, values: (n,) the points of the curve.
        reach: lower and upper end of the range; None: all of the curve.
    """
    low, high = reach if reach is not None else (float(steps[0]), float(steps[-1]))
    if len(steps) < 2 or high <= low:
        return float("nan")
    inside = (steps > low) & (steps < high)
    at = np.concatenate([[low], steps[inside], [high]])
    return float(np.trapezoid(np.interp(at, steps, values), at) / (high - low))


def contrast(
    arm: str,
    baseline: str,
    measure: str,
    runs: Sequence[tuple[RunCurve, RunCurve]],
    *,
    primary: bool = False,
) -> Contrast | None:
    """Return one contrast; None if no pair of runs has the measure.

    `runs` are the arm's and the baseline's run of each seed. Areas under curves are taken over the
    range of steps that all curves cover.
    """
    if not runs:
        return None
    curves = [curve for pair in runs for curve in pair if len(curve.steps)]
    reach = None
    if measure.startswith("auc_"):
        if len(curves) < 2 * len(runs):
            return None
        first = max(float(curve.steps[0]) for curve in curves)
        reach = first, min(float(curve.steps[-1]) for curve in curves)
    values = np.array([[curve.value(measure, reach) for curve in pair] for pair in runs])
    values = values[~np.isnan(values).any(axis=1)]
    if not len(values):
        return None
    differences = values[:, 0] - values[:, 1]
    interval, p = paired_t(differences)
    interval = interval.within(-1.0, 1.0)  # limits of a difference of shares
    return Contrast(
        arm,
        baseline,
        measure,
        primary,
        len(values),
        float(values[:, 0].mean()),
        float(values[:, 1].mean()),
        interval.value,
        _known(interval.low),
        _known(interval.high),
        float(differences.std(ddof=1)) if len(differences) > 1 else None,
        _known(p),
        no_interval=_explain_no_interval(differences),
    )


def _explain_no_interval(differences: F64) -> str | None:
    """Return why `paired_t` gives no interval for paired differences (n,); None if it has one."""
    if (seeds := len(differences)) < MIN_PAIRS:
        return f"{counted(seeds, 'seed')}, at least {MIN_PAIRS} are needed"
    return "the same in every seed: nothing varies" if nothing_varies(differences) else None


def with_holm(contrasts: Sequence[Contrast]) -> list[Contrast]:
    """Return the contrasts with Holm's adjusted p for all but the primary one."""
    places = [i for i, c in enumerate(contrasts) if not c.primary and c.p is not None]
    adjusted = holm([float(contrasts[i].p or 0.0) for i in places])
    found = list(contrasts)
    for place, value in zip(places, adjusted, strict=True):
        found[place] = replace(found[place], p_holm=value)
    return found


def learning_curves(arms: Mapping[str, Sequence[Path]]) -> list[dict[str, Any]]:
    """Return a row per arm, condition and periodic evaluation: the mean success over its runs.

    The 95 % interval is Student's t over runs; its ends are None if `paired_t` has none. Runs that
    cannot be read are left out.
    """
    rows = []
    for arm, paths in arms.items():
        values: dict[tuple[str, int], list[float]] = {}
        for path in paths:
            for condition, step, success in _read_curve(path):
                values.setdefault((condition, step), []).append(success)
        for (condition, step), found in sorted(values.items()):
            interval = paired_t(np.array(found))[0].within(0.0, 1.0)
            rows.append(
                {
                    "arm": arm,
                    "condition": condition,
                    "env_steps": step,
                    "runs": len(found),
                    "success": interval.value,
                    "low": _known(interval.low),
                    "high": _known(interval.high),
                }
            )
    return rows


def _read_curve(path: Path) -> list[tuple[str, int, float]]:
    try:
        return RunCurve(path).conditions
    except RunError:
        return []


def training_cost(arms: Mapping[str, Sequence[Path]]) -> list[dict[str, Any]]:
    """Return a row per arm: the mean environment steps, updates and seconds of its runs."""
    rows = []
    for arm, paths in arms.items():
        last = [row for path in paths if (row := _last_progress(path)) is not None]
        cost: dict[str, Any] = {"arm": arm, "runs": len(last)}
        for name in ("env_steps", "gradient_steps", "wall_s"):
            values = [row[name] for row in last]
            cost[name] = float(np.mean(values)) if values and None not in values else None
        rows.append(cost)
    return rows


def _last_progress(path: Path) -> dict[str, Any] | None:
    try:
        rows = Run.open(path).table("progress").to_pylist()
    except RunError:
        return None
    return rows[-1] if rows else None


def _success_by_step(table: pa.Table) -> dict[int, dict[tuple[str, str], float]]:
    """Return success by environment steps and cell; of two evaluations at one step, the later."""
    by_step: dict[int, tuple[int, list[dict[str, Any]]]] = {}
    for row in table.to_pylist():
        step, update = int(row["env_steps"]), int(row["gradient_steps"])
        at = by_step.get(step)
        if at is None or at[0] < update:
            at = by_step[step] = (update, [])
        if at[0] == update:
            at[1].append(row)
    return {step: _success_by_cell(rows) for step, (_, rows) in by_step.items()}


def _clean_success(table: pa.Table | None) -> dict[tuple[str, str], float]:
    """Return the success of unperturbed episodes by condition and block."""
    if table is None:
        return {}
    return _success_by_cell([row for row in table.to_pylist() if row["perturbation"] == "none"])


def _success_by_cell(rows: Sequence[dict[str, Any]]) -> dict[tuple[str, str], float]:
    cells: dict[tuple[str, str], list[bool]] = {}
    for row in rows:
        if row["success"] is not None:
            cell = row["condition"], row["block"] or "none"
            cells.setdefault(cell, []).append(row["success"])
    return {cell: float(np.mean(values)) for cell, values in cells.items()}


def _mean(values: Any) -> float:
    values = list(values)
    return float(np.mean(values)) if values else float("nan")


def _known(value: float) -> float | None:
    return None if np.isnan(value) else value
