"""Figures are queries: the named statements of a package's `.sql` file, and their rows."""

from __future__ import annotations

from importlib.resources import files
from typing import Any

import duckdb

from restock.report.look.blocks import Rows


def statements(package: str, name: str) -> dict[str, str]:
    """Split a file into statements, by the `-- name:` line before each."""
    text = (files(package) / name).read_text(encoding="utf-8")
    parts = text.split("-- name: ")[1:]
    return {part.split("\n", 1)[0].strip(): part.split("\n", 1)[1] for part in parts}


def rows_of(cursor: duckdb.DuckDBPyConnection) -> Rows:
    """Return the result of a query as dicts."""
    names = [column[0] for column in cursor.description or ()]
    return [dict(zip(names, row, strict=True)) for row in cursor.fetchall()]


def ask(connection: Any, sql: str, **parameters: Any) -> Rows:
    """Run a query with its `$name` parameters."""
    return rows_of(connection.execute(sql, parameters or None))


__all__ = ["ask", "rows_of", "statements"]
