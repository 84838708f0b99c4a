"""Queries: the views and macros of a connection, read-only, with errors worth reading."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from importlib.resources import files
from typing import Any, TypeVar

import duckdb

from restock.errors import QueryError
from restock.ingest.store.summary import with_included
from restock.replay.store.column_docs import install_columns

T = TypeVar("T")

# In their order: a view may use those before it.
VIEWS = ("rows.sql", "views.sql", "labels.sql", "events.sql", "fleet.sql", "exposure.sql")
FRAMES = "frames.sql"  # over stored_frames, which a store alone has
MACROS = (
    "macros.sql",
    "flawed_rows.sql",
    "capacity.sql",
    "shared_rows.sql",
    "repeated_rows.sql",
    "corrections.sql",
    "measured_signals.sql",
    "episode_signals.sql",
    "drift.sql",
    "return_order.sql",
    "returns.sql",
)
_INGESTS = "ingest_id IN (SELECT ingest_id FROM stored_transitions)"  # in rows.sql
# To bind these takes more than half of the time to open a store: only for queries that name them.
ON_DEMAND = (
    ("events.sql", "fleet.sql"),
    ("measured_signals.sql", "episode_signals.sql", "drift.sql"),
    ("flawed_rows.sql",),
    ("exposure.sql",),
    ("return_order.sql", "returns.sql"),
    ("capacity.sql",),
    ("shared_rows.sql", "repeated_rows.sql"),
    (FRAMES,),
)
_LISTS = {
    "columns",
    "information_schema",
    "duckdb_views",
    "duckdb_columns",
    "duckdb_tables",
    "show",
}

# Statements that leave files as they are; CREATE makes tables and macros in memory.
_ALLOWED = {"SELECT", "EXPLAIN", "CREATE", "DROP", "SET", "VARIABLE_SET", "PRAGMA", "CALL"}


def install(connection: duckdb.DuckDBPyConnection, observation_type: str) -> None:
    """Create all views and macros over `stored_transitions` and `stored_recordings`."""
    connection.execute(definitions(observation_type))
    install_columns(connection)


def install_first(connection: duckdb.DuckDBPyConnection, observation_type: str) -> None:
    """Create those that are not ON_DEMAND, of a store; `install_named` makes the others.

    Which ingests it holds is `stored_ingests`, from Delta's log: no need to scan rows for it.
    """
    later = {name for group in ON_DEMAND for name in group}
    first = [name for name in (*VIEWS, *MACROS) if name not in later]
    text = definitions(observation_type, first)
    connection.execute(text.replace(_INGESTS, _INGESTS.replace("transitions", "ingests")))


def install_named(connection: duckdb.DuckDBPyConnection, text: str) -> None:
    """Create the views ON_DEMAND that a query (or another text) names, on a store's connection."""
    words = set(re.findall(r"\w+", text.lower()))
    every = bool(words & _LISTS)
    named = [group for group in ON_DEMAND if every or words & _names(group)]
    if not named:
        return
    query = "SELECT view_name FROM duckdb_views() WHERE schema_name = 'main'"
    there = {name for (name,) in connection.execute(query).fetchall()}
    if "recordings" not in there:  # a run's or a panel's
        return
    for group in named:
        missing = [name for name in group if not _names((name,)) & there]
        if missing:
            connection.execute(definitions(names=missing))
    if every and "columns" not in there:
        install_columns(connection)


@cache
def _names(group: Sequence[str]) -> frozenset[str]:
    """The views and macros of some SQL files."""
    text = definitions(names=group)
    return frozenset(re.findall(r"^CREATE OR REPLACE (?:VIEW|MACRO) (\w+)", text, re.MULTILINE))


def definitions(observation_type: str = "FLOAT[]", names: Sequence[str] = (*VIEWS, *MACROS)) -> str:
    """The text of these SQL files, with the type that observations are cast to."""
    folder = files("restock.replay.store")
    text = [(folder / name).read_text(encoding="utf-8") for name in names]
    whole = with_included("\n".join(text), folder)
    return whole.replace("::FLOAT[] AS", f"::{observation_type} AS")


def install_repeated_rows(connection: duckdb.DuckDBPyConnection) -> None:
    """Create the macro `repeated_rows`, over any `transitions`."""
    query = "SELECT view_name FROM duckdb_views() WHERE view_name = 'shared_rows'"
    there = connection.execute(query).fetchall()  # that of a store need not scan
    names = ["repeated_rows.sql"] if there else ["shared_rows.sql", "repeated_rows.sql"]
    connection.execute(definitions(names=names))


