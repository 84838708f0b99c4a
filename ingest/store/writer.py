"""Write recordings to a store: two Delta tables of plain Parquet with atomic commits.

`recordings` has one manifest row per ingest, `transitions` has the rows; `ingest_id` joins them.
The two files of an ingest have the same name, unless many recordings of a commit share one file of
manifests. The manifest is committed first and the transitions second. An ingest that is killed in
between leaves a manifest without rows, so a reader sees each recording whole or not at all. If a
recording is ingested again, one commit removes its old rows and adds the new ones; the same writer
then removes the old manifest. A manifest without rows is removed only when it is old enough:
another writer may be about to commit its transitions. Removed files are deleted after the same
retention window. Until then a reader that opened an older version can read it, and finds its
manifests by the names of its rows' files.

Camera frames are plain Parquet in `frames`, one file per ingest, written before both commits. A
frame file is kept as long as a manifest names it.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
from deltalake.exceptions import DeltaError

from restock.errors import StoreError
from restock.ingest.store.commits import (
    ATTEMPTS,
    AddedFile,
    TableCommits,
    delta_columns,
    merge,
    parquet_options,
    plain_lists,
    recording_columns,
    written_whole,
)
from restock.ingest.store.lineage import (
    Ingest,
    StoredFile,
    changed_by_others,
    frame_files,
    own_path,
)
from restock.ingest.store.location import FRAMES, RECORDINGS, TRANSITIONS, Location
from restock.ingest.store.summary import (
    UNREADABLE,
    Hashes,
    RepeatedDrive,
    compare,
    contents_of,
    summarised,
)
from restock.ingest.task.schema import frame_schema, recording_schema

# Files that no version of a table needs are kept this long: a writer may be about to commit them,
# and a reader that opened an older version may be about to read them.
RETENTION_HOURS = 7 * 24
ROW_GROUP_ROWS = 32_768


@dataclass(frozen=True)
class Staged:
    """A recording whose rows are written but not yet committed."""

    recording_id: str
    ingest_id: str
    manifest: pa.Table  # the row for `recordings`, with its summary
    rows: AddedFile  # the recording's file in `transitions`
    columns: pa.Schema  # the columns of that file
    contents: Hashes  # hashes of its distinctive rows, (N,) ascending
    instead_of: str | None = None  # the ingest that these rows were made from and replace, if any


class StoreWriter(TableCommits):
    """Writer of a store; creates the store with the first recording."""

    def __init__(self, path: str | Path | Location) -> None:
        super().__init__(path)
        self.path.expect_newest()
        self._fitting: list[pa.Schema] = []  # schemas whose columns the tables are known to have
        self._reached = False

    def repeated(
        self, recording: Staged, *, ahead: Sequence[Staged] = (), aside: Collection[str] = ()
    ) -> RepeatedDrive | None:
        """Return the stored recording that repeats most of this one's rows, or None.

        Recordings in `ahead`, staged before this one, are compared too, but no ingests in `aside`.
        """
        others = [
            one
            for one in self.shown()
            if one.ingest_id not in aside and one.recording_id != recording.recording_id
        ]
        manifests = [
            *self.similar(recording.contents, others),
            *(one.manifest for one in ahead),
        ]
        found = (compare(recording.contents, recording.rows.rows, one) for one in manifests)
        return max(
            (repeat for repeat in found if repeat is not None),
            key=lambda repeat: (repeat.rows, repeat.recording_id),
            default=None,
        )

    def write_frames(self, path: str, batches: Iterable[pa.RecordBatch]) -> int:
        """Write a recording's frames to a file of `frames`; return the number of frames.

        If the manifest that names the file is not committed, call `discard_frames`.

        Raises:
            StoreError: the file cannot be written.
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
        """Delete a frame file that no manifest names."""
        with suppress(OSError, StoreError):
            self.path.delete([f"{FRAMES}/{path}"])

    def write(self, manifest: pa.Table, rows: pa.Table) -> int:
        """Write one recording's manifest row and transitions, replacing its old ones.

        Returns the version of `transitions` that has them.

        Raises:
            StoreError: the path is not a store, or other writers were faster too many times.
        """
        return self.write_all([(manifest, rows)])

    def write_all(
        self,
        recordings: Iterable[tuple[pa.Table, pa.Table]],
        *,
        instead_of: Mapping[str, str] | None = None,
    ) -> int:
        """Write several recordings, as (manifest row, transitions), in one commit.

        `instead_of` maps recordings to the ingest that their new rows were made from: if another
        writer has replaced one of these ingests since, nothing is written.

        Raises:
            StoreError: as `write`, or another writer has replaced or removed one of the recordings.
        """
        staged: list[Staged] = []
        try:
            for manifest, rows in recordings:
                made_from = (instead_of or {}).get(manifest["recording_id"][0].as_py())
                staged.append(self.stage(manifest, rows, instead_of=made_from))
                self.fit(staged[-1:])
        except BaseException:  # no commit has begun, so no table needs the files
            self.discard(staged)
            raise
        try:
            return self.commit_staged(staged)
        except BaseException:
            self.take_back(staged)
            raise

    def stage(self, manifest: pa.Table, rows: pa.Table, *, instead_of: str | None = None) -> Staged:
        """Write a recording's rows to a file; readers do not see them before `commit_staged`.

        A summary is added to the manifest row, unless it has one already.

        Raises:
            StoreError: the file cannot be written.
        """
        self.expect_folder()
        if not self._reached:
            self.reach()  # before the write: Delta's library explains S3 errors better than Arrow
            self._reached = True
        ids = manifest["recording_id"][0].as_py(), manifest["ingest_id"][0].as_py()
        if "distinctive_rows" not in manifest.column_names:
            manifest = summarised(manifest, rows)
        staged = Staged(
            *ids,
            manifest,
            AddedFile(ids[0], own_path(*ids), len(rows)),
            delta_columns(rows.schema).remove_metadata(),
            contents_of(manifest),
            instead_of,
        )
        try:
            staged.rows.size = self._write(rows, f"{TRANSITIONS}/{staged.rows.path}")
        except BaseException:
            self.discard([staged])
            raise
        return staged

    def commit_staged(self, staged: Sequence[Staged]) -> int:
        """Commit staged recordings, all or none. They must differ, and must have passed `fit`.

        Returns the version of `transitions` that has them.

        Raises:
            StoreError: an ingest to be replaced has changed, other writers were faster too many
                times, or the tables cannot be written. Call `take_back` if you will not try again.
        """
        pa.default_memory_pool().release_unused()
        instead_of = {one.recording_id: one.instead_of for one in staged if one.instead_of}
        self._commit_manifests(staged, instead_of)
        done = self.commit(TRANSITIONS, [one.rows for one in staged], instead_of)
        with suppress(StoreError):  # the rows are committed; `clean` removes manifests without rows
            self.remove(RECORDINGS, done.replaced)
        for one in staged:
            self.remember(one.ingest_id, one.contents)
        return done.version

    def _commit_manifests(self, staged: Sequence[Staged], instead_of: Mapping[str, str]) -> None:
        """Write and commit the manifests that are not in `recordings` yet.

        An earlier attempt that failed may have committed some. MIN_JOINED manifests or more become
        one file, which stays in the table even if some of its recordings cannot be committed.
        """
        held = self._listing(RECORDINGS).paths
        new = [one for one in staged if one.ingest_id not in held]
        made: list[AddedFile] = []
        with self.discarded_on_failure(RECORDINGS, made):
            if len(new) >= MIN_JOINED:
                rows, schema = [one.manifest for one in new], delta_columns(recording_columns())
                made.append(merge(self.path, RECORDINGS, [], [], schema, extra=rows))
            for one in new if not made else ():
                made.append(AddedFile(one.recording_id, one.rows.path, len(one.manifest)))
                made[-1].size = self._write(one.manifest, f"{RECORDINGS}/{one.rows.path}")
            if made:
                self.commit(RECORDINGS, made, instead_of)

    def remove_recordings(self, ingests: Mapping[str, str], operation: str) -> tuple[int, int]:
        """Remove recordings from the store in one commit; `ingests` maps recording to ingest.

        Their files are kept as long as those of replaced recordings.

        Returns the last version of `transitions` that has them, and the new version without them.

        Raises:
            StoreError: a recording was ingested again or removed in the meantime, or other writers
                were faster too many times. The store is unchanged.
        """
        done = self.commit(TRANSITIONS, [], ingests, operation)
        self.remove(RECORDINGS, {own_path(*ids) for ids in ingests.items()})
        return done.before, done.version

    def fit(self, staged: Sequence[Staged]) -> None:
        """Ensure that the tables exist and have the columns of these recordings.

        Raises:
            StoreError: a table cannot be written, or has a column of the same name, but other type.
        """
        for one in staged:
            if one.columns not in self._fitting:
                self.create(RECORDINGS, recording_columns())
                self.create(TRANSITIONS, one.columns)
                self._fitting.append(one.columns)

    def discard(self, staged: Sequence[Staged]) -> None:
        """Delete the files of recordings whose commit has not begun, including their frames."""
        with suppress(OSError, StoreError):
            for name in (RECORDINGS, TRANSITIONS, FRAMES):
                self.path.delete(f"{name}/{one.rows.path}" for one in staged)

    def take_back(self, staged: Sequence[Staged]) -> None:
        """Delete the files of recordings whose commit failed or was interrupted, where possible.

        Recordings whose rows were committed after all are left alone.

        On S3 nothing is deleted: a commit without an answer may still appear later. `clean`
        deletes the files when they are older than its retention window.
        """
        if self.path.folder is None:
            return
        with suppress(OSError, StoreError, DeltaError):
            there = {one.ingest_id for one in self.shown()}
            gone = [one for one in staged if one.ingest_id not in there]
            # Rows first: on a full disk this frees the space to commit the removal of manifests.
            self.discard_uncommitted(TRANSITIONS, [one.rows for one in gone])
            ids = {(one.recording_id, one.ingest_id) for one in gone}
            manifests = [file for file in self.files(RECORDINGS) if file.ingests]
            useless = [f.path for f in manifests if ids.issuperset(i[:2] for i in f.ingests)]
            self.remove(RECORDINGS, useless)
            self.discard(gone)

    def clean(self, retention_hours: int = RETENTION_HOURS) -> list[str]:
        """Delete files that no version within the retention window needs; return their paths.

        These are files that killed writers left, and files of replaced or removed recordings. The
        window must be longer than any writer takes from its first file to its last commit.
        """
        deleted = []
        self.remove(RECORDINGS, self._abandoned(retention_hours))
        for name in (RECORDINGS, TRANSITIONS):
            if not self.path.has_table(name):
                continue
            # An old file may still belong to a version within the window: vacuum leaves it out.
            stale = self._written_before(name, retention_hours)
            if not stale.difference(file.path for file in self.files(name)):
                continue
            with self.path.translate_errors():
                unneeded = self.path.open_table(name).vacuum(
                    retention_hours=retention_hours,
                    dry_run=True,
                    enforce_retention_duration=False,
                    full=True,
                )
            # Vacuum also returns files that were deleted long ago, as long as the log has them.
            deleted += [f"{name}/{file}" for file in sorted(stale.intersection(unneeded))]
        # Vacuum only listed files; deleting them here avoids its commit to the table.
        self.path.delete(deleted)
        frames = self._unnamed_frames(retention_hours)
        self.path.delete(frames)
        return deleted + frames

    def _written_before(self, name: str, retention_hours: int) -> set[str]:
        """Return the files in a folder that are older than the window.

        This goes by the files' write times, not by Delta's log: compaction may rewrite the file of
        a manifest that the log has removed, if a version within the window needs it.
        """
        before_s = time.time() - retention_hours * 3600
        return {path for path, at_s in self.path.times(name).items() if at_s <= before_s}

    def _unnamed_frames(self, retention_hours: int) -> list[str]:
        """Return frame files older than the window that no manifest names, removed or active."""
        found = self._written_before(FRAMES, retention_hours)
        if not found:
            return []
        for path in self.path.times(RECORDINGS):
            if path.endswith(".parquet"):
                try:
                    reported = self.path.read(f"{RECORDINGS}/{path}", columns=["cameras"])
                except UNREADABLE:
                    return []  # the unreadable manifest may name any of them
                found -= set(frame_files(reported))
        return [f"{FRAMES}/{path}" for path in sorted(found)]

    def _abandoned(self, retention_hours: int) -> list[str]:
        """Return manifests without rows that are too old for their writer to be still at work."""
        if not self.path.has_table(RECORDINGS) or not self.path.has_table(TRANSITIONS):
            return []
        manifests = self.files(RECORDINGS)  # read first: rows committed since then are found below
        shown = {one.ingest_id for one in self.shown()}
        before_ms = (time.time() - retention_hours * 3600) * 1000
        return [
            file.path
            for file in manifests
            # Joined files are kept: older versions may need manifests in them.
            if file.own
            and file.added_ms < before_ms
            and not shown & {one.ingest_id for one in file.ingests}
        ]

    def _write(self, rows: pa.Table, path: str) -> int:
        """Write a Parquet file; return its size in bytes.

        Fixed-size lists become plain lists, which every engine that supports Delta can read.
        """
        rows = plain_lists(rows)
        options = parquet_options(rows.schema)
        with written_whole(self.path, path):
            size = self.path.write(rows, path, row_group_size=ROW_GROUP_ROWS, **options)
        # Free tens of MB that Arrow keeps after encoding: a commit takes as much again.
        pa.default_memory_pool().release_unused()
        return size


