"""Hostile files are rejected or counted as lost, without crash, hang or unbounded memory."""

import io
import json
import os
import resource
import sqlite3
import struct
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
import zstandard
from mcap.writer import CompressionType, Writer
from support.bag_samples import write_bag, write_channels, write_mcap
from support.driven_robot import Drive
from support.driven_robot import write_bag as write_drive
from support.long import one_in

from restock.cli import main
from restock.errors import RecordingError, visible
from restock.ingest.containers import recording
from restock.ingest.containers.open_recording import open_recording
from restock.ingest.decoding.columns import CannotDecode, Channel
from restock.ingest.decoding.definitions import message_type
from restock.replay.store.store import Store

# -- sqlite: programs in place of tables ----------------------------------------------------------


def write_bag_and_run(folder: Path, script: str) -> Path:
    """Write a bag, run an SQL script on it, and return its file."""
    file = next(write_bag(folder / "run", 2).glob("*.db3"))
    base = sqlite3.connect(file)
    base.executescript(script)
    base.close()
    return file


SCRIPTS = {
    "ALTER TABLE messages RENAME TO m; CREATE VIEW messages AS WITH RECURSIVE n(id) AS"
    " (SELECT 1 UNION ALL SELECT id + 1 FROM n) SELECT id, 1 AS topic_id,"
    " id AS timestamp, zeroblob(1000000) AS data FROM n": "messages is not a plain table",
    "DROP TABLE messages; CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER,"
    " timestamp INTEGER, data BLOB AS (zeroblob(900000000)));"
    "INSERT INTO messages (topic_id, timestamp) VALUES (1, 1)": "messages has computed columns",
    "DROP TABLE messages": "no such table",
    "ALTER TABLE messages RENAME COLUMN data TO datum": "no such column",
    "DROP TABLE messages; DROP TABLE topics": "not a rosbag2 recording",
}


@pytest.mark.parametrize("script", SCRIPTS)
def test_sqlite_files_without_plain_tables_are_rejected(script, tmp_path):
    with pytest.raises(RecordingError, match=SCRIPTS[script]):
        open_recording(write_bag_and_run(tmp_path, script))


def test_sqlite_values_of_wrong_type_are_counted(tmp_path):
    file = write_bag_and_run(
        tmp_path,
        "UPDATE messages SET timestamp = 'noon' WHERE id = 1;"
        "UPDATE messages SET timestamp = 1.5 WHERE id = 2;"
        "UPDATE messages SET data = CAST(x'ff' AS TEXT) WHERE id = 3;"
        "UPDATE messages SET data = '' WHERE id = 4;"
        "UPDATE messages SET data = 17 WHERE id = 5;",
    )
    with open_recording(file) as recording:
        recording.read({topic: recording.leaves(topic) for topic in recording.topics})
        assert sum(account.decoded for account in recording.accounts.values()) == 14 - 5
        assert sum(account.lost for account in recording.accounts.values()) == 5
        assert recording.span_ns is not None


