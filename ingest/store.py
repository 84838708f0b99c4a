"""The store, for writing: two Delta tables of plain Parquet, one atomic commit a recording.

`recordings` holds one manifest row an ingest, `transitions` the rows; `ingest_id` joins them. The
manifest is committed first and the transitions second, so an ingest that is cut between the two is
a manifest that joins nothing, and a reader sees each recording whole or not at all. A recording
that is ingested again replaces its old rows in the same commit that adds the new ones; the
manifests of what was replaced go last, by the writer that replaced it. A manifest that joins
nothing yet is never removed: another writer may be about to commit its transitions.
"""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import pyarrow as pa
import pyarrow.parquet as pq
from deltalake import CommitProperties, DeltaTable, Transaction
from deltalake.exceptions import CommitFailedError, DeltaError, TableNotFoundError
from deltalake.transaction import AddAction, RemoveAction

from restock.errors import StoreError
from restock.ingest.schema import recording_schema

TRANSITIONS, RECORDINGS = "transitions", "recordings"
ATTEMPTS = 10  # at a commit, when other writers are faster
# Files that no version of a table needs are kept this long: a writer may be about to commit them.
RETENTION_HOURS = 7 * 24
ROW_GROUP_ROWS = 32_768
_OWN_PATH = re.compile(r"([0-9a-f]{16})/[^/]+\.parquet")


