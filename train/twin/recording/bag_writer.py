"""Write recordings, as an MCAP file or a rosbag2 folder, and serialise their messages.

Both are written whole or not at all: under a temporary name beside the target, which is renamed at
the end, or removed if anything (Ctrl-C included) stops the writing. The same messages give the same
bytes, wherever and whenever they are written.

rosbags serialises one exemplar of a message. Further messages of the same shape differ from it only
in numbers at fixed places. `Exemplar` finds these places by CDR's alignment rules and writes
columns directly into copies of its bytes, tens of times faster than building and serialising
messages one by one. Messages whose shape changes (texts, markers) go through rosbags
one by one.
"""

from __future__ import annotations

import functools
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from numpy.typing import NDArray
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.rosbag2.metadata import dump_qos_v9
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore
from ruamel.yaml import YAML

from restock.errors import RecordingError

Format = Literal["mcap", "rosbag2"]
TAGS_RECORD = "tags"  # name of the metadata record of an MCAP file
CHUNK_BYTES = 2 << 20  # about twenty seconds of one robot: cheap to seek, and compresses well


@dataclass(frozen=True)
class Topic:
    """A topic to record, with its publisher's QoS."""

    name: str
    type_name: str  # package/msg/Type
    latched: bool = False  # transient local: a late subscriber gets the last message
    reliable: bool = True


@dataclass(frozen=True)
class Message:
    """A serialised message: received at `log_ns`, sent at `publish_ns`."""

    log_ns: int
    publish_ns: int
    topic: str
    data: bytes


class Sink(Protocol):
    """A writer that takes messages in the order of their log times."""

    def write(self, messages: Sequence[Message]) -> None: ...

    def close(self) -> None: ...

    def abort(self) -> None: ...


@contextmanager
def recording_sink(
    path: Path, file_format: Format, topics: Sequence[Topic], tags: Mapping[str, str] | None = None
) -> Iterator[Sink]:
    """Open a sink that becomes `path` if the block ends well, and leaves nothing if it fails.

    `tags` (robot, site, …) go into an MCAP file's metadata or a rosbag2 folder's custom_data.

    Raises:
        RecordingError: `path` exists, or its folder cannot be written to.
    """
    refuse_existing(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        scratch = Path(mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    except OSError as error:
        raise RecordingError(
            f"cannot write here: {error.strerror}",
            where=str(path.parent),
            remedy="choose another --out",
        ) from error
    try:
        # A bag's database is named after its folder, so the temporary folder has the final name.
        partial = scratch / path.name
        sink: Sink = (McapSink if file_format == "mcap" else Rosbag2Sink)(
            partial, topics, tags or {}
        )
        try:
            yield sink
            sink.close()
        except BaseException:
            sink.abort()
            raise
        refuse_existing(path)
        partial.rename(path)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def refuse_existing(path: Path) -> None:
    """Raise RecordingError if anything exists at `path`."""
    if path.exists() or path.is_symlink():
        raise RecordingError(
            "it already exists, and recordings are never overwritten",
            where=str(path),
            remedy="choose another --out, or remove it",
        )


class McapSink:
    """An MCAP file, profile ros2: zstd chunks with CRCs and message indexes, `ros2msg` schemas."""

    def __init__(self, path: Path, topics: Sequence[Topic], tags: Mapping[str, str]) -> None:
        self._stream = path.open("wb")
        self._writer = McapWriter(
            self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD
        )
        self._writer.start(profile="ros2", library="restock")
        if tags:  # first, so that a file that is cut short has them too
            self._writer.add_metadata(TAGS_RECORD, dict(sorted(tags.items())))
        schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._sequence = dict.fromkeys((topic.name for topic in topics), 0)
        for topic in topics:
            name = topic.type_name
            if name not in schemas:
                definition, _ = typestore().generate_msgdef(name, ros_version=2)
                schemas[name] = self._writer.register_schema(name, "ros2msg", definition.encode())
            self._channels[topic.name] = self._writer.register_channel(
                topic.name,
                "cdr",
                schemas[name],
                {
                    "offered_qos_profiles": _qos_yaml(topic),
                    "topic_type_hash": typestore().hash_rihs01(name),
                },
            )

    def write(self, messages: Sequence[Message]) -> None:
        for message in messages:
            sequence = self._sequence[message.topic]
            self._sequence[message.topic] = sequence + 1
            self._writer.add_message(
                self._channels[message.topic],
                message.log_ns,
                message.data,
                message.publish_ns,
                sequence,
            )

    def close(self) -> None:
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.close()

    def abort(self) -> None:
        self._stream.close()


class Rosbag2Sink:
    """A rosbag2 folder: metadata.yaml (version 9) and one sqlite3 file with its definitions.

    This storage keeps only the time at which a message was received, not `publish_ns`.
    """

    def __init__(self, path: Path, topics: Sequence[Topic], tags: Mapping[str, str]) -> None:
        self._path = path
        self._writer = Rosbag2Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3)
        for name, value in sorted(tags.items()):
            self._writer.set_custom_data(name, value)
        self._writer.open()
        self._connections: dict[str, Connection] = {
            topic.name: self._writer.add_connection(
                topic.name,
                topic.type_name,
                typestore=typestore(),
                offered_qos_profiles=[_qos(topic)],
            )
            for topic in topics
        }

    def write(self, messages: Sequence[Message]) -> None:
        for message in messages:
            self._writer.write(self._connections[message.topic], message.log_ns, message.data)

    def close(self) -> None:
        self._writer.close()
        _forget_sqlite_version(self._path / f"{self._path.name}.db3")

    def abort(self) -> None:
        self._writer.abort()


def _forget_sqlite_version(database: Path) -> None:
    """Set the header's version of the SQLite library to a constant, for reproducible bytes.

    SQLite itself does not use it (https://sqlite.org/fileformat2.html#the_database_header), but
    because of it the same bag would differ from one machine to the next.
    """
    with database.open("r+b") as stream:
        stream.seek(96)
        stream.write((3_040_000).to_bytes(4, "big"))


_SENSOR_DEPTH = 10


def _qos(topic: Topic) -> Qos:
    unlimited = QosTime(9223372036, 854775807)
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=1 if topic.latched else _SENSOR_DEPTH,
        reliability=QosReliability.RELIABLE if topic.reliable else QosReliability.BEST_EFFORT,
        durability=QosDurability.TRANSIENT_LOCAL if topic.latched else QosDurability.VOLATILE,
        deadline=unlimited,
        lifespan=unlimited,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=unlimited,
        avoid_ros_namespace_conventions=False,
    )


