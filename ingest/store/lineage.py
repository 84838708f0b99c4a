"""Read a store: the ingests in each of its files, their manifests, and rows of one recording.

The path of a file that `restock ingest` wrote names its one ingest:
`<recording_id>/<ingest_id>.parquet`. A joined file has several: `restock store compact` writes
their list into the file's metadata. If another tool joined the file, they are read from its columns
`recording_id` and `ingest_id`. For SQL queries see `restock.replay.store`.
"""

from __future__ import annotations

import json
import re
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import pyarrow as pa
from deltalake import DeltaTable

from restock.errors import StoreError, quoted
from restock.files import first_line
from restock.ingest.store.location import FRAMES, RECORDINGS, TRANSITIONS, Location, open_parquet
from restock.ingest.store.summary import (
    SKETCH_HASHES,
    SUMMARY_SCHEMA,
    UNREADABLE,
    Hashes,
    read_sketch,
    sharing,
    with_ends,
)
from restock.ingest.task.schema import DOCUMENTS, recording_schema

OWN_PATH = re.compile(r"([0-9a-f]{16})/([^/]+)\.parquet")
INGESTS = b"restock.ingests"  # key in the metadata of a joined file
READERS = 16  # small files to read in parallel, because on S3 each read waits for the server
_COLUMNS = ("recording_id", "ingest_id")


class Ingest(NamedTuple):
    """An ingest of a recording, and its number of rows in a file."""

    recording_id: str
    ingest_id: str
    rows: int


class StoredFile(NamedTuple):
    """An active file of a table."""

    path: str  # relative to the table
    rows: int
    bytes: int
    added_ms: int
    ingests: tuple[Ingest, ...]
    listed: bool = True  # False: another tool wrote it, so its ingests were read from its rows

    @property
    def own(self) -> bool:
        """Return whether this is the unchanged file of one ingest, named after that ingest."""
        return OWN_PATH.fullmatch(self.path) is not None


def own_path(recording_id: str, ingest_id: str) -> str:
    """Return the path of the file that an ingest writes, relative to the table."""
    return f"{recording_id}/{ingest_id}.parquet"


def stored_files(
    place: Location,
    name: str,
    table: DeltaTable,
    *,
    without: Collection[str] = (),
    known: Iterable[StoredFile] = (),
) -> list[StoredFile]:
    """Return the active files of table `name` with their ingests, except paths in `without`.

    Files in `known` (from an earlier version) are not read again.

    Raises:
        StoreError: a file has rows without ids of recording and ingest, or cannot be read.
    """
    adds = [one for one in active_files(table) if one[0] not in without]
    found = {(one.path, one.bytes, one.added_ms): one for one in known}
    new: list[tuple[str, int, int]] = []
    for path, rows, size, added_ms in adds:
        if (key := (path, size or 0, added_ms or 0)) in found:
            continue
        if own := _parse_own_path(path, rows):
            found[key] = StoredFile(path, own[0].rows, *key[1:], own)
        else:
            new.append(key)
    if new:
        with ThreadPoolExecutor(READERS) as pool:
            held = pool.map(lambda key: _read(place, name, key[0]), new)
            for key, (ingests, listed) in zip(new, held, strict=True):
                rows = sum(one.rows for one in ingests)
                found[key] = StoredFile(key[0], rows, *key[1:], ingests, listed)
    return [found[path, size or 0, added_ms or 0] for path, _, size, added_ms in adds]


def changed_by_others(files: Iterable[StoredFile], written: Mapping[str, int]) -> dict[str, int]:
    """Count rows per ingest, for ingests whose manifest may no longer describe their rows.

    Such an ingest has rows in a file by another tool, or has not as many rows as in `written`,
    which maps ingest ids to the numbers of rows in the manifests.
    """
    rows: Counter[str] = Counter()
    others: set[str] = set()
    for file in files:
        for one in file.ingests:
            rows[one.ingest_id] += one.rows
            if not file.listed:
                others.add(one.ingest_id)
    return {
        ingest_id: count
        for ingest_id, count in rows.items()
        if ingest_id in others or count != written.get(ingest_id, count)
    }


def active_files(table: DeltaTable) -> list[tuple[str, int | None, int | None, int | None]]:
    """Return path, rows, bytes and time of addition (ms) of the active files, from Delta's log."""
    actions = table.get_add_actions(flatten=True)
    columns = [
        actions[column].to_pylist() if column in actions.schema.names else [None] * len(actions)
        for column in ("path", "num_records", "size_bytes", "modification_time")
    ]
    return [(unquote(str(path)), *rest) for path, *rest in zip(*columns, strict=True)]


