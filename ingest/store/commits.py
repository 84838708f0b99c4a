"""Commits to a store's two Delta tables, and the Parquet files that they add.

A commit takes files that are already written, and what they replace, from a fresh look at the
table. It is all or nothing, is tried again if another writer was faster, and is not done twice if
its answer was lost. Tables are created, and get the columns of a profile's own signals, when rows
with them are first written.
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
from typing import Any, TypeVar

import numpy as np
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

GROUP_ROWS = 65_536  # of a compacted file's row groups
GROUP_BYTES = 64 << 20  # or where rows are large, as manifests are
READ_ROWS = 2048


@dataclass
class AddedFile:
    """A file to be committed."""

    recording_id: str
    path: str  # in its table
    rows: int
    size: int = 0  # bytes, once it is written


def add_action(file: AddedFile, now_ms: int) -> AddAction:
    """Return what a commit says about a file."""
    stats = json.dumps({"numRecords": file.rows})
    return AddAction(file.path, file.size, {}, now_ms, True, stats)


def parquet_options(schema: pa.Schema) -> dict[str, Any]:
    """Return how the tables' columns are encoded. Each page has a checksum: see `open_parquet`."""
    return {
        "compression": "zstd",
        "write_page_checksum": True,
        "use_dictionary": [f.name for f in schema if pa.types.is_string(f.type)],
        "use_byte_stream_split": _float_columns(schema),
    }


def rewrite(place: Location, file: StoredFile, kept: Sequence[Ingest]) -> AddedFile:
    """Write a compacted file of transitions without the ingests that are not kept."""
    path = f"{TRANSITIONS}/{file.path}"
    with damage_named(place, path):
        schema = place.read_schema(path)
    return merge(place, TRANSITIONS, [file], kept, schema)


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
    """Write one file of some ingests in these files, in their order, and of `extra` manifests.

    What it holds is listed in it if the manifests describe these rows: Restock wrote the files, or
    all that others changed in them is `summarised` again. A row group at a time is in memory.
    Columns of `schema` that a file lacks are null. What is written is deleted where that fails.

    Raises:
        StoreError: a file is missing or damaged, or it cannot be written.
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
    """Delete a file that the block writes if it fails or is interrupted.

    On a full disk its part would keep the disk full.

    Raises:
        StoreError: it cannot be written.
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
    """Return the error of a store that cannot be written, with what to do."""
    said = str(error)
    if re.search(r"No space left|Disk quota exceeded|os error (28|122)\b", said):
        return StoreError(
            "cannot be written: there is no space left on its disk",
            where=str(place),
            remedy="free some space, then run the same command again: what the store has is kept",
        )
    # Delta's library has the cause in its last line, behind an arrow.
    causes = [line.rsplit("↳\x1b[0m ")[-1].strip() for line in said.splitlines() if "↳" in line]
    return StoreError(
        "cannot be written: " + ": ".join([first_line(error), *causes[-1:]]), where=str(place)
    )


def conformed(rows: pa.Table, schema: pa.Schema) -> pa.Table:
    """Return a table with the columns of a schema, in its order; null if it has none."""
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
    """Return Parquet's paths of the float columns, those in lists of floats included."""
    paths = []
    for field in schema:
        if pa.types.is_floating(field.type):
            paths.append(field.name)
        elif pa.types.is_list(field.type) and pa.types.is_floating(field.type.value_type):
            paths.append(f"{field.name}.list.element")
    return paths


ATTEMPTS = 12  # at a commit, when other writers are faster; Delta's library tries 15 times in each
CHECKPOINT_COMMITS = 20  # a reader of the log opens at most so many files
_JITTER = random.SystemRandom()
T = TypeVar("T")


