"""Check the recorded scene of a mission: markers, perturbation, frames, map and their QoS."""

import json
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from support.long import one_in
from support.paths import ROOT

from restock.train.twin.recording.recorder import HARDWARE, RecordingPlan, record
from restock.train.twin.recording.robot_topics import (
    MARKERS,
    PERTURBATION,
    TOPICS,
    TRAFFIC,
    perturbation_text,
)

LATCHED = {"/tf_static", "/map", "/behaviour_policy", "/amcl_pose", PERTURBATION, MARKERS, TRAFFIC}


@pytest.mark.parametrize(("file_format", "name"), one_in(2, [("mcap", "a.mcap"), ("rosbag2", "a")]))
def test_recording_contains_frames_map_and_scene(tmp_path, file_format, name):
    kinds = {"near_collision": 1.0, "blocked_aisle": 1.0}
    done = record(
        tmp_path / name, RecordingPlan(format=file_format, missions=2, seed=4, conditions=kinds)
    )
    decoded: dict[str, list[Any]] = {topic.name: [] for topic in TOPICS}
    with AnyReader([tmp_path / name]) as reader:
        for connection, _, data in reader.messages():
            decoded[connection.topic].append(reader.deserialize(data, connection.msgtype))
        durability = {
            c.topic: c.ext.offered_qos_profiles[0].durability.name for c in reader.connections
        }
    assert {topic for topic, how in durability.items() if how == "TRANSIENT_LOCAL"} == LATCHED

    links = {
        (link.header.frame_id, link.child_frame_id)
        for topic in ("/tf", "/tf_static")
        for message in decoded[topic]
        for link in message.transforms
    }
    assert links == {
        ("map", "odom"),
        ("odom", "base_link"),
        ("base_link", "laser_link"),
        ("base_link", "imu_link"),
    }
    frames = {child for _, child in links} | {"map"}
    used = {
        message.header.frame_id
        for topic, messages in decoded.items()
        for message in messages
        if hasattr(message, "header") and topic not in ("/diagnostics", "/joint_states")
    }
    assert used <= frames

    (grid,) = decoded["/map"]
    cells = np.array(grid.data).reshape(grid.info.height, grid.info.width)
    assert (cells.shape, grid.header.frame_id) == ((102, 122), "map")  # 12 x 10 m and its walls
    assert set(np.unique(cells)) == {0, 100}
    assert (cells[0] == 100).all()
    x, y = (grid.info.origin.position.x, grid.info.origin.position.y)
    pose = decoded["/amcl_pose"][0].pose.pose.position
    row, column = (int((at - low) / grid.info.resolution) for at, low in ((pose.y, y), (pose.x, x)))
    assert cells[row, column] == 0  # the robot stands where the map is free

    content = [json.loads(message.data) for message in decoded[PERTURBATION]]
    assert content == [json.loads(perturbation_text(HARDWARE))] * 2
    shown = [{marker.ns for marker in message.markers} for message in decoded[MARKERS]]
    assert sum("pallet" in names for names in shown) == done.missions["blocked_aisle"] == 1
    walking = [m for message in decoded[TRAFFIC] for m in message.markers if m.ns == "person"]
    assert len({(m.pose.position.x, m.pose.position.y) for m in walking}) > 2


def test_foxglove_layout_shows_recorded_topics() -> None:
    layout = json.loads((ROOT / "docs" / "foxglove.json").read_text())
    panels = layout["configById"]

    def placed(node: Any) -> list[str]:
        if isinstance(node, str):
            return [node]
        assert node["direction"] in ("row", "column")
        return placed(node["first"]) + placed(node["second"])

    assert sorted(placed(layout["layout"])) == sorted(panels)
    fields = [
        path.get("value") or path["topicPath"]
        for config in panels.values()
        for path in [*config.get("paths", []), *([config] if "topicPath" in config else [])]
    ]
    topics = {topic.name for topic in TOPICS}
    shown = set(panels["3D!floor"]["topics"])
    assert shown <= topics
    assert {"/map", "/scan", "/plan", MARKERS, TRAFFIC} <= shown
    assert {field.partition(".")[0] for field in fields} <= topics
    assert panels["3D!floor"]["fixedFrame"] == "map"
