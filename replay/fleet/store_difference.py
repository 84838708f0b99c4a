"""Differences of two stores, or two versions of one: what was added, removed and changed.

Episodes are matched by recording and first stamp, even if other ingests wrote them; rows by id. The
comparison is in SQL (`between.sql`). `measure_drift` tests whether a change is more than chance.
"""

from __future__ import annotations

import tempfile
from importlib.resources import files
from typing import Any

import duckdb

from restock.errors import StoreError
from restock.process import interrupts_raised
from restock.replay.store.query import rows_of
from restock.replay.store.store import Store

# Columns of `transitions` whose shares of values are compared, if both stores have them.
SHARES_OF = ("primary_condition", "zone", "behaviour_policy", "robot", "site", "shift")


@interrupts_raised
def diff_stores(first: Store, second: Store) -> dict[str, Any]:
    """Return what is different in `second`, as plain values: the JSON of `restock coverage diff`.

    Raises:
        StoreError: their rows are of different tasks, or cannot be read.
    """
    _same_task(first, second)
    with (
        tempfile.TemporaryDirectory(prefix="restock-") as spill,
        duckdb.connect(config={"temp_directory": spill}) as connection,
    ):
        try:
            first.attach(connection, "a")
            second.attach(connection, "b")
            connection.execute(f"CREATE TEMP VIEW share_values AS {_share_values(connection)}")
            script = files("restock.replay.fleet").joinpath("between.sql")
            connection.execute(script.read_text(encoding="utf-8"))
            return _difference(connection, first, second)
        except duckdb.OperationalError as error:
            raise StoreError(
                f"cannot be read: {str(error).splitlines()[0]}",
                where=f"{first.path} or {second.path}",
                remedy="`restock audit` shows which; restore its files, or ingest again",
            ) from error


def _same_task(first: Store, second: Store) -> None:
    tasks = [store.task_hashes() for store in (first, second)]
    if all(tasks) and tasks[0] != tasks[1]:
        names = [
            ", ".join(f"{task} (profile {store.profile_name(task)})" for task in sorted(hashes))
            for store, hashes in zip((first, second), tasks, strict=True)
        ]
        raise StoreError(
            f"its rows are of task {names[1]}, those of {first.path} version {first.version} of"
            f" {names[0]}: their observations, actions and rewards do not mean the same",
            where=f"{second.path} version {second.version}",
            remedy="ingest the recordings of one again with the other's profile"
            " (`restock ingest … --profile`), into a store of its own",
        )


def _difference(
    connection: duckdb.DuckDBPyConnection, first: Store, second: Store
) -> dict[str, Any]:
    definitions = rows_of(connection, "FROM definition_changes")
    recordings = rows_of(connection, "FROM recording_changes")
    labels = rows_of(connection, "FROM label_changes")
    (of_rows,) = rows_of(connection, "FROM label_counts")
    (of_episodes,) = rows_of(connection, "FROM episode_counts")
    return {
        "kind": "store",
        # Stores that differ only in their version number are not different.
        "different": bool(
            definitions or recordings or labels or of_rows["rows_with_other_changes"]
        ),
        "a": _side(connection, first, "a"),
        "b": _side(connection, second, "b"),
        "definitions": definitions,
        "recordings": recordings,
        "episodes": of_episodes | {"changes": rows_of(connection, "FROM episode_changes")},
        "labels": of_rows | {"changes": labels},
        "shares": rows_of(connection, "FROM share_changes"),
    }


def _side(connection: duckdb.DuckDBPyConnection, store: Store, name: str) -> dict[str, Any]:
    (counted,) = rows_of(
        connection,
        f"SELECT count(DISTINCT recording_id) AS recordings, count(*) AS episodes,"
        f" coalesce(sum(rows_{name}), 0)::BIGINT AS rows,"
        f" coalesce(sum(duration_{name}_s), 0) / 3600 AS hours"
        f" FROM episode_pairs WHERE episode_{name} IS NOT NULL",
    )
    tasks = sorted(store.task_hashes())
    return {"path": str(store.path), "version": store.version, "tasks": tasks, **counted}


def _share_values(connection: duckdb.DuckDBPyConnection) -> str:
    """Return a query for each row's values in the columns of SHARES_OF that both stores have."""
    has = [set(connection.sql(f"FROM {side}.transitions LIMIT 0").columns) for side in "ab"]
    return " UNION ALL ".join(
        f"SELECT {place} AS place, '{column}' AS \"of\", '{side}' AS side,"
        f" coalesce(CAST({column} AS VARCHAR), '(none)') AS value FROM {side}.transitions"
        for place, column in enumerate(SHARES_OF)
        if column in has[0] & has[1]
        for side in "ab"
    )
