"""A robot that drives straight ahead at .5 m/s, for tests worked out by hand."""

import os
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader

from restock.ingest.decoding.columns import FieldColumn, Ragged, TopicColumns, offsets_of
from restock.ingest.live.observer import LiveObserver, Observed
from restock.ingest.profile.profile import Profile
from restock.ingest.steps.episodes import Steps

SPEED_MPS = 0.5
PERIOD_S = 0.2
START_NS = 1_700_000_000 * 10**9
LATENCY_NS = 2_000_000  # from header stamp to log time, of every topic
BEAMS = 72
FREE_M = 3.0
GOAL = (11.0, 1.0)
MOVE_BASE = {
    "MoveBaseGoal": "geometry_msgs/PoseStamped target_pose\n",
    "MoveBaseActionGoal": "std_msgs/Header header\nactionlib_msgs/GoalID goal_id\n"
    "move_base_msgs/MoveBaseGoal goal\n",
}
KINDS = {  # of topics: the types of their messages
    "/cmd_vel": "geometry_msgs/msg/Twist",
    "/amcl_pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/odom": "nav_msgs/msg/Odometry",
    "/imu": "sensor_msgs/msg/Imu",
    "/goal_pose": "geometry_msgs/msg/PoseStamped",
    "/plan": "nav_msgs/msg/Path",
    "/map": "nav_msgs/msg/OccupancyGrid",
    "/bumper": "std_msgs/msg/Bool",
    "/behaviour_policy": "std_msgs/msg/String",
    "/ground_truth/condition": "std_msgs/msg/String",
    "/battery": "sensor_msgs/msg/BatteryState",
    "/robot_description": "std_msgs/msg/String",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/local_costmap/published_footprint": "geometry_msgs/msg/PolygonStamped",
}
ITEMS = {  # of lists: what they hold
    "poses": "geometry_msgs/msg/PoseStamped",
    "polygon.points": "geometry_msgs/msg/Point32",
    "transforms": "geometry_msgs/msg/TransformStamped",
    "new_parameters": "rcl_interfaces/msg/Parameter",
}


@dataclass
class Drive:
    """A drive of `duration_s` along y = 1 from x = 1; goals as (time, x, y)."""

    duration_s: float = 6.0
    goals: list[tuple[float, float, float]] = field(default_factory=lambda: [(0.0, *GOAL)])
    policies: list[tuple[float, str]] = field(default_factory=lambda: [(0.0, "planner")])
    truth: str | None = None
    drop: ClassVar[tuple[str, ...]] = ()  # topics that it lacks
    proposals: str | None = None  # the topic of what navigation proposes, 5 ms ahead of commands

    def x_at(self, time_s: NDArray[Any]) -> NDArray[Any]:
        return 1.0 + SPEED_MPS * time_s

    def topics(self) -> dict[str, TopicColumns]:
        """Return what a reader would hand over for the profile `warehouse_amr`."""
        fast = np.arange(0, self.duration_s, 0.02)
        ticks = np.arange(0, self.duration_s, PERIOD_S)
        tenth = np.arange(0, self.duration_s, 0.1)
        goal_s = np.array([time for time, *_ in self.goals])
        goal_xy = np.array([(x, y) for _, x, y in self.goals]).reshape(-1, 2)
        starts = np.array([(self.x_at(time), 1.0) for time in goal_s]).reshape(-1, 2)
        found = {
            "/cmd_vel": columns(
                ticks + 0.005,
                {"linear.x": np.full(len(ticks), 0.4), "angular.z": np.zeros(len(ticks))},
                stamped=False,
            ),
            "/amcl_pose": columns(tenth, pose("pose.pose", self.x_at(tenth), 1.0)),
            "/odom": columns(
                fast,
                {
                    "twist.twist.linear.x": np.full(len(fast), SPEED_MPS),
                    "twist.twist.angular.z": np.zeros(len(fast)),
                },
            ),
            "/imu": columns(
                fast,
                {
                    "angular_velocity.z": np.zeros(len(fast)),
                    "linear_acceleration.x": np.zeros(len(fast)),
                },
            ),
            "/scan": columns(tenth, scans(np.full((len(tenth), BEAMS), FREE_M))),
            "/goal_pose": columns(
                goal_s, {"pose.position.x": goal_xy[:, 0], "pose.position.y": goal_xy[:, 1]}
            ),
            "/plan": columns(
                goal_s,
                {
                    "poses[].pose.position.x": ragged([starts[:, 0], goal_xy[:, 0]]),
                    "poses[].pose.position.y": ragged([starts[:, 1], goal_xy[:, 1]]),
                },
            ),
            "/bumper": columns(tenth, {"data": np.zeros(len(tenth), np.bool_)}, stamped=False),
            "/behaviour_policy": columns(
                np.array([time for time, _ in self.policies]),
                {"data": np.array([text for _, text in self.policies], object)},
                stamped=False,
            ),
        }
        if self.truth is not None:
            found["/ground_truth/condition"] = columns(
                ticks, {"data": np.full(len(ticks), self.truth, object)}, stamped=False
            )
        if self.proposals is not None:
            fields = {"linear.x": np.full(len(ticks), 0.3), "angular.z": np.full(len(ticks), 0.1)}
            found[self.proposals] = columns(ticks, fields, stamped=False)
        return {name: one for name, one in found.items() if name not in self.drop}


