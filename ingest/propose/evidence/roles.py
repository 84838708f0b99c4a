"""What a topic and a frame may be for: guesses by message types and names."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TypeVar

from restock.ingest.containers.recording import Recording
from restock.ingest.containers.topic_reading import TopicInfo
from restock.ingest.live.node_topics import ACTION, LIMITER, PROPOSAL, SHADOW, TAKEOVER
from restock.ingest.profile.tables import Frames
from restock.ingest.steps.frames import FIELDS, Edges, upward
from restock.ingest.urdf.description import BASE_FRAMES

T = TypeVar("T")

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
    never: tuple[str, ...] = ()  # in the topic's name, they speak against it
    rather: tuple[str, ...] = ()  # in the topic's name, they put it after all others


# Where nothing else says where the robot is.
FIX = "sensor_msgs/msg/NavSatFix"
FIX_FIELDS = {
    "latitude_deg": "latitude",
    "longitude_deg": "longitude",
    "status": "status.status",
    "covariance_m2": "position_covariance",
    "covariance_type": "position_covariance_type",
}

# A name of what may drive but is only proposed: to a multiplexer, a smoother, a person's remote.
NAVIGATION = ("nav", "move_base", "planner", "autonom", "cmd_vel_raw", "raw_cmd_vel")
# Of several, what is nearest to the motor is driven: a multiplexer's output before its inputs.
_DRIVEN = ("cmd_vel_out", "mux/out", "mux/cmd_vel", "cmd_vel")
_ACKERMANN = ("low_level", "output", "ackermann_cmd", "drive")
BY_HAND = ("teleop", "joy", "key", "web", "remote")

# A name of a pose that is not where the robot is.
_ELSEWHERE = (
    *("goal", "target", "initial", "waypoint", "click", "marker", "object", "human", "person"),
    *("people", "dock", "desired", "setpoint", "reference", "camera", "joint", "gripper"),
)

MUCH = 0.1  # of the messages of the topic that is taken: another one with as many may be it

# Best first.
KINDS: dict[str, tuple[Kind, ...]] = {
    "command": (
        Kind(
            "geometry_msgs/msg/Twist",
            _TWIST,
            _DRIVEN,
            rather=(*NAVIGATION, *BY_HAND, "input"),
        ),
        Kind(
            "geometry_msgs/msg/TwistStamped",
            _under("twist", _TWIST),
            _DRIVEN,
            rather=(*NAVIGATION, *BY_HAND, "input"),
        ),
        Kind(
            "ackermann_msgs/msg/AckermannDriveStamped",
            {"speed_mps": "drive.speed", "steering_rad": "drive.steering_angle"},
            _ACKERMANN,
            rather=(*NAVIGATION, *BY_HAND, "input", "safety"),
        ),
        Kind(
            "ackermann_msgs/msg/AckermannDrive",
            {"speed_mps": "speed", "steering_rad": "steering_angle"},
            _ACKERMANN,
            rather=(*NAVIGATION, *BY_HAND, "input", "safety"),
        ),
    ),
    "pose": (
        Kind(
            "geometry_msgs/msg/PoseWithCovarianceStamped",
            _under("pose.pose", _POSE),
            ("amcl", "pose", "local"),
            never=_ELSEWHERE,
        ),
        Kind(
            "geometry_msgs/msg/PoseStamped",
            _under("pose", _POSE),
            ("robot_pose", "tracked_pose", "slam", "pose"),
            must=True,
            never=_ELSEWHERE,
        ),
        Kind("nav_msgs/msg/Odometry", _under("pose.pose", _POSE), ("filtered", "map", "odom")),
        # Of motion capture and the like, whatever their names.
        Kind("geometry_msgs/msg/PoseStamped", _under("pose", _POSE), never=_ELSEWHERE),
        Kind(
            "geometry_msgs/msg/TransformStamped",
            {
                "x_m": "transform.translation.x",
                "y_m": "transform.translation.y",
                "orientation": "transform.rotation",
            },
            never=_ELSEWHERE,
        ),
        Kind("geometry_msgs/msg/Pose", _POSE, ("pose",), never=_ELSEWHERE),
        Kind(
            "geometry_msgs/msg/Pose2D",
            {"x_m": "x", "y_m": "y", "yaw_rad": "theta"},
            ("pose",),
            never=_ELSEWHERE,
        ),
        Kind(FIX, FIX_FIELDS, ("fix", "gps", "gnss"), never=("filtered",)),
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
    "nav_command": (
        Kind("geometry_msgs/msg/Twist", _TWIST, NAVIGATION, must=True, never=BY_HAND),
        Kind(
            "geometry_msgs/msg/TwistStamped",
            _under("twist", _TWIST),
            NAVIGATION,
            must=True,
            never=BY_HAND,
        ),
    ),
    "behaviour_policy": (
        Kind("std_msgs/msg/String", {"text": "data"}, ("policy", "mode", "behavi"), must=True),
    ),
    "true_condition": (
        Kind(
            "std_msgs/msg/String",
            {"text": "data"},
            ("ground_truth", "true_cond"),
            must=True,
            never=("exposure",),
        ),
    ),
    "true_exposure": (Kind("std_msgs/msg/String", {"text": "data"}, ("exposure",), must=True),),
    "perturbation": (Kind("std_msgs/msg/String", {"text": "data"}, ("perturbation",), must=True),),
}
# Where that is asked for: the measured motion in place of commands that were not recorded.
ODOMETRY_AS_COMMAND = (
    Kind("nav_msgs/msg/Odometry", _under("twist.twist", _TWIST), ("wheel", "odom")),
)
# Message type -> what of a robot it is. Poses may also be of odometry's type.
_KIND_OF = {
    kind.type: role
    for role in ("pose", "imu", "scan", "plan", "wheels", "command")
    for kind in KINDS[role]
}
REQUIRED = ("command", "pose")
FIXED_FRAMES = ("map", "odom", "world")  # best first
LATCHED = ("goal", "plan", "behaviour_policy", "perturbation")
# Of Restock's own node: what a policy would have driven is no command of the robot.
NODE_TOPICS = frozenset((PROPOSAL, SHADOW, ACTION, LIMITER, TAKEOVER))
SPENT = (*LATCHED, "true_condition", "true_exposure")  # nothing else is in their topics

Roles = dict[str, list[tuple[TopicInfo, Kind]]]  # input -> …, best first


def usable_topics(recording: Recording) -> dict[str, TopicInfo]:
    """The topics that can be decoded and have messages, without those of Restock's node, and of
    other robots."""
    others = other_robots_topics(recording)
    return {
        name: topic
        for name, topic in _readable(recording)
        if name not in NODE_TOPICS and name not in others
    }


def robots_in(recording: Recording) -> list[str]:
    """The namespaces of a recording's robots, where it has several; first the one to propose for:
    with a command, and topics of most kinds.

    Robots' namespaces lie side by side, and topics of two kinds at least have the same name in
    more than one of them: `/front/scan` and `/rear/scan`, or two sources of `cmd_vel`, are of one
    robot.
    """
    inside: dict[str, list[tuple[str, str, TopicInfo]]] = {}  # namespace -> the rest, kind, topic
    where: dict[tuple[str, str, str], set[str]] = {}  # what is beside it, the rest, kind -> those
    for name, topic in _readable(recording):
        if (kind := _KIND_OF.get(topic.type)) is None:
            continue
        parts = name.strip("/").split("/")
        for place in range(1, len(parts)):
            namespace, rest = "/" + "/".join(parts[:place]), "/".join(parts[place:])
            inside.setdefault(namespace, []).append((rest, kind, topic))
            where.setdefault((namespace.rpartition("/")[0], rest, kind), set()).add(namespace)
    robots = []
    for namespace, topics in inside.items():
        beside = namespace.rpartition("/")[0]
        shared = {kind for rest, kind, _ in topics if len(where[beside, rest, kind]) > 1}
        if len(shared) > 1:
            robots.append(namespace)
    kinds = {robot: {kind for _, kind, _ in inside[robot]} for robot in robots}
    if len(robots) < 2 or not any("command" in found for found in kinds.values()):
        return []
    messages = {robot: sum(topic.expected for *_, topic in inside[robot]) for robot in robots}
    return sorted(
        robots,
        key=lambda one: (
            "command" not in kinds[one],
            -len(kinds[one] - {"imu"}),  # which everything can do without
            -messages[one],
            one,
        ),
    )


def other_robots_topics(recording: Recording) -> set[str]:
    """The topics of a recording's other robots than the one to propose for."""
    others = tuple(f"{robot}/" for robot in robots_in(recording)[1:])
    return {name for name in recording.topics if name.startswith(others)}


