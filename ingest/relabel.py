"""Relabelling: evaluates conditions again on the stored signals, without reading the recordings.

Rows, observations and rewards stay as ingested. `condition`, `conditions`, `labels_version` and the
manifest's scores are replaced. People's corrections override the new labels (`correct_store` puts
corrections into the store). All recordings change in one commit.
"""

from __future__ import annotations

import datetime as dt
import uuid
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa

from restock.errors import ConfigError, StoreError
from restock.ingest.profile.profile import parse_profile, profile_toml, with_conditions
from restock.ingest.store.manifest import (
    COLUMN,
    Correction,
    LabelScore,
    Moments,
    conditions_json,
    correct_labels,
    corrections_in,
    driven_plan,
    label_scores,
    merged,
    rules_of,
    score_columns,
    uncertain_conditions,
)
from restock.ingest.store.transitions import episode_ends, label_columns, replaced
from restock.ingest.store.writer import StoreWriter
from restock.ingest.task.conditions import (
    Condition,
    held,
    label_with_probabilities,
    labels_version,
    of_kind,
    reported,
    stored,
    unknown_rows,
)
from restock.ingest.task.schema import recording_schema
from restock.ingest.task.task import Task


@dataclass(frozen=True)
class Relabelled:
    """The outcome of relabelling one recording."""

    recording_id: str
    source_file: str
    before: str  # labels version
    after: str
    changed: int = 0  # rows with another `condition` than before
    named: dict[str, int] = field(default_factory=dict)  # condition -> rows that have it now
    named_before: dict[str, int] = field(default_factory=dict)
    scores: list[LabelScore] = field(default_factory=list)


def relabel_store(
    store: StoreWriter,
    conditions_of: Callable[[str], Sequence[Condition]],
    *,
    dry_run: bool = False,
) -> tuple[list[Relabelled], int | None]:
    """Label every recording again whose conditions have changed.

    `conditions_of` returns the definitions of outcomes and exposures for a profile, by its name.
    Returns the outcome of each recording, and the version of `transitions` (None if nothing was
    written).

    Raises:
        StoreError: another process changed the rows meanwhile.
        ConfigError: a condition's SQL fails on the stored signals.
    """
    outcomes: list[Relabelled] = []
    stale: list[dict[str, Any]] = []
    for row in store.live().to_pylist():
        rules = labels_version(conditions_of(row["profile"]))
        if rules_of(row["labels_version"]) == rules:
            same = (row["labels_version"], row["labels_version"])
            outcomes.append(Relabelled(row["recording_id"], row["source_file"], *same))
        else:
            stale.append(row)

    def relabelled() -> Iterator[tuple[pa.Table, pa.Table]]:
        for row in stale:
            manifest, rows, outcome = relabel_rows(store, row, conditions_of(row["profile"]))
            outcomes.append(outcome)
            yield manifest, rows

    read = {row["recording_id"]: row["ingest_id"] for row in stale}
    return outcomes, _write(store, relabelled(), read, dry_run)


