"""Commit to a store's two Delta tables, and write the Parquet files that commits add.

A commit adds files that are already written, and removes files that they replace in the newest
version of the table, all or nothing. It is tried again if another writer was faster, and not made
twice if its answer was lost. Tables are created with the first rows, and get the columns of a
profile's own signals with the first rows that have them.
"""

from __future__ import annotations

import json
import random
import re
import time
import uuid
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import pyarrow as pa
import pyarrow.parquet as pq
from deltalake import CommitProperties, DeltaTable, Schema, Transaction
from deltalake.exceptions import CommitFailedError, DeltaError
from deltalake.transaction import AddAction, RemoveAction

from restock.errors import StoreError
from restock.files import first_line
from restock.ingest.store.lineage import (
    INGESTS,
    Ingest,
    StoredFile,
    StoreReader,
    active_files,
    damage_named,
    own_path,
    packed_ingests,
)
from restock.ingest.store.location import (
    RECORDINGS,
    TRANSITIONS,
    Location,
    open_parquet,
    with_plain_text,
)
from restock.ingest.store.summary import SUMMARY_SCHEMA
from restock.ingest.store.version import FORMAT, expect_writable
from restock.ingest.task.schema import recording_schema

GROUP_ROWS = 65_536  # rows per row group of a joined file
GROUP_BYTES = 64 << 20  # a row group also ends at this size: manifests have large rows
READ_ROWS = 2048


@dataclass
class AddedFile:
    """A file to be committed."""

    recording_id: str
    path: str  # relative to its table
    rows: int
    size: int = 0  # bytes, once it is written


class Committed(NamedTuple):
    """A commit to a table."""

    version: int  # of the table
    before: int  # the last version without the commit
    replaced: list[str]  # the `own_path` of each ingest whose rows were removed


def add_action(file: AddedFile, now_ms: int) -> AddAction:
    """Return the Delta action that adds a file."""
    stats = json.dumps({"numRecords": file.rows})
    return AddAction(file.path, file.size, {}, now_ms, True, stats)


def parquet_options(schema: pa.Schema) -> dict[str, Any]:
    """Return Parquet options for a table's files. Each page has a checksum: see `open_parquet`."""
    return {
        "compression": "zstd",
        "write_page_checksum": True,
        "use_dictionary": [f.name for f in schema if pa.types.is_string(f.type)],
        "use_byte_stream_split": _float_columns(schema),
    }


def merge(
    place: Location,
    name: str,
    files: Sequence[StoredFile],
    kept: Sequence[Ingest],
    schema: pa.Schema,
    *,
    extra: Sequence[pa.Table] = (),
    summarised: bool = False,
) -> AddedFile:
    """Write a file with the manifests `extra`, then the `kept` ingests of these files, in order.

    The new file's metadata lists its ingests only if manifests describe all rows: Restock wrote all
    the files, or it made new summaries of the rows that other tools changed (`summarised`). Columns
    of `schema` that a file lacks are null. One row group at a time is in memory. If writing fails,
    the new file is deleted.

    Raises:
        StoreError: a file is missing or damaged, or the new file cannot be written.
    """
    wanted = pa.array([one.ingest_id for one in kept], pa.string())
    rows = [(one["recording_id"][0].as_py(), one["ingest_id"][0].as_py()) for one in extra]
    held = [*kept, *(Ingest(*ids, 1) for ids in rows)]
    listed = summarised or all(file.listed for file in files)
    schema = schema.with_metadata({INGESTS: packed_ingests(held)} if listed else None)
    made = AddedFile("", f"compacted/{uuid.uuid4().hex}.parquet", 0)
    with (
        written_whole(place, f"{name}/{made.path}"),
        place.writing(f"{name}/{made.path}") as sink,
        pq.ParquetWriter(sink, schema, **parquet_options(schema)) as writer,
    ):
        waiting = [conformed(one, schema) for one in extra]
        rows_waiting = size_waiting = 0
        for part in _parts(place, name, files, wanted, schema):
            waiting.append(part)
            rows_waiting, size_waiting = rows_waiting + len(part), size_waiting + part.nbytes
            if rows_waiting >= GROUP_ROWS or size_waiting >= GROUP_BYTES:
                made.rows += _flush(writer, waiting)
                rows_waiting = size_waiting = 0
        made.rows += _flush(writer, waiting)
        writer.close()
        made.size = sink.tell()
    return made


