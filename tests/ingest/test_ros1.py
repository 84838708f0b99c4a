"""ROS 1 bags: indexes that do not match their chunks, damage, and topics of two types."""

import struct
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from restock.errors import RecordingError
from restock.ingest.containers.open_recording import open_recording

TYPES = get_typestore(Stores.ROS1_NOETIC)
ROWS = 400


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Write a bag of two topics in several chunks."""
    path = tmp_path / "run.bag"
    writer = Writer(path)
    writer.chunk_threshold = 4096
    with writer:
        flag = writer.add_connection("/flag", "std_msgs/msg/Bool", typestore=TYPES)
        number = writer.add_connection("/number", "std_msgs/msg/Float64", typestore=TYPES)
        for row in range(ROWS):
            writer.write(flag, row * 1_000_000, struct.pack("<?", row % 2))
            writer.write(number, row * 1_000_000 + 1, struct.pack("<d", row))
    return path


def index_records(content: bytes) -> list[int]:
    """Return the offsets at which index records name their connection."""
    places, at = [], content.find(b"op=\x04")
    while at >= 0:
        near = [content.rfind(b"conn=", 0, at), content.find(b"conn=", at)]
        places.append(min(near, key=lambda place: abs(place - at)) + 5)
        at = content.find(b"op=\x04", at + 1)
    return places


def read_counts(path: Path) -> tuple[dict[str, int], int, int]:
    """Return messages per topic, the total counted at opening, and the messages reported lost."""
    with open_recording(path) as recording:
        columns = recording.read({topic: [] for topic in recording.topics})
        lost = sum(loss.messages or 0 for loss in recording.lost_messages if loss.topic is None)
        return {topic: len(rows) for topic, rows in columns.items()}, recording.messages, lost


@pytest.mark.parametrize("other", [0, 1, 2, 77, 2**32 - 1])
@pytest.mark.parametrize("record", [0, 1, -1])
def test_index_naming_another_connection_is_ignored(bag: Path, record: int, other: int) -> None:
    content = bytearray(bag.read_bytes())
    place = index_records(content)[record]
    content[place : place + 4] = struct.pack("<I", other)
    bag.write_bytes(content)
    assert read_counts(bag) == ({"/flag": ROWS, "/number": ROWS}, 2 * ROWS, 0)


def test_message_of_unknown_connection_is_lost(bag: Path) -> None:
    content = bytearray(bag.read_bytes())
    at = content.index(b"op=\x02")  # the first message
    place = content.index(b"conn=", at - 40) + 5
    content[place : place + 4] = struct.pack("<I", 77)
    bag.write_bytes(content)
    counts, _, lost = read_counts(bag)
    assert sum(counts.values()) == 2 * ROWS - 1
    assert lost == 1


def test_truncated_bag_is_salvaged_up_to_the_cut(bag: Path) -> None:
    whole = bag.read_bytes()
    with open_recording(bag) as recording:
        values = recording.read({"/number": ["data"]})["/number"].fields["data"]
    bag.write_bytes(whole[: int(0.6 * len(whole))])
    with pytest.raises(RecordingError, match="index") as error:
        open_recording(bag)
    assert "--salvage" in (error.value.remedy or "")
    reported: list[str] = []
    with open_recording(bag, salvage=True, watch=lambda *how: reported.append(how[0])) as recording:
        columns = recording.read({"/number": ["data"], "/flag": []})
        assert recording.integrity == "damaged"
        assert recording.topics["/number"].expected == len(columns["/number"])
        assert any("no index" in loss.what for loss in recording.damage)
    part = columns["/number"].fields["data"]
    assert 0.5 * ROWS < len(part) < ROWS
    assert np.array_equal(part, values[: len(part)])
    assert abs(len(columns["/flag"]) - len(part)) <= 1
    assert "looking through the file, bytes" in reported


@pytest.mark.parametrize("keep", [0, 10, 13, 4117])
def test_bag_without_complete_chunk_is_rejected(bag: Path, keep: int) -> None:
    bag.write_bytes(bag.read_bytes()[:keep])
    with pytest.raises(RecordingError):
        open_recording(bag, salvage=True)


def test_every_truncation_is_salvaged_or_rejected(bag: Path) -> None:
    whole, before = bag.read_bytes(), 0
    for size in range(4000, len(whole), 997):
        bag.write_bytes(whole[:size])
        try:
            with open_recording(bag, salvage=True) as recording:
                found = sum(
                    len(columns)
                    for columns in recording.read({"/flag": [], "/number": []}).values()
                )
        except RecordingError:
            found = 0
        assert before <= found <= 2 * ROWS
        before = found
    assert before == 2 * ROWS


def test_damaged_chunk_is_counted_once_per_topic(tmp_path: Path) -> None:
    path = tmp_path / "run.bag"
    writer = Writer(path)
    writer.set_compression(Writer.CompressionFormat.BZ2)
    writer.chunk_threshold = 20_000
    with writer:
        topics = {
            topic: writer.add_connection(topic, "std_msgs/msg/Float64", typestore=TYPES)
            for topic in ("/one", "/two")
        }
        for row in range(1000):
            for number in topics.values():
                writer.write(number, row * 1_000_000, struct.pack("<d", row))
    content = bytearray(path.read_bytes())
    second = content.index(b"BZh9", content.index(b"BZh9") + 1)
    content[second + 200] ^= 0xFF
    path.write_bytes(content)
    with open_recording(path) as recording:
        num_read = sum(len(recording.read({topic: []})[topic]) for topic in topics)
        assert 1000 < num_read < 2000
        (lost,) = recording.lost_messages
        assert (lost.topic, lost.messages) == (None, 2000 - num_read)
        reasons = [account.reasons for account in recording.accounts.values()]
        # Each topic has its own share.
        assert [list(counts) for counts in reasons] == [[lost.reason]] * 2
        assert sum(counts[lost.reason] for counts in reasons) == lost.messages


def test_damage_between_chunks_loses_at_most_one_chunk(bag: Path) -> None:
    whole = bag.read_bytes()
    second = whole.index(b"op=\x05", whole.index(b"op=\x05") + 1)
    content = bytearray(whole)
    # the second chunk's record header, and the index of the first
    content[second - 40 : second + 40] = bytes(80)
    bag.write_bytes(content)
    with open_recording(bag) as recording:
        num_read = sum(
            len(columns) for columns in recording.read({"/flag": [], "/number": []}).values()
        )
        (lost,) = recording.lost_messages
    assert num_read == 2 * ROWS - (lost.messages or 0)
    assert 0 < num_read < 2 * ROWS


STORE = get_typestore(Stores.ROS1_NOETIC)
EACH = 30
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
for name in TRANSFORMS:
    STORE.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", name))


def write_two_types(path: Path, kinds: tuple[str, str]) -> Path:
    """Write two publishers of /both, one per type, that alternate."""
    make = STORE.types
    with Writer(path) as writer:
        connections = [writer.add_connection("/both", kind, typestore=STORE) for kind in kinds]
        for row in range(2 * EACH):
            kind = kinds[row % 2]
            if kind in TRANSFORMS:
                stamp = make["builtin_interfaces/msg/Time"](row, 0)
                header = make["std_msgs/msg/Header"](row, stamp, ("map", "odom")[row % 2])
                place = make["geometry_msgs/msg/Vector3"](float(row), 0.0, 0.0)
                turn = make["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
                transform = make["geometry_msgs/msg/Transform"](place, turn)
                stamped_type = make["geometry_msgs/msg/TransformStamped"]
                message = make[kind](
                    [stamped_type(header, ("odom", "base_link")[row % 2], transform)]
                )
            else:
                message = make[kind](row)
            writer.write(connections[row % 2], row * 10**9, STORE.serialize_ros1(message, kind))
    return path


@pytest.mark.parametrize("kinds", [TRANSFORMS, TRANSFORMS[::-1]])
def test_both_transform_types_are_read(tmp_path, kinds, shell):
    path = write_two_types(tmp_path / "run.bag", kinds)
    field = "transforms[].transform.translation.x"
    with open_recording(path) as recording:
        columns = recording.read({"/both": [field, "transforms[].child_frame_id"]})["/both"]
        values = columns.fields[field]
        assert [values[row].tolist() for row in range(2 * EACH)] == [[n] for n in range(2 * EACH)]
        account = recording.accounts["/both"]
        assert (account.expected, account.decoded, account.reasons) == (2 * EACH, 2 * EACH, {})
        assert account.log_backsteps == 0
        assert not recording.lost_messages
    stderr = shell.err("info", path, code=0)
    assert f"/both has messages of several types: 30 of {kinds[0]}, 30 of {kinds[1]}" in stderr


def test_messages_of_second_type_are_counted_as_lost(tmp_path, shell):
    path = write_two_types(tmp_path / "run.bag", ("std_msgs/msg/Int32", "std_msgs/msg/Float32"))
    with open_recording(path) as recording:
        assert len(recording.read({"/both": ["data"]})["/both"]) == EACH
        (lost,) = recording.lost_messages
        assert lost.messages == EACH
        assert (
            lost.reason
            == "data of std_msgs/msg/Float32 is missing, or not as in std_msgs/msg/Int32"
        )
    (entry,) = shell.json("info", path)["recordings"]
    (note,) = entry["notes"]
    assert "30 of std_msgs/msg/Int32, 30 of std_msgs/msg/Float32" in note
