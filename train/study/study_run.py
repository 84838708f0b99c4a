"""Run a study, every arm with every seed, then compare.

A study is a TOML file and a directory. Panels, finished runs and evaluations that already exist are
not made again. So a study continues where it stopped after an interruption, or after you added a
seed or an arm.
"""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from threading import Event
from typing import Any

import msgspec
import numpy as np

from restock.errors import RestockError, RunError
from restock.files import write_text
from restock.process import ended_with_us, interrupt_running, kill_as_interrupt
from restock.replay.panel.build import plan_only
from restock.stats import paired_t
from restock.train.judge.compare import Comparison, compare
from restock.train.run.kept_evaluations import (
    cell_name,
    mission_of,
    planner_times,
    read_evaluations,
)
from restock.train.study.contrasts import (
    RARE,
    Contrast,
    RunCurve,
    contrast,
    learning_curves,
    training_cost,
    with_holm,
)
from restock.train.study.study import (
    DONE,
    ArmConfig,
    Pair,
    StudyEvaluation,
    StudyJob,
    StudyPlan,
    check_jobs,
)

Say = Callable[[str], None]
REFERENCES = ("planner", "operator")  # policies that drive the runs' episodes, once per study


def run_study(
    plan: StudyPlan, *, workers: int = 1, say: Say = lambda line: None
) -> list[Comparison | RunError]:
    """Run the open jobs, then compare every arm with its baseline, in the order of the arms.

    If a comparison cannot be made, the list has its error instead, and the others are still made.

    Raises:
        RestockError: a run failed; its log shows why.
        RunError: a finished run was made with other settings than the study now has.
    """
    check_jobs(plan)
    for arm in plan.study.arms:
        _build(plan, arm, say)
    todo = [job for job in plan.jobs if not job.done.exists()]
    say(f"{len(plan.jobs) - len(todo)} of {len(plan.jobs)} runs already exist")
    _run_all(plan, todo, workers, say)
    _drive_references(plan, say)
    return [_compare(plan, pair) for pair in plan.study.pairs]


def _compare(plan: StudyPlan, pair: Pair) -> Comparison | RunError:
    try:
        return compare(plan.runs(pair.baseline), plan.runs(pair.arm), treatment=pair.treatment)
    except RunError as error:
        return error


def _run_all(plan: StudyPlan, todo: Sequence[StudyJob], workers: int, say: Say) -> None:
    """Train and evaluate the jobs; after a failure, start no more and wait for the running ones."""
    failed = Event()

    def run(job: StudyJob) -> None:
        if failed.is_set():
            return
        try:
            run_job(plan, job, say)
        except BaseException:
            failed.set()
            raise

    pool = ThreadPoolExecutor(max_workers=workers)
    try:
        futures = [pool.submit(run, job) for job in todo]
        for future in as_completed(futures):
            if (error := future.exception()) is None:
                continue
            if isinstance(error, RestockError) and not all(future.done() for future in futures):
                say(str(error).splitlines()[0])
                say("no more runs begin; waiting for those under way (Ctrl-C checkpoints them)")
            raise error
    except BaseException as stop:
        pool.shutdown(wait=False, cancel_futures=True)
        if isinstance(stop, KeyboardInterrupt):  # running jobs write a checkpoint and end
            interrupt_running()
        raise
    finally:
        _wait(pool)


def _wait(pool: ThreadPoolExecutor) -> None:
    """Wait until the running jobs have ended; interrupt them if the user interrupts."""
    try:
        pool.shutdown()
    except KeyboardInterrupt:
        interrupt_running()
        pool.shutdown()
        raise


def _build(plan: StudyPlan, arm: ArmConfig, say: Say) -> None:
    """Build an arm's panel if the arm has a mixture that is not packed yet."""
    out = plan.panel(arm)
    if out is None or out.exists() or arm.mixture is None or plan.study.store is None:
        return
    store, mixture = _mix_arguments(plan, arm.mixture)
    say(f"packing {mixture} for {arm.name}")
    out.parent.mkdir(parents=True, exist_ok=True)
    words = ["mix", store, "--mixture", mixture, "--out", str(out)]
    restock_verb(words, plan.out / "logs" / "mix.log")


def _mix_arguments(plan: StudyPlan, mixture: str) -> tuple[str, str]:
    """Return store and mixture for `restock mix`, with paths taken from the study's folder."""
    store = str(plan.study.store)
    if "://" not in store:
        store = str(plan.folder / store)
    file = plan.folder / mixture
    return store, str(file) if file.is_file() else mixture


