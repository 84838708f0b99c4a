"""A store through Spark's API: the same Delta tables, the same views.

Works with any session that reads Delta: a Spark cluster with the Delta package, or Sail (`pip
install 'restock[spark]'`), which speaks Spark's protocol without a JVM.
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from restock.errors import StoreError
from restock.ingest.store.location import Location
from restock.ingest.store.writer import RECORDINGS, TRANSITIONS
from restock.replay.store.store import is_store

_LATER = {
    "perturbation": "CAST(NULL AS STRING) AS perturbation",
    "perturbation_values": "CAST(NULL AS MAP<STRING, DOUBLE>) AS perturbation_values",
}

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pyspark.sql import SparkSession


def install_views(session: SparkSession | Any, store: str | Path, *, scheme: str = "s3") -> None:
    """Give a session the views of a store: transitions, episodes, coverage, missing_cells, …

    They are temporary views over the store's newest version, and stay at it where the session
    plans a query anew; call it again after an ingest.

    Args:
        session: a Spark session, of Spark Connect or classic.
        store: the store's folder, as the session's machines see it, or `s3://bucket/prefix`.
        scheme: how the session writes S3 addresses: Hadoop's Spark says `s3a`.

    Raises:
        StoreError: there is no store.
    """
    place = Location.of(store)
    if not is_store(place):
        raise StoreError("no such store", where=str(place), remedy="`restock ingest` makes one")
    for name in (TRANSITIONS, RECORDINGS):
        address = (
            str(place.folder.absolute() / name)
            if place.folder is not None
            else f"{scheme}://{place.table(name).removeprefix('s3://')}"
        )
        table = session.read.format("delta").load(address)
        if name == TRANSITIONS:  # rows of an older store have no such columns: null
            table = table.selectExpr(
                "*", *(sql for column, sql in _LATER.items() if column not in table.columns)
            )
        table.createOrReplaceTempView(f"stored_{name}")
    for statement in statements():
        session.sql(statement)


def statements() -> Iterator[str]:
    """The statements of spark.sql, in their order, without comments."""
    text = (files("restock.replay.store") / "spark.sql").read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if not line.startswith("--")]
    for statement in "\n".join(lines).split(";\n"):
        if statement.strip():
            yield statement.strip().removesuffix(";")
