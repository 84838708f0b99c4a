"""Readers: every container gives the same columns, and every loss is reported."""

import errno
import json
import shutil
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import pytest
import zstandard
from mcap.writer import CompressionType, IndexType, Writer
from ruamel.yaml import YAML
from support.bag_samples import (
    START_NS,
    TOPICS,
    assert_same_columns,
    compress_files,
    write_bag,
    write_mcap,
)
from support.paths import SHARED

from restock.cli import main
from restock.cli.data.info import describe_recording, parse_qos
from restock.errors import RecordingError
from restock.ingest.containers.open_recording import open_recording, recordings_in
from restock.ingest.containers.recording import Recording
from restock.ingest.decoding.columns import TopicColumns


def read_all(recording: Recording) -> dict[str, TopicColumns]:
    return recording.read({topic: recording.leaves(topic) for topic in recording.topics})


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_bag(tmp_path_factory.mktemp("bag") / "run")


@pytest.fixture(scope="module")
def mcap(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mcap(tmp_path_factory.mktemp("mcap") / "run.mcap")


# -- the conformance test: the same recording in every container gives the same columns ------

CONTAINERS = {
    "mcap, lz4": lambda d: write_mcap(d / "r.mcap", compression=CompressionType.LZ4),
    "mcap, not compressed": lambda d: write_mcap(d / "r.mcap", compression=CompressionType.NONE),
    "mcap, not chunked": lambda d: write_mcap(d / "r.mcap", use_chunking=False),
    "mcap, one chunk": lambda d: write_mcap(d / "r.mcap", chunk_size=1 << 20),
    "mcap, no message index": lambda d: write_mcap(d / "r.mcap", index_types=IndexType.NONE),
    "mcap, nothing repeated in the summary": lambda d: write_mcap(
        d / "r.mcap", repeat_channels=False, repeat_schemas=False, use_statistics=False
    ),
    "mcap, no statistics": lambda d: write_mcap(d / "r.mcap", use_statistics=False),
    "sqlite3 bag": lambda d: write_bag(d / "run"),
    "mcap bag": lambda d: write_bag(d / "run", storage="mcap"),
    "sqlite3 file without its folder": lambda d: next(write_bag(d / "run").glob("*.db3")),
    "sqlite3 bag, zstd file": lambda d: compress_files(write_bag(d / "run")),
    "mcap bag, zstd file": lambda d: compress_files(write_bag(d / "run", storage="mcap")),
    "sqlite3 bag, zstd messages": lambda d: compress_messages(write_bag(d / "run")),
    "mcap bag, zstd messages": lambda d: write_mcap(d / "r.mcap", packed=True),
    "sqlite3 bag without metadata": lambda d: remove_metadata(write_bag(d / "run")),
    "sqlite3 bag in three files": lambda d: split_sqlite(write_bag(d / "run")),
    **{
        f"metadata version {version}": lambda d, version=version: write_metadata(
            write_bag(d / "run"), version
        )
        for version in (1, 3, 4, 5, 6, 7, 8, 9)
    },
}


def compress_messages(bag: Path) -> Path:
    with sqlite3.connect(next(bag.glob("*.db3"))) as base:
        rows = base.execute("SELECT id, data FROM messages").fetchall()
        pack = zstandard.ZstdCompressor().compress
        base.executemany(
            "UPDATE messages SET data = ? WHERE id = ?", [(pack(data), id) for id, data in rows]
        )
    base.close()
    return bag


def remove_metadata(bag: Path) -> Path:
    (bag / "metadata.yaml").unlink()
    file = next(bag.glob("*.db3"))
    file.rename(bag / f"{bag.name}_0.db3")
    return bag


def split_sqlite(bag: Path) -> Path:
    """Split the bag's messages over three files, the second of which holds the earliest."""
    file = next(bag.glob("*.db3"))
    for part in range(3):
        copy = shutil.copy(file, bag / f"run_{part}.db3")
        with sqlite3.connect(copy) as base:
            base.execute("DELETE FROM messages WHERE (id + 1) % 3 != ?", (part,))
        base.close()
    file.unlink()
    (bag / "metadata.yaml").unlink()
    return bag


def write_metadata(bag: Path, version: int) -> Path:
    """Write a metadata.yaml into the bag as rosbag2 did at that version."""
    file = next(bag.glob("*.db3")).name
    qos: object = "- history: 1\n  depth: 10\n"
    about = {
        "version": version,
        "storage_identifier": "sqlite3",
        # The first versions wrote the path relative to the recorder's working directory.
        "relative_file_paths": [f"run/{file}" if version < 3 else file],
        "duration": {"nanoseconds": 950_000_006},
        "starting_time": {"nanoseconds_since_epoch": START_NS + 3_000_000},
        "message_count": 140,
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic,
                    "type": kind,
                    "serialization_format": "cdr",
                    **({"offered_qos_profiles": qos if version < 9 else []} if version > 3 else {}),
                    **({"type_description_hash": "RIHS01_0"} if version > 6 else {}),
                },
                "message_count": 20,
            }
            for topic, kind in TOPICS.items()
        ],
        **({"compression_format": "", "compression_mode": ""} if version > 2 else {}),
        **({"files": [{"path": file, "message_count": 140}]} if version > 4 else {}),
        **({"custom_data": None} if version > 5 else {}),
        **({"ros_distro": "rosbags"} if version > 7 else {}),
    }
    with (bag / "metadata.yaml").open("w") as out:
        YAML(typ="safe").dump({"rosbag2_bagfile_information": about}, out)
    return bag


