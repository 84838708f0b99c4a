"""The columns of a store: typed once, in Arrow; DuckDB's types and the views follow."""

from __future__ import annotations

import duckdb
import pyarrow as pa
import pytest

from restock.ingest.task import schema
from restock.ingest.task.schema import (
    COLUMNS,
    FRAME_COLUMNS,
    RECORDING_COLUMNS,
    Column,
    duckdb_type,
)
from restock.replay.store.definitions import definitions


@pytest.mark.parametrize("columns", [COLUMNS, RECORDING_COLUMNS, FRAME_COLUMNS])
def test_duckdb_types_are_those_of_arrow(columns: tuple[Column, ...]) -> None:
    row = pa.table({column.name: pa.nulls(1, column.type) for column in columns})
    with duckdb.connect() as connection:
        connection.register("stored", row)
        seen = dict(
            connection.sql("SELECT column_name, column_type FROM (DESCRIBE stored)").fetchall()
        )
        for column in columns:
            kind = connection.sql(f"SELECT NULL::{duckdb_type(column.type)} AS it").types[0]
            assert str(kind).replace('"', "") == seen[column.name].replace('"', "")


def test_a_new_column_is_null_in_rows_from_before(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = pa.table({column.name: pa.nulls(1, column.type) for column in COLUMNS})
    manifest = pa.table({column.name: pa.nulls(1, column.type) for column in RECORDING_COLUMNS})
    ingest = pa.array(["one"])
    new = Column("payload_kg", pa.float32(), "mass of what the robot carries", nullable=True)
    monkeypatch.setattr(schema, "COLUMNS", (*COLUMNS, new))
    with duckdb.connect() as connection:
        for name, table in (("stored_transitions", rows), ("stored_recordings", manifest)):
            place = table.schema.get_field_index("ingest_id")
            connection.register(name, table.set_column(place, "ingest_id", ingest))
        connection.execute(definitions(names=["rows.sql"]))
        found = connection.sql("SELECT payload_kg FROM transitions")
        assert found.types == ["FLOAT"]
        assert found.fetchall() == [(None,)]
