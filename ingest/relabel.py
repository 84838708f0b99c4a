"""Relabel: run conditions again over the signals that are stored, without the recordings.

Rows, observations and rewards stay as they were ingested; `condition`, `conditions` and
`labels_version` become new, and so do the manifest's scores. Corrections that people made are laid
over the new labels. All recordings change in one commit.
"""

from __future__ import annotations

import datetime as dt
import uuid
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa

from restock.errors import ConfigError, StoreError, expect
from restock.ingest.profile.profile import Profile
from restock.ingest.profile.profile_text import (
    profile_toml,
    read_profile_toml,
    with_conditions,
)
from restock.ingest.store.corrections import correction_rows, corrections_in, lay_over, rules_of
from restock.ingest.store.episode_rows import episode_ends
from restock.ingest.store.manifest import (
    conditions_json,
    count_rows,
    driven_plan,
    score_rows,
    uncertain_conditions,
)
from restock.ingest.store.transitions import by_name, names_of, replaced
from restock.ingest.store.version import Version
from restock.ingest.store.writer import StoreWriter
from restock.ingest.task.conditions import (
    NOMINAL,
    Condition,
    label_with_probabilities,
    labels_version,
    of_kind,
    primary,
    reported,
    runnable,
    too_near_to_call,
    unknown_rows,
)
from restock.ingest.task.label_scores import LabelScore, label_scores
from restock.ingest.task.schema import recording_schema
from restock.ingest.task.task import Task

TWIN = "twin"  # format of the recordings that training makes of its episodes


@dataclass(frozen=True)
class Relabelled:
    """What became of one recording's labels."""

    recording_id: str
    source_file: str
    before: str  # labels version
    after: str
    changed: int = 0  # rows whose one condition is another now
    named: dict[str, int] = field(default_factory=dict)  # rows per condition, after
    named_before: dict[str, int] = field(default_factory=dict)
    scores: list[LabelScore] = field(default_factory=list)


def relabel_store(
    store: StoreWriter,
    conditions_of: Callable[[str], Sequence[Condition]],
    *,
    dry_run: bool = False,
    version: Version | None = None,
) -> tuple[list[Relabelled], int | None]:
    """Label every recording again whose conditions have changed.

    A `version` of the store is labelled in a dry run alone: what was is not written over.

    `conditions_of` gives the definitions, of both kinds, for the profile (by name) that read a
    recording. Returns what became of each, and the version of `transitions` (None where nothing
    was written).

    Raises:
        StoreError: rows were written before their episodes' ends were kept, or changed meanwhile.
        ConfigError: a condition's SQL does not run over the signals that are stored.
    """
    expect("store", store, StoreWriter, 'make it as StoreWriter("store")')
    if version is not None and not dry_run:
        raise StoreError(
            "an earlier version cannot be labelled",
            where=str(store.path),
            remedy="give --dry-run to see what would change, or leave out --version",
        )
    outcomes: list[Relabelled] = []
    stale: list[dict[str, Any]] = []
    for row in store.live(version=version).to_pylist():
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

    if dry_run or not stale:
        for _ in relabelled():
            pass
        return outcomes, None
    read = {row["recording_id"]: row["ingest_id"] for row in stale}
    return outcomes, store.write_all(relabelled(), instead_of=read)


def relabel_rows(
    store: StoreWriter, row: dict[str, Any], definitions: Sequence[Condition]
) -> tuple[pa.Table, pa.Table, Relabelled]:
    """One recording's manifest (of which `row` is the old one) and rows with new labels.

    `definitions` are conditions of both kinds.

    Raises:
        StoreError: its rows were written before their episodes' ends were kept.
        ConfigError: a condition's SQL does not run over the signals that are stored.
    """
    rows = store.rows(row["recording_id"], row["ingest_id"])
    ends = episode_ends(rows)
    if ends is None:
        raise StoreError(
            f"the rows of {row['source_file']} lack the ends of their episodes",
            where=str(store.path),
            remedy="ingest the recording again",
        )
    stored = rows.select(ends.column_names)  # the signals, and the profile's own
    every_condition, every_exposure = (of_kind(definitions, k) for k in ("outcome", "exposure"))
    task = msgspec.json.decode(row["task_json"], type=Task, strict=False)
    conditions, situations_told = (
        reported(several, lidar=task.lidar, driven_plan=driven_plan(rows))
        for several in (every_condition, every_exposure)
    )
    if row["format"] == TWIN:  # which fills none of the profile's own signals
        conditions = runnable(stored, conditions)
    # An older store has not all signals that exposures are told by: then they stay unknown.
    exposures = runnable(stored, situations_told)
    steps = pa.concat_tables([stored, ends.cast(stored.schema)])
    begin = np.arange(len(rows))
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
    named = primary(labels, conditions) or [NOMINAL] * len(rows)
    before = rows["condition"].to_pylist()
    ingest_id = uuid.uuid4().hex[:16]
    new = {
        "condition": named,
        "conditions": names_of(labels, begin),
        "probabilities": by_name(probable, begin),
        "uncertain": names_of(too_near_to_call(probable, conditions), begin),
        "exposures": names_of(situations, begin)
        if exposures or not situations_told
        else pa.nulls(len(rows), pa.list_(pa.string())),
        "labels_version": labels_version(definitions),
        "ingest_id": ingest_id,
    }
    rows = replaced(rows, new)
    corrections = corrections_in(row)
    rows, corrections = lay_over(rows, corrections, every_condition, row["clock_offset_ns"])
    named = rows["condition"].to_pylist()
    scores = label_scores(rows, labels, task.control_period_s)
    profile = _with_conditions(row["profile_toml"], definitions)
    manifest = row | {
        "ingest_id": ingest_id,
        "ingested_at": dt.datetime.now(dt.UTC),
        "labels_version": rows["labels_version"][0].as_py(),
        "label_scores": score_rows(scores),
        "label_counts": count_rows(scores),
        "unknown_conditions": unknown_rows(
            definitions, lidar=task.lidar, driven_plan=driven_plan(rows)
        ),
        "corrections": correction_rows(corrections),
        "conditions_json": conditions_json(every_condition),
        "exposures_json": conditions_json(every_exposure),
        "profile_toml": None if profile is None else profile_toml(profile),
        "uncertain_conditions": None if profile is None else uncertain_conditions(profile),
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


def _with_conditions(text: str | None, conditions: Sequence[Condition]) -> Profile | None:
    """The profile of a manifest's text with the conditions that label its rows now; None where it
    has none, or one that only a newer Restock can read."""
    try:
        profile = read_profile_toml(text or "", where="the manifest's profile")
    except ConfigError:
        return None
    return with_conditions(profile, conditions)


def open_for_relabel(path: Path | str) -> StoreWriter:
    """The store at `path`, which must be there.

    Raises:
        StoreError: there is none.
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
