"""Stores with damaged files or logs: losses are reported with a remedy."""

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

DAMAGES = ("cut", "missing", "page", "values")


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
    elif how == "values":  # values still decode, so only the page checksum reveals it
        at = len(content) // 3
        content = content[:at] + bytes(b ^ 0x55 for b in content[at : at + 40]) + content[at + 40 :]
    else:  # the footer stays valid
        content = content[:8] + bytes(byte ^ 0x55 for byte in content[8:40]) + content[40:]
    with store.writing(file) as sink:
        sink.write(content)


def active_files(place: Path | str, name: str) -> list[str]:
    return [f"{name}/{file.path}" for file in StoreWriter(place).files(name)]


def expected(*ingests: tuple[int, str, int]) -> dict[str, int]:
    return {f"{n:016x}-{name}": len(one(n, name, seed)[1]) for n, name, seed in ingests}


def write_compacted(place: Path | str) -> StoreWriter:
    """Write three recordings, compact them into one file, and ingest the second again."""
    writer = StoreWriter(place)
    writer.write_all([one(1), one(2), one(3)])
    compact(writer)
    writer.write(*one(2, "b", seed=7))
    return writer


UNDAMAGED_ROWS = expected((1, "a", 0), (2, "b", 7), (3, "a", 0))


@pytest.mark.parametrize("how", DAMAGES)
@pytest.mark.parametrize(
    "names", one_in(3, [[TRANSITIONS, RECORDINGS], [TRANSITIONS], [RECORDINGS]])
)
def test_damaged_compacted_file_is_rebuilt_from_sources(tmp_path, names, how):
    writer = write_compacted(tmp_path / "s")
    before = writer.rows(f"{3:016x}", f"{3:016x}-a").to_pylist()
    damaged = [
        file for name in names for file in active_files(tmp_path / "s", name) if "compacted" in file
    ]
    for file in damaged:
        damage(tmp_path / "s", file, how)
    planned = drop_damaged(writer, dry_run=True)
    result = drop_damaged(writer)
    assert planned == result
    assert (result.joined_again, result.dropped, result.lost) == (damaged, [], [])
    assert shown(tmp_path / "s") == UNDAMAGED_ROWS
    assert writer.rows(f"{3:016x}", f"{3:016x}-a").to_pylist() == before
    assert len(writer.live()) == 3
    assert drop_damaged(writer).joined_again == []


@pytest.mark.parametrize("place", one_in(2, ["folder", "s3"]), indirect=True)
@pytest.mark.parametrize("name", [TRANSITIONS, RECORDINGS])
@pytest.mark.parametrize("how", one_in(2, DAMAGES[:2]))
def test_lost_recordings_are_listed_and_can_be_reingested(place, name, how):
    writer = write_compacted(place)
    writer.clean(retention_hours=0)  # removes the source files of the compacted file
    damage(place, next(file for file in active_files(place, name) if "compacted" in file), how)
    with pytest.raises(StoreError, match=r"restock store compact .* --drop-damaged"):
        StoreWriter(place).write(*one(1, "c"))
    result = drop_damaged(writer)
    assert len(result.dropped) == 1
    assert [loss.recording_id[-1] for loss in result.lost] == ["1", "3"]
    assert {loss.source_file for loss in result.lost} == {"logs/1.mcap", "logs/3.mcap"}
    assert {loss.transitions for loss in result.lost} == {
        UNDAMAGED_ROWS[f"{n:016x}-a"] for n in (1, 3)
    }
    assert result.unnamed_transitions == 0
    assert shown(place) == expected((2, "b", 7))
    compact(writer)  # rows without a manifest do not disturb it
    writer.write_all([one(1, "c"), one(3, "c"), one(4)])
    assert shown(place) == expected((1, "c", 0), (2, "b", 7), (3, "c", 0), (4, "a", 0))


