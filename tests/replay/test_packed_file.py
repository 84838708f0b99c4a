"""The file of packed rows: the same bytes and checksum for any order of writing."""

import resource

import numpy as np
import pytest
from blake3 import blake3
from hypothesis import given, settings
from hypothesis import strategies as st

from restock.errors import PanelError
from restock.replay.panel.pack import PackedFile
from restock.replay.panel.panel import FileRecord

WIDTH = 5
HALVES = (slice(0, 2), slice(2, WIDTH))


@settings(max_examples=40)
@given(st.integers(1, 90), st.integers(0, 2**32), st.integers(1, 40))
def test_parts_in_any_order_give_same_file(tmp_path_factory, count, seed, at_once):
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(count, WIDTH)).astype("<f4")
    path = tmp_path_factory.mktemp("packed") / "rows"
    puts = [
        (part, some)
        for part in HALVES
        for some in np.split(rng.permutation(count), range(at_once, count, at_once))
    ]
    file = PackedFile(path, count, WIDTH, parts=2)
    for place in rng.permutation(len(puts)).tolist():
        part, some = puts[place]
        file.put(some, (part, rows[some, part]))
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
    file = PackedFile(tmp_path / "rows", 20, WIDTH, parts=2)
    file.put(np.arange(20), (HALVES[0], rows[:, HALVES[0]]))
    file.put(np.arange(19), (HALVES[1], rows[:19, HALVES[1]]))
    with pytest.raises(PanelError, match="changed while it was read"):
        file.finish()


def test_missing_space_is_reported_before_rows_are_written(tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, hard))
    try:
        with pytest.raises(OSError, match="File too large"):
            PackedFile(tmp_path / "rows", 1 << 20, WIDTH, parts=1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
