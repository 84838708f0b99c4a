"""ROS 1 bags: an index that does not fit its chunks, and topics of two types."""

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
    """Two topics in several chunks."""
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
    """Where each index record names its connection."""
    places, at = [], content.find(b"op=\x04")
    while at >= 0:
        near = [content.rfind(b"conn=", 0, at), content.find(b"conn=", at)]
        places.append(min(near, key=lambda place: abs(place - at)) + 5)
        at = content.find(b"op=\x04", at + 1)
    return places


def read(path: Path) -> tuple[dict[str, int], int, int]:
    """Messages of each topic, in sum as counted before, and how many are said to be lost."""
    with open_recording(path) as recording:
        columns = recording.read({topic: [] for topic in recording.topics})
        lost = sum(loss.messages or 0 for loss in recording.lost_messages if loss.topic is None)
        return {topic: len(rows) for topic, rows in columns.items()}, recording.messages, lost


@pytest.mark.parametrize("other", [0, 1, 2, 77, 2**32 - 1])
@pytest.mark.parametrize("record", [0, 1, -1])
def test_an_index_that_names_another_connection(bag: Path, record: int, other: int) -> None:
    content = bytearray(bag.read_bytes())
    place = index_records(content)[record]
    content[place : place + 4] = struct.pack("<I", other)
    bag.write_bytes(content)
    assert read(bag) == ({"/flag": ROWS, "/number": ROWS}, 2 * ROWS, 0)


def test_a_message_of_a_connection_that_is_not_named_is_counted(bag: Path) -> None:
    content = bytearray(bag.read_bytes())
    at = content.index(b"op=\x02")  # the first message
    place = content.index(b"conn=", at - 40) + 5
    content[place : place + 4] = struct.pack("<I", 77)
    bag.write_bytes(content)
    counts, _, lost = read(bag)
    assert sum(counts.values()) == 2 * ROWS - 1
    assert lost == 1


def test_a_bag_that_was_cut_short_is_read_up_to_the_cut(bag: Path) -> None:
    whole = bag.read_bytes()
    with open_recording(bag) as recording:
        values = recording.read({"/number": ["data"]})["/number"].fields["data"]
    bag.write_bytes(whole[: int(0.6 * len(whole))])
    with pytest.raises(RecordingError, match="index") as refused:
        open_recording(bag)
    assert "--salvage" in (refused.value.remedy or "")
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
def test_a_bag_without_a_whole_chunk_is_refused(bag: Path, keep: int) -> None:
    bag.write_bytes(bag.read_bytes()[:keep])
    with pytest.raises(RecordingError):
        open_recording(bag, salvage=True)


def test_every_cut_is_read_or_refused(bag: Path) -> None:
    whole, before = bag.read_bytes(), 0
    for size in range(4000, len(whole), 997):
        bag.write_bytes(whole[:size])
        try:
            with open_recording(bag, salvage=True) as recording:
                found = sum(
                    len(one) for one in recording.read({"/flag": [], "/number": []}).values()
                )
        except RecordingError:
            found = 0
        assert before <= found <= 2 * ROWS
        before = found
    assert before == 2 * ROWS


def test_a_damaged_chunk_is_lost_once_whatever_is_read_first(tmp_path: Path) -> None:
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
        there = sum(len(recording.read({topic: []})[topic]) for topic in topics)
        assert 1000 < there < 2000
        (lost,) = recording.lost_messages
        assert (lost.topic, lost.messages) == (None, 2000 - there)
        reasons = [account.reasons for account in recording.accounts.values()]
        assert [list(one) for one in reasons] == [[lost.reason]] * 2  # each topic's own share
        assert sum(one[lost.reason] for one in reasons) == lost.messages


def test_damage_between_chunks_costs_one_chunk_at_most(bag: Path) -> None:
    whole = bag.read_bytes()
    second = whole.index(b"op=\x05", whole.index(b"op=\x05") + 1)
    content = bytearray(whole)
    content[second - 40 : second + 40] = bytes(80)  # its record, and the index behind the first
    bag.write_bytes(content)
    with open_recording(bag) as recording:
        there = sum(len(one) for one in recording.read({"/flag": [], "/number": []}).values())
        (lost,) = recording.lost_messages
    assert there == 2 * ROWS - (lost.messages or 0)
    assert 0 < there < 2 * ROWS


STORE = get_typestore(Stores.ROS1_NOETIC)
EACH = 30
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
for name in TRANSFORMS:
    STORE.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", name))


def two_types(path: Path, kinds: tuple[str, str]) -> Path:
    """Write two publishers of /both, one of each type, by turns."""
    make = STORE.types
    with Writer(path) as writer:
        to = [writer.add_connection("/both", kind, typestore=STORE) for kind in kinds]
        for row in range(2 * EACH):
            kind = kinds[row % 2]
            if kind in TRANSFORMS:
                stamp = make["builtin_interfaces/msg/Time"](row, 0)
                header = make["std_msgs/msg/Header"](row, stamp, ("map", "odom")[row % 2])
                place = make["geometry_msgs/msg/Vector3"](float(row), 0.0, 0.0)
                turn = make["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
                transform = make["geometry_msgs/msg/Transform"](place, turn)
                of = make["geometry_msgs/msg/TransformStamped"]
                message = make[kind]([of(header, ("odom", "base_link")[row % 2], transform)])
            else:
                message = make[kind](row)
            writer.write(to[row % 2], row * 10**9, STORE.serialize_ros1(message, kind))
    return path


@pytest.mark.parametrize("kinds", [TRANSFORMS, TRANSFORMS[::-1]])
def test_both_types_of_transforms_are_read(tmp_path, kinds, shell):
    path = two_types(tmp_path / "run.bag", kinds)
    field = "transforms[].transform.translation.x"
    with open_recording(path) as recording:
        columns = recording.read({"/both": [field, "transforms[].child_frame_id"]})["/both"]
        values = columns.fields[field]
        assert [values[row].tolist() for row in range(2 * EACH)] == [[n] for n in range(2 * EACH)]
        account = recording.accounts["/both"]
        assert (account.expected, account.decoded, account.reasons) == (2 * EACH, 2 * EACH, {})
        assert account.log_backsteps == 0
        assert not recording.lost_messages
    said = shell.err("info", path, code=0)
    assert f"/both has 2 types: 30 messages of {kinds[0]}, 30 of {kinds[1]}" in said
    assert "not read" not in said


def test_what_another_type_makes_unreadable_is_counted_and_said(tmp_path, shell):
    path = two_types(tmp_path / "run.bag", ("std_msgs/msg/Int32", "std_msgs/msg/Float32"))
    with open_recording(path) as recording:
        assert len(recording.read({"/both": ["data"]})["/both"]) == EACH
        (lost,) = recording.lost_messages
        assert lost.messages == EACH
        assert "std_msgs/msg/Float32" in lost.reason
    (entry,) = shell.json("info", path)["recordings"]
    (note,) = entry["notes"]
    assert note.endswith("30 of std_msgs/msg/Float32: only those of std_msgs/msg/Int32 are read")
