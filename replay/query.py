"""Queries: the views and macros of a connection, read-only, with errors worth reading."""

from __future__ import annotations

from importlib.resources import files

import duckdb

from restock.errors import QueryError

# Statements that would write a file, or reach one that the views do not show.
_REFUSED = {"COPY", "COPY_DATABASE", "EXPORT", "ATTACH", "DETACH", "LOAD", "INSTALL"}


def install(connection: duckdb.DuckDBPyConnection, observation_type: str) -> None:
    """Create the views and macros over `stored_transitions` and `stored_recordings`."""
    folder = files("restock.replay")
    views = (folder / "views.sql").read_text(encoding="utf-8")
    connection.execute(views.replace("FLOAT[]", observation_type))
    connection.execute((folder / "macros.sql").read_text(encoding="utf-8"))


def query(
    connection: duckdb.DuckDBPyConnection, text: str, *, where: str
) -> duckdb.DuckDBPyRelation:
    """Run one query.

    Raises:
        QueryError: DuckDB refused it, it is no query, or it would write.
    """
    try:
        statements = connection.extract_statements(text)
    except duckdb.Error as error:
        raise QueryError(_message(error), where=where) from error
    for statement in statements:
        if statement.type.name in _REFUSED:
            raise QueryError(
                f"{statement.type.name} is refused: queries are read-only",
                where=where,
                remedy="print with --csv or --json and redirect, or use .to_arrow_table()",
            )
    if not statements:
        raise QueryError("the query is empty", where=where, remedy='try "FROM coverage"')
    try:
        for statement in statements[:-1]:
            connection.execute(statement)
        relation = connection.sql(statements[-1])
    except duckdb.Error as error:
        raise QueryError(_message(error), where=where, remedy=_hint(error)) from error
    if relation is None:
        raise QueryError("the last statement gives no rows", where=where)
    return relation


def _message(error: duckdb.Error) -> str:
    return str(error).strip()


def _hint(error: duckdb.Error) -> str | None:
    if "does not exist" in str(error):
        return '`restock sql STORE "FROM columns"` lists every view and column'
    return None
