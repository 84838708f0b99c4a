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

import time
from collections.abc import Iterable, Mapping
from contextlib import suppress

import pyarrow as pa
import pyarrow.parquet as pq

from restock.errors import StoreError
from restock.files import first_line
from restock.ingest.store.commits import TableCommits, delta_columns, recording_columns
from restock.ingest.store.data_files import AddedFile, parquet_options
from restock.ingest.store.lineage import own_path, stored_files
from restock.ingest.store.location import FRAMES, RECORDINGS, TRANSITIONS
from restock.ingest.store.reader import frame_files
from restock.ingest.store.summary import summarised
from restock.ingest.task.schema import frame_schema

# Files that no version of a table needs are kept this long: a writer may be about to commit them,
# and a reader that opened an older version may be about to read them.
RETENTION_HOURS = 7 * 24
ROW_GROUP_ROWS = 32_768


class StoreWriter(TableCommits):
    """Writes recordings to a store, which is made when the first one is written."""

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
                self.allow_nulls(rows)
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
        self.commit(RECORDINGS, manifests, instead_of or {})
        version, replaced = self.commit(TRANSITIONS, transitions, instead_of or {})
        self.remove(RECORDINGS, replaced)
        return version

    def clean(self, retention_hours: int = RETENTION_HOURS) -> list[str]:
        """Delete files that no version within the retention window needs; returns their paths.

        They are what killed writers left, and what replaced recordings had. The window must be
        longer than any writer takes from its first file to its last commit.
        """
        deleted = []
        self.remove(RECORDINGS, self._abandoned(retention_hours))
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