def test_rows_of_replaced_ingest_are_not_restored(tmp_path):
    writer = StoreWriter(tmp_path / "s")
    writer.write(*one(1))
    writer.write(*one(1, "b"))  # with the same number of rows
    (file,) = active_files(tmp_path / "s", TRANSITIONS)
    damage(tmp_path / "s", file, "cut")
    result = drop_damaged(writer)
    assert (result.joined_again, result.dropped) == ([], [file])
    assert [loss.recording_id for loss in result.lost] == [f"{1:016x}"]
    assert shown(tmp_path / "s") == {}


@pytest.mark.parametrize("how", ["cut", "missing"])
def test_damaged_manifest_is_reported_and_dropped(writer, tmp_path, how):
    file = f"{RECORDINGS}/{1:016x}/{1:016x}-a.parquet"
    damage(tmp_path / "s", file, how)
    with pytest.raises(StoreError, match=file) as error:
        writer.live(f"{1:016x}")
    assert "--drop-damaged" in str(error.value)
    with pytest.raises(StoreError, match=file) as error:
        Store(tmp_path / "s")
    assert "--drop-damaged" in str(error.value)
    assert drop_damaged(writer).dropped == [file]
    assert shown(tmp_path / "s") == expected((2, "a", 0))
    assert len(writer.live(f"{1:016x}")) == 0  # so an ingest treats it as new
    writer.write(*one(1, "b"))
    assert shown(tmp_path / "s") == expected((1, "b", 0), (2, "a", 0))


def test_damaged_rows_need_forced_ingest(tmp_path, shell):
    writer = StoreWriter(tmp_path / "s")
    writer.write(*one(1))
    file = f"{TRANSITIONS}/{1:016x}/{1:016x}-a.parquet"
    damage(tmp_path / "s", file, "cut")
    with pytest.raises(StoreError, match=f"{file} cannot be read") as error:
        writer.rows(f"{1:016x}", f"{1:016x}-a")
    assert "--force" in str(error.value)
    store = str(tmp_path / "s")
    query = ["sql", store, "SELECT sum(reward) FROM transitions"]
    for command in (query, ["audit", store], ["mix", store, "--dry-run"]):
        stderr = shell.err(*command)
        assert f"its file {file} cannot be read" in stderr
        assert "--force" in stderr
    writer.write(*one(1, "b"))
    assert shown(tmp_path / "s") == expected((1, "b", 0))


@pytest.mark.parametrize("error", [PermissionError(13, "denied"), OSError(5, "disk")])
def test_temporarily_unreadable_file_is_not_dropped(tmp_path, monkeypatch, error):
    writer = write_compacted(tmp_path / "s")
    reading = Location.reading

    @contextmanager
    def reading_failsrror(self, path):
        if "compacted" in path:
            raise error
        with reading(self, path) as source:
            yield source

    monkeypatch.setattr(Location, "reading", reading_failsrror)
    with pytest.raises(StoreError, match=r"compacted/.* cannot be read") as caught:
        drop_damaged(writer)
    assert "make the file readable" in str(caught.value)
    monkeypatch.undo()
    assert shown(tmp_path / "s") == UNDAMAGED_ROWS


def test_rows_with_changed_bytes_are_never_used(tmp_path, shell):
    place = tmp_path / "s"
    writer = StoreWriter(place)
    writer.write_all([one(1), one(2)])
    file = f"{TRANSITIONS}/{1:016x}/{1:016x}-a.parquet"
    damage(place, file, "values")
    before, version = (
        active_files(place, TRANSITIONS),
        writer.path.open_table(TRANSITIONS).version(),
    )
    assert f"its file {file} cannot be read" in shell.err("store", "compact", place)
    assert active_files(place, TRANSITIONS) == before
    assert writer.path.open_table(TRANSITIONS).version() == version
    assert not [path for path in files_of(place) if "transitions/compacted" in path]
    with pytest.raises(StoreError, match=f"{file} cannot be read"):
        writer.rows(f"{1:016x}", f"{1:016x}-a")
    result = drop_damaged(writer)
    assert result.dropped == [file]
    assert [loss.recording_id for loss in result.lost] == [f"{1:016x}"]
    assert shown(place) == expected((2, "a", 0))