class TableCommits(StoreReader):
    """A store whose tables can be made and committed to."""

    def create(self, name: str, schema: pa.Schema) -> None:
        """Make the table, or add the columns that it lacks: rows from before hold null in them."""
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

        self.again_on_conflict(create)

    def expect_folder(self) -> None:
        """Raise StoreError if there is a file, a panel or a run in place of the store."""
        folder = self.path.folder
        other = folder is not None and (folder.is_file() or self.path.other())
        if other and not self.path.has_table(TRANSITIONS):
            raise self.path.absent()

    def expect_store(self) -> None:
        """Raise StoreError if there is no whole store, or if rows cannot be taken out of it.

        Other tools' features can protect it from that.
        """
        self.expect_folder()
        self.path.expect_both_tables()
        if not self.path.has_table(TRANSITIONS):
            raise self.path.absent()
        for name in (RECORDINGS, TRANSITIONS):
            expect_writable(self.path.open_table(name), where=str(self.path), removing=True)

    def commit(
        self, name: str, added: Sequence[AddedFile], instead_of: Mapping[str, str]
    ) -> tuple[int, list[str]]:
        """Add files, all or nothing; to `transitions`, remove the same recordings' others with it.

        Returns the table's version and the files removed from it.
        """
        recordings = sorted({file.recording_id for file in added})
        replaced: list[str] = []
        rewritten: list[AddedFile] = []

        def attempt() -> int:
            listing = self._listing(name)
            table, active = listing.table, listing.files
            if {file.path for file in added} <= {file.path for file in active}:
                return table.version()  # by the attempt before, whose answer was lost
            self._still(instead_of)
            now_ms = time.time_ns() // 1_000_000
            actions: list[AddAction | RemoveAction] = [add_action(f, now_ms) for f in added]
            turns = []
            if name == TRANSITIONS:
                self.discard_uncommitted(name, rewritten)  # of an attempt before
                replaced[:] = _held(active, recordings)
                rewritten.clear()
                actions += self._without(active, recordings, rewritten, now_ms)
                # Two first ingests of one recording add without removing, which is no conflict by
                # itself: the transaction id makes it one.
                turns = _turns(table, recordings)
            self.transact(table, actions, turns)
            return self._read_on(name, table)

        with self.discarded_on_failure(name, rewritten):
            return self.again_on_conflict(attempt), replaced

    def take_out(self, ingests: Mapping[str, str], operation: str) -> tuple[int, int]:
        """Take recordings out of `transitions` by their ingests, all or none of them.

        Their manifests are left to the caller.

        Returns the table's version that they were read from, and the newest, without them.

        Raises:
            StoreError: one was ingested again or removed in the meantime, or other writers were
                faster too many times.
        """
        rewritten: list[AddedFile] = []
        before: list[int] = []

        def attempt() -> int:
            listing = self._listing(TRANSITIONS)
            table, active = listing.table, listing.files
            self.discard_uncommitted(TRANSITIONS, rewritten)  # of an attempt before
            rewritten.clear()
            if before and not _held(active, ingests):
                return table.version()  # by the attempt before, whose answer was lost
            self._still(ingests)
            before[:] = [table.version()]
            now_ms = time.time_ns() // 1_000_000
            actions = self._without(active, ingests, rewritten, now_ms)
            self.transact(table, actions, _turns(table, sorted(ingests)), operation)
            return self._read_on(TRANSITIONS, table)

        with self.discarded_on_failure(TRANSITIONS, rewritten):
            version = self.again_on_conflict(attempt)
        return before[0], version

    def _without(
        self,
        active: Sequence[StoredFile],
        recordings: Collection[str],
        rewritten: list[AddedFile],
        now_ms: int,
    ) -> list[AddAction | RemoveAction]:
        """Return what takes the rows of recordings out of `transitions`: their files.

        Of files that hold others too, new ones without them are added to `rewritten`.
        """
        actions: list[AddAction | RemoveAction] = []
        for file in active:
            kept = [one for one in file.ingests if one.recording_id not in recordings]
            if len(kept) == len(file.ingests):
                continue
            actions.append(RemoveAction(file.path, True, now_ms))
            if kept:
                rewritten.append(rewrite(self.path, file, kept))
                actions.append(add_action(rewritten[-1], now_ms))
        return actions

    def replace_files(
        self, name: str, gone: Collection[str], made: Sequence[AddedFile], operation: str
    ) -> int | None:
        """Put files in the place of others of a table, all or nothing.

        Returns the table's version; None, and `made` are deleted, where another writer has taken
        one of the others out meanwhile.
        """

        def attempt() -> int | None:
            table = self.path.open_table(name)
            active = {path for path, *_ in active_files(table)}
            if made and {file.path for file in made} <= active:
                return table.version()  # by the attempt before, whose answer was lost
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
            version = self.again_on_conflict(attempt)
        if version is None:
            self.discard_uncommitted(name, made)
        return version

    @contextmanager
    def discarded_on_failure(self, name: str, files: Sequence[AddedFile]) -> Iterator[None]:
        """Delete files that the block was to commit where it fails or is interrupted."""
        try:
            yield
        except BaseException:
            self.discard_uncommitted(name, files)
            raise

    def discard_uncommitted(self, name: str, files: Sequence[AddedFile]) -> None:
        """Delete those of the files that are not in the table, as far as that is possible.

        An error or an interrupt may come when they are in it already.
        """
        with suppress(OSError, StoreError, DeltaError):
            if files:
                active = {path for path, *_ in active_files(self.path.open_table(name))}
                paths = [file.path for file in files if file.path not in active]
                self.path.delete(f"{name}/{path}" for path in paths)

    def remove(self, name: str, paths: Collection[str]) -> None:
        """Take files out of a table, those that are still in it."""

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
                self._read_on(name, listing.table)

        if paths:
            self.again_on_conflict(attempt)

    def transact(
        self,
        table: DeltaTable,
        actions: Sequence[AddAction | RemoveAction],
        turns: Sequence[Transaction],
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
                    custom_metadata={"operation_name": operation}, app_transactions=list(turns)
                ),
            )
        except CommitFailedError:
            raise
        except (DeltaError, OSError) as error:
            if self.path.folder is None:
                raise  # `translate_errors` knows what S3 says
            raise unwritten(self.path, error) from error

    def _still(self, instead_of: Mapping[str, str]) -> None:
        """Check that these ingests are the ones in the store."""
        if not instead_of:
            return
        shown = {one.recording_id: one.ingest_id for one in self.shown()}
        for recording, ingest in instead_of.items():
            if shown.get(recording) != ingest:
                raise StoreError(
                    f"recording {recording} was ingested again or removed in the meantime",
                    where=str(self.path),
                    remedy="try again; the store is in the state after that",
                )

    def again_on_conflict(self, work: Callable[[], T]) -> T:
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
                raise unwritten(self.path, error) from error
        raise StoreError(
            f"other writers were faster {ATTEMPTS} times: {first_line(conflict)}",
            where=str(self.path),
            remedy="try again when they are done; the store is unchanged",
        )


