"""The store, for writing: two Delta tables of plain Parquet, one atomic commit a recording.

`recordings` holds one manifest row an ingest, `transitions` the rows; `ingest_id` joins them, and
both files of an ingest have the same name in their tables. The manifest is committed first and the
transitions second, so an ingest that is cut between the two is a manifest that joins nothing, and
a reader sees each recording whole or not at all. A recording that is ingested again replaces its
old rows in the same commit that adds the new ones; the manifests of what was replaced go last, by
the writer that replaced it. A manifest that joins nothing yet is removed by its age only: another
writer may be about to commit its transitions. Files outlive their removal by the same window, so
that who opened a version before can read it: its manifests too, by the names of its rows' files.

Frames of cameras are plain Parquet, a file an ingest, in `frames`: written before both commits, and
there for whom a manifest names them to. A file lives for as long as a manifest that names it.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

import pyarrow as pa
import pyarrow.parquet as pq
from deltalake import CommitProperties, DeltaTable, Schema, Transaction
from deltalake.exceptions import CommitFailedError, DeltaError
from deltalake.transaction import AddAction, RemoveAction

from restock.errors import StoreError
from restock.files import first_line
from restock.ingest.store.data_files import AddedFile, add_action, parquet_options, rewrite
from restock.ingest.store.lineage import READERS, Ingest, StoredFile, own_path, stored_files
from restock.ingest.store.location import Location
from restock.ingest.store.repeated import (
    SKETCH,
    UNREADABLE,
    RepeatedDrive,
    Sketch,
    find_repeat,
    read_sketch,
)
from restock.ingest.store.summary import SUMMARY_SCHEMA, summarised, with_ends
from restock.ingest.store.version import Version
from restock.ingest.task.schema import frame_schema, recording_schema
from restock.ingest.task.signals import LIDAR_SIGNALS

TRANSITIONS, RECORDINGS, FRAMES = "transitions", "recordings", "frames"
ATTEMPTS = 12  # at a commit, when other writers are faster; Delta's library tries 15 times in each
# Files that no version of a table needs are kept this long: a writer may be about to commit them,
# and a reader that opened an older version may be about to read them.
RETENTION_HOURS = 7 * 24
ROW_GROUP_ROWS = 32_768
CHECKPOINT_COMMITS = 20  # a reader of the log opens at most so many files
_JITTER = random.SystemRandom()
_SKETCHES: dict[tuple[Location, str], Sketch] = {}  # by ingest, which never changes; 2 kB each
T = TypeVar("T")


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
        schema = recording_schema()
        if not self.path.has_table(TRANSITIONS):
            return schema.empty_table()
        shown = self.shown(version)
        return self.manifests(
            [one for one in shown if recording_id in (None, one.recording_id)], schema
        )

    def manifests(
        self,
        ingests: Sequence[Ingest],
        schema: pa.Schema,
        *,
        skip: tuple[type[Exception], ...] = (),
    ) -> pa.Table:
        """These columns of the manifests of ingests; null where an older store has them not.

        A file at which one of `skip` is raised is left out.
        """
        parts = [schema.empty_table()]
        if ingests:
            at = {
                one.ingest_id: file.path for file in self.files(RECORDINGS) for one in file.ingests
            }
            paths = {
                at.get(one.ingest_id, own_path(one.recording_id, one.ingest_id)): None
                for one in ingests
            }

            def read(path: str) -> pa.Table:
                with suppress(*skip):
                    part = self.path.read(f"{RECORDINGS}/{path}", columns=schema.names)
                    return _with_sketch(part) if "sketch" in schema.names else part
                return schema.empty_table()

            with ThreadPoolExecutor(READERS) as pool:
                parts += pool.map(read, paths)
        import pyarrow.compute as pc  # slow to import

        wanted = pa.array([one.ingest_id for one in ingests], pa.string())
        found = pa.concat_tables(
            [part.replace_schema_metadata(None) for part in parts], promote_options="default"
        )
        return found.filter(pc.is_in(found["ingest_id"], wanted)).combine_chunks()

    def rows(self, recording_id: str, ingest_id: str) -> pa.Table:
        """One recording's transitions, as they were written."""
        with suppress(FileNotFoundError):
            return self.path.read(f"{TRANSITIONS}/{own_path(recording_id, ingest_id)}")
        import pyarrow.compute as pc  # slow to import

        parts = [
            self.path.read(f"{TRANSITIONS}/{file.path}", where=pc.field("ingest_id") == ingest_id)
            for file in self.files(TRANSITIONS)
            if ingest_id in {one.ingest_id for one in file.ingests}
        ]
        if not parts:
            raise FileNotFoundError(own_path(recording_id, ingest_id))
        rows = pa.concat_tables(parts, promote_options="default").sort_by("transition_id")
        told = self._packed_ends([Ingest(recording_id, ingest_id, len(rows))])
        return with_ends(rows, told.get(ingest_id))

    def ends(self, ingests: Sequence[Ingest]) -> Iterator[tuple[str, pa.Table]]:
        """The recording of each of these ingests and the ends of its episodes, as `episode_ends`
        gives them; without those that have none."""
        from restock.ingest.store.episode_rows import episode_ends

        told = self._packed_ends(ingests)
        for one in ingests:
            bare = with_ends(pa.table({}), told.get(one.ingest_id))
            if not told.get(one.ingest_id):
                with suppress(FileNotFoundError):  # of an older store they lie with its rows
                    path = own_path(one.recording_id, one.ingest_id)
                    bare = self.path.read_schema(f"{TRANSITIONS}/{path}").empty_table()
            ends = episode_ends(bare)
            if ends is not None:
                yield one.recording_id, ends

    def _packed_ends(self, ingests: Sequence[Ingest]) -> dict[str, str | None]:
        """What manifests keep of the ends of episodes, by ingest."""
        schema = pa.schema([("ingest_id", pa.string()), ("packed_ends", pa.string())])
        told = self.manifests(ingests, schema)
        return dict(zip(*(told[name].to_pylist() for name in schema.names), strict=True))

    def files(self, name: str, version: Version | None = None) -> list[StoredFile]:
        """The active files of one of its tables, and which ingests they hold."""
        return stored_files(self.path, name, self.path.open_table(name, version))

    def shown(self, version: Version | None = None) -> list[Ingest]:
        """The ingests whose transitions are in the store."""
        held = [one for file in self.files(TRANSITIONS, version) for one in file.ingests]
        return list({one.ingest_id: one for one in held}.values())

    def repeated(self, rows: pa.Table, period_s: float) -> RepeatedDrive | None:
        """The recording that holds most of these rows under other ids, if one largely does.

        `period_s` is the control period: rows further apart than half of it do not count.
        Recordings that older software wrote are not looked at; the audit `repeated_steps` does.
        """
        if not self.path.has_table(TRANSITIONS):
            return None
        own = rows["recording_id"][0].as_py()
        others = [one for one in self.shown() if one.recording_id != own]
        return find_repeat(rows, self._sketches(others), self.rows, period_s)

    def _sketches(self, ingests: Sequence[Ingest]) -> list[Sketch]:
        """Their sketches, each read once: many recordings would read all others' as many times."""
        names = ("recording_id", "ingest_id", "sketch")
        schema = pa.schema([(name, pa.string()) for name in names])
        new = [one for one in ingests if (self.path, one.ingest_id) not in _SKETCHES]
        # What cannot be read is another recording's, which `restock sql` reports.
        for told in self.manifests(new, schema, skip=UNREADABLE).to_pylist():
            hashes = read_sketch({SKETCH: (told["sketch"] or "").encode()})
            sketch = Sketch(told["recording_id"], told["ingest_id"], hashes)
            _SKETCHES[self.path, sketch.ingest_id] = sketch
        keys = [(self.path, one.ingest_id) for one in ingests]
        return [_SKETCHES[key] for key in keys if key in _SKETCHES]

    def write_frames(self, path: str, batches: Iterable[pa.RecordBatch]) -> int:
        """Write a recording's frames to a file of `frames`; returns how many they are.

        No manifest names it yet: `discard_frames` where none will.

        Raises:
            StoreError: it cannot be written.
        """
        count = 0
        try:
            with (
                self.path.writing(f"{FRAMES}/{path}") as sink,
                pq.ParquetWriter(sink, frame_schema(), compression="zstd") as writer,
            ):
                for batch in batches:
                    writer.write_batch(batch)
                    count += len(batch)
        except BaseException as error:
            self.discard_frames(path)
            if isinstance(error, OSError):
                raise StoreError(
                    f"cannot be written: {first_line(error)}", where=str(self.path)
                ) from error
            raise
        return count

    def discard_frames(self, path: str) -> None:
        """Delete a file of frames that no manifest names."""
        with suppress(OSError, StoreError):
            self.path.delete([f"{FRAMES}/{path}"])

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
        manifests: list[AddedFile] = []
        transitions: list[AddedFile] = []
        created: tuple[pa.Schema, ...] = ()
        try:
            for manifest, rows in recordings:
                recording_id = manifest["recording_id"][0].as_py()
                name = own_path(recording_id, manifest["ingest_id"][0].as_py())
                manifest = summarised(manifest, rows)
                schemas = recording_columns(), delta_columns(rows.schema)
                if schemas != created:
                    self.create(RECORDINGS, schemas[0])
                    self.create(TRANSITIONS, schemas[1])
                    created = schemas
                self._allow_nulls(rows)
                for table, what, added in (
                    (manifest, RECORDINGS, manifests),
                    (rows, TRANSITIONS, transitions),
                ):
                    added.append(AddedFile(recording_id, name, len(table)))
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
        frames = self._unnamed_frames(retention_hours)
        self.path.delete(frames)
        return deleted + frames

    def _unnamed_frames(self, retention_hours: int) -> list[str]:
        """Files of frames older than the window that no manifest names, removed ones included."""
        before_s = time.time() - retention_hours * 3600
        found = {path for path, at_s in self.path.times(FRAMES).items() if at_s < before_s}
        if not found:
            return []
        for path in self.path.listing(RECORDINGS):
            if path.endswith(".parquet"):
                told = self.path.read(f"{RECORDINGS}/{path}", columns=["cameras"])
                found -= set(frame_files(told))
        return [f"{FRAMES}/{path}" for path in sorted(found)]

    def _abandoned(self, retention_hours: int) -> list[str]:
        """Manifests that join nothing, and are too old for a writer to be on its way to commit."""
        if not self.path.has_table(RECORDINGS) or not self.path.has_table(TRANSITIONS):
            return []
        manifests = self.path.open_table(RECORDINGS)  # before the transitions that may join them
        shown = {one.ingest_id for one in self.shown()}
        before_ms = (time.time() - retention_hours * 3600) * 1000
        return [
            file.path
            for file in stored_files(self.path, RECORDINGS, manifests)
            if file.added_ms < before_ms and not shown & {one.ingest_id for one in file.ingests}
        ]

    def _write(self, rows: pa.Table, path: str) -> int:
        """Write a Parquet file; returns its size in bytes.

        Lists of fixed size become plain lists, which every engine that knows Delta reads.
        """
        rows = rows.cast(delta_columns(rows.schema).with_metadata(rows.schema.metadata))
        try:
            options = parquet_options(rows.schema)
            return self.path.write(rows, path, row_group_size=ROW_GROUP_ROWS, **options)
        except OSError as error:
            raise StoreError(
                f"cannot be written: {first_line(error)}", where=str(self.path)
            ) from error

    def create(self, name: str, schema: pa.Schema) -> None:
        """See that there is a table with these columns.

        Columns that newer software writes are added; rows from before hold null in them.
        """
        if self.path.folder is not None and self.path.folder.is_file():
            raise StoreError("is a file, not a store", where=str(self.path), remedy="name a folder")

        from restock.ingest.profile.custom_signal import refuse_other_signals

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

        self.again_on_conflict(create)

    def _allow_nulls(self, rows: pa.Table) -> None:
        """Let signals be null where they are in these rows: in a store of an older Restock the
        clearance of a robot without a lidar was a number."""
        names = [name for name in sorted(LIDAR_SIGNALS) if name in rows.column_names]
        names = [name for name in names if rows[name].null_count]

        def allow() -> None:
            table = self.path.open_table(TRANSITIONS)
            strict = {field.name for field in table.schema().fields if not field.nullable}
            for name in names:
                if name in strict:
                    table.alter.drop_column_not_null(name)

        if names:
            self.again_on_conflict(allow)

    def _commit(
        self, name: str, added: Sequence[AddedFile], instead_of: Mapping[str, str]
    ) -> tuple[int, list[str]]:
        """Add files, all or nothing; to `transitions`, remove the same recordings' others with it.

        Returns the table's version and the files removed from it.
        """
        recordings = sorted({file.recording_id for file in added})
        replaced: list[str] = []

        def commit() -> int:
            table = self.path.open_table(name)
            active = stored_files(self.path, name, table)
            if {file.path for file in added} <= {file.path for file in active}:
                return table.version()  # by the attempt before, whose answer was lost
            self._still(instead_of)
            now_ms = time.time_ns() // 1_000_000
            actions: list[AddAction | RemoveAction] = [add_action(f, now_ms) for f in added]
            turns = []
            if name == TRANSITIONS:
                replaced.clear()
                for file in active:
                    gone = [one for one in file.ingests if one.recording_id in recordings]
                    if not gone:
                        continue
                    replaced.extend(own_path(one.recording_id, one.ingest_id) for one in gone)
                    actions.append(RemoveAction(file.path, True, now_ms))
                    kept = [one for one in file.ingests if one.recording_id not in recordings]
                    if kept:
                        actions.append(add_action(rewrite(self.path, file, kept), now_ms))
                # Two first ingests of one recording add without removing, which is no conflict by
                # itself: the transaction id makes it one.
                turns = [
                    Transaction(app, (table.transaction_version(app) or 0) + 1)
                    for app in (f"restock/{recording}" for recording in recordings)
                ]
            self.transact(table, actions, turns)
            table.update_incremental()
            return table.version()

        return self.again_on_conflict(commit), replaced

    def _remove(self, name: str, paths: Collection[str]) -> None:
        """Take files out of a table, those that are still in it."""

        def commit() -> None:
            table = self.path.open_table(name)
            now_ms = time.time_ns() // 1_000_000
            actions = [
                RemoveAction(file.path, True, now_ms)
                for file in stored_files(self.path, name, table)
                if file.path in paths
            ]
            if actions:
                self.transact(table, actions, [])

        if paths:
            self.again_on_conflict(commit)

    def transact(
        self,
        table: DeltaTable,
        actions: Sequence[AddAction | RemoveAction],
        turns: Sequence[Transaction],
        operation: str = "restock ingest",
    ) -> None:
        """Commit to a table. Raises CommitFailedError where another writer was faster."""
        table.create_write_transaction(
            list(actions),
            mode="append",
            schema=table.schema(),
            commit_properties=CommitProperties(
                custom_metadata={"operation_name": operation}, app_transactions=list(turns)
            ),
        )

    def _still(self, instead_of: Mapping[str, str]) -> None:
        """Check that these ingests are the ones in the store."""
        if not instead_of:
            return
        shown = {one.recording_id: one.ingest_id for one in self.shown()}
        for recording, ingest in instead_of.items():
            if shown.get(recording) != ingest:
                raise StoreError(
                    f"recording {recording} was ingested again meanwhile",
                    where=str(self.path),
                    remedy="try again; the store is as that ingest left it",
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
                raise StoreError(
                    f"cannot be written: {first_line(error)}", where=str(self.path)
                ) from error
        raise StoreError(
            f"other writers were faster {ATTEMPTS} times: {first_line(conflict)}",
            where=str(self.path),
            remedy="try again when they are done; the store is as it was",
        )


def recording_columns() -> pa.Schema:
    """The columns of `recordings`: the manifest's, and the summary's."""
    return pa.schema([*recording_schema(), *SUMMARY_SCHEMA])


def frame_files(manifests: pa.Table) -> list[str]:
    """The files of `frames` that manifests name."""
    rows = manifests["cameras"].to_pylist() if "cameras" in manifests.column_names else []
    return sorted({camera["file"] for cameras in rows for camera in cameras or ()} - {""})


def _with_sketch(manifests: pa.Table) -> pa.Table:
    """Manifests of an earlier version have their sketch in their metadata."""
    said = (manifests.schema.metadata or {}).get(SKETCH)
    if said and "sketch" not in manifests.column_names:
        manifests = manifests.append_column("sketch", pa.array([said.decode()] * len(manifests)))
    return manifests


def delta_columns(schema: pa.Schema) -> pa.Schema:
    """The same columns without lists of fixed size, which Delta does not know."""
    return pa.schema(
        [
            field.with_type(pa.list_(field.type.value_type))
            if pa.types.is_fixed_size_list(field.type)
            else field
            for field in schema
        ]
    )
