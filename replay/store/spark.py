"""A store through Spark's API: the same Delta tables, and its views in Spark's SQL.

Works with any session that reads Delta: a Spark cluster with the Delta package, or Sail (`pip
install 'restock[spark]'`), which speaks Spark's protocol without a JVM.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from restock.errors import StoreError
from restock.ingest.store.location import RECORDINGS, TRANSITIONS, Location
from restock.ingest.store.summary import SUMMARY_SCHEMA
from restock.ingest.task.tags import NAMED
from restock.replay.store.definitions import VIEWS, definitions
from restock.replay.store.store import is_store


def _moment(stamp_ns: str) -> str:
    return f"timestamp_micros(CAST(({stamp_ns}) DIV 1000 AS BIGINT))"


# rows.sql, which no rule translates: DuckDB adds the columns that rows of an older store lack.
_NAMED = ", ".join(f"tags['{name}'] AS {name}" for name in NAMED)
_BY_HAND = {
    "recordings": f"""
CREATE OR REPLACE TEMPORARY VIEW recordings AS
SELECT
    *,
    {_NAMED},
    {_moment("start_stamp_ns")} AS start_stamp_time,
    {_moment("end_stamp_ns")} AS end_stamp_time,
    {_moment("start_stamp_ns + coalesce(clock_offset_ns, 0)")} AS logged_start_time,
    {_moment("end_stamp_ns + coalesce(clock_offset_ns, 0)")} AS logged_end_time
FROM stored_recordings
WHERE ingest_id IN (SELECT ingest_id FROM stored_transitions)""",
    "transitions": f"""
CREATE OR REPLACE TEMPORARY VIEW transitions AS
SELECT
    stored_transitions.*,
    coalesce(logged_ns, stamp_ns + coalesce(clock_offset_ns, 0)) AS logged_ns,
    {_moment("stamp_ns")} AS stamp_time,
    {_moment("coalesce(logged_ns, stamp_ns + coalesce(clock_offset_ns, 0))")} AS logged_time,
    {_moment("pose_stamp_ns")} AS pose_stamp_time,
    {", ".join(NAMED)},
    tags
