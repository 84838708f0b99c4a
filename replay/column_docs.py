"""What each column of each view means: the view `columns`, and the table in docs/sql.md."""

from __future__ import annotations

import tomllib
from importlib.resources import files

import duckdb
import pyarrow as pa

from restock.ingest.schema import COLUMNS, RECORDING_COLUMNS

# A name's ending -> its unit. Longer endings first.
UNITS = (
    ("_mps2", "m/s²"),
    ("_mps", "m/s"),
    ("_radps", "rad/s"),
    ("_rad", "rad"),
    ("_days", "days"),
    ("_ns", "ns"),
    ("_s", "s"),
    ("_m", "m"),
    ("_share", "1"),
    ("_fraction", "1"),
)


def view_docs() -> dict[str, str]:
    """What each view is, by name."""
    return {name: table["doc"] for name, table in _read().items() if name != "shared"}


def column_docs() -> dict[tuple[str, str], str]:
    """(view, column) -> meaning, as far as they are named there; see `meaning` for the rest."""
    found = {
        (view, column): text
        for view, table in _read().items()
        for column, text in table.items()
        if column != "doc"
    }
    found |= {("transitions", column.name): column.meaning for column in COLUMNS}
    found |= {("recordings", column.name): column.meaning for column in RECORDING_COLUMNS}
    return found


def unit(column: str) -> str:
    """A column's unit, from its name's ending; "" for none."""
    return next((unit for ending, unit in UNITS if column.endswith(ending)), "")


def install_columns(connection: duckdb.DuckDBPyConnection) -> None:
    """Create the view `columns` over the views that are there."""
    docs = column_docs()
    there = connection.sql(
        "SELECT table_name, column_name, data_type FROM duckdb_columns()"
        " WHERE NOT internal AND table_name NOT LIKE 'stored_%' ORDER BY table_name, column_index"
    ).fetchall()
    order = list(view_docs())
    there = [(view, column, kind) for view, column, kind in there if view in order]
    own = [("columns", name, "VARCHAR") for name in ("view", "column", "type", "unit", "meaning")]
    rows = [
        {
            "view": view,
            "column": column,
            "type": kind,
            "unit": unit(column),
            "meaning": docs.get((view, column)) or docs.get(("shared", column)),
        }
        for view, column, kind in sorted(there, key=lambda row: order.index(row[0])) + own
    ]
    names = ("view", "column", "type", "unit", "meaning")
    schema = pa.schema([pa.field(name, pa.string()) for name in names])
    connection.register("columns", pa.Table.from_pylist(rows, schema=schema))


def _read() -> dict[str, dict[str, str]]:
    text = (files("restock.replay") / "columns.toml").read_text(encoding="utf-8")
    tables: dict[str, dict[str, str]] = tomllib.loads(text)
    return tables
