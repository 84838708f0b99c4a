"""Recordings are taken out of a store, all that are named or none; versions before keep them."""

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


def name_of(n: int) -> str:
    return f"{n:016x}"


def expected(*ingests: tuple[int, str]) -> dict[str, int]:
    return {f"{name_of(n)}-{ingest}": len(one(n, ingest)[1]) for n, ingest in ingests}


def three(place: Path | str, *, joined: bool = False) -> StoreWriter:
    writer = StoreWriter(place)
    writer.write_all([one(1), one(2), one(3)])
    if joined:
        compact(writer)
    return writer


def called(recording_id: str, path: str) -> tuple[pa.Table, pa.Table]:
    """Return a recording with this id that was ingested by this path."""
    new = {"recording_id": recording_id, "source_file": path, "ingest_id": f"{recording_id}-a"}
    manifest, rows = (replaced(table, new) for table in one(1))
    return manifest, rows


def aged(place: Path) -> None:
    """Age the store's files as if written long ago; Delta's log stays."""
    for file in place.rglob("*.parquet"):
        os.utime(file, (0, 0))


@pytest.mark.parametrize("joined", [False, True], ids=["own files", "joined files"])
@pytest.mark.parametrize("place", one_in(2, ["folder", "s3"]), indirect=True)
def test_a_recording_is_removed_and_the_version_before_has_it(place, joined):
    writer = three(place, joined=joined)
    before = writer.rows(name_of(3), f"{name_of(3)}-a").to_pylist()
    done = remove_recordings(writer, [name_of(2)])
    manifest, rows = one(2)
    assert done.recordings == [
        RemovedRecording(
            name_of(2), "logs/2.mcap", len(rows), manifest["episodes"][0].as_py(), 0, {}
        )
    ]
    assert (done.left, done.version) == (2, done.version_before + 1)
    assert shown(place) == expected((1, "a"), (3, "a"))
    assert len(writer.live()) == 2
    assert writer.rows(name_of(3), f"{name_of(3)}-a").to_pylist() == before
    writer.clean()
    compact(writer)
    with Store(place, version=done.version_before) as store:
        assert store.sql("SELECT count(*) FROM recordings").fetchall() == [(3,)]
        assert store.sql("SELECT count(*) FROM transitions").fetchall() == [
            (sum(expected((1, "a"), (2, "a"), (3, "a")).values()),)
        ]
    assert shown(place) == expected((1, "a"), (3, "a"))
    writer.write(*one(2, "b"))
    assert shown(place) == expected((1, "a"), (2, "b"), (3, "a"))


def test_after_the_retention_its_files_are_deleted(tmp_path):
    writer = three(tmp_path / "s")
    done = remove_recordings(writer, [name_of(2)])
    assert writer.clean() == []
    path = f"{name_of(2)}/{name_of(2)}-a.parquet"
    assert writer.clean(retention_hours=0) == [f"{RECORDINGS}/{path}", f"{TRANSITIONS}/{path}"]
    with pytest.raises(StoreError, match="can no longer be read"):
        writer.live(version=done.version_before)
    assert shown(tmp_path / "s") == expected((1, "a"), (3, "a"))


@pytest.mark.parametrize("joined", [False, True], ids=["own files", "joined files"])
def test_all_may_be_removed_of_an_old_store(tmp_path, joined, monkeypatch):
    """The file of their manifests is old by then, and is of no recording that is there."""
    place = tmp_path / "s"
    then_ns = time.time_ns() - 30 * 86400 * 10**9
    with monkeypatch.context() as then:
        then.setattr("restock.ingest.store.commits.time.time_ns", lambda: then_ns)
        writer = three(place, joined=joined)
    aged(place)
    done = remove_recordings(writer, [name_of(n) for n in (1, 2, 3)])
    assert done.left == 0
    assert shown(place) == {}
    writer.clean()
    compact(writer)
    with Store(place, version=done.version_before) as store:
        assert store.sql("SELECT count(*) FROM recordings").fetchall() == [(3,)]
        assert store.sql("SELECT count(*) FROM transitions").fetchall() != [(0,)]
    writer.write(*one(1, "b"))
    compact(writer)
    writer.clean()
    assert len(writer.live(version=done.version_before)) == 3
    assert shown(place) == expected((1, "b"))


