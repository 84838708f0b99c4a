"""What a topic may be for, by its type and name: the message types that can fill each input."""

from __future__ import annotations

from dataclasses import dataclass

from restock.ingest.containers.topic_reading import TopicInfo

_TWIST = {"speed_mps": "linear.x", "yaw_rate_radps": "angular.z"}
_POSE = {"x_m": "position.x", "y_m": "position.y", "orientation": "orientation"}


def _under(path: str, fields: dict[str, str]) -> dict[str, str]:
    return {key: f"{path}.{value}" for key, value in fields.items()}


@dataclass(frozen=True)
class Kind:
    """A message type that may fill an input, and how."""

    type: str
    fields: dict[str, str]
    words: tuple[str, ...] = ()  # in the topic's name, they speak for it
    must: bool = False  # … and without one of them it is not taken


# Best first.
KINDS: dict[str, tuple[Kind, ...]] = {
    "command": (
        Kind("geometry_msgs/msg/Twist", _TWIST, ("cmd_vel",)),
        Kind("geometry_msgs/msg/TwistStamped", _under("twist", _TWIST), ("cmd_vel",)),
        # Nobody's command was recorded: what the robot did stands for what it was told.
        Kind("nav_msgs/msg/Odometry", _under("twist.twist", _TWIST), ("wheel", "odom")),
    ),
    "pose": (
        Kind(
            "geometry_msgs/msg/PoseWithCovarianceStamped",
            _under("pose.pose", _POSE),
            ("amcl", "pose", "local"),
        ),
        Kind(
            "geometry_msgs/msg/PoseStamped",
            _under("pose", _POSE),
            ("robot_pose", "tracked_pose", "slam"),
            must=True,
        ),
        Kind("nav_msgs/msg/Odometry", _under("pose.pose", _POSE), ("filtered", "map", "odom")),
    ),
    "wheels": (Kind("nav_msgs/msg/Odometry", _under("twist.twist", _TWIST), ("wheel", "odom")),),
    "imu": (
        Kind(
            "sensor_msgs/msg/Imu",
            {"yaw_rate_radps": "angular_velocity.z", "accel_x_mps2": "linear_acceleration.x"},
            ("imu",),
        ),
    ),
    "scan": (
        Kind(
            "sensor_msgs/msg/LaserScan",
            {
                "ranges_m": "ranges",
                "angle_min_rad": "angle_min",
                "angle_increment_rad": "angle_increment",
            },
            ("scan",),
        ),
    ),
    "goal": (
        Kind(
            "geometry_msgs/msg/PoseStamped",
            {"x_m": "pose.position.x", "y_m": "pose.position.y"},
            ("goal",),
            must=True,
        ),
    ),
    "plan": (
        Kind(
            "nav_msgs/msg/Path",
            {"x_m": "poses[].pose.position.x", "y_m": "poses[].pose.position.y"},
            ("plan", "path"),
        ),
    ),
    "bumper": (Kind("std_msgs/msg/Bool", {"pressed": "data"}, ("bump", "contact"), must=True),),
    "behaviour_policy": (
        Kind("std_msgs/msg/String", {"text": "data"}, ("policy", "mode", "behavi"), must=True),
    ),
    "true_condition": (
        Kind("std_msgs/msg/String", {"text": "data"}, ("ground_truth", "true_cond"), must=True),
    ),
    "perturbation": (Kind("std_msgs/msg/String", {"text": "data"}, ("perturbation",), must=True),),
}
REQUIRED = ("command", "wheels", "pose")
MOTION = "nav_msgs/msg/Odometry"
SPENT = (
    "goal",
    "plan",
    "behaviour_policy",
    "true_condition",
    "perturbation",
)  # nothing else is in them
LATCHED = ("goal", "plan", "behaviour_policy", "perturbation")

Roles = dict[str, list[tuple[TopicInfo, Kind]]]  # input -> …, best first


def topics_for(
    topics: dict[str, TopicInfo], kinds: tuple[Kind, ...]
) -> list[tuple[TopicInfo, Kind]]:
    """The topics that may fill an input, best first: by kind, by name, by messages."""
    found = []
    for rank, kind in enumerate(kinds):
        for topic in topics.values():
            named = [place for place, word in enumerate(kind.words) if word in topic.name.lower()]
            if topic.type == kind.type and (named or not kind.must):
                order = (rank, min(named, default=len(kind.words)), -topic.expected, topic.name)
                found.append((order, topic, kind))
    return [(topic, kind) for _, topic, kind in sorted(found, key=lambda item: item[0])]
