"""One robot of a fleet that is unlike the others: what is wrong in some recordings alone.

A wrong sensor of one robot in four moves the figures of all rows by a quarter of what it does to
its own: within what is allowed, or as if all robots were a little wrong. So each recording is
compared by itself, too; short ones (a bag a mission) together with the other short ones of the
robot that they are tagged with, or without a tag with those that were recorded before and after.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from restock.train.diagnosis.answers import Answer, TwinFits, answers
from restock.train.diagnosis.causes import Finding, findings
from restock.train.diagnosis.evidence import Comparison, not_run
from restock.train.diagnosis.fed_rows import FedRows

MIN_ROWS = 500  # of a recording, or of several short ones, that are compared by themselves
MOST = 40  # parts, of the most rows
CHECK = "recordings"
_SOME = 0.8  # of the parts, at most: what is wrong in nearly all of them is wrong in all rows
_NAMED = 3


def unlike_recordings(
    logs: FedRows, twin: FedRows | None, seed: int = 0
) -> tuple[list[Finding], list[Comparison]]:
    """What is wrong in some of the recordings alone, and the comparisons that say so."""
    recordings = len(np.unique(logs.recording))
    if recordings < 2:
        return [], []
    part, kind = _parts(logs)
    names, rows = np.unique(part, return_counts=True)
    chosen = names[np.argsort(-rows, kind="stable")][: min((rows >= MIN_ROWS).sum(), MOST)]
    what = f"each of the {kind} by itself"
    if len(chosen) < 2:
        return [], [not_run(CHECK, what, f"there are no two {kind} with {MIN_ROWS} rows")]
    found: dict[str, list[tuple[str, Finding]]] = {}  # by cause
    off: list[Comparison] = []
    of_twin: TwinFits = {}  # the same for every recording
    for name in chosen.tolist():
        rows_of = logs.take(part == name)
        own = [_named(one, name) for one in answers(rows_of, twin, seed, of_twin)]
        for one in findings(own, [], [], logs.task):
            found.setdefault(one.cause, []).append((name, one))
        off += [row for one in own for row in one.comparisons if row.off]
    some = list(found.values())
    if any(len(each) > _SOME * len(chosen) for each in some):
        some = []
    inside = np.isin(part, chosen)
    compared = Comparison(
        CHECK, what, "recordings", "off" if some else "ok",
        logs_rows=int(inside.sum()),
        note=f"{len(chosen)} {kind} with {MIN_ROWS} rows were compared:"
        f" {len(np.unique(logs.recording[inside]))} of {recordings} recordings",
    )  # fmt: skip
    return [_joined(each, len(chosen), kind) for each in some], [compared, *(off if some else [])]


def _parts(logs: FedRows) -> tuple[NDArray[np.str_], str]:
    """Which part each row (N,) is compared with, and what the parts are called."""
    place, rows = np.unique(logs.recording, return_inverse=True, return_counts=True)[1:]
    is_short = (rows < MIN_ROWS)[place.reshape(-1)]
    tagged = is_short & (logs.robot != "")
    part = np.where(tagged, np.char.add("robot ", logs.robot), logs.recording).astype(object)
    untagged = is_short & ~tagged
    if untagged.any():
        part[untagged] = _by_start(logs.take(untagged))
        return part.astype(np.str_), "groups of recordings"
    kind = "recordings" if not tagged.any() else "robots" if is_short.all() else ""
    return part.astype(np.str_), kind or "recordings and robots"


def _by_start(logs: FedRows) -> NDArray[np.str_]:
    """The group of each row (N,): recordings that started one after the other, in groups of
    `MIN_ROWS` rows at least, as many as let `MOST` groups hold all."""
    names, place, rows = np.unique(logs.recording, return_inverse=True, return_counts=True)
    place = place.reshape(-1)
    start = np.full(len(names), np.iinfo(np.int64).max)
    np.minimum.at(start, place, logs.logged_ns)
    order = np.argsort(start, kind="stable")
    middle = np.cumsum(rows[order]) - rows[order] / 2
    groups = np.clip(len(logs) // (MIN_ROWS + rows.max()), 1, MOST)  # each loses half of two
    begins = np.searchsorted(middle * groups / len(logs), np.arange(groups + 1))
    named = np.empty(len(names), object)
    for first, end in pairwise(begins.tolist()):
        named[order[first:end]] = f"{names[order[first]]} and the next {end - first - 1}"
    return np.asarray(named[place], np.str_)


def _named(answer: Answer, recording: str) -> Answer:
    """With the recording in the names of its comparisons."""
    rows = (replace(row, check=f"{row.check}, {recording}") for row in answer.comparisons)
    return replace(answer, comparisons=tuple(rows))


def _joined(each: Sequence[tuple[str, Finding]], compared: int, kind: str) -> Finding:
    """One finding of those of several parts, in the words of the first."""
    names = ", ".join(name for name, _ in each[:_NAMED])
    more = f" and {len(each) - _NAMED} more" if len(each) > _NAMED else ""
    first = each[0][1]
    return replace(
        first,
        text=f"in {len(each)} of {compared} {kind} ({names}{more}): {first.text}",
        remedy="for their recordings alone (the store's `recordings` view has the files and tags):"
        f" {first.remedy}",
        evidence=tuple(check for _, one in each for check in one.evidence),
    )


__all__ = ["unlike_recordings"]
