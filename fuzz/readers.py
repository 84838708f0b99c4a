"""Fuzzing the readers and decoders: bytes nobody wrote must end in columns or in a clear refusal.

    python fuzz/readers.py --minutes 60          # coverage-guided, with `pip install atheris`
    python fuzz/readers.py --again INPUT …       # what one input does, with its stack trace

Without atheris the seeds are mutated blindly, which finds less. An input is a finding where
anything but a `RestockError` (or a topic that says why it cannot be decoded) comes of it, where
the account of a topic does not add up, where the columnar decoder and rosbags disagree about a
message that both can read, or where it takes too long or too much memory. Each kind of finding is
kept once, in --out; the exit code is 1 where there was any.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import os
import random
import resource
import sqlite3
import struct
import subprocess
import sys
import tempfile
import time
import traceback
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

try:
    import atheris
except ImportError:
    atheris = None

with (
    atheris.instrument_imports(include=["restock.ingest"]) if atheris else contextlib.nullcontext()
):
    import numpy as np
    import zstandard
    from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet
    from mcap.writer import CompressionType, IndexType, Writer
    from rosbags.rosbag1 import Writer as Ros1Writer
    from rosbags.typesys import Stores, get_typestore

    from restock.errors import RestockError
    from restock.ingest.cdr import ColumnDecoder
    from restock.ingest.columns import Batch, equal, take
    from restock.ingest.decoders import decoder_of, type_of
    from restock.ingest.describe import describe
    from restock.ingest.fields import CannotDecode
    from restock.ingest.readers import open_recording
    from restock.ingest.rows import RowDecoder
    from restock.ingest.storage import Channel

LONGEST_INPUT = 1 << 14
SECONDS_EACH = 30
MEMORY_MB = 3000  # of one process: imports take some 500, an input may take the rest
MOST_LEAVES = 200  # of a topic that are read: a definition may have thousands

Target = Callable[[bytes], None]


class Wrong(Exception):
    """What came of an input does not add up."""


def require(holds: bool, what: str) -> None:
    if not holds:
        raise Wrong(what)


# -- targets ----------------------------------------------------------------------------------


def recording(data: bytes) -> None:
    """A file of any kind. The first byte's lowest bit says whether to salvage."""
    with tempfile.TemporaryDirectory(dir=_memory()) as folder:
        path = Path(folder) / "input"
        path.write_bytes(data[1:])
        _read(path, salvage=bool(data[:1] > b"\x7f"))


def metadata(data: bytes) -> None:
    """A bag's folder, with this metadata.yaml."""
    with tempfile.TemporaryDirectory(dir=_memory()) as folder:
        path = Path(folder) / "bag"
        path.mkdir()
        (path / "bag_0.mcap").write_bytes(_small_mcap())
        (path / "metadata.yaml").write_bytes(data)
        _read(path, salvage=False)


def _read(path: Path, *, salvage: bool) -> None:
    try:
        describe(path, salvage=salvage)
        with open_recording(path, salvage=salvage) as opened:
            wanted = {topic: opened.leaves(topic)[:MOST_LEAVES] for topic in opened.topics}
            found = opened.read(wanted)
            for topic, account in opened.accounts.items():
                said = account.decoded + sum(account.reasons.values())
                require(said >= account.expected, f"messages went missing: {account}")
                if topic in found:
                    columns = found[topic]
                    require(len(columns) == account.decoded, "as many rows as were decoded")
                    require(bool((np.diff(columns.log_time_ns) >= 0).all()), "in order")
                    for path_, column in columns.fields.items():
                        require(len(column) == len(columns), f"as many rows in {path_}")
            json.dumps([opened.integrity, *(loss.reason for loss in opened.losses)])
    except RestockError:
        pass


def cdr(data: bytes) -> None:
    """A ROS 2 definition and messages of it, beside rosbags."""
    definition, payloads = _parts(data)
    form = "ros2idl" if definition.startswith(b"module") else "ros2msg"
    _beside_rosbags("cdr", form, definition, payloads)


