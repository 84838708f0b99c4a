"""Guesses what a topic is for, and of which robot, from message types and names."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from restock.errors import ConfigError
from restock.ingest.containers.recording import Recording
from restock.ingest.containers.storage import TopicInfo
from restock.ingest.live.node import ACTION, LIMITER, PROPOSAL, SHADOW, TAKEOVER
from restock.ingest.profile.signal_paths import last_part
from restock.ingest.profile.tables import Input
from restock.ingest.steps.needs import field_paths

_TWIST = {"speed_mps": "linear.x", "yaw_rate_radps": "angular.z"}
_PLACE = {"x_m": "position.x", "y_m": "position.y"}
_SCAN = {"ranges_m": "ranges", "angle_min_rad": "start_angle", "angle_max_rad": "end_angle"}
_POSE = {**_PLACE, "orientation": "orientation"}


def _under(path: str, fields: dict[str, str]) -> dict[str, str]:
    return {key: f"{path}.{value}" for key, value in fields.items()}


@dataclass(frozen=True)
class Kind:
    """A message type that may fill an input, with its fields and rules for names of topics."""

    type: str
    fields: dict[str, str]
    words: tuple[str, ...] = ()  # words in a topic's name that favour it, best first
    must: bool = False  # require one of `words`
    never: tuple[str, ...] = ()  # words in a topic's name that exclude it
    rather: tuple[str, ...] = ()  # words in a topic's name that put it last
    at_changes: bool = False  # messages come only at changes; each is valid until the next

    @property
    def by_fix(self) -> bool:
        """Return whether this kind is a position by latitude and longitude."""
        return "latitude_deg" in self.fields


# Satellite fixes, used if nothing else gives the robot's position.
_STATED_FIX = {
    "latitude_deg": "latitude",
    "longitude_deg": "longitude",
    "status": "status.status",
    "covariance_m2": "position_covariance",
    "covariance_type": "position_covariance_type",
}
_FIX = {key: path for key, path in _STATED_FIX.items() if key != "status"}
_RECEIVERS = ("fix", "gps", "gnss")

# Words in names of commands that navigation sends to a multiplexer, a smoother or a remote.
NAVIGATION = ("nav", "move_base", "planner", "autonom", "cmd_vel_raw", "raw_cmd_vel")
# Names of commands, the nearest to the motors first: a multiplexer's output before its inputs.
_DRIVEN = ("cmd_vel_out", "mux/out", "mux/cmd_vel", "cmd_vel")
_ACKERMANN = ("low_level", "output", "ackermann_cmd", "drive")
BY_HAND = ("teleop", "joy", "key", "web", "remote")
_CHOSEN_FROM = (*NAVIGATION, *BY_HAND, "input")

# Words in the names of poses that are not the robot's.
_ELSEWHERE = (
    *("goal", "target", "initial", "waypoint", "click", "marker", "object", "human", "person"),
    *("people", "dock", "desired", "setpoint", "reference", "camera", "joint", "gripper"),
)

_ROBOTS_POSE = ("robot_pose", "tracked_pose", "slam", "pose")
_PATHS = ("plan", "path")
# Names of paths that do not lead to the goal, but only as far as a controller looks.
_NEAR_PATHS = ("local_plan", "local_path", "local_traj", "transformed_", "pruned_")

_MEASURED = (
    Kind("nav_msgs/msg/Odometry", _under("twist.twist", _TWIST), ("wheel", "odom")),
    Kind(
        "foxglove.Odometry",
        {"speed_mps": "linear_velocity.x", "yaw_rate_radps": "angular_velocity.z"},
        ("wheel", "odom"),
    ),
)

MUCH = 0.1  # another topic may be the right one if it has this share of the chosen one's messages

_TWISTS = (
    ("geometry_msgs/msg/Twist", _TWIST),
    ("geometry_msgs/msg/TwistStamped", _under("twist", _TWIST)),
)
_STEERED = {"speed_mps": "speed", "steering_rad": "steering_angle"}
_STEERINGS = (
    ("ackermann_msgs/msg/AckermannDriveStamped", _under("drive", _STEERED)),
    ("ackermann_msgs/msg/AckermannDrive", _STEERED),
)
_POSES = ("geometry_msgs/msg/PoseStamped", "foxglove.PoseInFrame")
_ODOMETRY = (("nav_msgs/msg/Odometry", "pose.pose"), ("foxglove.Odometry", "pose"))


def _texts(words: tuple[str, ...], never: tuple[str, ...] = ()) -> tuple[Kind, ...]:
    return (Kind("std_msgs/msg/String", {"text": "data"}, words, must=True, never=never),)


# Input -> the kinds of topic that may fill it, best first.
KINDS: dict[str, tuple[Kind, ...]] = {
    "command": (
        *(Kind(name, fields, _DRIVEN, rather=_CHOSEN_FROM) for name, fields in _TWISTS),
        *(
            Kind(name, fields, _ACKERMANN, rather=(*_CHOSEN_FROM, "safety"))
            for name, fields in _STEERINGS
        ),
    ),
    "pose": (
        Kind(
            "geometry_msgs/msg/PoseWithCovarianceStamped",
            _under("pose.pose", _POSE),
            ("amcl", "pose", "local"),
            never=_ELSEWHERE,
        ),
        *(
            Kind(name, _under("pose", _POSE), _ROBOTS_POSE, must=True, never=_ELSEWHERE)
            for name in _POSES
        ),
        *(Kind(name, _under(at, _POSE), ("filtered", "map", "odom")) for name, at in _ODOMETRY),
        # Poses from motion capture and similar systems, whatever the topic's name.
        *(Kind(name, _under("pose", _POSE), never=_ELSEWHERE) for name in _POSES),
        Kind(
            "geometry_msgs/msg/TransformStamped",
            _under(
                "transform",
                {"x_m": "translation.x", "y_m": "translation.y", "orientation": "rotation"},
            ),
            never=_ELSEWHERE,
        ),
        Kind("geometry_msgs/msg/Pose", _POSE, ("pose",), never=_ELSEWHERE),
        Kind(
            "geometry_msgs/msg/Pose2D",
            {"x_m": "x", "y_m": "y", "yaw_rad": "theta"},
            ("pose",),
            never=_ELSEWHERE,
        ),
        Kind("sensor_msgs/msg/NavSatFix", _STATED_FIX, _RECEIVERS, never=("filtered",)),
        Kind("foxglove.LocationFix", _FIX, _RECEIVERS, never=("filtered",)),
    ),
    "wheels": _MEASURED,
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
            rather=("back", "rear"),
        ),
        Kind("foxglove.LaserScan", _SCAN, ("scan",), rather=("back", "rear")),
    ),
    "goal": (
        Kind(  # every goal that move_base got
            "move_base_msgs/msg/MoveBaseActionGoal", _under("goal.target_pose.pose", _PLACE)
        ),
        *(Kind(name, _under("pose", _PLACE), ("goal",), must=True) for name in _POSES),
    ),
    "plan": (
        Kind("nav_msgs/msg/Path", _under("poses[].pose", _PLACE), _PATHS, never=_NEAR_PATHS),
        Kind("foxglove.PosesInFrame", _under("poses[]", _PLACE), _PATHS, True, _NEAR_PATHS),
    ),
    "bumper": (
        Kind("std_msgs/msg/Bool", {"pressed": "data"}, ("bump", "contact"), must=True),
        *(
            Kind(f"{package}/msg/Bumper", {"pressed": "is_left_pressed or is_right_pressed"})
            for package in ("create_msgs", "ca_msgs")
        ),
        Kind(  # irobot_create_msgs/HazardDetection: BUMP = 1
            "irobot_create_msgs/msg/HazardDetectionVector", {"pressed": "detections[type=1].type"}
        ),
        # Bits, or 0: nothing is pressed.
        *(
            Kind(f"{package}/msg/SensorState", {"pressed": "bumper"})
            for package in ("kobuki_ros_interfaces", "kobuki_msgs", "turtlebot3_msgs")
        ),
        *(
            Kind(f"{package}/msg/BumperEvent", {"pressed": "state"}, at_changes=True)
            for package in ("kobuki_ros_interfaces", "kobuki_msgs")
        ),
    ),
    "nav_command": tuple(
        Kind(name, fields, NAVIGATION, must=True, never=BY_HAND) for name, fields in _TWISTS
    ),
    "behaviour_policy": _texts(("policy", "mode", "behavi")),
    "true_condition": _texts(("ground_truth", "true_cond"), never=("exposure",)),
    "true_exposure": _texts(("exposure",)),
    "perturbation": _texts(("perturbation",)),
}
# Used on request: the measured motion in place of commands that were not recorded.
ODOMETRY_AS_COMMAND = _MEASURED
# Message type -> input, to recognise a robot's namespace. Odometry, also a pose, counts as wheels.
_KIND_OF = {
    name: role
    for role in ("pose", "imu", "scan", "plan", "wheels", "command")
    for kind in KINDS[role]
    for name in (kind.type, last_part(kind.type))
}
_OTHER_ENCODINGS = ("json", "protobuf")
REQUIRED = ("command", "pose")
LATCHED = ("goal", "plan", "behaviour_policy", "perturbation")
# Topics of Restock's own node. Actions that a policy only proposed are no commands of the robot.
NODE_TOPICS = frozenset((PROPOSAL, SHADOW, ACTION, LIMITER, TAKEOVER))
SPENT = (*LATCHED, "true_condition", "true_exposure")  # inputs whose topics have no other use

Roles = dict[str, list[tuple[TopicInfo, Kind]]]  # input -> topics that may fill it, best first


def usable_topics(recording: Recording) -> dict[str, TopicInfo]:
    """Return the topics that can be decoded and have messages.

    Topics of Restock's node and of other robots are left out.
    """
    found = {name: topic for name, topic in _readable(recording) if name not in NODE_TOPICS}
    return {name: found[name] for name in sort_own_first(recording, found)}


def robots_in(recording: Recording) -> list[str]:
    """Return the namespaces of a recording's robots, if it has several.

    The robot to propose for is first: the chosen robot, or else a robot with a command and with
    topics of the most kinds.

    Sibling namespaces belong to robots if topics of at least two kinds have the same names in them.
    `/front/scan` and `/rear/scan`, or two sources of `cmd_vel`, belong to one robot.
    """
    kinds, messages = defaultdict[str, set[str]](set), Counter[str]()
    beside = defaultdict[tuple[str, str, str], set[str]](set)  # (parent, rest, kind) -> namespaces
    for name, topic in _readable(recording):
        other = topic.encoding in _OTHER_ENCODINGS
        if (kind := _KIND_OF.get(last_part(topic.type) if other else topic.type)) is None:
            continue
        parts = name.strip("/").split("/")
        for place in range(1, len(parts)):
            namespace = "/" + "/".join(parts[:place])
            kinds[namespace].add(kind)
            messages[namespace] += topic.expected
            beside[namespace.rpartition("/")[0], "/".join(parts[place:]), kind].add(namespace)
    common = {(one, kind) for (*_, kind), many in beside.items() if len(many) > 1 for one in many}
    robots = [one for one, count in Counter(one for one, _ in common).items() if count > 1]
    if len(robots) < 2 or not any("command" in kinds[one] for one in robots):
        return []
    return sorted(
        robots,
        key=lambda one: (
            one != recording.robot,
            "command" not in kinds[one],
            -len(kinds[one] - {"imu"}),  # an IMU does not count
            -messages[one],
            one,
        ),
    )


def choose_robot(recording: Recording, name: str) -> None:
    """Choose the robot to propose for by its namespace, if the recording has several robots.

    Raises:
        ConfigError: there is no such robot, or no topic in this namespace.
    """
    chosen, robots = f"/{name.strip('/')}", sorted(robots_in(recording))
    known = any(topic.startswith(f"{chosen}/") for topic in recording.topics)
    if not known or (robots and chosen not in robots):
        raise ConfigError(
            f"there is no robot {chosen} in the recording",
            where=str(recording.path),
            remedy=f"its robots are {', '.join(robots)}"
            if robots
            else "it seems to have a single robot: omit --robot",
        )
    recording.robot = chosen


def sort_own_first(recording: Recording, names: Iterable[str]) -> list[str]:
    """Drop topics of other robots, and put topics without a robot's namespace last."""
    robots = tuple(f"{robot}/" for robot in robots_in(recording))
    kept = [name for name in names if not name.startswith(robots[1:])]
    return sorted(kept, key=lambda name: not name.startswith(robots[:1]))


