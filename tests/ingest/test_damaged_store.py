"""A store whose files or log are damaged: what is lost is said, and Restock leads out of it."""

import json
import os
import shutil
from contextlib import contextmanager
from pathlib import Path

import pytest
from support.long import one_in
from support.s3_server import files_of
from support.stores import one, shown

from restock.errors import QueryError, StoreError
from restock.ingest.store import commits, lineage
from restock.ingest.store import writer as writer_module
from restock.ingest.store.commits import recording_columns
from restock.ingest.store.damaged_files import drop_damaged
from restock.ingest.store.location import RECORDINGS, TRANSITIONS, Location
from restock.ingest.store.writer import StoreWriter, compact
from restock.replay.store.query import fetch
from restock.replay.store.store import Store

DAMAGES = ("cut", "missing", "a page", "numbers")


def damage(place: Path | str, file: str, how: str) -> None:
    lineage._read.cache_clear()  # as in another process
    store = Location.of(place)
    with store.reading(file) as source:
        content = source.read()
    if how == "missing":
        store.delete([file])
        return
    if how == "cut":
        content = content[:1000]
    elif how == "numbers":  # which decode as others: only the page's checksum tells
        at = len(content) // 3
        content = content[:at] + bytes(b ^ 0x55 for b in content[at : at + 40]) + content[at + 40 :]
    else:  # the footer is whole
        content = content[:8] + bytes(byte ^ 0x55 for byte in content[8:40]) + content[40:]
    with store.writing(file) as sink:
        sink.write(content)


def active(place: Path | str, name: str) -> list[str]:
    return [f"{name}/{file.path}" for file in StoreWriter(place).files(name)]


def expected(*ingests: tuple[int, str, int]) -> dict[str, int]:
    return {f"{n:016x}-{name}": len(one(n, name, seed)[1]) for n, name, seed in ingests}


def joined(place: Path | str) -> StoreWriter:
    """Three recordings in one file, the second ingested again since."""
    writer = StoreWriter(place)
    writer.write_all([one(1), one(2), one(3)])
    compact(writer)
    writer.write(*one(2, "b", seed=7))
    return writer


WHOLE = expected((1, "a", 0), (2, "b", 7), (3, "a", 0))


@pytest.mark.parametrize("how", DAMAGES)
@pytest.mark.parametrize(
    "names", one_in(3, [[TRANSITIONS, RECORDINGS], [TRANSITIONS], [RECORDINGS]])
)
def test_a_damaged_file_is_joined_again_from_its_sources(tmp_path, names, how):
    writer = joined(tmp_path / "s")
    before = writer.rows(f"{3:016x}", f"{3:016x}-a").to_pylist()
    damaged = [one for name in names for one in active(tmp_path / "s", name) if "compacted" in one]
    for file in damaged:
        damage(tmp_path / "s", file, how)
    planned = drop_damaged(writer, dry_run=True)
    done = drop_damaged(writer)
    assert planned == done
    assert (done.joined_again, done.dropped, done.lost) == (damaged, [], [])
    assert shown(tmp_path / "s") == WHOLE
    assert writer.rows(f"{3:016x}", f"{3:016x}-a").to_pylist() == before
    assert len(writer.live()) == 3
    assert drop_damaged(writer).joined_again == []


@pytest.mark.parametrize("place", one_in(2, ["folder", "s3"]), indirect=True)
@pytest.mark.parametrize("name", [TRANSITIONS, RECORDINGS])
@pytest.mark.parametrize("how", one_in(2, DAMAGES[:2]))
def test_what_a_damaged_file_loses_is_named_and_ingested_again(place, name, how):
    writer = joined(place)
    writer.clean(retention_hours=0)  # the files that it was made of
    damage(place, next(one for one in active(place, name) if "compacted" in one), how)
    with pytest.raises(StoreError, match=r"restock store compact .* --drop-damaged"):
        StoreWriter(place).write(*one(1, "c"))
    done = drop_damaged(writer)
    assert len(done.dropped) == 1
    assert [one.recording_id[-1] for one in done.lost] == ["1", "3"]
    assert {one.source_file for one in done.lost} == {"logs/1.mcap", "logs/3.mcap"}
    assert {one.transitions for one in done.lost} == {WHOLE[f"{n:016x}-a"] for n in (1, 3)}
    assert done.unnamed_transitions == 0
    assert shown(place) == expected((2, "b", 7))
    compact(writer)  # rows without a manifest are in no one's way
    writer.write_all([one(1, "c"), one(3, "c"), one(4)])
    assert shown(place) == expected((1, "c", 0), (2, "b", 7), (3, "c", 0), (4, "a", 0))


