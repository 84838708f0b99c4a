"""Check whether two arms may be compared, then compare their outcomes.

A comparison of methods that were fed differently measures the feed. It is refused, with a list of
the differences, unless the treatment allows them (`treatment="mixture"`).

Outcomes are differences with intervals, paired by episode: Student's t over runs (seeds) and
episodes, so that an interval covers both other seeds and other episodes. There is no interval with
fewer than `MIN_RUNS` runs per arm or `MIN_EPISODES` episodes, nor if every run ended every episode
in the same way. The probability of improvement and the interquartile mean are those of
arXiv:2108.13264.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from restock.arrays import F64
from restock.errors import RestockError, RunError, counted, quoted
from restock.replay.fleet.panel_difference import diff_panels
from restock.replay.panel.panel import Panel
from restock.stats import (
    ConfidenceInterval,
    difference_of_arms,
    improvement_of_arms,
    iqm,
)
from restock.train.evaluation.paired import (
    MIN_EPISODES,
    Cell,
    Key,
    agent_episodes,
    by_cell,
    paired,
)
from restock.train.judge.comparability import (
    ALLOWED,
    Arm,
    Check,
    Difference,
    Treatment,
    Verdict,
    check_feeds,
    differences,
    feeds,
    same_run,
    worst,
)
from restock.train.run.run import Run

_SAME_TOTAL = 1.02  # largest ratio between the arms' environment steps, or updates
MIN_RUNS = 3  # seeds per arm; with fewer there is no interval


@dataclass(frozen=True)
class Comparison:
    """The verdict of the checks, and the outcomes if the arms are comparable."""

    treatment: Treatment
    verdict: Verdict
    differences: list[Difference]  # in the arms' settings
    refused: list[Difference]  # differences that the treatment does not allow
    totals: list[Check]  # whether environment steps and updates are the same
    checks: list[Check]  # whether the critics were fed the same
    source: str | None  # where outcomes come from: "restock eval" or "training"; None without any
    rows: list[dict[str, Any]]  # the outcomes, one per perturbation and condition

    @property
    def deciding_checks(self) -> list[Check]:
        """Return the checks that decide the verdict; some treatments exempt checks of the feed."""
        return _deciding(self.treatment, self.totals, self.checks)

    @property
    def why(self) -> str:
        """Explain why the comparison is refused; "" if it is not."""
        if self.verdict == "comparable":
            return ""
        if self.refused:
            names = ", ".join(difference.setting for difference in self.refused)
            return f"the runs differ in {names}, which treatment {self.treatment} does not allow"
        failed = [check for check in self.deciding_checks if check.verdict == self.verdict]
        # Different numbers of updates make the feeds differ, too: name only the cause.
        for check in failed:
            if check.name == "updates" and None not in (check.first, check.second):
                return (
                    f"the first made {check.first:,.0f} updates and the second {check.second:,.0f},"
                    " including those on the logs alone (schedule.updates_per_env_step); treatment"
                    " method allows that"
                )
        names = ", ".join(dict.fromkeys(f"{check.name} ({check.part})" for check in failed[:4]))
        names += f" and {len(failed) - 4} more" if len(failed) > 4 else ""
        if self.verdict == "inconclusive":
            return f"too few episodes to show that {names} are the same; add seeds to both sides"
        return f"the critics were fed differently in {names}"

    @property
    def sentence(self) -> str:
        """Return the result of the checks as a sentence."""
        if self.verdict != "comparable":
            undecided = ", inconclusive" if self.verdict == "inconclusive" else ""
            return f"REFUSED{undecided}: {self.why}"
        what = {
            "mixture": "settings, steps",
            "practice": "settings, steps and the logs' part of the feed",
            "method": "environment, environment steps and evaluation",
        }.get(self.treatment, "settings, steps and feed")
        return f"COMPARABLE: {what} are the same within the limits, except the {self.treatment}"

    def as_json(self) -> dict[str, Any]:
        """Return the whole comparison as JSON values."""
        deciding = self.deciding_checks
        return {
            "treatment": self.treatment,
            "verdict": self.verdict,
            "why": self.why,
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
    seed: int = 0,
) -> Comparison:
    """Compare the runs of two arms.

    Raises:
        RunError: a run is missing, has no updates, has other settings than its arm, or is in both
            arms; an arm has no run, the same run twice, or two runs of one seed; or the treatment
            is unknown.
    """
    if treatment not in ALLOWED:
        what = f"there is no treatment {treatment!r}"
        raise RunError(what, remedy=f"choose from {', '.join(ALLOWED)}")
    arms = Arm("first", first), Arm("second", second)
    _refuse_shared(*arms)
    rng = np.random.default_rng(seed)
    differing = [d for d in differences(arms[0].runs[0], arms[1].runs[0]) if d.kind != "free"]
    allowed = ALLOWED[treatment] | {"software"}
    refused = [difference for difference in differing if difference.kind not in allowed]
    totals = [_total(name, *(arm.totals[name] for arm in arms)) for name in arms[0].totals]
    checks = check_feeds(*feeds(*arms), rng)
    deciding = _deciding(treatment, totals, checks)
    verdict = "incomparable" if refused else worst([check.verdict for check in deciding])
    source, rows = _outcomes(*arms) if verdict == "comparable" else (None, [])
    return Comparison(treatment, verdict, differing, refused, totals, checks, source, rows)


def _refuse_shared(first: Arm, second: Arm) -> None:
    """Raise RunError if a run, or a copy of it, is in both arms."""
    for a, b in ((a, b) for a in first.runs for b in second.runs if same_run(a, b)):
        copy = "" if a.path.resolve() == b.path.resolve() else f" as a copy of {a.path}"
        raise RunError(
            f"is in both arms{copy}: the arms then vary together",
            where=str(b.path),
            remedy="leave it out of one of them",
        )


def _deciding(treatment: Treatment, totals: list[Check], checks: list[Check]) -> list[Check]:
    if treatment == "method":  # updates of different methods cannot be compared
        return [check for check in totals if check.name == "env steps"]
    if treatment == "practice":  # practice changes the fresh rows; logged rows must be the same
        return totals + [check for check in checks if " logs/" in check.name]
    return totals + ([] if treatment in ("mixture", "data") else checks)


def _total(name: str, first: float, second: float) -> Check:
    ratio = max(first, second) / max(min(first, second), 1.0)
    shown = name.replace("_", " ").replace("gradient steps", "updates")
    return Check.exact(shown, first, second, ratio, _SAME_TOTAL)


def _outcomes(first: Arm, second: Arm) -> tuple[str, list[dict[str, Any]]]:
    """Return the source of the episodes, and an outcome per condition and perturbation in both.

    Raises:
        RunError: a run has no evaluation, or the arms share no episode.
    """
    source, tables = _episodes([*first.runs, *second.runs])
    scores = [_scores(of) for of in (tables[: len(first.runs)], tables[len(first.runs) :])]
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
    missing = _explain_no_interval(a, b, difference)
    # The probability that a run of b beats a run of a on an episode.
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
    """Return None for NaN: without a goal, there is no success."""
    return None if np.isnan(value) else float(value)


def _explain_no_interval(a: F64, b: F64, difference: ConfidenceInterval) -> str | None:
    """Explain why an interval would claim too much; None if it would not. a, b as in `_outcome`."""
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


def _scores(tables: Iterable[pa.Table]) -> dict[Cell, dict[Key, F64]]:
    """Return success and return (runs, 2) by cell and episode, if every run drove the episode."""
    first, *others = runs = [by_cell(table) for table in tables]
    return {
        cell: {
            key: np.array([run[cell][key] for run in runs], np.float64)
            for key in episodes
            if all(key in run.get(cell, {}) for run in others)
        }
        for cell, episodes in first.items()
    }


def _episodes(runs: Sequence[Run]) -> tuple[str, list[pa.Table]]:
    """Return the source of the episodes that each run's policy drove, and their tables.

    They come from `restock eval` if all runs have such episodes, else from the training.

    Raises:
        RunError: a run has no evaluation.
    """
    driven = [table for run in runs if (table := agent_episodes(run)) is not None]
    if len(driven) == len(runs):
        return "restock eval", driven
    return "training", [last_evaluation(run) for run in runs]


def last_evaluation(run: Run) -> pa.Table:
    """Return the last periodic evaluation in training; raise RunError if there was none."""
    table = run.table("evaluations")
    if not len(table):
        raise RunError(
            "has no evaluation",
            where=str(run.path),
            remedy=f"run `restock eval {quoted(run.path)}`",
        )
    last = pc.max(table["gradient_steps"])
    return table.filter(pc.equal(table["gradient_steps"], last))


def diff_runs(a: Run, b: Run) -> dict[str, Any]:
    """Compare two runs' settings, panels, and outcomes of the episodes that both drove.

    Raises:
        RunError: the runs are of different tasks.
    """
    tasks = [str(run.document.get("task_hash")) for run in (a, b)]
    if tasks[0] != tasks[1]:
        raise RunError(
            f"was trained on task {tasks[1]}, but {a.path} on {tasks[0]}: their returns and "
            "episodes have different meanings",
            where=str(b.path),
            remedy="compare runs of one profile (`profile` in their configs)",
        )
    try:
        _, tables = _episodes([a, b])
    except RunError:  # one was not evaluated
        tables = []
    return {
        "settings": [asdict(difference) for difference in differences(a, b)],
        "panels": _panels(a, b),
        "evaluation": paired(*map(by_cell, tables)) if tables else [],
    }


def _panels(a: Run, b: Run) -> dict[str, Any] | None:
    """Compare the runs' panels; None if they are equal or missing; a note if one was replaced."""
    fed = [run.document.get("panel") or {} for run in (a, b)]
    if not all(fed) or fed[0].get("id") == fed[1].get("id"):
        return None
    try:
        panels = [Panel.open(one["path"]) for one in fed]
        for panel, one in zip(panels, fed, strict=True):
            if panel.id != one["id"]:
                return {"note": f"{one['path']} is now another panel, {panel.id}"}
        return diff_panels(*panels)
    except RestockError as error:
        return {"note": str(error)}
