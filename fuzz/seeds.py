"""Small sound inputs of every target of the fuzzer, made by code (see readers.py)."""

from __future__ import annotations

import contextlib
import io
import json
import sqlite3
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import zstandard
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

MESSAGE = """\
std_msgs/Header header
float64 x
bool[2] flags
string name
uint8[] data
float64[<=3] more
pkg/Inner[] inner
string[] names
================================================================================
MSG: pkg/Inner
uint16 a
string b
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
IDL = """\
module pkg { module msg {
  const uint8 N = 2;
  struct T { double x; octet data[N]; sequence<string> names; sequence<float, 3> more; };
}; };
"""
SCHEMA = {
    "type": "object",
    "properties": {
        "stamp": {"type": "object", "properties": {"sec": {"type": "integer"}}},
        "x": {"type": ["number", "null"]},
        "again": {"$ref": "#/$defs/a"},
        "list": {"type": "array", "items": {"type": "object", "properties": {"s": {}}}},
    },
    "$defs": {"a": {"type": "boolean"}},
}
JSON = b'{"stamp":{"sec":1,"nsec":2},"x":-1.5e3,"again":true,"list":[{"s":"\\u00e4"},{"s":""}]}'


def _messages() -> list[bytes]:
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(MESSAGE, "pkg/msg/T"))
    make = store.types
    payloads = []
    for row in range(3):
        time = make["builtin_interfaces/msg/Time"](row, 5)
        inner = [make["pkg/msg/Inner"](n, "b" * n) for n in range(row)]
        message = make["pkg/msg/T"](
            make["std_msgs/msg/Header"](time, "map"),
            row * 0.5,
            np.array([True, False]),
            "name" * row,
            np.arange(row, dtype=np.uint8),
            np.zeros(row),
            inner,
            ["a"] * row,
        )
        little = row != 2
        payloads.append(bytes(store.serialize_cdr(message, "pkg/msg/T", little_endian=little)))
    return payloads


def _descriptor() -> bytes:
    files = FileDescriptorSet()
    file = files.file.add(name="p.proto", package="p", syntax="proto3")
    message = file.message_type.add(name="T")
    kinds = (
        *((FieldDescriptorProto.TYPE_DOUBLE, 1), (FieldDescriptorProto.TYPE_STRING, 3)),
        *((FieldDescriptorProto.TYPE_BYTES, 1), (FieldDescriptorProto.TYPE_SINT64, 3)),
    )
    for number, (kind, label) in enumerate(kinds, 1):
        message.field.add(name=f"f{number}", number=number, type=kind, label=label)
    message.field.add(name="t", number=9, type=11, label=3, type_name=".p.T")
    return files.SerializeToString()


PROTO = (
    b"\x09\x00\x00\x00\x00\x00\x00\xf8\x3f\x12\x02ab\x1a\x01\xff\x22\x02\x01\x02\x4a\x02\x12\x00"
)


def _mcap(**options: object) -> bytes:
    out = io.BytesIO()
    writer = Writer(out, chunk_size=400, **options)  # type: ignore[arg-type]
    writer.start(profile="", library="fuzz")
    topics = (
        ("/cdr", "cdr", "pkg/msg/T", "ros2msg", MESSAGE.encode(), _messages()),
        ("/json", "json", "J", "jsonschema", json.dumps(SCHEMA).encode(), [JSON] * 3),
        ("/bare", "json", "", "", b"", [JSON, b"[]"]),
        ("/proto", "protobuf", "p.T", "protobuf", _descriptor(), [PROTO] * 2),
        ("/bool", "cdr", "std_msgs/msg/Bool", "", b"", [b"\0\1\0\0\1"]),
    )
    for topic, encoding, kind, form, definition, payloads in topics:
        schema = writer.register_schema(kind, form, definition) if kind else 0
        channel = writer.register_channel(topic, encoding, schema)
        for row, payload in enumerate(payloads):
            writer.add_message(channel, 1000 - row, payload, row)
    writer.add_attachment(1, 2, "a.txt", "text/plain", b"attached")
    writer.add_metadata("m", {"key": "value"})
    writer.finish()
    return out.getvalue()


def small_mcap() -> bytes:
    out = io.BytesIO()
    writer = Writer(out, use_chunking=False)
    writer.start()
    schema = writer.register_schema("std_msgs/msg/Bool", "ros2msg", b"bool data")
    channel = writer.register_channel("/bool", "cdr", schema)
    writer.add_message(channel, 1, b"\0\1\0\0\1", 1)
    writer.finish()
    return out.getvalue()


def _sqlite(folder: Path) -> bytes:
    file = folder / "seed.db3"
    with contextlib.closing(sqlite3.connect(file)) as base, base:
        base.executescript(
            "PRAGMA page_size = 512;"
            "CREATE TABLE topics (id INTEGER PRIMARY KEY, name TEXT, type TEXT,"
            " serialization_format TEXT, offered_qos_profiles TEXT);"
            "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER,"
            " timestamp INTEGER, data BLOB);"
            "CREATE TABLE message_definitions (id INTEGER PRIMARY KEY, topic_type TEXT,"
            " encoding TEXT, encoded_message_definition TEXT);"
            "INSERT INTO topics VALUES (1, '/t', 'pkg/msg/T', 'cdr', '');"
        )
        base.execute(
            "INSERT INTO message_definitions VALUES (1, 'pkg/msg/T', 'ros2msg', ?)", (MESSAGE,)
        )
        rows = [(1, row, payload) for row, payload in enumerate(_messages())]
        rows.append((1, 9, zstandard.ZstdCompressor().compress(rows[0][2])))
        base.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
    return file.read_bytes()


def _bag(folder: Path) -> bytes:
    store = get_typestore(Stores.ROS1_NOETIC)
    with Ros1Writer(folder / "seed.bag") as bag:
        connection = bag.add_connection("/b", "std_msgs/msg/Bool", typestore=store)
        for row in range(3):
            bag.write(connection, row, b"\1")
    return (folder / "seed.bag").read_bytes()


METADATA = b"""\
rosbag2_bagfile_information:
  version: 5
  storage_identifier: mcap
  relative_file_paths: [bag_0.mcap, ../other.mcap]
  duration: {nanoseconds: 1}
  message_count: 1
  compression_format: ""
  topics_with_message_count:
    - topic_metadata: {name: /bool, type: std_msgs/msg/Bool, serialization_format: cdr}
      message_count: 2
