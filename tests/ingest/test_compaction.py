"""Compacted stores stay usable, and their summaries stay correct."""

from pathlib import Path

import duckdb
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from deltalake import DeltaTable
from support.long import one_in
from support.stores import manifest, one, shown, views_over

from restock.cli import main
from restock.errors import StoreError
from restock.ingest.store import writer as writer_module
from restock.ingest.store.location import RECORDINGS, TRANSITIONS
from restock.ingest.store.transitions import ENDS, packed, replaced
from restock.ingest.store.writer import OPERATION, StoreWriter, compact, fold, fold_if_many
from restock.replay.store.audit import Finding, run_audits, shipped_audits
from restock.replay.store.store import Store


def compact_with_delta(path: Path) -> None:
    """Compact and vacuum with Delta's library, as another tool does."""
    for name in (RECORDINGS, TRANSITIONS):
        table = DeltaTable(str(path / name))
        table.optimize.compact()
        table.vacuum(retention_hours=0, dry_run=False, enforce_retention_duration=False)


COMMON = (
    "episodes ORDER BY episode_id",
    "coverage",
    "coverage_by_condition",
    "missing_cells",
    "cells_below(5)",
    "episode_signals ORDER BY episode_id, signal",
    "flawed_rows ORDER BY transition_id",
    "zone_steps ORDER BY ALL",
    "condition_steps ORDER BY ALL",
    "episode_conditions ORDER BY episode_id, zone NULLS FIRST, condition",
    "repeated_rows(1)",
    "recording_cells ORDER BY ALL",
    "recording_conditions ORDER BY ALL",
    "episode_kinds(3) ORDER BY episode_id",
)


def assert_views_match_scan(path: Path | str) -> None:
    """Check that the common views agree with views that scan the rows."""
    with Store(path) as store:
        scanned = duckdb.connect()
        rows = store.sql("FROM stored_transitions").to_arrow_table()
        manifests = store.sql("FROM stored_recordings").to_arrow_table()
        made = views_over(scanned, rows, manifests, store.observation_type)
        made.make(" ".join(COMMON))
        made.hold(["transitions"])
        for view in COMMON:
            by_summary, by_scan = store.sql(f"FROM {view}"), scanned.sql(f"FROM {view}")
            assert by_summary.columns == by_scan.columns
            assert by_summary.types == by_scan.types, view
            assert round_rows(by_summary) == round_rows(by_scan), view
        plan = str(store.sql("EXPLAIN FROM coverage_by_condition").fetchall())
        assert "cells" in plan
        count = store.sql("SELECT count(*) FROM transitions")
        assert count.columns == ["count_star()"]
        assert count.fetchall() == scanned.sql("SELECT count(*) FROM transitions").fetchall()


def round_rows(relation: duckdb.DuckDBPyRelation) -> list[tuple[object, ...]]:
    """Return rounded rows, as sums in another order differ in their last digits."""
    return [
        tuple(round(value, 6) if isinstance(value, float) else value for value in row)
        for row in relation.fetchall()
    ]


def test_summary_views_match_row_views(writer, tmp_path):
    writer.write(*one(1, "b", seed=3))
    assert_views_match_scan(tmp_path / "s")
    compact_with_delta(tmp_path / "s")
    writer.write(*one(2, "c", seed=5))
    assert compact(writer).summaries == 1  # the other tool's changes of its rows are unknown
    assert_views_match_scan(tmp_path / "s")


def test_audit_advises_compaction_of_many_small_files(tmp_path):
    writer = StoreWriter(tmp_path / "s")
    writer.write_all([one(1), one(2), one(3)])
    audits = [audit for audit in shipped_audits() if audit.name == "many_small_files"]

    def finding(files: int) -> Finding:
        limits = {"many_small_files": {"min_files": files, "max_rows_a_file": 15_000}}
        with Store(tmp_path / "s") as store:
            return run_audits(store.connection, audits, limits)[0]

    many = finding(3)
    assert (finding(4).status, many.status, many.sample[0]["files"]) == ("pass", "info", 3)
    compact(writer)
    assert finding(3).status == "pass"


