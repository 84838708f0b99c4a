"""The store, for writing: two Delta tables of plain Parquet, one atomic commit a recording.

`recordings` holds one manifest row an ingest, `transitions` the rows; `ingest_id` joins them. The
manifest is committed first and the transitions second, so an ingest that is cut between the two is
a manifest that joins nothing, and a reader sees each recording whole or not at all. A recording
that is ingested again replaces its old rows in the same commit that adds the new ones.
"""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Callable
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

    def live(self) -> pa.Table:
        """The manifest rows whose transitions are in the store."""
        if not self._exists(RECORDINGS) or not self._exists(TRANSITIONS):
            return recording_schema().empty_table()
        manifests = _read(self._open(RECORDINGS), self.path / RECORDINGS)
        ingests = {file.ingest_id for file in _files(self._open(TRANSITIONS))}
        alive = [ingest in ingests for ingest in manifests["ingest_id"].to_pylist()]
        return manifests.filter(pa.array(alive, pa.bool_()))

    def write(self, manifest: pa.Table, rows: pa.Table) -> int:
        """Put one recording's manifest row and transitions in the store, replacing its old ones.

        Returns the version of `transitions` that has them.

        Raises:
            StoreError: `path` is something else, or other writers were faster too many times.
        """
        recording_id = manifest["recording_id"][0].as_py()
        ingest_id = manifest["ingest_id"][0].as_py()
        self._create(RECORDINGS, recording_schema())
        self._create(TRANSITIONS, _delta_schema(rows.schema))
        name = f"{recording_id}/{ingest_id}.parquet"
        added = {
            RECORDINGS: _write_parquet(manifest, self.path / RECORDINGS / name),
            TRANSITIONS: _write_parquet(rows, self.path / TRANSITIONS / name),
        }
        self._commit(RECORDINGS, recording_id, name, added[RECORDINGS], len(manifest))
        return self._commit(TRANSITIONS, recording_id, name, added[TRANSITIONS], len(rows))

    def clean(self, retention_hours: int = RETENTION_HOURS) -> list[str]:
        """Delete files that no version within the retention window needs; returns their paths.

        They are what killed writers left, and what replaced recordings had.
        """
        deleted = []
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

    def _exists(self, name: str) -> bool:
        return (self.path / name / "_delta_log").is_dir()

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
            table.alter.add_columns(Schema.from_arrow(nullable).fields)

    def _commit(self, name: str, recording_id: str, file: str, size: int, rows: int) -> int:
        """Add one file and remove the recording's others, all or nothing."""
        app = f"restock/{recording_id}"

        def commit() -> int:
            table = self._open(name)
            # Two first ingests of one recording add without removing, which is no conflict by
            # itself: the transaction id makes it one.
            turn = Transaction(app, (table.transaction_version(app) or 0) + 1)
            now_ms = time.time_ns() // 1_000_000
            add = AddAction(file, size, {}, now_ms, True, json.dumps({"numRecords": rows}))
            old = [
                RemoveAction(path, True, now_ms)
                for path in self._replaced(name, table, recording_id)
            ]
            table.create_write_transaction(
                [add, *old],
                mode="append",
                schema=table.schema(),
                commit_properties=CommitProperties(
                    custom_metadata={"operation_name": "restock ingest"}, app_transactions=[turn]
                ),
            )
            return DeltaTable(str(self.path / name)).version()

        return _again_on_conflict(commit, self.path)

    def _replaced(self, name: str, table: DeltaTable, recording_id: str) -> list[str]:
        """The recording's files that this commit takes out of a table.

        Of the manifests, all but the one whose transitions are in the store until the second
        commit replaces them.
        """
        files = [file for file in _files(table) if file.recording_id == recording_id]
        if name == RECORDINGS:
            shown = {file.ingest_id for file in _files(self._open(TRANSITIONS))}
            files = [file for file in files if file.ingest_id not in shown]
        return [file.path for file in files]


class _File:
    """An active file of a table, by its path `<recording_id>/<ingest_id>.parquet`."""

    def __init__(self, path: str) -> None:
        if not _OWN_PATH.fullmatch(path):
            raise StoreError(
                f"holds a file that `restock ingest` did not write: {path}",
                remedy="restore the version before it was added (compacting tools rewrite files)",
            )
        self.path = path
        self.recording_id, name = path.split("/")
        self.ingest_id = name.removesuffix(".parquet")


def _files(table: DeltaTable) -> list[_File]:
    return [_File(path) for path in table.get_add_actions(flatten=True)["path"].to_pylist()]


def _read(table: DeltaTable, folder: Path) -> pa.Table:
    parts = [pq.read_table(folder / file.path, partitioning=None) for file in _files(table)]
    if not parts:
        return recording_schema().empty_table()
    return pa.concat_tables(parts, promote_options="default")


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
