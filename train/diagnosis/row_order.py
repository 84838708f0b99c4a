"""Do rows follow from one another? What must hold by definition, whatever the robot or the twin.

An observation holds the action before it and how clearances changed since the one before, and the
next observation of a row is the observation of the next. Rows that were shifted, mixed up,
repeated, or that know what comes after them break this.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from restock.arrays import F32, Bools
from restock.train.diagnosis.evidence import Comparison, not_run, share_judged
from restock.train.diagnosis.fed_rows import FedRows

MOST = 0.02  # of the rows
_EQUAL = 1e-4
_MIN_STEPS = 10  # of an episode, for its repetition to be no accident


def row_order(rows: FedRows) -> Iterator[Comparison]:
    """Every check of rows against rows."""
    joined, before = rows.joined, np.maximum(np.arange(len(rows)) - 1, 0)
    count = int(joined.sum())
    apart = _differ(rows.next_observation[before], rows.observation) & joined
    yield share_judged(
        "chain", "next observation is not the observation of the next row", int(apart.sum()), count,
        MOST,
    )  # fmt: skip
    acted = rows.previous_action() != rows.action[before]
    yield share_judged(
        "previous action", "observation does not hold the action of the row before",
        int((acted & joined).sum()), count, MOST,
    )  # fmt: skip
    after = rows.previous_action(after=True) != rows.action
    yield share_judged(
        "own action", "next observation does not hold the row's own action", int(after.sum()),
        len(rows), MOST,
    )  # fmt: skip
    yield _foresight(rows, joined)
    change = rows.sectors() - rows.sectors()[before]
    names = enumerate(rows.task.observation_names)
    first = next((place for place, name in names if name.startswith("closing_")), 0)
    closing = rows.observation[:, first : first + rows.task.sectors]
    unlike = (np.abs(change - closing) > 10 * _EQUAL).any(axis=1) & joined
    yield share_judged(
        "closing", "clearances did not change as in the observation", int(unlike.sum()),
        count, MOST,
    )  # fmt: skip
    yield _still(rows)
    yield _repeated(rows)


def _foresight(rows: FedRows, joined: Bools) -> Comparison:
    """An observation that holds the action taken at it, where that is not the one before."""
    before = np.maximum(np.arange(len(rows)) - 1, 0)
    changed = joined & (rows.action != rows.action[before])
    knows = changed & (rows.previous_action() == rows.action)
    return share_judged(
        "foresight", "observation contains the action that is only taken "
            "afterwards", int(knows.sum()),
        int(changed.sum()), MOST,
    )  # fmt: skip


def _still(rows: FedRows) -> Comparison:
    """Moving rows whose next observation is the observation."""
    moving = np.abs(rows.now("wheel_speed")) > 0.1
    same = ~_differ(rows.observation, rows.next_observation) & moving
    return share_judged(
        "unchanged", "next observation is the observation, though the robot moves",
        int(same.sum()), int(moving.sum()), MOST,
    )  # fmt: skip


def _repeated(rows: FedRows) -> Comparison:
    """Rows of episodes that are another's, byte for byte, or steps that are there twice."""
    what = "row belongs to an episode that is stored twice"
    if not len(rows):
        return not_run("repeated episodes", what, "no rows")
    starts = np.append(np.flatnonzero(np.append(True, rows.last[:-1])), len(rows))
    seen: set[int] = set()
    same_step = (np.diff(rows.episode) == 0) & (np.diff(rows.step) == 0)
    repeated = int(same_step.sum())
    for begin, end in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
        if end - begin < _MIN_STEPS:
            continue
        content = hash((rows.observation[begin:end].tobytes(), rows.action[begin:end].tobytes()))
        repeated += (end - begin) if content in seen else 0
        seen.add(content)
    return share_judged("repeated episodes", what, repeated, len(rows), MOST)


def _differ(first: F32, second: F32) -> Bools:
    return np.asarray((np.abs(first - second) > _EQUAL).any(axis=1), np.bool_)


__all__ = ["row_order"]
