"""Compaction: many small files of a store's tables become a few large ones.

Rows, ingests and manifests stay as they are; only which file holds them changes, so versions from
before can be read for as long as their files are kept. Other writers may go on meanwhile: what they
replaced in the files of a step undoes that step alone, which the next compaction does again. Its
commits say that data changed, though no row did: else Delta takes a writer that removes one of the
same files for no conflict, and a replaced recording's rows would be there twice.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

import pyarrow as pa
from deltalake.transaction import AddAction, RemoveAction

from restock.errors import StoreError
from restock.ingest.store.commits import delta_columns, recording_columns
from restock.ingest.store.data_files import AddedFile, add_action, merge
from restock.ingest.store.lineage import Ingest, StoredFile, own_path
from restock.ingest.store.location import RECORDINGS, TRANSITIONS
from restock.ingest.store.summary import VERSION, summarised
from restock.ingest.store.writer import StoreWriter
from restock.ingest.task.schema import recording_schema

FILE_ROWS = 500_000  # of transitions: what replacing one of its recordings writes again, at most
LEAST_FILES = 2
FOLD_FILES = 200  # manifests of a file each that are worth it, at the end of an ingest
OPERATION = "restock compact"


@dataclass
class Compacted:
    """What a compaction did, or would do."""

    rows: int = 0  # of transitions that were written again
    files_before: int = 0  # of transitions
    files_after: int = 0
    manifests_before: int = 0  # files of manifests
    manifests_after: int = 0
    summaries: int = 0  # of recordings that had none, or an older Restock's
    changed_meanwhile: int = 0  # files that another writer replaced before they were done
    version: int | None = None  # of the store's transitions, where they were written


def compact(store: StoreWriter, *, dry_run: bool = False) -> Compacted:
    """Make few files of many: of the manifests, and of the transitions.

    Raises:
        StoreError: there is no store, or it cannot be written.
    """
    if not store.path.has_table(TRANSITIONS):
        raise StoreError(
            "no such store", where=str(store.path), remedy="`restock ingest` makes one"
        )
    done = Compacted()
    plan = list(_groups(store))
    done.files_before = len(store.files(TRANSITIONS))
    done.files_after = done.files_before - sum(len(group) - 1 for group in plan)
    if dry_run:
        done.rows = sum(file.rows for group in plan for file in group)
        done.manifests_before = done.manifests_after = len(store.files(RECORDINGS))
        return done
    fold(store, done)
    for group in plan:
        _merge_rows(store, group, done)
    done.files_after = len(store.files(TRANSITIONS))
    return done


def fold(store: StoreWriter, done: Compacted | None = None) -> None:
    """Make one file of the manifests of all recordings, with summaries of those that lack them.

    Manifests whose rows are not there yet, and those of replaced rows, stay as they are.
    """
    done = done or Compacted()
    made: dict[str, pa.Table] = {}  # manifests with new summaries, by ingest
    written: list[AddedFile] = []

    def commit() -> None:
        shown = {one.ingest_id: one for one in store.shown()}
        table = store.path.open_table(RECORDINGS)
        files = store.files(RECORDINGS)
        done.manifests_before = done.manifests_after = len(files)
        chosen = [f for f in files if not f.own or f.ingests[0].ingest_id in shown]
        live = [one for file in chosen for one in file.ingests if one.ingest_id in shown]
        _summarise(store, live, made)
        if not made and len(chosen) < LEAST_FILES:
            return
        _keep_replaced(store, chosen, shown.keys())
        plain = [one for one in live if one.ingest_id not in made]
        schema = delta_columns(recording_columns())
        one = merge(store.path, RECORDINGS, chosen, plain, schema, extra=list(made.values()))
        written.append(one)
        now_ms = time.time_ns() // 1_000_000
        actions: list[AddAction | RemoveAction] = [
            RemoveAction(file.path, True, now_ms) for file in chosen
        ]
        actions.append(add_action(one, now_ms))
        store.transact(table, actions, [], OPERATION)
        done.manifests_after = len(files) - len(chosen) + 1
        done.summaries = len(made)

    if store.path.has_table(RECORDINGS):
        store.create(RECORDINGS, recording_columns())
        store.again_on_conflict(commit)
        _discard(store, RECORDINGS, written[:-1])


def fold_if_many(store: StoreWriter) -> None:
    """Fold the manifests where so many files are read at every opening that it pays."""
    if not store.path.has_table(TRANSITIONS):
        return
    if sum(file.own for file in store.files(RECORDINGS)) >= FOLD_FILES:
        fold(store)


def _summarise(store: StoreWriter, live: Sequence[Ingest], made: dict[str, pa.Table]) -> None:
    """The manifests of the ingests that have no summary of this version, with one."""
    names = pa.schema([("ingest_id", pa.string()), ("summary_version", pa.int32())])
    told = store.manifests(live, names).to_pylist()
    current = {one["ingest_id"] for one in told if one["summary_version"] == VERSION}
    lacking = [one for one in live if one.ingest_id not in current | made.keys()]
    manifests = store.manifests(lacking, recording_schema())
    for one in lacking:
        with suppress(FileNotFoundError):  # replaced meanwhile
            rows = store.rows(one.recording_id, one.ingest_id)
            made[one.ingest_id] = summarised(_of(manifests, one), rows)


def _of(manifests: pa.Table, one: Ingest) -> pa.Table:
    import pyarrow.compute as pc  # slow to import

    return manifests.filter(pc.equal(manifests["ingest_id"], one.ingest_id))


def _keep_replaced(store: StoreWriter, files: Sequence[StoredFile], shown: Collection[str]) -> None:
    """Manifests of replaced rows in compacted files, which older versions need, as files of their
    own: they are found by their names until cleaning removes them."""
    gone = [
        one for file in files if not file.own for one in file.ingests if one.ingest_id not in shown
    ]
    manifests = store.manifests(gone, recording_columns())
    for one in gone:
        path = own_path(one.recording_id, one.ingest_id)
        store.path.write(_of(manifests, one), f"{RECORDINGS}/{path}")


def _groups(store: StoreWriter) -> Iterator[list[StoredFile]]:
    """Files of transitions to make one of, robot by robot in the order of their time."""
    small = [file for file in store.files(TRANSITIONS) if file.rows < FILE_ROWS / 2]
    names = ("ingest_id", "tags", "start_stamp_ns")
    schema = pa.schema([field for field in recording_schema() if field.name in names])
    told = store.manifests([one for file in small for one in file.ingests], schema)
    driven = {
        row["ingest_id"]: (dict(row["tags"] or {}).get("robot", ""), row["start_stamp_ns"] or 0)
        for row in told.to_pylist()
    }
    group: list[StoredFile] = []
    for file in sorted(
        small,
        key=lambda f: min((driven.get(i.ingest_id, ("", 0)) for i in f.ingests), default=("", 0)),
    ):
        if group and sum(one.rows for one in group) + file.rows > FILE_ROWS:
            if len(group) >= LEAST_FILES:
                yield group
            group = []
        group.append(file)
    if len(group) >= LEAST_FILES:
        yield group


def _merge_rows(store: StoreWriter, group: Sequence[StoredFile], done: Compacted) -> None:
    """One file of these, in a commit of its own; none where one of them is gone by then."""
    held: dict[str, Ingest] = {}  # another tool may have cut the rows of one into several files
    for one in (one for file in group for one in file.ingests):
        before = held.get(one.ingest_id)
        held[one.ingest_id] = one._replace(rows=one.rows + (before.rows if before else 0))
    schema = pa.schema(store.path.open_table(TRANSITIONS).schema().to_arrow())
    made = merge(store.path, TRANSITIONS, group, list(held.values()), schema)

    def commit() -> int | None:
        table = store.path.open_table(TRANSITIONS)
        active = {file.path for file in store.files(TRANSITIONS)}
        if made.path in active:
            return table.version()  # by the attempt before, whose answer was lost
        if not {file.path for file in group} <= active:
            return None
        now_ms = time.time_ns() // 1_000_000
        actions: list[AddAction | RemoveAction] = [
            RemoveAction(file.path, True, now_ms) for file in group
        ]
        actions.append(add_action(made, now_ms))
        store.transact(table, actions, [], OPERATION)
        table.update_incremental()
        return table.version()

    version = store.again_on_conflict(commit)
    if version is None:
        done.changed_meanwhile += len(group)
        _discard(store, TRANSITIONS, [made])
        return
    done.rows += made.rows
    done.version = version


def _discard(store: StoreWriter, name: str, files: Sequence[AddedFile]) -> None:
    store.path.delete(f"{name}/{file.path}" for file in files)
