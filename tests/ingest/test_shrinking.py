"""Irregular files, and files that shrink while read, give a message, never a crash or silence."""

import os
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest
import zstandard
from mcap.writer import CompressionType
from support.bag_samples import write_bag, write_mcap
from support.shell import Shell

from restock.errors import RecordingError
from restock.ingest.containers.open_recording import open_recording

# Opens a recording, truncates it and reads it, in its own process, as a signal would end it.
SHRINK = """
import os, sys
from restock.errors import RecordingError
from restock.ingest.containers.open_recording import open_recording
with open_recording(sys.argv[1]) as recording:
    os.truncate(sys.argv[1], int(sys.argv[2]))
    try:
        columns = recording.read({topic: [] for topic in recording.topics})
        lost = sum(account.lost for account in recording.accounts.values())
        assert sum(map(len, columns.values())) + lost == recording.messages
        print("lost", lost, recording.lost_messages)
    except RecordingError as error:
        print("refused", error)
"""


@pytest.mark.parametrize("kind", ["chunks", "loose", "sqlite3"])
def test_recording_shrinking_while_read_is_reported(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    if kind == "sqlite3":
        path = next(write_bag(tmp_path / "run", 300).glob("*.db3"))
        with sqlite3.connect(path) as base:  # more than SQLite keeps in memory
            for _ in range(4):
                base.execute(
                    "INSERT INTO messages (topic_id, timestamp, data)"
                    " SELECT topic_id, timestamp, data FROM messages"
                )
        base.close()
    else:
        write_mcap(path, 300, compression=CompressionType.NONE, use_chunking=kind == "chunks")
    process = subprocess.run(
        [sys.executable, "-c", SHRINK, str(path), "20000"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert process.returncode == 0, process.stderr
    outcome, _, detail = process.stdout.partition(" ")
    assert outcome == ("lost" if kind == "sqlite3" else "refused")
    assert "shrank while it was read" in detail or int(detail.split()[0]) > 0


def test_pipe_is_rejected(tmp_path: Path, shell: Shell) -> None:
    pipe = tmp_path / "run.mcap"
    os.mkfifo(pipe)
    assert "a pipe, a socket or a device" in shell.err("info", pipe)
    assert "run.mcap: a pipe, a socket or a device" in shell.err("info", tmp_path / "*.mcap")
    with pytest.raises(RecordingError, match="a pipe"):
        open_recording(pipe)


def test_trailing_zeros_are_damage(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "run.mcap")
    with path.open("ab") as file:
        file.truncate(path.stat().st_size + (1 << 28))  # a sparse hole
    with open_recording(path) as recording:  # the zeros are after the recording's end
        assert recording.messages == 140
    content = path.open("rb").read(8000)
    path.write_bytes(content)
    with path.open("ab") as file:
        file.truncate(1 << 28)
    with pytest.raises(RecordingError, match="cut short or damaged"):
        open_recording(path)
    with open_recording(path, salvage=True) as recording:
        assert 20 < recording.messages < 140


def test_zeros_in_compressed_file_are_damage(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap.zstd"
    head = b"\x89MCAP0\r\n" + b"\x01" + (8).to_bytes(8, "little") + bytes(8)
    path.write_bytes(zstandard.ZstdCompressor().compress(head + bytes(1 << 20)))
    with pytest.raises(RecordingError, match="opcode 0"):
        open_recording(path)


@pytest.mark.long
def test_large_sqlite_blobs_are_read_one_by_one(tmp_path: Path) -> None:
    """Blobs of 60 MB are read; one of 300 MB is too large and counted as lost."""
    file = tmp_path / "run.db3"
    base = sqlite3.connect(file)
    base.executescript(
        "CREATE TABLE topics (id INTEGER PRIMARY KEY, name, type, serialization_format);"
        "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id, timestamp, data);"
        "INSERT INTO topics VALUES (1, '/t', 'std_msgs/msg/String', 'cdr')"
    )
    sizes = [9, 60 << 20, 60 << 20, 9, 60 << 20, 300 << 20, 60 << 20, 9]
    for stamp, size in enumerate(sizes):
        base.execute("INSERT INTO messages VALUES (NULL, 1, ?, zeroblob(?))", (stamp, size))
    base.commit()
    base.close()
    code = (
        "import re, sys\n"
        "from restock.ingest.containers.open_recording import open_recording\n"
        "with open_recording(sys.argv[1]) as recording:\n"
        "    (storage,) = recording._storages\n"
        "    for _, batch in storage.batches([1]):\n"
        "        print(*batch.log_time_ns.tolist())\n"
        "        del batch\n"
        "    print([loss.reason for loss in recording.lost_messages])\n"
        "    text = open('/proc/self/status').read()\n"
        "    print(int(re.search('VmHWM:\\\\s+([0-9]+)', text)[1]) // 1024)\n"
    )
    process = subprocess.run(
        [sys.executable, "-c", code, str(file)], capture_output=True, text=True, check=True
    )
    *stamps, reasons, peak_mb = process.stdout.splitlines()
    assert " ".join(stamps).split() == ["0", "1", "2", "3", "4", "6", "7"]
    assert reasons == "['row 6 is not read: its message of 314,572,800 bytes is too large']"
    assert int(peak_mb) < 450