def test_rows_of_a_replaced_ingest_are_not_restored(tmp_path):
    writer = StoreWriter(tmp_path / "s")
    writer.write(*one(1))
    writer.write(*one(1, "b"))  # with as many rows
    (file,) = active(tmp_path / "s", TRANSITIONS)
    damage(tmp_path / "s", file, "cut")
    done = drop_damaged(writer)
    assert (done.joined_again, done.dropped) == ([], [file])
    assert [one.recording_id for one in done.lost] == [f"{1:016x}"]
    assert shown(tmp_path / "s") == {}


@pytest.mark.parametrize("how", ["cut", "missing"])
def test_a_damaged_manifest_is_named_and_dropped(writer, tmp_path, how):
    file = f"{RECORDINGS}/{1:016x}/{1:016x}-a.parquet"
    damage(tmp_path / "s", file, how)
    with pytest.raises(StoreError, match=file) as said:
        writer.live(f"{1:016x}")
    assert "--drop-damaged" in str(said.value)
    with pytest.raises(StoreError, match=file) as said:
        Store(tmp_path / "s")
    assert "--drop-damaged" in str(said.value)
    assert drop_damaged(writer).dropped == [file]
    assert shown(tmp_path / "s") == expected((2, "a", 0))
    assert len(writer.live(f"{1:016x}")) == 0  # so an ingest takes it for new
    writer.write(*one(1, "b"))
    assert shown(tmp_path / "s") == expected((1, "b", 0), (2, "a", 0))


def test_damaged_rows_are_ingested_with_force(tmp_path, shell):
    writer = StoreWriter(tmp_path / "s")
    writer.write(*one(1))
    file = f"{TRANSITIONS}/{1:016x}/{1:016x}-a.parquet"
    damage(tmp_path / "s", file, "cut")
    with pytest.raises(StoreError, match=f"{file} cannot be read") as said:
        writer.rows(f"{1:016x}", f"{1:016x}-a")
    assert "--force" in str(said.value)
    store = str(tmp_path / "s")
    query = ["sql", store, "SELECT sum(reward) FROM transitions"]
    for command in (query, ["audit", store], ["mix", store, "--dry-run"]):
        told = shell.err(*command)
        assert f"its file {file} cannot be read" in told
        assert "--force" in told
    writer.write(*one(1, "b"))
    assert shown(tmp_path / "s") == expected((1, "b", 0))


@pytest.mark.parametrize("error", [PermissionError(13, "denied"), OSError(5, "disk")])
def test_a_file_that_only_now_cannot_be_read_is_not_dropped(tmp_path, monkeypatch, error):
    writer = joined(tmp_path / "s")
    reading = Location.reading

    @contextmanager
    def refused(self, path):
        if "compacted" in path:
            raise error
        with reading(self, path) as source:
            yield source

    monkeypatch.setattr(Location, "reading", refused)
    with pytest.raises(StoreError, match=r"compacted/.* cannot be read") as said:
        drop_damaged(writer)
    assert "make the file readable" in str(said.value)
    monkeypatch.undo()
    assert shown(tmp_path / "s") == WHOLE


def test_rows_with_changed_bytes_are_neither_joined_nor_read(tmp_path, shell):
    place = tmp_path / "s"
    writer = StoreWriter(place)
    writer.write_all([one(1), one(2)])
    file = f"{TRANSITIONS}/{1:016x}/{1:016x}-a.parquet"
    damage(place, file, "numbers")
    before, version = active(place, TRANSITIONS), writer.path.open_table(TRANSITIONS).version()
    assert f"its file {file} cannot be read" in shell.err("store", "compact", place)
    assert active(place, TRANSITIONS) == before
    assert writer.path.open_table(TRANSITIONS).version() == version
    assert not [one for one in files_of(place) if "transitions/compacted" in one]
    with pytest.raises(StoreError, match=f"{file} cannot be read"):
        writer.rows(f"{1:016x}", f"{1:016x}-a")
    done = drop_damaged(writer)
    assert done.dropped == [file]
    assert [one.recording_id for one in done.lost] == [f"{1:016x}"]
    assert shown(place) == expected((2, "a", 0))


