"""A file of Delta's log that is damaged is named with what to do: rows never just go missing."""

import shutil
from pathlib import Path

import pytest
from support.stores import one, shown

from restock.errors import StoreError
from restock.ingest.store import commits
from restock.ingest.store.writer import StoreWriter

LAST = 4
DAMAGES = {
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


def damaged(whole: Path, place: Path, file: str, how: str) -> Path:
    shutil.copytree(whole, place)
    path = place / file
    path.write_bytes(DAMAGES[how](path.read_bytes()))
    return path


@pytest.mark.parametrize(
    ("table", "number", "how"),
    [
        *(("transitions", LAST, how) for how in DAMAGES),
        *[("transitions", 3, "empty"), ("recordings", 3, "cut"), ("recordings", LAST, "empty")],
    ],
)
def test_a_damaged_commit_is_named(whole, tmp_path, table, number, how):
    file = f"{table}/_delta_log/{number:020}.json"
    path = damaged(whole, tmp_path / "s", file, how)
    with pytest.raises(StoreError) as caught:
        shown(tmp_path / "s")
    assert f"{tmp_path / 's'}: its file {file} is " in str(caught.value)
    if number < LAST:
        assert "ingest the recordings into a new store" in str(caught.value)
        return
    assert "or delete it, as it is the last commit: the store is" in str(caught.value)
    path.unlink()
    assert len(shown(tmp_path / "s")) == (LAST if table == "recordings" else LAST - 1)
    StoreWriter(tmp_path / "s").write(*one(number, "again"))
    assert len(shown(tmp_path / "s")) == LAST


def test_a_commit_that_is_missing_among_others_is_named(whole, tmp_path):
    path = damaged(whole, tmp_path / "s", f"transitions/_delta_log/{3:020}.json", "empty")
    path.unlink()
    with pytest.raises(StoreError, match=rf"_delta_log/{3:020}.json is missing"):
        shown(tmp_path / "s")


@pytest.mark.parametrize("how", ["empty", "cut", "missing"])
def test_a_damaged_checkpoint_is_named_and_can_do_without(whole, tmp_path, how):
    log = tmp_path / "s" / "transitions" / "_delta_log"
    file = log / f"{2:020}.checkpoint.parquet"
    name = file.relative_to(tmp_path / "s").as_posix()
    damaged(whole, tmp_path / "s", name, "empty" if how == "missing" else how)
    if how == "missing":
        file.unlink()
    with pytest.raises(StoreError) as caught:
        shown(tmp_path / "s")
    assert f"its file {name} {'is missing' if how == 'missing' else 'cannot be read'}" in str(
        caught.value
    )
    assert "delete it and _last_checkpoint beside it" in str(caught.value)
    file.unlink(missing_ok=True)
    (log / "_last_checkpoint").unlink()
    assert len(shown(tmp_path / "s")) == LAST


def test_a_commit_within_a_checkpoint_may_be_damaged(whole, tmp_path):
    damaged(whole, tmp_path / "s", f"transitions/_delta_log/{1:020}.json", "empty")
    assert len(shown(tmp_path / "s")) == LAST
    with pytest.raises(StoreError, match=rf"_delta_log/{1:020}.json is empty"):
        StoreWriter(tmp_path / "s").path.open_table("transitions", 1)
