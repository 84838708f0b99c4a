"""The store's writer, in a folder and on S3: atomic commits, also with concurrent writers."""

import multiprocessing
import os
import shutil
import time
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from deltalake import DeltaTable
from deltalake.exceptions import CommitFailedError, DeltaError
from deltalake.transaction import AddAction
from support.long import one_in
from support.paths import ROOT
from support.s3_server import files_of
from support.stores import one, shown

import restock
from restock.errors import StoreError
from restock.ingest.store.location import RECORDINGS, TRANSITIONS, Location
from restock.ingest.store.removal import remove_recordings
from restock.ingest.store.writer import StoreWriter
from restock.replay.store.store import Store


def test_written_rows_are_read_with_their_types(place):
    manifest, rows = one(1)
    version = StoreWriter(place).write(manifest, rows)
    with restock.open(place) as store:
        assert store.version == version
        assert str(store.path) == str(place)
        found = store.sql("FROM transitions ORDER BY transition_id").to_arrow_table()
    assert found["logged_ns"].to_pylist() == rows["stamp_ns"].to_pylist()  # null in `rows`
    for name in rows.drop_columns("logged_ns").column_names:
        public_name = "primary_condition" if name == "condition" else name
        assert found[public_name].to_pylist() == rows[name].to_pylist(), name
    assert found.schema.field("observation").type.list_size == len(rows["observation"][0])
    written = [file for file in files_of(place) if file.startswith("transitions/0")]
    assert written == ["transitions/0000000000000001/0000000000000001-a.parquet"]


def test_rewritten_recording_replaces_its_rows(place):
    writer = StoreWriter(place)
    version = writer.write(*one(1, "a"))
    writer.write(*one(2, "b"))
    writer.write(*one(1, "c", seed=9))
    first, second = one(1, "c", seed=9)[1], one(2, "b")[1]
    assert shown(place) == {
        first["ingest_id"][0].as_py(): len(first),
        second["ingest_id"][0].as_py(): len(second),
    }
    assert sorted(writer.live()["ingest_id"].to_pylist()) == sorted(shown(place))
    # An old version keeps its manifests: they leave `recordings` when the rows are replaced, and
    # are found by name until they are cleaned.
    with Store(place, version=version) as store:
        old_ingest = [("0000000000000001-a",)]
        assert store.sql("SELECT DISTINCT ingest_id FROM transitions").fetchall() == old_ingest
        assert store.sql("SELECT ingest_id FROM recordings").fetchall() == old_ingest
    assert writer.clean() == []
    old = "0000000000000001/0000000000000001-a.parquet"
    assert writer.clean(retention_hours=0) == [f"{RECORDINGS}/{old}", f"{TRANSITIONS}/{old}"]
    assert not [file for file in files_of(place) if file.endswith(old)]
    assert len(shown(place)) == 2


def _write(place: Path | str, recording: int, ingest: str) -> None:
    StoreWriter(place).write(*one(recording, ingest))


@pytest.mark.parametrize("place", one_in(2, ["folder", "s3"]), indirect=True)
def test_concurrent_writers_lose_and_duplicate_nothing(place):
    """All processes create the store; two of them write the same recording."""
    context = multiprocessing.get_context("spawn")
    jobs = [(1, "a"), (1, "b"), (2, "a")]
    processes = [context.Process(target=_write, args=(place, *job)) for job in jobs]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0] * len(jobs)
    found = shown(place)
    assert sorted(ingest.split("-")[0][-1] for ingest in found) == ["1", "2"]
    for ingest, count in found.items():
        recording, name = ingest.split("-")
        assert count == len(one(int(recording, 16), name)[1])


def test_reader_between_two_commits_sees_recording(tmp_path, monkeypatch):
    """The reader opens the old rows, and their manifest is gone when it looks."""
    path = tmp_path / "s"
    StoreWriter(path).write(*one(1, "a"))
    open_table = Location.open_table

    def open_after_write(self, name, *rest):
        if name == RECORDINGS:
            monkeypatch.undo()
            StoreWriter(path).write(*one(1, "b"))
        return open_table(self, name, *rest)

    monkeypatch.setattr(Location, "open_table", open_after_write)
    assert shown(path) == {"0000000000000001-a": len(one(1, "a")[1])}


