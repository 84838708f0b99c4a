"""Memory grows with the fields that a profile needs, not with the size of the recording."""

import json
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.bag_samples import compress_files
from support.cameras import raw
from support.driven_robot import Drive, typed_topics, write_topics

from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.profile.tables import Clock
from restock.ingest.steps.align import align
from restock.ingest.steps.clocks import STAMP, topic_clock

FEW, MANY = 10, 250  # images of 400 kB
# Allowed growth; the larger recording holds 96 MB more. Read-ahead takes some 25 MB at any size
# (the same with 400 MB), give or take an allocation.
ALLOWED_MB = 48

# Ingests each recording in turn and prints the peak memory of the process after each.
MEASURE = """
import json, re, sys
from restock.ingest.pipeline import ingest
from restock.ingest.profile.profile import load_profile
profile, peaks = load_profile("warehouse_amr"), []
for path in sys.argv[1:]:
    outcome = ingest(path, profile, store=None)
    with open("/proc/self/status") as file:  # ru_maxrss would count the parent's memory, too
        peak = int(re.search(r"VmHWM:\\s+(\\d+) kB", file.read())[1]) / 1024
    peaks.append((outcome.manifest["transitions"], peak))
print(json.dumps(peaks))
"""


def recording(kind: str, folder: Path, images: int) -> Path:
    """Return a drive with images among its messages."""
    rng = np.random.default_rng(1)
    frames = [rng.integers(0, 256, (400, 334, 3), np.uint8) for _ in range(images)]
    topics = typed_topics(Drive()) | {"/camera": raw(frames)}
    bag = write_topics(topics, folder / "run", storage="sqlite3" if kind == "sqlite3" else "mcap")
    return compress_files(bag) if kind == "zstd file" else bag


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="no /proc to read peaks from")
@pytest.mark.parametrize("kind", ["mcap", "sqlite3", "zstd file"])
def test_memory_does_not_grow_with_recording_size(kind: str, tmp_path: Path) -> None:
    paths = [recording(kind, tmp_path / str(images), images) for images in (FEW, MANY)]
    done = subprocess.run(
        [sys.executable, "-c", MEASURE, *map(str, paths)], capture_output=True, check=True
    )
    (few, before), (many, after) = json.loads(done.stdout)
    assert few == many > 20
    assert after - before < ALLOWED_MB


def peak_memory(work: Callable[[], Any]) -> int:
    """Return the peak bytes that a call allocates, as NumPy counts them."""
    work()  # fills caches, which do not count
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_alignment_memory_is_few_times_the_stamps() -> None:
    count = 200_000
    rng = np.random.default_rng(1)
    stamp = np.arange(count, dtype=np.int64) * 5_000_000 + 10**18
    log = np.maximum.accumulate(stamp + 1_000_000 + rng.integers(0, 2_000_000, count))
    imu = TopicColumns(log, log, {STAMP: stamp})
    odometry = TopicColumns(log[::4], log[::4], {STAMP: stamp[::4]})
    topics, clock = {"/imu": imu, "/odom": odometry}, Clock(alignment="header.stamp")
    assert peak_memory(lambda: align(topics, clock)) < 7 * stamp.nbytes  # measured 5, formerly 10
    # measured 3, formerly 7
    assert peak_memory(lambda: topic_clock("/imu", imu)) < 5 * stamp.nbytes
    (segment,), _ = align(topics, clock)
    assert np.shares_memory(segment.topics["/imu"].stamp_ns, stamp)