@pytest.mark.parametrize("container", CONTAINERS)
def test_every_container_gives_the_same_columns(container: str, mcap: Path, tmp_path: Path) -> None:
    with (
        open_recording(mcap) as reference,
        open_recording(CONTAINERS[container](tmp_path)) as other,
    ):
        expected, by_topic = read_all(reference), read_all(other)
        assert not other.lost_messages
        assert not [note for note in other.notes if "no metadata" not in note]
        assert {name: topic.type for name, topic in other.topics.items()} == TOPICS
        assert_same_columns(expected, by_topic, publish=False)
        for topic, account in other.accounts.items():
            assert account.expected == account.read == account.decoded == 20, topic


def test_recording_id_depends_on_content_only(bag: Path, mcap: Path, tmp_path: Path) -> None:
    moved = shutil.copytree(bag, tmp_path / "elsewhere")
    with (
        open_recording(bag) as original,
        open_recording(moved) as copied,
        open_recording(mcap) as other,
    ):
        assert original.recording_id == copied.recording_id
        assert len(original.recording_id) == 16
        assert other.recording_id != original.recording_id


def test_recordings_in_finds_files_and_bags(tmp_path: Path) -> None:
    (tmp_path / "many" / "a").mkdir(parents=True)
    (tmp_path / "empty").mkdir()
    write_bag(tmp_path / "many" / "a" / "run", 2)
    write_mcap(tmp_path / "many" / "one.mcap", 2)
    write_mcap(tmp_path / "many" / "two.mcap", 2)
    (tmp_path / "many" / "notes.txt").write_text("not a recording")
    names = [path.name for path in recordings_in(tmp_path / "many")]
    assert names == ["run", "one.mcap", "two.mcap"]
    assert len(recordings_in(tmp_path / "many" / "*.mcap")) == 2
    with pytest.raises(RecordingError, match="no such file"):
        recordings_in(tmp_path / "nothing")
    with pytest.raises(RecordingError, match="no recording in this folder"):
        recordings_in(tmp_path / "empty")


