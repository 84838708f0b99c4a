"""A store goes on after its files were compacted, and its summaries stay true."""

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


def compacted_by_delta(path: Path) -> None:
    """As any tool that knows Delta does it, with the old files gone."""
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


def same_as_scanned(path: Path | str) -> None:
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
            assert rounded(by_summary) == rounded(by_scan), view
        plan = str(store.sql("EXPLAIN FROM coverage_by_condition").fetchall())
        assert "cells" in plan
        count = store.sql("SELECT count(*) FROM transitions")
        assert count.columns == ["count_star()"]
        assert count.fetchall() == scanned.sql("SELECT count(*) FROM transitions").fetchall()


def rounded(relation: duckdb.DuckDBPyRelation) -> list[tuple[object, ...]]:
    """Round values, as sums in another order differ in their last digits."""
    return [
        tuple(round(value, 6) if isinstance(value, float) else value for value in row)
        for row in relation.fetchall()
    ]


def test_views_over_summaries_are_those_over_rows(writer, tmp_path):
    writer.write(*one(1, "b", seed=3))
    same_as_scanned(tmp_path / "s")
    compacted_by_delta(tmp_path / "s")
    writer.write(*one(2, "c", seed=5))
    assert compact(writer).summaries == 1  # nobody knows what the other tool did to its rows
    same_as_scanned(tmp_path / "s")


def test_compaction_is_advised_of_many_files_of_few_rows(tmp_path):
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
def test_a_compacted_store_goes_on(place):
    writer = StoreWriter(place)
    version = writer.write_all([one(1), one(2), one(3)])
    as_written = writer.rows(f"{2:016x}", f"{2:016x}-a")
    done = compact(writer)
    assert (done.files_before, done.files_after, done.manifests_after) == (3, 1, 1)
    assert done.rows == sum(shown(place).values())
    # Replaced, added, compacted again: and each row as its ingest wrote it.
    writer.write(*one(2, "b", seed=7))
    writer.write(*one(4))
    assert compact(writer).files_after == 1
    assert writer.clean(retention_hours=24) == []
    assert sorted(writer.live()["ingest_id"].to_pylist()) == sorted(shown(place))
    with Store(place, version=version) as store:  # as it was before all that
        counts = store.sql("SELECT ingest_id, count(*) FROM transitions GROUP BY ALL").fetchall()
    assert dict(counts) == {f"{n:016x}-a": len(one(n)[1]) for n in (1, 2, 3)}
    writer.clean(retention_hours=0)
    kept = writer.rows(f"{3:016x}", f"{3:016x}-a")
    assert kept.to_pylist() == one(3)[1].to_pylist()
    assert as_written.to_pylist() == one(2)[1].to_pylist()
    copy = replaced(kept, {"recording_id": "f" * 16, "ingest_id": "copy"})
    assert writer.repeated(writer.stage(manifest(copy), copy), 0.2) is not None


def test_nothing_is_left_to_compact_and_a_dry_run_writes_nothing(writer, tmp_path, capsys, shell):
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
def test_an_ingest_while_it_compacts_loses_nothing(writer, tmp_path, before_commit, recording):
    """One that replaces a recording undoes the step; one that adds another does not."""
    again = one(recording, "b", seed=8)
    before_commit(lambda: StoreWriter(tmp_path / "s").write(*again), TRANSITIONS)
    done = compact(writer)
    assert done.changed_meanwhile == (2 if recording == 1 else 0)
    assert shown(tmp_path / "s")[f"{recording:016x}-b"] == len(again[1])
    assert len(shown(tmp_path / "s")) == (2 if recording == 1 else 3)
    same_as_scanned(tmp_path / "s")


def test_a_faster_compaction_undoes_no_replacing_ingest(writer, tmp_path, before_commit):
    before_commit(lambda: compact(StoreWriter(tmp_path / "s")), TRANSITIONS)
    writer.write(*one(1, "b", seed=8))
    assert shown(tmp_path / "s") == {
        f"{1:016x}-b": len(one(1, "b", seed=8)[1]),
        f"{2:016x}-a": len(one(2)[1]),
    }


def test_the_ends_of_episodes_outlive_compaction(tmp_path):
    """Of several recordings, one of which has none."""
    writer = StoreWriter(tmp_path / "s")
    ends = pa.table({"episode_index": [0, 1], "step_index": [7, 9]})
    manifest, rows = one(1)
    writer.write(manifest, rows.replace_schema_metadata({ENDS: packed(ends)}))
    writer.write(*one(2))
    compact(writer)
    with Store(tmp_path / "s") as store:
        assert list(store.episode_ends()) == [(f"{1:016x}", ends)]
        assert list(store.episode_ends([f"{2:016x}"])) == []


def test_without_restock_each_row_is_read_once(writer, tmp_path):
    """As docs/libraries.md says."""
    writer.write(*one(2, "b"))
    compact(writer)
    place = str(tmp_path / "s" / TRANSITIONS)
    count = sum(shown(tmp_path / "s").values())
    assert len(duckdb.read_parquet(DeltaTable(place).file_uris())) == count
    assert len(duckdb.read_parquet(f"{place}/**/*.parquet")) > 2 * count


def parquet(path: Path) -> list[Path]:
    return sorted(path.rglob("*.parquet"))


@pytest.mark.parametrize("name", [RECORDINGS, TRANSITIONS])
@pytest.mark.parametrize("committed", [False, True])
def test_an_interrupted_compaction_leaves_no_orphan(writer, tmp_path, monkeypatch, name, committed):
    before, whole, transact = parquet(tmp_path / "s"), shown(tmp_path / "s"), StoreWriter.transact

    def interrupted(self, table, actions, turns, operation=OPERATION):
        at_it = table.table_uri.rstrip("/").endswith(name)
        if committed or not at_it:
            transact(self, table, actions, turns, operation)
        if at_it:
            raise KeyboardInterrupt

    monkeypatch.setattr(StoreWriter, "transact", interrupted)
    with pytest.raises(KeyboardInterrupt):
        compact(writer)
    held = {
        tmp_path / "s" / table / file.path
        for table in (RECORDINGS, TRANSITIONS)
        for file in writer.files(table)
    }
    assert set(parquet(tmp_path / "s")) == set(before) | held
    assert shown(tmp_path / "s") == whole


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
@pytest.mark.parametrize("name", [RECORDINGS, TRANSITIONS])
def test_a_write_that_fails_leaves_no_part_of_a_file(writer, tmp_path, monkeypatch, name, error):
    if name == TRANSITIONS:
        fold(writer)
    before, write = parquet(tmp_path / "s"), pq.ParquetWriter.write_table

    def full(self, table, **given):
        write(self, table, **given)
        raise error

    monkeypatch.setattr(pq.ParquetWriter, "write_table", full)
    with pytest.raises(StoreError if isinstance(error, OSError) else KeyboardInterrupt):
        compact(writer)
    assert parquet(tmp_path / "s") == before


def test_one_ingest_after_the_other_leaves_few_manifests(tmp_path, monkeypatch):
    """Each is written again a few times only; a reader that was open sees all that follow."""
    monkeypatch.setattr(writer_module, "FOLD_FILES", 2)
    writer, reader, merge, written = StoreWriter(tmp_path / "s"), None, writer_module.merge, []

    def counted(*args, **given):
        made = merge(*args, **given)
        written.append(made.rows)
        return made

    monkeypatch.setattr(writer_module, "merge", counted)
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
