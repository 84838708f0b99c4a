"""A panel larger than memory is drawn from in chunks: the same quotas, every row in its turn."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from restock.errors import MixtureError, PanelError
from restock.replay.sampling.chunked import ChunkedSampler
from restock.replay.sampling.packed_rows import RowFile

WIDTH = 5


def panel(path: Path, rows: int) -> np.memmap[Any, np.dtype[np.float32]]:
    """Rows that say which they are: row i is [i, i + 1, …]."""
    made = np.arange(rows, dtype=np.float32)[:, None] + np.arange(WIDTH, dtype=np.float32)
    path.write_bytes(b"\0" * 64 + made.tobytes())
    return np.memmap(path, np.float32, "r", offset=64, shape=(rows, WIDTH))


def scattered(sizes: list[int], seed: int) -> list[np.ndarray]:
    rows = np.random.default_rng(seed).permutation(sum(sizes))
    return np.split(rows, np.cumsum(sizes)[:-1])


@pytest.fixture
def thousand(tmp_path) -> np.memmap[Any, np.dtype[np.float32]]:
    return panel(tmp_path / "rows.f32", 1000)


def memory_for(rows: int) -> int:
    return rows * (4 * WIDTH + 16)


@settings(max_examples=40)
@given(
    sizes=st.lists(st.integers(1, 300), min_size=1, max_size=4),
    batch_size=st.integers(1, 10),
    chunk_rows=st.integers(10, 40),
    room=st.integers(80, 400),
    seed=st.integers(0, 2**32),
)
def test_quotas_are_exact_and_rows_have_their_turns(
    tmp_path_factory, sizes, batch_size, chunk_rows, room, seed
):
    rows = panel(tmp_path_factory.mktemp("panel") / "rows", sum(sizes))
    strata = scattered(sizes, seed)
    shares = np.full(len(sizes), 1 / len(sizes))
    sampler = ChunkedSampler(
        rows,
        strata,
        shares,
        batch_size,
        np.random.default_rng(seed),
        chunk_rows=chunk_rows,
        memory_bytes=memory_for(room * len(sizes)),
    )
    counts, quota = np.zeros(sum(sizes)), np.zeros(len(sizes))
    out = np.empty((batch_size, WIDTH), np.float32)
    for batch in range(1, 120):
        drawn, stratum = sampler.draw()
        sampler.gather(out)
        np.testing.assert_array_equal(out[:, 0], drawn)
        np.testing.assert_array_equal(out[:, -1], drawn + WIDTH - 1)
        assert all(row in strata[s] for row, s in zip(drawn.tolist(), stratum, strict=True))
        np.add.at(counts, drawn, 1)
        quota += np.bincount(stratum, minlength=len(sizes))
        assert np.abs(quota - batch * batch_size * shares).max() < 2.0
        assert all(np.ptp(counts[members]) <= 1 for members in strata)
    sampler.close()


def test_draws_are_mixed_across_the_file(thousand):
    sampler = ChunkedSampler(
        thousand,
        [np.arange(1000)],
        [1.0],
        10,
        np.random.default_rng(0),
        chunk_rows=50,
        memory_bytes=memory_for(300),
    )
    drawn = np.concatenate([sampler.draw()[0] for _ in range(100)])  # an epoch's worth
    assert abs(np.corrcoef(drawn, np.arange(1000))[0, 1]) < 0.5
    # Neighbours in the file do not come together: a batch holds rows of many chunks.
    chunks = [len(set((batch // 50).tolist())) for batch in drawn.reshape(-1, 10)]
    assert np.mean(chunks) > 3


def test_a_state_of_other_chunks_is_refused(thousand):
    def sampler(**reading: int) -> ChunkedSampler:
        rng = np.random.default_rng(0)
        return ChunkedSampler(thousand, [np.arange(1000)], [1.0], 4, rng, **reading)

    state = sampler(chunk_rows=50, memory_bytes=memory_for(300)).state_dict()
    with pytest.raises(MixtureError, match="capacity was 300, this one's is 400"):
        sampler(chunk_rows=50, memory_bytes=memory_for(400)).load_state_dict(state)
    with pytest.raises(MixtureError, match="chunk_rows was 50, this one's is 40"):
        sampler(chunk_rows=40, memory_bytes=memory_for(300)).load_state_dict(state)


@pytest.fixture(scope="module")
def fifty_thousand(tmp_path_factory) -> np.memmap[Any, np.dtype[np.float32]]:
    return panel(tmp_path_factory.mktemp("panel") / "rows", 50_000)


@settings(max_examples=60)
@given(picked=st.lists(st.integers(0, 49_999), max_size=60), run=st.integers(0, 49_000))
def test_rows_are_read_whatever_their_gaps(fifty_thousand, picked, run):
    rows = fifty_thousand
    wanted = np.sort(np.array([*picked, *range(run, run + 900)], np.int64))  # repeats and gaps
    out = np.empty((len(wanted), WIDTH), np.float32)
    with RowFile(rows) as file:
        file.read(wanted, out)
    np.testing.assert_array_equal(out, rows[wanted])


def test_a_file_that_shrank_is_an_error(tmp_path):
    rows = panel(tmp_path / "rows", 100)
    os.truncate(tmp_path / "rows", 64 + 50 * 4 * WIDTH)
    with RowFile(rows) as file, pytest.raises(PanelError, match="ends before row 100 of 100"):
        file.read(np.arange(100), np.empty((100, WIDTH), np.float32))


def test_what_cannot_be_read_in_chunks_is_refused(thousand):
    rng = np.random.default_rng(0)
    with pytest.raises(PanelError, match="memory-mapped"):
        ChunkedSampler(np.zeros((9, 3), np.float32), [np.arange(9)], [1.0], 4, rng)
    with pytest.raises(MixtureError, match="less than two chunks"):
        ChunkedSampler(
            thousand, [np.arange(1000)], [1.0], 4, rng, memory_bytes=memory_for(99), chunk_rows=50
        )
    with pytest.raises(MixtureError, match="no rows"):
        ChunkedSampler(thousand, [np.arange(9), np.arange(0)], [0.5, 0.5], 4, rng)
    sampler = ChunkedSampler(thousand, [np.arange(1000)], [1.0], 60, rng, chunk_rows=50)
    with pytest.raises(MixtureError, match="larger chunks"):
        sampler.draw()


LIMITED = """
import resource, sys
import numpy as np
from restock.replay.sampling.chunked import ChunkedSampler

