"""Tell buffer failure from target failure: what a critic gets wrong, and where.

A critic fails in two ways that a falling loss cannot tell apart. Its *replay* may have too few or
too many rows of a condition, or wrong ones: then it is wrong on fresh steps of that condition and
right elsewhere. Or its *target* may follow too slowly, not at all, or too fast: then it is wrong
everywhere, or its two networks disagree. The evaluations' steps, which are not in replay, show
which: `windows` has the figures and their limits. Each figure is the median over the last
evaluations.

An experiment confirms a diagnosis: the same run with one suspect replaced. If the target was at
fault, another target rule on the same feed repairs the critic. If the feed was, the same target
rule on another feed does.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isinf
from pathlib import Path
from typing import Any

import msgspec

from restock.errors import RestockError, RunError, counted
from restock.train.dqn.config import (
    Polyak,
    TargetRule,
    apply_overrides,
    as_overrides,
    has_effect,
    parse_config,
)
from restock.train.judge.before_training import RowDiagnosis, diagnose_before_training
from restock.train.judge.comparability import refuse_dependent
from restock.train.judge.windows import (
    LIMITS,
    Cause,
    Window,
    median_window,
    windows_of,
)
from restock.train.loop import train
from restock.train.prepare import prepare_new
from restock.train.run.run import Run, check_free
from restock.train.run.run_profile import profile_of_run, run_panel
from restock.train.twin.floors.layout import DEFAULT
from restock.train.twin.physics.perturbation import Schedule, find_perturbation

WINDOWS = 3  # figures are medians over so many of the last windows (evaluations)
_SETTLED_LAGS = 10  # a run is old enough to judge L after so many mean ages of its target
_MIN_UPDATES = 1500  # updates from which L is judged in younger runs, too, unless it is falling
_FALLING = 0.75  # L is falling if its ratio of the last to the first window is below this
_WORKING_LAGS = 50, 800  # range of a target's mean age, in updates, with which most critics learn


@dataclass(frozen=True)
class Diagnosis:
    """The verdict on one or more runs (seeds of one method), with the evidence."""

    cause: Cause
    runs: list[Cause]  # cause per run
    figures: list[Window]  # per run, the median over its last windows
    windows: list[list[Window]]  # per run, in order of time
    evidence: list[str]
    experiment: str  # what to try, in words, to confirm the cause


def diagnose(runs: Sequence[Run]) -> Diagnosis:
    """Diagnose runs of one method that differ only in their seed.

    Raises:
        RunError: no run is given, a run has no evaluation after its updates, or two runs are the
            same run, have the same seed, or differ in more than the seed.
    """
    refuse_dependent(runs)
    windows = [windows_of(run) for run in runs]
    figures = [median_window(of_run[-WINDOWS:]) for of_run in windows]
    verdicts = [_verdict(*of_run) for of_run in zip(runs, windows, figures, strict=True)]
    causes = [cause for cause, _ in verdicts]
    ((cause, votes), *_) = Counter(causes).most_common()
    advice = "; ".join(dict.fromkeys(advice for _, advice in verdicts if advice))
    if votes <= len(causes) / 2:
        cause = "UNDETERMINED"
        advice = f"train longer, or with more seeds: the runs do not agree ({', '.join(causes)})"
    agreeing = [window for window, own in zip(figures, causes, strict=True) if own == cause]
    shown = agreeing or figures
    return Diagnosis(
        cause,
        causes,
        figures,
        windows,
        _evidence(shown[0]),
        _experiment(cause, shown, target_rule(runs[0]), advice),
    )


def target_rule(run: Run) -> TargetRule:
    """Return the run's target rule; raise RunError if its config has none."""
    if (given := run.document["config"].get("target")) is None:
        raise RunError(
            "does not say how its target follows",
            where=str(run.path),
            remedy='give its buffer settings={"target": {"rule": "polyak", "tau": 0.005}, …}',
        )
    rule: TargetRule = msgspec.convert(given, TargetRule)
    return rule


def other_target(rule: TargetRule) -> Polyak:
    """Return a target rule to try in place of `rule`, to test whether `rule` is at fault.

    This is the default rule if `rule` is far too slow or too fast, else a rule with a quarter of
    the lag of `rule`.
    """
    least, below = _WORKING_LAGS
    lag = rule.effective_lag
    return Polyak(tau=4 / lag) if least <= lag < below else Polyak()