def query(
    connection: duckdb.DuckDBPyConnection, text: str, *, where: str
) -> duckdb.DuckDBPyRelation:
    """Run one query (the last of several statements).

    Raises:
        QueryError: DuckDB refused it, it is no query, or it would write.
    """
    try:
        statements = connection.extract_statements(text)
    except duckdb.Error as error:
        raise QueryError(_message(error), where=where) from error
    if not statements:
        raise QueryError("the query is empty", where=where, remedy='try "FROM coverage"')
    for statement in statements:
        if statement.type.name not in _ALLOWED:
            raise QueryError(
                f"{statement.type.name} is refused: queries are read-only",
                where=where,
                remedy="print with --csv or --json and redirect, or use .to_arrow_table()",
            )
    install_named(connection, text)
    try:
        for statement in statements[:-1]:
            connection.execute(statement).fetchall()
        relation = connection.sql(_counted(connection, statements[-1].query))
    except duckdb.Error as error:
        raise QueryError(_message(error), where=where, remedy=_hint(error)) from error
    if relation is None:
        raise QueryError(
            "the last statement gives no rows", where=where, remedy="end with a SELECT or FROM"
        )
    return relation


# `SELECT count(*) FROM transitions`, alone: Delta's log has the answer.
_COUNT = re.compile(r"\s*select\s+count\(\s*\*?\s*\)\s+from\s+transitions\s*;?\s*", re.IGNORECASE)


def _counted(connection: duckdb.DuckDBPyConnection, text: str) -> str:
    """The same query, from the counts of the store's files where these answer it."""
    if not _COUNT.fullmatch(text):
        return text
    views = "SELECT view_name FROM duckdb_views() WHERE view_name IN ('transitions', $1)"
    found = connection.execute(views, ["stored_ingests"]).fetchall()
    if sorted(found) != [("stored_ingests",), ("transitions",)]:  # a run's, or one made beside it
        return text
    return (
        'SELECT CAST(coalesce(sum("rows"), 0) AS BIGINT) AS "count_star()"'
        " FROM stored_ingests JOIN (SELECT ingest_id FROM stored_recordings) USING (ingest_id)"
    )


def fetch(
    connection: duckdb.DuckDBPyConnection, text: str, *, where: str, at_most: int | None = None
) -> tuple[list[str], list[tuple[Any, ...]], int]:
    """Column names, rows (the first `at_most`), and how many there are; Ctrl-C stops it.

    Raises:
        QueryError: as `query` does, also for what goes wrong while it runs.
        KeyboardInterrupt: the query was stopped.
    """

    def run() -> tuple[list[str], list[tuple[Any, ...]], int]:
        relation = query(connection, text, where=where)
        try:
            if at_most is None:
                rows = values(relation)
                return relation.columns, rows, len(rows)
            rows = values(relation.limit(at_most + 1))
            count = len(rows) if len(rows) <= at_most else len(relation)
            return relation.columns, rows[:at_most], count
        except duckdb.Error as error:
            raise QueryError(_message(error), where=where, remedy=_hint(error)) from error

    return interruptible(connection, run)


def values(relation: duckdb.DuckDBPyRelation) -> list[tuple[Any, ...]]:
    """The rows of a relation; times with a zone as text in UTC."""
    columns = [
        f"timezone('UTC', #{place})::VARCHAR || 'Z' AS \"{name}\""
        if str(kind) == "TIMESTAMP WITH TIME ZONE"
        else f"#{place}"
        for place, (name, kind) in enumerate(
            zip(relation.columns, relation.types, strict=True), start=1
        )
    ]
    return relation.project(", ".join(columns)).fetchall()


def interruptible(connection: duckdb.DuckDBPyConnection, job: Callable[[], T]) -> T:
    """Run a job on a thread of its own: DuckDB does not look for Ctrl-C while it works."""
    with ThreadPoolExecutor(1) as pool:
        done = pool.submit(job)
        try:
            return done.result()
        except KeyboardInterrupt:
            connection.interrupt()
            raise


def _message(error: duckdb.Error) -> str:
    """What DuckDB says, or what a function in Python said, without DuckDB's words around it."""
    text = str(error).strip()
    _, of_python, cause = text.partition("occurred while executing the UDF: ")
    return cause.partition(": ")[2] if of_python else text


def _hint(error: duckdb.Error) -> str | None:
    if isinstance(error, duckdb.CatalogException | duckdb.BinderException):
        return '`restock sql PATH "FROM columns"` lists every view and column'
    return None
