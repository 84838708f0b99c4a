"""A store creates the views and macros that a query names, and those they depend on."""

import re

import pytest
from support.long import one_in

from restock.errors import QueryError
from restock.replay.store.definitions import MACROS, VIEWS, definitions, install_named
from restock.replay.store.query import query
from restock.replay.store.store import Store

_LISTED = "SELECT view_name FROM duckdb_views() WHERE NOT internal"


def created_views(store: Store) -> set[str]:
    """Return the views that a store's connection has."""
    return {name for (name,) in store.bare.execute(_LISTED).fetchall()}


@pytest.mark.parametrize("every", one_in(2, [8, 1]))
def test_every_view_and_macro_works_alone(store_path, every):
    text = definitions(names=[*VIEWS, *MACROS])
    views = re.findall(r"CREATE OR REPLACE VIEW (\w+)", text)
    assert {"events", "coverage_by_week", "drift", "signal_weeks"} <= set(views)
    for view in views[::every]:
        with Store(store_path) as store:
            store.sql(f'FROM "{view.upper()}" LIMIT 1').fetchall()
    for macro in re.findall(r"CREATE OR REPLACE MACRO (\w+)", text)[::every]:
        with Store(store_path) as store:
            install_named(store.bare, macro)  # bound when it is created
    with Store(store_path) as store:
        store.sql("FROM drift_by('month')").fetchall()


def test_query_creates_only_views_it_needs(store_path):
    with Store(store_path) as store:
        assert not created_views(store) & {"transitions", "recordings", "coverage"}
        store.sql("SELECT count(*) FROM Transitions").fetchall()
        assert "transitions" in created_views(store)
        assert not created_views(store) & {"coverage", "coverage_by_condition", "held_conditions"}
        store.sql("FROM missing_cells").fetchall()
        assert {"held_conditions", "conditions", "actions"} <= created_views(store)
    with Store(store_path) as store:
        common = {"transitions", "episodes", "coverage", "label_scores", "corrections"}
        assert common <= {name for (name,) in store.connection.execute(_LISTED).fetchall()}


def test_computed_and_misspelt_view_names(store_path):
    with Store(store_path) as store:
        rows = store.sql("FROM query_table('cover' || 'age')").fetchall()
        assert rows == store.sql("FROM coverage").fetchall()
    with Store(store_path) as store, pytest.raises(QueryError, match='mean "reward_mix"'):
        store.sql("FROM rewardmix")


def test_views_created_by_query_are_kept(store_path):
    with Store(store_path) as store:
        store.sql("CREATE OR REPLACE VIEW drops AS SELECT 'mine' AS reason; FROM drops")
        assert store.sql("SELECT reason FROM drops").fetchall() == [("mine",)]
        assert query(store.connection, "FROM drops", where="").fetchall() == [("mine",)]


@pytest.mark.long
def test_view_listings_are_complete(store_path):
    for text in (
        "SELECT DISTINCT view FROM columns",
        "SELECT table_name FROM information_schema.tables",
        "SELECT name FROM (SHOW ALL TABLES)",
    ):
        with Store(store_path) as store:
            names = {name for (name,) in store.sql(text).fetchall()}
        assert {"transitions", "events", "drift", "columns"} <= names, text
    with Store(store_path) as store, pytest.raises(QueryError, match="no_such_view"):
        store.sql("FROM no_such_view")
