"""Removal of recordings from a store: all named ones or none; earlier versions keep them."""

import datetime as dt
import os
import time
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pytest
from support.long import one_in
from support.stores import one, shown

from restock.cli import main
from restock.errors import StoreError
from restock.ingest.relabel import RecordingCorrections, correct_store
from restock.ingest.store.location import RECORDINGS, TRANSITIONS
from restock.ingest.store.manifest import Correction
from restock.ingest.store.removal import RemovedRecording, remove_recordings
from restock.ingest.store.transitions import replaced
from restock.ingest.store.writer import StoreWriter, compact
from restock.replay.store.store import Store


def id_of(n: int) -> str:
    return f"{n:016x}"


def expected(*ingests: tuple[int, str]) -> dict[str, int]:
    return {f"{id_of(n)}-{ingest}": len(one(n, ingest)[1]) for n, ingest in ingests}


def store_of_three(place: Path | str, *, compacted: bool = False) -> StoreWriter:
    writer = StoreWriter(place)
    writer.write_all([one(1), one(2), one(3)])
    if compacted:
        compact(writer)
    return writer


def recording_named(recording_id: str, path: str) -> tuple[pa.Table, pa.Table]:
    """Return a recording with this id, ingested from this path."""
    new = {"recording_id": recording_id, "source_file": path, "ingest_id": f"{recording_id}-a"}
    manifest, rows = (replaced(table, new) for table in one(1))
    return manifest, rows


def make_files_old(place: Path) -> None:
    """Set the store's Parquet files to an old modification time; Delta's log stays."""
    for file in place.rglob("*.parquet"):
        os.utime(file, (0, 0))


@pytest.mark.parametrize("compacted", [False, True], ids=["own files", "compacted files"])
@pytest.mark.parametrize("place", one_in(2, ["folder", "s3"]), indirect=True)
def test_removed_recording_stays_in_earlier_version(place, compacted):
    writer = store_of_three(place, compacted=compacted)
    before = writer.rows(id_of(3), f"{id_of(3)}-a").to_pylist()
    removal = remove_recordings(writer, [id_of(2)])
    manifest, rows = one(2)
    assert removal.recordings == [
        RemovedRecording(id_of(2), "logs/2.mcap", len(rows), manifest["episodes"][0].as_py(), 0, {})
    ]
    assert (removal.left, removal.version) == (2, removal.version_before + 1)
    assert shown(place) == expected((1, "a"), (3, "a"))
    assert len(writer.live()) == 2
    assert writer.rows(id_of(3), f"{id_of(3)}-a").to_pylist() == before
    writer.clean()
    compact(writer)
    with Store(place, version=removal.version_before) as store:
        assert store.sql("SELECT count(*) FROM recordings").fetchall() == [(3,)]
        assert store.sql("SELECT count(*) FROM transitions").fetchall() == [
            (sum(expected((1, "a"), (2, "a"), (3, "a")).values()),)
        ]
    assert shown(place) == expected((1, "a"), (3, "a"))
    writer.write(*one(2, "b"))
    assert shown(place) == expected((1, "a"), (2, "b"), (3, "a"))


def test_files_are_deleted_after_retention(tmp_path):
    writer = store_of_three(tmp_path / "s")
    removal = remove_recordings(writer, [id_of(2)])
    assert writer.clean() == []
    path = f"{id_of(2)}/{id_of(2)}-a.parquet"
    assert writer.clean(retention_hours=0) == [f"{RECORDINGS}/{path}", f"{TRANSITIONS}/{path}"]
    with pytest.raises(StoreError, match="can no longer be read"):
        Store(tmp_path / "s", version=removal.version_before)
    assert shown(tmp_path / "s") == expected((1, "a"), (3, "a"))


@pytest.mark.parametrize("compacted", [False, True], ids=["own files", "compacted files"])
def test_all_recordings_of_an_old_store_can_be_removed(tmp_path, compacted, monkeypatch):
    """The manifests' file is old by then and belongs to no remaining recording."""
    place = tmp_path / "s"
    long_ago_ns = time.time_ns() - 30 * 86400 * 10**9
    with monkeypatch.context() as patched:
        patched.setattr("restock.ingest.store.commits.time.time_ns", lambda: long_ago_ns)
        writer = store_of_three(place, compacted=compacted)
    make_files_old(place)
    removal = remove_recordings(writer, [id_of(n) for n in (1, 2, 3)])
    assert removal.left == 0
    assert shown(place) == {}
    writer.clean()
    compact(writer)
    with Store(place, version=removal.version_before) as store:
        assert store.sql("SELECT count(*) FROM recordings").fetchall() == [(3,)]
        assert store.sql("SELECT count(*) FROM transitions").fetchall() != [(0,)]
    writer.write(*one(1, "b"))
    compact(writer)
    writer.clean()
    with Store(place, version=removal.version_before) as store:
        assert store.sql("SELECT count(*) FROM recordings").fetchall() == [(3,)]
    assert shown(place) == expected((1, "b"))


