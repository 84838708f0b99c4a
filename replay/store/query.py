"""Run read-only SQL queries, and turn DuckDB's errors into errors with a remedy."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from difflib import get_close_matches
from functools import partial
from itertools import count
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

import duckdb

from restock.errors import QueryError, StoreError
from restock.replay.store.definitions import install_all, install_named, is_own
from restock.replay.store.parquet_views import damage

T = TypeVar("T")

# DuckDB's suggestion of an internal table for a misspelt name, which is never what was meant.
_OWN_TABLE = re.compile(
    r'\s*Did you mean "(?:pg|duckdb|sqlite|pragma|information|stored_\d+)_[^"]*"\?'
)
ZONED = "TIMESTAMP WITH TIME ZONE"
# Statements that change no files; CREATE makes tables and macros in memory.
_ALLOWED = {"SELECT", "CREATE", "SET", "VARIABLE_SET", "PRAGMA", "CALL"}
_WITHOUT_ROWS = {"CREATE", "SET", "VARIABLE_SET"}
# The beginning of an EXPLAIN, cut off to check the rest, as EXPLAIN ANALYZE also runs the rest.
_GAP = r"(?:\s|--[^\n]*\n|/\*.*?\*/)*"
_EXPLAIN = re.compile(
    rf"{_GAP}EXPLAIN\b{_GAP}(?:ANALYZE\b)?{_GAP}(?:\([^()]*\))?", re.IGNORECASE | re.DOTALL
)
# A PIVOT with columns from data is a MULTI statement in DuckDB; so is a COPY of such a PIVOT.
_PIVOT = re.compile(r"[\s(]*(?:PIVOT|FROM|SELECT|WITH|CREATE)\b", re.IGNORECASE)


def query(
    connection: duckdb.DuckDBPyConnection,
    text: str,
    *,
    where: str,
    alone: bool = False,
    only_select: bool = False,
) -> duckdb.DuckDBPyRelation:
    """Run all statements of a text, and return the rows of the last one.

    Set `alone` if nothing else uses the connection afterwards: then a last statement without rows
    is refused. With `only_select`, every statement that is not a SELECT is refused.

    Raises:
        StoreError: a file of the store is damaged or missing.
        QueryError: DuckDB refused a statement, a statement would write, or the text is empty.
    """
    if _COUNT.fullmatch(text) and is_own(connection, "transitions"):
        text = _COUNTED
    try:
        statements = connection.extract_statements(text)
    except duckdb.Error as error:
        raise QueryError(_message(error), where=where) from error
    if not statements:
        raise QueryError("the query is empty", where=where, remedy='try "FROM columns"')
    for statement in statements:
        if not _reads(connection, statement, {"SELECT"} if only_select else _ALLOWED):
            kind = statement.type.name
            if kind == "MULTI":
                kind = statement.query.split(maxsplit=1)[0].upper()
            elif kind == "EXPLAIN":
                kind = "EXPLAIN of anything but a query"
            raise QueryError(
                f"{kind} is refused: queries are read-only",
                where=where,
                remedy="ask for rows with SELECT; to keep them, redirect --csv or --json, or use"
                " .to_arrow_table()",
            )
    if alone and statements[-1].type.name in _WITHOUT_ROWS:
        raise QueryError(
            "the last statement gives no rows",
            where=where,
            remedy="end with a SELECT or FROM: queries are read-only; what they create or set is"
            " gone after them",
        )
    install_named(connection, text)
    if any(_joins_by_commas(connection, statement.query) for statement in statements):
        connection.execute("SET disabled_optimizers = ''")
    try:
        for statement in statements[:-1]:
            _with_all_views(connection, partial(connection.execute, statement)).fetchall()
        relation = _with_all_views(connection, partial(connection.sql, statements[-1].query))
    except duckdb.Error as error:
        raise _translate(error, where, connection) from error
    if relation is None:
        raise QueryError(
            "the last statement gives no rows", where=where, remedy="end with a SELECT or FROM"
        )
    return relation


def _reads(
    connection: duckdb.DuckDBPyConnection, statement: duckdb.Statement, allowed: Collection[str]
) -> bool:
    """Return whether a statement is allowed: it changes neither files nor the store's views."""
    if statement.type.name != "EXPLAIN":
        return statement.type.name in allowed or _pivots(statement)
    explained = _EXPLAIN.sub("", statement.query, count=1)
    try:
        return all(
            one.type.name == "SELECT" or _pivots(one)
            for one in connection.extract_statements(explained)
        )
    except duckdb.Error:
        return False