def test_unreadable_folder_is_reported_and_skipped(tmp_path, monkeypatch, shell):
    """One folder of another user, and one link to an unmounted disk."""
    locked = tmp_path / "locked"
    locked.mkdir()
    (tmp_path / "lost+found").mkdir()
    write_mcap(tmp_path / "good.mcap", 2)
    (tmp_path / "gone.mcap").symlink_to("/not/mounted/gone.mcap")
    listed = Path.iterdir

    # simulated, as a test run by root may read everything
    def iterdir_denied(folder: Path) -> Iterator[Path]:
        if folder.name in ("locked", "lost+found"):
            raise PermissionError(errno.EACCES, "Permission denied", str(folder))
        return listed(folder)

    monkeypatch.setattr(Path, "iterdir", iterdir_denied)
    out, err = shell.printed("info", tmp_path, "--json", code=2)
    shown = [Path(recording["path"]).name for recording in json.loads(out)["recordings"]]
    assert shown == ["good.mcap"]
    assert f"{locked}: cannot be read: Permission denied" in err
    assert "gone.mcap: a link to /not/mounted/gone.mcap, which is not there" in err
    assert "lost+found" not in err
    with pytest.raises(RecordingError, match="Permission denied"):
        recordings_in(locked)


# -- bad input ------------------------------------------------------------------------------


INVALID_FILES = [
    (b"", "an empty file"),
    (b"version https://git-lfs.github.com/spec/v1\noid sha256:0", "Git LFS pointer"),
    (b"<html>not found</html>", "not a recording"),
    (b"SQLite format 3\x00", "cut short"),
    (b"\x89MCAP0\r\n", "cut short"),
    (b"#ROSBAG V2.0\n", "cannot be read"),
    (b"\x28\xb5\x2f\xfd\x00", "cut short"),
    (None, "no such file"),
]


@pytest.mark.parametrize(("content", "message"), INVALID_FILES)
def test_invalid_file_is_rejected(content: bytes | None, message: str, tmp_path: Path):
    file = tmp_path / "run.mcap"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(RecordingError, match=message) as caught:
        open_recording(file)
    assert caught.value.where is not None


@pytest.mark.parametrize("container", ["mcap, lz4", "sqlite3 bag", "mcap bag, zstd file"])
def test_reading_a_closed_recording_fails(container: str, tmp_path: Path) -> None:
    with open_recording(CONTAINERS[container](tmp_path)) as recording:
        assert recording.topics
    recording.close()  # closing again does nothing
    with pytest.raises(RecordingError, match="it is closed"):
        recording.read({"/odom": ["twist.twist.linear.x"]})


def test_truncated_mcap_is_rejected_or_salvaged(mcap: Path, tmp_path: Path) -> None:
    whole = mcap.read_bytes()
    for share in (0.3, 0.6, 0.9):
        cut = tmp_path / "cut.mcap"
        cut.write_bytes(whole[: int(len(whole) * share)])
        with pytest.raises(RecordingError, match="cut short"):
            open_recording(cut)
        with open_recording(cut, salvage=True) as recording, open_recording(mcap) as full:
            by_topic = read_all(recording)
            expected = read_all(full)
            assert recording.integrity == "damaged"
            assert "cut short" in recording.lost_messages[0].reason
            decoded = sum(len(columns) for columns in by_topic.values())
            assert decoded > 0.6 * share * 140
            # Salvaged messages are also in the whole file.
            for topic, columns in by_topic.items():
                times = set(expected[topic].log_time_ns.tolist())
                assert set(columns.log_time_ns.tolist()) <= times