def test_concurrent_drops_of_one_file_drop_it_once(tmp_path, before_commit):
    writer = write_compacted(tmp_path / "s")
    file = next(path for path in active_files(tmp_path / "s", TRANSITIONS) if "compacted" in path)
    damage(tmp_path / "s", file, "cut")

    def drop_concurrently():
        assert drop_damaged(StoreWriter(tmp_path / "s")).joined_again == [file]

    before_commit(drop_concurrently)
    result = drop_damaged(writer)
    assert (result.joined_again, result.dropped, result.lost) == ([], [], [])
    assert shown(tmp_path / "s") == UNDAMAGED_ROWS
    assert len([path for path in files_of(tmp_path / "s") if "transitions/compacted" in path]) == 3


def test_clean_and_fold_survive_a_damaged_manifest(writer, tmp_path, monkeypatch):
    """These run at the end of an ingest; frames that the manifest may name are kept."""
    damage(tmp_path / "s", f"{RECORDINGS}/{1:016x}/{1:016x}-a.parquet", "cut")
    frames = tmp_path / "s/frames" / f"{1:016x}" / f"{1:016x}-a.parquet"
    frames.parent.mkdir(parents=True)
    frames.write_text("frames")
    os.utime(frames, (0, 0))
    monkeypatch.setattr(writer_module, "FOLD_FILES", 2)
    assert writer.clean() == []
    writer_module.fold_if_many(writer)
    assert frames.is_file()


def test_rows_lost_with_their_manifests_are_counted(tmp_path):
    writer = write_compacted(tmp_path / "s")
    writer.clean(retention_hours=0)
    for name in (TRANSITIONS, RECORDINGS):
        damage(
            tmp_path / "s",
            next(f for f in active_files(tmp_path / "s", name) if "comp" in f),
            "cut",
        )
    result = drop_damaged(writer)
    assert len(result.dropped) == 2
    assert (result.lost, result.unnamed_transitions) == (
        [],
        sum(UNDAMAGED_ROWS[f"{n:016x}-a"] for n in (1, 3)),
    )
    assert shown(tmp_path / "s") == expected((2, "b", 7))


def test_compact_command_lists_losses_and_exits_3(tmp_path, shell):
    place = tmp_path / "s"
    writer = write_compacted(place)
    assert "no file is damaged" in shell.err("store", "compact", place, "--drop-damaged", code=0)
    writer.clean(retention_hours=0)
    file = next(path for path in active_files(place, TRANSITIONS) if "compacted" in path)
    damage(place, file, "cut")
    for options in (["--dry-run"], ["--json"]):
        out, stderr = shell.printed("store", "compact", place, "--drop-damaged", *options, code=3)
        assert file in stderr
        assert "logs/1.mcap (recording 0000000000000001" in stderr
        assert "logs/3.mcap" in stderr
        assert "logs/2.mcap" not in stderr
    assert json.loads(out)["dropped"] == [file]
    assert shown(place) == expected((2, "b", 7))


@pytest.mark.parametrize("missing", [TRANSITIONS, RECORDINGS])
def test_missing_table_is_reported_and_not_recreated(tmp_path, missing, shell):
    place, log = tmp_path / "s", tmp_path / "log.mcap"
    StoreWriter(place).write_all([one(1), one(2)])
    log.touch()
    shutil.rmtree(place / missing)
    before = files_of(place)
    for command in (
        ["sql", str(place), "SELECT 1"],
        ["audit", str(place)],
        ["store", "compact", str(place)],
        ["ingest", str(log), "--store", str(place)],
    ):
        stderr = shell.err(*command)
        assert f"`{missing}` is missing" in stderr
        assert "from a copy" in stderr
        assert "makes a store" not in stderr
    with pytest.raises(StoreError, match=f"`{missing}` is missing"):
        Store(place)
    with pytest.raises(StoreError, match=f"`{missing}` is missing"):
        StoreWriter(place).write(*one(3))
    assert files_of(place) == before


