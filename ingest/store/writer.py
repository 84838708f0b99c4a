"""The store, for writing: two Delta tables of plain Parquet, one atomic commit a recording.

`recordings` holds one manifest row an ingest, `transitions` the rows; `ingest_id` joins them, and
both files of an ingest have the same name in their tables. The manifest is committed first and the
transitions second, so an ingest that is cut between the two is a manifest that joins nothing, and
a reader sees each recording whole or not at all. A recording that is ingested again replaces its
old rows in the same commit that adds the new ones; the manifests of what was replaced go last, by
the writer that replaced it. A manifest that joins nothing yet is removed by its age only: another
writer may be about to commit its transitions. Files outlive their removal by the same window, so
that who opened a version before can read it: its manifests too, by the names of its rows' files.
"""

from __future__ import annotations

import json
import random
import re
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import pyarrow as pa
from deltalake import CommitProperties, DeltaTable, Schema, Transaction
from deltalake.exceptions import CommitFailedError, DeltaError
from deltalake.transaction import AddAction, RemoveAction

from restock.errors import StoreError
from restock.files import first_line
from restock.ingest.profile.custom_signal import refuse_other_signals
from restock.ingest.store.location import Location
from restock.ingest.store.repeated import (
    SKETCH,
    UNREADABLE,
    RepeatedDrive,
    Sketch,
    find_repeat,
    read_sketch,
    sketch,
)
from restock.ingest.store.version import Version
from restock.ingest.task.schema import recording_schema

TRANSITIONS, RECORDINGS = "transitions", "recordings"
ATTEMPTS = 12  # at a commit, when other writers are faster; Delta's library tries 15 times in each
# Files that no version of a table needs are kept this long: a writer may be about to commit them,
# and a reader that opened an older version may be about to read them.
RETENTION_HOURS = 7 * 24
ROW_GROUP_ROWS = 32_768
READERS = 16  # of small files at once, which on S3 are a wait each
CHECKPOINT_COMMITS = 20  # a reader of the log opens at most so many files
_JITTER = random.SystemRandom()
T = TypeVar("T")
OWN_PATH = re.compile(r"([0-9a-f]{16})/[^/]+\.parquet")


