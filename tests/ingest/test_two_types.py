"""One topic with messages of two types: read together if their fields are the same."""

import json
from pathlib import Path

import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from restock.cli import main
from restock.ingest.containers.open_recording import open_recording

STORE = get_typestore(Stores.ROS1_NOETIC)
ROWS = 30
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
for name in TRANSFORMS:
    STORE.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", name))


def bag(path: Path, kinds: tuple[str, str]) -> Path:
    """Write two publishers of /both, one of each type, by turns."""
    make = STORE.types
    with Writer(path) as writer:
        to = [writer.add_connection("/both", kind, typestore=STORE) for kind in kinds]
        for row in range(2 * ROWS):
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
def test_both_types_of_transforms_are_read(tmp_path, capsys, kinds):
    path = bag(tmp_path / "run.bag", kinds)
    field = "transforms[].transform.translation.x"
    with open_recording(path) as recording:
        columns = recording.read({"/both": [field, "transforms[].child_frame_id"]})["/both"]
        values = columns.fields[field]
        assert [values[row].tolist() for row in range(2 * ROWS)] == [[n] for n in range(2 * ROWS)]
        account = recording.accounts["/both"]
        assert (account.expected, account.decoded, account.reasons) == (2 * ROWS, 2 * ROWS, {})
        assert account.log_backsteps == 0
        assert not recording.lost_messages
    assert main(["info", str(path)]) == 0
    said = capsys.readouterr().err
    assert f"/both has 2 types: 30 messages of {kinds[0]}, 30 of {kinds[1]}" in said
    assert "not read" not in said


def test_what_another_type_makes_unreadable_is_counted_and_said(tmp_path, capsys):
    path = bag(tmp_path / "run.bag", ("std_msgs/msg/Int32", "std_msgs/msg/Float32"))
    with open_recording(path) as recording:
        assert len(recording.read({"/both": ["data"]})["/both"]) == ROWS
        (lost,) = recording.lost_messages
        assert lost.messages == ROWS
        assert "std_msgs/msg/Float32" in lost.reason
    assert main(["info", str(path), "--json"]) == 0
    (entry,) = json.loads(capsys.readouterr().out)["recordings"]
    (note,) = entry["notes"]
    assert note.endswith("30 of std_msgs/msg/Float32: only those of std_msgs/msg/Int32 are read")