def _qos_yaml(topic: Topic) -> str:
    """Return a QoS profile as rosbag2's MCAP storage writes it into a channel's metadata."""
    text = StringIO()
    YAML().dump(dump_qos_v9([_qos(topic)]), text)
    return text.getvalue()


ENCAPSULATION_BYTES = 4  # a header; alignment counts from the byte after it
_BASIC = {
    "bool": "u1", "byte": "u1", "octet": "u1", "char": "u1", "uint8": "u1", "int8": "i1",
    "uint16": "<u2", "int16": "<i2", "uint32": "<u4", "int32": "<i4", "uint64": "<u8",
    "int64": "<i8", "float32": "<f4", "float64": "<f8",
}  # fmt: skip
_TIME = "builtin_interfaces/msg/Time"


@functools.cache
def typestore() -> Typestore:
    """Return the message definitions of every recording Restock writes: ROS 2 Jazzy's."""
    return get_typestore(Stores.ROS2_JAZZY)


def build(type_name: str, /, **fields: Any) -> Any:
    """Build a message of `type_name`: every field zero, empty or identity, except `fields`.

    A dict for a field that is itself a message fills that message in the same way.
    """
    definition = typestore().fielddefs[type_name][1]
    unknown = fields.keys() - {name for name, _ in definition}
    if unknown:
        raise TypeError(f"{type_name} has no field {sorted(unknown)}")
    values = {name: _value(kind, details, fields.get(name)) for name, (kind, details) in definition}
    return typestore().types[type_name](**values)


def serialise(message: Any) -> bytes:
    """Serialise one message as little-endian CDR with its encapsulation header."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


class Place(NamedTuple):
    """The position of a number (or a run of them) in the serialised message."""

    offset: int
    dtype: np.dtype[Any]
    size: int  # how many numbers


class Exemplar:
    """A message, from which others with its strings and sequence lengths are packed.

    Numbers are named by path: `pose.pose.position.x`, `ranges` (the whole run),
    `transforms[0].header.stamp` (a time is one place: int64 nanoseconds). When packing, `[]` stands
    for every item: `poses[].pose.position.x`.
    """

    def __init__(self, type_name: str, /, **fields: Any) -> None:
        self._type_name, self._fields = type_name, fields

    @functools.cached_property
    def layout(self) -> tuple[bytes, Mapping[str, Place]]:
        """Return the message's bytes and the places in them; typestores are slow to build."""
        message = build(self._type_name, **self._fields)
        places: dict[str, Place] = {}
        data = serialise(message)
        end = _walk(message, "", ENCAPSULATION_BYTES, places)
        if end != len(data):  # rosbags and this file disagree about CDR: never write such bytes
            raise ValueError(f"{self._type_name}: walked {end} of {len(data)} bytes")
        return data, places

    def pack(self, columns: Mapping[str, NDArray[Any]]) -> list[bytes]:
        """Pack a message per row of the columns, of which there is at least one.

        Each column is (rows,), or (rows, count) for a run and for `[]`.
        """
        data, places = self.layout
        rows, size = len(next(iter(columns.values()))), len(data)
        table = np.tile(np.frombuffer(data, np.uint8), (rows, 1))  # (rows, bytes)
        for path, column in columns.items():
            offsets, dtype = _slots(places, path)
            values = np.asarray(column)
            values = split_stamps(values) if dtype == _STAMP else values.astype(dtype)
            raw = np.ascontiguousarray(values).view(np.uint8)
            where = offsets[:, None] + np.arange(dtype.itemsize)
            table[:, where.ravel()] = raw.reshape(rows, where.size)
        whole = table.tobytes()
        return [whole[start : start + size] for start in range(0, len(whole), size)]


