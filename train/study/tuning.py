"""Searching a space with Optuna: the objective is the worst condition's lower bound.

A trial trains its settings with every seed and is judged by `restock eval` on episodes that chose
nothing: of each condition's success the lower end of Wilson's 95 % interval, over all seeds'
episodes together, and of those the least. The evaluations that training makes anyway are reported
on the way, and a trial that falls behind the median of those before it at the same environment
steps is stopped. All is kept in OUT: the same command goes on with the same draws.
"""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import msgspec
import pyarrow as pa

from restock.errors import RestockError, RunError
from restock.files import read_table, write_text
from restock.imports import import_extra
from restock.interrupts import ended_with_us, kill_as_interrupt
from restock.stats import wilson
from restock.train.evaluation.regression import agent_episodes
from restock.train.run.run import Run
from restock.train.study.space import MIXTURE, Parameter, Search, settings_of, trial_name
from restock.train.study.study import DONE
from restock.train.study.study_run import Say, episodes_flags, pack, restock_verb, train_words
from restock.words import quoted

SEARCH, TRIALS = "search.json", "trials.log"  # what was asked; Optuna's journal
_POLL_S = 0.5
ENDED = ("COMPLETE", "PRUNED")


@dataclass(frozen=True)
class SearchPlan:
    """A search and its folders."""

    search: Search
    folder: Path  # of the TOML: its paths are relative to it
    out: Path

    def run(self, values: Mapping[str, Any], seed: int) -> Path:
        """The run directory of a trial and a seed."""
        return self.out / "runs" / f"{trial_name(values)}-{seed}"

    def panel(self, values: Mapping[str, Any]) -> Path | None:
        """Where a trial's panel is, or will be."""
        if self.search.panel is not None:
            return self.folder / self.search.panel
        mixture = values.get(MIXTURE, self.search.mixture)
        if mixture is None:
            return None
        # One name for each: two folders may both hold a coverage.toml.
        return self.out / "panels" / quote(str(mixture), safe="")

    @property
    def fingerprint(self) -> str:
        """What the trials of a search have in common, as JSON."""
        requested = msgspec.to_builtins(self.search)
        for free in ("doc", "trials"):
            requested.pop(free)
        return json.dumps(requested, indent=1, sort_keys=True) + "\n"


def require_optuna() -> Any:
    """The module.

    Raises:
        ConfigError: it is not installed.
    """
    return import_extra("optuna", "tune", "a space is searched with Optuna", where="[space]")


def run_search(plan: SearchPlan, *, say: Say = lambda line: None) -> dict[str, Any]:
    """Do the trials that are left, one after the other; returns what `restock train` shows.

    Raises:
        ConfigError: Optuna is not installed.
        RunError: OUT is of another search, or a trial's run failed (its log says why).
    """
    optuna = require_optuna()
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    requested = plan.out / SEARCH
    if requested.exists() and requested.read_text(encoding="utf-8") != plan.fingerprint:
        raise RunError(
            "is of another search: its space, settings, seeds or evaluation were different",
            where=str(plan.out),
            remedy="choose another --out; only `trials` and `doc` may change",
        )
    plan.out.mkdir(parents=True, exist_ok=True)
    write_text(requested, plan.fingerprint)
    backend = optuna.storages.journal.JournalFileBackend(str(plan.out / TRIALS))
    search = plan.search
    study = optuna.create_study(
        storage=optuna.storages.JournalStorage(backend),
        study_name="restock",
        direction="maximize",
        load_if_exists=True,
        pruner=optuna.pruners.MedianPruner(n_startup_trials=search.startup_trials)
        if search.prune
        else optuna.pruners.NopPruner(),
    )
    for cut in [trial for trial in study.trials if trial.state.name == "RUNNING"]:
        study.tell(cut.number, state=optuna.trial.TrialState.FAIL)
        study.enqueue_trial(cut.params)  # its runs go on from their checkpoints
    while (done := _ended(study)) < search.trials:
        study.sampler = _sampler(optuna, search, done)
        trial = study.ask()
        values = draw(trial, search.parameters)
        say(f"trial {done + 1} of {search.trials}: {_in_words(values)}")
        try:
            worst = _try(plan, trial, values, say)
        except RestockError:
            study.tell(trial, state=optuna.trial.TrialState.FAIL)
            raise
        if worst is None:
            study.tell(trial, state=optuna.trial.TrialState.PRUNED)
            say("stopped: worse than the median of earlier trials")
            continue
        trial.set_user_attr("condition", worst[1])
        study.tell(trial, worst[0])
        say(f"worst condition {worst[1]}: at least {worst[0]:.2f}")
    return _found(plan, study)