def read_stored_file(place: Location, name: str, path: str) -> StoredFile:
    """Read which ingests an active or removed file of a table has. Raises as `stored_files`."""
    with damage_named(place, f"{name}/{path}"), place.reading(f"{name}/{path}") as source:
        rows = open_parquet(source).metadata.num_rows
    if own := _parse_own_path(path, rows):
        return StoredFile(path, rows, 0, 0, own)
    return StoredFile(path, rows, 0, 0, *_read(place, name, path))


@contextmanager
def damage_named(place: Location, path: str) -> Iterator[None]:
    """Turn errors of reading a file of the store into a StoreError that names the file."""
    try:
        yield
    except MemoryError:  # raised first, as Arrow's out-of-memory error is an ArrowException, too
        raise
    except (OSError, pa.ArrowException) as error:
        missing = isinstance(error, FileNotFoundError)
        raise StoreError(
            f"its file {path} "
            + ("is missing" if missing else f"cannot be read: {first_line(error)}"),
            where=str(place),
            remedy="make the file readable: it may be undamaged"
            if is_system_error(error) or isinstance(error, pa.ArrowNotImplementedError)
            else damage_remedy(place, path),
        ) from error


def is_system_error(error: BaseException) -> bool:
    """Return whether a file could not be read because of its permissions or the disk.

    Errors of Parquet's reader have no errno. Errors of S3 were turned into a StoreError before.
    """
    return (
        isinstance(error, OSError)
        and error.errno is not None
        and not isinstance(error, FileNotFoundError)
    )


def damage_remedy(place: Location, path: str) -> str:
    """Return what to do if a file of the store is damaged or missing."""
    name, _, file = path.partition("/")
    if name == FRAMES or (name == TRANSITIONS and OWN_PATH.fullmatch(file)):
        return "restore the file from a copy, or ingest its recording again with --force"
    return (
        f"restore the file from a copy, or run `restock store compact {quoted(place)}"
        " --drop-damaged`, which removes it and names the recordings to ingest again"
    )


def packed_ingests(ingests: Sequence[Ingest]) -> bytes:
    """Pack the list of a joined file's ingests for its metadata."""
    return json.dumps(ingests, separators=(",", ":")).encode()


def ingests_table(files: Iterable[StoredFile]) -> pa.Table:
    """Return a row per file and ingest: recording_id, ingest_id, rows, file."""
    text, number = pa.string(), pa.int64()
    columns = {"recording_id": text, "ingest_id": text, "rows": number, "file": text}
    rows = [{**one._asdict(), "file": file.path} for file in files for one in file.ingests]
    return pa.Table.from_pylist(rows, pa.schema(list(columns.items())))


def _parse_own_path(path: str, rows: int | None) -> tuple[Ingest, ...] | None:
    """Parse the ingest in a file's name; return None if there is none or `rows` is unknown."""
    ids = OWN_PATH.fullmatch(path)
    return (Ingest(ids[1], ids[2], rows),) if ids and rows is not None else None


@lru_cache(maxsize=4096)  # files never change
def _read(place: Location, name: str, path: str) -> tuple[tuple[Ingest, ...], bool]:
    """Read which ingests a file has, and whether Restock listed them in the file's metadata."""
    where = f"{name}/{path}"
    with damage_named(place, where), place.reading(where) as source:
        file = open_parquet(source)
        if packed := (file.schema_arrow.metadata or {}).get(INGESTS):
            listed = tuple(Ingest(*one) for one in json.loads(packed))
            if sum(one.rows for one in listed) == file.metadata.num_rows:
                return listed, True
        counts: Counter[tuple[str | None, str | None]] = Counter()
        if set(_COLUMNS) <= set(file.schema_arrow.names):
            for batch in file.iter_batches(columns=list(_COLUMNS)):
                rows = pa.table(batch).group_by(list(_COLUMNS)).aggregate([([], "count_all")])
                for one in rows.to_pylist():
                    counts[one["recording_id"], one["ingest_id"]] += one["count_all"]
    held = [
        Ingest(recording_id, ingest_id, count)
        for (recording_id, ingest_id), count in counts.items()
        if recording_id and ingest_id
    ]
    if sum(one.rows for one in held) < max(counts.total(), 1):
        raise StoreError(
            f"holds a file that `restock ingest` did not write: {path}",
            where=str(place),
            remedy="restore the version before it was added",
        )
    return tuple(held), False


# Store -> ingest id -> sketch. An ingest never changes; a sketch takes 2 kB.
_SKETCHES: defaultdict[Location, dict[str, Hashes]] = defaultdict(dict)


@dataclass(frozen=True)
class _Listing:
    """The active files of a table when it was last read."""

    table: DeltaTable
    at: tuple[str, int]  # id of the table, and its version
    files: list[StoredFile]

    @cached_property
    def paths(self) -> dict[str, list[str]]:
        """Return the paths of the files that have rows of an ingest, by ingest id."""
        paths: dict[str, list[str]] = {}
        for file in self.files:
            for one in file.ingests:
                paths.setdefault(one.ingest_id, []).append(file.path)
        return paths

    @cached_property
    def by_recording(self) -> dict[str, Ingest]:
        """Return the ingest of each recording, by recording id."""
        return {one.recording_id: one for file in self.files for one in file.ingests}