class StoreWriter:
    """Writes recordings to a store, which is made when the first one is written."""

    def __init__(self, path: str | Path | Location) -> None:
        self.path = Location.of(path)

    def reach(self) -> None:
        """Check that the place can be reached. Raises StoreError where it cannot."""
        self.path.has_table(TRANSITIONS)

    def live(self, recording_id: str | None = None, version: Version | None = None) -> pa.Table:
        """The manifest rows whose transitions are in the store (of one recording, or of all).

        Of a version, or as it is now.
        """
        empty = recording_schema().empty_table()
        if not self.path.has_table(TRANSITIONS):
            return empty
        parts = [
            self.path.read(f"{RECORDINGS}/{file.path}")
            for file in _files(self.path.open_table(TRANSITIONS, version))
            if recording_id in (None, file.recording_id)
        ]
        return pa.concat_tables([empty, *parts], promote_options="default")

    def rows(self, recording_id: str, ingest_id: str) -> pa.Table:
        """One recording's transitions, as they were written."""
        return self.path.read(f"{TRANSITIONS}/{recording_id}/{ingest_id}.parquet")

    def repeated(self, rows: pa.Table, period_s: float) -> RepeatedDrive | None:
        """The recording that holds most of these rows under other ids, if one largely does.

        `period_s` is the control period: rows further apart than half of it do not count.
        Recordings that older software wrote are not looked at; the audit `repeated_steps` does.
        """
        if not self.path.has_table(TRANSITIONS):
            return None
        own = rows["recording_id"][0].as_py()
        others = [f for f in _files(self.path.open_table(TRANSITIONS)) if f.recording_id != own]
        with ThreadPoolExecutor(READERS) as pool:
            sketches = list(pool.map(self._sketch, others))
        return find_repeat(rows, sketches, self.rows, period_s)

    def _sketch(self, file: _File) -> Sketch:
        metadata = None
        with suppress(*UNREADABLE):  # another recording, which `restock sql` reports
            metadata = self.path.read_schema(f"{RECORDINGS}/{file.path}").metadata
        return Sketch(file.recording_id, file.ingest_id, read_sketch(metadata))

    def write(self, manifest: pa.Table, rows: pa.Table) -> int:
        """Write one recording's manifest row and transitions, replacing its old ones.

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
        """Write several recordings, as (manifest row, transitions), in one commit.

        `instead_of` (recording -> ingest) are the ingests that were read to make them: if another
        writer has replaced one since, nothing is written.

        Raises:
            StoreError: as `write`, or what was to be replaced has changed.
        """
        manifests: list[_Added] = []
        transitions: list[_Added] = []
        try:
            for manifest, rows in recordings:
                recording_id = manifest["recording_id"][0].as_py()
                name = f"{recording_id}/{manifest['ingest_id'][0].as_py()}.parquet"
                manifest = manifest.replace_schema_metadata({SKETCH: sketch(rows)})
                self._create(RECORDINGS, recording_schema())
                self._create(TRANSITIONS, _delta_schema(rows.schema))
                for table, what, added in (
                    (manifest, RECORDINGS, manifests),
                    (rows, TRANSITIONS, transitions),
                ):
                    added.append(_Added(recording_id, name, len(table)))
                    added[-1].size = self._write(table, f"{what}/{name}")
        except BaseException:  # no commit has begun, so they are not needed
            with suppress(OSError, StoreError):
                self.path.delete(f"{RECORDINGS}/{file.path}" for file in manifests)
                self.path.delete(f"{TRANSITIONS}/{file.path}" for file in transitions)
            raise
        self._commit(RECORDINGS, manifests, instead_of or {})
        version, replaced = self._commit(TRANSITIONS, transitions, instead_of or {})
        self._remove(RECORDINGS, replaced)
        return version

    def clean(self, retention_hours: int = RETENTION_HOURS) -> list[str]:
        """Delete files that no version within the retention window needs; returns their paths.

        They are what killed writers left, and what replaced recordings had. The window must be
        longer than any writer takes from its first file to its last commit.
        """
        deleted = []
        self._remove(RECORDINGS, self._abandoned(retention_hours))
        for name in (RECORDINGS, TRANSITIONS):
            if not self.path.has_table(name):
                continue
            with self.path.translate_errors():
                unneeded = self.path.open_table(name).vacuum(
                    retention_hours=retention_hours,
                    dry_run=True,
                    enforce_retention_duration=False,
                    full=True,
                )
            # It names removed files for as long as the log does, there or not.
            stale = sorted(set(unneeded) & self.path.listing(name))
            deleted += [f"{name}/{file}" for file in stale]
        # Without commits of its own: cleaning changes no version of a table.
        self.path.delete(deleted)
        return deleted

    def _abandoned(self, retention_hours: int) -> list[str]:
        """Manifests that join nothing, and are too old for a writer to be on its way to commit."""
        if not self.path.has_table(RECORDINGS) or not self.path.has_table(TRANSITIONS):
            return []
        manifests = self.path.open_table(RECORDINGS)  # before the transitions that may join them
        shown = {file.path for file in _files(self.path.open_table(TRANSITIONS))}
        before_ms = (time.time() - retention_hours * 3600) * 1000
        return [
            file.path
            for file in _files(manifests)
            if file.path not in shown and file.added_ms < before_ms
        ]

    def _write(self, rows: pa.Table, path: str) -> int:
        """Write a Parquet file; returns its size in bytes.

        Lists of fixed size become plain lists, which every engine that knows Delta reads.
        """
        rows = rows.cast(_delta_schema(rows.schema).with_metadata(rows.schema.metadata))
        try:
            return self.path.write(
                rows,
                path,
                row_group_size=ROW_GROUP_ROWS,
                compression="zstd",
                use_dictionary=[f.name for f in rows.schema if pa.types.is_string(f.type)],
                use_byte_stream_split=_float_columns(rows.schema),
            )
        except OSError as error:
            raise StoreError(
                f"cannot be written: {first_line(error)}", where=str(self.path)
            ) from error

    def _create(self, name: str, schema: pa.Schema) -> None:
        """See that there is a table with these columns.

        Columns that newer software writes are added; rows from before hold null in them.
        """
        if self.path.folder is not None and self.path.folder.is_file():
            raise StoreError("is a file, not a store", where=str(self.path), remedy="name a folder")

        def create() -> None:
            if not self.path.has_table(name):
                DeltaTable.create(
                    self.path.table(name),
                    schema,
                    mode="ignore",
                    storage_options=self.path.options,
                    configuration={"delta.checkpointInterval": str(CHECKPOINT_COMMITS)},
                )
            table = self.path.open_table(name)
            have = {field.name: field for field in table.schema().fields}
            refuse_other_signals(have, schema, str(self.path))
            extra = [field.with_nullable(True) for field in schema if field.name not in have]
            if extra:
                table.alter.add_columns(Schema.from_arrow(pa.schema(extra)).fields)

        self._again_on_conflict(create)

    def _commit(
        self, name: str, added: Sequence[_Added], instead_of: Mapping[str, str]
    ) -> tuple[int, list[str]]:
        """Add files, all or nothing; to `transitions`, remove the same recordings' others with it.

        Returns the table's version and the files removed from it.
        """
        recordings = sorted({file.recording_id for file in added})
        replaced: list[str] = []

        def commit() -> int:
            table = self.path.open_table(name)
            active = _files(table)
            if {file.path for file in added} <= {file.path for file in active}:
                return table.version()  # by the attempt before, whose answer was lost
            self._still(instead_of)
            now_ms = time.time_ns() // 1_000_000
            actions: list[AddAction | RemoveAction] = [
                AddAction(f.path, f.size, {}, now_ms, True, json.dumps({"numRecords": f.rows}))
                for f in added
            ]
            turns = []
            if name == TRANSITIONS:
                replaced[:] = [file.path for file in active if file.recording_id in recordings]
                actions += [RemoveAction(path, True, now_ms) for path in replaced]
                # Two first ingests of one recording add without removing, which is no conflict by
                # itself: the transaction id makes it one.
                turns = [
                    Transaction(app, (table.transaction_version(app) or 0) + 1)
                    for app in (f"restock/{recording}" for recording in recordings)
                ]
            self._transact(table, actions, turns)
            table.update_incremental()
            return table.version()

        return self._again_on_conflict(commit), replaced

    def _remove(self, name: str, paths: Collection[str]) -> None:
        """Take files out of a table, those that are still in it."""

        def commit() -> None:
            table = self.path.open_table(name)
            now_ms = time.time_ns() // 1_000_000
            actions = [
                RemoveAction(file.path, True, now_ms)
                for file in _files(table)
                if file.path in paths
            ]
            if actions:
                self._transact(table, actions, [])

        if paths:
            self._again_on_conflict(commit)

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
        shown = {
            file.recording_id: file.ingest_id for file in _files(self.path.open_table(TRANSITIONS))
        }
        for recording, ingest in instead_of.items():
            if shown.get(recording) != ingest:
                raise StoreError(
                    f"recording {recording} was ingested again meanwhile",
                    where=str(self.path),
                    remedy="try again; the store is as that ingest left it",
                )

    def _again_on_conflict(self, work: Callable[[], T]) -> T:
        """Do it again, from a fresh look at the table, while other writers are faster."""
        for attempt in range(ATTEMPTS):
            try:
                with self.path.translate_errors():
                    return work()
            except CommitFailedError as error:
                conflict = error
                # Writers that collided wait for different times, and longer each time.
                time.sleep(0.02 * 2 ** min(attempt, 6) * (1 + _JITTER.random()))
            except (DeltaError, OSError) as error:
                raise StoreError(
                    f"cannot be written: {first_line(error)}", where=str(self.path)
                ) from error
        raise StoreError(
            f"other writers were faster {ATTEMPTS} times: {first_line(conflict)}",
            where=str(self.path),
            remedy="try again when they are done; the store is as it was",
        )


@dataclass
class _Added:
    """A file to be committed."""

    recording_id: str
    path: str  # in its table
    rows: int
    size: int = 0  # bytes, once it is written


class _File:
    """An active file of a table, by its path `<recording_id>/<ingest_id>.parquet`."""

    def __init__(self, path: str, added_ms: int) -> None:
        if not OWN_PATH.fullmatch(path):
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


def _float_columns(schema: pa.Schema) -> list[str]:
    """Parquet's paths of the float columns, those in lists of floats included."""
    paths = []
    for field in schema:
        if pa.types.is_floating(field.type):
            paths.append(field.name)
        elif pa.types.is_list(field.type) and pa.types.is_floating(field.type.value_type):
            paths.append(f"{field.name}.list.element")
    return paths


def _delta_schema(schema: pa.Schema) -> pa.Schema:
    """The same columns without lists of fixed size, which Delta does not know."""
    return pa.schema(
        [
            field.with_type(pa.list_(field.type.value_type))
            if pa.types.is_fixed_size_list(field.type)
            else field
            for field in schema
        ]
    )