def test_two_that_drop_the_same_file_drop_it_once(tmp_path, before_commit):
    writer = joined(tmp_path / "s")
    file = next(one for one in active(tmp_path / "s", TRANSITIONS) if "compacted" in one)
    damage(tmp_path / "s", file, "cut")

    def dropped_meanwhile():
        assert drop_damaged(StoreWriter(tmp_path / "s")).joined_again == [file]

    before_commit(dropped_meanwhile)
    done = drop_damaged(writer)
    assert (done.joined_again, done.dropped, done.lost) == ([], [], [])
    assert shown(tmp_path / "s") == WHOLE
    assert len([one for one in files_of(tmp_path / "s") if "transitions/compacted" in one]) == 3


def test_an_ingest_survives_a_damaged_manifest_of_another(writer, tmp_path, monkeypatch):
    """In what it does at its end; frames that the manifest may name are kept."""
    damage(tmp_path / "s", f"{RECORDINGS}/{1:016x}/{1:016x}-a.parquet", "cut")
    frames = tmp_path / "s/frames" / f"{1:016x}" / f"{1:016x}-a.parquet"
    frames.parent.mkdir(parents=True)
    frames.write_text("frames")
    os.utime(frames, (0, 0))
    monkeypatch.setattr(writer_module, "FOLD_FILES", 2)
    assert writer.clean() == []
    writer_module.fold_if_many(writer)
    assert frames.is_file()


def test_rows_that_are_lost_with_their_manifests_are_counted(tmp_path):
    writer = joined(tmp_path / "s")
    writer.clean(retention_hours=0)
    for name in (TRANSITIONS, RECORDINGS):
        damage(tmp_path / "s", next(f for f in active(tmp_path / "s", name) if "comp" in f), "cut")
    done = drop_damaged(writer)
    assert len(done.dropped) == 2
    assert (done.lost, done.unnamed_transitions) == ([], sum(WHOLE[f"{n:016x}-a"] for n in (1, 3)))
    assert shown(tmp_path / "s") == expected((2, "b", 7))


def test_the_command_names_what_is_lost_and_exits_3(tmp_path, shell):
    place = tmp_path / "s"
    writer = joined(place)
    assert "no file is damaged" in shell.err("store", "compact", place, "--drop-damaged", code=0)
    writer.clean(retention_hours=0)
    file = next(one for one in active(place, TRANSITIONS) if "compacted" in one)
    damage(place, file, "cut")
    for options in (["--dry-run"], ["--json"]):
        out, said = shell.printed("store", "compact", place, "--drop-damaged", *options, code=3)
        assert file in said
        assert "logs/1.mcap (recording 0000000000000001" in said
        assert "logs/3.mcap" in said
        assert "logs/2.mcap" not in said
    assert json.loads(out)["dropped"] == [file]
    assert shown(place) == expected((2, "b", 7))


@pytest.mark.parametrize("gone", [TRANSITIONS, RECORDINGS])
def test_a_store_without_one_table_is_not_made_again(tmp_path, gone, shell):
    place, log = tmp_path / "s", tmp_path / "log.mcap"
    StoreWriter(place).write_all([one(1), one(2)])
    log.touch()
    shutil.rmtree(place / gone)
    before = files_of(place)
    for command in (
        ["sql", str(place), "SELECT 1"],
        ["audit", str(place)],
        ["store", "compact", str(place)],
        ["ingest", str(log), "--store", str(place)],
    ):
        said = shell.err(*command)
        assert f"`{gone}` is missing" in said
        assert "from a copy" in said
        assert "makes a store" not in said
    with pytest.raises(StoreError, match=f"`{gone}` is missing"):
        Store(place)
    with pytest.raises(StoreError, match=f"`{gone}` is missing"):
        StoreWriter(place).write(*one(3))
    assert files_of(place) == before