def _pivots(statement: duckdb.Statement) -> bool:
    return statement.type.name == "MULTI" and _PIVOT.match(statement.query) is not None


def _joins_by_commas(connection: duckdb.DuckDBPyConnection, text: str) -> bool:
    """Return whether the query joins tables by commas.

    In the written order, such tables could become a cross join. So the caller lets DuckDB choose
    the order of joins, for this and all later queries of the connection.
    """
    tree = connection.execute("SELECT json_serialize_sql($1::VARCHAR)", [text]).fetchall()[0][0]
    return '"ref_type":"CROSS"' in tree


def _with_all_views(connection: duckdb.DuckDBPyConnection, job: Callable[[], T]) -> T:
    """Run the job; if a table is not found, create all views of the store and run it again.

    This serves queries that build view names from parts, and DuckDB's hints for misspelt names.
    """
    try:
        return job()
    except duckdb.CatalogException:
        if not install_all(connection):
            raise
        return job()


# `SELECT count(*) FROM transitions`, and nothing else: answered from Delta's log.
_COUNT = re.compile(r"\s*select\s+count\(\s*\*?\s*\)\s+from\s+transitions\s*;?\s*", re.IGNORECASE)
_COUNTED = (
    'SELECT CAST(coalesce(sum("rows"), 0) AS BIGINT) AS "count_star()"'
    " FROM stored_ingests JOIN (SELECT ingest_id FROM stored_recordings) USING (ingest_id)"
)


def fetch(
    connection: duckdb.DuckDBPyConnection,
    text: str,
    *,
    where: str,
    at_most: int | None = None,
    alone: bool = False,
    only_select: bool = False,
) -> tuple[list[str], list[tuple[Any, ...]], int]:
    """Return column names, the first `at_most` rows, and the number of all rows. Ctrl-C stops it.

    If several columns have the same name, as after a join, later ones become `name_1`, `name_2`, …

    Raises:
        QueryError: as `query` does, also for errors while the query runs.
        KeyboardInterrupt: the query was stopped.
    """

    def run() -> tuple[list[str], list[tuple[Any, ...]], int]:
        relation = query(connection, text, where=where, alone=alone, only_select=only_select)
        try:
            if at_most is None:
                rows = values(relation)
                return _distinct(relation.columns), rows, len(rows)
            rows = values(relation.limit(at_most + 1))
            count = len(rows) if len(rows) <= at_most else len(relation)
            return _distinct(relation.columns), rows[:at_most], count
        except duckdb.Error as error:
            raise _translate(error, where, connection) from error

    return interruptible(connection, run)


def write_parquet(
    connection: duckdb.DuckDBPyConnection, text: str, path: Path, *, where: str
) -> None:
    """Write the rows of a query to a Parquet file, without collecting them in memory.

    Raises:
        QueryError: as `fetch` does.
    """

    def run() -> None:
        relation = query(connection, text, where=where, alone=True)
        try:
            relation.write_parquet(str(path))
        except duckdb.Error as error:
            raise _translate(error, where, connection) from error

    interruptible(connection, run)


def _distinct(names: Sequence[str]) -> list[str]:
    """Make column names distinct, in the way DuckDB does when it creates a table."""
    given: list[str] = []
    for name in names:
        free = (f"{name}_{number}" for number in count(1))
        taken = {*given, *names}
        given.append(next(one for one in free if one not in taken) if name in given else name)
    return given


def found(
    connection: duckdb.DuckDBPyConnection, text: str, given: Mapping[str, Any] | None = None
) -> tuple[list[str], list[tuple[Any, ...]]]:
    """Return column names and rows of a query with `$name` parameters; times are as in `values`.

    Without such times, the query is bound once: with many views, binding takes longer than running.
    """
    connection.execute(text, given)
    columns = connection.description or []
    if any(str(column[1]) == ZONED for column in columns):
        return [column[0] for column in columns], values(connection.sql(text, params=given))
    return [column[0] for column in columns], connection.fetchall()


