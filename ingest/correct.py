"""Correct: take what people said of labels into a store, in one commit.

Neither the recordings nor the rules are needed: what is said is laid over the labels that are
there. `restock.ingest.relabel` and an ingest lay it over theirs again.
"""

from __future__ import annotations

import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa

from restock.errors import StoreError
from restock.ingest.relabel import relabel_rows
from restock.ingest.store.corrections import (
    COLUMN,
    Correction,
    Moments,
    correction_rows,
    corrections_in,
    lay_over,
    merged,
)
from restock.ingest.store.manifest import count_rows, score_rows
from restock.ingest.store.transitions import replaced
from restock.ingest.store.writer import StoreWriter
from restock.ingest.task.conditions import Condition, Kind, held, stored
from restock.ingest.task.label_scores import label_scores
from restock.ingest.task.schema import recording_schema
from restock.ingest.task.task import Task


@dataclass(frozen=True)
class RecordingCorrections:
    """What is said of one recording's labels."""

    ingest_id: str  # of the rows that it was said of
    corrections: list[Correction]


@dataclass(frozen=True)
class Changed:
    """What corrections did to one condition's rows."""

    added: int = 0  # the label is there now
    removed: int = 0
    confirmed: int = 0  # were said to be as they are


@dataclass(frozen=True)
class Corrected:
    """What became of one recording."""

    recording_id: str
    source_file: str
    before: str  # labels version
    after: str
    changed: dict[str, Changed] = field(default_factory=dict)  # by condition


def correct_store(
    store: StoreWriter, given: Mapping[str, RecordingCorrections], *, dry_run: bool = False
) -> tuple[list[Corrected], int | None]:
    """Lay corrections over the labels of these recordings (by their ids), all in one commit.

    Returns what became of each, and the version of `transitions` (None: nothing was written).

    Raises:
        StoreError: a recording is not in the store, or was ingested again meanwhile.
    """
    live = {row["recording_id"]: row for row in store.live().to_pylist()}
    for recording, what in given.items():
        if live.get(recording, {}).get("ingest_id") != what.ingest_id:
            raise StoreError(
                f"recording {recording} was ingested again or removed in the meantime",
                where=str(store.path),
                remedy="list its events again with `restock store label STORE --review N`",
            )
    outcomes: list[Corrected] = []

    def corrected() -> Iterator[tuple[pa.Table, pa.Table]]:
        for recording, what in given.items():
            manifest, rows, outcome = _one(store, live[recording], what.corrections)
            outcomes.append(outcome)
            if outcome.after != outcome.before:
                yield manifest, rows

    read = {recording: what.ingest_id for recording, what in given.items()}
    return outcomes, _write(store, corrected(), read, dry_run)


def remove_corrections(
    store: StoreWriter, *, dry_run: bool = False
) -> tuple[list[Corrected], int | None]:
    """Take all corrections out of a store: its rules' own labels are there again.

    Raises:
        StoreError: rows were written before their episodes' ends were kept.
    """
    outcomes: list[Corrected] = []
    live = [row for row in store.live().to_pylist() if row[COLUMN]]

    def plain() -> Iterator[tuple[pa.Table, pa.Table]]:
        for row in live:
            conditions = stored_conditions(row)
            before = store.rows(row["recording_id"], row["ingest_id"])
            manifest, rows, _ = relabel_rows(
                store, row | {COLUMN: []}, [*conditions, *stored_conditions(row, "exposure")]
            )
            outcomes.append(_outcome(row, before, rows, corrections_in(row), conditions))
            yield manifest, rows

    replaced_ingests = {row["recording_id"]: row["ingest_id"] for row in live}
    return outcomes, _write(store, plain(), replaced_ingests, dry_run)


def stored_conditions(manifest: Mapping[str, Any], kind: Kind = "outcome") -> list[Condition]:
    """The conditions of a kind that labelled a recording, as its manifest keeps them.

    Raises:
        StoreError: a newer Restock wrote them.
    """
    try:
        return stored(manifest, kind)
    except msgspec.MsgspecError as error:
        raise StoreError(
            f"the conditions in its manifest cannot be read: {error}",
            where=str(manifest["source_file"]),
            remedy="they were written by a newer Restock: use that version",
        ) from error


def _one(
    store: StoreWriter, row: dict[str, Any], given: Sequence[Correction]
) -> tuple[pa.Table, pa.Table, Corrected]:
    """One recording's manifest and rows, corrected."""
    before = store.rows(row["recording_id"], row["ingest_id"])
    conditions, offset_ns = stored_conditions(row), row["clock_offset_ns"]
    every = merged(corrections_in(row), given, Moments.of(before, offset_ns))
    rows, every = lay_over(before, every, conditions, offset_ns)
    ingest_id = uuid.uuid4().hex[:16]
    rows = replaced(rows, {"ingest_id": ingest_id})
    task = msgspec.json.decode(row["task_json"], type=Task, strict=False)
    names = [condition.name for condition in conditions]
    scores = label_scores(rows, names, task.control_period_s)
    # Not ingested now: which recording is the newest decides which rules are the store's.
    manifest = row | {
        "ingest_id": ingest_id,
        "labels_version": rows["labels_version"][0].as_py(),
        "label_scores": score_rows(scores),
        "label_counts": count_rows(scores),
        COLUMN: correction_rows(every),
    }
    outcome = _outcome(row, before, rows, given, conditions)
    return pa.Table.from_pylist([manifest], recording_schema()), rows, outcome


def _outcome(
    row: Mapping[str, Any],
    before: pa.Table,
    after: pa.Table,
    given: Sequence[Correction],
    conditions: Sequence[Condition],
) -> Corrected:
    """What changed, and what was confirmed, of the conditions that are spoken of."""
    names = [c.name for c in conditions]
    was, now = held(before["conditions"], names), held(after["conditions"], names)
    moments = Moments.of(before, row["clock_offset_ns"])
    changed = {}
    for name in dict.fromkeys(c.condition for c in given if c.condition in names):
        said = np.zeros(len(before), np.bool_)
        for correction in given:
            if correction.condition == name:
                said |= moments.covered(correction)
        changed[name] = Changed(
            int((now[name] & ~was[name]).sum()),
            int((was[name] & ~now[name]).sum()),
            int((said & (was[name] == now[name])).sum()),
        )
    return Corrected(
        row["recording_id"],
        row["source_file"],
        row["labels_version"],
        after["labels_version"][0].as_py(),
        changed,
    )


def _write(
    store: StoreWriter,
    recordings: Iterator[tuple[pa.Table, pa.Table]],
    instead_of: Mapping[str, str],
    dry_run: bool,
) -> int | None:
    """One commit, unless there is nothing to write, or it is not to be written."""
    first = next(recordings, None)
    if first is None:
        return None
    if dry_run:
        for _ in recordings:
            pass
        return None
    return store.write_all(chain([first], recordings), instead_of=instead_of)
