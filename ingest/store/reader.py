"""What a store holds, for who writes to it: ingests, manifests, rows, the ends of episodes.

Which files and ingests there are is in Delta's log, the rest in the manifests; nothing is asked of
the rows but one recording's. Questions in SQL are for `restock.replay.store`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import pyarrow as pa
from deltalake import DeltaTable

from restock.errors import StoreError
from restock.ingest.store.lineage import (
    READERS,
    Ingest,
    StoredFile,
    damage_named,
    own_path,
    stored_files,
)
from restock.ingest.store.location import RECORDINGS, TRANSITIONS, Location
from restock.ingest.store.repeated import UNREADABLE, Hashes, Sketch, read_sketch
from restock.ingest.store.summary import with_ends
from restock.ingest.store.version import Version
from restock.ingest.task.schema import recording_schema

_SKETCHES: dict[tuple[Location, str], Sketch] = {}  # by ingest, which never changes; 2 kB each


class StoreReader:
    """What is in a store, at its newest version or at an older one."""

    def __init__(self, path: str | Path | Location) -> None:
        self.path = Location.of(path)
        self._opened: DeltaTable | None = None  # transitions, as `_files_of` read them
        self._by_ingest: dict[str, list[str]] = {}

    def reach(self) -> None:
        """Check that the place can be reached, and what is there is no part of a store.

        Raises StoreError where it is not so.
        """
        self.path.expect_both_tables()

    def live(self, recording_id: str | None = None, version: Version | None = None) -> pa.Table:
        """The manifest rows whose transitions are in the store (of one recording, or of all).

        Of a version, or as it is now.
        """
        schema = recording_schema()
        if not self.path.has_table(TRANSITIONS):
            return schema.empty_table()
        shown = [one for one in self.shown(version) if recording_id in (None, one.recording_id)]
        found = self.manifests(shown, schema)
        if version is not None and len(found) < len(shown):
            raise StoreError(
                "this version can no longer be read: manifests of it are gone",
                where=str(self.path),
                remedy="name a newer version, or restore them from a copy",
            )
        return found

    def manifests(
        self,
        ingests: Sequence[Ingest],
        schema: pa.Schema,
        *,
        skip: tuple[type[Exception], ...] = (),
    ) -> pa.Table:
        """Return these columns of the manifests of ingests.

        An ingest whose manifest the store does not have any more is left out, and so is a file at
        which one of `skip` is raised.

        Raises:
            StoreError: a file is missing or damaged, or the place cannot be reached.
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
            listed = set(at.values())

            def read(path: str) -> pa.Table:
                absent = () if path in listed else (FileNotFoundError,)
                place = f"{RECORDINGS}/{path}"
                with suppress(*skip), damage_named(self.path, place), suppress(*absent):
                    return self.path.read(place, columns=schema.names)
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
        """One recording's transitions, as they were written.

        Raises:
            FileNotFoundError: there are none of this ingest.
            StoreError: a file is missing or damaged, or the place cannot be reached.
        """
        import pyarrow.compute as pc  # slow to import

        own = own_path(recording_id, ingest_id)
        files = self._files_of(ingest_id)
        if files in ([], [own]):  # replaced rows, and those in no commit yet, lie there as well
            with damage_named(self.path, f"{TRANSITIONS}/{own}"), suppress(FileNotFoundError):
                return self.path.read(f"{TRANSITIONS}/{own}")
        parts = []
        for file in files:
            place = f"{TRANSITIONS}/{file}"
            with damage_named(self.path, place):
                parts.append(self.path.read(place, where=pc.field("ingest_id") == ingest_id))
        if not parts:
            raise FileNotFoundError(own)
        rows = pa.concat_tables(parts, promote_options="default").sort_by("transition_id")
        reported = self._packed_ends([Ingest(recording_id, ingest_id, len(rows))])
        return with_ends(rows, reported.get(ingest_id))

    def _files_of(self, ingest_id: str) -> list[str]:
        """The active files of transitions that hold rows of an ingest; the log is read again only
        where it went on."""
        if self._opened is None and not self.path.has_table(TRANSITIONS):
            return []
        version = None
        if self._opened is not None:
            version = self._opened.version()
            with self.path.translate_errors():
                self._opened.update_incremental()
        if self._opened is None or self._opened.version() != version:
            self._opened = self.path.open_table(TRANSITIONS)
            self._by_ingest = {}
            for file in stored_files(self.path, TRANSITIONS, self._opened):
                for one in file.ingests:
                    self._by_ingest.setdefault(one.ingest_id, []).append(file.path)
        return self._by_ingest.get(ingest_id, [])

    def ends(self, ingests: Sequence[Ingest]) -> Iterator[tuple[str, pa.Table]]:
        """The recording of each of these ingests and the ends of its episodes, as `episode_ends`
        gives them; without those that have none."""
        from restock.ingest.store.episode_rows import episode_ends

        reported = self._packed_ends(ingests)
        for one in ingests:
            ends = episode_ends(with_ends(pa.table({}), reported.get(one.ingest_id)))
            if ends is not None:
                yield one.recording_id, ends

    def _packed_ends(self, ingests: Sequence[Ingest]) -> dict[str, str | None]:
        """What manifests keep of the ends of episodes, by ingest."""
        schema = pa.schema([("ingest_id", pa.string()), ("packed_ends", pa.string())])
        reported = self.manifests(ingests, schema)
        return dict(zip(*(reported[name].to_pylist() for name in schema.names), strict=True))

    def files(self, name: str, version: Version | None = None) -> list[StoredFile]:
        """The active files of one of its tables, and which ingests they hold."""
        return stored_files(self.path, name, self.path.open_table(name, version))

    def shown(self, version: Version | None = None) -> list[Ingest]:
        """The ingests whose transitions are in the store."""
        held = [one for file in self.files(TRANSITIONS, version) for one in file.ingests]
        return list({one.ingest_id: one for one in held}.values())

    def sketches(self, ingests: Sequence[Ingest]) -> list[Sketch]:
        """Their sketches, each read once: many recordings would read all others' as many times."""
        names = ("recording_id", "ingest_id", "sketch")
        schema = pa.schema([(name, pa.string()) for name in names])
        new = [one for one in ingests if (self.path, one.ingest_id) not in _SKETCHES]
        # What cannot be read is another recording's, which `restock sql` reports.
        for reported in self.manifests(new, schema, skip=UNREADABLE).to_pylist():
            hashes = read_sketch(reported["sketch"] or "")
            sketch = Sketch(reported["recording_id"], reported["ingest_id"], hashes)
            _SKETCHES[self.path, sketch.ingest_id] = sketch
        keys = [(self.path, one.ingest_id) for one in ingests]
        return [_SKETCHES[key] for key in keys if key in _SKETCHES]

    def remember(self, recording_id: str, ingest_id: str, contents: Hashes) -> None:
        """Keep the sketch of an ingest that was just written: it need not be read."""
        _SKETCHES[self.path, ingest_id] = Sketch.of(recording_id, ingest_id, contents)


def frame_files(manifests: pa.Table) -> list[str]:
    """The files of `frames` that manifests name."""
    rows = manifests["cameras"].to_pylist() if "cameras" in manifests.column_names else []
    return sorted({camera["file"] for cameras in rows for camera in cameras or ()} - {""})