def test_a_recording_is_named_by_its_id_a_prefix_or_its_path(tmp_path, monkeypatch):
    writer = StoreWriter(tmp_path / "s")
    monkeypatch.chdir(tmp_path)
    paths = {"abcdef1111111111": "logs/b.mcap", "abcde12222222222": "logs/a/c.mcap"}
    paths |= {"0123450000000000": "/x/c.mcap"}
    for recording_id, path in paths.items():
        writer.write(*called(recording_id, path))

    def named(*names: str) -> set[str]:
        done = remove_recordings(writer, names, dry_run=True)
        return {one.recording_id for one in done.recordings}

    b, c, x = paths
    assert named("abcdef") == named("ABCDEF1111111111") == {b}
    assert named("abcde1", "01234500") == {c, x}
    assert named("logs/b.mcap") == named("b.mcap") == named("./logs/../logs/b.mcap") == {b}
    assert named(str(tmp_path / "logs/b.mcap")) == {b}
    assert named("a/c.mcap", "b.mcap", "abcdef", "logs/b.mcap") == {b, c}
    assert len(shown(tmp_path / "s")) == 3
    for wrong, said in {
        "c.mcap": r"'c.mcap' is the name of 2 recordings: .*x/c.mcap.*logs/a/c.mcap",
        "abcde": "too short for the beginning of an id .*logs/b.mcap.*logs/a/c.mcap|c.mcap.*b.mcap",
        "logs/bb.mcap": r"no recording 'logs/bb.mcap' is in the store; similar: .*logs/b.mcap",
        "fedcba98": "no recording 'fedcba98' is in the store; it has 3 recordings: .*x/c.mcap",
        "": "no recording ''",
    }.items():
        with pytest.raises(StoreError, match=said) as error:
            remove_recordings(writer, [x, wrong])
        assert "nothing was removed" in str(error.value)
    assert len(shown(tmp_path / "s")) == 3


@pytest.mark.parametrize("joined", [False, True], ids=["own files", "joined files"])
def test_another_writer_may_be_faster(tmp_path, before_commit, joined):
    writer = three(tmp_path / "s", joined=joined)
    before_commit(lambda: StoreWriter(tmp_path / "s").write_all([one(1, "b"), one(4)]))
    remove_recordings(writer, [name_of(2)])
    assert shown(tmp_path / "s") == expected((1, "b"), (3, "a"), (4, "a"))


@pytest.mark.parametrize("joined", [False, True], ids=["own files", "joined files"])
def test_what_is_ingested_again_meanwhile_is_not_removed(tmp_path, before_commit, joined):
    writer = three(tmp_path / "s", joined=joined)
    before_commit(lambda: StoreWriter(tmp_path / "s").write(*one(2, "b")))
    with pytest.raises(StoreError, match=f"{name_of(2)} was ingested again or removed in the mean"):
        remove_recordings(writer, [name_of(1), name_of(2)])
    assert shown(tmp_path / "s") == expected((1, "a"), (2, "b"), (3, "a"))


def test_the_command_says_what_it_removed(tmp_path, shell):
    place = str(tmp_path / "s")
    three(place)
    out, said = shell.printed("store", "remove", place, "logs/2.mcap", "--dry-run")
    assert name_of(2) in out
    assert "would remove 1 recording" in said
    assert len(shown(place)) == 3
    out, said = shell.printed("store", "remove", place, "2.mcap", name_of(3))
    assert all(word in out for word in (name_of(2), "logs/2.mcap", str(len(one(2)[1]))))
    assert "removed 2 recordings" in said
    assert f"restock ingest logs/2.mcap logs/3.mcap --store {place}" in said
    version = StoreWriter(place).path.open_table(TRANSITIONS).version() - 1
    assert f"{place}@{version}" in said
    assert shown(place) == expected((1, "a"))
    assert len(shell.json("sql", f"{place}@{version}", "FROM recordings")) == 3
    document = shell.json("store", "remove", place, name_of(1))
    assert document["recordings"][0]["source_file"] == "logs/1.mcap"
    assert (document["left"], document["dry_run"]) == (0, False)
    assert main(["store", "remove", place]) == 2  # names no recording
    assert main(["store", "remove", str(tmp_path / "none"), name_of(1)]) == 2


def test_labels_corrected_in_a_removed_recording_go_with_it(tmp_path, shell):
    writer = three(tmp_path / "s")
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
        "store", "remove", tmp_path / "s", name_of(2), code=0
    )
    with pytest.raises(StoreError, match="was ingested again or removed"):
        correct_store(writer, given)
    with Store(tmp_path / "s") as store:
        said = store.sql("SELECT recording_id, len(corrections) FROM recordings ORDER BY 1")
        assert said.fetchall() == [(name_of(1), 1), (name_of(3), 0)]
    (now_there,) = writer.live(name_of(1)).to_pylist()
    again = replace(given[name_of(1)], ingest_id=now_there["ingest_id"])
    assert len(correct_store(writer, {name_of(1): again})[0]) == 1
    assert set(shown(tmp_path / "s").values()) == {len(one(n)[1]) for n in (1, 3)}
    writer.write(*one(2, "c"))
    assert writer.live(name_of(2))["corrections"].to_pylist() in ([[]], [None])
