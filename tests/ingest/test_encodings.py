"""MCAP's other message encodings: JSON, protobuf and ROS 1 decode to columns as CDR does."""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from google.protobuf import duration_pb2, timestamp_pb2
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pb2 import FileDescriptorSet as Files
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap_protobuf.schema import build_file_descriptor_set
from rosbags.typesys import Stores, get_typestore
from support.bag_samples import START_NS, Written, write_channels

from restock.ingest.containers.open_recording import open_recording
from restock.ingest.decoding.columns import CannotDecode, Ragged
from restock.ingest.decoding.protobuf_messages import protobuf_type
from restock.ingest.decoding.row_by_row import JsonType

# -- JSON ---------------------------------------------------------------------------------------

VECTOR = {"type": "object", "properties": {axis: {"type": "number"} for axis in "xyz"}}
TIME = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
SCHEMA = {
    "title": "Pose",
    "type": "object",
    "properties": {
        "timestamp": TIME,
        "frame_id": {"type": "string"},
        "position": {"$ref": "#/$defs/vector"},
        "count": {"type": ["integer", "null"]},
        "valid": {"type": "boolean"},
        "ranges": {"type": "array", "items": {"type": "number"}},
        "points": {"type": "array", "items": {"type": "object", "properties": {"p": VECTOR}}},
        "stamps": {"type": "array", "items": TIME},
    },
    "$defs": {"vector": VECTOR},
}
LEAVES = [
    *("timestamp", "frame_id", "position.x", "position.y", "position.z", "count", "valid"),
    *("ranges", "points[].p.x", "points[].p.y", "points[].p.z", "stamps"),
]


def pose(row: int) -> dict[str, Any]:
    vector = {"x": row + 0.5, "y": row, "z": -1.0}
    return {
        "timestamp": {"sec": 1_700_000_000 + row, "nsec": 5},
        "frame_id": f"map {row}",
        "position": vector,
        "count": row,
        "valid": row % 2 == 0,
        "ranges": [1.5, None, 3][:row],
        "points": [{"p": vector}] * row,
        "stamps": [{"sec": 1, "nsec": row}] * row,
    }


@pytest.mark.parametrize("schema", [json.dumps(SCHEMA).encode(), b""], ids=["schema", "none"])
def test_json_with_and_without_a_schema(schema, tmp_path):
    payloads = [json.dumps(pose(row)).encode() for row in range(4)]
    form = "jsonschema" if schema else ""
    path = write_channels(tmp_path / "j.mcap", ("/pose", "json", "Pose", form, schema, payloads))
    with open_recording(path) as recording:
        assert recording.topics["/pose"].skipped is None
        assert recording.topics["/pose"].definition == ("embedded" if schema else "inferred")
        assert recording.leaves("/pose") == LEAVES
        columns = recording.read({"/pose": LEAVES})["/pose"].fields
        assert not recording.lost_messages
    assert columns["timestamp"].tolist() == [  # type: ignore[union-attr]
        (1_700_000_000 + row) * 10**9 + 5 for row in range(4)
    ]
    assert columns["position.y"].dtype == np.float64  # type: ignore[union-attr]
    assert columns["position.x"].tolist() == [0.5, 1.5, 2.5, 3.5]  # type: ignore[union-attr]
    assert columns["frame_id"][2] == "map 2"
    assert columns["valid"].tolist() == [True, False, True, False]  # type: ignore[union-attr]
    ranges = columns["ranges"]
    assert isinstance(ranges, Ragged)
    assert np.array_equal(np.asarray(ranges[3]), [1.5, np.nan, 3.0], equal_nan=True)
    points, stamps = columns["points[].p.x"], columns["stamps"]
    assert np.asarray(points[2]).tolist() == [2.5, 2.5]
    assert np.asarray(stamps[3]).tolist() == [10**9 + 3] * 3


def test_undecodable_json_is_counted_by_reason(tmp_path):
    good = json.dumps({"x": 1.5, "stamp": {"sec": 1, "nanosec": 2}}).encode()
    bad = {
        b"{": "not JSON",
        b'{"x": 1.5}': "field 'stamp' is missing",
        b'{"x": "1.5", "stamp": {"sec": 1, "nanosec": 2}}': "x is not a float64",
        b'{"x": 1.5, "stamp": {"sec": 1.5, "nanosec": 2}}': "not a valid time",
        b'{"x": 1, "stamp": {"sec": 9999999999999999999, "nanosec": 2}}': "stamp is out of range",
        b"[1]": "JSON that is not an object",
        b'{"x":' * 100_000: "JSON that nests too deeply",
        b"\xff": "not JSON",
        b"": "not JSON",
        b"1" * 5000: "not JSON",
        b'{"x": %s, "stamp": {"sec": 1, "nanosec": 2}}' % (b"9" * 400): "not JSON",
    }
    payloads = [good, *bad, b'{"x": NaN, "stamp": {"sec": 1, "nanosec": 3}}']
    path = write_channels(tmp_path / "j.mcap", ("/t", "json", "", "", b"", payloads))
    with open_recording(path) as recording:
        columns = recording.read({"/t": ["x", "stamp"]})["/t"]
        account = recording.accounts["/t"]
    assert columns.fields["stamp"].tolist() == [10**9 + 2, 10**9 + 3]  # type: ignore[union-attr]
    assert account.decoded == 2
    assert account.expected == account.read == len(payloads)
    assert sum(account.reasons.values()) == len(bad)
    for reason_start in bad.values():
        assert any(reason.startswith(reason_start) for reason in account.reasons), (
            reason_start,
            account.reasons,
        )


