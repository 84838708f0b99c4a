"""The contestants of `ingest.py`: a log to columns, by Restock and by its peers.

rerun-sdk and mcap-ros2-support are left out where they are not installed.
"""

from __future__ import annotations

import sqlite3
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import zstandard
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from restock.ingest.containers.chunks import crc32
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.decoding.columns import FieldColumn, Leaf, Ragged, equal, join, take
from restock.ingest.decoding.definitions import message_type

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from support.rosbags_columns import RowDecoder

NOT_INSTALLED: set[str] = set()
try:
    from rerun.chunk import McapReader
except ImportError:
    NOT_INSTALLED.add("rerun-sdk")
try:
    from mcap_ros2.decoder import DecoderFactory
except ImportError:
    NOT_INSTALLED.add("mcap-ros2-support")

PROFILE = {
    "/odom": ["header.stamp", "twist.twist.linear.x", "twist.twist.angular.z"],
    "/imu": ["header.stamp", "angular_velocity.z", "linear_acceleration.x"],
    "/scan": ["header.stamp", "ranges", "angle_min", "angle_increment"],
    "/cmd_vel": ["linear.x", "angular.z"],
}
CHUNK_HEAD = 9 + 8 + 8 + 8 + 4 + 4 + 8  # bytes before a chunk's records, but for the name


def decompress_only(path: Path) -> Callable[[], None]:
    """Read each chunk's bytes, decompress them and compute their CRC.

    Where they lie is looked up beforehand; the CRC is by the fastest there is, as Restock's.
    """
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    places = [
        (c.chunk_start_offset + CHUNK_HEAD + len(c.compression), c.compressed_size, c)
        for c in summary.chunk_indexes
    ]

    def work() -> None:
        decoder = zstandard.ZstdDecompressor()
        with path.open("rb") as file:
            for at, size, chunk in places:
                file.seek(at)
                records = decoder.decompress(
                    file.read(size), max_output_size=chunk.uncompressed_size
                )
                crc32(records)

    return work


def fetch_only(bag: Path) -> None:
    """Every row of a sqlite3 bag, and nothing else."""
    base = sqlite3.connect(next(bag.glob("*.db3")))
    for _ in base.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY id"):
        pass
    base.close()


def restock_columns(path: Path, wanted: dict[str, list[str]] | None = None) -> dict[str, Any]:
    with open_recording(path) as recording:
        fields = wanted or {topic: recording.leaves(topic) for topic in recording.topics}
        columns = recording.read(fields)
        assert not recording.lost_messages
        return columns


def restock_diagnostics(path: Path) -> None:
    with open_recording(path) as recording:
        recording.read({"/diagnostics": recording.leaves("/diagnostics")})


def rerun_columns(path: Path, topic: str | None = None) -> dict[str, list[pa.RecordBatch]]:
    only = {"include_topic_regex": [f"^{topic}$"]} if topic else {}
    batches: dict[str, list[pa.RecordBatch]] = {}
    for chunk in McapReader(path, decoders=["ros2_reflection"], **only).stream():
        batches.setdefault(str(chunk.entity_path), []).append(chunk.to_record_batch())
    return batches


def rosbags_decode(bag: Path) -> None:
    with AnyReader([bag]) as reader:
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)


def rosbags_columns(path: Path) -> dict[str, dict[str, FieldColumn]]:
    """rosbags' decoder, message by message, and its values laid out in the same columns."""
    with open_recording(path) as recording:
        columns: dict[str, dict[str, FieldColumn]] = {}
        for topic in recording.topics:
            (stream,) = recording._streams[topic]
            kind: Any = message_type(stream.channel, "humble")
            decoder = RowDecoder(kind, kind.leaves())
            parts = [
                decoder.decode(batch).fields
                for _, batch in stream.storage.batches([stream.channel.id])
            ]
            columns[topic] = {leaf: join([part[leaf] for part in parts]) for leaf in parts[0]}
        return columns


def mcap_ros2(path: Path) -> None:
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _ in reader.iter_decoded_messages(log_time_order=False):
            pass


def mcap_alone(path: Path) -> None:
    with path.open("rb") as file:
        for _ in make_reader(file).iter_messages(log_time_order=False):
            pass


# -- are they equal? ---------------------------------------------------------------------------


def check_values(path: Path, bag: Path) -> dict[str, int]:
    """Return how many columns equal Restock's of the MCAP, by whom; ends where one does not."""
    of_mcap = restock_columns(path)
    compared: Counter[str] = Counter()
    of_bag = restock_columns(bag)
    rosbags = rosbags_columns(path)
    rerun = {} if "rerun-sdk" in NOT_INSTALLED else rerun_columns(path)
    with open_recording(path) as recording:
        leaves = {
            topic: message_type(recording._streams[topic][0].channel, "humble").leaves()
            for topic in recording.topics
        }
    for topic, columns in of_mcap.items():
        if rerun:
            parts = pa.Table.from_batches(rerun[topic])
            order = np.argsort(parts["message_log_time"].cast(pa.int64()).to_numpy(), kind="stable")
            (name,) = (name for name in parts.column_names if name.endswith(":message"))
            messages = parts[name].combine_chunks().values  # one struct a message
        for leaf in leaves[topic]:
            ours = columns.fields[leaf.path]
            others = {
                "restock, of the sqlite3 bag": of_bag[topic].fields[leaf.path],
                "rosbags": rosbags[topic][leaf.path],
            }
            if rerun:
                others["rerun-sdk"] = take(arrow_column(messages, leaf), order)
            for who, column in others.items():
                if not equal(ours, column):
                    raise SystemExit(f"{topic} {leaf.path}: not what {who} reads")
                compared[who] += 1
    return compared


def arrow_column(messages: pa.StructArray, leaf: Leaf) -> FieldColumn:
    """Return a field path of rerun's messages as a column of Restock's."""
    return _inside(messages, list(leaf.steps), leaf.kind)


def _inside(array: Any, steps: list[Any], kind: str) -> FieldColumn:
    if not steps:
        if kind == "time":
            sec, nanosec = (array.field(part).to_numpy() for part in ("sec", "nanosec"))
            return sec.astype(np.int64) * 1_000_000_000 + nanosec
        if kind == "string":
            return np.array(array.to_pylist() or [None], object)[: len(array)]
        return array.to_numpy(zero_copy_only=False)
    step, *rest = steps
    array = array.field(step.name)
    if not step.many:
        return _inside(array, rest, kind)
    if pa.types.is_binary(array.type) or not hasattr(array, "offsets"):
        raise SystemExit(f"rerun gives {array.type} for {step.name}")
    offsets = array.offsets.to_numpy().astype(np.int64)
    values = _inside(array.flatten(), rest, kind)
    if step.many.length is not None and not isinstance(values, Ragged):
        return values.reshape(len(array), step.many.length, *values.shape[1:])
    return Ragged(values, offsets - offsets[0])
