"""Which ingests the files of a store's tables hold.

A file that `restock ingest` wrote is named by its one ingest: `<recording_id>/<ingest_id>.parquet`.
One that was compacted holds several: `restock store compact` keeps their list in the file's
metadata. For files that other tools compacted, it is read from the columns `recording_id` and
`ingest_id`.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple
from urllib.parse import unquote

import pyarrow as pa
from deltalake import DeltaTable

from restock.errors import StoreError
from restock.files import first_line
from restock.ingest.store.location import FRAMES, TRANSITIONS, Location, open_parquet
from restock.words import quoted

OWN_PATH = re.compile(r"([0-9a-f]{16})/[^/]+\.parquet")
INGESTS = b"restock.ingests"  # key in the metadata of a compacted file
READERS = 16  # of small files at once, which on S3 are a wait each
_COLUMNS = ("recording_id", "ingest_id")


class Ingest(NamedTuple):
    """The rows of one ingest of a recording, in a file."""

    recording_id: str
    ingest_id: str
    rows: int


@dataclass(frozen=True)
class StoredFile:
    """An active file of a table."""

    path: str  # in the table
    rows: int
    bytes: int
    added_ms: int
    ingests: tuple[Ingest, ...]
    listed: bool = True  # whether Restock wrote it, and says in it or by its name what it holds

    @property
    def own(self) -> bool:
        """Whether one ingest wrote it, and it is as it was written."""
        return OWN_PATH.fullmatch(self.path) is not None


def own_path(recording_id: str, ingest_id: str) -> str:
    """Where an ingest writes."""
    return f"{recording_id}/{ingest_id}.parquet"


def stored_files(
    place: Location, name: str, table: DeltaTable, *, without: Collection[str] = ()
) -> list[StoredFile]:
    """The active files of a store's table `name`, with what each holds; `without` those paths.

    Raises:
        StoreError: one is of another kind, or it cannot be read.
    """
    adds = [one for one in active_files(table) if one[0] not in without]
    held: dict[str, tuple[tuple[Ingest, ...], bool]] = {
        path: (one, True) for path, rows, *_ in adds if (one := _named(path, rows))
    }
    others = [path for path, *_ in adds if path not in held]
    with ThreadPoolExecutor(READERS) as pool:
        held |= zip(others, pool.map(lambda path: _read(place, name, path), others), strict=True)
    return [
        StoredFile(
            path, sum(one.rows for one in ingests), size or 0, added_ms or 0, ingests, listed
        )
        for path, _, size, added_ms in adds
        for ingests, listed in (held[path],)
    ]


def changed_by_others(files: Iterable[StoredFile], written: Mapping[str, int]) -> dict[str, int]:
    """How many rows each ingest has whose rows need not be those that Restock wrote, which its
    manifest describes: another tool wrote their file, or their number is another.

    `written` is the number of rows by ingest, as the manifests say.
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
    """What Delta's log says of the active files: path, rows, bytes, when it was added in ms."""
    actions = table.get_add_actions(flatten=True)
    columns = [
        actions[column].to_pylist() if column in actions.schema.names else [None] * len(actions)
        for column in ("path", "num_records", "size_bytes", "modification_time")
    ]
    files = [(unquote(str(path)), *rest) for path, *rest in zip(*columns, strict=True)]
    if damaged := next((path for path, *_ in files if "\0" in path), None):
        raise StoreError(
            f"its log names a file that cannot be: {damaged}",
            where=table.table_uri,
            remedy="restore the newest commits of its _delta_log from a copy",
        )
    return files


def held_by(place: Location, name: str, path: str) -> StoredFile:
    """A file of a table that need not be active, with what it holds. Raises as `stored_files`."""
    with damage_named(place, f"{name}/{path}"), place.reading(f"{name}/{path}") as source:
        rows = open_parquet(source).metadata.num_rows
    if own := _named(path, rows):
        return StoredFile(path, rows, 0, 0, own)
    return StoredFile(path, rows, 0, 0, *_read(place, name, path))


@contextmanager
def damage_named(place: Location, path: str) -> Iterator[None]:
    """What goes wrong while a file of the store is read, as a StoreError that names the file."""
    try:
        yield
    except MemoryError:  # which one of Arrow's errors is, too
        raise
    except (OSError, pa.ArrowException) as error:
        missing = isinstance(error, FileNotFoundError)
        raise StoreError(
            f"its file {path} "
            + ("is missing" if missing else f"cannot be read: {first_line(error)}"),
            where=str(place),
            remedy="make the file readable: it need not be damaged"
            if by_system(error) or isinstance(error, pa.ArrowNotImplementedError)
            else damage_remedy(place, path),
        ) from error


def by_system(error: BaseException) -> bool:
    """Whether a file could not be read for its permissions or the disk: Parquet's reader sets no
    errno. What goes wrong on the way to S3 is a StoreError before."""
    return (
        isinstance(error, OSError)
        and error.errno is not None
        and not isinstance(error, FileNotFoundError)
    )


def damage_remedy(place: Location, path: str) -> str:
    """What to do where a file of the store is damaged or missing."""
    name, _, file = path.partition("/")
    if name == FRAMES or (name == TRANSITIONS and OWN_PATH.fullmatch(file)):
        return "restore the file from a copy, or ingest its recording again with --force"
    return (
        f"restore the file from a copy, or let `restock store compact {quoted(place)}"
        " --drop-damaged` take it out of the store: it names the recordings to ingest again"
    )


def packed_ingests(ingests: Sequence[Ingest]) -> bytes:
    """The list of what a compacted file holds, for its metadata."""
    return json.dumps(ingests, separators=(",", ":")).encode()


def ingests_table(files: Iterable[StoredFile]) -> pa.Table:
    """One row an ingest: recording_id, ingest_id, rows, and the file that has them."""
    every = [(*one, file.path) for file in files for one in file.ingests]
    names = ("recording_id", "ingest_id", "rows", "file")
    types = (pa.string(), pa.string(), pa.int64(), pa.string())
    columns = zip(*every, strict=True) if every else [()] * len(names)
    arrays = [pa.array(list(c), t) for c, t in zip(columns, types, strict=True)]
    return pa.table(dict(zip(names, arrays, strict=True)))


def _named(path: str, rows: int | None) -> tuple[Ingest, ...] | None:
    """What a file holds by its name, where it says that."""
    if rows is None or not OWN_PATH.fullmatch(path):
        return None
    recording_id, file = path.split("/")
    return (Ingest(recording_id, file.removesuffix(".parquet"), rows),)


@lru_cache(maxsize=4096)  # files never change
def _read(place: Location, name: str, path: str) -> tuple[tuple[Ingest, ...], bool]:
    """What a file holds, and whether Restock listed it there."""
    where = f"{name}/{path}"
    with damage_named(place, where), place.reading(where) as source:
        file = open_parquet(source)
        if said := (file.schema_arrow.metadata or {}).get(INGESTS):
            listed = tuple(Ingest(*one) for one in json.loads(said))
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
