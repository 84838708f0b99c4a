"""A store open for reading: DuckDB over the Parquet files of one version of its Delta tables.

Queries are read-only, and can use the views of `views.sql` and the macros of `macros.sql`. DuckDB
reads the files of a local folder itself. It reads files on S3 through Arrow, which skips columns
and row groups that a query does not need. Columns, files and row counts come from Delta's log, so
no file of transitions is opened before a query needs it. Manifests are in memory.
"""

from __future__ import annotations

import os
import re
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeVar

import duckdb
import msgspec
import pyarrow as pa

from restock.errors import QueryError, StoreError
from restock.ingest.store.damaged_files import damaged_error, unverified_files, verify_files
from restock.ingest.store.lineage import (
    Ingest,
    StoredFile,
    StoreReader,
    changed_by_others,
    frame_files,
    ingests_table,
    stored_files,
)
from restock.ingest.store.location import FRAMES, RECORDINGS, TRANSITIONS, Location
from restock.ingest.store.version import Version
from restock.ingest.store.writer import RETENTION_HOURS
from restock.ingest.task.conditions import NOMINAL, Condition
from restock.ingest.task.schema import frame_schema
from restock.ingest.task.task import Task
from restock.process import interrupts_raised
from restock.replay.store.definitions import (
    FRAMES_SQL,
    Definitions,
    definitions,
    install_common,
    names_created_in,
)
from restock.replay.store.parquet_views import (
    StoredTable,
    damage,
    literal,
    manifest_tables,
    parquet_view,
    register,
)
from restock.replay.store.query import query
from restock.replay.store.same_drives import SHARED, install_shared_rows

# With these optimizers disabled, joins run as written, with the right side in memory. DuckDB
# estimates one row for each scan of files with given columns, so it would choose to hold all
# transitions in memory to look up their recordings.
AS_WRITTEN = "join_order,build_side_probe_side"
# DuckDB reads a negative limit, "none" or "null" as no limit, and fails at random with zero.
_UNLIMITED_OR_ZERO = re.compile(r"\s*(?:-|none\b|null\b|[0.]+\s*[a-z%])", re.IGNORECASE)
MEMORY_LIMIT = "RESTOCK_MEMORY_LIMIT"  # environment variable
_MEMORY_REMEDY = f'write it like "4GB" or "512MB" ({MEMORY_LIMIT})'
MAX_CLOSES = 500  # attempts to close a connection, 0.01 s apart
T = TypeVar("T")


class StoredProfile(NamedTuple):
    """A profile as stored in the manifests of its recordings."""

    name: str
    hash: str
    toml: str


