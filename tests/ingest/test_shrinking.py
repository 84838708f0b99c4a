"""Files that are no files, or do not stay as they are: a message, never a crash or silence."""

from __future__ import annotations

import os
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest
import zstandard
from mcap.writer import CompressionType
from support.bag_samples import write_bag, write_mcap

from restock.cli import main
from restock.errors import RecordingError
from restock.ingest.containers.open_recording import open_recording

# Opens a recording, cuts it, and reads it: in a process of its own, as a signal would end it.
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
def test_a_recording_that_shrinks_while_it_is_read(kind: str, tmp_path: Path) -> None:
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
    done = subprocess.run(
        [sys.executable, "-c", SHRINK, str(path), "20000"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    said, _, why = done.stdout.partition(" ")
    assert said == ("lost" if kind == "sqlite3" else "refused")
    assert "shrank while it was read" in why or int(why.split()[0]) > 0


def test_a_pipe_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pipe = tmp_path / "run.mcap"
    os.mkfifo(pipe)
    assert main(["info", str(pipe)]) == 2
    assert "a pipe, a socket or a device" in capsys.readouterr().err
    assert main(["info", str(tmp_path / "*.mcap")]) == 2
    assert "is a recording" in capsys.readouterr().err
    with pytest.raises(RecordingError, match="a pipe"):
        open_recording(pipe)


def test_a_tail_of_zeros_is_damage(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "run.mcap")
    with path.open("ab") as file:
        file.truncate(path.stat().st_size + (1 << 30))  # a hole
    with open_recording(path) as recording:  # after the end of the recording
        assert recording.messages == 140
    content = path.open("rb").read(8000)
    path.write_bytes(content)
    with path.open("ab") as file:
        file.truncate(1 << 30)
    with pytest.raises(RecordingError, match="cut short or damaged"):
        open_recording(path)
    with open_recording(path, salvage=True) as recording:
        assert 20 < recording.messages < 140


def zeros(size: int) -> bytes:
    return zstandard.ZstdCompressor().compress(bytes(size))


def test_zeros_in_a_chunk_and_in_a_compressed_file_are_damage(tmp_path: Path) -> None:
    from restock.ingest.containers.mcap_chunk import walked_messages

    positions, cut = walked_messages(bytes(64 << 20))
    assert not positions
    assert cut == "zeros or noise, 67,108,864 bytes before its end"
    path = tmp_path / "run.mcap.zstd"
    head = b"\x89MCAP0\r\n" + b"\x01" + (8).to_bytes(8, "little") + bytes(8)
    path.write_bytes(zstandard.ZstdCompressor().compress(head + bytes(200 << 20)))
    with pytest.raises(RecordingError, match="opcode 0"):
        open_recording(path)


def test_small_records_without_end_are_refused(tmp_path: Path) -> None:
    record = b"\x80" + bytes(8)
    path = tmp_path / "run.mcap"
    head = b"\x89MCAP0\r\n" + b"\x01" + (8).to_bytes(8, "little") + bytes(8)
    path.write_bytes(head + record * 1_100_000)
    with pytest.raises(RecordingError, match="more than 1,000,000 records of no messages"):
        open_recording(path)