@pytest.mark.parametrize("place", one_in(2, ["folder", "s3"]), indirect=True)
def test_compacted_store_accepts_writes_and_compactions(place):
    writer = StoreWriter(place)
    version = writer.write_all([one(1), one(2), one(3)])
    as_written = writer.rows(f"{2:016x}", f"{2:016x}-a")
    compaction = compact(writer)
    assert (compaction.files_before, compaction.files_after, compaction.manifests_after) == (
        3,
        1,
        1,
    )
    assert compaction.rows == sum(shown(place).values())
    # Rows stay as ingested after replacing, adding and compacting again.
    writer.write(*one(2, "b", seed=7))
    writer.write(*one(4))
    assert compact(writer).files_after == 1
    assert writer.clean(retention_hours=24) == []
    assert sorted(writer.live()["ingest_id"].to_pylist()) == sorted(shown(place))
    with Store(place, version=version) as store:  # the version before compaction
        counts = store.sql("SELECT ingest_id, count(*) FROM transitions GROUP BY ALL").fetchall()
    assert dict(counts) == {f"{n:016x}-a": len(one(n)[1]) for n in (1, 2, 3)}
    writer.clean(retention_hours=0)
    kept = writer.rows(f"{3:016x}", f"{3:016x}-a")
    assert kept.to_pylist() == one(3)[1].to_pylist()
    assert as_written.to_pylist() == one(2)[1].to_pylist()
    copy = replaced(kept, {"recording_id": "f" * 16, "ingest_id": "copy"})
    assert writer.repeated(writer.stage(manifest(copy), copy)) is not None


def test_dry_run_writes_nothing_and_second_run_has_no_work(writer, tmp_path, capsys, shell):
    files, command = sorted((tmp_path / "s").rglob("*")), ["store", "compact", str(tmp_path / "s")]
    assert main([*command, "--dry-run"]) == 0
    assert sorted((tmp_path / "s").rglob("*")) == files
    planned = capsys.readouterr().err
    assert "2 -> 1 files" in planned
    assert shell.err(*command, code=0) == planned.replace("would write", "wrote")
    assert compact(writer).version is None
    with pytest.raises(StoreError, match="no such store"):
        compact(StoreWriter(tmp_path / "none"))
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="is a file, not a store"):
        compact(StoreWriter(tmp_path / "file"))


@pytest.mark.long
@pytest.mark.parametrize("recording", [1, 3])
def test_concurrent_ingest_during_compaction(writer, tmp_path, before_commit, recording):
    """A replacing ingest undoes the compaction step; an added recording does not."""
    again = one(recording, "b", seed=8)
    before_commit(lambda: StoreWriter(tmp_path / "s").write(*again), TRANSITIONS)
    compaction = compact(writer)
    assert compaction.changed_meanwhile == (2 if recording == 1 else 0)
    assert shown(tmp_path / "s")[f"{recording:016x}-b"] == len(again[1])
    assert len(shown(tmp_path / "s")) == (2 if recording == 1 else 3)
    assert_views_match_scan(tmp_path / "s")


def test_concurrent_compaction_keeps_replacing_ingest(writer, tmp_path, before_commit):
    before_commit(lambda: compact(StoreWriter(tmp_path / "s")), TRANSITIONS)
    writer.write(*one(1, "b", seed=8))
    assert shown(tmp_path / "s") == {
        f"{1:016x}-b": len(one(1, "b", seed=8)[1]),
        f"{2:016x}-a": len(one(2)[1]),
    }


