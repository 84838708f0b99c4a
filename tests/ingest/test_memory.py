"""Memory grows with what a profile keeps of a recording, not with the recording's bytes."""

from __future__ import annotations

import json
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore
from support.bag_samples import compress_files
from support.driven_robot import Drive
from support.driven_robot import write_bag as write_drive
from support.long import one_in

from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.profile.profile import load_profile
from restock.ingest.profile.tables import Clock
from restock.ingest.steps.align import align
from restock.ingest.steps.clocks import STAMP, topic_clock
from restock.ingest.steps.episodes import Steps, steps_of

IMAGE_BYTES = 400_000
FEW, MANY = 10, 250  # images
# Of growth, where the larger recording holds 96 MB more. What is read ahead, some 25 MB however
# large the recording (the same with 400 MB), differs by an allocation or two.
ALLOWED_MB = 48

PROFILE = load_profile("warehouse_amr")
# Ingests each recording in turn, and says the peak of this process' memory after each.
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


def with_images(drive: Path, target: Path, images: int, storage: str) -> Path:
    """Return the drive with images among its messages."""
    types = get_typestore(Stores.ROS2_HUMBLE)
    rng = np.random.default_rng(1)
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    with (
        AnyReader([drive]) as reader,
        BagWriter(target, version=9, storage_plugin=plugin) as writer,
    ):
        names = {c.topic: c.msgtype for c in reader.connections}
        connections = {
            topic: writer.add_connection(topic, name, typestore=types)
            for topic, name in names.items()
        }
        camera = writer.add_connection("/camera", "sensor_msgs/msg/Image", typestore=types)
        lines = list(reader.messages())
        every = max(len(lines) // images, 1)
        left = images
        for number, (connection, stamp, data) in enumerate(lines):
            writer.write(connections[connection.topic], stamp, data)
            while left and (number % every == 0 or number == len(lines) - 1):
                writer.write(camera, stamp, rng.bytes(IMAGE_BYTES))
                left -= 1
                if number < len(lines) - 1:
                    break
    return target


def unchunked(bag: Path) -> Path:
    """Return the messages of an MCAP bag outside any chunk, without a data section CRC."""
    target = bag.with_suffix(".mcap")
    with next(bag.glob("*.mcap")).open("rb") as file, target.open("wb") as sink:
        writer = Writer(sink, use_chunking=False, compression=CompressionType.NONE)
        writer.start(profile="ros2")
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            if channel.id not in channels:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, "cdr", kind)
            writer.add_message(channels[channel.id], message.log_time, message.data, 0)
        writer.finish()
    return target


def recording(kind: str, drive: Path, folder: Path, images: int) -> Path:
    bag = with_images(drive, folder / "run", images, "sqlite3" if kind == "sqlite3" else "mcap")
    if kind == "not chunked":
        return unchunked(bag)
    return compress_files(bag) if kind == "zstd file" else bag


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="no /proc to read peaks from")
@pytest.mark.parametrize("kind", one_in(2, ["mcap", "not chunked", "sqlite3", "zstd file"]))
def test_memory_does_not_grow_with_the_bytes_of_a_recording(kind: str, tmp_path: Path) -> None:
    drive = write_drive(Drive(), tmp_path / "drive")
    paths = []
    for name, images in (("small", FEW), ("large", MANY)):
        (tmp_path / name).mkdir()
        paths.append(recording(kind, drive, tmp_path / name, images))
    done = subprocess.run(
        [sys.executable, "-c", MEASURE, *map(str, paths)], capture_output=True, check=True
    )
    (few, before), (many, after) = json.loads(done.stdout)
    assert few == many > 20
    assert after - before < ALLOWED_MB


def most_memory(work: Callable[[], Any]) -> int:
    """Return the peak bytes that some work adds, as NumPy counts them."""
    work()  # what is kept for the next time is not of the work
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_aligning_takes_few_arrays_beside_the_times() -> None:
    count = 200_000
    rng = np.random.default_rng(1)
    stamp = np.arange(count, dtype=np.int64) * 5_000_000 + 10**18
    log = np.maximum.accumulate(stamp + 1_000_000 + rng.integers(0, 2_000_000, count))
    imu = TopicColumns(log, log, {STAMP: stamp})
    odometry = TopicColumns(log[::4], log[::4], {STAMP: stamp[::4]})
    topics, clock = {"/imu": imu, "/odom": odometry}, Clock(alignment="header.stamp")
    assert most_memory(lambda: align(topics, clock)) < 7 * stamp.nbytes  # 5; it was 10
    assert most_memory(lambda: topic_clock("/imu", imu)) < 5 * stamp.nbytes  # 3; 7
    (segment,), _ = align(topics, clock)
    assert np.shares_memory(segment.topics["/imu"].stamp_ns, stamp)


@pytest.fixture(scope="module")
def steps() -> Steps:
    """Of a drive of many episodes of much the same length."""
    goals = [(float(t), 2.0 + t % 3, 1.0) for t in range(0, 40, 4)]
    return steps_of(PROFILE, Drive(duration_s=45.0, goals=goals).topics())