class StoreWriter:
    """Writes recordings to a store. The directory is made when the first one is written."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    def live(self, recording_id: str | None = None) -> pa.Table:
        """The manifest rows whose transitions are in the store (of one recording, or of all)."""
        if not self._exists(RECORDINGS) or not self._exists(TRANSITIONS):
            return recording_schema().empty_table()
        shown = {file.ingest_id for file in _files(self._open(TRANSITIONS))}
        parts = [
            pq.read_table(self.path / RECORDINGS / file.path, partitioning=None)
            for file in _files(self._open(RECORDINGS))
            if file.ingest_id in shown and recording_id in (None, file.recording_id)
        ]
        empty = recording_schema().empty_table()
        return pa.concat_tables([empty, *parts], promote_options="default")

    def rows(self, recording_id: str, ingest_id: str) -> pa.Table:
        """One recording's transitions, as they were written."""
        path = self.path / TRANSITIONS / recording_id / f"{ingest_id}.parquet"
        return pq.read_table(path, partitioning=None)

    def write(self, manifest: pa.Table, rows: pa.Table) -> int:
        """Put one recording's manifest row and transitions in the store, replacing its old ones.

        Returns the version of `transitions` that has them.

        Raises:
            StoreError: `path` is something else, or other writers were faster too many times.
        """
        return self.write_all([(manifest, rows)])

    def write_all(
        self,
        recordings: Iterable[tuple[pa.Table, pa.Table]],
        *,
        instead_of: Mapping[str, str] | None = None,
    ) -> int:
        """Put several recordings, as (manifest row, transitions), in the store in one commit.

        `instead_of` (recording -> ingest) are the ingests that were read to make them: if another
        writer has replaced one since, nothing is written.

        Raises:
            StoreError: as `write`, or what was to be replaced has changed.
        """
        manifests: list[_Added] = []
        transitions: list[_Added] = []
        for manifest, rows in recordings:
            recording_id = manifest["recording_id"][0].as_py()
            name = f"{recording_id}/{manifest['ingest_id'][0].as_py()}.parquet"
            self._create(RECORDINGS, recording_schema())
            self._create(TRANSITIONS, _delta_schema(rows.schema))
            for table, what, added in (
                (manifest, RECORDINGS, manifests),
                (rows, TRANSITIONS, transitions),
            ):
                size = _write_parquet(table, self.path / what / name)
                added.append(_Added(recording_id, name, size, len(table)))
        self._commit(RECORDINGS, manifests, instead_of or {})
        version, replaced = self._commit(TRANSITIONS, transitions, instead_of or {})
        self._remove(RECORDINGS, replaced)
        return version

    def clean(self, retention_hours: int = RETENTION_HOURS) -> list[str]:
        """Delete files that no version within the retention window needs; returns their paths.

        They are what killed writers left, and what replaced recordings had.
        """
        deleted = []
        self._remove(RECORDINGS, self._abandoned(retention_hours))
        for name in (RECORDINGS, TRANSITIONS):
            if not self._exists(name):
                continue
            unneeded = self._open(name).vacuum(
                retention_hours=retention_hours,
                dry_run=True,
                enforce_retention_duration=False,
                full=True,
            )
            for file in unneeded:
                # Without a commit of its own: cleaning changes no version of the table.
                (self.path / name / file).unlink(missing_ok=True)
                deleted.append(f"{name}/{file}")
        return deleted

    def _abandoned(self, retention_hours: int) -> list[str]:
        """Manifests that join nothing, and are too old for a writer to be on its way to commit."""
        if not self._exists(RECORDINGS) or not self._exists(TRANSITIONS):
            return []
        manifests = self._open(RECORDINGS)  # before the transitions that may join them
        shown = {file.ingest_id for file in _files(self._open(TRANSITIONS))}
        before_ms = (time.time() - retention_hours * 3600) * 1000
        return [
            file.path
            for file in _files(manifests)
            if file.ingest_id not in shown and file.added_ms < before_ms
        ]

    def _exists(self, name: str) -> bool:
        # A folder of a log is not yet a table: another writer may be making its first version.
        return DeltaTable.is_deltatable(str(self.path / name))

    def _open(self, name: str) -> DeltaTable:
        try:
            return DeltaTable(str(self.path / name))
        except (TableNotFoundError, DeltaError, ValueError) as error:
            raise StoreError(
                f"its table `{name}` cannot be opened: {str(error).splitlines()[0]}",
                where=str(self.path),
            ) from error

    def _create(self, name: str, schema: pa.Schema) -> None:
        if self._exists(name):
            self._evolve(name, schema)
            return
        if self.path.is_file():
            raise StoreError("is a file, not a store", where=str(self.path), remedy="name a folder")

        def create() -> None:
            DeltaTable.create(str(self.path / name), schema, mode="ignore")

        _again_on_conflict(create, self.path)

    def _evolve(self, name: str, schema: pa.Schema) -> None:
        """Columns that newer software writes are added; rows from before hold null in them."""
        table = self._open(name)
        have = {field.name for field in table.schema().fields}
        extra = [field for field in schema if field.name not in have]
        if extra:
            from deltalake import Schema

            nullable = pa.schema([field.with_nullable(True) for field in extra])
            fields = Schema.from_arrow(nullable).fields
            _again_on_conflict(lambda: table.alter.add_columns(fields), self.path)

    def _commit(
        self, name: str, added: Sequence[_Added], instead_of: Mapping[str, str]
    ) -> tuple[int, list[str]]:
        """Add files and remove the same recordings' other transitions, all or nothing.

        Returns the table's version and the files removed from it.
        """
        recordings = {file.recording_id for file in added}

        def commit() -> tuple[int, list[str]]:
            table = self._open(name)
            self._still(instead_of)
            now_ms = time.time_ns() // 1_000_000
            replaced = [
                file.path
                for file in _files(table)
                if name == TRANSITIONS and file.recording_id in recordings
            ]
            actions: list[AddAction | RemoveAction] = [
                AddAction(f.path, f.size, {}, now_ms, True, json.dumps({"numRecords": f.rows}))
                for f in added
            ]
            actions += [RemoveAction(path, True, now_ms) for path in replaced]
            # Two first ingests of one recording add without removing, which is no conflict by
            # itself: the transaction id makes it one.
            turns = [
                Transaction(app, (table.transaction_version(app) or 0) + 1)
                for app in (f"restock/{recording}" for recording in sorted(recordings))
            ]
            self._transact(table, actions, turns)
            return DeltaTable(str(self.path / name)).version(), replaced

        return _again_on_conflict(commit, self.path)

    def _remove(self, name: str, paths: Collection[str]) -> None:
        """Take files out of a table, those that are still in it."""

        def commit() -> None:
            table = self._open(name)
            now_ms = time.time_ns() // 1_000_000
            actions = [
                RemoveAction(file.path, True, now_ms)
                for file in _files(table)
                if file.path in paths
            ]
            if actions:
                self._transact(table, actions, [])

        if paths:
            _again_on_conflict(commit, self.path)

    def _transact(
        self,
        table: DeltaTable,
        actions: Sequence[AddAction | RemoveAction],
        turns: Sequence[Transaction],
    ) -> None:
        table.create_write_transaction(
            list(actions),
            mode="append",
            schema=table.schema(),
            commit_properties=CommitProperties(
                custom_metadata={"operation_name": "restock ingest"}, app_transactions=list(turns)
            ),
        )

    def _still(self, instead_of: Mapping[str, str]) -> None:
        """Check that these ingests are the ones in the store."""
        if not instead_of:
            return
        shown = {file.recording_id: file.ingest_id for file in _files(self._open(TRANSITIONS))}
        for recording, ingest in instead_of.items():
            if shown.get(recording) != ingest:
                raise StoreError(
                    f"recording {recording} was ingested anew meanwhile",
                    where=str(self.path),
                    remedy="try again; the store is as that ingest left it",
                )