def own_first(recording: Recording, found: Iterable[tuple[str, T]]) -> Iterable[tuple[str, T]]:
    """What was found at these topics or nodes without what is of other robots than the one to
    propose for, and what is of no robot in particular last. Of one robot, as it is found."""
    robots = [f"{robot}/" for robot in robots_in(recording)]
    if not robots:
        return found
    kept = [one for one in found if not one[0].startswith(tuple(robots[1:]))]
    return sorted(kept, key=lambda one: not one[0].startswith(robots[0]))


def shared(recording: Recording, place: str) -> str:
    """What is to be said of a topic's or node's word on the robot to propose for; "": nothing."""
    robots = robots_in(recording)[:1]
    if not robots or place.startswith(f"{robots[0]}/"):
        return ""
    return f"{robots[0]} has none of its own that can be used: CHECK THAT IT IS OF THIS ROBOT"


def node_topics(recording: Recording) -> dict[str, str]:
    """The topics of Restock's node that can be decoded and have messages: name -> type."""
    return {name: topic.type for name, topic in _readable(recording) if name in NODE_TOPICS}


def _readable(recording: Recording) -> Iterator[tuple[str, TopicInfo]]:
    for name, topic in recording.topics.items():
        if topic.skipped is None and topic.expected:
            yield name, topic