def _slots(places: Mapping[str, Place], path: str) -> tuple[NDArray[np.intp], np.dtype[Any]]:
    """Return the offset of every number at a path, and their type."""
    if "[]" not in path:
        offset, dtype, size = places[path]
        return offset + dtype.itemsize * np.arange(size), dtype
    before, after = path.split("[]")
    found: list[Place] = []
    while (place := places.get(f"{before}[{len(found)}]{after}")) is not None:
        found.append(place)
    return np.array([place.offset for place in found]), found[0].dtype


_STAMP = np.dtype([("sec", "<i4"), ("nanosec", "<u4")])


def split_stamps(stamp_ns: NDArray[Any]) -> NDArray[Any]:
    """Convert nanoseconds (…) int64 to `builtin_interfaces/Time` records of the same shape."""
    stamps = np.empty(stamp_ns.shape, _STAMP)
    stamps["sec"], stamps["nanosec"] = np.divmod(stamp_ns, 1_000_000_000)
    return stamps


def stamp(stamp_ns: int) -> Any:
    """Return one `builtin_interfaces/Time`."""
    sec, nanosec = divmod(int(stamp_ns), 1_000_000_000)
    return typestore().types[_TIME](sec=sec, nanosec=nanosec)


def _walk(message: Any, prefix: str, at: int, places: dict[str, Place]) -> int:
    """Write into `places` where a message's fields lie from byte `at` on; return the byte after."""
    if message.__msgtype__ == _TIME:
        at = _align(at, 4)
        places[prefix.removesuffix(".")] = Place(at, _STAMP, 1)
        return at + 8
    for name, (kind, details) in typestore().fielddefs[message.__msgtype__][1]:
        at = _walk_field(getattr(message, name), f"{prefix}{name}", kind, details, at, places)
    return at


def _walk_field(
    value: Any, path: str, kind: Any, details: Any, at: int, places: dict[str, Place]
) -> int:
    match kind.name:
        case "BASE" if details[0] == "string":
            return _align(at, 4) + 4 + len(value.encode()) + 1
        case "BASE":
            dtype = np.dtype(_BASIC[details[0]])
            at = _align(at, dtype.itemsize)
            places[path] = Place(at, dtype, 1)
            return at + dtype.itemsize
        case "NAME":
            return _walk(value, f"{path}.", at, places)
    (item_kind, item_details), _ = details  # an array or a sequence
    if kind.name == "SEQUENCE":
        at = _align(at, 4) + 4
    if item_kind.name == "BASE" and item_details[0] != "string":
        dtype = np.dtype(_BASIC[item_details[0]])
        if len(value):  # an empty sequence takes no padding
            at = _align(at, dtype.itemsize)
            places[path] = Place(at, dtype, len(value))
        return at + dtype.itemsize * len(value)
    for index, item in enumerate(value):
        at = _walk_field(item, f"{path}[{index}]", item_kind, item_details, at, places)
    return at


def _align(at: int, size: int) -> int:
    return at + (-(at - ENCAPSULATION_BYTES)) % size


def _value(kind: Any, details: Any, given: Any) -> Any:
    """Return a field's given value in the type rosbags expects, or the field's empty value."""
    if kind.name == "NAME":
        if given is None or isinstance(given, Mapping):
            defaults = {"w": 1.0} if details.endswith("/Quaternion") else {}
            return build(details, **{**defaults, **(given or {})})
        return given
    if kind.name == "BASE":
        if details[0] == "string":
            return given or ""
        return given if given is not None else (False if details[0] == "bool" else 0)
    (item_kind, item_details), length = details
    if item_kind.name == "BASE" and item_details[0] != "string":
        dtype = np.bool_ if item_details[0] == "bool" else np.dtype(_BASIC[item_details[0]])
        size = length if kind.name == "ARRAY" else 0
        return np.zeros(size, dtype) if given is None else np.asarray(given, dtype)
    items: Sequence[Any] = given if given is not None else ()
    return [_value(item_kind, item_details, item) for item in items]