def relabel_rows(
    store: StoreWriter, row: dict[str, Any], definitions: Sequence[Condition]
) -> tuple[pa.Table, pa.Table, Relabelled]:
    """Return the manifest and rows of a recording with new labels; `row` is the old manifest.

    `definitions` are the outcomes and exposures.

    Raises:
        StoreError: its rows lack the ends of their episodes: another tool wrote them.
        ConfigError: a condition's SQL fails on the stored signals.
    """
    rows = store.rows(row["recording_id"], row["ingest_id"])
    ends = episode_ends(rows)
    if ends is None:
        raise StoreError(
            f"the rows of {row['source_file']} lack the ends of their episodes",
            where=str(store.path),
            remedy="ingest the recording again",
        )
    signals = rows.select(ends.column_names)  # including the profile's own
    every_condition, every_exposure = (of_kind(definitions, k) for k in ("outcome", "exposure"))
    task = msgspec.json.decode(row["task_json"], type=Task, strict=False)
    conditions, exposures = (
        reported(several, lidar=task.lidar, driven_plan=driven_plan(rows))
        for several in (every_condition, every_exposure)
    )
    steps = pa.concat_tables([signals, ends.cast(signals.schema)])
    try:
        every, probable = label_with_probabilities(steps, [*conditions, *exposures])
    except ConfigError as error:
        raise ConfigError(
            f"{error.where}: {error.what}",
            where=f"the rows of {row['source_file']}",
            remedy=f"they hold {', '.join(ends.column_names)}; for signals that are new in the"
            " profile ingest the recordings again",
        ) from error
    labels, situations = (
        {one.name: every[one.name][: len(rows)] for one in several}
        for several in (conditions, exposures)
    )
    before = rows["condition"].to_pylist()
    ingest_id = uuid.uuid4().hex[:16]
    new = {
        **label_columns(labels, situations, probable, conditions, np.arange(len(rows))),
        "labels_version": labels_version(definitions),
        "ingest_id": ingest_id,
    }
    rows = replaced(rows, new)
    corrections = corrections_in(row)
    rows, corrections = correct_labels(rows, corrections, every_condition, row["clock_offset_ns"])
    named = rows["condition"].to_pylist()
    scores = label_scores(rows, labels, task.control_period_s)
    profile = parse_profile(row["profile_toml"], where="the manifest's profile")
    profile = with_conditions(profile, definitions)
    manifest = row | {
        "ingest_id": ingest_id,
        "ingested_at": dt.datetime.now(dt.UTC),
        "labels_version": rows["labels_version"][0].as_py(),
        **score_columns(scores),
        "unknown_conditions": unknown_rows(
            definitions, lidar=task.lidar, driven_plan=driven_plan(rows)
        ),
        "corrections": [asdict(one) for one in corrections],
        "conditions_json": conditions_json(every_condition),
        "exposures_json": conditions_json(every_exposure),
        "profile_toml": profile_toml(profile),
        "uncertain_conditions": uncertain_conditions(profile),
    }
    outcome = Relabelled(
        row["recording_id"],
        row["source_file"],
        row["labels_version"],
        manifest["labels_version"],
        sum(a != b for a, b in zip(before, named, strict=True)),
        dict(sorted(Counter(named).items())),
        dict(sorted(Counter(before).items())),
        scores,
    )
    return pa.Table.from_pylist([manifest], recording_schema()), rows, outcome


def open_for_relabel(path: Path | str) -> StoreWriter:
    """Open the store at `path`, which must exist.

    Raises:
        StoreError: there is no store, or it is empty.
    """
    store = StoreWriter(path)
    store.reach()
    if not len(store.live()):
        raise StoreError(
            "there is no store, or it is empty",
            where=str(path),
            remedy=store.path.remedy_if_absent(),
        )
    return store


@dataclass(frozen=True)
class RecordingCorrections:
    """People's corrections of one recording's labels."""

    ingest_id: str  # the ingest whose rows people judged
    corrections: list[Correction]


@dataclass(frozen=True)
class Changed:
    """The effect of corrections on one condition, as numbers of rows."""

    added: int = 0  # got the label
    removed: int = 0
    confirmed: int = 0  # judged, and unchanged


@dataclass(frozen=True)
class Corrected:
    """The outcome of correcting one recording."""

    recording_id: str
    source_file: str
    before: str  # labels version
    after: str
    changed: dict[str, Changed] = field(default_factory=dict)  # by condition