@contextmanager
def written_whole(place: Location, path: str) -> Iterator[None]:
    """Delete the file that the block writes if the block fails or is interrupted.

    On a full disk, the incomplete file would keep the disk full.

    Raises:
        StoreError: the file cannot be written.
    """
    try:
        yield
    except BaseException as error:
        with suppress(OSError, StoreError, DeltaError):
            place.delete([path])
        if isinstance(error, OSError):
            raise unwritten(place, error) from error
        raise


def unwritten(place: Location, error: OSError | DeltaError) -> StoreError:
    """Return the error for a store that cannot be written, with what to do."""
    text = str(error)
    if re.search(r"No space left|Disk quota exceeded|os error (28|122)\b", text):
        return StoreError(
            "cannot be written: there is no space left on its disk",
            where=str(place),
            remedy="free some space, then run the same command again: no stored data is lost",
        )
    # Delta's library puts the cause on the last line, after an arrow.
    causes = [line.rsplit("↳\x1b[0m ")[-1].strip() for line in text.splitlines() if "↳" in line]
    return StoreError(
        "cannot be written: " + ": ".join([first_line(error), *causes[-1:]]), where=str(place)
    )


def conformed(rows: pa.Table, schema: pa.Schema) -> pa.Table:
    """Return a table with the columns of a schema, in its order; missing columns become null."""
    columns = [
        rows[field.name].cast(field.type)
        if field.name in rows.column_names
        else pa.nulls(len(rows), field.type)
        for field in schema
    ]
    return pa.table(columns, schema=schema)


def _parts(
    place: Location, name: str, files: Sequence[StoredFile], wanted: pa.Array, schema: pa.Schema
) -> Iterator[pa.Table]:
    import pyarrow.compute as pc  # slow to import

    for file in files:
        path = f"{name}/{file.path}"
        with damage_named(place, path), place.reading(path) as source:
            for batch in open_parquet(source).iter_batches(READ_ROWS):
                rows = with_plain_text(pa.table(batch))
                rows = rows.filter(pc.is_in(rows["ingest_id"], wanted))
                yield conformed(rows, schema)


def _flush(writer: pq.ParquetWriter, waiting: list[pa.Table]) -> int:
    rows = pa.concat_tables(waiting) if waiting else None
    waiting.clear()
    if not rows:
        return 0
    writer.write_table(rows, row_group_size=GROUP_ROWS)
    return len(rows)


def _float_columns(schema: pa.Schema) -> list[str]:
    """Return the Parquet paths of columns of floats and of lists of floats."""
    paths = []
    for field in schema:
        if pa.types.is_floating(field.type):
            paths.append(field.name)
        elif pa.types.is_list(field.type) and pa.types.is_floating(field.type.value_type):
            paths.append(f"{field.name}.list.element")
    return paths


ATTEMPTS = 12  # maximum, if other writers commit first; in each, Delta's library tries 15 times
CHECKPOINT_COMMITS = 20  # commits per checkpoint, so that readers of the log open few files
_JITTER = random.SystemRandom()
T = TypeVar("T")