FILE_ROWS = 500_000  # maximum in a joined file: replacing one recording rewrites the whole file
MIN_FILES = 2
FOLD_FILES = 16  # number of small manifest files that triggers a fold; each takes 10 ms to open
MIN_JOINED = 8  # from this many recordings in a commit, their manifests become one file
FULL_MANIFESTS = 500  # a file with so many is not joined again, as that would take a second
OPERATION = "restock store compact"


@dataclass
class Compacted:
    """What a compaction did, or would do."""

    rows: int = 0  # transitions that were written again
    files_before: int = 0  # files of transitions
    files_after: int = 0  # files of transitions, except those that others added meanwhile
    manifests_before: int = 0  # files of manifests
    manifests_after: int = 0
    summaries: int = 0  # new summaries of recordings whose rows another tool changed
    changed_meanwhile: int = 0  # files left unjoined, as another writer replaced one of their group
    version: int | None = None  # version of `transitions` that was committed last; None: no commit


def compact(store: StoreWriter, *, dry_run: bool = False) -> Compacted:
    """Join small files of manifests and of transitions into few large ones.

    Raises:
        StoreError: there is no store, or it cannot be written.
    """
    store.expect_store()
    done = Compacted()
    groups = list(_group_files(store))
    files = store.files(TRANSITIONS)
    done.files_before = done.files_after = len(files)
    changed = _find_changed(store, files)
    # Manifests first: once Restock has joined changed rows, their manifests' summaries are trusted.
    plan = _Fold.of(store, changed) if dry_run else fold(store, changed)
    plan.count(done)
    if dry_run:
        done.rows = sum(file.rows for group in groups for file in group)
        done.files_after -= sum(len(group) - 1 for group in groups)
        return done
    for group in groups:
        _merge_rows(store, group, done)
    return done