"""


def seeds() -> Iterator[bytes]:
    """Small inputs of every target, all of them sound."""
    none = CompressionType.NONE
    files = [
        _mcap(compression=none),
        _mcap(compression=none, enable_crcs=False),
        _mcap(compression=none, enable_crcs=False, index_types=IndexType.NONE),
        _mcap(use_chunking=False, enable_crcs=False),
        _mcap(compression=CompressionType.ZSTD, enable_crcs=False),
        _mcap(compression=CompressionType.LZ4, use_statistics=False, repeat_channels=False),
        small_mcap(),
        zstandard.ZstdCompressor().compress(small_mcap()),
    ]
    with tempfile.TemporaryDirectory() as folder:
        files += [_sqlite(Path(folder)), _bag(Path(folder))]
    for file in files:
        yield b"\0\0" + file
        yield b"\0\xff" + file
        yield b"\0\xff" + file[: len(file) * 2 // 3]
    payloads = _messages()
    yield b"\1" + _joined(MESSAGE.encode(), *payloads)
    yield b"\1" + _joined(IDL.encode(), b"\0\1\0\0" + bytes(24))
    yield b"\1" + _joined(b"string a\nint64[] b", b"\0\0\0\0\0\0\0\2a\0", b"\0\1\0\0")
    yield b"\2" + _joined(MESSAGE.encode(), bytes(60), b"\1" * 60)
    yield b"\2" + _joined(b"time t\nduration[] d\nstring s\nint64 n", bytes(24))
    yield b"\3" + _joined(json.dumps(SCHEMA).encode(), JSON, JSON[:-1])
    yield b"\3" + _joined(b"", JSON, b'{"x": [[1], {"y": NaN}]}')
    yield b"\4" + _joined(_descriptor(), PROTO, PROTO[:-1])
    yield b"\5" + METADATA


def _joined(*parts: bytes) -> bytes:
    return b"".join(struct.pack("<H", len(part)) + part for part in parts)