def sharing_warning(recording: Recording, place: str) -> str:
    """Return a warning if a topic may be another robot's, or ""."""
    robots = robots_in(recording)[:1]
    if not robots or place.startswith(f"{robots[0]}/"):
        return ""
    return f"{robots[0]} has none of its own that can be used: CHECK THAT IT IS OF THIS ROBOT"


def _readable(recording: Recording) -> Iterator[tuple[str, TopicInfo]]:
    for name, topic in recording.topics.items():
        if topic.skipped is None and topic.expected:
            yield name, topic


def _is_of(recording: Recording, topic: TopicInfo, kind: Kind) -> bool:
    """Return whether a topic's messages are of this kind.

    In JSON and protobuf, ROS types may be in any namespace (`ros.geometry_msgs.Twist`, `Twist`), so
    fields are checked as well. The fields of bumpers are also checked, because no ROS distribution
    defines the packages of their types.
    """
    other = topic.encoding in _OTHER_ENCODINGS
    of_ros = "/" in kind.type and last_part(topic.type) == last_part(kind.type)
    if topic.type != kind.type and not (other and of_ros):
        return False
    if not other and "pressed" not in kind.fields:
        return True
    paths = field_paths(Input(topic.name, topic.type, kind.fields))
    return set(paths) <= set(recording.leaves(topic.name))