def fold(store: StoreWriter, changed: Collection[str] = (), *, small: bool = False) -> _Fold:
    """Join the manifests of all recordings, or only those in `small` files, into one file.

    Ingests in `changed`, whose rows another tool has changed, get new summaries.

    Manifests whose rows are not yet committed or were replaced keep or get a file of their own.
    Files with many manifests stay as they are. Returns what was done.
    """
    made: dict[str, pa.Table] = {}  # ingest -> manifest with its new summary
    store.create(RECORDINGS, recording_columns())
    for _ in range(ATTEMPTS):
        plan = _Fold.of(store, changed, small=small)
        if not plan.worth_it:
            return plan
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
            return plan
    raise StoreError(
        f"other writers were faster {ATTEMPTS} times",
        where=str(store.path),
        remedy="try again when they are done; the manifests are unchanged",
    )


def fold_if_many(store: StoreWriter) -> None:
    """Fold manifests if they are in FOLD_FILES or more small files, which are slow to open."""
    if not store.path.has_table(TRANSITIONS):
        return
    sizes = [len(file.ingests) for file in store.files(RECORDINGS)]
    if sum(size < FULL_MANIFESTS for size in sizes) >= FOLD_FILES:
        with suppress(StoreError):  # the ingest itself succeeded; queries report damaged files
            fold(store, small=True)