def columns(
    time_s: NDArray[Any], fields: dict[str, FieldColumn], *, stamped: bool = True
) -> TopicColumns:
    """Return a topic whose messages were measured at these times."""
    stamp = START_NS + np.rint(time_s * 1e9).astype(np.int64)
    fields = dict(fields)
    if stamped:
        fields["header.stamp"] = stamp
    return TopicColumns(stamp + LATENCY_NS, stamp + LATENCY_NS, fields)


def pose(path: str, x: NDArray[Any], y: float) -> dict[str, FieldColumn]:
    """Poses that look along x."""
    zero, one = np.zeros(len(x)), np.ones(len(x))
    quaternion = {f"{path}.orientation.{axis}": zero for axis in "xyz"}
    return {
        f"{path}.position.x": x,
        f"{path}.position.y": np.full(len(x), y),
        **quaternion,
        f"{path}.orientation.w": one,
    }


def scans(ranges: NDArray[Any]) -> dict[str, FieldColumn]:
    """Return scans (N, B) over the full circle, from straight behind counter-clockwise."""
    count, beams = ranges.shape
    flat = np.asarray(ranges, np.float32).reshape(-1)
    return {
        "ranges": Ragged(flat, offsets_of(np.full(count, beams))),
        "angle_min": np.full(count, -np.pi),
        "angle_increment": np.full(count, 2 * np.pi / beams),
    }


def ragged(points: list[NDArray[Any]]) -> Ragged:
    """Columns (N,) of the points of N polylines, one column a point."""
    values = np.stack(points, axis=1)
    return Ragged(values.reshape(-1), offsets_of(np.full(len(values), values.shape[1])))


def transforms(time_s: NDArray[Any], *edges: tuple[Any, ...]) -> tuple[str, TopicColumns]:
    """Return messages that each hold every edge: parent, child, x, y, yaw and roll."""
    count, full = len(time_s), [(*edge, *(0.0,) * (6 - len(edge))) for edge in edges]
    parent, child, x, y, yaw, roll = (
        np.stack([np.broadcast_to(one, count) for one in values], axis=1).reshape(-1)
        for values in zip(*full, strict=True)
    )
    yaw, roll = yaw / 2, roll / 2
    values = {
        "header.stamp": np.repeat(START_NS + np.rint(time_s * 1e9).astype(np.int64), len(edges)),
        "header.frame_id": parent.astype(object),
        "child_frame_id": child.astype(object),
        "transform.translation.x": x,
        "transform.translation.y": y,
        "transform.rotation.x": np.cos(yaw) * np.sin(roll),
        "transform.rotation.y": np.sin(yaw) * np.sin(roll),
        "transform.rotation.z": np.sin(yaw) * np.cos(roll),
        "transform.rotation.w": np.cos(yaw) * np.cos(roll),
    }
    each = offsets_of(np.full(count, len(edges)))
    fields = {f"transforms[].{path}": Ragged(value, each) for path, value in values.items()}
    return "tf2_msgs/msg/TFMessage", columns(time_s, fields, stamped=False)


def without(topic: TopicColumns, keep: NDArray[np.bool_]) -> TopicColumns:
    """Only some of a topic's messages."""
    from restock.ingest.decoding.columns import take

    rows = np.flatnonzero(keep)
    return TopicColumns(
        topic.log_time_ns[rows],
        topic.publish_time_ns[rows],
        {path: take(column, rows) for path, column in topic.fields.items()},
    )


def write_bag(drive: Drive, folder: Path, *, storage: str = "sqlite3") -> Path:
    """Write the drive as a rosbag2 folder, `sqlite3` or `mcap`, written by rosbags."""
    return write_topics(typed_topics(drive), folder, storage=storage)


def write_bags(folder: Path, count: int) -> Path:
    """Write a folder of this many recordings, `drive0` and so on, of 3 s, 4 s and so on."""
    for number in range(count):
        write_bag(Drive(duration_s=3.0 + number, truth="nominal"), folder / f"drive{number}")
    return folder


def typed_topics(drive: Drive) -> dict[str, tuple[str, TopicColumns]]:
    """Return the drive's topics with the types of their messages."""
    found = typed_columns(drive.topics())
    if drive.proposals is not None:
        found[drive.proposals] = KINDS["/cmd_vel"], found[drive.proposals][1]
    return found


