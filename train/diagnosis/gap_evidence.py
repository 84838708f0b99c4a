"""What `restock twin gap` found, as rows of evidence beside the others.

A gap that is large says that logs and twin differ, not which of the two is wrong: it names no
fault, and where a fault is named it says how much of the comparison the twin itself can bear.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from restock.errors import RunError
from restock.train.diagnosis.evidence import Comparison, Status, not_run
from restock.train.twin.calibration.twin_gap import (
    DOCUMENT,
    FOLDER,
    TRUSTED,
    UNDECIDED,
    UNTRUSTED,
    read_gap,
)

CHECK = "twin gap"
_STATUS: dict[str, Status] = {TRUSTED: "ok", UNDECIDED: "undecided", UNTRUSTED: "off"}


def gap_evidence(places: Sequence[Path]) -> Iterator[Comparison]:
    """A row for each condition, of the first of `places` (a run, a store) that has a gap in it."""
    what = "where the twin ends when it drives what was logged"
    folder = next((p / FOLDER for p in places if (p / FOLDER / DOCUMENT).is_file()), None)
    if folder is None:
        shown = places[0] / FOLDER if places else f"STORE/{FOLDER}"
        yield not_run(CHECK, what, f"`restock twin gap STORE --out {shown}` measures it")
        return
    try:
        gap = read_gap(folder)
    except RunError as error:
        yield not_run(CHECK, what, f"{error.where}: {error.what}")
        return
    for verdict in gap.verdicts:
        name, reasons = f"{CHECK}: {verdict.condition}", "; ".join(verdict.reasons)
        if verdict.verdict not in _STATUS:
            yield not_run(name, what, reasons)
            continue
        ends = verdict.position_p90
        yield Comparison(
            name, what, "m", _STATUS[verdict.verdict],
            effect=ends.value, low=ends.low, high=ends.high,
            logs_rows=verdict.segments, note=reasons,
        )  # fmt: skip


def untrusted(rows: Sequence[Comparison]) -> list[str]:
    """The conditions in which the twin strays from the logs beyond its limits."""
    start = f"{CHECK}: "
    return [
        row.check.removeprefix(start) for row in rows if row.off and row.check.startswith(start)
    ]


__all__ = ["CHECK", "gap_evidence", "untrusted"]