def _verdict(run: Run, windows: Sequence[Window], figures: Window) -> tuple[Cause, str]:
    """Return the verdict on the last windows, and what to do if it is UNDETERMINED."""
    if windows[-1].diverged() and figures.diverged():
        return "DIVERGENCE", ""
    last = windows[-WINDOWS:]
    if len(last) < WINDOWS:
        return "UNDETERMINED", (
            "train longer, or evaluate more often (evaluation.every_env_steps): "
            f"{counted(len(last), 'evaluation')}, and the verdict needs {WINDOWS}"
        )
    lagging = any(not window.lag < LIMITS.lag for window in last)
    if lagging and (young := _explain_youth(last, target_rule(run))):
        return "UNDETERMINED", f"train longer: {young}"
    if len({bool(window.target()) for window in last}) > 1:
        return "UNDETERMINED", (
            f"train longer: the last {WINDOWS} evaluations do not agree on whether the target is "
            "at fault"
        )
    cause = figures.cause()
    many = (
        "correct what the evidence names, and train again: more than half of the conditions are in "
        "doubt, which may be their rows or the critic"
    )
    return cause, many if cause == "UNDETERMINED" else ""


def _explain_youth(last: Sequence[Window], rule: TargetRule) -> str:
    """Explain why the run's youth may be the cause of its large lag L; "" if it cannot be.

    While values grow from 0, every target lags, but L falls with time. If L does not fall, the
    rule is too slow for any run to be old enough, and the rule is at fault.
    """
    updates, settled = last[-1].gradient_steps, _SETTLED_LAGS * rule.effective_lag
    if updates >= settled:
        return ""
    if updates < _MIN_UPDATES:
        return (
            f"after {updates:,} updates any target lags; L is judged from "
            f"{min(settled, _MIN_UPDATES):,.0f} on"
        )
    if last[-1].lag < _FALLING * last[0].lag:
        lags = ", ".join(f"{window.lag:.2f}" for window in last)
        return f"L is still falling ({lags}), as the values of a young run are learnt"
    return ""


def _explained(explained: float | None) -> str:
    return "" if explained is None else f" {explained:.0%} of the targets' variance explained,"


def _evidence(window: Window) -> list[str]:
    """Describe a window's figures, and which of them are past their limits."""
    most = f"of at most {window.q_bound:.3g}"
    if isinf(window.q_bound):
        most = "(how large it may be is unknown: no audited row has a reward)"
    lines = [
        f"after {window.gradient_steps:,} updates: median G {window.gap_median:.2f},"
        f" L {window.lag:.3f}, S {window.clock:.2f},{_explained(window.explained)}"
        f" max |Q| {window.q_abs_max:.3g} {most}"
    ]
    lines += [f"target: {reason}" for reason in window.target()]
    for condition, reasons in window.bad().items():
        lines += [f"{condition}: {reason}" for reason in reasons]
    return lines


def _experiment(
    cause: Cause,
    windows: Sequence[Window],
    rule: TargetRule,
    advice: str,  # what to do if the cause is UNDETERMINED
) -> str:
    named = dict.fromkeys(name for window in windows for name in window.bad())
    which = ", ".join(named) or "the condition with the largest gap"
    return {
        "HEALTHY": "none needed: no figure is past its limit",
        "BUFFER": f"train again with more or corrected rows of {which} and the same target rule: "
        "these symptoms must be gone, and nothing else change",
        "TARGET": f"train again with the target rule {other_target(rule)} in place of {rule} on "
        "the same panel: the figures of the target must be back within their limits",
        "BOTH": f"first change the target rule alone, from {rule} to {other_target(rule)}, then "
        f"the rows of {which} alone",
        "DIVERGENCE": "train again with a lower optimizer.learning_rate, then with a slower"
        " target: no rows explain values above the sum of rewards, or without information",
        "UNDETERMINED": advice,
    }[cause]


_WITH_WRONG_ROWS: dict[Cause, Cause] = {  # cause by the run's figures -> cause with wrong rows
    "HEALTHY": "BUFFER",
    "UNDETERMINED": "BUFFER",
    "TARGET": "BOTH",
}


def rows_of(runs: Sequence[Run]) -> tuple[RowDiagnosis | None, str]:
    """Diagnose the rows of the panel that the runs were fed; None, and why, if impossible."""
    fed = {run.document["panel"]["path"]: run for run in runs if run.document.get("panel")}
    if len(fed) != 1:
        return None, "the runs were fed several panels" if fed else "there is no panel"
    ((path, run),) = fed.items()
    env = run.document["config"].get("env", {})
    try:
        run_panel(run.document)
        given = find_perturbation(env.get("perturbation", "nominal"), where="env.perturbation")
        twin = given.base if isinstance(given, Schedule) else given
        profile = profile_of_run(run)
        found = diagnose_before_training(
            Path(path),
            profile=profile,
            perturbation=twin,
            layouts=env.get("layouts", DEFAULT),
        )
        return found, ""
    except RestockError as error:  # the run may be on a machine without its panel
        return None, f"{path}: {error.what}"


