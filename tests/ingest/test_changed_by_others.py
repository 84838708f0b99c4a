"""Stores whose Delta tables another tool has changed."""

import json
from pathlib import Path

import duckdb
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from deltalake import DeltaTable
from support.stores import one, shown

from restock.errors import StoreError
from restock.ingest.store import commits
from restock.ingest.store.location import RECORDINGS, TRANSITIONS
from restock.ingest.store.writer import StoreWriter, compact
from restock.replay.store.store import Store


@pytest.fixture
def store(tmp_path: Path) -> Path:
    place = tmp_path / "s"
    StoreWriter(place).write_all([one(1), one(2)])
    return place


def write_protocol(store: Path, name: str = TRANSITIONS, **protocol: object) -> Path:
    """Commit a protocol change of a table, as Spark writes it."""
    log = store / name / "_delta_log"
    number = len(list(log.glob("*.json")))
    text = json.dumps({"protocol": protocol}) + "\n"
    (log / f"{number:020}.json").write_text(text, encoding="utf-8")
    return store


def features(*names: str, reading: bool = True) -> dict[str, object]:
    listed = {"minReaderVersion": 1, "minWriterVersion": 7, "writerFeatures": list(names)}
    return listed | ({"minReaderVersion": 3, "readerFeatures": list(names)} if reading else {})


@pytest.mark.parametrize("feature", ["deletionVectors", "typeWidening", "fromTheFuture"])
def test_unknown_reader_feature_is_rejected_by_name(store, feature, shell):
    """Rows removed by deletion vectors are still in the Parquet files."""
    before = sum(shown(store).values())
    write_protocol(store, **features(feature))
    for verb in (["sql", str(store), "FROM coverage"], ["store", "compact", str(store)]):
        stderr = shell.err(*verb)
        assert f"its table `transitions` uses Delta's feature `{feature}`" in stderr
        assert "DROP FEATURE" in stderr
        assert "Traceback" not in stderr
    with pytest.raises(StoreError, match=feature):
        StoreWriter(store).write(*one(3))
    if feature != "fromTheFuture":  # Delta's library cannot open a table with this feature at all
        with Store(store, version=1) as earlier:
            assert earlier.sql("SELECT count(*) FROM transitions").fetchall() == [(before,)]


@pytest.mark.parametrize(
    ("protocol", "message"),
    [
        (features("rowTracking", "domainMetadata", reading=False), "feature `rowTracking`"),
        ({"minReaderVersion": 1, "minWriterVersion": 8}, "writer version 8"),
    ],
)
@pytest.mark.parametrize("name", [TRANSITIONS, RECORDINGS])
def test_unknown_writer_feature_prevents_writing(store, protocol, message, name):
    before = shown(store)
    write_protocol(store, name, **protocol)
    writer = StoreWriter(store)
    files = {path for path in store.rglob("*") if path.is_file()}
    for write in (lambda: writer.write(*one(3)), lambda: compact(writer)):
        with pytest.raises(StoreError, match=f"`{name}` uses Delta's {message}.*nothing changed"):
            write()
    assert shown(store) == before  # reading is still allowed
    assert {path for path in store.rglob("*") if path.is_file()} == files


def test_delta_check_constraint_prevents_writing(store):
    table = DeltaTable(str(store / TRANSITIONS))
    table.alter.add_constraint({"forward": "step_index >= 0"})
    with pytest.raises(StoreError, match="feature `checkConstraints`"):
        StoreWriter(store).write(*one(3))
    DeltaTable(str(store / TRANSITIONS)).alter.drop_constraint("forward")
    StoreWriter(store).write(*one(3))
    assert len(shown(store)) == 3


def test_append_only_table_accepts_only_new_recordings(store, monkeypatch):
    monkeypatch.setattr(commits, "ATTEMPTS", 1)
    DeltaTable(str(store / TRANSITIONS)).alter.set_table_properties({"delta.appendOnly": "true"})
    before = shown(store)
    for write in (lambda w: w.write(*one(1, "b")), compact):
        with pytest.raises(StoreError, match="feature `appendOnly`"):
            write(StoreWriter(store))
    assert shown(store) == before
    StoreWriter(store).write(*one(3))
    assert len(shown(store)) == 3