class StoreReader:
    """Reader of a store's files and manifests, at the newest version.

    The reader caches what it has read of the logs and of joined manifests, and later reads only
    what was added.
    """

    def __init__(self, path: str | Path | Location) -> None:
        self.path = Location.of(path)
        self._listings: dict[str, _Listing] = {}
        self._joined: dict[str, tuple[pa.Table, dict[str, int]]] = {}

    def reach(self) -> None:
        """Raise StoreError if the place cannot be reached or only one of the tables exists."""
        self.path.expect_both_tables()

    def live(self, recording_id: str | None = None) -> pa.Table:
        """Return the manifest rows of recordings (or of one) whose transitions are in the store."""
        shown = [one for one in self.shown() if recording_id in (None, one.recording_id)]
        return self.manifests(shown, recording_schema())

    def manifest(self, recording_id: str) -> dict[str, Any] | None:
        """Return the manifest row of a recording whose transitions are in the store, or None.

        A joined file is read once and cached for later calls.

        Raises:
            StoreError: a file is missing or damaged, or the place cannot be reached.
        """
        one = self._listing(TRANSITIONS).by_recording.get(recording_id) if self._exists() else None
        if one is None:
            return None
        path = self._listing(RECORDINGS).paths.get(one.ingest_id, [own_path(*one[:2])])[-1]
        if OWN_PATH.fullmatch(path):
            rows, row = self.manifests([one], recording_schema()), 0
        else:
            if path not in self._joined:
                place = f"{RECORDINGS}/{path}"
                names = recording_schema().names
                with damage_named(self.path, place):
                    rows = self.path.read(place, columns=names, repeated=DOCUMENTS)
                ids = rows["ingest_id"].to_pylist()
                self._joined[path] = rows, {ingest_id: row for row, ingest_id in enumerate(ids)}
            rows, places = self._joined[path]
            row = places.get(one.ingest_id, len(rows))
        return next(iter(rows.slice(row, 1).to_pylist(maps_as_pydicts="strict")), None)

    def manifests(self, ingests: Sequence[Ingest], schema: pa.Schema) -> pa.Table:
        """Read the manifests of these ingests, with the columns of `schema`.

        An ingest whose manifest is no longer in the store is left out.

        Raises:
            StoreError: a file is missing or damaged, or the place cannot be reached.
        """
        parts = [schema.empty_table(), *self._manifest_files(ingests, schema)]
        found = pa.concat_tables(parts, promote_options="default")
        if {one.ingest_id for one in ingests}.issuperset(found["ingest_id"].to_pylist()):
            return found.combine_chunks()
        import pyarrow.compute as pc  # slow to import

        wanted = pa.array([one.ingest_id for one in ingests], pa.string())
        return found.filter(pc.is_in(found["ingest_id"], wanted)).combine_chunks()

    def _manifest_files(
        self,
        ingests: Sequence[Ingest],
        schema: pa.Schema,
        *,
        skip: tuple[type[Exception], ...] = (),
    ) -> Iterator[pa.Table]:
        """Yield all rows of each file with a manifest of these ingests, in the columns of `schema`.

        A file whose reading raises one of `skip` yields no rows.
        """
        if not ingests:
            return
        listing = self._listing(RECORDINGS)
        paths = {
            listing.paths.get(one.ingest_id, [own_path(*one[:2])])[-1]: None for one in ingests
        }
        listed = {file.path for file in listing.files}

        def read(path: str) -> pa.Table:
            absent = () if path in listed else (FileNotFoundError,)
            place = f"{RECORDINGS}/{path}"
            with suppress(*skip), damage_named(self.path, place), suppress(*absent):
                return self.path.read(place, columns=schema.names).replace_schema_metadata(None)
            return schema.empty_table()

        with ThreadPoolExecutor(READERS) as pool:
            yield from pool.map(read, paths)

    def rows(self, recording_id: str, ingest_id: str) -> pa.Table:
        """Return one recording's transitions as they were written.

        Raises:
            FileNotFoundError: the store has no rows of this ingest.
            StoreError: a file is missing or damaged, or the place cannot be reached.
        """
        import pyarrow.compute as pc  # slow to import

        own = own_path(recording_id, ingest_id)
        files = self._listing(TRANSITIONS).paths.get(ingest_id, []) if self._exists() else []
        if files in ([], [own]):  # []: replaced or uncommitted rows, whose file may exist
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

    def _exists(self) -> bool:
        """Return whether there is a table of transitions. Raises as `has_table` does."""
        return TRANSITIONS in self._listings or self.path.has_table(TRANSITIONS)

    def ends(self, ingests: Sequence[Ingest]) -> Iterator[tuple[str, pa.Table]]:
        """Yield the recording id of each of these ingests and its `episode_ends`.

        Ingests without episode ends are left out.
        """
        from restock.ingest.store.transitions import episode_ends

        reported = self._packed_ends(ingests)
        for one in ingests:
            ends = episode_ends(with_ends(pa.table({}), reported.get(one.ingest_id)))
            if ends is not None:
                yield one.recording_id, ends

    def _packed_ends(self, ingests: Sequence[Ingest]) -> dict[str, str | None]:
        """Return the packed episode ends from the manifests, by ingest id."""
        schema = pa.schema([("ingest_id", pa.string()), ("packed_ends", pa.string())])
        reported = self.manifests(ingests, schema)
        return dict(zip(*(reported[name].to_pylist() for name in schema.names), strict=True))

    def files(self, name: str) -> list[StoredFile]:
        """Return the active files of a table, with their ingests."""
        return self._listing(name).files

    def _listing(self, name: str) -> _Listing:
        """Return the listing of a table's newest version; reopen the table after new commits."""
        known = self._listings.get(name)
        if known is None or self.path.has_new_commits(name, known.table):
            return self._update_listing(name, self.path.open_table(name))
        if known.at[1] != known.table.version():  # changed by `_read_own_commit`
            return self._update_listing(name, known.table)
        return known

    def _update_listing(self, name: str, table: DeltaTable) -> _Listing:
        """Return the listing of a table that was just opened or updated, and cache it."""
        known, at = self._listings.get(name), (str(table.metadata().id), table.version())
        if known is None or known.at != at:
            same = known.files if known is not None and known.at[0] == at[0] else ()
            known = _Listing(table, at, stored_files(self.path, name, table, known=same))
            self._listings[name] = known
        return known

    def _read_own_commit(self, name: str, table: DeltaTable) -> int:
        """Update a table after a commit by this store, and return its new version."""
        before = table.version()
        table.update_incremental()
        if table.version() != before + 1:  # others committed, too: reopen, to check their commits
            self._listings.pop(name, None)
        return table.version()

    def shown(self) -> list[Ingest]:
        """Return the ingests whose transitions are in the store."""
        if not self._exists():
            return []
        held = [one for file in self.files(TRANSITIONS) for one in file.ingests]
        return list({one.ingest_id: one for one in held}.values())

    def similar(self, mine: Hashes, ingests: Sequence[Ingest]) -> Iterator[pa.Table]:
        """Yield the manifest rows of the ingests whose sketches share hashes with `mine`.

        They have the columns that `summary.compare` needs. Unreadable manifests are left out.
        """
        names = sharing(mine, self._sketches(ingests))
        columns = ("recording_id", "ingest_id", "source_file", "transitions")
        schema = pa.schema([recording_schema().field(name) for name in columns])
        schema = schema.append(SUMMARY_SCHEMA.field("distinctive_rows"))
        wanted = [one for one in ingests if one.ingest_id in names]
        for part in self._manifest_files(wanted, schema, skip=UNREADABLE):
            for row, ingest_id in enumerate(part["ingest_id"].to_pylist()):
                if ingest_id in names:
                    yield part.slice(row, 1)

    def _sketches(self, ingests: Sequence[Ingest]) -> dict[str, Hashes]:
        """Return the sketch of each ingest, read once and cached; leave out unreadable ones."""
        schema = pa.schema([("ingest_id", pa.string()), ("sketch", pa.string())])
        kept = _SKETCHES[self.path]
        new = {one.ingest_id: one for one in ingests if one.ingest_id not in kept}
        # Skip unreadable manifests: `restock sql` reports them, and this ingest need not fail.
        for part in self._manifest_files(list(new.values()), schema, skip=UNREADABLE):
            columns = (part[name].to_pylist() for name in schema.names)
            for ingest_id, text in zip(*columns, strict=True):
                if ingest_id in new:
                    kept[ingest_id] = read_sketch(text or "")
        return {one.ingest_id: kept[one.ingest_id] for one in ingests if one.ingest_id in kept}

    def remember(self, ingest_id: str, contents: Hashes) -> None:
        """Cache the sketch of an ingest that was just written, so that it need not be read."""
        _SKETCHES[self.path][ingest_id] = contents[:SKETCH_HASHES]


def frame_files(manifests: pa.Table) -> list[str]:
    """Return the files in `frames` that these manifests name."""
    rows = manifests["cameras"].to_pylist() if "cameras" in manifests.column_names else []
    return sorted({camera["file"] for cameras in rows for camera in cameras or ()} - {""})