def with_rows(diagnosis: Diagnosis, rows: RowDiagnosis) -> Diagnosis:
    """Combine the verdicts on a run and on its rows; sound rows change nothing."""
    if not rows.findings:
        return diagnosis
    cause = _WITH_WRONG_ROWS.get(diagnosis.cause, diagnosis.cause)
    experiment = diagnosis.experiment
    if cause in ("BUFFER", "BOTH"):
        experiment = f"first correct the rows ({rows.findings[0].remedy}), mix and train again"
    reasons = []
    if cause != diagnosis.cause:
        whose = "the run's own figures" if len(diagnosis.runs) == 1 else "the runs' own figures"
        reasons = [f"{diagnosis.cause} by {whose}, {cause} with the rows that were fed:"]
    reasons += [f"rows: {one.cause}: {one.text}" for one in rows.findings]
    return replace(
        diagnosis, cause=cause, evidence=[*diagnosis.evidence, *reasons], experiment=experiment
    )


_UNCONFIRMABLE: frozenset[Cause] = frozenset({"HEALTHY", "UNDETERMINED"})


def check_place(out: Path) -> None:
    """Raise RunError if the experiment's run cannot be made at `out`."""
    try:
        check_free(out)
    except RunError as taken:
        raise RunError(
            taken.what,
            where=taken.where,
            remedy="give --confirm another directory, or remove this one",
        ) from taken


def confirm(
    run: Run, diagnosis: Diagnosis, out: Path, *, rows_at_fault: bool = False
) -> dict[str, Any]:
    """Train again into `out` with the suspected part replaced, and diagnose that run.

    `diagnosis` must be that of `diagnose`, without `with_rows`: consistently wrong rows leave no
    trace in any run's figures, so a new run without a trace would confirm nothing. `rows_at_fault`
    is whether the rows were found to be wrong; it only makes the error more precise.

    Returns `changed` (settings), the `run`, its `cause` and `evidence`, and `confirmed`: True if
    the suspected cause is gone, False if it is not, None if the new run is undetermined.

    Raises:
        RunError: something is at `out`, there is nothing to confirm, or the run already has the
            settings of the experiment.
    """
    check_place(out)
    config, where = run.document["config"], str(run.path)
    cause, remedy = diagnosis.cause, diagnosis.experiment
    changed = [] if cause in _UNCONFIRMABLE else swapped(run, cause)
    what = None
    if rows_at_fault and cause in _UNCONFIRMABLE:
        what = "by its own figures, and only its rows are at fault: another run cannot confirm that"
        remedy = "correct the rows, mix again, and check them with `restock diagnose PANEL`"
    elif cause in _UNCONFIRMABLE:
        what = "there is nothing to confirm"
    elif parse_config(apply_overrides(config, changed), where=where) == parse_config(
        config, where=where
    ):
        what = f"it already has the settings of the experiment: {', '.join(changed)}"
    if what is not None:
        raise RunError(f"is {cause}: {what}", where=where, remedy=remedy)
    panel = run.document["panel"]
    given = config["teacher"]  # lists all settings, also those that its source ignores
    resolved = parse_config(config, where=where)
    has = {"source", *(key for key in given if has_effect(resolved, key))}
    taught = {key: value for key, value in given.items() if key in has}
    settings = as_overrides(config | {"teacher": taught}) + changed
    prepared = prepare_new(out, Path(panel["path"]) if panel else None, None, settings)
    session = prepared.open()
    try:
        train(session)
    finally:
        session.close()
    after = diagnose([Run.open(out)])
    suspected = "TARGET" if diagnosis.cause == "BOTH" else diagnosis.cause  # the replaced part
    still = after.cause in (suspected, "BOTH")
    return {
        "changed": changed,
        "run": str(out),
        "cause": after.cause,
        "confirmed": None if after.cause == "UNDETERMINED" else not still,
        "evidence": after.evidence,
    }


def swapped(run: Run, cause: Cause) -> list[str]:
    """Return the settings that replace the suspected part."""
    config = run.document["config"]
    if cause == "DIVERGENCE":
        return [f"optimizer.learning_rate={min(config['optimizer']['learning_rate'] / 10, 3e-4)}"]
    if cause in ("TARGET", "BOTH"):
        tau = other_target(target_rule(run)).tau
        return [f"target={{rule='polyak', tau={tau:g}}}"]
    # Replace the feed: only fresh rows, of all conditions equally often.
    share = 1 / len(config["env"]["conditions"])
    names = list(config["env"]["conditions"])
    natural = "practice={rule='natural'}"
    return [
        "replay.logs_share=0.0",
        natural,
        *(f"env.conditions.{name}={share:.6g}" for name in names),
    ]
