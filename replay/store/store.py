"""A store, open for reading: DuckDB over the Parquet of one version of its Delta tables.

The views of `views.sql` and the macros of `macros.sql` are there; queries are read-only. DuckDB
reads a folder's files itself; those on S3 it reads through Arrow, which skips the columns and row
groups that a query does not ask for.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeVar
from urllib.parse import unquote

import duckdb
import msgspec
import pyarrow as pa
import pyarrow.dataset
from deltalake import DeltaTable

from restock.errors import StoreError
from restock.files import first_line
from restock.ingest.store.location import Location
from restock.ingest.store.version import Version
from restock.ingest.store.writer import OWN_PATH, RECORDINGS, RETENTION_HOURS, TRANSITIONS
from restock.ingest.task.conditions import Condition
from restock.ingest.task.task import Task
from restock.replay.store.computed import install_computed
from restock.replay.store.query import install_first, query

T = TypeVar("T")


@dataclass(frozen=True)
class _Stored:
    """The files of one table at the version that is open."""

    name: str
    schema: pa.Schema
    paths: Sequence[str]  # in the table
    hold: bool = False  # in memory, where the store lies on S3

    @property
    def view(self) -> str:
        return f"stored_{self.name}"


class StoredProfile(NamedTuple):
    """A profile as the manifests of its recordings keep it."""

    name: str
    hash: str
    toml: str  # "" where an older Restock wrote them


class Store:
    """A store at one version. Close it, or use it as a context manager.

    Args:
        path: the store's directory, or `s3://bucket/prefix`.
        version: of its transitions table, a number or the moment whose newest it was; default the
            newest.
        memory_limit: what DuckDB may hold in memory, e.g. "4GB"; default DuckDB's own (80 %).

    `version` is of the transitions table, `files` the Parquet files of each table.

    Raises:
        StoreError: nothing there, not a store, no such version, or it cannot be reached.
    """

    def __init__(
        self,
        path: str | Path | Location,
        *,
        version: Version | None = None,
        memory_limit: str | None = None,
    ) -> None:
        self.path = Location.of(path)
        _expect(self.path)
        transitions = self.path.open_table(TRANSITIONS, version)
        recordings = self.path.open_table(RECORDINGS)
        self.version: int = transitions.version()
        self._spill = tempfile.TemporaryDirectory(prefix="restock-")
        self.connection = duckdb.connect(
            config={"temp_directory": self._spill.name, "autoinstall_known_extensions": False}
        )
        if memory_limit is not None:
            self._set_memory(memory_limit)
        rows = _paths(transitions)
        manifests = _manifests(self.path, recordings, rows)
        self._tables = (
            _Stored(RECORDINGS, pa.schema(recordings.schema().to_arrow()), manifests, hold=True),
            _Stored(TRANSITIONS, pa.schema(transitions.schema().to_arrow()), rows),
        )
        self.files = {
            table.view: [f"{self.path.table(table.name)}/{path}" for path in table.paths]
            for table in self._tables
        }
        try:
            self._present_all(self.connection, "main")
        except StoreError as error:
            if version is None:
                raise
            raise StoreError(
                f"its version {self.version} cannot be read any more: {error.what}",
                where=str(self.path),
                remedy=f"files are kept for {RETENTION_HOURS // 24} days after their rows were"
                " replaced: name a newer version, or restore them from a copy",
            ) from error
        self._tasks = self._read_tasks()
        self.observation_type = self._observation_type()
        # Of a query's text, before it runs: what only fails while rows are fetched is said here.
        self.checks: list[Callable[[str], None]] = []
        install_first(self.connection, self.observation_type)
        install_computed(self)

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Store {self.path} version {self.version}>"

    def close(self) -> None:
        """Close the connection and remove its temporary files."""
        self.connection.close()
        self._spill.cleanup()

    def sql(self, text: str) -> duckdb.DuckDBPyRelation:
        """The result of a query: `.to_arrow_table()`, `.df()`, `.pl()`, `.fetchall()`.

        Raises QueryError with DuckDB's message, or where the query would write; ConfigError where
        it names a mixture that there is not.
        """
        for check in self.checks:
            check(text)
        return query(self.connection, text, where=str(self.path))

    def conditions(self) -> tuple[Condition, ...]:
        """The conditions that labelled the store's rows, of the newest ingest.

        Only what the table keeps of them: name, timing, priority and SQL.
        """
        rows = self.connection.sql(
            "SELECT conditions_json FROM recordings ORDER BY ingested_at DESC, ingest_id LIMIT 1"
        ).fetchall()
        if not rows:
            return ()
        return tuple(self._decode(rows[0][0], list[Condition], "conditions"))

    def exposures(self) -> tuple[Condition, ...]:
        """The exposures listed beside them, of the newest ingest; an older store has none."""
        rows = self.connection.sql(
            "SELECT exposures_json FROM recordings ORDER BY ingested_at DESC, ingest_id LIMIT 1"
        ).fetchall()
        found = self._decode(rows[0][0] or "[]", list[Condition], "exposures") if rows else []
        return tuple(msgspec.structs.replace(one, kind="exposure") for one in found)

    def profile_name(self, task_hash: str) -> str:
        """The profile that read the rows of a task, by the newest ingest; "" where none did."""
        profiles = profiles_of(self.connection, task_hash)
        return profiles[0].name if profiles else ""

    def task_hashes(self) -> list[str]:
        """Of the store's rows, sorted; more than one where profiles of several tasks read them."""
        return sorted(self._tasks)

    def task_json(self, task_hash: str | None = None) -> str:
        """The task of the store's rows as JSON.

        Raises StoreError where the rows are of several tasks and none, or no such, is named.
        """
        if task_hash is None and len(self._tasks) == 1:
            return next(iter(self._tasks.values()))
        if task_hash is not None and task_hash in self._tasks:
            return self._tasks[task_hash]
        raise StoreError(
            "it holds no recording"
            if not self._tasks
            else f"it holds transitions of the tasks {', '.join(sorted(self._tasks))}"
            + (f", not of {task_hash}" if task_hash else ""),
            where=str(self.path),
            remedy="ingest recordings" if not self._tasks else "name one of them",
        )

    def task(self, task_hash: str | None = None) -> Task:
        """The task of the store's rows. Raises StoreError as `task_json` does."""
        return self._decode(self.task_json(task_hash), Task, "task")

    def _decode(self, text: str, kind: type[T], name: str) -> T:
        """What a manifest keeps as JSON.

        Raises StoreError where another Restock wrote it, or it is damaged.
        """
        try:
            return msgspec.json.decode(text, type=kind, strict=False)
        except msgspec.MsgspecError as error:
            raise StoreError(
                f"the {name} in its recordings' manifests cannot be read: {error}",
                where=str(self.path),
                remedy="a newer Restock wrote it (use that one), or the file is damaged (ingest the"
                " recordings again)",
            ) from error

    def _read_tasks(self) -> dict[str, str]:
        rows = self.connection.sql(
            "SELECT DISTINCT task_hash, task_json FROM stored_recordings"
            " WHERE ingest_id IN (SELECT ingest_id FROM stored_transitions) ORDER BY ALL"
        ).fetchall()
        return dict(rows)

    def _observation_type(self) -> str:
        """Fixed-size where all tasks agree on the size: DuckDB reads Delta's lists as FLOAT[].

        The size of another version's observation is not known.
        """
        tasks = {name: self._decode(text, Task, "task") for name, text in self._tasks.items()}
        sizes = {
            task.observation_size if task.hash == name else None for name, task in tasks.items()
        }
        size = sizes.pop() if len(sizes) == 1 else None
        return f"FLOAT[{size}]" if size else "FLOAT[]"

    def attach(self, connection: duckdb.DuckDBPyConnection, schema: str) -> None:
        """Views and macros of this store in a schema of another connection, beside other stores'.

        Those on demand are not there.

        Raises StoreError where a file is missing or damaged.
        """
        connection.execute(f'CREATE SCHEMA "{schema}"; USE "{schema}"')
        try:
            self._present_all(connection, schema)
            install_first(connection, self.observation_type)
        finally:
            connection.execute("USE main")

    def _present_all(self, connection: duckdb.DuckDBPyConnection, schema: str) -> None:
        """A view `stored_…` of the files of each table.

        What lies on S3 is read at each query, or once, to be held in memory.
        """
        for table in self._tables:
            files = self.files[table.view]
            if files and self.path.folder is not None:
                read_parquet(connection, table.view, files, schema=schema)
                continue
            name = table.view if schema == "main" else f"{schema}_{table.view}"
            with self.path.translate_errors():
                connection.register(name, self._arrow(table))
            if name != table.view:
                connection.execute(f'CREATE VIEW "{schema}".{table.view} AS FROM "{name}"')

    def _arrow(self, table: _Stored) -> pa.Table | pa.dataset.Dataset:
        if not table.paths:
            return table.schema.empty_table()
        parquet = pa.dataset.ParquetFileFormat(
            default_fragment_scan_options=pa.dataset.ParquetFragmentScanOptions(pre_buffer=True)
        )
        remote = pa.dataset.FileSystemDataset(
            [
                parquet.make_fragment(f"{table.name}/{path}", self.path.files)
                for path in table.paths
            ],
            table.schema,
            parquet,
            self.path.files,
        )
        return remote.to_table() if table.hold else remote

    def _set_memory(self, limit: str) -> None:
        try:
            self.connection.execute(f"SET memory_limit = '{limit}'")
        except duckdb.Error as error:
            raise StoreError(
                f"no memory limit {limit!r}", remedy='write it like "4GB" or "512MB"'
            ) from error