def test_a_first_ingest_killed_between_its_tables_goes_on(tmp_path):
    writer = StoreWriter(tmp_path / "s")
    writer.create(RECORDINGS, recording_columns())
    with pytest.raises(StoreError, match="not a store"):
        Store(tmp_path / "s")
    StoreWriter(tmp_path / "s").write(*one(1))
    assert shown(tmp_path / "s") == expected((1, "a", 0))


@pytest.mark.usefixtures("writer")
def test_damage_without_a_file_name_has_a_remedy_too(tmp_path):
    damage(tmp_path / "s", active(tmp_path / "s", TRANSITIONS)[0], "a page")
    with Store(tmp_path / "s") as store:
        for text in ("SELECT nothing FROM transitions", "FROM read_csv('no.csv')"):
            with pytest.raises(QueryError):
                store.sql(text)
        with pytest.raises(StoreError, match="--drop-damaged"):
            fetch(store.connection, "SELECT sum(transition_id) FROM transitions", where="s")


LAST = 4
LOG_DAMAGES = {
    "empty": lambda content: b"",
    "blank": lambda content: b"\n\n",
    "cut": lambda content: content[: len(content) // 2],
    "cut after its first line": lambda content: content.splitlines(keepends=True)[0],
    "other bytes": lambda content: bytes(len(content)),
    "no commit": lambda content: b"[]\n",
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Tables of five versions; `transitions` begins with a checkpoint of the third."""
    place = tmp_path_factory.mktemp("whole") / "s"
    writer = StoreWriter(place)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(commits, "CHECKPOINT_COMMITS", 3)
        for number in range(1, LAST + 1):
            writer.write(*one(number))
    return place


@pytest.fixture
def logged(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "s"))


def refused(store: Path) -> str:
    with pytest.raises(StoreError) as caught:
        shown(store)
    return str(caught.value)


COMMITS = [
    *(("transitions", LAST, how) for how in LOG_DAMAGES),
    *[("transitions", 3, "empty"), ("recordings", 3, "cut"), ("recordings", LAST, "empty")],
]


def test_a_damaged_commit_is_named_and_the_last_may_go(logged: Path) -> None:
    for table, number, how in COMMITS:
        file = logged / f"{table}/_delta_log/{number:020}.json"
        content = file.read_bytes()
        file.write_bytes(LOG_DAMAGES[how](content))
        said = refused(logged)
        assert f"{logged}: its file {file.relative_to(logged)} is " in said
        last = "or delete it, as it is the last commit: the store is"
        assert (last if number == LAST else "ingest the recordings into a new store") in said
        file.write_bytes(content)
    for table, left in (("recordings", LAST), ("transitions", LAST - 1)):
        (logged / f"{table}/_delta_log/{LAST:020}.json").unlink()
        assert len(shown(logged)) == left
    StoreWriter(logged).write(*one(LAST, "again"))
    assert len(shown(logged)) == LAST


def test_a_commit_that_is_missing_among_others_is_named(logged: Path) -> None:
    (logged / f"transitions/_delta_log/{3:020}.json").unlink()
    assert f"_delta_log/{3:020}.json is missing" in refused(logged)


@pytest.mark.parametrize("how", ["empty", "cut", "missing"])
def test_a_damaged_checkpoint_is_named_and_can_do_without(logged: Path, how: str) -> None:
    log = logged / "transitions" / "_delta_log"
    file = log / f"{2:020}.checkpoint.parquet"
    if how == "missing":
        file.unlink()
    else:
        file.write_bytes(LOG_DAMAGES[how](file.read_bytes()))
    said = refused(logged)
    what = "is missing" if how == "missing" else "cannot be read"
    assert f"its file {file.relative_to(logged)} {what}" in said
    assert "delete it and _last_checkpoint beside it" in said
    file.unlink(missing_ok=True)
    (log / "_last_checkpoint").unlink()
    assert len(shown(logged)) == LAST


def test_a_commit_within_a_checkpoint_may_be_damaged(logged: Path) -> None:
    (logged / f"transitions/_delta_log/{1:020}.json").write_bytes(b"")
    assert len(shown(logged)) == LAST
    with pytest.raises(StoreError, match=rf"_delta_log/{1:020}.json is empty"):
        StoreWriter(logged).path.open_table("transitions", 1)