def test_orphans_are_cleaned_only_after_retention(tmp_path):
    writer = StoreWriter(tmp_path / "s")
    writer.write(*one(1))
    orphan = tmp_path / "s" / "transitions" / "00000000000000ff" / "x.parquet"
    orphan.parent.mkdir()
    orphan.write_bytes(b"left by a killed writer")
    assert writer.clean() == []
    assert orphan.exists()
    old = time.time() - 8 * 24 * 3600
    os.utime(orphan, (old, old))
    version = DeltaTable(str(tmp_path / "s" / "transitions")).version()
    assert writer.clean() == ["transitions/00000000000000ff/x.parquet"]
    assert writer.clean() == []
    assert not orphan.exists()
    assert len(shown(tmp_path / "s")) == 1
    assert DeltaTable(str(tmp_path / "s" / "transitions")).version() == version


def with_payload(recording: int) -> tuple[pa.Table, pa.Table]:
    """Return tables of a recording with a custom signal."""
    manifest, rows = one(recording)
    return manifest, rows.append_column("payload_kg", pa.array([3.0] * len(rows)))


def test_columns_added_by_two_writers_are_added_once(tmp_path, monkeypatch):
    path = tmp_path / "s"
    StoreWriter(path).write(*one(1))
    open_table = Location.open_table

    def open_before_write(self, name, *rest):
        table = open_table(self, name, *rest)
        if name == TRANSITIONS:
            monkeypatch.undo()
            StoreWriter(path).write(*with_payload(2))
        return table

    monkeypatch.setattr(Location, "open_table", open_before_write)
    StoreWriter(path).write(*with_payload(3))
    assert len(shown(path)) == 3


def test_commit_with_lost_response_is_not_repeated(tmp_path, monkeypatch):
    transact, writer = StoreWriter.transact, StoreWriter(tmp_path / "s")

    def lose_next_response() -> None:
        def transact_without_response(self, *args):
            transact(self, *args)
            monkeypatch.setattr(StoreWriter, "transact", transact)
            raise CommitFailedError("the answer was lost")

        monkeypatch.setattr(StoreWriter, "transact", transact_without_response)

    writer.write_all([one(1, "a"), one(2)])
    lose_next_response()
    writer.write(*one(1, "b"))
    assert set(shown(tmp_path / "s")) == {"0000000000000001-b", "0000000000000002-a"}
    lose_next_response()
    removal = remove_recordings(writer, ["0000000000000002"])
    assert removal.version == removal.version_before + 1
    assert set(shown(tmp_path / "s")) == {"0000000000000001-b"}
    assert DeltaTable(str(tmp_path / "s" / RECORDINGS)).count() == 1


def test_read_only_store_is_reported_as_not_writable(tmp_path, monkeypatch):
    """Simulate the error of delta-rs, as a test run by root may write everywhere."""
    StoreWriter(tmp_path / "s").write(*one(1))

    def denied(self, *args, **options):
        arrow = "\n \x1b[31m↳\x1b[0m "
        raise OSError(
            arrow.join(["Generic LocalFileSystem error", "Permission denied (os error 13)"])
        )

    monkeypatch.setattr(DeltaTable, "create_write_transaction", denied)
    with pytest.raises(StoreError, match=r"cannot be written: .*Permission denied"):
        remove_recordings(StoreWriter(tmp_path / "s"), ["0000000000000001"])
    assert len(shown(tmp_path / "s")) == 1


def test_concurrent_write_loses_nothing(tmp_path, before_commit):
    path = tmp_path / "s"
    StoreWriter(path).write(*one(2))
    before_commit(lambda: StoreWriter(path).write(*one(1, "b")), TRANSITIONS)
    StoreWriter(path).write(*one(1, "a"))
    assert list(shown(path)) == ["0000000000000001-a", "0000000000000002-a"]
    manifests = DeltaTable(str(path / RECORDINGS)).file_uris()
    assert {Path(uri).stem for uri in manifests} == set(shown(path))


def test_new_columns_are_null_in_old_rows(tmp_path):
    path = tmp_path / "s"
    StoreWriter(path).write(*one(1))
    StoreWriter(path).write(*with_payload(2))
    with Store(path) as store:
        found = store.sql(
            "SELECT recording_id[-1:] AS r, count(payload_kg) > 0 FROM stored_transitions"
            " GROUP BY ALL ORDER BY ALL"
        ).fetchall()
    assert found == [("1", False), ("2", True)]


@pytest.mark.parametrize(
    ("file", "message"),
    [("panel.json", "is a panel, not a store"), ("config.json", "is the folder of a run")],
)
def test_writing_into_panel_or_run_is_rejected(tmp_path, file, message, shell):
    (tmp_path / file).write_text("{}")
    with pytest.raises(StoreError, match=message):
        StoreWriter(tmp_path).write(*one(1))
    # Reported once, before any recording is read.
    recordings = [str(ROOT / "sample_logs" / name) for name in ("amr_monday.mcap", "amr_tuesday")]
    stderr = shell.err("ingest", *recordings, "--store", tmp_path)
    assert (stderr.count(message), "was not added" in stderr) == (1, False)
    assert [path.name for path in tmp_path.iterdir()] == [file]