@dataclass
class _Fold:
    """Plan of a fold: the files that it joins, and the ingests that the new file will have."""

    files: int  # number of all files of manifests
    chosen: list[StoredFile]
    live: list[Ingest]
    lacking: list[Ingest]  # the live ingests whose summary does not match their rows

    @classmethod
    def of(cls, store: StoreWriter, changed: Collection[str], *, small: bool = False) -> _Fold:
        """Plan a fold. If `small`, leave out joined files that outweigh all smaller files together.

        So each manifest is rewritten only a few times, however many manifests follow.
        """
        shown = {one.ingest_id for one in store.shown()}
        files = store.files(RECORDINGS)
        chosen = []
        for file in files:
            held = shown.intersection(one.ingest_id for one in file.ingests)
            full = len(held) >= FULL_MANIFESTS and held.isdisjoint(changed)
            if not full and (held or not file.own):
                chosen.append(file)
        if small:
            chosen.sort(key=lambda file: len(file.ingests))
            before = accumulate((len(file.ingests) for file in chosen), initial=0)
            larger = (
                place
                for place, (file, held) in enumerate(zip(chosen, before, strict=False))
                if not file.own and len(file.ingests) > held
            )
            chosen = chosen[: next(larger, None)]
        live = [one for file in chosen for one in file.ingests if one.ingest_id in shown]
        lacking = [one for one in live if one.ingest_id in changed]
        return cls(len(files), chosen, live, lacking)

    @property
    def worth_it(self) -> bool:
        return bool(self.lacking) or len(self.chosen) >= MIN_FILES

    def count(self, done: Compacted) -> None:
        """Set counts in `done`: manifest files before and after the fold, and new summaries."""
        done.manifests_before = done.manifests_after = self.files
        if self.worth_it:
            done.manifests_after -= len(self.chosen) - 1
            done.summaries = len(self.lacking)