def rows_of(
    connection: duckdb.DuckDBPyConnection, text: str, given: Mapping[str, Any] | None = None
) -> list[dict[str, Any]]:
    """Return the rows of a query as `found` does, but as dictionaries by column name."""
    columns, rows = found(connection, text, given)
    return [dict(zip(columns, row, strict=True)) for row in rows]


def values(relation: duckdb.DuckDBPyRelation) -> list[tuple[Any, ...]]:
    """Return the rows of a relation; times with a time zone become text in UTC."""
    if ZONED not in map(str, relation.types):
        return relation.fetchall()
    columns = [
        f"timezone('UTC', #{place})::VARCHAR || 'Z' AS \"{name}\""
        if str(kind) == ZONED
        else f"#{place}"
        for place, (name, kind) in enumerate(
            zip(relation.columns, relation.types, strict=True), start=1
        )
    ]
    return relation.project(", ".join(columns)).fetchall()


def interruptible(connection: duckdb.DuckDBPyConnection, job: Callable[[], T]) -> T:
    """Run a job in its own thread, so that Ctrl-C can interrupt DuckDB while it works."""
    begins, given_up = Lock(), False

    def run() -> T:
        with begins:
            if given_up:  # interrupted before the job began: nobody waits for its result
                raise CancelledError
            return job()

    with ThreadPoolExecutor(1) as pool:
        try:
            return pool.submit(run).result()
        except KeyboardInterrupt:
            given_up = True
            connection.interrupt()
            with begins:  # wait for the job to stop; if it did not begin, `given_up` prevents it
                raise


def _translate(
    error: duckdb.Error, where: str, connection: duckdb.DuckDBPyConnection
) -> QueryError | StoreError:
    """Turn DuckDB's error into one about the query, or about a file that it failed to read."""
    remedy = hint(error)
    if (near := _nearest(error, connection)) and remedy:
        remedy = f"the nearest names are {near}; {remedy}"
    failure = QueryError(_message(error), where=where, remedy=remedy)
    return damage(error, where=where) or failure


_NO_TABLE = re.compile(r"Table with name (.+?) does not exist!")


def _nearest(error: duckdb.Error, connection: duckdb.DuckDBPyConnection) -> str:
    """Return the view names closest to a missing table's name, quoted for SQL if needed, or ""."""
    missing = _NO_TABLE.search(str(error))
    if not isinstance(error, duckdb.CatalogException) or not missing:
        return ""
    views = connection.execute(
        "SELECT view_name FROM duckdb_views() WHERE NOT internal AND view_name NOT LIKE 'stored_%'"
    ).fetchall()
    near = get_close_matches(missing[1], [name for (name,) in views], n=4, cutoff=0.5)
    return ", ".join(name if name.isidentifier() else f'"{name}"' for name in near)


def _message(error: duckdb.Error) -> str:
    """Return DuckDB's message; for an error in a Python function, only that function's message."""
    text = _OWN_TABLE.sub("", str(error)).strip().expandtabs(4)
    _, of_python, cause = text.partition("occurred while executing the UDF: ")
    return cause.partition(": ")[2] if of_python else text


# Error of `WHERE condition = …`: `transitions` has no such column, as a row can hold several.
_NO_CONDITION = re.compile(r'column(?: named)? "condition"', re.IGNORECASE)
OF_CONDITIONS = (
    "a row can hold several conditions: `FROM held_conditions WHERE condition = '…'` has every row"
    " that holds it, as has `FROM transitions WHERE list_contains(conditions, '…')`;"
    " `primary_condition` is only the one of highest priority"
)


def hint(error: duckdb.Error) -> str | None:
    """Return what to query instead if a name was not found, else None."""
    if isinstance(error, duckdb.BinderException) and _NO_CONDITION.search(str(error)):
        return OF_CONDITIONS
    if isinstance(error, duckdb.CatalogException | duckdb.BinderException):
        return '`restock sql PATH "FROM columns"` lists every view and column'
    return None