def topics_for(
    topics: dict[str, TopicInfo], kinds: tuple[Kind, ...]
) -> list[tuple[TopicInfo, Kind]]:
    """The topics that may fill an input, best first: by kind, by name, by messages."""
    fitting = []
    for rank, kind in enumerate(kinds):
        for topic in topics.values():
            name = topic.name.lower()
            named = [place for place, word in enumerate(kind.words) if word in name]
            against = any(word in name for word in kind.never)
            later = any(word in name for word in kind.rather)
            if topic.type == kind.type and not against and (named or not kind.must):
                place = min(named, default=len(kind.words))
                fitting.append(((later, rank, place, -topic.expected, topic.name), topic, kind))
    return [(topic, kind) for _, topic, kind in sorted(fitting, key=lambda item: item[0])]


def several_commands(topics: dict[str, TopicInfo]) -> list[str]:
    """All topics that may be what drives the robot, best first, where there are several."""
    fitting = topics_for(topics, KINDS["command"])
    proposed = {topic.name for topic, _ in topics_for(topics, KINDS["nav_command"])}
    named = [
        topic.name
        for topic, kind in fitting
        if topic.name not in proposed
        and any(word in topic.name.lower() for word in kind.words)
        and topic.expected >= MUCH * fitting[0][0].expected
        and not any(word in topic.name.lower() for word in kind.rather)
    ]
    return named if len(named) > 1 else []


@dataclass(frozen=True)
class FrameGuess:
    """Two frames that transforms join, and all that there are."""

    fixed: str
    base: str
    chain: str
    localised: bool  # it leads to a map

    def lines(self, *, used: bool) -> list[str]:
        """The `[frames]` of a profile, commented out where it is not `used`."""
        mark = "" if used else "# "
        why = "poses from /tf and /tf_static" if used else "instead of inputs.pose, from /tf"
        return [
            f"{mark}[frames]  # {why}: {self.chain}",
            f'{mark}fixed = "{self.fixed}"',
            f'{mark}base = "{self.base}"',
            f"{mark}max_age_s = 0.5",
            "",
        ]


def transform_edges(recording: Recording) -> Edges:
    """The transforms of /tf and /tf_static; none where it has no such topics."""
    usual = Frames()
    wanted = {
        name: list(FIELDS)
        for name in (usual.topic, usual.static_topic)
        if name in recording.topics and set(FIELDS) <= set(recording.leaves(name))
    }
    return Edges.of(usual, recording.read(wanted) if wanted else {})


def transform_frames(recording: Recording) -> FrameGuess | None:
    """The map's and the robot's frame, or None where no transforms join any such two."""
    edges = transform_edges(recording)
    frames = {frame for child, up in edges.parents.items() for frame in (child, *up)}
    others = {robot.rpartition("/")[2] for robot in robots_in(recording)[1:]}
    frames = {frame for frame in frames if frame.split("/")[0] not in others}
    for fixed in named_frames(FIXED_FRAMES, frames):
        for base in named_frames(BASE_FRAMES, frames):
            if fixed in upward(base, edges.parents):
                chain = " -> ".join(_chain(base, fixed, edges))
                return FrameGuess(fixed, base, chain, fixed.split("/")[-1] == "map")
    return None


def named_frames(words: tuple[str, ...], frames: set[str]) -> list[str]:
    """The frames of these names, a robot's prefix before them or not; best first."""
    return [name for word in words for name in sorted(frames) if name.split("/")[-1] == word]


def _chain(base: str, fixed: str, edges: Edges) -> list[str]:
    """The frames from the fixed one down to the base."""
    way = [base]
    while way[-1] != fixed:
        ups = [up for up in edges.parents[way[-1]] if fixed in upward(up, edges.parents)]
        if not ups or ups[0] in way:
            break
        way.append(ups[0])
    return way[::-1]
