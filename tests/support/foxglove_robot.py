"""A robot that drives in a circle and records Foxglove's message types as JSON or protobuf."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf import timestamp_pb2
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Field
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.writer import Writer
from mcap_protobuf.schema import build_file_descriptor_set

from restock.ingest.decoding.protobuf_messages import protobuf_type

START_NS = 1_700_000_000 * 10**9
SPEED_MPS, YAW_RATE_RADPS, WALL_M, BEAMS = 0.5, 0.25, 2.5, 181
FIELD_RAD = np.pi  # of the lidar
_NUMBER, _TEXT, _TIME = "number", "string", "time"
_VECTOR = {"x": _NUMBER, "y": _NUMBER, "z": _NUMBER}
# Type -> its fields; a list is of many. Names of types are as a recorder would give them.
TYPES: dict[str, dict[str, Any]] = {
    "foxglove.Vector3": _VECTOR,
    "foxglove.Quaternion": {**_VECTOR, "w": _NUMBER},
    "foxglove.Pose": {"position": "foxglove.Vector3", "orientation": "foxglove.Quaternion"},
    "foxglove.PoseInFrame": {"timestamp": _TIME, "frame_id": _TEXT, "pose": "foxglove.Pose"},
    "foxglove.Odometry": {
        **{"timestamp": _TIME, "frame_id": _TEXT, "child_frame_id": _TEXT},
        "pose": "foxglove.Pose",
        "linear_velocity": "foxglove.Vector3",
        "angular_velocity": "foxglove.Vector3",
    },
    "foxglove.LaserScan": {
        **{"timestamp": _TIME, "frame_id": _TEXT, "pose": "foxglove.Pose"},
        **{"start_angle": _NUMBER, "end_angle": _NUMBER},
        **{"ranges": [_NUMBER], "intensities": [_NUMBER]},
    },
    "foxglove.FrameTransform": {
        **{"timestamp": _TIME, "parent_frame_id": _TEXT, "child_frame_id": _TEXT},
        **{"translation": "foxglove.Vector3", "rotation": "foxglove.Quaternion"},
    },
    "foxglove.FrameTransforms": {"transforms": ["foxglove.FrameTransform"]},
    "foxglove.PosesInFrame": {"timestamp": _TIME, "frame_id": _TEXT, "poses": ["foxglove.Pose"]},
    "foxglove.LocationFix": {
        **{"timestamp": _TIME, "frame_id": _TEXT, "latitude": _NUMBER, "longitude": _NUMBER},
        **{"position_covariance": [_NUMBER], "position_covariance_type": _NUMBER},
    },
    "ros.geometry_msgs.Twist": {"linear": "foxglove.Vector3", "angular": "foxglove.Vector3"},
}


Message = tuple[float, str, str, dict[str, Any]]  # time (s), topic, type, values


def vector(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def turned(yaw_rad: float) -> dict[str, float]:
    return {**vector(z=float(np.sin(yaw_rad / 2))), "w": float(np.cos(yaw_rad / 2))}


def pose(x: float = 0.0, y: float = 0.0, yaw_rad: float = 0.0) -> dict[str, Any]:
    return {"position": vector(x, y), "orientation": turned(yaw_rad)}


def fix(time_s: float, std_m: float) -> dict[str, Any]:
    """As a satellite receiver says where the robot is, about 48 degrees north and 11 east."""
    x, y, _ = place(time_s)
    return {
        **{"timestamp": time_s, "frame_id": "gps", "position_covariance_type": 2},
        **{"latitude": 48 + y / 111_194.0, "longitude": 11 + x / 74_600.0},
        "position_covariance": np.diag([std_m**2] * 3).ravel().tolist(),
    }


def place(time_s: float) -> tuple[float, float, float]:
    """Where the robot is and which way it faces."""
    yaw, radius = YAW_RATE_RADPS * time_s, SPEED_MPS / YAW_RATE_RADPS
    return radius * np.sin(yaw), radius * (1 - np.cos(yaw)), (yaw + np.pi) % (2 * np.pi) - np.pi


def drive(duration_s: float = 20.0) -> list[Message]:
    """Return (time, topic, type, values): commands, scans at 10 Hz, poses, odometry at 20."""
    messages: list[Message] = []
    for time_s in np.arange(0, duration_s, 0.05).tolist():
        x, y, yaw = place(time_s)
        of = {"timestamp": time_s, "frame_id": "map", "pose": pose(x, y, yaw)}
        speeds = {
            "linear_velocity": vector(SPEED_MPS),
            "angular_velocity": vector(z=YAW_RATE_RADPS),
        }
        messages.append((time_s, "/pose", "foxglove.PoseInFrame", of))
        moving = {**of, "frame_id": "odom", "child_frame_id": "base_link", **speeds}
        messages.append((time_s, "/odom", "foxglove.Odometry", moving))
    for time_s in np.arange(0, duration_s, 0.1).tolist():
        reported = {"linear": vector(SPEED_MPS), "angular": vector(z=YAW_RATE_RADPS)}
        messages.append((time_s + 0.01, "/cmd_vel", "ros.geometry_msgs.Twist", reported))
        scan = {
            **{"timestamp": time_s, "frame_id": "laser", "pose": pose()},
            **{"start_angle": -FIELD_RAD / 2, "end_angle": FIELD_RAD / 2},
            **{"ranges": [WALL_M] * BEAMS, "intensities": []},
        }
        messages.append((time_s, "/scan", "foxglove.LaserScan", scan))
    return sorted(messages, key=lambda one: one[0])


def write_robot(path: Path, encoding: str, messages: list[Message]) -> Path:
    """Write an MCAP file of these messages, as "json" or "protobuf"."""
    files = _descriptors().SerializeToString()
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channels: dict[str, int] = {}
        for time_s, topic, kind, values in messages:
            if topic not in channels:
                form = ("jsonschema", json.dumps(_schema(kind)).encode())
                if encoding == "protobuf":
                    form = ("protobuf", files)
                schema = writer.register_schema(kind, *form)
                channels[topic] = writer.register_channel(topic, encoding, schema)
            if encoding == "json":
                payload = json.dumps(_json(kind, values)).encode()
            else:
                message = protobuf_type(kind, files).message_class()
                payload = _fill(message, kind, values).SerializeToString()
            log_ns = START_NS + round(time_s * 1e9) + 2_000_000
            writer.add_message(channels[topic], log_ns, payload, log_ns)
        writer.finish()
    return path


def _one(kind: Any) -> str:
    return str(kind[0] if isinstance(kind, list) else kind)


def _schema(kind: str) -> dict[str, Any]:
    if kind == _TIME:
        whole = {"type": "integer"}
        return {"type": "object", "properties": {"sec": whole, "nsec": whole}}
    if kind not in TYPES:
        return {"type": kind}
    fields = {
        name: {"type": "array", "items": _schema(_one(of))} if isinstance(of, list) else _schema(of)
        for name, of in TYPES[kind].items()
    }
    return {"title": kind, "type": "object", "properties": fields}


def _json(kind: str, value: Any) -> Any:
    if kind == _TIME:
        stamp_ns = START_NS + round(value * 1e9)
        return {"sec": stamp_ns // 10**9, "nsec": stamp_ns % 10**9}
    if kind not in TYPES:
        return value
    return {
        name: [_json(_one(of), one) for one in value[name]]
        if isinstance(of, list)
        else _json(of, value[name])
        for name, of in TYPES[kind].items()
    }


def _descriptors() -> FileDescriptorSet:
    files = build_file_descriptor_set(timestamp_pb2.Timestamp)
    for package in ("foxglove", "ros.geometry_msgs"):
        file = files.file.add(name=f"{package}.proto", package=package, syntax="proto3")
        file.dependency.append("google/protobuf/timestamp.proto")
        if package != "foxglove":
            file.dependency.append("foxglove.proto")
        for kind in (name for name in TYPES if name.rpartition(".")[0] == package):
            message = file.message_type.add(name=kind.rpartition(".")[2])
            for number, (name, of) in enumerate(TYPES[kind].items(), 1):
                part = _one(of)
                scalar = {_NUMBER: Field.TYPE_DOUBLE, _TEXT: Field.TYPE_STRING}.get(part)
                stamp = ".google.protobuf.Timestamp" if part == _TIME else f".{part}"
                message.field.add(
                    name=name,
                    number=number,
                    type=scalar or Field.TYPE_MESSAGE,
                    type_name=None if scalar else stamp,
                    label=Field.LABEL_REPEATED if isinstance(of, list) else Field.LABEL_OPTIONAL,
                )
    return files


def _fill(message: Any, kind: str, values: dict[str, Any]) -> Any:
    for name, of in TYPES[kind].items():
        value, part = values[name], _one(of)
        if part == _TIME:
            getattr(message, name).FromNanoseconds(START_NS + round(value * 1e9))
        elif isinstance(of, list) and part in TYPES:
            for one in value:
                _fill(getattr(message, name).add(), part, one)
        elif isinstance(of, list):
            getattr(message, name).extend(value)
        elif part in TYPES:
            _fill(getattr(message, name), part, value)
        else:
            setattr(message, name, value)
    return message
