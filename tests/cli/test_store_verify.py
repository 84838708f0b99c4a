"""Changed bytes of a store are found before its rows are used, and by `store verify`."""

import os
import random
import shutil
from contextlib import suppress
from pathlib import Path

import pytest
from support.shell import Shell
from support.stores import recording_transitions, write_store

from restock.errors import StoreError
from restock.ingest.profile.profile import load_profile
from restock.ingest.store.damaged_files import verify_store
from restock.ingest.store.writer import StoreWriter, compact
from restock.replay.store.store import Store

FLIPS = 8


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    task = load_profile("warehouse_amr").task
    rows = [recording_transitions(number, episodes=6, task=task) for number in (1, 2)]
    path = write_store(tmp_path_factory.mktemp("whole") / "store", rows, task=task)
    compact(StoreWriter(path))  # now one file of rows and one of manifests, with checksums
    return path


@pytest.fixture
def store(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "store"))


def flip(file: Path, at: int, bit: int = 0) -> None:
    """Change one bit."""
    content = bytearray(file.read_bytes())
    content[at] ^= 1 << bit
    file.write_bytes(content)


def is_damaged(store: Store) -> bool:
    """Return whether `verify` refuses the store."""
    with suppress(StoreError):
        store.verify()
        return False
    return True


def rows_file(store: Path) -> Path:
    return next(store.glob("transitions/compacted/*.parquet"))


def test_flipped_bit_is_found_or_changes_no_value(store: Path) -> None:
    """Page headers have no checksum, and some of their bits do not affect values."""
    file, draw = rows_file(store), random.Random(5)
    with Store(store) as opened:
        rows = opened.sql("FROM transitions ORDER BY ALL").to_arrow_table()
    found = 0
    content = file.read_bytes()
    footer = int.from_bytes(content[-8:-4], "little")
    for _ in range(FLIPS):
        flip(file, draw.randrange(4, len(content) - footer - 8), draw.randrange(8))
        with Store(store) as opened:
            if is_damaged(opened):
                found += 1
            else:
                assert opened.sql("FROM transitions ORDER BY ALL").to_arrow_table() == rows
        file.write_bytes(content)
    assert found > 0.75 * FLIPS


@pytest.mark.parametrize(
    "verb",
    [
        ["mix", "STORE", "--out", "OUT"],
        ["export", "STORE", "--to", "parquet", "--out", "OUT"],
        ["audit", "STORE"],
    ],
    ids=" ".join,
)
def test_verbs_refuse_damaged_rows(verb, store, tmp_path, shell):
    file, out = rows_file(store), tmp_path / "out.parquet"
    flip(file, 1000)
    argv = [{"STORE": str(store), "OUT": str(out)}.get(word, word) for word in verb]
    err = shell.err(*argv)
    assert f"its file {file.relative_to(store)} cannot be read" in err
    assert "--drop-damaged" in err
    assert not out.exists()


def test_verify_lists_damaged_files(store: Path, shell: Shell) -> None:
    assert "2 of 2 files whole" in shell.err("store", "verify", store, code=0)
    file, gone = rows_file(store), next(store.glob("recordings/compacted/*.parquet"))
    flip(file, 1000)
    gone.unlink()
    document = shell.json("store", "verify", store, code=1)
    assert document["files"] == 2
    assert [one["file"] for one in document["damaged"]] == [
        str(one.relative_to(store)) for one in (file, gone)
    ]


def test_damaged_manifest_is_found_in_unreadable_store(store: Path) -> None:
    file = next(store.glob("recordings/compacted/*.parquet"))
    flip(file, 1000)
    assert [Path(one.file).name for one in verify_store(store).damaged] == [file.name]


def test_unchanged_file_is_verified_once(store: Path) -> None:
    file = rows_file(store)
    with Store(store) as opened:
        assert opened.unverified() == 2
        opened.verify()
        assert opened.unverified() == 0
        stat = file.stat()
        flip(file, 1000)
        os.utime(file, ns=(stat.st_atime_ns, stat.st_mtime_ns))
        opened.verify()  # remembered, as the file seems unchanged
        assert len(verify_store(store).damaged) == 1  # which reads every file
        assert opened.unverified() == 1
        with pytest.raises(StoreError, match="cannot be read"):
            opened.verify()
        assert opened.unverified() == 1  # files that were whole are still remembered
        flip(file, 1000)
        opened.verify()
        assert opened.unverified() == 0