def test_recording_is_found_by_id_prefix_or_path(tmp_path, monkeypatch):
    writer = StoreWriter(tmp_path / "s")
    monkeypatch.chdir(tmp_path)
    paths = {"abcdef1111111111": "logs/b.mcap", "abcde12222222222": "logs/a/c.mcap"}
    paths |= {"0123450000000000": "/x/c.mcap"}
    for recording_id, path in paths.items():
        writer.write(*recording_named(recording_id, path))

    def matched_ids(*names: str) -> set[str]:
        removal = remove_recordings(writer, names, dry_run=True)
        return {removed.recording_id for removed in removal.recordings}

    b, c, x = paths
    assert matched_ids("abcdef") == matched_ids("ABCDEF1111111111") == {b}
    assert matched_ids("abcde1", "01234500") == {c, x}
    assert (
        matched_ids("logs/b.mcap")
        == matched_ids("b.mcap")
        == matched_ids("./logs/../logs/b.mcap")
        == {b}
    )
    assert matched_ids(str(tmp_path / "logs/b.mcap")) == {b}
    assert matched_ids("a/c.mcap", "b.mcap", "abcdef", "logs/b.mcap") == {b, c}
    assert len(shown(tmp_path / "s")) == 3
    for wrong, message in {
        "c.mcap": r"'c.mcap' is the name of 2 recordings: .*x/c.mcap.*logs/a/c.mcap",
        "abcde": "no recording 'abcde' is in the store",
        "logs/bb.mcap": "no recording 'logs/bb.mcap' is in the store",
        "fedcba98": "no recording 'fedcba98' is in the store",
        "": "no recording ''",
    }.items():
        with pytest.raises(StoreError, match=message) as error:
            remove_recordings(writer, [x, wrong])
        assert "nothing was removed" in str(error.value)
        assert "at least its first 6 digits" in str(error.value)
    assert len(shown(tmp_path / "s")) == 3


@pytest.mark.parametrize("compacted", [False, True], ids=["own files", "compacted files"])
def test_removal_succeeds_after_concurrent_write(tmp_path, before_commit, compacted):
    writer = store_of_three(tmp_path / "s", compacted=compacted)
    before_commit(lambda: StoreWriter(tmp_path / "s").write_all([one(1, "b"), one(4)]))
    remove_recordings(writer, [id_of(2)])
    assert shown(tmp_path / "s") == expected((1, "b"), (3, "a"), (4, "a"))


@pytest.mark.parametrize("compacted", [False, True], ids=["own files", "compacted files"])
def test_concurrently_reingested_recording_is_not_removed(tmp_path, before_commit, compacted):
    writer = store_of_three(tmp_path / "s", compacted=compacted)
    before_commit(lambda: StoreWriter(tmp_path / "s").write(*one(2, "b")))
    with pytest.raises(StoreError, match=f"{id_of(2)} was ingested again or removed in the mean"):
        remove_recordings(writer, [id_of(1), id_of(2)])
    assert shown(tmp_path / "s") == expected((1, "a"), (2, "b"), (3, "a"))


def test_remove_command_lists_removed_recordings(tmp_path, shell):
    place = str(tmp_path / "s")
    store_of_three(place)
    out, stderr = shell.printed("store", "remove", place, "logs/2.mcap", "--dry-run")
    assert id_of(2) in out
    assert "would remove 1 recording" in stderr
    assert len(shown(place)) == 3
    out, stderr = shell.printed("store", "remove", place, "2.mcap", id_of(3))
    assert all(word in out for word in (id_of(2), "logs/2.mcap", str(len(one(2)[1]))))
    assert "removed 2 recordings" in stderr
    assert f"restock ingest logs/2.mcap logs/3.mcap --store {place}" in stderr
    version = StoreWriter(place).path.open_table(TRANSITIONS).version() - 1
    assert f"{place}@{version}" in stderr
    assert shown(place) == expected((1, "a"))
    assert len(shell.json("sql", f"{place}@{version}", "FROM recordings")) == 3
    document = shell.json("store", "remove", place, id_of(1))
    assert document["recordings"][0]["source_file"] == "logs/1.mcap"
    assert (document["left"], document["dry_run"]) == (0, False)
    assert main(["store", "remove", place]) == 2  # without recordings
    assert main(["store", "remove", str(tmp_path / "none"), id_of(1)]) == 2


def test_removal_drops_label_corrections(tmp_path, shell):
    writer = store_of_three(tmp_path / "s")
    (first, second, _) = writer.live().sort_by("recording_id").to_pylist()
    stamps = [int(one(n)[1]["stamp_ns"][0].as_py()) for n in (1, 2)]
    now = dt.datetime.now(dt.UTC)
    given = {
        row["recording_id"]: RecordingCorrections(
            row["ingest_id"], [Correction("wheel_slip", True, 0, at_ns, at_ns + 10**9, now)]
        )
        for row, at_ns in zip((first, second), stamps, strict=True)
    }
    correct_store(writer, given)
    assert "does not bring back 1 correction of labels" in shell.err(
        "store", "remove", tmp_path / "s", id_of(2), code=0
    )
    with pytest.raises(StoreError, match="was ingested again or removed"):
        correct_store(writer, given)
    with Store(tmp_path / "s") as store:
        corrections = store.sql("SELECT recording_id, len(corrections) FROM recordings ORDER BY 1")
        assert corrections.fetchall() == [(id_of(1), 1), (id_of(3), 0)]
    (live,) = writer.live(id_of(1)).to_pylist()
    again = replace(given[id_of(1)], ingest_id=live["ingest_id"])
    assert len(correct_store(writer, {id_of(1): again})[0]) == 1
    assert set(shown(tmp_path / "s").values()) == {len(one(n)[1]) for n in (1, 3)}
    writer.write(*one(2, "c"))
    assert writer.live(id_of(2))["corrections"].to_pylist() in ([[]], [None])