def draw(trial: Any, parameters: Mapping[str, Parameter]) -> dict[str, Any]:
    """A trial's values, by key; choices may be anything that TOML has."""
    values: dict[str, Any] = {}
    for name, one in parameters.items():
        if one.choices:
            texts = [json.dumps(msgspec.to_builtins(choice)) for choice in one.choices]
            values[name] = json.loads(trial.suggest_categorical(name, texts))
        elif one.integers:
            step = {} if one.step is None else {"step": int(one.step)}
            values[name] = trial.suggest_int(name, one.low, one.high, log=one.log, **step)
        else:
            apart = None if one.step is None else float(one.step)
            values[name] = trial.suggest_float(name, one.low, one.high, log=one.log, step=apart)
    return values


def worst_condition(tables: Iterable[pa.Table]) -> tuple[float, str]:
    """The least lower bound of a condition's success, and which, over all of these episodes.

    Raises:
        RunError: the task has no goal, or nothing was driven.
    """
    counts: dict[str, list[bool]] = {}
    for table in tables:
        for condition, success in zip(
            table["condition"].to_pylist(), table["success"].to_pylist(), strict=True
        ):
            if success is None:
                raise RunError(
                    "its task has no goal: there is no success to search for",
                    where="[space]",
                    remedy="train on a task with a goal",
                )
            counts.setdefault(condition, []).append(success)
    if not counts:
        raise RunError("no episode was driven: there is nothing to compare", where="[space]")
    bounds = {name: wilson(sum(observed), len(observed))[0] for name, observed in counts.items()}
    condition = min(sorted(bounds), key=lambda name: bounds[name])
    return bounds[condition], condition


def _ended(study: Any) -> int:
    return sum(trial.state.name in ENDED for trial in study.trials)


def _sampler(optuna: Any, search: Search, number: int) -> Any:
    """By its number alone, so that a search that was interrupted draws as it would have."""
    seed = (search.sampler_seed * 1_000_003 + number) % 2**32
    if search.sampler == "random":
        return optuna.samplers.RandomSampler(seed=seed)
    return optuna.samplers.TPESampler(seed=seed, n_startup_trials=search.startup_trials)


def _try(
    plan: SearchPlan, trial: Any, values: Mapping[str, Any], say: Say
) -> tuple[float, str] | None:
    """Train and judge every seed; None where the trial is stopped on the way."""
    search = plan.search
    for index, seed in enumerate(search.seeds):
        path = plan.run(values, seed)
        log = plan.out / "logs" / f"{path.name}.log"
        if (path / DONE).exists():  # trained before, by a trial that drew the same values
            if search.prune:
                _falls_behind(trial, path, set(), index)
            continue
        settings = [*settings_of(search, values), f"seed={seed}"]
        panel = plan.panel(values)
        if panel is not None and search.panel is None and search.store is not None:
            mixture = str(values.get(MIXTURE, search.mixture))
            pack(search.store, mixture, plan.folder, panel, plan.out / "logs" / "mix.log", say)
        if not _train(path, settings, panel, log, trial if search.prune else None, index):
            return None
        perturbations = ",".join(search.evaluation.perturbations)
        flags = ["--policies", "agent", "--perturbations", perturbations]
        restock_verb(["eval", str(path), *flags, *episodes_flags(search.evaluation)], log)
        write_text(path / DONE, json.dumps({"settings": settings}) + "\n")
    tables = [agent_episodes(Run.open(plan.run(values, seed))) for seed in search.seeds]
    return worst_condition([table for table in tables if table is not None])


def _train(
    path: Path, settings: list[str], panel: Path | None, log: Path, trial: Any, index: int
) -> bool:
    """Train a run, telling the trial of its evaluations; False where it was stopped by them."""
    words = train_words(path, settings, panel)
    log.parent.mkdir(parents=True, exist_ok=True)
    reported: set[int] = set()
    stopped = False
    with kill_as_interrupt(), log.open("a", encoding="utf-8") as file:
        file.write(f"$ restock {' '.join(words)}\n")
        file.flush()
        process = subprocess.Popen(
            [sys.executable, "-m", "restock", *words],
            stdout=file,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            env={**os.environ, "NO_COLOR": "1"},
            start_new_session=True,  # Ctrl-C reaches it through here alone: twice is "at once"
        )
        with ended_with_us(process):
            while process.poll() is None:
                time.sleep(_POLL_S)
                if (
                    trial is not None
                    and not stopped
                    and _falls_behind(trial, path, reported, index)
                ):
                    process.send_signal(signal.SIGINT)  # it checkpoints and ends
                    stopped = True
    if process.returncode == 130 and not stopped:
        raise KeyboardInterrupt
    if process.returncode not in (0, 3, 130):
        last = [line for line in log.read_text(encoding="utf-8").splitlines() if line.strip()][-3:]
        raise RestockError(
            f"`restock train` failed with exit code {process.returncode}: " + " / ".join(last),
            where=str(log),
            remedy="correct it and run the same command again: finished trials are kept",
        )
    if trial is not None and not stopped:  # what it evaluated since it was last looked at
        _falls_behind(trial, path, reported, index)
    return not stopped


