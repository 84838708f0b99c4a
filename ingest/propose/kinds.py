"""Which recordings are of one kind of robot, by what they say themselves: never by file or folder.

Two recordings that both have a lidar, or both a robot's description, or both odometry, are of one
kind only if these agree. And something must tell one robot from the next: lidar or description.
Recordings with neither are of one kind if they have the same command, pose and odometry, and at
least half of their topics in common. What fits two kinds that differ is of neither.

And which recordings are of no robot on wheels: a drone's, an arm's, of cameras alone.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from restock.ingest.containers.recording import Recording
from restock.ingest.containers.topic_reading import TopicInfo
from restock.ingest.decoding.columns import Ragged
from restock.ingest.profile.inputs import is_motion
from restock.ingest.propose.evidence.commands import off_the_floor
from restock.ingest.propose.evidence.footprint import descriptions
from restock.ingest.propose.evidence.roles import KINDS, Kind, topics_for, usable_topics
from restock.ingest.steps.clocks import STAMP
from restock.ingest.steps.frames import FRAME_IDS, frame_id_path, plain
from restock.ingest.urdf.description import read_description

SCANS = 40  # of a recording that are looked at
BEAMS = 0.1  # of the beams, by which scans of one lidar may differ: some turn at their own pace
RANGE = 0.01
SIMULATED_NS = 10**8 * 10**9  # stamps before 1973 are of a simulation, which begins at 0
SHARED = 0.5  # of all topics
DRONES = ("mavros_msgs/", "px4_msgs/", "mav_msgs/", "ardupilot_msgs/", "crazyflie_interfaces/")
MULTI_DOF = "trajectory_msgs/msg/MultiDOFJointTrajectory"
ARMS = ("trajectory_msgs/msg/JointTrajectory", "control_msgs/", "moveit_msgs/")
CAMERAS = re.compile(r"sensor_msgs/msg/(Image|CompressedImage|CameraInfo|PointCloud2?)$")
ALONGSIDE = re.compile(r"tf2_msgs/|rcl_interfaces/|rosgraph_msgs/|std_msgs/|diagnostic_msgs/")
RISES_M = 0.5  # of a pose between its 5th and 95th percentile: no floor's
ON_WHEELS = "Restock is for wheeled robots: give a recording of one, with its velocity commands"


@dataclass(frozen=True)
class Lidar:
    """A lidar, as its scans describe it."""

    frame: str
    beams: int
    range_max_m: float  # 0: they do not say
    simulated: bool  # by their stamps

    def agrees(self, other: Lidar) -> bool:
        most = max(self.beams, other.beams, 1)
        longest = max(self.range_max_m, other.range_max_m)
        return (
            self.frame == other.frame
            and abs(self.beams - other.beams) <= BEAMS * most
            and (
                self.range_max_m == other.range_max_m
                or abs(self.range_max_m - other.range_max_m) <= RANGE * longest
            )
            and self.simulated == other.simulated
        )

    def __str__(self) -> str:
        clock = ", simulated clock" if self.simulated else ""
        reach = f", {self.range_max_m:g} m" if self.range_max_m else ""
        return f"lidar {self.frame}, {self.beams} beams{reach}{clock}"


@dataclass(frozen=True)
class RobotTraits:
    """The traits of a robot in one recording; None and "" if it does not show them."""

    command: str  # type of the topic that drives it
    frames: str  # of its odometry: "odom -> base_link"
    lidar: Lidar | None
    description: str  # a digest of it
    named: str  # the robot's name in it
    inputs: frozenset[tuple[str, str]]  # topics, with their types, that command and locate it
    topics: frozenset[tuple[str, str]]  # all of them

    def fits(self, other: RobotTraits) -> bool:
        """Return whether both may be one kind of robot, and something shows that they are."""
        for mine, its in (
            (self.command, other.command),
            (self.frames, other.frames),
            (self.description, other.description),
        ):
            if mine and its and mine != its:
                return False
        if self.lidar and other.lidar and not self.lidar.agrees(other.lidar):
            return False
        if (self.lidar and other.lidar) or (self.description and other.description):
            return True
        if self.lidar or other.lidar or self.description or other.description:
            return False
        shared = len(self.topics & other.topics)
        return self.inputs == other.inputs and shared >= SHARED * len(self.topics | other.topics)

    def __str__(self) -> str:
        reported = [
            self.named and f"described as {self.named}",
            str(self.lidar or ""),
            self.frames,
            self.command.split("/")[-1],
        ]
        topics = ", ".join(sorted(name for name, _ in self.inputs))
        return "; ".join(filter(None, reported)) or topics or "nothing that describes a robot"


def robot_traits(recording: Recording) -> RobotTraits:
    """Read the traits of a recording's robot, from a few of its scans and poses."""
    topics = usable_topics(recording)
    roles = {
        role: topics_for(recording, topics, KINDS[role]) for role in ("command", "pose", "wheels")
    }
    command = roles["command"][0][0].type if roles["command"] else ""
    odometry = next((t for fits in roles.values() for t, _ in fits if is_motion(t.type)), None)
    frames = ""
    if odometry is not None:
        leaves = recording.leaves(odometry.name)
        paths = [path for path in (*FRAME_IDS, "child_frame_id") if path in leaves]
        ends = recording.read({odometry.name: paths})[odometry.name].fields
        frames = " -> ".join(plain(str(np.asarray(ends[path], object)[0])) for path in paths)
    texts = [text for _, text in descriptions(recording)]
    described = read_description(texts[0]) if texts else ""
    return RobotTraits(
        command,
        frames,
        _lidar(recording, topics_for(recording, topics, KINDS["scan"])[:1]),
        hashlib.blake2b(texts[0].encode(), digest_size=8).hexdigest() if texts else "",
        "" if isinstance(described, str) else described.name,
        frozenset((t.name, t.type) for fits in roles.values() for t, _ in fits),
        frozenset((name, topic.type) for name, topic in recording.topics.items() if topic.expected),
    )


