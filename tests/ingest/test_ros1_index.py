"""ROS 1 bags whose index does not fit their chunks: the chunks are right, no message is lost."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Reader, Writer
from rosbags.typesys import Stores, get_typestore
from support.paths import SHARED

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


def test_values_are_those_that_rosbags_reads(bag: Path) -> None:
    with Reader(bag) as reader:
        wanted = [
            (stamp, TYPES.deserialize_ros1(data, connection.msgtype).data)
            for connection, stamp, data in reader.messages()
            if connection.topic == "/number"
        ]
    with open_recording(bag) as recording:
        columns = recording.read({"/number": ["data"]})["/number"]
    assert columns.log_time_ns.tolist() == [stamp for stamp, _ in wanted]
    assert np.array_equal(columns.fields["data"], [value for _, value in wanted])


def test_a_message_of_a_connection_that_is_not_named_is_counted(bag: Path) -> None:
    content = bytearray(bag.read_bytes())
    at = content.index(b"op=\x02")  # the first message
    place = content.index(b"conn=", at - 40) + 5
    content[place : place + 4] = struct.pack("<I", 77)
    bag.write_bytes(content)
    counts, _, lost = read(bag)
    assert sum(counts.values()) == 2 * ROWS - 1
    assert lost == 1


@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/bags is absent")
@pytest.mark.parametrize("other", [1, 3, 77])
def test_the_index_of_a_huskys_bag(other: int, tmp_path: Path) -> None:
    content = bytearray((SHARED / "ros1" / "husky_robot_localization.bag").read_bytes())
    places = index_records(content)
    place = places[len(places) // 2]
    content[place : place + 4] = struct.pack("<I", other)
    (tmp_path / "run.bag").write_bytes(content)
    counts, messages, lost = read(tmp_path / "run.bag")
    assert (sum(counts.values()), messages, lost) == (16806, 16806, 0)