def test_store_with_config_file_beside_its_tables(tmp_path):
    StoreWriter(tmp_path).write(*one(1))
    (tmp_path / "config.json").write_text("{}")
    assert StoreWriter(tmp_path).write(*one(2)) == 2


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("", "the name of the store is empty"),
        ("gs://bucket/store", "cannot be on gs:"),
        ("some%20where/store", "percent sign"),
        ("s3://bucket/some%20where", "percent sign"),
    ],
)
def test_invalid_store_address_is_rejected(place, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(StoreError, match=message):
        StoreWriter(place)
    with pytest.raises(StoreError, match=message):
        Store(place)
    assert list(tmp_path.iterdir()) == []


def test_files_written_by_other_tools_are_rejected(tmp_path):
    path = tmp_path / "s"
    StoreWriter(path).write(*one(1))
    writer, table = StoreWriter(path), DeltaTable(str(path / "transitions"))
    size = writer.path.write(pa.table({"reward": [1.0]}), "transitions/strange.parquet")
    writer.transact(table, [AddAction("strange.parquet", size, {}, 0, True, "{}")], [])
    with pytest.raises(StoreError, match="did not write"):
        StoreWriter(path).write(*one(3))


def test_floats_are_byte_stream_split_and_compressed(tmp_path):
    manifest, rows = one(1)
    StoreWriter(tmp_path / "s").write(manifest, rows)
    (file,) = (tmp_path / "s" / "transitions").glob("*/*.parquet")
    group = pq.ParquetFile(file).metadata.row_group(0)
    columns = {group.column(i).path_in_schema: group.column(i) for i in range(group.num_columns)}
    assert {column.compression for column in columns.values()} == {"ZSTD"}
    assert "BYTE_STREAM_SPLIT" in columns["observation.list.element"].encodings
    assert "BYTE_STREAM_SPLIT" in columns["pose_x_m"].encodings


def test_unreadable_store_is_reported_as_permission_error(tmp_path: Path) -> None:
    """Simulate the error of delta-rs, as a test run by root may read everything."""
    message = (
        "Generic LocalFileSystem error\n ↳ IO error for operation on /s/_delta_log\x1b[0m\n ↳ "
    )
    for error in (
        OSError(f"{message}Permission denied (os error 13)"),
        DeltaError("Permission denied"),
    ):
        with pytest.raises(StoreError) as caught, Location.of(tmp_path).translate_errors():
            raise error
        assert caught.value.what.startswith("permission denied: ")
        assert ("/s/_delta_log cannot" in caught.value.what) == isinstance(error, OSError)
    own = PermissionError(13, "Permission denied", "/s/x")
    with pytest.raises(PermissionError), Location.of(tmp_path).translate_errors():
        raise own


@pytest.mark.parametrize("scheme", ["s3", "s3a", "https"])
@pytest.mark.parametrize("secret", ["hush", "hu/sh", "hu@sh"])
def test_secret_in_address_is_rejected_and_hidden(scheme, secret):
    with pytest.raises(StoreError, match="must not hold a key and its secret") as caught:
        Location.of(f"{scheme}://AKIA:{secret}@bucket/store")
    message = str(caught.value)
    assert f"{scheme}://***:***@bucket/store" in message
    assert "hu" not in message
    assert "AKIA:" not in message


def test_version_in_s3_address_is_not_a_secret():
    assert str(Location.of("s3://bucket/a@2026-11-01T08:00Z")) == "s3://bucket/a"


def test_writer_reopens_table_only_after_other_commits(tmp_path, monkeypatch):
    writer, opened = StoreWriter(tmp_path / "s"), []
    open_table = Location.open_table
    monkeypatch.setattr(
        Location, "open_table", lambda self, *of: opened.append(of) or open_table(self, *of)
    )
    writer.write(*one(1))
    assert sorted(opened) == [(RECORDINGS,), (TRANSITIONS,)]
    writer.write(*one(2))
    assert len(opened) == 2
    StoreWriter(tmp_path / "s").write(*one(3))
    opened.clear()
    writer.write(*one(1, "again"))
    assert sorted(opened) == [(RECORDINGS,), (TRANSITIONS,)]
    shutil.rmtree(tmp_path / "s")
    with pytest.raises(StoreError, match="cannot be opened"):
        writer.write(*one(4))