FROM stored_transitions
JOIN (SELECT ingest_id AS of_ingest, clock_offset_ns, tags, {_NAMED} FROM stored_recordings) AS told
    ON stored_transitions.ingest_id = told.of_ingest""",
}

# What Spark calls by another name, as patterns of the text of views.sql.
_RULES = (
    (r"CREATE OR REPLACE VIEW", "CREATE OR REPLACE TEMPORARY VIEW"),
    (r"\bunnest\(", "explode("),
    (r"\blist_sort\(", "sort_array("),
    (r"\blist_contains\(", "array_contains("),
    (r"\bstring_split\(", "split("),
    (r"\blist_distinct\(", "array_distinct("),
    (r"\blist\(DISTINCT ", "collect_set("),
    (r"\blist\(", "collect_list("),
    (r"\barg_min\(", "min_by("),
    (r"\barg_max\(", "max_by("),
    (r"(?<!range\()\blen\(", "size("),
    (r"\bjson_extract_string\(", "get_json_object("),
    (r"\bquantile_cont\(", "percentile("),
    (r"\bquantile_disc\((\w+), ([\d.]+)\)", r"percentile_disc(\2) WITHIN GROUP (ORDER BY \1)"),
    (r"\bepoch_ns\(now\(\)\)", "unix_micros(now()) * 1000"),
    (r"\bmake_timestamp_ns\((\w+\(\w+\))\)", r"timestamp_micros(CAST(\1 DIV 1000 AS BIGINT))"),
    (r"\[\]", "CAST(array() AS ARRAY<STRING>)"),
    (r"\blist_extract\(", "element_at("),
    (r"\brange\(len\((\w+)\)\)", r"sequence(0, size(\1) - 1)"),
    (r'\[\["DOUBLE"\]\]', "array<array<double>>"),
    (r"\[\{(.*)\}\]", r"array<struct<\1>>"),
    (r'"(\w+)": "(\w+)"', r"\1: \2"),
    (r"\bVARCHAR\b", "STRING"),
    (r"(\w+) IS DISTINCT FROM (\w+\(\w+\) OVER \([^)]*\))", r"NOT (\1 <=> \2)"),
    (r"\bANTI JOIN", "LEFT ANTI JOIN"),
)
_LATER = {
    TRANSITIONS: {
        "logged_ns": "CAST(NULL AS BIGINT) AS logged_ns",
        "probabilities": "CAST(NULL AS MAP<STRING, FLOAT>) AS probabilities",
        "uncertain": "CAST(NULL AS ARRAY<STRING>) AS uncertain",
        "exposures": "CAST(NULL AS ARRAY<STRING>) AS exposures",
        "true_exposure": "CAST(NULL AS STRING) AS true_exposure",
        "came_nearer_m": "CAST(NULL AS FLOAT) AS came_nearer_m",
        "plan_return_m": "CAST(NULL AS FLOAT) AS plan_return_m",
        "plan_gap_m": "CAST(NULL AS FLOAT) AS plan_gap_m",
        "perturbation": "CAST(NULL AS STRING) AS perturbation",
        "perturbation_values": "CAST(NULL AS MAP<STRING, DOUBLE>) AS perturbation_values",
    },
    RECORDINGS: {
        "tags": "CAST(NULL AS MAP<STRING, STRING>) AS tags",
        "exposures_json": "CAST(NULL AS STRING) AS exposures_json",
        "unknown_conditions": (
            "CAST(NULL AS ARRAY<STRUCT<condition: STRING, kind: STRING, signals: ARRAY<STRING>,"
            " because: STRING>>) AS unknown_conditions"
        ),
        "uncertain_conditions": "CAST(NULL AS ARRAY<STRING>) AS uncertain_conditions",
        "label_counts": (
            "CAST(NULL AS ARRAY<STRUCT<condition: STRING, known: BIGINT, labelled: BIGINT,"
            " support: BIGINT, agreed: BIGINT, event_labelled: BIGINT, event_right: BIGINT,"
            " event_support: BIGINT, event_found: BIGINT>>) AS label_counts"
        ),
    },
}

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pyspark.sql import SparkSession


def install_views(session: SparkSession | Any, store: str | Path, *, scheme: str = "s3") -> None:
    """Give a session the views of a store: transitions, episodes, coverage, missing_cells, …

    Those of camera frames are DuckDB's alone: their files are no Delta table.

    They are temporary views over the store's newest version, and stay at it where the session
    plans a query again; call it again after an ingest.

    Args:
        session: a Spark session, of Spark Connect or classic.
        store: the store's folder, as the session's machines see it, or `s3://bucket/prefix`.
        scheme: how the session writes S3 addresses: Hadoop's Spark says `s3a`.

    Raises:
        StoreError: there is no store.
    """
    place = Location.of(store)
    if not is_store(place):
        place.expect_both_tables()
        raise StoreError("no such store", where=str(place), remedy="`restock ingest` makes one")
    for name in (TRANSITIONS, RECORDINGS):
        address = (
            str(place.folder.absolute() / name)
            if place.folder is not None
            else f"{scheme}://{place.table(name).removeprefix('s3://')}"
        )
        table = session.read.format("delta").load(address)
        # Rows of an older store have no such columns: null.
        later = (sql for column, sql in _LATER[name].items() if column not in table.columns)
        kept = [column for column in table.columns if column not in SUMMARY_SCHEMA.names]
        table = table.selectExpr(*(kept if len(kept) < len(table.columns) else "*"), *later)
        table = table.withColumnRenamed("condition", "primary_condition")  # as rows.sql does
        table.createOrReplaceTempView(f"stored_{name}")
        if name == TRANSITIONS:  # rows.sql leaves logged_ns out; Sail has no `* EXCEPT`
            stored = [f"stored_transitions.`{c}`" for c in table.columns if c != "logged_ns"]

    for statement in statements():
        session.sql(statement.replace("stored_transitions.*", ", ".join(stored)))


def statements() -> Iterator[str]:
    """The statements of VIEWS in Spark's SQL, in their order, without comments."""
    text = re.sub(r" *--.*", "", definitions(names=VIEWS))
    for pattern, spark in _RULES:
        text = re.sub(pattern, spark, text)
    for statement in text.split(";\n"):
        if statement.strip():
            name = statement.partition(" VIEW ")[2].split()[0]
            yield _BY_HAND.get(name) or statement.strip()