def test_damaged_chunk_loses_only_its_messages(mcap: Path, tmp_path: Path) -> None:
    from restock.ingest.containers.mcap_file import McapFile

    chunks = McapFile(mcap)._contents.chunks
    assert len(chunks) > 3
    damaged = bytearray(mcap.read_bytes())
    damaged[(chunks[1].start + chunks[1].stop) // 2] ^= 0xFF
    (tmp_path / "bad.mcap").write_bytes(damaged)
    with open_recording(tmp_path / "bad.mcap") as recording:
        by_topic = read_all(recording)
        lost = sum(chunks[1].counts().values())
        assert sum(len(columns) for columns in by_topic.values()) == 140 - lost
        assert [loss.messages for loss in recording.lost_messages] == [lost]
        assert recording.integrity == "damaged"
        assert sum(account.lost for account in recording.accounts.values()) == lost


def test_integrity_depends_on_checksums(mcap: Path, bag: Path, tmp_path: Path) -> None:
    unchecked = write_mcap(tmp_path / "no_crc.mcap", enable_crcs=False)
    for path, integrity in ((mcap, "verified"), (unchecked, "unverified"), (bag, "unverified")):
        with open_recording(path) as recording:
            read_all(recording)
            assert recording.integrity == integrity


def test_rows_in_wal_file_are_read(tmp_path: Path) -> None:
    file = next(write_bag(tmp_path / "run").glob("*.db3"))
    base = sqlite3.connect(file)
    base.execute("PRAGMA journal_mode = WAL")
    base.execute("PRAGMA wal_autocheckpoint = 0")
    base.execute(
        "INSERT INTO messages (topic_id, timestamp, data)"
        " SELECT topic_id, timestamp + 1, data FROM messages"
    )
    base.commit()
    kept = {
        item.name: item.read_bytes() for item in file.parent.iterdir() if "shm" not in item.name
    }
    copy = tmp_path / "copy"
    copy.mkdir()
    for name, content in kept.items():
        (copy / name).write_bytes(content)
    base.close()
    with open_recording(copy) as recording:
        assert recording.messages == 280
        assert sum(len(columns) for columns in read_all(recording).values()) == 280
        assert any("-wal" in note for note in recording.notes)
    assert {item.name: item.read_bytes() for item in copy.iterdir()} == kept


def test_wrong_metadata_is_reported(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "run")
    metadata = bag / "metadata.yaml"
    text = metadata.read_text()
    outside = write_bag(tmp_path / "secret") / "secret.db3"
    metadata.write_text(text.replace("run.db3", str(outside)))
    with open_recording(bag) as recording:
        assert [file.parent for file in recording.files] == [bag]
        assert any("secret.db3, which is missing" in note for note in recording.notes)
        assert not recording.lost_messages
    metadata.write_text(text.replace("run.db3", str(outside)).replace("count: 20", "count: 21"))
    with open_recording(bag) as recording:
        assert any(
            "secret.db3, which is missing" in loss.reason for loss in recording.lost_messages
        )
    metadata.write_text(text.replace("message_count: 20", "message_count: 21"))
    with open_recording(bag) as recording:
        lost = {loss.reason: loss.messages for loss in recording.lost_messages}
        assert lost["metadata.yaml counts 21 messages on /odom, the files hold 20"] == 1
        assert recording.topics["/odom"].expected == 20
    assert main(["info", str(bag)]) == 3
    metadata.write_text(text.replace("message_count: 20", "message_count: 19"))
    with open_recording(bag) as recording:  # the file holds more than counted, so nothing is lost
        assert any("counts 19 messages on /odom" in note for note in recording.notes)
        assert not recording.lost_messages
    assert main(["info", str(bag)]) == 0
    metadata.write_text("a: [unclosed")
    with open_recording(bag) as recording:
        assert recording.messages == 140


def test_messages_missing_from_statistics_count_are_lost(tmp_path: Path) -> None:
    from restock.ingest.containers.mcap_records import Op, walk

    file = write_mcap(tmp_path / "run.mcap")
    content = bytearray(file.read_bytes())
    for opcode, start, stop in walk(content, 8, len(content)):
        if opcode == Op.STATISTICS:  # the last field is the count of the last channel
            content[stop - 8 : stop] = (25).to_bytes(8, "little")
            total = int.from_bytes(content[start : start + 8], "little")
            content[start : start + 8] = (total + 5).to_bytes(8, "little")
        if opcode == Op.FOOTER:
            content[start + 16 : stop] = bytes(4)  # removes the CRC of the summary
            break
    file.write_bytes(content)
    with open_recording(file) as recording:
        read_all(recording)
        lost = [account for account in recording.accounts.values() if account.lost]
        assert [account.lost for account in lost] == [5]
        assert recording.lost_messages[0].reason == "counted by the container, but missing"


def remove_summary(path: Path, *, missing: int) -> Path:
    """Remove the file's records after its data, and one of its message indexes."""
    from restock.ingest.containers.mcap_records import MAGIC, PREFIX, Op, walk

    content = path.read_bytes()
    kept, indexes = [MAGIC], 0
    for opcode, start, stop in walk(content, len(MAGIC), len(content) - len(MAGIC)):
        indexes += opcode == Op.MESSAGE_INDEX
        if opcode != Op.MESSAGE_INDEX or indexes != missing:
            kept.append(content[start - PREFIX : stop])
        if opcode == Op.DATA_END:
            break
    footer = bytes([Op.FOOTER]) + (20).to_bytes(8, "little") + bytes(20)
    path.write_bytes(b"".join([*kept, footer, MAGIC]))
    return path


@pytest.mark.parametrize("missing", [1, 9, 20])
def test_missing_message_index_loses_no_message(missing: int, tmp_path: Path) -> None:
    file = remove_summary(write_mcap(tmp_path / "run.mcap"), missing=missing)
    with open_recording(file) as recording:
        assert recording.messages == 140
        assert sum(len(columns) for columns in read_all(recording).values()) == 140
        assert not recording.lost_messages


def test_topic_of_unknown_type_is_skipped_and_reported(tmp_path: Path) -> None:
    file = next(write_bag(tmp_path / "run").glob("*.db3"))
    with sqlite3.connect(file) as base:
        base.execute("UPDATE topics SET type = 'gazebo_msgs/msg/Performance' WHERE name = '/odom'")
    base.close()
    with open_recording(file) as recording:
        assert "gazebo_msgs/msg/Performance" in str(recording.topics["/odom"].skipped)
        by_topic = recording.read({"/odom": ["x"], "/bumper": ["data"]})
        assert list(by_topic) == ["/bumper"]
        assert recording.accounts["/odom"].expected == recording.accounts["/odom"].lost == 20
        assert [loss.topic for loss in recording.lost_messages] == ["/odom"]


def test_implausible_log_times_are_counted(tmp_path: Path) -> None:
    mcap, sqlite = tmp_path / "run.mcap", next(write_bag(tmp_path / "run", 2).glob("*.db3"))
    with mcap.open("wb") as out:
        writer = Writer(out)
        writer.start()
        schema = writer.register_schema("std_msgs/msg/Bool", "ros2msg", b"bool data")
        channel = writer.register_channel("/bumper", "cdr", schema)
        for stamp in (START_NS, START_NS, 2**64 - 1, 2**63, 2**63 - 1):
            writer.add_message(channel, stamp, b"\0\1\0\0\1", 2**64 - 1)
        writer.finish()
    with sqlite3.connect(sqlite) as base:
        base.execute(
            "DELETE FROM messages WHERE topic_id NOT IN (SELECT id FROM topics"
            " WHERE name = '/bumper')"
        )
        base.executemany("INSERT INTO messages (topic_id, timestamp, data)"
                         " SELECT topic_id, ?, data FROM messages LIMIT 1",
                         [(stamp,) for stamp in (-1, -(2**63), 2**63 - 1)])  # fmt: skip
    base.close()
    for file in (mcap, sqlite):
        with open_recording(file) as recording:
            columns = recording.read({"/bumper": ["data"]})["/bumper"]
            assert len(columns) == 2
            assert (columns.publish_time_ns > 0).all()
            assert recording.accounts["/bumper"].reasons == {
                "logged at an implausible time, before 1970 or after 2262": 3
            }
        assert any("implausible stamps" in note for note in describe_recording(file)["notes"])


# -- recordings from elsewhere --------------------------------------------------------------

needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/bags is absent")

COUNTS = {
    "turtlebot3-sim-humble": 9432,
    "turtlebot3-sim-sparse-cmd": 7811,
    "jazzy-mcap-backsteps": 6578,
    "nav2-file-zstd": 693,
    "every-common-type/test_bag_mcap": 188,
    "every-common-type/test_bag_sqlite3": 188,
    "rosbag2-resources/mcap/talker": 20,
    "rosbag2-resources/mcap/convert_a": 150,
    "rosbag2-resources/mcap/convert_b": 75,
    "rosbag2-resources/mcap/wbag": 6074,
    "rosbag2-resources/mcap/reindex_test_bags/multiple_files": 1324 + 1324 + 529,
    "rosbag2-resources/sqlite3/talker": 20,
    "rosbag2-resources/sqlite3/convert_a": 150,
    "rosbag2-resources/sqlite3/convert_b": 75,
    "rosbag2-resources/sqlite3/wbag": 6074,
    "rosbag2-resources/sqlite3/reindex_test_bags/multiple_files": 1324 + 1324 + 529,
    "rosbag2-zstd-modes/message_compression": 380 + 360 + 360 + 27,
    "rosbag2-zstd-modes/file_compression": 249 + 242 + 240 + 44,
    "rosbag2-tests/mcap/cdr_test": 7,
    "rosbag2-tests/sqlite3/cdr_test": 7,
    "rosbag2-services/topics_and_services.db3": 13,
    "rosbag2-services/topics_and_services.mcap": 13,
    "rosbag2-services/only_topics.mcap": 7,
    "rosbag2-services/only_services.mcap": 12,
    "ros1/husky_robot_localization.bag": 16806,
}


@needs_shared
@pytest.mark.parametrize("name", COUNTS)
def test_shared_recordings_are_counted_and_read(name: str) -> None:
    with open_recording(SHARED / name) as recording:
        assert recording.messages == COUNTS[name]
        by_topic = read_all(recording)
        for topic, account in recording.accounts.items():
            info = recording.topics[topic]
            assert account.expected == info.expected
            assert account.decoded + sum(account.reasons.values()) == account.expected
            if info.skipped is None:
                assert len(by_topic[topic]) == account.decoded
                assert account.read == account.expected


@needs_shared
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_topics_of_unsupported_serialisation_are_skipped(storage: str) -> None:
    with open_recording(SHARED / "rosbag2-tests" / storage / "wrong_rmw_test") as recording:
        reasons = {topic.skipped for topic in recording.topics.values()}
    if storage == "mcap":
        assert reasons == {"messages encoded as 'wrong_format' are not supported"}
    else:  # its topics say cdr, and their types are unknown
        assert all("unknown type test_msgs/msg/" in str(reason) for reason in reasons)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    write_mcap(folder / "one.mcap")
    write_bag(folder / "bag")
    return folder


def test_info_json_lists_recordings_and_topics(folder, shell):
    printed = shell.out("info", folder, "--json")
    recordings = json.loads(printed)["recordings"]
    assert [entry["path"] for entry in recordings] == [
        str(folder / "bag"),
        str(folder / "one.mcap"),
    ]
    assert [entry["format"] for entry in recordings] == ["rosbag2-sqlite3", "mcap"]
    for entry in recordings:
        assert entry["messages"] == 140
        assert entry["start"] == entry["end"] == "2023-11-14T22:13:20Z"
        assert entry["duration_s"] == pytest.approx(0.950000006)
        assert {name: topic["type"] for name, topic in entry["topics"].items()} == TOPICS
        for topic in entry["topics"].values():
            assert topic["messages"] == 20
            assert topic["rate_hz"] == pytest.approx(20 / 0.95, rel=1e-3)
            assert topic["skipped"] is None


OFFERED = {
    "": [],
    "not yaml: [": [],
    "- depth: 1\n  durability: 2\n  reliability: reliable\n  deadline:\n   sec: 9\n" * 2
    + "- reliability: 7\n": [
        {"reliability": "reliable", "durability": "volatile", "depth": 1},
        {"reliability": "7"},
    ],
}


@pytest.mark.parametrize("text", OFFERED)
def test_offered_qos_of_every_version_is_parsed(text):
    assert parse_qos(text) == OFFERED[text]


def test_info_finds_damage_only_if_it_reads_messages(folder, shell):
    path = folder / "one.mcap"
    content = bytearray(path.read_bytes())
    content[len(content) // 4] ^= 0xFF  # within a chunk's messages
    path.write_bytes(content)
    (entry,) = shell.json("info", path)["recordings"]
    assert (entry["integrity"], entry["damage"]) == (None, [])
    (entry,) = shell.json("info", path, "--clocks", code=3)["recordings"]
    assert entry["integrity"] == "damaged"
    assert "is lost" in entry["damage"][0]