def robot_kinds(traits: Sequence[RobotTraits]) -> list[list[int]]:
    """Group the recordings by kind, as indices of `traits`; each is in exactly one kind.

    Kinds are in the order of their first recording.
    """
    rich_first = sorted(range(len(traits)), key=lambda one: (-_known(traits[one]), one))
    kinds: list[list[int]] = []
    for index in rich_first:
        fitting = [k for k in kinds if all(traits[index].fits(traits[other]) for other in k)]
        if len(fitting) == 1:
            fitting[0].append(index)
        else:
            kinds.append([index])
    return sorted(sorted(kind) for kind in kinds)


def _known(traits: RobotTraits) -> int:
    reported = (traits.description, traits.lidar, traits.frames, traits.command)
    return sum(bool(each) for each in reported)


def _lidar(recording: Recording, best: Sequence[tuple[TopicInfo, Kind]]) -> Lidar | None:
    if not best:
        return None
    name, path = best[0][0].name, best[0][1].fields["ranges_m"]
    leaves = recording.leaves(name)
    wanted = [one for one in (*FRAME_IDS, "range_max", STAMP) if one in leaves]
    columns = recording.read({name: [path, *wanted]})[name]
    if not len(columns):
        return None
    fields, some = columns.fields, slice(SCANS)
    ranges, frame = fields[path], frame_id_path(fields)
    assert isinstance(ranges, Ragged)
    stamps = np.asarray(fields[STAMP], np.int64)[some] if STAMP in fields else np.zeros(0)
    return Lidar(
        "" if frame is None else plain(str(np.asarray(fields[frame], object)[0])),
        int(np.median(ranges.lengths[some])),
        round(float(np.median(np.asarray(fields.get("range_max", [0]), np.float64)[some])), 3),
        bool(len(stamps)) and 0 < int(np.median(stamps)) < SIMULATED_NS,
    )


__all__ = ["RobotTraits", "robot_kinds", "robot_traits"]


def no_wheeled_robot(
    recording: Recording, command: Sequence[tuple[TopicInfo, Kind]], *, located: bool
) -> str | None:
    """Say what a recording is taken for that is not of a robot on wheels, and what to do.

    Else None.

    `command` are the topics that may drive it, `located` whether anything says where it is.
    """
    types = {topic.type for topic in recording.topics.values() if topic.expected}
    flying = sorted({t.split("/")[0] for t in types if t.startswith(DRONES) or t == MULTI_DOF})
    if not (command and located) and flying:
        reported = ", ".join(sorted(t for t in types if t.split("/")[0] in flying)[:3])
        return f"this looks like a drone's recording (it has {reported}): {ON_WHEELS}"
    rises_m, lifted = _rises_m(recording), _lifted(recording, command)
    if rises_m > RISES_M and (flying or lifted):
        reported = "commands go up and down" if lifted else f"it has topics of {flying[0]}"
        return (
            f"this looks like a drone's recording (it rises by {rises_m:.1f} m, {reported}): "
            f"{ON_WHEELS}"
        )
    if command:
        off, requested = off_the_floor(recording, command[0])
        if 2 * off <= requested:
            return None
        return (
            f"this looks like a robot arm's or a drone's recording ({off:,} of the {requested:,} "
            f"commands to move of {command[0][0].name} have linear.z, angular.x or angular.y): "
            f"{ON_WHEELS}"
        )
    arm = sorted(t for t in types if t.startswith(ARMS))
    if arm and not located:
        reported = f"it has {', '.join(arm[:2])}, no velocity command and no pose"
        return f"this looks like a robot arm's recording ({reported}): {ON_WHEELS}"
    rest = [t for t in types if not CAMERAS.search(t) and not ALONGSIDE.match(t)]
    if types and not rest and any(CAMERAS.search(t) for t in types):
        return (
            "this looks like a recording of sensors alone (it has images or point clouds, but no "
            "velocity command and no odometry): also record the command and a pose"
        )
    return None


def _rises_m(recording: Recording) -> float:
    """Return how far the poses of a recording go up and down; 0 if there are none."""
    rises = [0.0]
    for topic, kind in topics_for(recording, usable_topics(recording), KINDS["pose"]):
        path = kind.fields.get("x_m", "").removesuffix("x") + "z"
        if path in recording.leaves(topic.name):
            heights = np.asarray(recording.read({topic.name: [path]})[topic.name].fields[path])
            heights = heights[np.isfinite(heights)]
            rises.append(float(np.ptp(np.percentile(heights, [5, 95]))) if len(heights) else 0.0)
    return max(rises)


def _lifted(recording: Recording, command: Sequence[tuple[TopicInfo, Kind]]) -> bool:
    """Return whether the driving command asks for speed upward."""
    if not command:
        return False
    topic, kind = command[0]
    path = kind.fields["speed_mps"].removesuffix("x") + "z"
    if not path.endswith("linear.z"):
        return False
    return bool(np.any(np.asarray(recording.read({topic.name: [path]})[topic.name].fields[path])))
