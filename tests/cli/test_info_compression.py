"""`restock info` of recordings that rosbag2 compressed: as whole files, or message by message."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import zstandard
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from support.bag_samples import STORE, TOPICS, compress_files, messages, write_bag, write_mcap

from restock import cli


def compressed_messages(folder: Path, storage: StoragePlugin) -> Path:
    """A bag whose messages are compressed one by one."""
    writer = Writer(folder, version=9, storage_plugin=storage)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer:
        connections = {
            topic: writer.add_connection(topic, kind, typestore=STORE)
            for topic, kind in TOPICS.items()
        }
        for topic, log, message in messages(20):
            writer.write(connections[topic], log, STORE.serialize_cdr(message, TOPICS[topic]))
    return folder


def described(capsys: pytest.CaptureFixture[str], path: Path) -> tuple[dict[str, Any], str]:
    """What `restock info` says of one recording: as JSON, and as text."""
    assert cli.main(["info", str(path), "--json"]) == 0
    (entry,) = json.loads(capsys.readouterr().out)["recordings"]
    assert cli.main(["info", str(path)]) == 0
    return entry, capsys.readouterr().out


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
@pytest.mark.parametrize("sized", [True, False], ids=["size in its head", "no size"])
def test_compressed_files_are_told_with_both_sizes(
    storage: str, sized: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = write_bag(tmp_path / "bag", storage=storage)
    (file,) = (one for one in bag.iterdir() if one.suffix != ".yaml")
    plain = file.stat().st_size
    if sized:
        packed = file.with_name(f"{file.name}.zstd")
        packed.write_bytes(zstandard.ZstdCompressor().compress(file.read_bytes()))
        file.unlink()
    else:
        compress_files(bag)
    stored = file.with_name(f"{file.name}.zstd").stat().st_size
    entry, text = described(capsys, bag)
    assert entry["compression"] == {
        "mode": "file",
        "format": "zstd",
        "number": 1,
        "stored_bytes": stored,
        "plain_bytes": plain,
    }
    share = f"{stored / plain:.0%} of {plain / 1e3:.1f} kB"
    assert f"1 file compressed with zstd: {stored / 1e3:.1f} kB, {share}\n" in text
    assert "0.0 MB" not in text
    entry, _ = described(capsys, file.with_name(f"{file.name}.zstd"))
    assert entry["compression"]["plain_bytes"] == plain


@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
@pytest.mark.parametrize("with_metadata", [True, False])
def test_compressed_messages_are_told_with_both_sizes(
    storage: StoragePlugin,
    with_metadata: bool,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    bag = compressed_messages(tmp_path / "bag", storage)
    if not with_metadata:
        (bag / "metadata.yaml").unlink()
    entry, text = described(capsys, bag)
    found = entry["compression"]
    sizes = [len(STORE.serialize_cdr(one, TOPICS[topic])) for topic, _, one in messages(20)]
    assert (found["mode"], found["number"], found["plain_bytes"]) == ("message", 140, sum(sizes))
    assert found["stored_bytes"] > 0
    assert "140 messages compressed with zstd: " in text


def test_without_compression_none_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in (write_bag(tmp_path / "bag"), write_mcap(tmp_path / "one.mcap")):
        entry, text = described(capsys, path)
        assert entry["compression"] is None
        assert "compressed with" not in text


def test_equal_names_of_metadata_records_are_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from mcap.writer import Writer as McapWriter

    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        for name in ("rosbag2", "site", "rosbag2"):
            writer.add_metadata(name, {"a": "b"})
        writer.finish()
    _, text = described(capsys, path)
    assert "metadata records, 3: rosbag2 (2), site\n" in text
