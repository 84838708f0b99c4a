"""May two arms be compared, and how do they compare: the checks, then the outcomes.

A comparison of methods that were fed differently measures the feed. It is refused, with what
differs, unless the feed is what is compared (`treatment="mixture"`).

Outcomes are differences with intervals, paired by episode: Student's t over runs (seeds) and
episodes, so that an interval holds both what another seed and what other episodes would have
changed. From fewer than `MIN_RUNS` runs an arm or `MIN_EPISODES` episodes there is none, nor
where every run ended every episode alike: only values. The
probability of improvement and the interquartile mean are those of arXiv:2108.13264.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from restock.arrays import F64
from restock.errors import RunError
from restock.stats import ConfidenceInterval, difference_of_arms, improvement_of_arms, iqm
from restock.train.comparison.arms import (
    ALLOWED,
    Arm,
    Difference,
    Treatment,
    differences,
    feeds,
    same_run,
)
from restock.train.comparison.comparability import (
    Check,
    ComparabilityLimits,
    Verdict,
    check_feeds,
    worst,
)
from restock.train.evaluation.regression import MIN_EPISODES, agent_episodes
from restock.train.run.run import Run
from restock.words import counted, quoted

Cell = tuple[str, str]  # perturbation, condition (with the kind of block)
_SAME_TOTAL = 1.02  # ratio of environment steps, and of updates
MIN_RUNS = 3  # seeds of each arm: with fewer there is no interval


@dataclass(frozen=True)
class Comparison:
    """The verdict of the checks, and the outcomes where the arms are comparable."""

    treatment: Treatment
    verdict: Verdict
    differences: list[Difference]  # of settings
    refused: list[Difference]  # those that the treatment does not allow
    totals: list[Check]  # environment steps and updates
    checks: list[Check]  # of the feed
    source: str | None  # of the outcomes: restock eval, or the training's own evaluations
    rows: list[dict[str, Any]]
    identical: bool = False  # both arms are the same runs: comparable whatever the checks show

    @property
    def deciding_checks(self) -> list[Check]:
        """The checks that the verdict is made of: of the feed too, unless it is the treatment."""
        return [] if self.identical else _deciding(self.treatment, self.totals, self.checks)

    def as_json(self) -> dict[str, Any]:
        """All of it."""
        deciding = self.deciding_checks
        return {
            "treatment": self.treatment,
            "verdict": self.verdict,
            "identical": self.identical,
            "refused": [difference.setting for difference in self.refused],
            "differences": [asdict(difference) for difference in self.differences],
            "checks": [
                {**asdict(check), "verdict": check.verdict, "decides": check in deciding}
                for check in self.totals + self.checks
            ],
            "outcomes_from": self.source,
            "outcomes": self.rows,
        }


def compare(
    first: Sequence[Path | str],
    second: Sequence[Path | str],
    *,
    treatment: Treatment = "algorithm",
    limits: ComparabilityLimits = ComparabilityLimits(),  # noqa: B008  (frozen)
    seed: int = 0,
) -> Comparison:
    """Compare the runs of two arms.

    The same runs on both sides are comparable by identity.

    Raises:
        RunError: a run is missing, has no updates, or does not belong to its arm; two of an arm
            are one run or have one seed; an arm has no run; or only some of the runs are in both
            arms. Also an unknown treatment.
    """
    if treatment not in ALLOWED:
        what = f"there is no treatment {treatment!r}"
        raise RunError(what, remedy=f"choose from {', '.join(ALLOWED)}")
    arms = Arm("first", first), Arm("second", second)
    identical = _identical(*arms)
    rng = np.random.default_rng(seed)
    differing = [d for d in differences(arms[0].runs[0], arms[1].runs[0]) if d.kind != "free"]
    allowed = ALLOWED[treatment] | {"software"}
    refused = [difference for difference in differing if difference.kind not in allowed]
    totals = [_total(name, *(arm.totals[name] for arm in arms)) for name in arms[0].totals]
    checks = check_feeds(*feeds(*arms), limits, rng)
    deciding = _deciding(treatment, totals, checks)
    verdict = "incomparable" if refused else worst([check.verdict for check in deciding])
    if identical:  # what was fed is the same by identity: there is nothing to estimate
        verdict = "comparable"
    source, rows = _outcomes(*arms) if verdict == "comparable" else (None, [])
    return Comparison(
        treatment, verdict, differing, refused, totals, checks, source, rows, identical
    )


def _identical(first: Arm, second: Arm) -> bool:
    """Whether both arms are the same runs. Raises RunError where only some are in both."""
    both = [(a, b) for a in first.runs for b in second.runs if same_run(a, b)]
    if both and not len(both) == len(first.runs) == len(second.runs):
        a, b = both[0]
        copy = "" if a.path.resolve() == b.path.resolve() else f" as a copy of {a.path}"
        raise RunError(
            f"is in both arms{copy}: the arms then vary together",
            where=str(b.path),
            remedy="leave it out of one of them",
        )
    return bool(both)


def _deciding(treatment: Treatment, totals: list[Check], checks: list[Check]) -> list[Check]:
    if treatment == "method":  # an update of one method is not one of another
        return [check for check in totals if check.name == "env steps"]
    if treatment == "practice":  # fresh rows are of what was practised; the logs' must be the same
        return totals + [check for check in checks if " logs/" in check.name]
    return totals + ([] if treatment in ("mixture", "data") else checks)


def _total(name: str, first: float, second: float) -> Check:
    ratio = max(first, second) / max(min(first, second), 1.0)
    shown = name.replace("_", " ").replace("gradient steps", "updates")
    return Check.exact(shown, first, second, ratio, _SAME_TOTAL)


def _outcomes(first: Arm, second: Arm) -> tuple[str, list[dict[str, Any]]]:
    """Where the episodes are from, and one row a perturbation and condition that both arms drove.

    Raises:
        RunError: a run has no evaluation, or the arms share no episode.
    """
    arms = [[agent_episodes(run) for run in arm.runs] for arm in (first, second)]
    source = "restock eval" if all(e is not None for arm in arms for e in arm) else "training"
    if source == "training":
        arms = [[last_evaluation(run) for run in arm.runs] for arm in (first, second)]
    scores = [_scores([e for e in arm if e is not None]) for arm in arms]
    rows = []
    for cell in scores[0]:
        seeds = sorted(scores[0][cell].keys() & scores[1].get(cell, {}).keys())
        if seeds:
            a, b = (np.stack([score[cell][seed] for seed in seeds], 1) for score in scores)
            rows.append(_outcome(cell, a, b))
    if not rows:
        raise RunError(
            f"was evaluated on none of the episodes of {first.runs[0].path}",
            where=str(second.runs[0].path),
            remedy="run `restock eval` on both with the same --seed",
        )
    return source, rows


def _outcome(
    cell: Cell,
    a: F64,  # (runs, episodes, 2) success and return
    b: F64,
) -> dict[str, Any]:
    difference = difference_of_arms(a[..., 0], b[..., 0]).within(-1.0, 1.0)
    missing = _why_no_interval(a, b, difference)
    # Episode by episode, over all pairs of runs.
    better = improvement_of_arms(b[..., 1], a[..., 1], rng=np.random.default_rng(0))
    few = min(len(a), len(b)) < MIN_RUNS or a.shape[1] < MIN_EPISODES
    return {
        "perturbation": cell[0],
        "condition": cell[1],
        "episodes": a.shape[1],
        "runs": [len(a), len(b)],
        "success": [_known(a[..., 0].mean()), _known(b[..., 0].mean())],
        "difference": _known(difference.value),
        "difference_low": None if missing else difference.low,
        "difference_high": None if missing else difference.high,
        "no_interval": missing,
        "return_iqm": [iqm(a[..., 1]), iqm(b[..., 1])],
        "improvement": better.value,
        "improvement_low": None if few else better.low,
        "improvement_high": None if few else better.high,
    }


def _known(value: float) -> float | None:
    """None where the task has no goal: its success is NaN."""
    return None if np.isnan(value) else float(value)


def _why_no_interval(a: F64, b: F64, difference: ConfidenceInterval) -> str | None:
    """What an interval would claim too much of, or None. A, b as of `_outcome`."""
    if np.isnan(difference.value):
        return "the task has no goal: compare the returns"
    runs, episodes = min(len(a), len(b)), a.shape[1]
    if runs < MIN_RUNS:
        return f"{counted(runs, 'run')} an arm, at least {MIN_RUNS} are needed"
    if episodes < MIN_EPISODES:
        return f"{counted(episodes, 'episode')}, at least {MIN_EPISODES} are needed"
    if difference.low == difference.high:
        return "every run ended every episode in the same way: nothing varies"
    return None


def _scores(tables: Iterable[pa.Table]) -> dict[Cell, dict[int, F64]]:
    """Cell -> episode seed -> (runs, 2) success and return; episodes that every run drove."""
    runs: list[dict[Cell, dict[int, tuple[float, float]]]] = []
    for table in tables:
        cells: dict[Cell, dict[int, tuple[float, float]]] = {}
        for row in table.to_pylist():
            block = f" ({row['block']})" if row["block"] in ("partial", "full") else ""
            cell = (row.get("perturbation", "none"), row["condition"] + block)
            success = float("nan") if row["success"] is None else float(row["success"])
            result = success, float(row["return"])
            cells.setdefault(cell, {})[int(row["episode_seed"])] = result
        runs.append(cells)
    shared: dict[Cell, dict[int, F64]] = {}
    for cell, episodes in runs[0].items():
        for seed in episodes:
            if all(seed in run.get(cell, {}) for run in runs):
                values = np.array([run[cell][seed] for run in runs], np.float64)
                shared.setdefault(cell, {})[seed] = values
    return shared


def last_evaluation(run: Run) -> pa.Table:
    """The last periodic evaluation in training. Raises RunError where there was none."""
    import pyarrow.compute as pc  # slow to import

    table = run.table("evaluations")
    if not len(table):
        raise RunError(
            "has no evaluation",
            where=str(run.path),
            remedy=f"run `restock eval {quoted(run.path)}`",
        )
    last = pc.max(table["gradient_steps"])
    return table.filter(pc.equal(table["gradient_steps"], last))


__all__ = ["MIN_EPISODES", "Comparison", "compare", "last_evaluation"]