def test_json_keeps_integers_too_large_for_float64(tmp_path):
    payloads = [b'{"big": %d, "small": 3}' % (START_NS + row) for row in range(3)]
    path = write_channels(tmp_path / "j.mcap", ("/t", "json", "", "", b"", payloads))
    with open_recording(path) as recording:
        fields = recording.read({"/t": ["big", "small"]})["/t"].fields
    assert fields["big"].tolist() == [START_NS, START_NS + 1, START_NS + 2]  # type: ignore[union-attr]
    assert fields["small"].dtype == np.float64  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("schema", "leaves"),
    [
        (b'{"type": "object", "properties": {"a": {"$ref": "#"}, "x": {"type": "number"}}}', 1),
        (b'{"$ref": "#"}', 0),
        (b"[]", 0),
        (b'{"properties": 7}', 0),
    ],
)
def test_json_schema_may_be_incomplete_or_recursive(schema, leaves):
    kind = JsonType("T", "embedded", schema, lambda: [])
    assert len(kind.leaves()) == leaves


def test_json_with_too_many_fields_is_rejected():
    wide = json.dumps({str(number): 1 for number in range(30_000)}).encode()
    with pytest.raises(CannotDecode, match="more than 20,000 fields"):
        JsonType("T", "inferred", b"", lambda: [wide]).leaves()


@pytest.mark.parametrize("schema", [b"{", b"[" * 100_000, b'{"a": \xff}', b" " * (5 << 20)])
def test_invalid_json_schema_is_rejected(schema):
    with pytest.raises(CannotDecode, match="its definition"):
        JsonType("T", "embedded", schema, lambda: []).leaves()


# -- protobuf -----------------------------------------------------------------------------------

F = FieldDescriptorProto


def scan_files() -> Files:
    """Return a Scan message with all kinds of fields, as a recorder embeds it."""
    file = FileDescriptorProto(name="scan.proto", package="lab", syntax="proto3")
    file.dependency.extend(["google/protobuf/timestamp.proto", "google/protobuf/duration.proto"])
    scan = file.message_type.add(name="Scan")
    point = file.message_type.add(name="Point")
    entry = scan.nested_type.add(name="TagsEntry")
    entry.options.map_entry = True
    file.enum_type.add(name="Mode").value.add(name="OFF", number=0)
    file.enum_type[0].value.add(name="ON", number=1)
    rows: list[tuple[Any, str, int, bool, str]] = [
        (scan, "timestamp", F.TYPE_MESSAGE, False, ".google.protobuf.Timestamp"),
        (scan, "frame_id", F.TYPE_STRING, False, ""),
        (scan, "ranges", F.TYPE_DOUBLE, True, ""),
        (scan, "points", F.TYPE_MESSAGE, True, ".lab.Point"),
        (scan, "mode", F.TYPE_ENUM, False, ".lab.Mode"),
        (scan, "data", F.TYPE_BYTES, False, ""),
        (scan, "tags", F.TYPE_MESSAGE, True, ".lab.Scan.TagsEntry"),
        (scan, "took", F.TYPE_MESSAGE, False, ".google.protobuf.Duration"),
        (scan, "inner", F.TYPE_MESSAGE, False, ".lab.Scan"),
        (scan, "count", F.TYPE_UINT64, False, ""),
        (point, "x", F.TYPE_FLOAT, False, ""),
        (point, "names", F.TYPE_STRING, True, ""),
        (entry, "key", F.TYPE_STRING, False, ""),
        (entry, "value", F.TYPE_INT32, False, ""),
    ]
    for message, name, kind, many, of in rows:
        message.field.add(
            name=name,
            number=len(message.field) + 1,
            type=kind,
            label=F.LABEL_REPEATED if many else F.LABEL_OPTIONAL,
            type_name=of or None,
        )
    files = build_file_descriptor_set(timestamp_pb2.Timestamp)
    files.MergeFrom(build_file_descriptor_set(duration_pb2.Duration))
    files.file.insert(0, file)  # before its dependencies, as their order is not guaranteed
    return files


def scan_class() -> Any:
    pool = DescriptorPool()
    files = scan_files().file
    for file in (*files[1:], files[0]):
        pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName("lab.Scan"))


def scan_payload(row: int) -> bytes:
    made = scan_class()()
    made.timestamp.seconds, made.timestamp.nanos = 1_700_000_000, row
    made.frame_id = "läser"
    made.ranges.extend([0.5] * row)
    for name in range(row):
        made.points.add(x=name + 0.25, names=["a"] * name)
    made.mode = row % 2
    made.data = bytes(range(row))
    made.tags["b"], made.tags["a"] = row, -row
    made.took.seconds, made.took.nanos = -1, -500_000_000
    made.inner.count = 2**63 + row
    return bytes(made.SerializeToString())


