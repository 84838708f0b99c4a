"""What is kept of a recording in its manifest, so that common questions need not scan its rows.

Its episodes, how many rows and episodes each cell of coverage has, what drift compares, the rows
that are flawed, what its rows hold in one number each, the ends of its episodes and its sketch.
Every writer of rows writes them, so they are true for as long as the rows are there.
"""

from __future__ import annotations

import atexit
import re
from collections.abc import Iterator
from functools import cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from itertools import pairwise
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa

from restock.ingest.store.repeated import distinctive, sketch

ENDS = b"restock.episode_ends"  # key in the rows' metadata
# Of whole episodes that are looked at together: bounds memory. Each time costs 40 ms of planning.
STRETCH_ROWS = 8192
# Tables whose rows are made of one episode's each, by queries of their names, and their order.
BY_EPISODE = {
    "measured_signals": "episode_id, signal",
    "flawed_rows": "transition_id",
    "zone_steps": "ALL",
    "condition_steps": "ALL",
}
WIDE = ("observation", "next_observation")  # columns that only those look at


def _rows_of(**columns: pa.DataType) -> pa.DataType:
    return pa.list_(pa.struct([pa.field(name, kind) for name, kind in columns.items()]))


_TEXT, _TEXTS, _COUNT, _NUMBER = pa.string(), pa.list_(pa.string()), pa.int64(), pa.float64()
TABLES = {  # of summary.sql, and `distinctive_rows`; each a column
    "episode_rows": _rows_of(
        episode_id=_TEXT,
        episode_index=pa.int32(),
        start_ns=_COUNT,
        end_ns=_COUNT,
        steps=_COUNT,
        missing_steps=_COUNT,
        **{"return": _NUMBER},
        ended=_TEXT,
        ended_by=_TEXT,
        goal_source=_TEXT,
        success=pa.bool_(),
        progress_m=_NUMBER,
        bumped_steps=_COUNT,
        clearance_min_m=pa.float32(),
        conditions=_TEXTS,
        behaviour_policies=_TEXTS,
        first_policy=_TEXT,
        handovers=_COUNT,
        zones=_TEXTS,
    ),
    "cells": _rows_of(
        condition=_TEXT,
        action=pa.int16(),
        zone=_TEXT,
        behaviour_policy=_TEXT,
        rows_held=_COUNT,
        primary_rows=_COUNT,
        rewards=_COUNT,
        reward_sum=_NUMBER,
        known_ends=_COUNT,
        terminated=_COUNT,
        episodes_held=_COUNT,
        successes=_COUNT,
        goal_episodes=_COUNT,
    ),
    "condition_episodes": _rows_of(
        condition=_TEXT,
        episodes_held=_COUNT,
        rows_held=_COUNT,
        squared_rows=_COUNT,
        successes=_COUNT,
        goal_episodes=_COUNT,
        returns=_COUNT,
        return_sum=_NUMBER,
        primary_rows=_COUNT,
        primary_episodes=_COUNT,
    ),
    "measured_signals": _rows_of(episode_id=_TEXT, signal=_TEXT, value=_NUMBER, steps=_COUNT),
    "flawed_rows": _rows_of(
        transition_id=_COUNT,
        episode_id=_TEXT,
        step_index=pa.int32(),
        is_null=pa.bool_(),
        is_not_finite=pa.bool_(),
    ),
    "zone_steps": _rows_of(episode_id=_TEXT, zone=_TEXT, start_ns=_COUNT, steps=_COUNT),
    "condition_steps": _rows_of(
        episode_id=_TEXT, zone=_TEXT, condition=_TEXT, steps=_COUNT, events=_COUNT
    ),
    "distinctive_rows": _rows_of(transition_id=_COUNT, content=_COUNT),
}
# Beside the columns of `recording_schema`.
SUMMARY_SCHEMA = pa.schema(
    [
        pa.field("sketch", _TEXT),
        pa.field("packed_ends", _TEXT),
        *(pa.field(name, kind) for name, kind in TABLES.items()),
    ]
)