def profiles_of(connection: duckdb.DuckDBPyConnection, task_hash: str) -> list[StoredProfile]:
    """The profiles that read the rows of a task, of a connection with a view `recordings`; that of
    the newest ingest first."""
    # Recordings of an older store carry no text: null.
    rows = connection.execute(
        "SELECT profile, profile_hash, arg_max(coalesce(profile_toml, ''), ingested_at)"
        " FROM (FROM recordings UNION ALL BY NAME SELECT NULL::VARCHAR AS profile_toml WHERE false)"
        " WHERE task_hash = ? AND profile <> ''"
        " GROUP BY profile, profile_hash ORDER BY max(ingested_at) DESC, profile_hash",
        [task_hash],
    ).fetchall()
    return [StoredProfile(*row) for row in rows]


def corrected_versions(connection: duckdb.DuckDBPyConnection) -> tuple[str, ...]:
    """The versions of labels that people corrected, of a connection with a view `recordings`."""
    rows = connection.sql(
        "SELECT DISTINCT labels_version FROM recordings WHERE contains(labels_version, '+')"
        " ORDER BY ALL"
    ).fetchall()
    return tuple(version for (version,) in rows)


def is_store(path: str | Path | Location) -> bool:
    """Whether there is a store at `path`. Raises StoreError where the place cannot be reached."""
    place = Location.of(path)
    return all(place.has_table(name) for name in (TRANSITIONS, RECORDINGS))


