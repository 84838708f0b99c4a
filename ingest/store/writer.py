"""The store, for writing: two Delta tables of plain Parquet, and commits that are atomic.

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
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from deltalake.exceptions import DeltaError

from restock.errors import StoreError
from restock.ingest.store.commits import (
    AddedFile,
    TableCommits,
    delta_columns,
    parquet_options,
    plain_lists,
    recording_columns,
    written_whole,
)
from restock.ingest.store.lineage import frame_files, own_path, stored_files
from restock.ingest.store.location import FRAMES, RECORDINGS, TRANSITIONS, Location
from restock.ingest.store.summary import (
    UNREADABLE,
    Hashes,
    RepeatedDrive,
    Sketch,
    find_repeat,
    summarised,
)
from restock.ingest.task.schema import frame_schema

# Files that no version of a table needs are kept this long: a writer may be about to commit them,
# and a reader that opened an older version may be about to read them.
RETENTION_HOURS = 7 * 24
ROW_GROUP_ROWS = 32_768


@dataclass(frozen=True)
class Staged:
    """A recording whose files are written and in no commit yet."""

    recording_id: str
    ingest_id: str
    manifest: AddedFile
    rows: AddedFile  # of `transitions`
    columns: pa.Schema  # of `transitions`
    contents: Hashes  # of its distinctive rows, (N,) ascending
    instead_of: str | None = None  # the ingest that was read to make it, if one was


class StoreWriter(TableCommits):
    """Writes recordings to a store, which is made when the first one is written."""

    def __init__(self, path: str | Path | Location) -> None:
        super().__init__(path)
        self._fitting: list[pa.Schema] = []  # columns that its tables are known to have
        self._reached = False

    def repeated(
        self,
        recording: Staged,
        period_s: float,
        *,
        ahead: Sequence[Staged] = (),
        aside: Collection[str] = (),
    ) -> RepeatedDrive | None:
        """Return the recording that holds most of one's rows under other ids, if one largely does.

        `period_s` is the control period: rows further apart than half of it do not count. Those
        `ahead` of it are looked at as if they were in the store, ingests `aside` are not.
        """
        shown = self.shown() if self.path.has_table(TRANSITIONS) else []
        others = [one for one in shown if one.ingest_id not in aside]
        sketches = [
            *self.sketches([one for one in others if one.recording_id != recording.recording_id]),
            *(Sketch.of(one.recording_id, one.ingest_id, one.contents) for one in ahead),
        ]
        own = recording.recording_id, recording.ingest_id
        return find_repeat(
            recording.contents, lambda: self.rows(*own), sketches, self.rows, period_s
        )

    def write_frames(self, path: str, batches: Iterable[pa.RecordBatch]) -> int:
        """Write a recording's frames to a file of `frames`; returns how many they are.

        No manifest names it yet: `discard_frames` where none will.

        Raises:
            StoreError: it cannot be written.
        """
        count = 0
        with (
            written_whole(self.path, f"{FRAMES}/{path}"),
            self.path.writing(f"{FRAMES}/{path}") as sink,
            pq.ParquetWriter(
                sink, frame_schema(), compression="zstd", write_page_checksum=True
            ) as writer,
        ):
            for batch in batches:
                writer.write_batch(batch)
                count += len(batch)
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
        staged: list[Staged] = []
        try:
            for manifest, rows in recordings:
                staged.append(self.stage(manifest, rows))
                self.fit(staged[-1:])
        except BaseException:  # no commit has begun, so they are not needed
            self.discard(staged)
            raise
        try:
            return self._commit_files(staged, instead_of or {})
        except BaseException:
            self.take_back(staged)
            raise

    def stage(self, manifest: pa.Table, rows: pa.Table, *, instead_of: str | None = None) -> Staged:
        """Write the files of a recording, of which nothing shows before `commit_staged`.

        Raises:
            StoreError: they cannot be written.
        """
        self.expect_folder()
        if not self._reached:
            self.reach()  # Delta's library says of S3 what is wrong; Arrow's writer says less
            self._reached = True
        ids = manifest["recording_id"][0].as_py(), manifest["ingest_id"][0].as_py()
        manifest = summarised(manifest, rows)
        contents = manifest["distinctive_rows"].combine_chunks().flatten().field("content")
        staged = Staged(
            *ids,
            AddedFile(ids[0], own_path(*ids), len(manifest)),
            AddedFile(ids[0], own_path(*ids), len(rows)),
            delta_columns(rows.schema).remove_metadata(),
            np.sort(contents.to_numpy().view(np.uint64)),
            instead_of,
        )
        try:
            staged.manifest.size = self._write(manifest, f"{RECORDINGS}/{staged.manifest.path}")
            staged.rows.size = self._write(rows, f"{TRANSITIONS}/{staged.rows.path}")
        except BaseException:
            self.discard([staged])
            raise
        return staged

    def commit_staged(self, staged: Sequence[Staged]) -> int:
        """Commit recordings that the tables `fit`, each of them once, together: all or none.

        Returns the version of `transitions` that has them.

        Raises:
            StoreError: what one was to replace has changed, other writers were faster too many
                times, or the tables cannot be written. `take_back` what is not to be tried again.
        """
        pa.default_memory_pool().release_unused()
        read = {one.recording_id: one.instead_of for one in staged if one.instead_of}
        version = self._commit_files(staged, read)
        for one in staged:
            self.remember(one.recording_id, one.ingest_id, one.contents)
        return version

    def _commit_files(self, staged: Sequence[Staged], instead_of: Mapping[str, str]) -> int:
        self.commit(RECORDINGS, [one.manifest for one in staged], instead_of)
        version, replaced = self.commit(TRANSITIONS, [one.rows for one in staged], instead_of)
        with suppress(StoreError):  # the rows are there: what joins nothing, `clean` removes
            self.remove(RECORDINGS, replaced)
        return version

    def remove_recordings(self, ingests: Mapping[str, str], operation: str) -> tuple[int, int]:
        """Take recordings out of the store in one commit, by their ingests (recording -> ingest).

        Their files stay for as long as those of replaced ones.

        Returns the version of `transitions` that they were read from, and the newest, without
        them.

        Raises:
            StoreError: one was ingested again or removed in the meantime, or other writers were
                faster too many times. The store is as it was.
        """
        versions = self.take_out(ingests, operation)
        self.remove(RECORDINGS, {own_path(*ids) for ids in ingests.items()})
        return versions

    def fit(self, staged: Sequence[Staged]) -> None:
        """See that the tables are there, and have the columns of these recordings.

        Raises:
            StoreError: they cannot be written, or have other columns by these names.
        """
        for one in staged:
            if one.columns not in self._fitting:
                self.create(RECORDINGS, recording_columns())
                self.create(TRANSITIONS, one.columns)
                self._fitting.append(one.columns)

    def discard(self, staged: Sequence[Staged]) -> None:
        """Delete the files of recordings whose commit has not begun, with their frames."""
        with suppress(OSError, StoreError):
            for name, files in (
                (RECORDINGS, [one.manifest for one in staged]),
                (TRANSITIONS, [one.rows for one in staged]),
                (FRAMES, [one.rows for one in staged]),
            ):
                self.path.delete(f"{name}/{file.path}" for file in files)

    def take_back(self, staged: Sequence[Staged]) -> None:
        """Delete the files of recordings whose commit failed or was interrupted.

        That is as far as possible, and only of those whose rows are in no commit.

        On S3 nothing is: a commit whose answer was lost may be there later. `clean` deletes what
        is left when it is older than its window.
        """
        if self.path.folder is None:
            return
        with suppress(OSError, StoreError, DeltaError):
            there = {one.ingest_id for one in self.shown()}
            gone = [one for one in staged if one.ingest_id not in there]
            # Rows first: on a full disk they give back the room to take the manifests out.
            self.discard_uncommitted(TRANSITIONS, [one.rows for one in gone])
            self.remove(RECORDINGS, {one.manifest.path for one in gone})
            self.discard(gone)

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
            stale = sorted(set(unneeded) & self._written_before(name, retention_hours))
            deleted += [f"{name}/{file}" for file in stale]
        # Without commits of its own: cleaning changes no version of a table.
        self.path.delete(deleted)
        frames = self._unnamed_frames(retention_hours)
        self.path.delete(frames)
        return deleted + frames

    def _written_before(self, name: str, retention_hours: int) -> set[str]:
        """Return the files in a folder that are older than the window.

        A manifest may be younger than its removal in the log: compaction writes it again where a
        version within the window needs it.
        """
        before_s = time.time() - retention_hours * 3600
        return {path for path, at_s in self.path.times(name).items() if at_s <= before_s}

    def _unnamed_frames(self, retention_hours: int) -> list[str]:
        """Files of frames older than the window that no manifest names, removed ones included."""
        found = self._written_before(FRAMES, retention_hours)
        if not found:
            return []
        for path in self.path.listing(RECORDINGS):
            if path.endswith(".parquet"):
                try:
                    reported = self.path.read(f"{RECORDINGS}/{path}", columns=["cameras"])
                except UNREADABLE:
                    return []  # which frames it names is not known
                found -= set(frame_files(reported))
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
            # A joined file was of recordings that were there: versions before need it still.
            if file.own
            and file.added_ms < before_ms
            and not shown & {one.ingest_id for one in file.ingests}
        ]

    def _write(self, rows: pa.Table, path: str) -> int:
        """Write a Parquet file; returns its size in bytes.

        Lists of fixed size become plain lists, which every engine that knows Delta reads.
        """
        rows = plain_lists(rows)
        options = parquet_options(rows.schema)
        with written_whole(self.path, path):
            size = self.path.write(rows, path, row_group_size=ROW_GROUP_ROWS, **options)
        # What encoding took, tens of MB: Arrow would keep it, and a commit takes as much again.
        pa.default_memory_pool().release_unused()
        return size
