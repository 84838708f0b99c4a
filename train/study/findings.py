"""Collect what a study found: its comparisons, its contrasts and what each arm came to."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from restock.errors import RunError
from restock.stats import paired_t
from restock.train.judge.compare import Comparison
from restock.train.run.kept_evaluations import mission_of, planner_times, read_evaluations
from restock.train.run.measures import cell_name
from restock.train.study.contrasts import (
    Contrast,
    RunCurve,
    contrast,
    learning_curves,
    training_cost,
    with_holm,
)
from restock.train.study.study import DONE, ArmConfig, Pair, StudyPlan

NOT_NEGATIVE = ("bumps_per_km", "closest_person_m")
MAX_NAMED = 4  # checks that refuse a comparison


def findings(plan: StudyPlan, comparisons: Sequence[Comparison | RunError]) -> dict[str, Any]:
    """Return the study and all that it found, as JSON values.

    `comparisons` are those of `run_study`; an error is why there is none.
    """
    compared = [
        _compared(pair, comparison)
        for pair, comparison in zip(plan.study.pairs, comparisons, strict=True)
    ]
    refused = {(one["arm"], one["baseline"]) for one in compared if one["verdict"] != "comparable"}
    return {
        "doc": plan.study.doc,
        "seeds": list(plan.study.seeds),
        "rare": list(plan.study.rare),
        "runs": {arm.name: [str(path) for path in plan.runs(arm)] for arm in plan.study.arms},
        "contrasts": [one.as_json() for one in contrasts(plan, refused)],
        "arms": arms(plan),
        "curves": learning_curves(_finished(plan)),
        "cost": training_cost(_finished(plan)),
        "comparisons": compared,
    }


def _compared(pair: Pair, comparison: Comparison | RunError) -> dict[str, Any]:
    """Return a comparison as JSON values, with why it has no outcomes, or ""."""
    if isinstance(comparison, RunError):
        why = f"{comparison.where}: {comparison.what}" if comparison.where else comparison.what
        comparison = Comparison(pair.treatment, "inconclusive", [], [], [], [], None, [])
    else:
        why = _why_refused(pair, comparison)
    return {
        "arm": pair.arm.name,
        "baseline": pair.baseline.name,
        **comparison.as_json(),
        "why": why,
    }


def _why_refused(pair: Pair, comparison: Comparison) -> str:
    if comparison.verdict == "comparable":
        return ""
    if comparison.refused:
        return (
            f"they differ in {', '.join(one.setting for one in comparison.refused)}, which"
            f' treatment = "{pair.treatment}" does not allow'
        )
    failed = [one for one in comparison.deciding_checks if one.verdict == comparison.verdict]
    # A feed that differs follows from numbers of updates that do: one cause is named.
    for check in failed:
        if check.name == "updates" and check.first is not None and check.second is not None:
            return (
                f"{pair.arm.name} made {check.second:,.0f} updates and {pair.baseline.name}"
                f" {check.first:,.0f}, with those on the logs alone;"
                f' treatment = "{pair.treatment}" needs the same number'
                ' (schedule.updates_per_env_step), treatment = "method" does not'
            )
    names = list(dict.fromkeys(check.name for check in failed))
    more = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
    return f"{comparison.verdict} in {', '.join(names[:MAX_NAMED])}{more}"


def _finished(plan: StudyPlan) -> dict[str, Sequence[Path]]:
    """Return the finished runs of each arm."""
    return {
        arm.name: [path for path in plan.runs(arm) if (path / DONE).exists()]
        for arm in plan.study.arms
    }


def contrasts(plan: StudyPlan, refused: set[tuple[str, str]]) -> list[Contrast]:
    """Return the primary contrast, then those of every comparison in the study's measures.

    Refused comparisons have none.
    """
    study, curves = plan.study, _Curves(plan)
    wanted = [
        (pair.arm, pair.baseline, measure, False)
        for pair in study.pairs
        for measure in study.measures
    ]
    if (first := study.primary) is not None:
        own = next(p for p in study.pairs if (p.arm.name, p.baseline.name) == first.pair)
        wanted = [one for one in wanted if (one[0].name, one[1].name, one[2]) != first.named]
        wanted.insert(0, (own.arm, own.baseline, first.measure, True))
    found = [
        contrast(arm.name, baseline.name, measure, curves.pairs(arm, baseline), primary=primary)
        for arm, baseline, measure, primary in wanted
        if (arm.name, baseline.name) not in refused
    ]
    return with_holm([one for one in found if one is not None])


def arms(plan: StudyPlan) -> list[dict[str, Any]]:
    """Return a row for each arm and reference: success by cell, and safety and return.

    Safety and return are those of rare missions, unperturbed. A value is [mean, low, high] over the
    seeds; the ends are None if `paired_t` has none.
    """
    planner_s, references = _references(plan)
    rows = []
    for arm in plan.study.arms:
        runs = [
            _measured(plan, _driven_by(path, "agent"), planner_s)
            for path in plan.runs(arm)
            if (path / DONE).exists()
        ]
        if runs:
            rows.append({"arm": arm.name, "runs": len(runs), **_over_seeds(runs)})
    for name, episodes in references.items():
        measured = _measured(plan, episodes, planner_s)
        rows.append({"arm": name, "runs": None, **_over_seeds([measured])})
    return rows


class _Curves:
    """Finished runs of a study, each read once."""

    def __init__(self, plan: StudyPlan) -> None:
        self._plan = plan
        self._read: dict[Path, RunCurve] = {}

    def pairs(self, arm: ArmConfig, baseline: ArmConfig) -> list[tuple[RunCurve, RunCurve]]:
        """Of the seeds that both arms have finished."""
        both = zip(self._plan.runs(arm), self._plan.runs(baseline), strict=True)
        return [
            (self._curve(first), self._curve(second))
            for first, second in both
            if (first / DONE).exists() and (second / DONE).exists()
        ]

    def _curve(self, path: Path) -> RunCurve:
        if path not in self._read:
            self._read[path] = RunCurve(path, self._plan.study.rare)
        return self._read[path]


def _driven_by(path: Path, policy: str) -> list[dict[str, Any]]:
    """Unperturbed episodes."""
    return [
        row
        for row in read_evaluations(path).to_pylist()
        if row["policy"] == policy and row["perturbation"] == "none"
    ]


def _references(plan: StudyPlan) -> tuple[dict[Any, float], dict[str, list[dict[str, Any]]]]:
    """Return the planner's times where it arrived, and the references' episodes, by name."""
    path = plan.jobs[0].path
    names = plan.study.evaluation.references if path.is_dir() else ()
    episodes = {name: rows for name in names if (rows := _driven_by(path, name))}
    return planner_times(episodes.get("planner", [])), episodes


def _measured(
    plan: StudyPlan, episodes: list[dict[str, Any]], planner_s: dict[Any, float]
) -> dict[str, float]:
    """One run's measures; NaN where nothing tells."""
    cells: dict[str, list[float]] = {}
    for row in episodes:
        if row["success"] is not None:
            cells.setdefault(cell_name(row["condition"], row["block"]), []).append(row["success"])
    rare = [row for row in episodes if row["condition"] in plan.study.rare]
    lost = [
        row["time_s"] - planner_s[mission_of(row)]
        for row in rare
        if row["success"] and mission_of(row) in planner_s
    ]
    km = sum(row["distance_m"] or 0.0 for row in rare) / 1000
    return {
        **{f"success {cell}": float(np.mean(values)) for cell, values in sorted(cells.items())},
        "bumps_per_km": sum(row["bumps"] for row in rare) / km if km else float("nan"),
        "closest_person_m": _mean([row["closest_person_m"] for row in rare]),
        "time_lost_s": _mean(lost),
        "discounted_return": _mean([row["discounted_return"] for row in rare]),
    }


def _over_seeds(runs: Sequence[dict[str, float]]) -> dict[str, list[float | None]]:
    found: dict[str, list[float | None]] = {}
    for name in dict.fromkeys(name for run in runs for name in run):
        values = np.array([run[name] for run in runs if not np.isnan(run.get(name, np.nan))])
        if len(values):
            interval = paired_t(values)[0].within(*_range(name))
            ends = [interval.low, interval.high]
            found[name] = [interval.value, *(None if np.isnan(end) else end for end in ends)]
    return found


def _range(name: str) -> tuple[float, float]:
    """Return what a measure of `_measured` can be."""
    if name.startswith("success "):
        return 0.0, 1.0
    return (0.0 if name in NOT_NEGATIVE else -math.inf), math.inf


def _mean(values: Sequence[float | None]) -> float:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else float("nan")


__all__ = ["arms", "contrasts", "findings"]