def correct_store(
    store: StoreWriter, given: Mapping[str, RecordingCorrections], *, dry_run: bool = False
) -> tuple[list[Corrected], int | None]:
    """Apply corrections to the labels of recordings, by recording id, all in one commit.

    Returns the outcome of each, and the version of `transitions` (None if nothing was written).

    Raises:
        StoreError: a recording is not in the store, or was ingested again meanwhile.
    """
    live = {row["recording_id"]: row for row in store.live().to_pylist()}
    for recording, what in given.items():
        if live.get(recording, {}).get("ingest_id") != what.ingest_id:
            raise StoreError(
                f"recording {recording} was ingested again or removed in the meantime",
                where=str(store.path),
                remedy="list its events again with `restock review STORE`",
            )
    outcomes: list[Corrected] = []

    def corrected() -> Iterator[tuple[pa.Table, pa.Table]]:
        for recording, what in given.items():
            manifest, rows, outcome = _correct_recording(store, live[recording], what.corrections)
            outcomes.append(outcome)
            if outcome.after != outcome.before:
                yield manifest, rows

    read = {recording: what.ingest_id for recording, what in given.items()}
    return outcomes, _write(store, corrected(), read, dry_run)


def remove_corrections(
    store: StoreWriter, *, dry_run: bool = False
) -> tuple[list[Corrected], int | None]:
    """Remove all corrections from a store, which restores the labels that the rules give."""
    outcomes: list[Corrected] = []
    live = [row for row in store.live().to_pylist() if row[COLUMN]]

    def plain() -> Iterator[tuple[pa.Table, pa.Table]]:
        for row in live:
            conditions = stored(row)
            before = store.rows(row["recording_id"], row["ingest_id"])
            manifest, rows, _ = relabel_rows(
                store, row | {COLUMN: []}, [*conditions, *stored(row, "exposure")]
            )
            outcomes.append(_build_outcome(row, before, rows, corrections_in(row), conditions))
            yield manifest, rows

    replaced_ingests = {row["recording_id"]: row["ingest_id"] for row in live}
    return outcomes, _write(store, plain(), replaced_ingests, dry_run)


def _correct_recording(
    store: StoreWriter, row: dict[str, Any], given: Sequence[Correction]
) -> tuple[pa.Table, pa.Table, Corrected]:
    """Return the corrected manifest and rows of one recording."""
    before = store.rows(row["recording_id"], row["ingest_id"])
    conditions, offset_ns = stored(row), row["clock_offset_ns"]
    every = merged(corrections_in(row), given, Moments.of(before, offset_ns))
    rows, every = correct_labels(before, every, conditions, offset_ns)
    ingest_id = uuid.uuid4().hex[:16]
    rows = replaced(rows, {"ingest_id": ingest_id})
    task = msgspec.json.decode(row["task_json"], type=Task, strict=False)
    names = [condition.name for condition in conditions]
    scores = label_scores(rows, names, task.control_period_s)
    # Keep `ingested_at`: the recording with the newest time decides which rules the store has.
    manifest = row | {
        "ingest_id": ingest_id,
        "labels_version": rows["labels_version"][0].as_py(),
        **score_columns(scores),
        COLUMN: [asdict(one) for one in every],
    }
    outcome = _build_outcome(row, before, rows, given, conditions)
    return pa.Table.from_pylist([manifest], recording_schema()), rows, outcome


def _build_outcome(
    row: Mapping[str, Any],
    before: pa.Table,
    after: pa.Table,
    given: Sequence[Correction],
    conditions: Sequence[Condition],
) -> Corrected:
    """Count the added, removed and confirmed rows of each corrected condition."""
    names = [c.name for c in conditions]
    was, now = held(before["conditions"], names), held(after["conditions"], names)
    moments = Moments.of(before, row["clock_offset_ns"])
    changed = {}
    for name in dict.fromkeys(c.condition for c in given if c.condition in names):
        judged = np.zeros(len(before), np.bool_)
        for correction in given:
            if correction.condition == name:
                judged |= moments.covered(correction)
        changed[name] = Changed(
            int((now[name] & ~was[name]).sum()),
            int((was[name] & ~now[name]).sum()),
            int((judged & (was[name] == now[name])).sum()),
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
    """Write all recordings in one commit; None for a dry run, or without recordings."""
    first = next(recordings, None)
    if first is None:
        return None
    if dry_run:
        for _ in recordings:
            pass
        return None
    return store.write_all(chain([first], recordings), instead_of=instead_of)
