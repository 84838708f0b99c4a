"""The experiment that confirms a diagnosis: the same run with one suspect replaced.

If the target was at fault, another target rule on the same feed mends it; if the feed was, the same
target rule on another feed does. What is left unchanged says as much as what changes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from restock.errors import RunError
from restock.train.dqn.config import apply_overrides, as_overrides, parse_config
from restock.train.judge.diagnose import Diagnosis, diagnose, other_target, target_rule
from restock.train.judge.windows import Cause
from restock.train.loop import train
from restock.train.prepare import prepare_new
from restock.train.run.run import Run, check_free

_NOTHING: frozenset[Cause] = frozenset({"HEALTHY", "UNDETERMINED"})


def check_place(out: Path) -> None:
    """Raise RunError where the experiment's run cannot be made at `out`."""
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
    """Train again with one thing swapped, to `out`, and diagnose that.

    `diagnosis` is of the run's own figures (`diagnose`), without its rows: those that are wrong
    alike leave no trace in any run's figures, so that a new run without such a trace would confirm
    nothing. `rows_at_fault` says that the rows are, for a run whose figures are not.

    Returns `changed` (settings), the new run's `cause`, and `confirmed`: True where the cause is
    gone, False where it stayed, None where the new run does not say.

    Raises:
        RunError: something is at `out`, there is nothing to confirm, or no setting changes what
            is suspected.
    """
    check_place(out)
    if rows_at_fault and diagnosis.cause in (*_NOTHING, "ACTION_COVERAGE"):
        raise RunError(
            f"is {diagnosis.cause} by its own figures, and only its rows are at fault: another run"
            " cannot confirm that",
            where=str(run.path),
            remedy="correct the rows, mix again, and ask `restock diagnose --before-training PANEL`"
            " whether they are right now",
        )
    if diagnosis.cause in _NOTHING:
        raise RunError(
            f"is {diagnosis.cause}: there is nothing to confirm",
            where=str(run.path),
            remedy=diagnosis.experiment,
        )
    if diagnosis.cause == "ACTION_COVERAGE":
        raise RunError(
            "is ACTION_COVERAGE: no setting can add the rows that the logs lack",
            where=str(run.path),
            remedy=diagnosis.experiment,
        )
    config, changed = run.document["config"], swapped(run, diagnosis.cause)
    where = str(run.path)
    if parse_config(apply_overrides(config, changed), where=where) == parse_config(
        config, where=where
    ):
        raise RunError(
            f"is {diagnosis.cause}, and has the settings of the experiment already: "
            + ", ".join(changed),
            where=where,
            remedy=diagnosis.experiment,
        )
    panel = run.document["panel"]
    if config["teacher"]["source"] == "none":  # its other settings, resolved, have no effect
        config = config | {"teacher": {"source": "none"}}
    settings = as_overrides(config) + changed
    prepared = prepare_new(out, Path(panel["path"]) if panel else None, None, settings)
    session = prepared.open()
    try:
        train(session)
    finally:
        session.close()
    after = diagnose([Run.open(out)])
    suspected = "TARGET" if diagnosis.cause == "BOTH" else diagnosis.cause  # what was swapped
    still = after.cause in (suspected, "BOTH")
    return {
        "changed": changed,
        "run": str(out),
        "cause": after.cause,
        "confirmed": None if after.cause == "UNDETERMINED" else not still,
        "evidence": after.evidence,
    }


def swapped(run: Run, cause: Cause) -> list[str]:
    """Return the settings that replace what is suspected."""
    config = run.document["config"]
    if cause == "DIVERGENCE":
        return [f"optimizer.learning_rate={min(config['optimizer']['learning_rate'] / 10, 3e-4)}"]
    if cause in ("TARGET", "BOTH"):
        tau = other_target(target_rule(run)).tau
        return [f"target={{rule='polyak', tau={tau:g}}}"]
    # The feed: all conditions that were evaluated, equally often, and fresh rows alone.
    share = 1 / len(config["env"]["conditions"])
    names = list(config["env"]["conditions"])
    natural = "practice={rule='natural'}"
    return [
        "replay.logs_share=0.0",
        natural,
        *(f"env.conditions.{name}={share:.6g}" for name in names),
    ]


__all__ = ["check_place", "confirm", "swapped"]
