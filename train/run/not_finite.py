"""Numbers that are not finite end a run with an error that names the rows of the batch.

A loss or gradient that is NaN or infinite makes every value NaN within an update, and nothing that
is learnt, evaluated or kept after it means anything. `restock.train.loop` checks the loss of every
update, which costs nothing because it is summed anyway. A gradient that is not finite under a
finite loss shows in the parameters: they are checked before an interval is closed, a policy is
evaluated and a checkpoint is written, so that none of these ever contains NaN. Another library's
loop is its own: there the rows and TD errors that its buffer sees are checked, and the parameters
before they are evaluated.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from restock.arrays import F32, Bools
from restock.errors import RunError
from restock.files import write_text

STOPPED = "not_finite.json"  # in the run's directory
_NAMED = 8  # rows in the message; the file has all of them
LEAVE_OUT = (
    "`restock trace PANEL PANEL_ROW` shows where such a row comes from; exclude it with the "
    "mixture's `where`, mix again and train again"
)
TRAIN_SLOWER = (
    "train with a lower optimizer.learning_rate, or a smaller optimizer.max_grad_norm; "
    "checkpoints and tables up to here are valid"
)


class NotFinite(RunError):
    """A loss, gradient or parameter was NaN or infinite."""


def check_fed(
    packed: F32,
    td: F32 | None,
    rows: Callable[[], list[dict[str, Any]]],
    *,
    run: Path | None,
    steps: Mapping[str, int],
) -> None:
    """Check a batch (B, W) of another library's loop, with its TD errors (B,) if they are known.

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
        refuse("a batch is not finite", bad_rows, why, LEAVE_OUT, rows(), run, steps)
    if bad_td.any():
        what = "the loss is not finite"
        why = "have such TD errors"
        if bad_td.all():
            why += ", after an update that left no parameter whole"
        refuse(what, bad_td, why, TRAIN_SLOWER, rows(), run, steps)


def check_kept(parameters: bool, run: Path, steps: Mapping[str, int]) -> None:
    """Before what another library learnt is evaluated: whether all its parameters are finite.

    Raises:
        NotFinite: one is not.
    """
    if not parameters:
        what = "the gradient was not finite, and with it the network's parameters"
        refuse(what, np.zeros(0, np.bool_), "", TRAIN_SLOWER, [], run, steps)


def refuse(
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


__all__ = ["LEAVE_OUT", "STOPPED", "TRAIN_SLOWER", "NotFinite", "check_fed", "check_kept", "refuse"]
