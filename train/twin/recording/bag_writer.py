"""Writers of recordings: an MCAP file, or a rosbag2 folder with sqlite3 storage.

Both are written whole or not at all: under a temporary name beside the target, renamed at the
end, removed when anything (Ctrl-C included) stops the writing. The same messages give the same
bytes, wherever and whenever they are written.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import mkdtemp
from typing import Literal, Protocol

from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
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

from restock.errors import RecordingError
from restock.train.twin.recording.messages import typestore

Format = Literal["mcap", "rosbag2"]
TAGS_RECORD = "tags"  # name of the metadata record of an MCAP file
CHUNK_BYTES = 2 << 20  # some twenty seconds of one robot: still cheap to seek, and compresses well


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

    `tags` say whose drive it is, in an MCAP file's metadata or a rosbag2 folder's custom_data.

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
        # The bag's folder gives its database its name, so the temporary one has the final name.
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
        if tags:  # first, where a file that is cut short has it too
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

    This storage keeps one time a message, when it was received: `publish_ns` is not kept.
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
    """Fix the header's "version of the library that wrote last", so that bytes are reproducible.

    SQLite only shows it to people (https://sqlite.org/fileformat2.html#the_database_header); it
    would make the same bag differ from one machine to the next.
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
    qos = _qos(topic)
    lines = [
        f"- history: {qos.history.name.lower()}",
        f"  depth: {qos.depth}",
        f"  reliability: {qos.reliability.name.lower()}",
        f"  durability: {qos.durability.name.lower()}",
    ]
    for name in ("deadline", "lifespan"):
        time = getattr(qos, name)
        lines += [f"  {name}:", f"    sec: {time.sec}", f"    nsec: {time.nsec}"]
    lease = qos.liveliness_lease_duration
    lines += [
        f"  liveliness: {qos.liveliness.name.lower()}",
        "  liveliness_lease_duration:",
        f"    sec: {lease.sec}",
        f"    nsec: {lease.nsec}",
        "  avoid_ros_namespace_conventions: false",
    ]
    return "\n".join(lines) + "\n"