class TableCommits(StoreReader):
    """Reader of a store that can also create its tables and commit to them."""

    def create(self, name: str, schema: pa.Schema) -> None:
        """Create the table, or add the columns that it lacks, which are null in older rows."""
        self.expect_folder()
        from restock.ingest.profile.tables import refuse_other_signals

        def create() -> None:
            if not self.path.has_table(name):
                DeltaTable.create(
                    self.path.table(name),
                    schema,
                    mode="ignore",
                    storage_options=self.path.options,
                    configuration={"delta.checkpointInterval": str(CHECKPOINT_COMMITS)},
                    description=FORMAT,
                )
            table = self._listing(name).table
            expect_writable(table, where=str(self.path))
            have = {field.name: field for field in table.schema().fields}
            refuse_other_signals(have, schema, str(self.path))
            extra = [field.with_nullable(True) for field in schema if field.name not in have]
            if extra:
                table.alter.add_columns(Schema.from_arrow(pa.schema(extra)).fields)

        self.retry_on_conflict(create)

    def expect_folder(self) -> None:
        """Raise StoreError if there is a file, a panel or a run in place of the store."""
        folder = self.path.folder
        other = folder is not None and (folder.is_file() or self.path.other())
        if other and not self.path.has_table(TRANSITIONS):
            raise self.path.absent()

    def expect_store(self) -> None:
        """Raise StoreError if there is no complete store, or a table's features forbid removals."""
        self.expect_folder()
        self.path.expect_both_tables()
        if not self.path.has_table(TRANSITIONS):
            raise self.path.absent()
        for name in (RECORDINGS, TRANSITIONS):
            expect_writable(self.path.open_table(name), where=str(self.path), removing=True)

    def commit(
        self,
        name: str,
        added: Sequence[AddedFile],
        instead_of: Mapping[str, str],
        operation: str = "restock ingest",
    ) -> Committed:
        """Add files in one commit, which in `transitions` also removes their recordings' old rows.

        Without `added`, the rows of the recordings in `instead_of` are removed. `instead_of` maps
        recordings to ingests that must still be the newest in the store.

        Raises:
            StoreError: a recording was ingested again or removed in the meantime, or other writers
                were faster too many times.
        """
        recordings = sorted({file.recording_id for file in added} or instead_of)
        before: list[int] = []
        replaced: list[str] = []
        rewritten: list[AddedFile] = []

        def attempt() -> int:
            listing = self._listing(name)
            table, active = listing.table, listing.files
            if (
                {file.path for file in added} <= {file.path for file in active}
                if added
                else before and not _own_paths(active, recordings)
            ):
                return table.version()  # an earlier attempt was committed, but its answer was lost
            self._expect_unchanged(instead_of)
            before[:] = [table.version()]
            now_ms = time.time_ns() // 1_000_000
            actions: list[AddAction | RemoveAction] = [add_action(f, now_ms) for f in added]
            locks = []
            if name == TRANSITIONS:
                self.discard_uncommitted(name, rewritten)  # files of an earlier attempt
                replaced[:] = _own_paths(active, recordings)
                rewritten.clear()
                actions += self._removing_actions(active, recordings, rewritten, now_ms)
                # Two concurrent first ingests of one recording remove nothing: only the transaction
                # id, which both use, makes Delta report a conflict.
                locks = _make_locks(table, recordings)
            self.transact(table, actions, locks, operation)
            return self._read_own_commit(name, table)

        with self.discarded_on_failure(name, rewritten):
            version = self.retry_on_conflict(attempt)
        return Committed(version, before[0] if before else version, replaced)

    def _removing_actions(
        self,
        active: Sequence[StoredFile],
        recordings: Collection[str],
        rewritten: list[AddedFile],
        now_ms: int,
    ) -> list[AddAction | RemoveAction]:
        """Return actions that remove all files with rows of these recordings from `transitions`.

        Files that also have other recordings are replaced by new ones, listed in `rewritten`.
        """
        actions: list[AddAction | RemoveAction] = []
        for file in active:
            kept = [one for one in file.ingests if one.recording_id not in recordings]
            if len(kept) == len(file.ingests):
                continue
            actions.append(RemoveAction(file.path, True, now_ms))
            if kept:
                path = f"{TRANSITIONS}/{file.path}"
                with damage_named(self.path, path):
                    schema = self.path.read_schema(path)
                rewritten.append(merge(self.path, TRANSITIONS, [file], kept, schema))
                actions.append(add_action(rewritten[-1], now_ms))
        return actions

    def replace_files(
        self, name: str, gone: Collection[str], made: Sequence[AddedFile], operation: str
    ) -> int | None:
        """Replace the files `gone` of a table by the files `made`, all or nothing.

        Returns the table's version. If another writer has removed one of `gone` meanwhile, deletes
        `made` and returns None.
        """

        def attempt() -> int | None:
            table = self.path.open_table(name)
            active = {path for path, *_ in active_files(table)}
            if made and {file.path for file in made} <= active:
                return table.version()  # an earlier attempt was committed, but its answer was lost
            if not set(gone) <= active:
                return None
            now_ms = time.time_ns() // 1_000_000
            actions: list[AddAction | RemoveAction] = [
                RemoveAction(path, True, now_ms) for path in gone
            ]
            actions += [add_action(file, now_ms) for file in made]
            self.transact(table, actions, [], operation)
            table.update_incremental()
            return table.version()

        with self.discarded_on_failure(name, made):
            version = self.retry_on_conflict(attempt)
        if version is None:
            self.discard_uncommitted(name, made)
        return version

    @contextmanager
    def discarded_on_failure(self, name: str, files: Sequence[AddedFile]) -> Iterator[None]:
        """Delete files that the block did not commit because it failed or was interrupted."""
        try:
            yield
        except BaseException:
            self.discard_uncommitted(name, files)
            raise

    def discard_uncommitted(self, name: str, files: Sequence[AddedFile]) -> None:
        """Delete the files, except any that are in the table, if possible.

        Some may be in the table: an error or interrupt can come right after a successful commit.
        """
        with suppress(OSError, StoreError, DeltaError):
            if files:
                active = {path for path, *_ in active_files(self.path.open_table(name))}
                paths = [file.path for file in files if file.path not in active]
                self.path.delete(f"{name}/{path}" for path in paths)

    def remove(self, name: str, paths: Collection[str]) -> None:
        """Remove files from a table; skip files that are no longer in it."""

        def attempt() -> None:
            listing = self._listing(name)
            now_ms = time.time_ns() // 1_000_000
            actions = [
                RemoveAction(file.path, True, now_ms)
                for file in listing.files
                if file.path in paths
            ]
            if actions:
                self.transact(listing.table, actions, [])
                self._read_own_commit(name, listing.table)

        if paths:
            self.retry_on_conflict(attempt)

    def transact(
        self,
        table: DeltaTable,
        actions: Sequence[AddAction | RemoveAction],
        locks: Sequence[Transaction],
        operation: str = "restock ingest",
    ) -> None:
        """Commit to a table.

        Raises:
            CommitFailedError: another writer was faster.
            StoreError: a folder cannot be written, or the table uses a feature that Restock cannot
                write.
        """
        removing = any(isinstance(one, RemoveAction) for one in actions)
        expect_writable(table, where=str(self.path), removing=removing)
        try:
            table.create_write_transaction(
                list(actions),
                mode="append",
                schema=table.schema(),
                commit_properties=CommitProperties(
                    custom_metadata={"operation_name": operation}, app_transactions=list(locks)
                ),
            )
        except CommitFailedError:
            raise
        except (DeltaError, OSError) as error:
            if self.path.folder is None:
                raise  # `translate_errors` explains errors of S3
            raise unwritten(self.path, error) from error

    def _expect_unchanged(self, instead_of: Mapping[str, str]) -> None:
        """Check that these ingests (recording -> ingest) are still the newest in the store."""
        if not instead_of:
            return
        shown = {one.recording_id: one.ingest_id for one in self.shown()}
        for recording, ingest in instead_of.items():
            if shown.get(recording) != ingest:
                raise StoreError(
                    f"recording {recording} was ingested again or removed in the meantime",
                    where=str(self.path),
                    remedy="try again; the store keeps the result of the other command",
                )

    def retry_on_conflict(self, work: Callable[[], T]) -> T:
        """Run `work`, which reads the table anew, up to ATTEMPTS times if others commit first."""
        for attempt in range(ATTEMPTS):
            try:
                with self.path.translate_errors():
                    return work()
            except CommitFailedError as error:
                conflict = error
                # Random, growing waits, so that writers that collided do not collide again.
                time.sleep(0.02 * 2 ** min(attempt, 6) * (1 + _JITTER.random()))
            except (DeltaError, OSError) as error:
                raise unwritten(self.path, error) from error
        raise StoreError(
            f"other writers were faster {ATTEMPTS} times: {first_line(conflict)}",
            where=str(self.path),
            remedy="try again when they are done; the store is unchanged",
        )