def _expect(place: Location) -> None:
    if is_store(place):
        return
    raise StoreError(
        "not a store" if place.folder is not None and place.folder.exists() else "no such store",
        where=str(place),
        remedy=f"`restock ingest RECORDINGS --store {place}` makes one",
    )


def _paths(table: DeltaTable) -> list[str]:
    """The table's files, by their paths in it."""
    paths = table.get_add_actions(flatten=True)["path"].to_pylist()
    return [unquote(str(path)) for path in paths]


def _manifests(place: Location, recordings: DeltaTable, rows: Sequence[str]) -> list[str]:
    """The files of the manifests, those of an older version's rows included.

    A manifest is taken out of `recordings` when its rows are replaced. Who reads the rows as they
    were before, by version or because the writer was between two commits, finds it by its name.
    """
    active = _paths(recordings)
    gone = sorted(set(filter(OWN_PATH.fullmatch, rows)) - set(active))
    infos = place.files.get_file_info([f"{RECORDINGS}/{path}" for path in gone])
    return active + [path for path, info in zip(gone, infos, strict=True) if info.is_file]


@contextmanager
def passed_in(connection: duckdb.DuckDBPyConnection, **tables: pa.Table) -> Iterator[None]:
    """Tables that the connection's SQL sees by their names, for as long as the block runs."""
    for name, table in tables.items():
        connection.register(name, table)
    try:
        yield
    finally:
        for name in tables:
            connection.unregister(name)


def read_parquet(
    connection: duckdb.DuckDBPyConnection,
    view: str,
    files: Sequence[str | os.PathLike[str]],
    *,
    schema: str = "main",
    absent: Sequence[str] = (),
) -> None:
    """A view over Parquet files; columns that only some have are null in the others, and so are
    text columns that are `absent` from all.

    Raises:
        StoreError: one of them is missing or damaged.
    """
    try:
        connection.execute(parquet_view(view, files, schema=schema, absent=absent))
    except duckdb.Error as error:
        where = str(files[0]) if len(files) == 1 else os.path.commonpath([str(f) for f in files])
        raise StoreError(
            f"cannot be read: {first_line(error)}",
            where=where,
            remedy="restore the file from a copy, or make it again with the verb that wrote it",
        ) from error


def parquet_view(
    view: str,
    files: Sequence[str | os.PathLike[str]],
    *,
    schema: str | None = None,
    absent: Sequence[str] = (),
) -> str:
    """The statement that makes such a view."""
    quoted = ", ".join("'" + str(file).replace("'", "''") + "'" for file in files)
    name = f'"{schema}"."{view}"' if schema else f'"{view}"'
    nulls = "".join(f", NULL::VARCHAR AS {column}" for column in absent)
    return (
        f"CREATE OR REPLACE VIEW {name} AS"
        f" SELECT *{nulls} FROM read_parquet([{quoted}], union_by_name = true)"
    )
