"""Compare packed messages with the bytes that rosbags writes, and check the sinks."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from restock.train.twin.recording.bag_writer import (
    Exemplar,
    Format,
    Message,
    Topic,
    build,
    recording_sink,
    serialise,
    typestore,
)
from restock.train.twin.recording.robot_topics import plan

STAMP_NS = 1_760_000_000_123_456_789


@given(
    frame=st.text(st.characters(codec="ascii", exclude_characters="\0"), max_size=9),
    names=st.lists(st.sampled_from(["a", "left_wheel_joint", "x" * 7]), max_size=3),
    ranges=st.lists(st.floats(width=32, allow_nan=False), max_size=5),
)
@settings(max_examples=60)
def test_packed_messages_match_rosbags(frame, names, ranges):
    """Check alignment after strings and sequences of any length."""
    numbers = np.arange(len(names), dtype=float)
    header, transforms = {"frame_id": frame}, [{"child_frame_id": name} for name in names]
    shapes: list[tuple[str, dict[str, Any], dict[str, np.ndarray]]] = [
        (
            "sensor_msgs/msg/LaserScan",
            {"header": header, "ranges": ranges},
            {"ranges": np.array([ranges], np.float32)} if ranges else {},
        ),
        (
            "sensor_msgs/msg/JointState",
            {"header": header, "name": names, "velocity": numbers},
            {"velocity": numbers[None]} if names else {},
        ),
        (
            "tf2_msgs/msg/TFMessage",
            {"transforms": transforms},
            {f"transforms[{i}].transform.rotation.w": np.ones(1) for i in range(len(names))},
        ),
    ]
    for name, fields, columns in shapes:
        exemplar, data = Exemplar(name, **fields), serialise(build(name, **fields))
        assert exemplar.layout[0] == data
        assert not columns or exemplar.pack(columns) == [data]
        assert serialise(typestore().deserialize_cdr(data, name)) == data


def test_plan_fills_every_pose_of_the_path() -> None:
    points = np.array([[0.0, 1.0], [2.0, 3.0], [2.0, 4.0]])
    path = typestore().deserialize_cdr(plan(STAMP_NS, points), "nav_msgs/msg/Path")
    assert [[p.pose.position.x, p.pose.position.y] for p in path.poses] == points.tolist()
    assert {(p.header.stamp.sec, p.header.stamp.nanosec) for p in path.poses} == {
        divmod(STAMP_NS, 10**9)
    }
    assert path.poses[1].pose.orientation.z == pytest.approx(np.sin(np.pi / 4))


@pytest.mark.parametrize("file_format", ["mcap", "rosbag2"])
def test_interrupted_recording_leaves_no_files(tmp_path: Path, file_format: Format) -> None:
    topics = [Topic("/pressed", "std_msgs/msg/Bool")]

    def interrupted() -> None:
        with recording_sink(tmp_path / "log", file_format, topics) as sink:
            sink.write([Message(1, 1, "/pressed", serialise(build("std_msgs/msg/Bool")))])
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == []
