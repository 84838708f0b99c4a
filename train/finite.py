"""Numbers that are not finite end a run with an error that names the rows of the batch.

A loss or gradient that is NaN or infinite makes every value NaN within an update, and nothing that
is learnt, evaluated or kept after it means anything. The loss of each update is looked at, which
costs nothing: it is summed anyway. A gradient that is not finite under a loss that is shows in the
parameters: they are looked at before an interval is closed, a policy is evaluated and a checkpoint
is written, so that none of them is ever of NaN. Another library's loop is its own: there the rows
and TD errors that its buffer sees are looked at, and the parameters before they are evaluated.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from restock.arrays import F32, Bools
from restock.errors import RunError
from restock.files import write_text
from restock.train.dqn.algorithm import Loss
from restock.train.feed.batches import ReplayBatch
from restock.train.session import Session

STOPPED = "not_finite.json"  # in the run's directory
_NAMED = 8  # rows in the message; the file has all of them
_LEAVE_OUT = (
    "`restock trace PANEL PANEL_ROW` shows where such a row comes from; exclude it with the "
    "mixture's `where`, mix again and train again"
)
_SLOWER = (
    "train with a lower optimizer.learning_rate, or a smaller optimizer.max_grad_norm; "
    "checkpoints and tables up to here are valid"
)


class NotFinite(RunError):
    """A loss, gradient or parameter was NaN or infinite."""


def check_loss(session: Session, batch: ReplayBatch, loss: Loss, value: float, phase: str) -> None:
    """Of the update just made, whose batch `session.feed` has kept.

    Raises:
        NotFinite: `value`, its loss, is not finite; names the rows.
    """
    if math.isfinite(value):
        return
    bad_rows = ~np.isfinite(batch.rows.cpu().numpy()).all(axis=1)
    td = loss.td.cpu().numpy()
    bad = bad_rows | ~np.isfinite(td)
    if not bad.any():  # finite one by one, and too large together
        bad = np.abs(td) == np.abs(td).max()
    what = f"the loss is {value} ({phase})"
    if bad_rows.any():
        _stop(session, what, bad_rows, "hold values that are not finite", _LEAVE_OUT)
    if bad.all():
        why = "have such TD errors, after an update that left no parameter whole"
        _stop(session, what, bad, why, _SLOWER, before=True)
    _stop(session, what, bad, "have such TD errors, or the largest", _SLOWER)


def check_parameters(session: Session) -> None:
    """Before they are recorded, evaluated or kept.

    Raises:
        NotFinite: one is not finite; names the rows of the last batch.
    """
    if session.learner.is_finite:
        return
    everything = np.ones(len(session.feed.last_batch()), np.bool_)
    what = "the gradient was not finite, and with it the network's parameters"
    _stop(session, what, everything, "gave it", _SLOWER)


def check_fed(
    packed: F32,
    td: F32 | None,
    rows: Callable[[], list[dict[str, Any]]],
    *,
    run: Path | None,
    steps: Mapping[str, int],
) -> None:
    """A batch (B, W) of another library's loop, with its TD errors (B,) where they are known.

    Args:
        rows: the ids of its rows, as `FeedRecord.last_batch` has them.
        run: the run's directory, if there is one.
        steps: `env_steps` and `gradient_steps` so far.

    Raises:
        NotFinite: one of them is not finite; names the rows.
    """
    bad_rows: Bools = np.logical_not(np.isfinite(packed).all(axis=1))
    bad_td: Bools = np.zeros(len(packed), np.bool_)
    if td is not None:
        bad_td = np.logical_not(np.isfinite(td))
    if bad_rows.any():
        why = "hold values that are not finite"
        _refuse("a batch is not finite", bad_rows, why, _LEAVE_OUT, rows(), run, steps)
    if bad_td.any():
        what = "the loss is not finite"
        why = "have such TD errors"
        if bad_td.all():
            why += ", after an update that left no parameter whole"
        _refuse(what, bad_td, why, _SLOWER, rows(), run, steps)


def check_kept(parameters: bool, run: Path, steps: Mapping[str, int]) -> None:
    """Before what another library learnt is evaluated: whether all its parameters are finite.

    Raises:
        NotFinite: one is not.
    """
    if not parameters:
        what = "the gradient was not finite, and with it the network's parameters"
        _refuse(what, np.zeros(0, np.bool_), "", _SLOWER, [], run, steps)


def _stop(
    session: Session, what: str, bad: Bools, why: str, remedy: str, *, before: bool = False
) -> NoReturn:
    """Leave the run's tables whole, write down the rows, and raise."""
    session.write_held()
    rows_before = session.feed.last_batch(before=True) if before else []
    rows, path = session.feed.last_batch(), session.run.path
    _refuse(what, bad, why, remedy, rows, path, session.steps, rows_before)


def _refuse(
    what: str,
    bad: Bools,
    why: str,
    remedy: str,
    rows: Sequence[dict[str, Any]],
    run: Path | None,
    steps: Mapping[str, int],
    rows_before: Sequence[dict[str, Any]] = (),
) -> NoReturn:
    """Write the rows into the run, if there is one, and raise."""
    named = [row for row, is_bad in zip(rows, bad, strict=True) if is_bad]
    message = f"{what} at update {steps['gradient_steps']}"
    if named:
        more = f" and {len(named) - _NAMED} more" if len(named) > _NAMED else ""
        message += f"; {len(named)} of the {len(rows)} rows of the batch {why}:"
        message += f" {', '.join(map(_name, named[:_NAMED]))}{more}"
    if run is not None:
        document = {
            **steps,
            "what": what,
            "rows": [{**row, "named": bool(is_bad)} for row, is_bad in zip(rows, bad, strict=True)],
            "rows_before": list(rows_before),
        }
        write_text(run / STOPPED, json.dumps(document, indent=1) + "\n")
        message += f"; all are in {STOPPED}" if rows else ""
        message += ", with those of the batch before" if rows_before else ""
    raise NotFinite(message, where=None if run is None else str(run), remedy=remedy)


def _name(row: dict[str, Any]) -> str:
    if row["source"] == "logs":
        return f"panel row {row['panel_row']} (transition {row['transition_id']})"
    return f"step {row['episode_step']} of the twin's episode {row['episode']}"


__all__ = [
    "STOPPED",
    "NotFinite",
    "check_fed",
    "check_kept",
    "check_loss",
    "check_parameters",
]
