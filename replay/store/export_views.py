"""The views of a store for any DuckDB: an init file, or a database file of views."""

from __future__ import annotations

from pathlib import Path

import duckdb

from restock.errors import StoreError
from restock.replay.store.definitions import FRAMES, definitions, made_by
from restock.replay.store.parquet_views import parquet_view
from restock.replay.store.store import Store

# Written by any newer DuckDB, a file of this version is read by DuckDB 1.4 and later.
STORAGE_VERSION = "v1.4.0"


def init_script(store: Store) -> str:
    """Return SQL that creates the store's views and macros, for `duckdb -init FILE`.

    Paths are absolute, and of the version that is open: write it again after an ingest.
    """
    beside = set(made_by(FRAMES))  # their files are none of the tables
    columns = ", ".join(
        "(" + ", ".join(_literal(value) for value in row) + ")"
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
    """Write `out`: an init file (.sql), or a database of views (.duckdb).

    Raises StoreError for another ending, a file that already exists, or an empty store.
    """
    out = Path(out)
    if out.suffix not in (".sql", ".duckdb"):
        raise StoreError(f"no export to {out.suffix or 'a file without an ending'}", where=str(out),
                         remedy="name it .sql (for `duckdb -init`) or .duckdb")  # fmt: skip
    if out.exists():
        raise StoreError(
            "already there", where=str(out), remedy="choose another name, or remove it"
        )
    if store.path.folder is None:
        raise StoreError(
            "views of a store on S3 cannot be exported to other DuckDBs",
            where=str(store.path),
            remedy="ask it with `restock sql`, or from Python with restock.open()",
        )
    if not all(store.files.values()):
        raise StoreError("it holds no recordings to look at", where=str(store.path))
    partial = out.with_name(f".{out.name}.partial")
    partial.unlink(missing_ok=True)
    out.parent.mkdir(parents=True, exist_ok=True)
    try:
        if out.suffix == ".sql":
            partial.write_text(init_script(store), encoding="utf-8")
        else:
            with duckdb.connect() as connection:
                quoted = str(partial).replace("'", "''")
                connection.execute(
                    f"ATTACH '{quoted}' AS views (STORAGE_VERSION '{STORAGE_VERSION}'); USE views"
                )
                connection.execute(init_script(store))
                connection.execute("USE memory; DETACH views")
        partial.rename(out)
    finally:
        partial.unlink(missing_ok=True)
    return out


def _literal(value: object) -> str:
    return "NULL" if value is None else "'" + str(value).replace("'", "''") + "'"
