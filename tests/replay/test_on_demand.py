"""Views that take time to bind are there as soon as a query names one of them."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from support.stores import recording_transitions, write_store

from restock.errors import QueryError
from restock.replay.store.query import ON_DEMAND, definitions
from restock.replay.store.store import Store


def test_every_view_can_be_queried_by_its_name_alone(tmp_path: Path) -> None:
    path = write_store(tmp_path / "store", [recording_transitions(1)])
    text = definitions(names=[name for group in ON_DEMAND for name in group])
    views = re.findall(r"CREATE OR REPLACE VIEW (\w+)", text)
    assert {"events", "coverage_by_week", "drift", "signal_weeks"} <= set(views)
    for view in views:
        with Store(path) as store:
            store.sql(f'FROM "{view.upper()}" LIMIT 1').fetchall()
    with Store(path) as store:
        store.sql("FROM drift_by('month')").fetchall()


def test_lists_of_views_have_all_of_them(tmp_path: Path) -> None:
    path = write_store(tmp_path / "store", [recording_transitions(1)])
    for query in (
        "SELECT DISTINCT view FROM columns",
        "SELECT table_name FROM information_schema.tables",
        "SELECT name FROM (SHOW ALL TABLES)",
    ):
        with Store(path) as store:
            names = {name for (name,) in store.sql(query).fetchall()}
        assert {"transitions", "events", "drift", "columns"} <= names, query
    with Store(path) as store, pytest.raises(QueryError, match="no_such_view"):
        store.sql("FROM no_such_view")