def protobuf(payloads: Sequence[bytes]) -> Written:
    definition = scan_files().SerializeToString()
    return "/scan", "protobuf", "lab.Scan", "protobuf", definition, payloads


def test_protobuf_messages_decode_to_columns(tmp_path):
    path = write_channels(tmp_path / "p.mcap", protobuf([scan_payload(row) for row in range(4)]))
    with open_recording(path) as recording:
        leaves = recording.leaves("/scan")
        assert leaves == [
            *("timestamp", "frame_id", "ranges", "points[].x", "points[].names", "mode", "data"),
            *("tags[].key", "tags[].value", "took", "count"),
        ]
        columns: dict[str, Any] = dict(recording.read({"/scan": leaves})["/scan"].fields)
        assert not recording.lost_messages
    assert columns["timestamp"].tolist() == [START_NS + row for row in range(4)]
    assert columns["took"].tolist() == [-1_500_000_000] * 4
    assert set(columns["frame_id"]) == {"läser"}
    assert columns["ranges"][3].tolist() == [0.5] * 3
    assert columns["points[].x"][2].tolist() == [0.25, 1.25]
    assert columns["points[].x"].values.dtype == np.float32
    assert [list(names) for names in (columns["points[].names"][2][n] for n in (0, 1))] == [
        [],
        ["a"],
    ]
    assert columns["mode"].tolist() == [0, 1, 0, 1]
    assert columns["data"][3].tolist() == [0, 1, 2]
    assert list(columns["tags[].key"][1]) == ["a", "b"]
    assert columns["tags[].value"][1].tolist() == [-1, 1]
    assert columns["count"].dtype == np.uint64


def test_undecodable_protobuf_is_counted_by_reason(tmp_path):
    beyond = scan_class()()
    beyond.timestamp.seconds = 2**62
    payloads = [
        scan_payload(1),
        b"\xff\xff",
        scan_payload(2)[:-1],
        bytes(beyond.SerializeToString()),
        scan_payload(3),
    ]
    path = write_channels(tmp_path / "p.mcap", protobuf(payloads))
    with open_recording(path) as recording:
        columns = recording.read({"/scan": ["timestamp", "mode"]})["/scan"]
        account = recording.accounts["/scan"]
    assert len(columns) == 2
    assert account.reasons == {
        "not a protobuf message of its type": 2,
        "timestamp is out of range for a date": 1,
    }


def changed_definition(change: Any) -> bytes:
    files = scan_files()
    change(files)
    return bytes(files.SerializeToString())


@pytest.mark.parametrize(
    ("definition", "message"),
    [
        (b"\xff\xff", "cannot be parsed"),
        (b"", "does not define lab.Scan"),
        (changed_definition(lambda files: files.file.pop(1)), "cannot be parsed"),
        (
            changed_definition(lambda files: files.file[1].dependency.append("scan.proto")),
            "cannot be parsed",
        ),
        (
            changed_definition(lambda files: files.file[0].message_type.pop(0)),
            "does not define lab.Scan",
        ),
        (changed_definition(lambda files: files.file[0].message_type[0].field.pop()), None),
        (bytes(5 << 20), "of 5,242,880 bytes is too long"),
    ],
)
def test_invalid_protobuf_definition_is_rejected(definition, message):
    if message is None:
        assert protobuf_type("lab.Scan", definition).leaves()
        return
    with pytest.raises(CannotDecode, match=message):
        protobuf_type("lab.Scan", definition)


# -- ROS 1 in MCAP, and unsupported encodings -----------------------------------------------------


def test_ros1_messages_in_mcap_decode_to_columns(tmp_path):
    store = get_typestore(Stores.ROS1_NOETIC)
    kind = "geometry_msgs/msg/PointStamped"
    definition, _ = store.generate_msgdef(kind, ros_version=1)
    make = store.types
    payloads = []
    for row in range(3):
        time = make["builtin_interfaces/msg/Time"](row, 7)
        header = make["std_msgs/msg/Header"](row, time, "map")
        point = make["geometry_msgs/msg/Point"](row * 1.5, 0.0, 0.0)
        payloads.append(bytes(store.serialize_ros1(make[kind](header, point), kind)))
    name = "geometry_msgs/PointStamped"
    path = write_channels(
        tmp_path / "r.mcap", ("/p", "ros1", name, "ros1msg", definition.encode(), payloads)
    )
    with open_recording(path) as recording:
        assert recording.leaves("/p") == [
            *("header.seq", "header.stamp", "header.frame_id", "point.x", "point.y", "point.z")
        ]
        columns = recording.read({"/p": ["header.stamp", "point.x"]})["/p"]
    assert columns.fields["header.stamp"].tolist() == [7, 10**9 + 7, 2 * 10**9 + 7]  # type: ignore[union-attr]
    assert columns.fields["point.x"].tolist() == [0.0, 1.5, 3.0]  # type: ignore[union-attr]