class Store:
    """A store at one version. Close it, or use it as a context manager.

    Args:
        path: the store's directory, or `s3://bucket/prefix`; `store@12` and `store@2026-11-01` open
            a version of it.
        version: number of a version of `transitions`, or a time, for the newest version at that
            time. Default: the version in the path, or the newest.
        memory_limit: how much memory DuckDB may use, e.g. "4GB". Default: RESTOCK_MEMORY_LIMIT from
            the environment, or DuckDB's own limit (80 %).

    `version` is the number of the open version, `files` has the Parquet files of each table, `bare`
    is a connection with only the views that queries have named so far, and `changed_by_others` has
    the ingests whose rows another tool may have changed. If there are any, no summaries are used.

    Raises:
        StoreError: there is nothing at the path, it is not a store, it has no such version, or it
            cannot be reached.
    """

    @interrupts_raised
    def __init__(
        self,
        path: str | Path | Location,
        *,
        version: Version | None = None,
        memory_limit: str | None = None,
    ) -> None:
        self.path = Location.of(path)
        version = self.path.version if version is None else version
        _expect_store(self.path)
        transitions = self.path.open_table(TRANSITIONS, version)
        recordings = self.path.open_table(RECORDINGS)
        self.version: int = transitions.version()
        self._spill = tempfile.TemporaryDirectory(prefix="restock-")
        self._query_lock = threading.RLock()  # held over all DuckDB calls of one query
        self.bare = duckdb.connect(
            config={
                "temp_directory": self._spill.name,
                "autoinstall_known_extensions": False,
                "disabled_optimizers": AS_WRITTEN,
            }
        )
        set_memory_limit(self.bare, memory_limit, where=self.path)
        try:
            held = stored_files(self.path, TRANSITIONS, transitions)
            self._ingests = ingests_table(held)
            self._recordings, self._summaries = manifest_tables(self.path, recordings, held)
            self._transitions = StoredTable(
                self.path,
                "stored_transitions",
                TRANSITIONS,
                pa.schema(transitions.schema().to_arrow()),
                [file.path for file in held],
            )
            self.files = {one.view: one.addresses for one in (self._recordings, self._transitions)}
            self._manifests = self._recordings.read()
            self.changed_by_others = self._count_changed(held)
            self._present_manifests(self.bare, "main")
            self._frames().present(self.bare)
            if version is not None:  # fail now if files of the old version are gone
                self._present_rows(self.bare, "main")
                query(self.bare, "FROM stored_transitions LIMIT 0", where=str(self.path))
        except StoreError as error:
            if version is None:
                raise
            raise StoreError(
                f"its version {self.version} can no longer be read: {error.what}",
                where=str(self.path),
                remedy=f"files are kept for {RETENTION_HOURS // 24} days after their rows were"
                " replaced: name a newer version, or restore them from a copy",
            ) from error
        self._tasks = self._read_tasks()
        self.observation_type = self._observation_type()
        summaries = self._has_summaries()
        self._definitions = Definitions(
            self.bare,
            self.observation_type,
            summaries=summaries,
            tables={
                "stored_transitions": partial(self._present_rows, self.bare, "main"),
                "stored_summaries": partial(self._summaries.present, self.bare),
            },
            replaced={("novelty",): self._install_novelty}
            | ({SHARED: self._install_shared_rows} if summaries else {}),
        )

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Store {self.path} version {self.version}>"

    @property
    @interrupts_raised
    def connection(self) -> duckdb.DuckDBPyConnection:
        """Return a connection with the common views; `install_named` adds other views."""
        self._definitions.make_common()
        return self.bare

    def verify(self) -> None:
        """Verify the page checksums of the files that queries read, as DuckDB does not.

        Each file is read whole once, and again if its size or write time changes (verified.json).

        Raises:
            StoreError: a file is damaged or missing, or the place cannot be reached.
        """
        if damaged := verify_files(self.path, self._paths()):
            raise damaged_error(self.path, damaged)

    def unverified(self) -> int:
        """Return the number of files that `verify` would read."""
        return unverified_files(self.path, self._paths())

    def close(self) -> None:
        """Close the connection and remove its temporary files.

        If an interrupt has left a thread that still runs a query, that query is stopped first.
        """
        for left in reversed(range(MAX_CLOSES)):
            try:
                self.bare.close()
                break
            except duckdb.Error:
                if not left:
                    raise
                self.bare.interrupt()
                time.sleep(0.01)
        self._spill.cleanup()

    @interrupts_raised
    def sql(self, text: str) -> duckdb.DuckDBPyRelation:
        """Return the result of a query: `.to_arrow_table()`, `.df()`, `.pl()`, `.fetchall()`.

        Raises:
            QueryError: DuckDB refuses the query, the query would write, or another thread still
                reads the result of an earlier query.
        """
        try:
            with self._query_lock:
                self._definitions.make(text)
                return query(self.bare, text, where=str(self.path))
        except (duckdb.Error, QueryError) as error:
            if "connection is busy" not in str(error):
                raise
            raise QueryError(
                "another thread is reading from it",
                where=str(self.path),
                remedy="open a Store in each thread",
            ) from error

    def coverage(self) -> duckdb.DuckDBPyRelation:
        """Return the number of rows, episodes and recordings of each condition, and more."""
        return self.sql("FROM coverage_by_condition")

    def show(self) -> None:
        """Print the coverage."""
        self.coverage().show()

    def add_tables(self, names: tuple[str, ...], install: Callable[[Store], None]) -> None:
        """Call `install` with this store before the first query that contains one of `names`."""
        self._definitions.computed[names] = partial(install, self)

    def conditions(self) -> tuple[Condition, ...]:
        """Return the conditions of the newest ingest, by which the store's rows were labelled.

        They have only the fields that manifests store, such as name, timing, priority and SQL.
        """
        rows = self.sql(
            "SELECT conditions_json FROM recordings ORDER BY ingested_at DESC, ingest_id LIMIT 1"
        ).fetchall()
        if not rows:
            return ()
        return tuple(self._decode(rows[0][0], list[Condition], "conditions"))

    def priority(self) -> list[str]:
        """Return the names of the conditions in order of priority, with `nominal` last."""
        held = sorted(self.conditions(), key=lambda condition: (condition.priority, condition.name))
        return [*(condition.name for condition in held), NOMINAL]

    def exposures(self) -> tuple[Condition, ...]:
        """Return the exposures of the newest ingest; ingests of older versions have none."""
        rows = self.sql(
            "SELECT exposures_json FROM recordings ORDER BY ingested_at DESC, ingest_id LIMIT 1"
        ).fetchall()
        found = self._decode(rows[0][0], list[Condition], "exposures") if rows else []
        return tuple(msgspec.structs.replace(one, kind="exposure") for one in found)

    def profile_name(self, task_hash: str) -> str:
        """Return the name of the newest profile that rows of a task were ingested with, or ""."""
        self._definitions.make("recordings")
        profiles = profiles_of(self.bare, task_hash)
        return profiles[0].name if profiles else ""

    def task_hashes(self) -> list[str]:
        """Return the hashes of the tasks of the store's rows, sorted."""
        return sorted(self._tasks)

    def task_json(self, task_hash: str | None = None) -> str:
        """Return the task of the store's rows as JSON.

        Raises StoreError if the store has no such task, or has several and `task_hash` is None.
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
        """Return the task of the store's rows. Raises StoreError as `task_json` does."""
        return self._decode(self.task_json(task_hash), Task, "task")

    def episode_ends(self, recordings: Sequence[str] = ()) -> Iterator[tuple[str, pa.Table]]:
        """Yield recording ids with a table of the last steps of their episodes, one row each.

        An empty `recordings` means all recordings.
        """
        held = [
            Ingest(one["recording_id"], one["ingest_id"], one["rows"])
            for one in self._ingests.to_pylist()
            if not recordings or one["recording_id"] in recordings
        ]
        yield from StoreReader(self.path).ends(held)

    def _decode(self, text: str, kind: type[T], name: str) -> T:
        """Decode JSON from a manifest.

        Raises StoreError if another version of Restock wrote it, or it is damaged.
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
        rows = self.bare.sql(
            "SELECT DISTINCT task_hash, task_json FROM stored_recordings"
            " WHERE ingest_id IN (SELECT ingest_id FROM stored_ingests) ORDER BY ALL"
        ).fetchall()
        return dict(rows)

    def _observation_type(self) -> str:
        """Return `FLOAT[size]` if all tasks have observations of one size, else `FLOAT[]`.

        The size is unknown for tasks of another version of Restock.
        """
        tasks = {name: self._decode(text, Task, "task") for name, text in self._tasks.items()}
        sizes = {
            task.observation_size if task.hash == name else None for name, task in tasks.items()
        }
        size = sizes.pop() if len(sizes) == 1 else None
        return f"FLOAT[{size}]" if size else "FLOAT[]"

    def attach(self, connection: duckdb.DuckDBPyConnection, schema: str) -> None:
        """Create this store's common views in a new schema of a connection to several stores.

        From then on, the connection runs joins as written.

        Raises StoreError if a file is missing or damaged.
        """
        connection.execute(f"SET disabled_optimizers = '{AS_WRITTEN}'")
        connection.execute(f'CREATE SCHEMA "{schema}"; USE "{schema}"')
        try:
            self._present_manifests(connection, schema)
            self._present_rows(connection, schema)
            install_common(connection, self.observation_type)
        finally:
            connection.execute("USE main")

    def _count_changed(self, held: Sequence[StoredFile]) -> list[str]:
        """Return the ingests whose rows other tools may have changed since ingest.

        In memory, also set `transitions` of their manifests to the number of rows in the files.
        """
        ids, place = self._manifests["ingest_id"], self._manifests.column_names.index("transitions")
        written = dict(zip(ids.to_pylist(), self._manifests[place].to_pylist(), strict=True))
        changed = changed_by_others(held, written)
        if changed:
            counts = [(written | changed)[one] for one in ids.to_pylist()]
            column = pa.array(counts, self._manifests[place].type)
            self._manifests = self._manifests.set_column(place, "transitions", column)
        return sorted(changed)

    def _has_summaries(self) -> bool:
        """Return whether each ingest has a manifest, and no other tool has changed rows."""
        manifests = set(self._manifests["ingest_id"].to_pylist())
        held = self._ingests["ingest_id"].to_pylist()
        return bool(held) and not self.changed_by_others and manifests.issuperset(held)

    def _install_shared_rows(self) -> None:
        """Replace the view `shared_rows`, which scans rows, by a table computed from manifests."""
        held = self._ingests.to_pylist()
        recordings = {one["ingest_id"]: one["recording_id"] for one in held}
        rows = sum(one["rows"] for one in held)
        install_shared_rows(self.bare, self._summaries.row_groups, recordings, rows)

    def _install_novelty(self) -> None:
        """Replace the view `novelty`, which is all null, by a table of measured values."""
        from restock.replay.store.novelty import kept_novelty  # pyarrow.compute is slow to import

        try:
            self.bare.register("found_novelty", kept_novelty(self))
        except duckdb.Error as error:
            raise damage(error, where=str(self.path)) or error from error
        self.bare.execute(
            "CREATE TABLE stored_novelty AS FROM found_novelty;"
            " CREATE OR REPLACE VIEW novelty AS FROM stored_novelty"
        )
        self.bare.unregister("found_novelty")

    def _present_manifests(self, connection: duckdb.DuckDBPyConnection, schema: str) -> None:
        """Create `stored_ingests` (the ingests in each file) and `stored_recordings`, in memory."""
        register(connection, "stored_ingests", self._ingests, schema=schema)
        register(connection, self._recordings.view, self._manifests, schema=schema)

    def _present_rows(self, connection: duckdb.DuckDBPyConnection, schema: str) -> None:
        """Create the view `stored_transitions`."""
        try:
            self._transitions.present(connection, schema=schema)
        except StoreError as error:
            cause = error.__cause__
            raise (isinstance(cause, duckdb.Error) and damage(cause)) or error from error

    def _paths(self) -> list[str]:
        """Return the files of rows and manifests, as paths relative to the store."""
        tables = (self._transitions, self._recordings)
        return [f"{table.table}/{path}" for table in tables for path in table.paths]

    def _frames(self) -> StoredTable:
        """Return the table of camera frames: the files that manifests of the open version name."""
        files = frame_files(self._manifests)
        if files:
            import pyarrow.compute as pc  # slow to import

            held = pc.is_in(self._manifests["ingest_id"], self._ingests["ingest_id"])
            files = frame_files(self._manifests.filter(held))
        return StoredTable(self.path, "stored_frames", FRAMES, frame_schema(), files)


def set_memory_limit(
    connection: duckdb.DuckDBPyConnection, limit: str | None = None, *, where: object
) -> None:
    """Limit DuckDB's memory to `limit`, or to RESTOCK_MEMORY_LIMIT if that is set.

    Raises StoreError if the limit is not a size.
    """
    limit = limit or os.environ.get(MEMORY_LIMIT)
    if not limit:
        return
    if _UNLIMITED_OR_ZERO.match(limit):
        raise StoreError(
            f"the memory limit {limit!r} is not a positive size",
            where=str(where),
            remedy=_MEMORY_REMEDY,
        )
    try:
        connection.execute(f"SET memory_limit = '{limit}'")
    except duckdb.Error as error:
        raise StoreError(
            f"the memory limit {limit!r} is not a size", where=str(where), remedy=_MEMORY_REMEDY
        ) from error


def profiles_of(connection: duckdb.DuckDBPyConnection, task_hash: str) -> list[StoredProfile]:
    """Return the profiles that rows of a task were ingested with, by newest ingest first.

    The connection must have a view `recordings`.
    """
    rows = connection.execute(
        "SELECT profile, profile_hash, arg_max(profile_toml, ingested_at)"
        " FROM recordings"
        " WHERE task_hash = ? AND profile <> ''"
        " GROUP BY profile, profile_hash ORDER BY max(ingested_at) DESC, profile_hash",
        [task_hash],
    ).fetchall()
    return [StoredProfile(*row) for row in rows]


def corrected_versions(connection: duckdb.DuckDBPyConnection) -> tuple[str, ...]:
    """Return the versions of labels that contain corrections by people.

    The connection must have a view `recordings`.
    """
    rows = connection.sql(
        "SELECT DISTINCT labels_version FROM recordings WHERE contains(labels_version, '+')"
        " ORDER BY ALL"
    ).fetchall()
    return tuple(version for (version,) in rows)


def is_store(path: str | Path | Location) -> bool:
    """Return whether there is a store at `path`.

    Raises StoreError if the place cannot be reached.
    """
    place = Location.of(path)
    return all(place.has_table(name) for name in (TRANSITIONS, RECORDINGS))


def _expect_store(place: Location) -> None:
    if is_store(place):
        return
    place.expect_both_tables()
    raise place.absent()


# DuckDB 1.4 and later can read files of this version, which all newer DuckDBs can write.
STORAGE_VERSION = "v1.4.0"


def init_script(store: Store) -> str:
    """Return SQL that creates the store's views and macros, for `duckdb -init FILE`.

    It names the files of the open version by absolute paths: write it again after an ingest.
    """
    beside = set(names_created_in(FRAMES_SQL))  # views left out: their files are in no Delta table
    columns = ", ".join(
        "(" + ", ".join(literal(value) for value in row) + ")"
        for row in store.sql("FROM columns").fetchall()
        if row[0] not in beside
    )
    return "\n".join(
        [
            f"-- {store.path}, version {store.version}",
            *(
                parquet_view(view, [Path(file).absolute() for file in files]) + ";"
                for view, files in store.files.items()
            ),
            definitions(store.observation_type),
            f"CREATE OR REPLACE VIEW columns AS FROM (VALUES {columns})"
            ' AS columns ("view", "column_name", "type", "unit", "meaning");',
            "",
        ]
    )


def export_views(store: Store, out: str | Path) -> Path:
    """Write a store's views to `out`, an init file (.sql) or a database of views (.duckdb).

    Raises StoreError for other endings, an existing file, an empty store, or a store on S3.
    """
    out = Path(out)
    if out.suffix not in (".sql", ".duckdb"):
        ending = out.suffix or "a file without an ending"
        raise StoreError(f"cannot export to {ending}", where=str(out),
                         remedy="name it .sql (for `duckdb -init`) or .duckdb; or give a query,"
                         " whose rows go to a .parquet, .csv or .json file")  # fmt: skip
    if out.exists():
        raise StoreError(
            "already there", where=str(out), remedy="choose another name, or remove it"
        )
    if store.path.folder is None:
        raise StoreError(
            "views of a store on S3 cannot be exported to other DuckDBs",
            where=str(store.path),
            remedy="query it with `restock sql`, or from Python with restock.open()",
        )
    if not all(store.files.values()):
        raise StoreError("it holds no recordings to view", where=str(store.path))
    partial = out.with_name(f".{out.name}.partial")
    partial.unlink(missing_ok=True)
    out.parent.mkdir(parents=True, exist_ok=True)
    try:
        if out.suffix == ".sql":
            partial.write_text(init_script(store), encoding="utf-8")
        else:
            with duckdb.connect() as connection:
                connection.execute(
                    f"ATTACH {literal(partial)} AS views (STORAGE_VERSION '{STORAGE_VERSION}');"
                    " USE views"
                )
                connection.execute(init_script(store))
                connection.execute("USE memory; DETACH views")
        partial.rename(out)
    finally:
        partial.unlink(missing_ok=True)
    return out
