"""Create views over Parquet files and Arrow tables on a DuckDB connection.

DuckDB's errors about damaged files of a store become errors with a remedy.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import duckdb
import pyarrow as pa
from deltalake import DeltaTable

from restock.errors import StoreError
from restock.files import first_line
from restock.ingest.store.lineage import (
    StoredFile,
    damage_named,
    damage_remedy,
    own_path,
    stored_files,
)
from restock.ingest.store.location import FRAMES, RECORDINGS, TRANSITIONS, Location
from restock.ingest.store.summary import SUMMARY_SCHEMA, TABLES
from restock.ingest.task.schema import DOCUMENTS

if TYPE_CHECKING:
    from pyarrow.dataset import Dataset

# Finds the path of a store's file in DuckDB's error messages.
_FILE = re.compile(
    rf"""["'](?P<store>[^"']+)/(?P<file>(?:{TRANSITIONS}|{RECORDINGS}|{FRAMES})/[^"']+\.parquet)["']"""
)
# Finds errors by which DuckDB reports damage without naming the file.
_NAMELESS = re.compile(
    r"TProtocolException|[Dd]ecompress|[Tt]hrift|[Pp]arquet (?:file|page|reader)"
)
REMAKE = "restore the file from a copy, or make it again with the command that wrote it"
_OTHER = (
    *(duckdb.CatalogException, duckdb.BinderException, duckdb.ParserException),
    *(duckdb.OutOfMemoryException, duckdb.InterruptException),
)


@contextmanager
def passed_in(connection: duckdb.DuckDBPyConnection, **tables: pa.Table) -> Iterator[None]:
    """Make tables visible to the connection's SQL by their names while the block runs."""
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
    kinds: Mapping[str, str] | None = None,
) -> None:
    """Create a view over Parquet files.

    A column that a file lacks is null in its rows. If `kinds` gives the types of the columns, no
    file is opened.

    Raises:
        StoreError: a file is missing or damaged.
    """
    try:
        if kinds is None:
            connection.execute(parquet_view(view, files, schema=schema))
        else:
            _view_of_known(connection, view, files, kinds, schema=schema)
    except duckdb.Error as error:
        where = str(files[0]) if len(files) == 1 else os.path.commonpath([str(f) for f in files])
        raise StoreError(
            f"cannot be read: {first_line(error)}",
            where=where,
            remedy=REMAKE,
        ) from error


def parquet_view(
    view: str,
    files: Sequence[str | os.PathLike[str]],
    *,
    schema: str | None = None,
) -> str:
    """Return the statement that creates a view over Parquet files with unknown columns.

    Each query that names the view opens every file to find its columns.
    """
    name = f'"{schema}"."{view}"' if schema else f'"{view}"'
    listed = ", ".join(map(literal, files))
    return f"CREATE OR REPLACE VIEW {name} AS FROM read_parquet([{listed}], union_by_name = true)"


def _view_of_known(
    connection: duckdb.DuckDBPyConnection,
    view: str,
    files: Sequence[str | os.PathLike[str]],
    kinds: Mapping[str, str],
    *,
    schema: str,
) -> None:
    """Create a view over Parquet files with the column types `kinds`.

    Files and types become variables of the connection. If the view's text had them, each query that
    names the view would parse them again.
    """
    fields = ", ".join(
        f"{literal(column)}: {{name: {literal(column)}, type: {literal(kind)},"
        " default_value: NULL}"
        for column, kind in kinds.items()
    )
    files_name, types_name = f"{schema}_{view}_files", f"{schema}_{view}_types"
    connection.execute(f'SET VARIABLE "{files_name}" = $1', [[str(file) for file in files]])
    connection.execute(
        f'SET VARIABLE "{types_name}" = MAP {{{fields}}};'
        f' CREATE OR REPLACE VIEW "{schema}"."{view}" WITH (DEFER_BINDING) AS FROM read_parquet('
        f"getvariable({literal(files_name)}), schema = getvariable({literal(types_name)}))"
    )


def damage(error: duckdb.Error, *, where: str | None = None) -> StoreError | None:
    """Return a StoreError if a query failed because of a damaged or missing file, else None.

    The error names the store `where` if DuckDB does not name the file.
    """
    text = str(error)
    if isinstance(error, _OTHER):
        return None
    named = _FILE.search(text)
    if named and (Path(named["store"]) / TRANSITIONS / "_delta_log").is_dir():
        missing = not (Path(named["store"]) / named["file"]).exists()
        problem = "is missing" if missing else f"cannot be read: {first_line(error)}"
        place = Location.of(named["store"])
        return StoreError(
            f"its file {named['file']} {problem}",
            where=str(place),
            remedy=damage_remedy(place, named["file"]),
        )
    if not _NAMELESS.search(text):
        return None
    return StoreError(
        f"is damaged or cannot be read: {first_line(error)}",
        where=where,
        remedy="restore its files from a copy, or run `restock store compact STORE --drop-damaged`,"
        " which finds the file and names the recordings to ingest again",
    )


def column_types(connection: duckdb.DuckDBPyConnection, schema: pa.Schema) -> dict[str, str]:
    """Return the DuckDB type of each column of an Arrow schema."""
    with passed_in(connection, columns_of_schema=schema.empty_table()):
        rows = connection.sql("DESCRIBE columns_of_schema").fetchall()
    return {str(row[0]): str(row[1]) for row in rows}


def literal(value: object) -> str:
    """Return a value as a string literal of SQL; None as NULL."""
    return "NULL" if value is None else "'" + str(value).replace("'", "''") + "'"


_TEXT = pa.dictionary(pa.int32(), pa.string())
FEW_FILES = 64  # up to so many files are read one by one: faster than to import Arrow's data sets


