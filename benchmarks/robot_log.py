"""A synthetic robot log for benchmarks: ten topics at a mobile robot's usual rates.

Messages are packed with numpy from one serialised template per topic, with noise where a sensor
has noise, so that writing a long log takes seconds and its compression is that of a real one.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, IndexType, Writer
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)
START_NS = 1_700_000_000_000_000_000
MARK = 1234.5  # stands in the template where noise goes
BEAMS = 360
CAMERA = "/camera"
LIBRARY = b"restock benchmark 0"
IMAGE_BYTES = 640 * 480 * 3

TYPES = {
    "/odom": ("nav_msgs/msg/Odometry", 50.0),
    "/imu": ("sensor_msgs/msg/Imu", 200.0),
    "/scan": ("sensor_msgs/msg/LaserScan", 10.0),
    "/cmd_vel": ("geometry_msgs/msg/Twist", 20.0),
    "/tf": ("tf2_msgs/msg/TFMessage", 50.0),
    "/diagnostics": ("diagnostic_msgs/msg/DiagnosticArray", 2.0),
    "/state": ("std_msgs/msg/String", 1.0),
}


def _make(name: str, *values: Any) -> Any:
    return STORE.types[name](*values)


def _header(frame: str) -> Any:
    stamp = _make("builtin_interfaces/msg/Time", 1, 2)
    return _make("std_msgs/msg/Header", stamp, frame)


def _vector(kind: str, *values: float) -> Any:
    return _make(f"geometry_msgs/msg/{kind}", *values)


def _template(topic: str) -> Any:
    marks = (MARK, MARK, MARK)
    if topic == "/odom":
        covariance = np.zeros(36)
        covariance[[0, 7, 35]] = 1e-3
        pose = _vector("Pose", _vector("Point", *marks), _vector("Quaternion", *marks, 1.0))
        twist = _vector("Twist", _vector("Vector3", *marks), _vector("Vector3", *marks))
        return _make(
            "nav_msgs/msg/Odometry",
            _header("odom"),
            "base_link",
            _make("geometry_msgs/msg/PoseWithCovariance", pose, covariance),
            _make("geometry_msgs/msg/TwistWithCovariance", twist, covariance),
        )
    if topic == "/imu":
        covariance = np.diag([1e-4] * 3).reshape(-1)
        vector = _vector("Vector3", *marks)
        quaternion = _vector("Quaternion", *marks, 1.0)
        imu = (quaternion, covariance, vector, covariance, vector, covariance)
        return _make("sensor_msgs/msg/Imu", _header("imu_link"), *imu)
    if topic == "/scan":
        ranges = np.full(BEAMS, MARK, np.float32)
        angles = (-3.14, 3.14, 6.28 / BEAMS, 0.0, 0.1, 0.05, 12.0)
        return _make("sensor_msgs/msg/LaserScan", _header("lidar"), *angles, ranges, ranges)
    if topic == "/cmd_vel":
        return _vector("Twist", _vector("Vector3", *marks), _vector("Vector3", *marks))
    frames = [("odom", "base_link"), ("base_link", "left_wheel"), ("base_link", "right_wheel")]
    rotation = _vector("Quaternion", *marks, 1.0)
    transform = _make("geometry_msgs/msg/Transform", _vector("Vector3", *marks), rotation)
    parts = [
        _make("geometry_msgs/msg/TransformStamped", _header(parent), child, transform)
        for parent, child in frames
    ]
    return _make("tf2_msgs/msg/TFMessage", parts)


def _packed(topic: str, stamps: NDArray[np.int64], rng: np.random.Generator) -> list[bytes]:
    """Return the topic's messages at these times, serialised."""
    kind = TYPES[topic][0]
    if topic in ("/diagnostics", "/state"):
        return [bytes(STORE.serialize_cdr(_varied(topic, rng), kind)) for _ in stamps]
    template = np.frombuffer(bytes(STORE.serialize_cdr(_template(topic), kind)), np.uint8)
    rows = np.tile(template, (len(stamps), 1))
    form = "<f4" if topic == "/scan" else "<f8"
    size = np.dtype(form).itemsize
    mark = np.frombuffer(struct.pack(form[0] + {"<f4": "f", "<f8": "d"}[form], MARK), np.uint8)
    at = 4
    while at + size <= len(template):
        if (template[at : at + size] == mark).all():
            # A slow drift with noise, rounded as sensors and drivers do.
            drift = np.cumsum(rng.normal(scale=0.01, size=len(stamps))) + at * 0.01
            values = np.round(drift + rng.normal(scale=0.003, size=len(stamps)), 3)
            rows[:, at : at + size] = values.astype(form)[:, None].view(np.uint8)
            at += size
        else:
            at += 4
    if topic not in ("/cmd_vel", "/tf"):  # their first bytes are the header's stamp
        rows[:, 4:8] = (stamps // 10**9).astype("<i4")[:, None].view(np.uint8)
        rows[:, 8:12] = (stamps % 10**9).astype("<u4")[:, None].view(np.uint8)
    return [row.tobytes() for row in rows]


def _varied(topic: str, rng: np.random.Generator) -> Any:
    if topic == "/state":
        return _make("std_msgs/msg/String", f"state {rng.integers(5)}" + "." * rng.integers(9))
    status = []
    for part in ("battery", "motor left", "motor right", "lidar", "network"):
        values = [
            _make("diagnostic_msgs/msg/KeyValue", f"{part} {n}", f"{rng.normal():.{n % 5 + 1}f}")
            for n in range(8)
        ]
        level, name = int(rng.integers(2)), f"/robot/{part}"
        status.append(
            _make("diagnostic_msgs/msg/DiagnosticStatus", level, name, "ok", "id", values)
        )
    return _make("diagnostic_msgs/msg/DiagnosticArray", _header(""), status)


def messages(seconds: float, seed: int = 1) -> Iterator[tuple[str, int, bytes]]:
    """Topic, log time and payload of every message, by log time."""
    rng = np.random.default_rng(seed)
    topics, times, payloads = [], [], []
    for number, (topic, (_, rate)) in enumerate(TYPES.items()):
        stamps = START_NS + (np.arange(int(seconds * rate)) / rate * 1e9).astype(np.int64)
        payloads += _packed(topic, stamps, rng)
        times.append(stamps + 2_000_000 + number)
        topics += [topic] * len(stamps)
    every = np.concatenate(times)
    for row in np.argsort(every, kind="stable").tolist():
        yield topics[row], int(every[row]), payloads[row]


def with_images(
    lines: Iterator[tuple[str, int, bytes]], seconds: float, images: int
) -> Iterator[tuple[str, int, bytes]]:
    """Yield the same messages with camera images of noise, evenly among them."""
    if not images:
        yield from lines
        return
    noise = np.random.default_rng(2).bytes(IMAGE_BYTES * 8)
    every_ns = int(seconds * 1e9 / images)
    sent = 0
    for topic, log, payload in lines:
        while sent < images and log >= START_NS + sent * every_ns:
            at = sent * 3_104_729 % (len(noise) - IMAGE_BYTES)
            yield CAMERA, log, noise[at : at + IMAGE_BYTES]
            sent += 1
        yield topic, log, payload


def write_mcap(
    path: Path,
    seconds: float,
    *,
    seed: int = 1,
    images: int = 0,
    chunked: bool = True,
    index: bool = True,
    summary: bool = True,
) -> Path:
    """Write the log as MCAP with zstd; without `summary` it has no index at its end."""
    with path.open("wb") as file:
        writer = Writer(
            file,
            compression=CompressionType.ZSTD,
            chunk_size=1 << 20,
            use_chunking=chunked,
            index_types=IndexType.ALL if index else IndexType.NONE,
            use_statistics=summary,
            repeat_channels=summary,
            repeat_schemas=summary,
        )
        writer.start(profile="ros2", library=LIBRARY.decode())
        channels = {}
        for topic, kind in _kinds(images).items():
            text, _ = STORE.generate_msgdef(kind, ros_version=2)
            schema = writer.register_schema(kind, "ros2msg", text.encode())
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        for topic, log, payload in with_images(messages(seconds, seed), seconds, images):
            writer.add_message(channels[topic], log, payload, publish_time=log)
        writer.finish()
    return path


def _kinds(images: int) -> dict[str, str]:
    camera = {CAMERA: "sensor_msgs/msg/Image"} if images else {}
    return {topic: kind for topic, (kind, _) in TYPES.items()} | camera


def write_bag(folder: Path, seconds: float, *, images: int = 0) -> Path:
    """Write the log as a rosbag2 sqlite3 bag."""
    with BagWriter(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as bag:
        connections = {
            topic: bag.add_connection(topic, kind, typestore=STORE)
            for topic, kind in _kinds(images).items()
        }
        for topic, log, payload in with_images(messages(seconds), seconds, images):
            bag.write(connections[topic], log, payload)
    return folder
