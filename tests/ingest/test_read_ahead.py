"""Chunks that are decompressed on other threads give what they give in their turn."""

import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from restock.ingest.containers import mcap_file
from restock.ingest.containers.mcap_file import AHEAD, ChunkReader, McapFile

CHUNK = 4096
MESSAGES = 400


@pytest.fixture(autouse=True)
def small_groups(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcap_file, "GROUP_BYTES", 3 * CHUNK)
    monkeypatch.setattr(mcap_file, "cores", lambda: 2)


def write(path: Path, compression: CompressionType) -> Path:
    rng = np.random.default_rng(1)
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=CHUNK, compression=compression)
        writer.start()
        schema = writer.register_schema("a/msg/A", "ros2msg", b"int32 x")
        channels = [writer.register_channel(f"/{n}", "cdr", schema) for n in range(3)]
        for number in range(MESSAGES):
            data = rng.integers(0, 9, rng.integers(1, 900), np.uint8).tobytes()
            writer.add_message(channels[number % 3], number, data, number)
        writer.finish()
    return path


def content(path: Path, *, salvage: bool = False) -> tuple[list[object], list[object]]:
    """Every message as it comes, and what is said of the file afterwards."""
    file = McapFile(path, salvage=salvage)
    messages = [
        (channel, [bytes(one) for one in batch.payloads()], batch.log_time_ns.tolist())
        for channel, batch in file.batches(file.channels)
    ]
    reported = [(one.what, one.messages) for one in file.damage]
    file.close()
    return messages, [reported, file.notes, file.integrity]


def inflating() -> list[str]:
    return [one.name for one in threading.enumerate() if one.name.startswith("inflate")]


def spoilt(path: Path, every: int) -> Path:
    """Return the file with some of its chunks damaged."""
    file = McapFile(path)
    chunks = list(file._contents.chunks)
    file.close()
    data = bytearray(path.read_bytes())
    for chunk in chunks[1::every]:
        middle = (chunk.start + chunk.stop) // 2
        data[middle : middle + 8] = bytes(byte ^ 0xFF for byte in data[middle : middle + 8])
    path.write_bytes(data)
    return path


@pytest.fixture(params=[CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE])
def recording(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return write(tmp_path / "a.mcap", request.param)


def both(path: Path, monkeypatch: pytest.MonkeyPatch, **options: bool) -> Iterator[object]:
    for ahead in (True, False):
        monkeypatch.setattr(ChunkReader, "ahead", ahead)
        yield content(path, **options)


def test_the_messages_are_the_same_in_the_same_order(recording, monkeypatch):
    ahead, plain = both(recording, monkeypatch)
    assert ahead == plain
    messages, reported = ahead  # type: ignore[misc]
    assert sum(len(times) for _, _, times in messages) == MESSAGES
    assert reported == [[], [], "verified"]
    assert inflating() == []


def test_damage_is_told_in_the_same_words_and_order(recording, monkeypatch):
    ahead, plain = both(spoilt(recording, 4), monkeypatch)
    assert ahead == plain
    _, (damage, *_) = ahead  # type: ignore[misc]
    assert len(damage) > 4


def test_a_reader_that_stops_early_leaves_no_thread(recording: Path) -> None:
    file = McapFile(recording)
    batches = file.batches(file.channels)
    next(batches)
    assert 0 < len(inflating()) <= AHEAD
    batches.close()  # type: ignore[attr-defined]
    assert inflating() == []
    file.close()