@dataclass(frozen=True)
class StoredTable:
    """The files of one table of a store, and the columns to read from them."""

    place: Location
    view: str
    table: str
    schema: pa.Schema  # columns to read
    paths: Sequence[str]  # relative to the table

    @cached_property
    def addresses(self) -> list[str]:
        """Return the full paths or addresses of the files."""
        folder = self.place.table(self.table)
        return [f"{folder}/{path}" for path in self.paths]

    def present(self, connection: duckdb.DuckDBPyConnection, *, schema: str = "main") -> None:
        """Create the view over the files, which are read at each query (on S3 by Arrow).

        Raises:
            StoreError: a file is missing or damaged, or the place cannot be reached.
        """
        if self.paths and self.place.folder is not None:
            kinds, files = column_types(connection, self.schema), self.addresses
            read_parquet(connection, self.view, files, schema=schema, kinds=kinds)
            return
        with self.place.translate_errors():
            register(connection, self.view, self._dataset(), schema=schema)

    def read(self) -> pa.Table:
        """Read all rows into memory; columns that a file lacks are null.

        Raises:
            StoreError: a file is missing or damaged, or the place cannot be reached.
        """
        try:
            with self.place.translate_errors():
                if len(self.paths) <= FEW_FILES and self.place.folder is not None:
                    return self._read_each()
                rows = self._dataset()
                return rows if isinstance(rows, pa.Table) else rows.to_table()
        except (OSError, pa.ArrowException) as error:
            raise StoreError(
                f"its manifests cannot be read: {first_line(error)}",
                where=str(self.place),
                remedy=damage_remedy(self.place, self.table),
            ) from error

    def row_groups(self, columns: Sequence[str]) -> Iterator[pa.Table]:
        """Yield the rows of each row group; `columns` are as for `Location.row_groups`.

        Raises:
            StoreError: a file is missing or damaged, or the place cannot be reached.
        """
        for path in self.paths:
            place = f"{self.table}/{path}"
            with damage_named(self.place, place):
                yield from self.place.row_groups(place, columns)

    def _dataset(self) -> pa.Table | Dataset:
        if not self.paths:
            return self.schema.empty_table()
        from pyarrow import dataset

        parquet = dataset.ParquetFileFormat(
            default_fragment_scan_options=dataset.ParquetFragmentScanOptions(
                pre_buffer=True, page_checksum_verification=True
            )
        )
        fragments = [
            parquet.make_fragment(f"{self.table}/{path}", self.place.files) for path in self.paths
        ]
        return dataset.FileSystemDataset(fragments, self.schema, parquet, self.place.files)

    def _read_each(self) -> pa.Table:
        """Read the manifests file by file; keep texts that recordings share in memory only once."""
        schema = pa.schema(
            [field.with_type(_TEXT) if field.name in DOCUMENTS else field for field in self.schema]
        )
        parts = []
        for path in self.paths:
            place = f"{self.table}/{path}"
            with damage_named(self.place, place):
                part = self.place.read(place, columns=schema.names, repeated=DOCUMENTS)
            kinds = pa.schema([schema.field(name) for name in part.column_names])
            if part.schema.types != kinds.types:  # other tools write text as views or large strings
                part = part.cast(kinds)
            parts.append(part.replace_schema_metadata(None))
        return pa.concat_tables([schema.empty_table(), *parts], promote_options="default")


def manifest_tables(
    place: Location, recordings: DeltaTable, held: Sequence[StoredFile]
) -> tuple[StoredTable, StoredTable]:
    """Return the manifests of these transition files as two tables, which split the columns.

    `stored_summaries` has ingest ids and summaries, and `stored_recordings` all other columns.
    """
    paths = _manifests(place, recordings, held)
    columns = pa.schema(recordings.schema().to_arrow())
    reported = [one for one in columns if one.name not in set(SUMMARY_SCHEMA.names)]
    kept = [columns.field("ingest_id"), *(one for one in SUMMARY_SCHEMA if one.name in TABLES)]
    return (
        StoredTable(place, "stored_recordings", RECORDINGS, pa.schema(reported), paths),
        StoredTable(place, "stored_summaries", RECORDINGS, pa.schema(kept), paths),
    )


def register(
    connection: duckdb.DuckDBPyConnection,
    view: str,
    rows: pa.Table | Dataset,
    *,
    schema: str = "main",
) -> None:
    """Create a view over an Arrow table or data set in an existing schema."""
    name = view if schema == "main" else f"{schema}_{view}"
    connection.register(name, rows)
    if name != view:
        connection.execute(f'CREATE VIEW "{schema}".{view} AS FROM "{name}"')


def _manifests(place: Location, recordings: DeltaTable, held: Sequence[StoredFile]) -> list[str]:
    """Return the manifest files of these transition files, also for rows of an older version.

    A manifest is removed from `recordings` when its rows are replaced. A reader of the old rows (at
    an older version, or between the writer's two commits) still finds it by its file name.
    """
    wanted = {one.ingest_id: one for file in held for one in file.ingests}
    active = [
        file
        for file in stored_files(place, RECORDINGS, recordings)
        if any(one.ingest_id in wanted for one in file.ingests)
    ]
    active_ids = {one.ingest_id for file in active for one in file.ingests}
    ingests = (one for ingest_id, one in wanted.items() if ingest_id not in active_ids)
    gone = sorted({own_path(one.recording_id, one.ingest_id) for one in ingests})
    infos = place.files.get_file_info([f"{RECORDINGS}/{path}" for path in gone])
    found = [path for path, info in zip(gone, infos, strict=True) if info.is_file]
    return [file.path for file in active] + found