def typed_columns(topics: Mapping[str, TopicColumns]) -> dict[str, tuple[str, TopicColumns]]:
    """Return topics as `write_topics` takes them; those that are none of `KINDS` are scans."""
    scan = "sensor_msgs/msg/LaserScan"
    return {name: (KINDS.get(name, scan), columns) for name, columns in topics.items()}


def write_topics(
    topics: Mapping[str, tuple[str, TopicColumns]],
    folder: Path,
    *then: Mapping[str, TopicColumns],
    storage: str = "sqlite3",
) -> Path:
    """Write (message type, columns) as a rosbag2 folder by log time, then those of `then`."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    types = _humble()
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        connections = {
            topic: writer.add_connection(topic, name, typestore=types)
            for topic, (name, _) in topics.items()
        }
        for part in ({topic: one for topic, (_, one) in topics.items()}, *then):
            lines = []
            for topic, messages in part.items():
                name = topics[topic][0]
                message, varies = _blank(types, name), any("[]" in one for one in messages.fields)
                for row in range(len(messages)):
                    message = _blank(types, name) if varies else message
                    for path, column in messages.fields.items():
                        _set(types, message, path, column[row])
                    data = types.serialize_cdr(message, name)
                    lines.append((int(messages.log_time_ns[row]), connections[topic], data))
            for log_time_ns, connection, data in sorted(lines, key=lambda line: line[0]):
                writer.write(connection, log_time_ns, data)
    return folder


@cache
def _humble() -> Any:
    """Return the types of ROS 2 Humble, with those of ackermann_msgs and move_base_msgs."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    from restock.ingest.decoding.definitions import ackermann_types

    types = get_typestore(Stores.ROS2_HUMBLE)
    types.register(ackermann_types())
    for name, text in MOVE_BASE.items():
        types.register(get_types_from_msg(text, f"move_base_msgs/msg/{name}"))
    return types


def _blank(types: Any, name: str) -> Any:
    """Return a message with every field zero or empty."""
    from rosbags.interfaces import Nodetype

    values: dict[str, Any] = {}
    for key, (kind, detail) in types.fielddefs[name][1]:
        if kind == Nodetype.NAME:
            values[key] = _blank(types, detail)
        elif kind == Nodetype.BASE:
            values[key] = "" if detail[0] == "string" else False if detail[0] == "bool" else 0
        elif kind == Nodetype.ARRAY:
            values[key] = np.zeros(detail[1])
        else:
            primitive = detail[0][0] == Nodetype.BASE
            values[key] = np.zeros(0, np.float32) if primitive else []
    return types.types[name](**values)


def _set(types: Any, message: Any, path: str, value: Any) -> None:
    if path == "header.stamp":
        stamp = types.types["builtin_interfaces/msg/Time"](*divmod(int(value), 10**9))
        message.header.stamp = stamp
        return
    head, repeated, rest = path.partition("[].")
    if repeated:
        for name in head.split("."):
            message = getattr(message, name)
        while len(message) < len(value):
            message.append(_blank(types, ITEMS[head]))
        for item, part in zip(message, value, strict=True):
            _set(types, item, rest, part)
        return
    *parents, last = path.split(".")
    for parent in parents:
        message = getattr(message, parent)
    setattr(message, last, value.item() if isinstance(value, np.generic) else value)


def up_to_the_panel(folder: Path) -> tuple[str, str]:
    """Options of `restock start` that end it at the panel: a mixture of what no log has."""
    path = folder / "of_nothing.toml"
    path.write_text('[[strata]]\nname = "none"\nwhere = "no_such_column = 1"\nshare = 1.0\n')
    return "--mixture", str(path)


def cut_bag(folder: Path) -> Path:
    """Write a drive whose MCAP file is cut short at four fifths."""
    (file,) = write_bag(Drive(), folder, storage="mcap").glob("*.mcap")
    os.truncate(file, int(0.8 * file.stat().st_size))
    return folder


def seen_alike(bag: Path, profile: Profile, steps: Steps) -> Counter[str]:
    """Count the commands at which a running robot sees what ingest stores, by what is amiss."""
    observer, seen, alike = LiveObserver(profile), dict[int, Observed](), Counter[str]()
    with AnyReader([bag]) as reader:
        chosen = [c for c in reader.connections if c.topic in observer.topics]
        for connection, now_ns, raw in reader.messages(chosen):
            if connection.topic == "/cmd_vel":
                observed = observer.observe(now_ns)
                seen[observed.stamp_ns] = observed
            observer.receive(connection.topic, reader.deserialize(raw, connection.msgtype), now_ns)
    stamps, sectors = (steps.signals[name] for name in ("stamp_ns", "sector_clearance_m"))
    for stamp_ns, problem, clearance in zip(stamps.tolist(), steps.problem, sectors, strict=True):
        if seen[stamp_ns].problem == problem:
            live = seen[stamp_ns].signals["sector_clearance_m"][0]
            np.testing.assert_array_equal(live, clearance)
            alike[problem] += 1
    return alike
