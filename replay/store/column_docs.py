"""Describe each column of each view: the view `columns`."""

from __future__ import annotations

import tomllib
from importlib.resources import files

import duckdb
import pyarrow as pa

from restock.ingest.task.schema import (
    COLUMNS,
    FRAME_COLUMNS,
    RECORDING_COLUMNS,
)

HELD = "held_conditions"  # has every column of `transitions`, and `condition`

# A name's ending -> its unit. Longer endings first.
UNITS = (
    ("_mps2", "m/s²"),
    ("_mps", "m/s"),
    ("_radps", "rad/s"),
    ("_radpm", "rad/m"),
    ("_rad", "rad"),
    ("_days", "days"),
    ("_ns", "ns"),
    ("_s", "s"),
    ("_m", "m"),
    ("_share", "1"),
    ("_fraction", "1"),
)


def view_docs() -> dict[str, str]:
    """Return what each view is, by name."""
    return {name: table["doc"] for name, table in _read().items() if name != "shared"}


def column_docs() -> dict[tuple[str, str], str]:
    """(view, column) -> meaning, as far as they are named there; see `meaning` for the rest."""
    meanings = {
        (view, column): text
        for view, table in _read().items()
        for column, text in table.items()
        if column != "doc"
    }
    meanings |= {
        ("transitions", column.name): column.meaning
        for column in COLUMNS
        if column.name != "condition"  # rows.sql has another name for it
    }
    meanings |= {("recordings", column.name): column.meaning for column in RECORDING_COLUMNS}
    meanings |= {
        ("frames", column.name): column.meaning for column in FRAME_COLUMNS if column.name != "data"
    }
    return meanings


def unit(column: str) -> str:
    """Return a column's unit, from its name's ending; "" for none."""
    return next((unit for ending, unit in UNITS if column.endswith(ending)), "")


def install_columns(connection: duckdb.DuckDBPyConnection) -> None:
    """Create the view `columns` over the views that are there."""
    docs, own_units = column_docs(), {}
    for name, own_unit, meaning, topic, path in _custom(connection):
        docs["transitions", name] = meaning or f"{path} of {topic}"
        own_units["transitions", name] = own_unit
    for view, column in [key for key in docs if key[0] == "transitions"]:
        docs.setdefault((HELD, column), docs[view, column])
        own_units[HELD, column] = own_units.get((view, column), "")
    columns = connection.sql(
        "SELECT table_name, column_name, data_type FROM duckdb_columns()"
        " WHERE NOT internal AND table_name NOT LIKE 'stored_%' ORDER BY table_name, column_index"
    ).fetchall()
    order = list(view_docs())
    columns = [(view, column, kind) for view, column, kind in columns if view in order]
    of_columns = [
        ("columns", name, "VARCHAR") for name in ("view", "column_name", "type", "unit", "meaning")
    ]
    rows = [
        {
            "view": view,
            "column_name": column,
            "type": kind,
            "unit": own_units.get((view, column)) or unit(column),
            "meaning": docs.get((view, column)) or docs.get(("shared", column)),
        }
        for view, column, kind in sorted(columns, key=lambda row: order.index(row[0])) + of_columns
    ]
    names = ("view", "column_name", "type", "unit", "meaning")
    schema = pa.schema([pa.field(name, pa.string()) for name in names])
    connection.register("columns", pa.Table.from_pylist(rows, schema=schema))


def _custom(connection: duckdb.DuckDBPyConnection) -> list[tuple[str, ...]]:
    """Return the custom signals of the store's profiles: name, unit, meaning, topic and path."""
    has = connection.sql(
        "SELECT 1 FROM duckdb_columns() WHERE table_name = 'recordings' AND column_name = 'signals'"
    ).fetchall()
    if not has:
        return []
    return connection.sql(
        "SELECT DISTINCT ON (s.name) s.name, s.unit, s.meaning, s.topic, s.path"
        " FROM (SELECT ingested_at, unnest(signals) AS s FROM recordings) ORDER BY ingested_at DESC"
    ).fetchall()


def _read() -> dict[str, dict[str, str]]:
    text = (files("restock.replay.store") / "columns.toml").read_text(encoding="utf-8")
    tables: dict[str, dict[str, str]] = tomllib.loads(text)
    return tables
