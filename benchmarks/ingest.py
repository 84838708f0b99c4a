"""Recordings to columns: Restock beside its peers, as CPU time over mere decompression.

    python benchmarks/ingest.py [--quick] [--json] [--check]

All contestants read the same generated log in one process, one after the other in every round.
`--check` exits 1 where a target is missed. Values are compared with rosbags' along the way.
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import robot_log
import zstandard
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from restock.ingest.columns import equal
from restock.ingest.definitions import message_type
from restock.ingest.readers import open_recording
from restock.ingest.rows import RowDecoder

FLOOR = "decompress only"
OURS = "restock, all topics to columns"
OURS_PROFILE = "restock, a profile's fields"
OURS_WALKED = "restock, no message index"
OURS_BAG = "restock, sqlite3 bag"
ROSBAGS = "rosbags, decode"
ROSBAGS_COLUMNS = "rosbags, to columns"
MCAP_ROS2 = "mcap + mcap-ros2-support, decode"
DIAGNOSTICS = "restock, diagnostics alone"

PROFILE = {
    "/odom": ["header.stamp", "twist.twist.linear.x", "twist.twist.angular.z"],
    "/imu": ["header.stamp", "angular_velocity.z", "linear_acceleration.x"],
    "/scan": ["header.stamp", "ranges", "angle_min", "angle_increment"],
    "/cmd_vel": ["linear.x", "angular.z"],
}


def floor(path: Path) -> None:
    decoder = zstandard.ZstdDecompressor()
    with path.open("rb") as file:
        for record in StreamReader(file, emit_chunks=True).records:
            if isinstance(record, Chunk):
                decoder.decompress(record.data, max_output_size=record.uncompressed_size)


def ours(path: Path) -> int:
    with open_recording(path) as recording:
        wanted = {topic: recording.leaves(topic) for topic in recording.topics}
        columns = recording.read(wanted)
        assert not recording.losses
        return sum(len(topic) for topic in columns.values())


def ours_profile(path: Path) -> None:
    with open_recording(path) as recording:
        recording.read(PROFILE)


def ours_diagnostics(path: Path) -> None:
    with open_recording(path) as recording:
        recording.read({"/diagnostics": recording.leaves("/diagnostics")})


def rosbags_decode(bag: Path) -> None:
    with AnyReader([bag]) as reader:
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)


def rosbags_columns(path: Path) -> dict[str, dict[str, Any]]:
    """rosbags' decoder, message by message, and its values laid out in the same columns."""
    with open_recording(path) as recording:
        found: dict[str, dict[str, Any]] = {}
        for topic in recording.topics:
            (stream,) = recording._streams[topic]
            kind = message_type(stream.channel, "humble")
            decoder = RowDecoder(kind, kind.leaves())
            from restock.ingest.columns import join

            parts = [
                decoder.decode(batch).fields
                for _, batch in stream.storage.batches([stream.channel.id])
            ]
            found[topic] = {leaf: join([part[leaf] for part in parts]) for leaf in parts[0]}
        return found


def mcap_ros2(path: Path) -> None:
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _ in reader.iter_decoded_messages(log_time_order=False):
            pass


def check_values(path: Path) -> int:
    """How many columns were compared with rosbags'; fails where one differs."""
    theirs = rosbags_columns(path)
    compared = 0
    with open_recording(path) as recording:
        mine = recording.read({topic: recording.leaves(topic) for topic in recording.topics})
    for topic, columns in theirs.items():
        for leaf, column in columns.items():
            if not equal(mine[topic].fields[leaf], column):
                raise SystemExit(f"{topic} {leaf}: not what rosbags reads")
            compared += 1
    return compared


def cpu_s(work: Callable[[], Any]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="two minutes of log, not twenty")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--check", action="store_true", help="exit 1 where a target is missed")
    options = parser.parse_args()
    seconds, rounds, slow_rounds = (120.0, 5, 1) if options.quick else (1200.0, 5, 2)
    with tempfile.TemporaryDirectory() as folder:
        path = robot_log.write_mcap(Path(folder) / "log.mcap", seconds)
        walked = robot_log.write_mcap(Path(folder) / "no_index.mcap", seconds, index=False)
        bag = robot_log.write_bag(Path(folder) / "bag", seconds)
        mcap_bag = path
        fast: dict[str, Callable[[], Any]] = {
            FLOOR: lambda: floor(path),
            OURS: lambda: ours(path),
            OURS_PROFILE: lambda: ours_profile(path),
            DIAGNOSTICS: lambda: ours_diagnostics(path),
            OURS_WALKED: lambda: ours(walked),
            OURS_BAG: lambda: ours(bag),
        }
        slow: dict[str, Callable[[], Any]] = {
            ROSBAGS: lambda: rosbags_decode(mcap_bag),
            ROSBAGS_COLUMNS: lambda: rosbags_columns(path),
            MCAP_ROS2: lambda: mcap_ros2(path),
        }
        columns = check_values(path)
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        times: dict[str, list[float]] = {name: [] for name in (*fast, *slow)}
        for number in range(rounds):
            for name, work in fast.items():
                times[name].append(cpu_s(work))
            if number < slow_rounds:
                for name, work in slow.items():
                    times[name].append(cpu_s(work))
        messages = ours(path)
        size_mb = path.stat().st_size / 1e6
    median = {name: statistics.median(values) for name, values in times.items()}
    ratio = {name: value / median[FLOOR] for name, value in median.items()}
    targets = {
        "all topics to columns at most 3.5x the floor": ratio[OURS] <= 3.5,
        "a profile's own fields faster still": ratio[OURS_PROFILE] < ratio[OURS],
        "at least 20x rosbags to columns": ratio[ROSBAGS_COLUMNS] >= 20 * ratio[OURS],
        "no index at most 1.3x indexed": ratio[OURS_WALKED] <= 1.3 * ratio[OURS],
    }
    answer = {
        "messages": messages,
        "log_s": seconds,
        "mcap_mb": size_mb,
        "columns_equal_to_rosbags": columns,
        "cpu_s": median,
        "over_floor": ratio,
        "peak_mb_with_rosbags": peak_mb,
        "targets": targets,
    }
    if options.json:
        print(json.dumps(answer, indent=1))
    else:
        print(f"{messages:,} messages, {seconds:.0f} s of log, {size_mb:.0f} MB of MCAP (zstd)")
        print(f"{columns} columns equal to rosbags'")
        for name, value in sorted(ratio.items(), key=lambda item: item[1]):
            print(f"{name:<36} {median[name]:8.3f} s CPU {value:8.2f} x the floor")
        for name, met in targets.items():
            print(f"{'met   ' if met else 'MISSED'} {name}")
    return 0 if all(targets.values()) or not options.check else 1


if __name__ == "__main__":
    np.seterr(all="raise")
    sys.exit(main())
