"""The views through Spark's API (by Sail) give what they give through DuckDB."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from support.long import one_in
from support.stores import one

from restock.errors import StoreError
from restock.ingest.store.transitions import replaced
from restock.ingest.store.writer import StoreWriter
from restock.replay.store.column_docs import view_docs
from restock.replay.store.definitions import FRAMES, MACROS, definitions
from restock.replay.store.spark import install_views, statements
from restock.replay.store.store import Store

# DuckDB's own, those that lie beside its macros, and those of files that are no Delta table.
DUCKDBS = {"columns", *re.findall(r"VIEW (\w+) AS", definitions(names=(*MACROS, FRAMES)))}
VIEWS = sorted(set(view_docs()) - DUCKDBS)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of three recordings, one of them replaced, in which a condition was never seen, and
    another one cannot be told."""
    import pyarrow as pa

    untold = {
        "condition": "near_miss",
        "kind": "outcome",
        "signals": ["clearance_m"],
        "because": "no lidar",
    }

    path = tmp_path_factory.mktemp("spark") / "store"
    writer = StoreWriter(path)
    for recording, ingest in ((1, "a"), (2, "a"), (1, "b"), (3, "a")):
        manifest, rows = one(recording, ingest)
        keep = pa.array([name != "recovery" for name in rows["condition"].to_pylist()])
        manifest = replaced(manifest, {"unknown_conditions": [[untold]]})
        writer.write(manifest, rows.filter(keep))
    return path


@pytest.fixture(scope="module")
def spark() -> Iterator[Any]:
    sail = pytest.importorskip("pysail.spark")
    session = pytest.importorskip("pyspark.sql").SparkSession
    server = sail.SparkConnectServer("127.0.0.1", 0)
    server.start(background=True)
    _, port = server.listening_address
    with pytest.MonkeyPatch.context() as patch:
        # A worker of pytest-xdist has no main file, which pyspark takes for its own doctests.
        patch.setattr(sys.modules["__main__"], "__file__", __file__, raising=False)
        connected = session.builder.remote(f"sc://127.0.0.1:{port}").getOrCreate()
    yield connected
    connected.stop()  # before its server: at exit the client would look for that for minutes
    server.stop()


@pytest.fixture(scope="module")
def views(spark: Any, path: Path) -> Any:
    install_views(spark, path)
    return spark


def test_every_view_is_there_by_the_same_columns(path: Path) -> None:
    named = [re.search(r"VIEW (\w+) AS", statement)[1] for statement in statements()]  # type: ignore[index]
    assert sorted(named) == VIEWS


@pytest.mark.parametrize("view", one_in(4, VIEWS))
def test_a_view_gives_the_same_rows(view: str, views: Any, path: Path) -> None:
    theirs = views.sql(f"SELECT * FROM {view}").toArrow()
    with Store(path) as store:
        ours = store.sql(f"FROM {view}").to_arrow_table()
    assert theirs.column_names == ours.column_names
    assert len(theirs) == len(ours) > 0
    for theirs_row, ours_row in zip(*map(by_key, (theirs, ours)), strict=True):
        for name, value in ours_row.items():
            assert alike(theirs_row[name], value, name), (name, theirs_row[name], value)


def by_key(table: Any) -> list[dict[str, Any]]:
    """Rows in an order that needs no float to be the same."""
    keys = [
        field.name
        for field in table.schema
        if not str(field.type).startswith(("double", "float", "list", "fixed", "timestamp"))
    ]
    return sorted(table.to_pylist(), key=lambda row: [str(row[name]) for name in keys])


def alike(theirs: Any, ours: Any, name: str) -> bool:
    if isinstance(ours, datetime):
        return bool(theirs.replace(tzinfo=None) == ours.replace(tzinfo=None))
    if isinstance(ours, float) and theirs is not None:
        # Of ages, some seconds lie between the two; of the rest, sums in another order.
        return math.isclose(theirs, ours, rel_tol=1e-5, abs_tol=1e-2 if "_days" in name else 1e-6)
    return bool(theirs == ours)


def test_the_answer_follows_the_store(spark: Any, tmp_path: Path) -> None:
    StoreWriter(tmp_path / "s").write(*one(1))
    install_views(spark, tmp_path / "s")
    count = "SELECT count(*) AS n FROM recordings"
    assert spark.sql(count).toArrow().to_pylist() == [{"n": 1}]
    StoreWriter(tmp_path / "s").write(*one(2))
    install_views(spark, tmp_path / "s")
    assert spark.sql(count).toArrow().to_pylist() == [{"n": 2}]


def test_where_there_is_no_store_it_says_so(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="no such store"):
        install_views(None, tmp_path)
