"""Small recordings for tests: the same messages written as a sqlite3 bag and as MCAP."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

from restock.ingest.decoding.columns import TopicColumns, equal

STORE = get_typestore(Stores.ROS2_HUMBLE)
START_NS = 1_700_000_000_000_000_000

TOPICS = {
    "/odom": "nav_msgs/msg/Odometry",
    "/scan": "sensor_msgs/msg/LaserScan",
    "/joint_states": "sensor_msgs/msg/JointState",
    "/plan": "nav_msgs/msg/Path",
    "/bumper": "std_msgs/msg/Bool",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/policy": "std_msgs/msg/String",
}


def messages(count: int = 20, seed: int = 7) -> Iterator[tuple[str, int, Any]]:
    """Topic, log time and message; log times step back now and then, as in real files."""
    rng = np.random.default_rng(seed)
    make = STORE.types

    def header(stamp: int, frame: str = "odom") -> Any:
        time = make["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
        return make["std_msgs/msg/Header"](time, frame)

    def pose(x: float) -> Any:
        return make["geometry_msgs/msg/Pose"](
            make["geometry_msgs/msg/Point"](x, 0.5, 0.0),
            make["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
        )

    def vector() -> Any:
        return make["geometry_msgs/msg/Vector3"](*rng.normal(size=3))

    none = np.zeros(0)
    for step in range(count):
        stamp = START_NS + step * 50_000_000
        log = stamp + 3_000_000 - (80_000_000 if step == 9 else 0)
        yield (
            "/odom",
            log,
            make["nav_msgs/msg/Odometry"](
                header(stamp),
                "base_link",
                make["geometry_msgs/msg/PoseWithCovariance"](pose(step * 0.1), rng.normal(size=36)),
                make["geometry_msgs/msg/TwistWithCovariance"](
                    make["geometry_msgs/msg/Twist"](vector(), vector()), rng.normal(size=36)
                ),
            ),
        )
        beams = rng.uniform(0.1, 5, size=8 + step % 3).astype(np.float32)
        beams[0] = np.inf
        scan = make["sensor_msgs/msg/LaserScan"](
            header(stamp, "lidar"), -3.1, 3.1, 0.1, 0.0, 0.1, 0.05, 4.0, beams, beams[:0]
        )
        yield "/scan", log + 1, scan
        yield (
            "/joint_states",
            log + 2,
            make["sensor_msgs/msg/JointState"](
                header(stamp, ""),
                ["left", "right wheel"],
                rng.normal(size=2),
                rng.normal(size=2),
                none,
            ),
        )
        poses = [
            make["geometry_msgs/msg/PoseStamped"](header(stamp + n, "map" * (n % 3)), pose(n))
            for n in range(step % 4)
        ]
        yield "/plan", log + 3, make["nav_msgs/msg/Path"](header(stamp, "map"), poses)
        yield "/bumper", log + 4, make["std_msgs/msg/Bool"](step % 5 == 0)
        status = [
            make["diagnostic_msgs/msg/DiagnosticStatus"](
                n,
                f"sensor {n}",
                "fine" if step % 2 else "läuft",
                "id",
                [make["diagnostic_msgs/msg/KeyValue"](f"k{k}", str(step)) for k in range(step % 3)],
            )
            for n in range(step % 3)
        ]
        yield (
            "/diagnostics",
            log + 5,
            make["diagnostic_msgs/msg/DiagnosticArray"](header(stamp), status),
        )
        yield "/policy", log + 6, make["std_msgs/msg/String"](f'{{"policy": "p{step % 2}"}}')


def write_bag(folder: Path, count: int = 20, storage: str = "sqlite3") -> Path:
    """Write a rosbag2 bag with message definitions."""
    plugin = StoragePlugin.SQLITE3 if storage == "sqlite3" else StoragePlugin.MCAP
    with BagWriter(folder, version=9, storage_plugin=plugin) as bag:
        connections = {
            topic: bag.add_connection(topic, kind, typestore=STORE)
            for topic, kind in TOPICS.items()
        }
        for topic, log, message in messages(count):
            data = STORE.serialize_cdr(message, TOPICS[topic])
            bag.write(connections[topic], log, data)
    return folder


def write_mcap(
    path: Path,
    count: int = 20,
    *,
    compression: CompressionType = CompressionType.ZSTD,
    chunk_size: int = 4096,
    packed: bool = False,
    **options: Any,
) -> Path:
    """Write an MCAP file of the same messages, in several chunks; `packed`: each message zstd."""
    with path.open("wb") as file:
        writer = McapWriter(file, compression=compression, chunk_size=chunk_size, **options)
        writer.start(profile="ros2", library="test")
        channels = {}
        for topic, kind in TOPICS.items():
            definition, _ = STORE.generate_msgdef(kind, ros_version=2)
            schema = writer.register_schema(kind, "ros2msg", definition.encode())
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        for topic, log, message in messages(count):
            data = bytes(STORE.serialize_cdr(message, TOPICS[topic]))
            data = zstandard.ZstdCompressor().compress(data) if packed else data
            writer.add_message(channels[topic], log, data, publish_time=log)
        writer.finish()
    return path


# topic, encoding, type, format of the definition, definition, messages
Written = tuple[str, str, str, str, bytes, Sequence[bytes]]


def write_channels(path: Path, *channels: Written) -> Path:
    """Write an MCAP file of these channels, a message a millisecond in each."""
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        for topic, encoding, kind, form, definition, payloads in channels:
            schema = writer.register_schema(kind, form, definition) if form else 0
            channel = writer.register_channel(topic, encoding, schema)
            for row, payload in enumerate(payloads):
                stamp = START_NS + row * 1_000_000
                writer.add_message(channel, stamp, payload, stamp)
        writer.finish()
    return path


def compress_files(bag: Path) -> Path:
    """Compress each storage file of the bag as a whole, as rosbag2's file mode does."""
    for file in [*bag.glob("*.db3"), *bag.glob("*.mcap")]:
        with file.open("rb") as source, file.with_name(file.name + ".zstd").open("wb") as sink:
            zstandard.ZstdCompressor(level=1).copy_stream(source, sink)
        file.unlink()
    return bag


def assert_same_columns(
    left: dict[str, TopicColumns], right: dict[str, TopicColumns], *, publish: bool = True
) -> None:
    """Every topic's times and values; sqlite3 bags do not keep when messages were published."""
    assert left.keys() == right.keys()
    for topic, columns in left.items():
        other = right[topic]
        assert np.array_equal(columns.log_time_ns, other.log_time_ns), topic
        if publish:
            assert np.array_equal(columns.publish_time_ns, other.publish_time_ns), topic
        assert columns.fields.keys() == other.fields.keys()
        for path, column in columns.fields.items():
            assert equal(column, other.fields[path]), (topic, path)