def _own_paths(active: Sequence[StoredFile], recordings: Collection[str]) -> list[str]:
    """Return the `own_path` of each ingest of these recordings in the files."""
    return [
        own_path(one.recording_id, one.ingest_id)
        for file in active
        for one in file.ingests
        if one.recording_id in recordings
    ]


def _make_locks(table: DeltaTable, recordings: Sequence[str]) -> list[Transaction]:
    """Return transaction ids that make concurrent changes of one of these recordings conflict."""
    return [
        Transaction(app, (table.transaction_version(app) or 0) + 1)
        for app in (f"restock/{recording}" for recording in recordings)
    ]


def recording_columns() -> pa.Schema:
    """Return the columns of the table `recordings`: those of the manifest and of the summary."""
    return pa.schema([*recording_schema(), *SUMMARY_SCHEMA])


def delta_columns(schema: pa.Schema) -> pa.Schema:
    """Replace fixed-size lists, which Delta does not support, by plain lists."""
    return pa.schema(
        [
            field.with_type(pa.list_(field.type.value_type))
            if pa.types.is_fixed_size_list(field.type)
            else field
            for field in schema
        ]
    )


def plain_lists(rows: pa.Table) -> pa.Table:
    """Convert fixed-size lists in rows to plain lists, without copying the values."""
    schema = delta_columns(rows.schema).with_metadata(rows.schema.metadata)
    columns = zip(rows.columns, schema, strict=True)
    return pa.table([column.cast(field.type) for column, field in columns], schema=schema)