def test_episode_ends_survive_compaction(tmp_path):
    """One of two recordings has episode ends."""
    writer = StoreWriter(tmp_path / "s")
    ends = pa.table({"episode_index": [0, 1], "step_index": [7, 9]})
    manifest, rows = one(1)
    writer.write(manifest, rows.replace_schema_metadata({ENDS: packed(ends)}))
    writer.write(*one(2))
    compact(writer)
    with Store(tmp_path / "s") as store:
        assert list(store.episode_ends()) == [(f"{1:016x}", ends)]
        assert list(store.episode_ends([f"{2:016x}"])) == []


def test_other_tools_read_each_row_once(writer, tmp_path):
    """Check the way to read a store that docs/libraries.md gives."""
    writer.write(*one(2, "b"))
    compact(writer)
    place = str(tmp_path / "s" / TRANSITIONS)
    count = sum(shown(tmp_path / "s").values())
    assert len(duckdb.read_parquet(DeltaTable(place).file_uris())) == count
    assert len(duckdb.read_parquet(f"{place}/**/*.parquet")) > 2 * count


def parquet_files(path: Path) -> list[Path]:
    return sorted(path.rglob("*.parquet"))


@pytest.mark.parametrize("name", [RECORDINGS, TRANSITIONS])
@pytest.mark.parametrize("committed", [False, True])
def test_interrupted_compaction_leaves_no_orphan(writer, tmp_path, monkeypatch, name, committed):
    before, whole, transact = (
        parquet_files(tmp_path / "s"),
        shown(tmp_path / "s"),
        StoreWriter.transact,
    )

    def interrupted(self, table, actions, turns, operation=OPERATION):
        is_target = table.table_uri.rstrip("/").endswith(name)
        if committed or not is_target:
            transact(self, table, actions, turns, operation)
        if is_target:
            raise KeyboardInterrupt

    monkeypatch.setattr(StoreWriter, "transact", interrupted)
    with pytest.raises(KeyboardInterrupt):
        compact(writer)
    held = {
        tmp_path / "s" / table / file.path
        for table in (RECORDINGS, TRANSITIONS)
        for file in writer.files(table)
    }
    assert set(parquet_files(tmp_path / "s")) == set(before) | held
    assert shown(tmp_path / "s") == whole


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
@pytest.mark.parametrize("name", [RECORDINGS, TRANSITIONS])
def test_failed_write_leaves_no_partial_file(writer, tmp_path, monkeypatch, name, error):
    if name == TRANSITIONS:
        fold(writer)
    before, write = parquet_files(tmp_path / "s"), pq.ParquetWriter.write_table

    def write_and_fail(self, table, **options):
        write(self, table, **options)
        raise error

    monkeypatch.setattr(pq.ParquetWriter, "write_table", write_and_fail)
    with pytest.raises(StoreError if isinstance(error, OSError) else KeyboardInterrupt):
        compact(writer)
    assert parquet_files(tmp_path / "s") == before


def test_successive_ingests_leave_few_manifests(tmp_path, monkeypatch):
    """Each manifest is rewritten a few times only, and an open reader sees all later ones."""
    monkeypatch.setattr(writer_module, "FOLD_FILES", 2)
    writer, reader, merge, written = StoreWriter(tmp_path / "s"), None, writer_module.merge, []

    def merge_and_count(*args, **options):
        merged = merge(*args, **options)
        written.append(merged.rows)
        return merged

    monkeypatch.setattr(writer_module, "merge", merge_and_count)
    for recording in range(1, 9):
        writer.write_all([one(recording)])
        fold_if_many(writer)
        reader = reader or StoreWriter(tmp_path / "s")
        assert reader.manifest(f"{recording:016x}")["ingest_id"] == f"{recording:016x}-a"
        (first,) = writer.live(f"{1:016x}").to_pylist(maps_as_pydicts="strict")
        assert reader.manifest(f"{1:016x}") == first
        assert reader.manifest(f"{recording + 1:016x}") is None
    assert written == [2, 4, 2, 8]
    assert [len(file.ingests) for file in reader.files(RECORDINGS)] == [8]