@dataclass(frozen=True)
class _Added:
    """A file written, and not yet committed."""

    recording_id: str
    path: str  # in its table
    size: int  # bytes
    rows: int


class _File:
    """An active file of a table, by its path `<recording_id>/<ingest_id>.parquet`."""

    def __init__(self, path: str, added_ms: int) -> None:
        if not _OWN_PATH.fullmatch(path):
            raise StoreError(
                f"holds a file that `restock ingest` did not write: {path}",
                remedy="restore the version before it was added (compacting tools rewrite files)",
            )
        self.path, self.added_ms = path, added_ms
        self.recording_id, name = path.split("/")
        self.ingest_id = name.removesuffix(".parquet")


def _files(table: DeltaTable) -> list[_File]:
    actions = table.get_add_actions(flatten=True)
    paths, added_ms = actions["path"].to_pylist(), actions["modification_time"].to_pylist()
    return [_File(path, ms) for path, ms in zip(paths, added_ms, strict=True)]


def _write_parquet(rows: pa.Table, path: Path) -> int:
    """Write a file whole and flushed to the disk; returns its size in bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(
        rows,
        path,
        row_group_size=ROW_GROUP_ROWS,
        compression="zstd",
        use_dictionary=[f.name for f in rows.schema if pa.types.is_string(f.type)],
        use_byte_stream_split=_float_columns(rows.schema),
    )
    with path.open("rb") as file:
        os.fsync(file.fileno())
    return path.stat().st_size


def _float_columns(schema: pa.Schema) -> list[str]:
    """Parquet's paths of the float columns, those in lists of floats included."""
    paths = []
    for field in schema:
        if pa.types.is_floating(field.type):
            paths.append(field.name)
        elif pa.types.is_fixed_size_list(field.type):
            paths.append(f"{field.name}.list.element")
    return paths


def _delta_schema(schema: pa.Schema) -> pa.Schema:
    """Delta knows no list of fixed size; the Parquet keeps it."""
    return pa.schema(
        [
            field.with_type(pa.list_(field.type.value_type))
            if pa.types.is_fixed_size_list(field.type)
            else field
            for field in schema
        ]
    )


T = TypeVar("T")


def _again_on_conflict(work: Callable[[], T], where: Path) -> T:
    """Do it again, from a fresh look at the table, while other writers are faster."""
    for attempt in range(ATTEMPTS):
        try:
            return work()
        except CommitFailedError as error:
            conflict = error
            # Writers that collided wait for different times: by process, and longer each time.
            time.sleep(0.02 * 2 ** min(attempt, 5) * (1 + os.getpid() % 7 / 7))
        except (DeltaError, OSError) as error:
            raise StoreError(
                f"cannot be written: {str(error).splitlines()[0]}", where=str(where)
            ) from error
    raise StoreError(
        f"other writers were faster {ATTEMPTS} times: {str(conflict).splitlines()[0]}",
        where=str(where),
        remedy="try again when they are done; the store is as it was",
    )


__all__ = ["RECORDINGS", "RETENTION_HOURS", "TRANSITIONS", "StoreWriter"]
