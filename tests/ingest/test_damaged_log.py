"""A damaged log of a store: the entry is named, and never are fewer rows shown."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from deltalake import DeltaTable
from support.stores import one

from restock.errors import StoreError
from restock.ingest.store.location import RECORDINGS, TRANSITIONS
from restock.ingest.store.writer import StoreWriter
from restock.replay.store.store import Store


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "store"
    writer = StoreWriter(path)
    for number in range(1, 4):
        writer.write(*one(number))
    return path


@pytest.fixture
def store(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "store"))


def _entry(store: Path, table: str, version: int) -> Path:
    return store / table / "_delta_log" / f"{version:020}.json"


@pytest.mark.parametrize("table", [TRANSITIONS, RECORDINGS])
@pytest.mark.parametrize("version", [0, 2, 3])
@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"", "is empty"),  # after a power failure
        (b"\n", "is empty|is damaged"),
        (b'{"add": {"path', "is damaged"),
        (b"[]\n", "is damaged"),
        (b"\xff\x00\xfe", "is damaged"),
    ],
)
def test_a_damaged_entry_of_the_log_is_named(
    store: Path, table: str, version: int, content: bytes, what: str
) -> None:
    entry = _entry(store, table, version)
    entry.write_bytes(content)
    with pytest.raises(StoreError, match=f"this entry of the store's log ({what})") as refused:
        Store(store)
    assert str(refused.value).startswith(str(entry))
    assert "restore it from a copy" in str(refused.value)


def test_a_missing_entry_of_the_log_is_named(store: Path) -> None:
    _entry(store, TRANSITIONS, 2).unlink()
    with pytest.raises(StoreError, match=f"{2:020}.json: this entry of the store's log is missing"):
        Store(store)


def test_an_empty_entry_before_a_checkpoint_is_not_needed(store: Path) -> None:
    DeltaTable(store / TRANSITIONS).create_checkpoint()
    _entry(store, TRANSITIONS, 1).write_bytes(b"")
    with Store(store) as opened:
        assert opened.sql("SELECT count(*) FROM recordings").fetchall() == [(3,)]