FLAGS = {"bool", "uint8", "int8", "byte", "char"}
MAX_FLAGS = 8


def own_bumpers(recording: Recording) -> list[tuple[TopicInfo, Kind]]:
    """Return bumpers of unknown types: topics named like a bumper, with only flags as fields."""
    found = []
    for topic in usable_topics(recording).values():
        leaves = [one for one in recording.fields(topic.name) if not one.path.startswith("header.")]
        flags = all(one.kind in FLAGS and not one.dims for one in leaves)
        if "bump" in topic.name.lower() and flags and 0 < len(leaves) <= MAX_FLAGS:
            fields = {"pressed": " or ".join(one.path for one in leaves)}
            found.append((topic, Kind(topic.type, fields)))
    return found


def topics_for(recording: Recording, kinds: tuple[Kind, ...]) -> list[tuple[TopicInfo, Kind]]:
    """Sort the topics that may fill an input, best first.

    Topics in the robot's namespace come before those in no robot's namespace. Within each group,
    topics with a word of `rather` are last; the others are sorted by kind, word and messages.
    """
    own = tuple(f"{robot}/" for robot in robots_in(recording)[:1])
    topics, fitting = usable_topics(recording).values(), []
    for rank, kind in enumerate(kinds):
        for topic in topics:
            name = topic.name.lower()
            named = [place for place, word in enumerate(kind.words) if word in name]
            against = any(word in name for word in kind.never)
            if not against and (named or not kind.must) and _is_of(recording, topic, kind):
                others, later = not topic.name.startswith(own), any(w in name for w in kind.rather)
                place = min(named, default=len(kind.words))
                order = (others, later, rank, place, -topic.expected, topic.name)
                fitting.append((order, topic, kind))
    return [(topic, kind) for _, topic, kind in sorted(fitting, key=lambda item: item[0])]


def several_commands(recording: Recording) -> list[str]:
    """Return all topics that may drive the robot, best first, if there are several."""
    fitting = topics_for(recording, KINDS["command"])
    proposed = {topic.name for topic, _ in topics_for(recording, KINDS["nav_command"])}
    named = [
        topic.name
        for topic, kind in fitting
        if topic.name not in proposed
        and any(word in topic.name.lower() for word in kind.words)
        and topic.expected >= MUCH * fitting[0][0].expected
        and not any(word in topic.name.lower() for word in kind.rather)
    ]
    return named if len(named) > 1 else []