def summarised(manifest: pa.Table, rows: pa.Table) -> pa.Table:
    """A manifest row with the summary of its recording's rows, and their number."""
    place = manifest.schema.get_field_index("transitions")
    count = pa.array([len(rows)], manifest.schema.field(place).type)
    manifest = manifest.set_column(place, manifest.schema.field(place), count)
    hashes, at = distinctive(rows)
    values: dict[str, Any] = {
        "sketch": sketch(hashes),
        "packed_ends": ((rows.schema.metadata or {}).get(ENDS) or b"").decode() or None,
    }
    in_order = np.argsort(at)
    tables = {
        "distinctive_rows": pa.table(
            {
                "transition_id": rows["transition_id"].take(pa.array(at[in_order])),
                "content": hashes[in_order].view(np.int64),
            }
        )
    }
    with _database().cursor() as connection:  # with temporary tables of its own
        connection.register("recordings", manifest)
        rows = rows.rename_columns({"condition": "primary_condition"})  # as rows.sql
        custom = any(manifest["signals"].to_pylist())  # whether the profile has its own
        tables |= _of_episodes(connection, rows, custom=custom)
        connection.register("transitions", rows.drop_columns(list(WIDE)))
        connection.execute(_definitions())
        tables |= {n: connection.table(n).to_arrow_table() for n in TABLES.keys() - tables.keys()}
    for field in SUMMARY_SCHEMA:
        column = (
            _listed(tables[field.name], field.type)
            if field.name in tables
            else pa.array([values[field.name]], field.type)
        )
        manifest = manifest.append_column(field, column)
    return manifest


def _of_episodes(
    connection: duckdb.DuckDBPyConnection, rows: pa.Table, *, custom: bool
) -> dict[str, pa.Table]:
    """The tables BY_EPISODE, which are made some whole episodes at a time: an episode's rows of
    them depend on its own steps alone. A window over all steps would hold them all twice."""
    for number, (first, stop) in enumerate(_whole_episodes(rows)):
        connection.register("transitions", _unchunked(rows.slice(first, stop - first)))
        for name in BY_EPISODE:
            into = f"INSERT INTO {name}" if number else f"CREATE TEMP TABLE {name} AS"
            connection.execute(f"{into}\n{_query(name)}")
        if custom:
            added = _query("measured_custom_signals")
            connection.execute(f"INSERT INTO measured_signals\n{added}")
        connection.unregister("transitions")  # its copies go before the next are made
    return {
        name: connection.sql(f"FROM {name} ORDER BY {order}").to_arrow_table()
        for name, order in BY_EPISODE.items()
    }


def _whole_episodes(rows: pa.Table) -> Iterator[tuple[int, int]]:
    """Where to cut the rows, as first and one past the last, some STRETCH_ROWS apart: no episode
    lies in two parts. All at once where an episode's rows do not lie together."""
    coded = rows["episode_id"].combine_chunks().dictionary_encode()
    codes = coded.indices.fill_null(-1).to_numpy(zero_copy_only=False)
    begins = np.flatnonzero(np.diff(codes)) + 1
    cuts = begins[np.flatnonzero(np.diff(begins // STRETCH_ROWS, prepend=0))].tolist()
    together = len(begins) < len(np.unique(codes))
    return pairwise([0, *(cuts if together else []), len(rows)])


def _unchunked(rows: pa.Table) -> pa.Table:
    """The rows with the chunks of their WIDE columns, one an episode, put together: for DuckDB
    each is a batch."""
    for name in WIDE:
        place = rows.schema.get_field_index(name)
        rows = rows.set_column(place, name, rows[name].combine_chunks())
    return rows


def with_ends(rows: pa.Table, packed_ends: str | None) -> pa.Table:
    """A recording's rows with the ends of their episodes, from its manifest, in their metadata."""
    metadata = {ENDS: packed_ends.encode()} if packed_ends else None
    return rows.replace_schema_metadata(metadata)


@cache
def _database() -> duckdb.DuckDBPyConnection:
    """One for all recordings: opening it takes as long as a summary."""
    atexit.register(_database.cache_clear)  # nanobind complains of what outlives its module
    return duckdb.connect(config={"threads": 1})


@cache
def _definitions() -> str:
    return with_included("-- include: summary.sql")


@cache
def _query(name: str) -> str:
    return with_included(f"-- include: {name}.sql")


def with_included(text: str, beside: Traversable | None = None) -> str:
    """SQL with the files that it names: definitions which several statements share, in this folder
    or else in the one `beside`."""

    def included(named: re.Match[str]) -> str:
        folder = files("restock.ingest.store")
        if beside is not None and not (folder / named[1]).is_file():
            folder = beside
        return with_included((folder / named[1]).read_text(encoding="utf-8"), beside)

    return re.sub(r"-- include: (\w+\.sql)", included, text)


def _listed(rows: pa.Table, kind: pa.DataType) -> pa.Array:
    """All rows of a table as the one value of a list column."""
    fields = list(kind.value_type)
    columns = [rows[field.name].cast(field.type).combine_chunks() for field in fields]
    values = pa.StructArray.from_arrays(columns, fields=fields)
    return pa.ListArray.from_arrays(pa.array([0, len(rows)], pa.int32()), values).cast(kind)