def test_first_ingest_killed_between_tables_can_continue(tmp_path):
    writer = StoreWriter(tmp_path / "s")
    writer.create(RECORDINGS, recording_columns())
    with pytest.raises(StoreError, match="not a store"):
        Store(tmp_path / "s")
    StoreWriter(tmp_path / "s").write(*one(1))
    assert shown(tmp_path / "s") == expected((1, "a", 0))


@pytest.mark.usefixtures("writer")
def test_damage_without_file_name_has_remedy(tmp_path):
    damage(tmp_path / "s", active_files(tmp_path / "s", TRANSITIONS)[0], "page")
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
    "cut after first line": lambda content: content.splitlines(keepends=True)[0],
    "other bytes": lambda content: bytes(len(content)),
    "no commit": lambda content: b"[]\n",
}


@pytest.fixture(scope="module")
def pristine_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a store of five versions; `transitions` has a checkpoint after the third."""
    place = tmp_path_factory.mktemp("whole") / "s"
    writer = StoreWriter(place)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(commits, "CHECKPOINT_COMMITS", 3)
        for number in range(1, LAST + 1):
            writer.write(*one(number))
    return place


@pytest.fixture
def store_copy(pristine_store: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(pristine_store, tmp_path / "s"))


def store_error(store: Path) -> str:
    with pytest.raises(StoreError) as caught:
        shown(store)
    return str(caught.value)


COMMITS = [
    *(("transitions", LAST, how) for how in LOG_DAMAGES),
    *[("transitions", 3, "empty"), ("recordings", 3, "cut"), ("recordings", LAST, "empty")],
]


def test_damaged_commit_is_reported_and_last_is_deletable(store_copy: Path) -> None:
    for table, number, how in COMMITS:
        file = store_copy / f"{table}/_delta_log/{number:020}.json"
        content = file.read_bytes()
        file.write_bytes(LOG_DAMAGES[how](content))
        error = store_error(store_copy)
        assert f"{store_copy}: its file {file.relative_to(store_copy)} is " in error
        last = "or delete it, as it is the last commit: the store is"
        assert (last if number == LAST else "ingest the recordings into a new store") in error
        file.write_bytes(content)
    for table, num_recordings in (("recordings", LAST), ("transitions", LAST - 1)):
        (store_copy / f"{table}/_delta_log/{LAST:020}.json").unlink()
        assert len(shown(store_copy)) == num_recordings
    StoreWriter(store_copy).write(*one(LAST, "again"))
    assert len(shown(store_copy)) == LAST


def test_missing_commit_is_reported(store_copy: Path) -> None:
    (store_copy / f"transitions/_delta_log/{3:020}.json").unlink()
    assert "`transitions` cannot be opened: Kernel error: Invalid" in store_error(store_copy)


@pytest.mark.parametrize("how", ["empty", "cut", "missing"])
def test_damaged_checkpoint_is_deletable(store_copy: Path, how: str) -> None:
    log = store_copy / "transitions" / "_delta_log"
    file = log / f"{2:020}.checkpoint.parquet"
    if how == "missing":
        file.unlink()
    else:
        file.write_bytes(LOG_DAMAGES[how](file.read_bytes()))
    error = store_error(store_copy)
    assert "`transitions` cannot be opened" in error
    assert "may be deleted, together with _last_checkpoint" in error
    file.unlink(missing_ok=True)
    (log / "_last_checkpoint").unlink()
    assert len(shown(store_copy)) == LAST


def test_damaged_commit_before_checkpoint_is_tolerated(store_copy: Path) -> None:
    (store_copy / f"transitions/_delta_log/{1:020}.json").write_bytes(b"")
    assert len(shown(store_copy)) == LAST
    with pytest.raises(StoreError, match=rf"_delta_log/{1:020}.json is empty"):
        StoreWriter(store_copy).path.open_table("transitions", 1)
