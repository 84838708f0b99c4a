"""One robot of a fleet that is unlike the others: what is wrong in some recordings alone.

A wrong sensor of one robot in four moves the figures of all rows by a quarter of what it does to
its own: within what is allowed, or as if all robots were a little wrong. So each recording is
compared by itself, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from restock.train.diagnosis.answers import Answer, TwinFits, answers
from restock.train.diagnosis.causes import Finding, findings
from restock.train.diagnosis.evidence import Comparison, not_run
from restock.train.diagnosis.fed_rows import FedRows

FEWEST_ROWS = 500  # of a recording that is compared by itself
MOST = 40  # recordings, of the most rows
CHECK = "recordings"
_SOME = 0.8  # of the recordings, at most: what is wrong in nearly all of them is wrong in all rows
_NAMED = 3


def unlike_recordings(
    logs: FedRows, twin: FedRows | None, seed: int = 0
) -> tuple[list[Finding], list[Comparison]]:
    """What is wrong in some of the recordings alone, and the comparisons that say so."""
    names, rows = np.unique(logs.recording, return_counts=True)
    if len(names) < 2:
        return [], []
    chosen = names[np.argsort(-rows, kind="stable")][: min((rows >= FEWEST_ROWS).sum(), MOST)]
    what = "each recording by itself"
    if not len(chosen):
        return [], [not_run(CHECK, what, f"no recording has {FEWEST_ROWS} rows")]
    found: dict[str, list[tuple[str, Finding]]] = {}  # by cause
    off: list[Comparison] = []
    of_twin: TwinFits = {}  # the same for every recording
    for name in chosen.tolist():
        rows_of = logs.take(logs.recording == name)
        own = [_named(one, name) for one in answers(rows_of, twin, seed, of_twin)]
        for one in findings(own, [], [], logs.task):
            found.setdefault(one.cause, []).append((name, one))
        off += [row for one in own for row in one.comparisons if row.off]
    some = list(found.values())
    if any(len(each) > _SOME * len(chosen) for each in some):
        some = []
    compared = Comparison(
        CHECK, what, "recordings", "off" if some else "ok",
        logs_rows=int(np.isin(logs.recording, chosen).sum()),
        note=f"{len(chosen)} of {len(names)} have {FEWEST_ROWS} rows and were compared",
    )  # fmt: skip
    return [_joined(each, len(chosen)) for each in some], [compared, *(off if some else [])]


def _named(answer: Answer, recording: str) -> Answer:
    """With the recording in the names of its comparisons."""
    rows = (replace(row, check=f"{row.check}, {recording}") for row in answer.comparisons)
    return replace(answer, comparisons=tuple(rows))


def _joined(each: Sequence[tuple[str, Finding]], compared: int) -> Finding:
    """One finding of those of several recordings, in the words of the first."""
    names = ", ".join(name for name, _ in each[:_NAMED])
    more = f" and {len(each) - _NAMED} more" if len(each) > _NAMED else ""
    first = each[0][1]
    return replace(
        first,
        text=f"in {len(each)} of {compared} recordings ({names}{more}): {first.text}",
        remedy="for these recordings alone (the store's `recordings` view has their files and"
        f" tags): {first.remedy}",
        evidence=tuple(check for _, one in each for check in one.evidence),
    )


__all__ = ["unlike_recordings"]