def _summarise(store: StoreWriter, lacking: Sequence[Ingest], made: dict[str, pa.Table]) -> None:
    """Add the manifests of these ingests, with new summaries, to `made` (by ingest id)."""
    manifests = store.manifests(lacking, recording_schema())
    for one in lacking:
        with suppress(FileNotFoundError):  # replaced meanwhile
            rows = store.rows(one.recording_id, one.ingest_id)
            made[one.ingest_id] = summarised(_manifest_of(manifests, one), rows)


def _manifest_of(manifests: pa.Table, one: Ingest) -> pa.Table:
    import pyarrow.compute as pc  # slow to import

    return manifests.filter(pc.equal(manifests["ingest_id"], one.ingest_id))


def _keep_replaced(store: StoreWriter, plan: _Fold) -> None:
    """Write each manifest in the chosen files whose rows were replaced to a file of its own.

    Older versions of the store find these files by name, until `clean` deletes them.
    """
    live = {one.ingest_id for one in plan.live}
    held = [one for file in plan.chosen for one in file.ingests]
    gone = [one for one in held if one.ingest_id not in live]
    manifests = store.manifests(gone, recording_columns())
    for one in gone:
        path = f"{RECORDINGS}/{own_path(one.recording_id, one.ingest_id)}"
        with written_whole(store.path, path):
            kept = _manifest_of(manifests, one)
            store.path.write(kept, path, **parquet_options(kept.schema))


def _find_changed(store: StoreWriter, files: Sequence[StoredFile]) -> set[str]:
    """Return the ingests in these files whose rows their manifests may no longer describe."""
    names = pa.schema([("ingest_id", pa.string()), ("transitions", pa.int64())])
    reported = store.manifests([one for file in files for one in file.ingests], names)
    written = dict(zip(*(reported[name].to_pylist() for name in names.names), strict=True))
    return set(changed_by_others(files, written))


def _group_files(store: StoreWriter) -> Iterator[list[StoredFile]]:
    """Group small files of transitions to join, ordered by robot, then time.

    A file that another tool wrote may form a group alone.
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
    """Join a group of files in one commit; if one is gone by then, leave all as they are."""
    held: dict[str, Ingest] = {}  # sums the rows of ingests that another tool split over files
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
