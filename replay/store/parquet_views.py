"""Views over Parquet files and Arrow tables on a DuckDB connection.

DuckDB's errors about damaged files of a store become errors that say what to do.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import duckdb
import pyarrow as pa

from restock.errors import StoreError
from restock.files import first_line
from restock.ingest.store.lineage import damage_remedy
from restock.ingest.store.location import FRAMES, RECORDINGS, TRANSITIONS, Location

# A file of a store, as DuckDB quotes it.
_FILE = re.compile(
    rf"""["'](?P<store>[^"']+)/(?P<file>(?:{TRANSITIONS}|{RECORDINGS}|{FRAMES})/[^"']+\.parquet)["']"""
)
# Of some damage DuckDB does not say in which file it is.
_NAMELESS = re.compile(
    r"TProtocolException|[Dd]ecompress|[Tt]hrift|[Pp]arquet (?:file|page|reader)"
)
REMAKE = "restore the file from a copy, or make it again with the verb that wrote it"
_OTHER = (
    *(duckdb.CatalogException, duckdb.BinderException, duckdb.ParserException),
    *(duckdb.OutOfMemoryException, duckdb.InterruptException),
)


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
    kinds: Mapping[str, str] | None = None,
) -> None:
    """Create a view over Parquet files.

    A column that a file lacks is null in its rows; text columns that are `absent` from all files
    are null everywhere. If `kinds` gives the types of the columns, no file is opened.

    Raises:
        StoreError: one of them is missing or damaged.
    """
    try:
        if kinds is None:
            connection.execute(parquet_view(view, files, schema=schema, absent=absent))
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
    absent: Sequence[str] = (),
) -> str:
    """Return the statement that creates such a view.

    Each query that names the view opens every file to find out its columns.
    """
    name = f'"{schema}"."{view}"' if schema else f'"{view}"'
    nulls = "".join(f", NULL::VARCHAR AS {column}" for column in absent)
    return (
        f"CREATE OR REPLACE VIEW {name} AS SELECT *{nulls}"
        f" FROM read_parquet({_list(files)}, union_by_name = true)"
    )


def _view_of_known(
    connection: duckdb.DuckDBPyConnection,
    view: str,
    files: Sequence[str | os.PathLike[str]],
    kinds: Mapping[str, str],
    *,
    schema: str,
) -> None:
    """Create a view of columns of these types.

    Files and types are variables of the connection. If they were part of the view, each query that
    names it would parse them again.
    """
    fields = ", ".join(
        f"{_literal(column)}: {{name: {_literal(column)}, type: {_literal(kind)},"
        " default_value: NULL}"
        for column, kind in kinds.items()
    )
    files_name, types_name = f"{schema}_{view}_files", f"{schema}_{view}_types"
    connection.execute(f'SET VARIABLE "{files_name}" = $1', [[str(file) for file in files]])
    connection.execute(
        f'SET VARIABLE "{types_name}" = MAP {{{fields}}};'
        f' CREATE OR REPLACE VIEW "{schema}"."{view}" AS FROM read_parquet('
        f"getvariable({_literal(files_name)}), schema = getvariable({_literal(types_name)}))"
    )


def damage(error: duckdb.Error, *, where: str | None = None) -> StoreError | None:
    """Translate a query's error if its cause is a damaged or missing file; else return None.

    `where` is the store to name if DuckDB does not name the file.
    """
    text = str(error)
    if isinstance(error, _OTHER):
        return None
    named = _FILE.search(text)
    if named and (Path(named["store"]) / TRANSITIONS / "_delta_log").is_dir():
        missing = not (Path(named["store"]) / named["file"]).exists()
        said = "is missing" if missing else f"cannot be read: {first_line(error)}"
        place = Location.of(named["store"])
        return StoreError(
            f"its file {named['file']} {said}",
            where=str(place),
            remedy=damage_remedy(place, named["file"]),
        )
    if not _NAMELESS.search(text):
        return None
    return StoreError(
        f"is damaged or cannot be read: {first_line(error)}",
        where=where,
        remedy="restore its files from a copy, or let `restock store compact STORE --drop-damaged`"
        " find the file: it names the recordings to ingest again",
    )


def _list(files: Sequence[str | os.PathLike[str]]) -> str:
    return "[" + ", ".join(_literal(str(file)) for file in files) + "]"


def column_types(connection: duckdb.DuckDBPyConnection, schema: pa.Schema) -> dict[str, str]:
    """Columns of an Arrow schema with DuckDB's types."""
    with passed_in(connection, columns_of_schema=schema.empty_table()):
        rows = connection.sql("DESCRIBE columns_of_schema").fetchall()
    return {str(row[0]): str(row[1]) for row in rows}


def _literal(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"