def test_unused_features_do_not_prevent_writing(store):
    write_protocol(
        store,
        minReaderVersion=3,
        minWriterVersion=7,
        readerFeatures=["timestampNtz", "columnMapping"],
        writerFeatures=[
            *("timestampNtz", "columnMapping", "appendOnly", "invariants"),
            *("checkConstraints", "changeDataFeed", "generatedColumns"),
        ],
    )
    StoreWriter(store).write(*one(1, "b"))
    compact(StoreWriter(store))
    assert set(shown(store)) == {f"{1:016x}-b", f"{2:016x}-a"}


def change_rows(store: Path, way: str) -> dict[str, int]:
    """Change rows with Delta's own library, which writes string views; return rows per ingest."""
    table = DeltaTable(str(store / TRANSITIONS))
    if way == "deleted":
        table.delete("step_index < 3")
    elif way == "updated":
        updates = {"behaviour_version": "'v2'", "reward": "-1.0", "zone": "'moved'"}
        table.update(updates=updates, predicate="action = 2")  # keeps the number of rows
    else:
        gone = pa.table({"transition_id": one(1)[1]["transition_id"].slice(0, 5)})
        merging = table.merge(
            gone, "t.transition_id = s.transition_id", source_alias="s", target_alias="t"
        )
        merging.when_matched_delete().execute()
    rows = (one(number)[1] for number in (1, 2))
    return {
        part["ingest_id"][0].as_py(): {
            "deleted": sum(step >= 3 for step in part["step_index"].to_pylist()),
            "updated": len(part),
            "merged": len(part) - 5 * (number == 0),
        }[way]
        for number, part in enumerate(rows)
    }


def assert_summaries_match_rows(store: Path) -> None:
    """Check that views from summaries agree with the table's active files."""
    files = DeltaTable(str(store / TRANSITIONS)).file_uris()
    rows, rewards, zones = duckdb.sql(
        "SELECT count(*), sum(reward), list(DISTINCT zone ORDER BY zone)"
        f" FROM read_parquet({files}, union_by_name = true)"
    ).fetchall()[0]
    with Store(store) as opened:
        summaries = opened.sql(
            "SELECT sum(primary_rows), (SELECT sum(steps) FROM episodes),"
            " (SELECT sum(transitions) FROM recordings), list(DISTINCT zone ORDER BY zone)"
            " FROM coverage"
        ).fetchall()
        returns = opened.sql("SELECT sum(return) FROM episodes").fetchall()[0][0]
    assert summaries == [(rows, rows, rows, zones)]
    assert returns == pytest.approx(rewards)


@pytest.mark.parametrize("way", ["deleted", "updated", "merged"])
def test_rows_changed_by_another_tool_are_used(store, way, shell):
    """Views use the rows, not summaries that another tool made stale."""
    expected = change_rows(store, way)
    kinds = {
        str(kind)
        for file in DeltaTable(str(store / TRANSITIONS)).file_uris()
        for kind in pq.read_schema(file).types
    }
    assert "string_view" in kinds
    assert shown(store) == expected
    assert_summaries_match_rows(store)
    with Store(store) as opened:
        changes = len(opened.changed_by_others)
    assert changes == (1 if way == "merged" else 2)
    assert f"not used: another tool may have changed {changes} recording" in shell.out(
        "info", store, "--json"
    )
    writer = StoreWriter(store)
    kept = writer.rows(f"{2:016x}", f"{2:016x}-a")
    assert kept.schema.field("zone").type == pa.string()
    assert len(kept) == expected[f"{2:016x}-a"]
    writer.write(*one(3))
    writer.write(*one(1, "b"))  # also rewrites the other recordings of its file
    assert_summaries_match_rows(store)
    assert compact(writer).summaries == (0 if way == "merged" else 1)
    assert writer.rows(f"{2:016x}", f"{2:016x}-a").equals(kept)
    with Store(store) as opened:
        assert opened.changed_by_others == []
        assert "cells" in str(opened.sql("EXPLAIN FROM coverage").fetchall())
    assert_summaries_match_rows(store)
    assert not compact(StoreWriter(store)).summaries
    writer.remove_recordings({f"{3:016x}": f"{3:016x}-a"}, "remove")
    assert shown(store) == {
        f"{1:016x}-b": len(one(1, "b")[1]),
        f"{2:016x}-a": expected[f"{2:016x}-a"],
    }