def test_sqlite_tree_with_repeated_pages_is_rejected(tmp_path):
    """Interior pages refer to the same child repeatedly: a few kB would give 10^14 rows."""
    file = tmp_path / "loop.db3"
    base = sqlite3.connect(file)
    base.executescript(
        "PRAGMA page_size = 512;"
        "CREATE TABLE topics (id INTEGER PRIMARY KEY, name, type, serialization_format);"
        "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id, timestamp, data);"
        "INSERT INTO topics VALUES (1, '/t', 'std_msgs/msg/Bool', 'cdr')"
    )
    base.executemany(
        "INSERT INTO messages VALUES (?, 1, 5, x'0001000001')", [(n,) for n in range(5000)]
    )
    base.commit()
    (root,) = base.execute("SELECT rootpage FROM sqlite_master WHERE name = 'messages'").fetchone()
    base.close()
    content = bytearray(file.read_bytes())

    def pointers(page: int) -> list[int]:
        """Return the offsets of an interior page's child page numbers."""
        at = (page - 1) * 512
        assert content[at] == 5
        count = int.from_bytes(content[at + 3 : at + 5], "big")
        cells = [
            int.from_bytes(content[at + 12 + 2 * n : at + 14 + 2 * n], "big") for n in range(count)
        ]
        return [at + 8, *(at + cell for cell in cells)]

    first = int.from_bytes(content[pointers(root)[1] : pointers(root)[1] + 4], "big")
    page = bytes(content[(first - 1) * 512 : first * 512])
    pages = len(content) // 512
    for level in range(7):  # a chain of pages: all children of a page are the next page
        content += page
        for at in pointers(pages + 1 + level):
            child = first if level == 6 else pages + 2 + level
            content[at : at + 4] = child.to_bytes(4, "big")
    for at in pointers(root):
        content[at : at + 4] = (pages + 1).to_bytes(4, "big")
    content[28:32] = (len(content) // 512).to_bytes(4, "big")
    file.write_bytes(content)
    with pytest.raises(RecordingError, match=r"out of order|2nd reference"):
        open_recording(file)
    with open_recording(file, salvage=True) as recording:  # each page is read once
        assert recording.messages <= 5000


# -- memory and time, in a process with little memory ---------------------------------------------

MEMORY_LIMIT_MB = 700  # imports alone take some 300 MB of address space


def run_limited(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python with at most MEMORY_LIMIT_MB of address space, for at most a minute."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_LIMIT_MB << 20, MEMORY_LIMIT_MB << 20))

    return subprocess.run(
        [sys.executable, *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
        preexec_fn=limit,
        env={"PATH": "/usr/bin:/bin", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def chunk(compression: bytes, stored: bytes, size: int) -> bytes:
    head = struct.pack("<QQQI", 1, 1, size, 0) + struct.pack("<I", len(compression)) + compression
    return record(6, head + struct.pack("<Q", len(stored)) + stored)


def mcap_of(*records: bytes) -> bytes:
    magic = b"\x89MCAP0\r\n"
    end = record(0x0F, bytes(4)) + record(2, bytes(20)) + magic
    return magic + record(1, bytes(8)) + b"".join(records) + end


def one_topic(
    kind: str, definition: bytes, payload: bytes, form: str = "ros2msg", encoding: str = "cdr"
) -> bytes:
    out = io.BytesIO()
    writer = Writer(out, compression=CompressionType.NONE)
    writer.start()
    schema = writer.register_schema(kind, form, definition)
    channel = writer.register_channel("/t", encoding, schema)
    writer.add_message(channel, 1, payload, 1)
    writer.finish()
    return out.getvalue()


def joined_definitions(*types: str) -> bytes:
    rule = "\n" + "=" * 80 + "\nMSG: "
    return rule.join(types).encode()


@cache
def zstd_bomb() -> bytes:
    """Return a thousand MiB of zeros, compressed."""
    pack = zstandard.ZstdCompressor().compressobj(size=1000 << 20)
    zeros = bytes(1 << 20)
    return b"".join(pack.compress(zeros) for _ in range(1000)) + pack.flush()


DEEP = joined_definitions(
    "pkg/T1 a", *(f"pkg/T{n}\npkg/T{n + 1} a" for n in range(1, 500)), "pkg/T500\nbool a"
)
WIDE = (
    joined_definitions(
        "pkg/T1 a\npkg/T1 b", *(f"pkg/T{n}\npkg/T{n + 1} a\npkg/T{n + 1} b" for n in range(1, 23))
    ).replace(b"T23", b"T1x")
    + b"\n"
    + b"=" * 80
    + b"\nMSG: pkg/T1x\nbool a"
)


def sequence_of_sequences(depth: int) -> bytes:
    """Return definitions whose every level repeats the next, so counts of 2^32 can multiply."""
    levels = (f"pkg/T{n}\npkg/T{n + 1}[] a" for n in range(1, depth))
    return joined_definitions("pkg/T1[] a", *levels, f"pkg/T{depth}\nuint8[] a")


HOSTILE: dict[str, tuple[Callable[[], bytes], str]] = {
    "zstd_file_bomb": (zstd_bomb, "refused"),
    "zstd_chunk_bomb": (
        lambda: mcap_of(chunk(b"zstd", zstd_bomb(), 1000 << 20)),
        "that claim to hold",
    ),
    "chunk_larger_than_declared": (
        lambda: mcap_of(chunk(b"zstd", zstd_bomb(), 100)),
        "more than it claims",
    ),
    "record_of_2^63_bytes": (
        lambda: mcap_of(struct.pack("<BQ", 6, 1 << 63)),
        "more than there are",
    ),
    "zstd_message_bomb": (
        lambda: one_topic("pkg/msg/T", b"uint8[] a", zstd_bomb()[: 1 << 16]),
        "",
    ),
    "definition_500_deep": (
        lambda: one_topic("pkg/msg/T", DEEP, bytes(9)),
        "nests deeper than",
    ),
    "definition_doubled_23_times": (
        lambda: one_topic("pkg/msg/T", WIDE, bytes(9)),
        "more than 20,000 fields",
    ),
    "array_of_2^31": (
        lambda: one_topic("pkg/msg/T", b"float64[2147483648] a", bytes(9)),
        "an array of 2,147,483,648",
    ),
    "nested_counts_of_2^32": (
        lambda: one_topic("pkg/msg/T", sequence_of_sequences(20), b"\0\1\0\0" + b"\xff" * 4000),
        "",
    ),
    "2^31_empty_elements": (
        lambda: one_topic(
            "pkg/msg/T",
            joined_definitions("pkg/E[] a", "pkg/E\n# nothing"),
            b"\0\1\0\0\xff\xff\xff\x7f" + bytes(64),
        ),
        "",
    ),
    "json_100000_deep": (
        lambda: one_topic("T", b"{}", b'{"a":' * 100_000, "jsonschema", "json"),
        "",
    ),
    "random_protobuf_definition": (
        lambda: one_topic("p.T", b"\x0a\xff\xff\xff\x0f" * 99, b"", "protobuf", "protobuf"),
        "cannot be parsed",
    ),
    "endless_metadata": (
        lambda: b"\x89MCAP0\r\n" + record(0x0C, bytes(8)) * 100_000,
        "its footer is missing",
    ),
}


@pytest.mark.parametrize("name", one_in(6, HOSTILE))
def test_hostile_files_are_read_in_little_memory(name, tmp_path):
    content_of, message = HOSTILE[name]
    path = tmp_path / "run.mcap"
    path.write_bytes(content_of())
    done = run_limited("-c", READ, str(path))
    assert "Traceback" not in done.stderr, done.stderr
    assert message in done.stdout + done.stderr
    *_, code, counted = done.stdout.split()
    assert (code, counted) in {("0", "1"), ("2", "-"), ("3", "-")}  # counted in any case


READ = """
import sys
from restock.cli import main
from restock.ingest.containers.open_recording import open_recording
code, counted = main(["info", sys.argv[1], "--json"]), "-"
if code == 0:
    with open_recording(sys.argv[1]) as recording:
        wanted = recording.leaves if len(sys.argv) == 2 else lambda topic: []
        recording.read({topic: wanted(topic) for topic in recording.topics})
        counted = sum(a.decoded + sum(a.reasons.values()) for a in recording.accounts.values())
print(code, counted)
"""


IDL = "module pkg {{ module msg {{ {} struct T {{ {} double x; }}; }}; }};"


@pytest.mark.parametrize(
    "text",
    [
        IDL.format("const uint8 N = " + "(" * 9 + "1" + ")" * 9 + ";", ""),
        IDL.format("", "sequence<" * 20 + "double" + ">" * 20 + " y;"),
        IDL.format('const string S = "' + "\\\\" * 99_999, ""),
        "/*" * 99_999 + "(",
    ],
)
def test_idl_with_exponential_parse_time_is_rejected(text):
    channel = Channel(1, "/t", "pkg/msg/T", "cdr", "ros2idl", text.encode())
    with pytest.raises(CannotDecode, match=r"nests brackets|cannot be parsed"):
        message_type(channel, "humble")


# -- metadata.yaml ------------------------------------------------------------------------------


BILLION_LAUGHS = "\n".join(
    f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" if n else "a0: &a0 [lol]" for n in range(30)
)


@pytest.mark.parametrize(
    "text",
    [
        BILLION_LAUGHS
        + "\nrosbag2_bagfile_information: {relative_file_paths: [*a29], version: *a29}",
        "rosbag2_bagfile_information: {topics_with_message_count: [{topic_metadata:"
        " {name: [1], serialization_format: [cdr]}, message_count: {}}]}",
        "rosbag2_bagfile_information: {relative_file_paths: ['', '..', '/', 'a\\0b', null]}",
        "rosbag2_bagfile_information: " + "[" * 300,
        "rosbag2_bagfile_information: !!python/object:os.system {}",
        "{" * 100 + "\x1b[2J",
        "\xff",
    ],
)
def test_invalid_metadata_is_ignored(text, tmp_path):
    bag = write_bag(tmp_path / "run", 2)
    (bag / "metadata.yaml").write_text(text, encoding="latin-1")
    with open_recording(bag) as recording:
        assert recording.messages == 14
        assert all("\x1b" not in note for note in recording.notes)


# -- the terminal ---------------------------------------------------------------------------

ESCAPES = "/t\x1b[2J\x07\n/other\u202egpj.\x9b31m"


def test_control_characters_are_escaped(tmp_path, capsys):
    path = tmp_path / "evil.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(ESCAPES, "ros2msg", f"pkg/{ESCAPES} a".encode())
        channel = writer.register_channel(ESCAPES, "cdr", schema)
        other = writer.register_channel(ESCAPES + "2", ESCAPES, 0)
        for number in (channel, other):
            writer.add_message(number, 1, b"", 1)
        writer.add_attachment(1, 1, ESCAPES, ESCAPES, b"")
        writer.add_metadata(ESCAPES, {})
        writer.finish()
    bag = write_bag(tmp_path / "run", 2)
    text = (bag / "metadata.yaml").read_text()
    escaped = json.dumps(ESCAPES)
    text = text.replace("name: /bumper", f"name: {escaped}").replace("run.db3", "gone\\e[2J.db3")
    (bag / "metadata.yaml").write_text(text)
    with sqlite3.connect(next(bag.glob("*.db3"))) as base:
        base.execute("UPDATE topics SET type = ? WHERE name = '/odom'", (ESCAPES,))
    base.close()
    odd = write_mcap(tmp_path / "a\x1b[2Jb.mcap", 2)
    assert main(["info", str(path), str(bag), str(odd), str(tmp_path / "no\x1b[2J")]) == 2
    assert main(["info", str(odd.rename(tmp_path / "b\x1b[2J.mcap")), "--json"]) == 0
    printed = capsys.readouterr()
    for text in (printed.out, printed.err):
        assert r"\x1b[2J" in text
        assert all(letter.isprintable() or letter == "\n" for letter in text)
    assert any(
        line.startswith(r" /t\x1b[2J\x07\n/other\u202e") for line in printed.out.splitlines()
    )


@pytest.mark.parametrize("storage", one_in(2, ["mcap", "sqlite3"]))
@pytest.mark.parametrize(
    "name", one_in(3, [b"a\x1b[2J\nb\xe2\x80\xaec", b"bad\xff", b"[red]caf\xc3\xa9 [b]"])
)
def test_unusual_file_names_are_ingested_and_escaped(name, storage, tmp_path, capsys, shell):
    bag = write_drive(Drive(2.0, truth="nominal"), tmp_path / "run", storage=storage)
    (file,) = bag.glob("run.*")
    odd = tmp_path / os.fsdecode(name)
    odd.mkdir()
    given = str(file.rename(odd / f"{odd.name}{file.suffix}"))
    store, profile = str(tmp_path / "store"), str(tmp_path / "new.toml")
    assert main(["ingest", given, "--store", store]) == 0
    assert main(["sql", store, "SELECT source_file FROM recordings"]) == 0
    assert main(["profile", "new", given, "--out", profile]) in (0, 3)
    printed = capsys.readouterr()
    for text in (printed.out, printed.err, Path(profile).read_text(encoding="utf-8")):
        assert all(letter.isprintable() or letter == "\n" for letter in text)
    with Store(store) as opened:
        recordings = opened.sql("FROM recordings").to_arrow_table().to_pylist()
        (steps,) = opened.sql("SELECT DISTINCT source_file FROM transitions").fetchall()
    assert steps == (visible(given),) == (recordings[0]["source_file"],)
    assert visible(given) in printed.out
    (row,) = shell.json("ingest", given, "--dry-run")["recordings"]
    assert row["path"] == given


@pytest.mark.long
def test_zstd_messages_are_decompressed_in_batches(tmp_path):
    """Read ninety messages of 8 MiB from a few kB, in a process that cannot hold them all."""
    packed = zstandard.ZstdCompressor().compress(
        b"\0\1\0\0" + (8 << 20).to_bytes(4, "little") + bytes(8 << 20)
    )
    channel = ("/t", "cdr", "pkg/msg/T", "ros2msg", b"uint8[] a", [packed] * 90)
    path = write_channels(tmp_path / "run.mcap", channel)
    done = run_limited("-c", READ, str(path), "no field")
    assert done.stdout.split()[-2:] == ["0", "90"], done.stderr


@pytest.mark.long
def test_total_size_of_definitions_is_limited(tmp_path, monkeypatch):
    """Read thirty different definitions of 40 kB with a tenth of the limit."""
    monkeypatch.setattr(recording, "MAX_DEFINED_BYTES", recording.MAX_DEFINED_BYTES // 10)
    texts = [f"bool data\n# {n}\n".encode() + b"# nothing\n" * 4_000 for n in range(30)]
    channels = (
        (f"/t{number:02}{twin}", "cdr", "pkg/msg/T", "ros2msg", text, [b"\0\1\0\0\1"])
        for number, text in enumerate(texts)
        for twin in "ab"  # a repeated definition costs nothing
    )
    with open_recording(write_channels(tmp_path / "run.mcap", *channels)) as opened:
        skipped = [name for name, topic in opened.topics.items() if topic.skipped]
        assert skipped == [f"/t{number:02}{twin}" for number in range(20, 30) for twin in "ab"]
        assert "more than 838,860 bytes" in str(opened.topics["/t29a"].skipped)