def _falls_behind(trial: Any, path: Path, reported: set[int], index: int) -> bool:
    """Tell the trial of the run's new evaluations; whether it is to be stopped."""
    file = path / "evaluations.parquet"
    if not file.exists():
        return False
    import pyarrow.compute as pc  # slow to import

    table = read_table(file, columns=["env_steps", "condition", "success"], error=RunError)
    for steps in sorted(set(table["env_steps"].to_pylist()) - reported):
        reported.add(steps)
        bound, _ = worst_condition([table.filter(pc.equal(table["env_steps"], steps))])
        # Seeds follow each other: each has its own stretch of steps.
        trial.report(bound, index * 1_000_000_000 + steps)
        if trial.should_prune():
            return True
    return False


def _found(plan: SearchPlan, study: Any) -> dict[str, Any]:
    """All trials, and the best with what trains it again."""
    trials = [
        {
            "trial": trial.number,
            "state": trial.state.name.lower(),
            "worst_lower_bound": trial.value if trial.state.name == "COMPLETE" else None,
            "worst_condition": trial.user_attrs.get("condition"),
            "evaluations": len(trial.intermediate_values),
            "values": (values := _values(trial, plan.search)),
            "runs": [str(plan.run(values, seed)) for seed in plan.search.seeds],
        }
        for trial in study.trials
        if trial.state.name in ENDED
    ]
    complete = [trial for trial in trials if trial["state"] == "complete"]
    best = max(complete, key=lambda trial: trial["worst_lower_bound"], default=None)
    found = {
        "doc": plan.search.doc,
        "objective": "the least over conditions of the lower end of success's 95 % interval",
        "trials": trials,
        "best": best,
    }
    if best is not None:
        panel = plan.panel(best["values"])
        lines = [f"# trial {best['trial']}: at least {best['worst_lower_bound']:.3f}"]
        lines += [f"# restock train --config best.toml --panel {quoted(panel)}"] if panel else []
        lines += [
            " = ".join(line.split("=", 1)) for line in settings_of(plan.search, best["values"])
        ]
        write_text(plan.out / "best.toml", "\n".join(lines) + "\n")
    return found


def _values(trial: Any, search: Search) -> dict[str, Any]:
    return {
        name: json.loads(value) if search.parameters[name].choices else value
        for name, value in trial.params.items()
    }


def search_page(found: Mapping[str, Any]) -> str:
    """The trials as Markdown, the best first."""
    lines = ["# The search", "", *([found["doc"], ""] if found["doc"] else [])]
    lines += [f"Objective: {found['objective']}.", ""]
    lines += ["| trial | | worst condition | at least | settings |", "|---|---|---|---|---|"]
    for trial in sorted(found["trials"], key=_rank):
        bound = trial["worst_lower_bound"]
        reached = "" if bound is None else f"{bound:.3f}"
        name = trial["worst_condition"] or ""
        words = _in_words(trial["values"])
        lines.append(f"| {trial['trial']} | {trial['state']} | {name} | {reached} | {words} |")
    if found["best"] is not None:
        lines += ["", "`best.toml` has the settings of the best; it was chosen among several by"]
        lines += ["these episodes, so evaluate it on others: `restock eval RUN --seed N`."]
    return "\n".join(lines) + "\n"


def _rank(trial: Mapping[str, Any]) -> float:
    bound = trial["worst_lower_bound"]
    return math.inf if bound is None else -bound


def _in_words(values: Mapping[str, Any]) -> str:
    return ", ".join(
        f"{name} = {value:.4g}" if isinstance(value, float) else f"{name} = {value}"
        for name, value in values.items()
    )


__all__ = ["SearchPlan", "run_search", "search_page", "worst_condition"]
