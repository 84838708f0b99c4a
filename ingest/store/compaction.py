"""Compaction: many small files of a store's tables become a few large ones.

Rows, ingests and manifests stay as they are; only which file holds them changes, so versions from
before can be read for as long as their files are kept. Other writers may go on meanwhile: what they
replaced in the files of a step undoes that step alone, which the next compaction does again. Its
commits say that data changed, though no row did: else Delta takes a writer that removes one of the
same files for no conflict, and a replaced recording's rows would be there twice.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

import pyarrow as pa

from restock.errors import StoreError
from restock.ingest.store.commits import (
    ATTEMPTS,
    delta_columns,
    merge,
    parquet_options,
    recording_columns,
    written_whole,
)
from restock.ingest.store.lineage import Ingest, StoredFile, changed_by_others, own_path
from restock.ingest.store.location import RECORDINGS, TRANSITIONS
from restock.ingest.store.summary import summarised
from restock.ingest.store.writer import StoreWriter
from restock.ingest.task.schema import recording_schema

FILE_ROWS = 500_000  # of transitions: what replacing one of its recordings writes again, at most
MIN_FILES = 2
FOLD_FILES = 50  # manifests of a file each, which cost each opening 5 ms; joining one costs 20 ms
FULL_MANIFESTS = 2_000  # a file of so many is left alone: else each fold would write all of them
OPERATION = "restock store compact"


@dataclass
class Compacted:
    """What a compaction did, or would do."""

    rows: int = 0  # of transitions that were written again
    files_before: int = 0  # of transitions
    files_after: int = 0  # of those: what other writers added meanwhile is not counted
    manifests_before: int = 0  # files of manifests
    manifests_after: int = 0
    summaries: int = 0  # of recordings whose rows another tool changed
    changed_meanwhile: int = 0  # files that another writer replaced before they were done
    version: int | None = None  # of the store's transitions, where they were written


def compact(store: StoreWriter, *, dry_run: bool = False) -> Compacted:
    """Make few files of many: of the manifests, and of the transitions.

    Raises:
        StoreError: there is no store, or it cannot be written.
    """
    store.expect_store()
    done = Compacted()
    groups = list(_groups(store))
    files = store.files(TRANSITIONS)
    done.files_before = done.files_after = len(files)
    changed = _changed(store, files)
    if dry_run:
        done.rows = sum(file.rows for group in groups for file in group)
        done.files_after -= sum(len(group) - 1 for group in groups)
        if store.path.has_table(RECORDINGS):
            _Fold.of(store, changed).count(done)
        return done
    if changed:  # first: once their files are Restock's own, the summaries are taken for true
        fold(store, done, changed)
    for group in groups:  # else first: where one is damaged, the manifests stay as they are
        _merge_rows(store, group, done)
    if not changed:
        fold(store, done)
    return done


def fold(store: StoreWriter, done: Compacted | None = None, changed: Collection[str] = ()) -> None:
    """Make one file of the manifests of all recordings.

    Ingests whose rows another tool `changed` get new summaries.

    Manifests whose rows are not there yet, those of replaced rows, and files that have many already
    stay as they are.
    """
    done = done or Compacted()
    made: dict[str, pa.Table] = {}  # manifests with new summaries, by ingest
    if not store.path.has_table(RECORDINGS):
        return
    store.create(RECORDINGS, recording_columns())
    for _ in range(ATTEMPTS):
        plan = _Fold.of(store, changed)
        if not plan.worth_it:
            break
        _summarise(store, [one for one in plan.lacking if one.ingest_id not in made], made)
        _keep_replaced(store, plan)
        schema = delta_columns(recording_columns())
        plain = [one for one in plan.live if one.ingest_id not in made]
        live = {one.ingest_id for one in plan.live}
        extra = [manifest for ingest_id, manifest in made.items() if ingest_id in live]
        one = merge(
            store.path, RECORDINGS, plan.chosen, plain, schema, extra=extra, summarised=True
        )
        paths = {file.path for file in plan.chosen}
        if store.replace_files(RECORDINGS, paths, [one], OPERATION) is not None:
            break
    else:
        raise StoreError(
            f"other writers were faster {ATTEMPTS} times",
            where=str(store.path),
            remedy="try again when they are done; the manifests are unchanged",
        )
    plan.count(done)


def fold_if_many(store: StoreWriter) -> None:
    """Fold the manifests where so many files are read at every opening that it pays."""
    if not store.path.has_table(TRANSITIONS):
        return
    if sum(file.own for file in store.files(RECORDINGS)) >= FOLD_FILES:
        with suppress(StoreError):  # the ingest before it is done; queries say what is damaged
            fold(store)


@dataclass
class _Fold:
    """What a fold does: the files that it makes one of, and the ingests in that."""

    files: int
    chosen: list[StoredFile]
    live: list[Ingest]
    lacking: list[Ingest]  # of these, those whose summary is of other rows

    @classmethod
    def of(cls, store: StoreWriter, changed: Collection[str]) -> _Fold:
        shown = {one.ingest_id for one in store.shown()}
        files = store.files(RECORDINGS)
        chosen = []
        for file in files:
            held = shown.intersection(one.ingest_id for one in file.ingests)
            full = len(held) >= FULL_MANIFESTS and held.isdisjoint(changed)
            if not full and (held or not file.own):
                chosen.append(file)
        live = [one for file in chosen for one in file.ingests if one.ingest_id in shown]
        lacking = [one for one in live if one.ingest_id in changed]
        return cls(len(files), chosen, live, lacking)

    @property
    def worth_it(self) -> bool:
        return bool(self.lacking) or len(self.chosen) >= MIN_FILES

    def count(self, done: Compacted) -> None:
        """Say what becomes of the files."""
        done.manifests_before = done.manifests_after = self.files
        if self.worth_it:
            done.manifests_after -= len(self.chosen) - 1
            done.summaries = len(self.lacking)


def _summarise(store: StoreWriter, lacking: Sequence[Ingest], made: dict[str, pa.Table]) -> None:
    """Add the manifests of these ingests with a summary of their rows."""
    manifests = store.manifests(lacking, recording_schema())
    for one in lacking:
        with suppress(FileNotFoundError):  # replaced meanwhile
            rows = store.rows(one.recording_id, one.ingest_id)
            made[one.ingest_id] = summarised(_of(manifests, one), rows)


def _of(manifests: pa.Table, one: Ingest) -> pa.Table:
    import pyarrow.compute as pc  # slow to import

    return manifests.filter(pc.equal(manifests["ingest_id"], one.ingest_id))


def _keep_replaced(store: StoreWriter, plan: _Fold) -> None:
    """Write manifests of replaced rows in compacted files as files of their own.

    Older versions need them: they are found by their names until cleaning removes them.
    """
    live = {one.ingest_id for one in plan.live}
    held = [one for file in plan.chosen for one in file.ingests]
    gone = [one for one in held if one.ingest_id not in live]
    manifests = store.manifests(gone, recording_columns())
    for one in gone:
        path = f"{RECORDINGS}/{own_path(one.recording_id, one.ingest_id)}"
        with written_whole(store.path, path):
            kept = _of(manifests, one)
            store.path.write(kept, path, **parquet_options(kept.schema))


def _changed(store: StoreWriter, files: Sequence[StoredFile]) -> set[str]:
    """Return the ingests of these files whose rows are not those that their manifests describe."""
    names = pa.schema([("ingest_id", pa.string()), ("transitions", pa.int64())])
    reported = store.manifests([one for file in files for one in file.ingests], names)
    written = dict(zip(*(reported[name].to_pylist() for name in names.names), strict=True))
    return set(changed_by_others(files, written))


def _groups(store: StoreWriter) -> Iterator[list[StoredFile]]:
    """Group files of transitions to join, robot by robot in the order of their time.

    One that another tool wrote may be alone.
    """
    files = store.files(TRANSITIONS)
    small = [file for file in files if file.rows < FILE_ROWS / 2 or not file.listed]
    names = ("ingest_id", "tags", "start_stamp_ns")
    schema = pa.schema([field for field in recording_schema() if field.name in names])
    reported = store.manifests([one for file in small for one in file.ingests], schema)
    driven = {
        row["ingest_id"]: (dict(row["tags"] or {}).get("robot", ""), row["start_stamp_ns"] or 0)
        for row in reported.to_pylist()
    }
    group: list[StoredFile] = []
    for file in sorted(
        small,
        key=lambda f: min((driven.get(i.ingest_id, ("", 0)) for i in f.ingests), default=("", 0)),
    ):
        if group and sum(one.rows for one in group) + file.rows > FILE_ROWS:
            if _worth_it(group):
                yield group
            group = []
        group.append(file)
    if _worth_it(group):
        yield group


def _worth_it(group: Sequence[StoredFile]) -> bool:
    return len(group) >= MIN_FILES or any(not file.listed for file in group)


def _merge_rows(store: StoreWriter, group: Sequence[StoredFile], done: Compacted) -> None:
    """One file of these, in a commit of its own; none where one of them is gone by then."""
    held: dict[str, Ingest] = {}  # another tool may have cut the rows of one into several files
    for one in (one for file in group for one in file.ingests):
        before = held.get(one.ingest_id)
        held[one.ingest_id] = one._replace(rows=one.rows + (before.rows if before else 0))
    schema = pa.schema(store.path.open_table(TRANSITIONS).schema().to_arrow())
    made = merge(store.path, TRANSITIONS, group, list(held.values()), schema, summarised=True)
    paths = {file.path for file in group}
    version = store.replace_files(TRANSITIONS, paths, [made], OPERATION)
    if version is None:
        done.changed_meanwhile += len(group)
        return
    done.rows += made.rows
    done.files_after -= len(group) - 1
    done.version = version