def check_mixtures(plan: StudyPlan) -> None:
    """Plan every mixture that is still to pack, as `restock mix --dry-run` does.

    Raises:
        RestockError: the store or a mixture does not exist, or a mixture does not fit the store.
    """
    to_pack = [
        job.arm.mixture
        for job in plan.jobs
        if job.arm.mixture is not None
        and not job.done.exists()
        and (panel := plan.panel(job.arm)) is not None
        and not panel.exists()
    ]
    for mixture in dict.fromkeys(to_pack):
        plan_only(*_mix_arguments(plan, mixture))


def run_job(plan: StudyPlan, job: StudyJob, say: Say) -> None:
    """Train and evaluate one run, from its checkpoint if it has one."""
    log = plan.out / "logs" / f"{job.path.name}.log"
    settings = plan.settings(job.arm, job.seed)
    say(f"{job.path.name}: training")
    restock_verb(train_words(job.path, settings, plan.panel(job.arm)), log)
    evaluation = plan.study.evaluation
    perturbations = ",".join(evaluation.perturbations)
    say(f"{job.path.name}: evaluating")
    restock_verb(
        [
            *("eval", str(job.path), "--policies", "agent", "--perturbations", perturbations),
            *_episodes_flags(evaluation),
        ],
        log,
    )
    write_text(job.done, plan.fingerprint(job))


def _episodes_flags(evaluation: StudyEvaluation) -> list[str]:
    """Return the options of `restock eval` for the episodes to drive."""
    given = evaluation.episodes
    if isinstance(given, dict):
        text = ",".join(f"{kind}={count}" for kind, count in given.items())
    else:
        text = str(given)
    return ["--episodes", text]


def _drive_references(plan: StudyPlan, say: Say) -> None:
    """Evaluate the planner and the operator on the runs' episodes, unless that was done before.

    Their results are stored in the first run's directory.
    """
    evaluation, path = plan.study.evaluation, plan.jobs[0].path
    done, requested = path / "references.json", msgspec.json.encode(evaluation).decode() + "\n"
    if done.exists() and done.read_text(encoding="utf-8") == requested:
        return
    say(f"driving {', '.join(REFERENCES)}")
    arguments = ["eval", str(path), "--policies", ",".join(REFERENCES), "--perturbations", "none"]
    restock_verb([*arguments, *_episodes_flags(evaluation)], plan.out / "logs" / "references.log")
    write_text(done, requested)


def train_words(path: Path, settings: Sequence[str], panel: Path | None = None) -> list[str]:
    """Return the arguments of `restock` that train the run at `path`, from a checkpoint if any.

    A run that stopped before its first checkpoint is removed, and begins again.
    """
    if (path / "checkpoints" / "latest.safetensors").exists():
        return ["train", "--resume", str(path)]
    if (path / "config.json").exists():
        shutil.rmtree(path)
    words = [word for setting in settings for word in ("--set", setting)]
    words += ["--panel", str(panel)] if panel is not None else []
    return ["train", "--out", str(path), *words]