def ros1(data: bytes) -> None:
    """A ROS 1 definition and messages of it, beside rosbags."""
    definition, payloads = _parts(data)
    _beside_rosbags("ros1", "ros1msg", definition, payloads)


def _beside_rosbags(encoding: str, form: str, definition: bytes, payloads: list[bytes]) -> None:
    channel = Channel(1, "/t", "pkg/msg/T", encoding, form, definition)
    batch = Batch.of(payloads, range(len(payloads)), range(len(payloads)))
    try:
        kind = type_of(channel, "humble", lambda: payloads)
        leaves = kind.leaves()[:MOST_LEAVES]
        ours = decoder_of(channel, kind, leaves)
        theirs = RowDecoder(kind, leaves, ros1=encoding == "ros1")  # type: ignore[arg-type]
    except CannotDecode:
        return
    require(isinstance(ours, ColumnDecoder), "columns")
    left, right = ours.decode(batch), theirs.decode(batch)
    require(len(left.rows) + sum(left.bad.values()) == len(batch), "every message is counted")
    both = np.intersect1d(left.rows, right.rows)
    for leaf in leaves:
        one = take(left.fields[leaf.path], np.searchsorted(left.rows, both))
        other = take(right.fields[leaf.path], np.searchsorted(right.rows, both))
        require(equal(one, other), f"{leaf.path} is not what rosbags reads")


def json_messages(data: bytes) -> None:
    """A JSON Schema and messages."""
    schema, payloads = _parts(data)
    _decode(Channel(1, "/t", "T", "json", "jsonschema" if schema else "", schema), payloads)


def protobuf(data: bytes) -> None:
    """A FileDescriptorSet and messages."""
    definition, payloads = _parts(data)
    _decode(Channel(1, "/t", "p.T", "protobuf", "protobuf", definition), payloads)


def _decode(channel: Channel, payloads: list[bytes]) -> None:
    batch = Batch.of(payloads, range(len(payloads)), range(len(payloads)))
    try:
        kind = type_of(channel, "humble", lambda: payloads)
        decoder = decoder_of(channel, kind, kind.leaves()[:MOST_LEAVES])
    except CannotDecode:
        return
    found = decoder.decode(batch)
    require(len(found.rows) + sum(found.bad.values()) == len(batch), "every message is counted")
    for path, column in found.fields.items():
        require(len(column) == len(found.rows), f"as many rows in {path}")


def _parts(data: bytes) -> tuple[bytes, list[bytes]]:
    """A definition and payloads, each after its length in two bytes."""
    parts = []
    while len(data) >= 2:
        (length,) = struct.unpack_from("<H", data)
        parts.append(data[2 : 2 + length])
        data = data[2 + length :]
    return (parts[0], parts[1:]) if parts else (b"", [])


TARGETS: tuple[Target, ...] = (recording, cdr, ros1, json_messages, protobuf, metadata)


def examine(data: bytes) -> None:
    """Try one input: its first byte chooses the target.

    Raises:
        Exception: whatever is a finding.
    """
    if data:
        TARGETS[data[0] % len(TARGETS)](data[1:])


# -- seeds ------------------------------------------------------------------------------------

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
    from rosbags.typesys import get_types_from_msg

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


def _small_mcap() -> bytes:
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
        _small_mcap(),
        zstandard.ZstdCompressor().compress(_small_mcap()),
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


# -- running ----------------------------------------------------------------------------------


def _memory() -> str | None:
    """Where files cost no disk."""
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None


