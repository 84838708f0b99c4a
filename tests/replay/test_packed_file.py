"""The file of packed rows: the same bytes and checksum for any order of writing."""

import errno
import os

import numpy as np
import pytest
from blake3 import blake3
from hypothesis import given, settings
from hypothesis import strategies as st

from restock.errors import PanelError
from restock.replay.panel import pack
from restock.replay.panel.pack import PackedFile, Values
from restock.replay.panel.panel import FileRecord

WIDTH = 5
HALVES = (slice(0, 2), slice(2, WIDTH))


def small_blocks(patch: pytest.MonkeyPatch, held_blocks: int) -> None:
    patch.setattr(pack, "BLOCK_ROWS", 8)
    patch.setattr(pack, "HELD_BYTES", held_blocks * 8 * WIDTH * 4)
    patch.setattr(pack, "WAITING_BYTES", 0)


@settings(max_examples=40)
@given(st.integers(1, 90), st.integers(0, 4), st.integers(0, 2**32), st.integers(1, 40))
def test_parts_in_any_order_give_same_file(tmp_path_factory, count, held, seed, at_once):
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(count, WIDTH)).astype("<f4")
    path = tmp_path_factory.mktemp("packed") / "rows"
    puts = [
        (part, some)
        for part in HALVES
        for some in np.split(rng.permutation(count), range(at_once, count, at_once))
    ]
    with pytest.MonkeyPatch.context() as patch:
        small_blocks(patch, held)
        with PackedFile(path, count, WIDTH, parts=2) as file:
            for place in rng.permutation(len(puts)).tolist():
                part, some = puts[place]
                held = Values(part, rows[some, part])
                file.put(some, held if place % 2 else Values(part, rows[:, part], some))
            record = file.finish()
    assert path.read_bytes() == rows.tobytes()
    assert record.bytes == rows.nbytes
    assert record.blake3 == blake3(rows.tobytes()).hexdigest(16)
    record.check(path, verify=True)


def test_changed_bytes_are_found(tmp_path):
    content = np.random.default_rng(0).bytes(4 * 100 + 7)
    path = tmp_path / "file"
    path.write_bytes(content)
    record = FileRecord.of(path)
    record.check(path, verify=True)
    for place in range(0, len(content), 13):
        path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
        with pytest.raises(PanelError, match="checksum"):
            record.check(path, verify=True)


def test_missing_row_is_refused(tmp_path):
    rows = np.zeros((20, WIDTH), np.float32)
    with PackedFile(tmp_path / "rows", 20, WIDTH, parts=2) as file:
        file.put(np.arange(20), Values(HALVES[0], rows[:, HALVES[0]]))
        file.put(np.arange(19), Values(HALVES[1], rows[:19, HALVES[1]]))
        with pytest.raises(PanelError, match="changed while it was read"):
            file.finish()


def test_full_disk_is_reported(tmp_path, monkeypatch):
    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    small_blocks(monkeypatch, 2)
    monkeypatch.setattr(os, "pwrite", full)
    rows = np.zeros((8_000, WIDTH), np.float32)
    with (
        pytest.raises(OSError, match="No space left"),
        PackedFile(tmp_path / "rows", len(rows), WIDTH, parts=1) as file,
    ):
        file.put(np.arange(len(rows)), Values(slice(0, WIDTH), rows))