def restock_verb(arguments: Sequence[str], log: Path) -> None:
    """Run a verb of `restock` in its own process, and append its output to a log."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with kill_as_interrupt(), log.open("a", encoding="utf-8") as file:
        file.write(f"$ restock {' '.join(arguments)}\n")
        file.flush()
        process = subprocess.Popen(
            [sys.executable, "-m", "restock", *arguments],
            stdout=file,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            env={**os.environ, "NO_COLOR": "1"},
            start_new_session=True,  # so that Ctrl-C comes only from us: a second ends it at once
        )
        with ended_with_us(process):
            process.wait()
    if process.returncode == 130:
        raise KeyboardInterrupt
    if process.returncode not in (0, 3):
        last = [line for line in log.read_text(encoding="utf-8").splitlines() if line.strip()][-3:]
        raise RestockError(
            f"`restock {arguments[0]}` failed with exit code {process.returncode}: "
            + " / ".join(last),
            where=str(log),
            remedy="correct it and run the study again: finished runs are kept",
        )


NOT_NEGATIVE = ("bumps_per_km", "closest_person_m")  # measures that are never below 0


def findings(plan: StudyPlan, comparisons: Sequence[Comparison | RunError]) -> dict[str, Any]:
    """Return the study and its results as JSON values; `comparisons` come from `run_study`."""
    compared = [
        _comparison_json(pair, comparison)
        for pair, comparison in zip(plan.study.pairs, comparisons, strict=True)
    ]
    refused = {(c["arm"], c["baseline"]) for c in compared if c["verdict"] != "comparable"}
    return {
        "doc": plan.study.doc,
        "seeds": list(plan.study.seeds),
        "rare": list(RARE),
        "runs": {arm.name: [str(path) for path in plan.runs(arm)] for arm in plan.study.arms},
        "contrasts": [found.as_json() for found in contrasts(plan, refused)],
        "arms": arms(plan),
        "curves": learning_curves(_finished(plan)),
        "cost": training_cost(_finished(plan)),
        "comparisons": compared,
    }


def _comparison_json(pair: Pair, comparison: Comparison | RunError) -> dict[str, Any]:
    """Return a comparison as JSON; an error becomes an inconclusive comparison with its reason."""
    names = {"arm": pair.arm.name, "baseline": pair.baseline.name}
    if isinstance(comparison, RunError):
        why = f"{comparison.where}: {comparison.what}" if comparison.where else comparison.what
        none = Comparison(pair.treatment, "inconclusive", [], [], [], [], None, [])
        return {**names, **none.as_json(), "why": why}
    return {**names, **comparison.as_json()}


def _finished(plan: StudyPlan) -> dict[str, Sequence[Path]]:
    """Return the finished runs of each arm."""
    return {
        arm.name: [path for path in plan.runs(arm) if (path / DONE).exists()]
        for arm in plan.study.arms
    }


def contrasts(plan: StudyPlan, refused: set[tuple[str, str]]) -> list[Contrast]:
    """Return the primary contrast, then one per comparison and measure of the study.

    The comparisons in `refused`, (arm, baseline), are left out.
    """
    study, curves = plan.study, _Curves(plan)
    wanted = [
        (pair.arm, pair.baseline, measure, False)
        for pair in study.pairs
        for measure in study.measures
    ]
    if (first := study.primary) is not None:
        own = next(pair for pair in study.pairs if pair.arm.name == first.arm)
        primary = own.arm, own.baseline, first.measure
        wanted = [(*primary, True), *(want for want in wanted if want[:3] != primary)]
    found = [
        contrast(arm.name, baseline.name, measure, curves.pairs(arm, baseline), primary=primary)
        for arm, baseline, measure, primary in wanted
        if (arm.name, baseline.name) not in refused
    ]
    return with_holm([contrast for contrast in found if contrast is not None])


def arms(plan: StudyPlan) -> list[dict[str, Any]]:
    """Return a row for each arm and reference: success by cell, and safety and return.

    Only unperturbed missions count; for safety and return, only rare ones of these. A value is
    [mean, low, high] over the seeds; low and high are None if `paired_t` gives no interval.
    """
    planner_s, references = _references(plan)
    rows = []
    for arm in plan.study.arms:
        runs = [
            _measure(_read_driven(path, "agent"), planner_s)
            for path in plan.runs(arm)
            if (path / DONE).exists()
        ]
        if runs:
            rows.append({"arm": arm.name, "runs": len(runs), **_over_seeds(runs)})
    for name, episodes in references.items():
        measured = _measure(episodes, planner_s)
        rows.append({"arm": name, "runs": None, **_over_seeds([measured])})
    return rows


class _Curves:
    """The finished runs of a study, each read once."""

    def __init__(self, plan: StudyPlan) -> None:
        self._plan = plan
        self._read: dict[Path, RunCurve] = {}

    def pairs(self, arm: ArmConfig, baseline: ArmConfig) -> list[tuple[RunCurve, RunCurve]]:
        """Return the two arms' runs of each seed, for seeds that both arms have finished."""
        both = zip(self._plan.runs(arm), self._plan.runs(baseline), strict=True)
        return [
            (self._curve(first), self._curve(second))
            for first, second in both
            if (first / DONE).exists() and (second / DONE).exists()
        ]

    def _curve(self, path: Path) -> RunCurve:
        if path not in self._read:
            self._read[path] = RunCurve(path)
        return self._read[path]


def _read_driven(path: Path, policy: str) -> list[dict[str, Any]]:
    """Return the unperturbed episodes that `policy` drove in a run's evaluations."""
    return [
        row
        for row in read_evaluations(path).to_pylist()
        if row["policy"] == policy and row["perturbation"] == "none"
    ]


def _references(plan: StudyPlan) -> tuple[dict[Any, float], dict[str, list[dict[str, Any]]]]:
    """Return the planner's times by mission, and the references' episodes by policy."""
    path = plan.jobs[0].path
    names = REFERENCES if path.is_dir() else ()
    episodes = {name: rows for name in names if (rows := _read_driven(path, name))}
    return planner_times(episodes.get("planner", [])), episodes


def _measure(episodes: list[dict[str, Any]], planner_s: dict[Any, float]) -> dict[str, float]:
    """Compute the measures of one run's episodes; NaN if unknown."""
    cells: dict[str, list[float]] = {}
    for row in episodes:
        if row["success"] is not None:
            cells.setdefault(cell_name(row["condition"], row["block"]), []).append(row["success"])
    rare = [row for row in episodes if row["condition"] in RARE]
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
    """Return the lowest and the largest possible value of a measure of `_measure`."""
    if name.startswith("success "):
        return 0.0, 1.0
    return (0.0 if name in NOT_NEGATIVE else -math.inf), math.inf


def _mean(values: Sequence[float | None]) -> float:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else float("nan")