class Findings:
    """What was found, each kind once."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def keep(self, data: bytes, error: BaseException) -> None:
        """Write the input and its stack trace, if it is of a kind not seen before."""
        frames = traceback.extract_tb(error.__traceback__)
        ours = [frame for frame in frames if "ingest" in Path(frame.filename).parts]
        place = (ours or frames)[-1]
        kind = f"{type(error).__name__} {Path(place.filename).name} {place.name} {place.lineno}"
        name = f"{zlib.crc32(kind.encode()):08x}"
        if (self.folder / name).exists():
            return
        (self.folder / name).write_bytes(data)
        (self.folder / f"{name}.txt").write_text("".join(traceback.format_exception(error)))
        sys.stderr.write(f"found {name}: {kind}: {str(error)[:200]!r}\n")

    def count(self) -> int:
        """How many kinds there are."""
        return sum(1 for item in self.folder.iterdir() if not item.suffix)


def fuzz(corpus: Path, out: Path, seconds: int) -> None:
    """One process' share of the work; does not return where atheris runs it."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_MB << 20, MEMORY_MB << 20))
    findings = Findings(out)

    def one(data: bytes) -> None:
        try:
            examine(data)
        except Exception as error:  # noqa: BLE001 - anything else is what is looked for
            findings.keep(data, error)

    if atheris:
        options = [f"-max_total_time={seconds}", f"-timeout={SECONDS_EACH}", "-rss_limit_mb=0"]
        options += [f"-max_len={LONGEST_INPUT}", f"-artifact_prefix={out}/", "-print_final_stats=1"]
        atheris.Setup([sys.argv[0], *options, str(corpus)], one, internal_libfuzzer=True)
        atheris.Fuzz()
    rng = random.Random(time.time_ns())
    known = [item.read_bytes() for item in sorted(corpus.iterdir())]
    end, count = time.monotonic() + seconds, 0
    while time.monotonic() < end:
        one(mutated(rng, known))
        count += 1
    sys.stderr.write(f"stat::number_of_executed_units: {count}\n")


def mutated(rng: random.Random, known: list[bytes]) -> bytes:
    """One of the known inputs with a few bytes changed, cut out or repeated."""
    data = bytearray(rng.choice(known))
    for _ in range(rng.randint(1, 8)):
        at = rng.randrange(1, len(data)) if len(data) > 1 else 0
        length = min(rng.choice([1, 1, 2, 4, 8, 64]), len(data) - at)
        change = rng.randrange(4)
        if change == 0:
            data[at : at + length] = rng.randbytes(length)
        elif change == 1:
            data[at : at + length] = rng.choice([b"\0", b"\xff", b"\x7f", b"\1"]) * length
        elif change == 2:
            del data[at : at + length]
        else:
            data[at:at] = data[at : at + length]
    return bytes(data)


def run(corpus: Path, out: Path, minutes: float) -> int:
    """Fuzz in a process of its own, started again where one input ends it."""
    corpus.mkdir(parents=True, exist_ok=True)
    for seed in seeds():
        (corpus / hashlib.blake2b(seed, digest_size=8).hexdigest()).write_bytes(seed)
    findings = Findings(out)
    start = time.monotonic()
    while (left := minutes * 60 - (time.monotonic() - start)) > 1:
        command = [sys.executable, __file__, "--child", str(int(left))]
        command += ["--corpus", str(corpus), "--out", str(out)]
        code = subprocess.run(command, check=False).returncode
        if code:
            sys.stderr.write(f"a process ended with {code}; its input is in {out}\n")
    took = (time.monotonic() - start) / 60
    how = "coverage-guided" if atheris else "without coverage"
    sys.stdout.write(f"{took:.1f} minutes, {how}: {findings.count()} kinds of findings in {out}\n")
    return 1 if findings.count() else 0


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--minutes", type=float, default=10, help="how long (10)")
    place = Path(tempfile.gettempdir()) / "restock-fuzz"
    parser.add_argument(
        "--corpus", type=Path, default=place / "corpus", help="grows from run to run"
    )
    parser.add_argument(
        "--out", type=Path, default=place / "findings", help="inputs that were found"
    )
    parser.add_argument("--again", type=Path, nargs="+", help="try these inputs, and stop at one")
    parser.add_argument("--child", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.again:
        for path in options.again:
            examine(path.read_bytes())
            sys.stdout.write(f"{path}: nothing wrong\n")
        return 0
    if options.child:
        fuzz(options.corpus, options.out, options.child)
        return 0
    return run(options.corpus, options.out, options.minutes)


if __name__ == "__main__":
    sys.exit(main())