def _held(active: Sequence[StoredFile], recordings: Collection[str]) -> list[str]:
    """Return where the ingests of these recordings that the files hold have written their own."""
    return [
        own_path(one.recording_id, one.ingest_id)
        for file in active
        for one in file.ingests
        if one.recording_id in recordings
    ]


def _turns(table: DeltaTable, recordings: Sequence[str]) -> list[Transaction]:
    """Return transaction ids that let one writer at a time change each of these recordings."""
    return [
        Transaction(app, (table.transaction_version(app) or 0) + 1)
        for app in (f"restock/{recording}" for recording in recordings)
    ]


def recording_columns() -> pa.Schema:
    """Return the columns of `recordings`: the manifest's, and the summary's."""
    return pa.schema([*recording_schema(), *SUMMARY_SCHEMA])


def delta_columns(schema: pa.Schema) -> pa.Schema:
    """Replace lists of fixed size, which Delta does not know, by plain lists."""
    return pa.schema(
        [
            field.with_type(pa.list_(field.type.value_type))
            if pa.types.is_fixed_size_list(field.type)
            else field
            for field in schema
        ]
    )


def plain_lists(rows: pa.Table) -> pa.Table:
    """Return the rows with `delta_columns`; the lists' values stay in their memory."""
    schema = delta_columns(rows.schema).with_metadata(rows.schema.metadata)
    columns = []
    for field, column in zip(schema, rows.columns, strict=True):
        if pa.types.is_fixed_size_list(column.type) and not column.null_count:
            column = pa.chunked_array([_plain(c, field.type) for c in column.chunks], field.type)
        columns.append(column)
    return pa.table(columns, schema=schema)


def _plain(lists: pa.FixedSizeListArray, kind: pa.DataType) -> pa.ListArray:
    size = lists.type.list_size
    offsets = pa.array(np.arange(len(lists) + 1) * size, pa.int32())
    return pa.ListArray.from_arrays(offsets, lists.flatten(), type=kind)