path, count, width = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
rows = np.memmap(path, np.float32, "r", shape=(count, width))
with open("/proc/self/statm") as file:
    pages, resident = (int(word) for word in file.read().split()[:2])
page = resource.getpagesize()
limit = pages * page + (80 << 20)  # what is mapped now, and 80 MB for all that follows
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
try:
    np.array(rows)
    sys.exit("the limit does not bind")
except MemoryError:
    pass
strata = [np.arange(0, count - 2000), np.arange(count - 2000, count)]
sampler = ChunkedSampler(
    rows, strata, [0.75, 0.25], 256, np.random.default_rng(0),
    chunk_rows=4096, memory_bytes=32 << 20,
)
out = np.empty((256, width), np.float32)
seen = np.zeros(count, bool)
for _ in range(count // 192):
    drawn, stratum = sampler.draw()
    sampler.gather(out)
    assert (out[:, 0] == drawn).all() and (stratum == 1).sum() == 64
    seen[drawn] = True
with open("/proc/self/statm") as file:
    grown = (int(file.read().split()[1]) - resident) * page
print(int(seen.mean() * 100), grown >> 20)
"""


@pytest.mark.skipif(not Path("/proc/self/statm").is_file(), reason="needs Linux's /proc")
def test_a_panel_larger_than_a_memory_limit(tmp_path):
    count, width = 300_000, 189  # 216 MiB
    path = tmp_path / "rows.f32"
    rows = np.memmap(path, np.float32, "w+", shape=(count, width))
    rows[:, 0] = np.arange(count)
    rows.flush()
    del rows
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(path), str(count), str(width)],
        capture_output=True,
        text=True,
        check=False,
        env={"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PATH": ""},
    )
    assert done.returncode == 0, done.stderr
    seen_percent, grown_mb = (int(word) for word in done.stdout.split())
    assert seen_percent >= 80  # of an epoch, less what waits in the buffer
    assert grown_mb < 80
