"""Where a robot's lidar is, by descriptions, transforms and its scans, and what these cover."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from restock.ingest.containers.recording import Recording
from restock.ingest.containers.topic_reading import Fields, Reduction, TopicInfo
from restock.ingest.decoding.columns import FieldColumn, Ragged
from restock.ingest.profile.tables import Clock, Frames
from restock.ingest.propose.evidence.footprint import OWN_SPREAD_M, Footprint, ScannedOutline
from restock.ingest.propose.evidence.pose_choice import named_frames, transform_topics
from restock.ingest.propose.evidence.roles import Kind
from restock.ingest.steps.align import align
from restock.ingest.steps.clearance import BEAMS
from restock.ingest.steps.frames import Edges, Tree, frame_id_path, plain, upward
from restock.ingest.task.signals import yaw_of
from restock.ingest.urdf.description import BASE_FRAMES

MAX_ASIDE_M = 3.0  # of the middle: a lidar
MIN_RANGE_M = 0.01
Place = tuple[float, float, float]  # ahead and to the left (m), and turned (rad)
_TURN = 2 * math.pi
_LIMITS = ("range_min", "range_max")


@dataclass(frozen=True)
class View:
    """The beams of a scan's last message, as seen from above, in the lidar's own frame."""

    low_rad: float
    high_rad: float
    beams: int

    def turned(self, yaw_rad: float) -> View:
        """Return the view of a lidar that is turned so, in the robot's frame."""
        if not yaw_rad:
            return self
        low, high = self.low_rad + yaw_rad, self.high_rad + yaw_rad
        back = _TURN * round((low + high) / 2 / _TURN)  # the middle of it within half a turn
        return View(low - back, high - back, self.beams)


@dataclass(frozen=True)
class SeenScans:
    """The frame and angles of a topic's scans."""

    frame: str = ""  # that the first one is in; "": it does not say
    angles: tuple[float, float, float] | None = None  # first, last, step (rad), of the last one
    origin: Place = (0.0, 0.0, 0.0)  # of the last one's lidar in its frame

    def seen_from(self, x_m: float, y_m: float, yaw_rad: float, *, upside_down: bool) -> Place:
        """Return the lidar's place and the direction of its zero, for a frame that is here."""
        ahead, left, turn = self.origin
        left, turn = (-left, -turn) if upside_down else (left, turn)
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        at_m = x_m + cos * ahead - sin * left, y_m + sin * ahead + cos * left
        return *at_m, math.remainder(yaw_rad + turn, _TURN) if turn else yaw_rad

    def view(self, *, upside_down: bool = False) -> View | None:
        """Return what the last scan covers; None if it does not say, or not sanely."""
        if self.angles is None:
            return None
        sign = -1 if upside_down else 1
        first, last, step = (sign * one + 0.0 for one in self.angles)  # no "-0.0" in a file
        if not (np.isfinite([first, last, step]).all() and step and abs(step) > 1e-4):
            return None
        count = round((last - first) / step) + 1
        low, high = min(first, last), max(first, last)
        if count < 4 or not 0 < high - low < _TURN + 0.1 or max(abs(low), abs(high)) > 7:
            return None
        return View(low, min(high, low + _TURN), count)


def moved_in_frame(footprint: Footprint, scans: SeenScans) -> Footprint:
    """Move the lidar of a footprint from its frame to where its scans say it is."""
    if scans.origin == (0.0, 0.0, 0.0):
        return footprint
    frame = (footprint.lidar_x_m or 0.0, footprint.lidar_y_m, footprint.lidar_yaw_rad or 0.0)
    x, y, yaw = scans.seen_from(*frame, upside_down=footprint.upside_down)
    source = f"{footprint.lidar_source}, and the pose in its scans"
    if footprint.lidar_x_m is None:
        source = f"by the pose in its scans; that {scans.frame} is the middle is a guess"
    length, width = footprint.length_m, footprint.width_m
    if not footprint.measured:  # a guess holds it
        length, width = max(length, 2 * abs(x)), max(width, 2 * abs(y))
    return replace(
        footprint,
        length_m=length,
        width_m=width,
        lidar_x_m=x,
        lidar_y_m=y,
        lidar_yaw_rad=yaw,
        lidar_source=source,
    )


def scans_of(recording: Recording, fits: Sequence[tuple[TopicInfo, Kind]]) -> dict[str, SeenScans]:
    """Read the frame and angles of each topic's scans, of all topics in one pass."""
    wanted, counted = dict[str, list[str]](), dict[str, Reduction]()
    for topic, kind in fits:
        leaves = set(recording.leaves(topic.name))
        frame, angles = frame_id_path(leaves), _angles(kind)
        kept = angles if leaves.issuperset(angles) else []
        wanted[topic.name] = [*([frame] if frame else []), *kept, *_origin(kind, leaves)]
        if len(kept) == 2:  # by the last of so many
            counted[topic.name] = Reduction((kind.fields["ranges_m"],), _beam_counts)
    columns = recording.read(wanted, counted) if wanted else {}
    return {
        topic.name: _seen(columns[topic.name].fields, kind)
        for topic, kind in fits
        if topic.name in columns
    }


def _angles(kind: Kind) -> list[str]:
    """Return the paths of a scan's first and last angle and, if it has one, of the step."""
    fields = kind.fields
    step = [fields["angle_increment_rad"]] if "angle_increment_rad" in fields else []
    return [fields["angle_min_rad"], fields.get("angle_max_rad", "angle_max"), *step]


def _beam_counts(fields: Fields) -> dict[str, FieldColumn]:
    (ranges,) = fields.values()
    lengths = ranges.lengths if isinstance(ranges, Ragged) else np.full(*ranges.shape)
    return {BEAMS: lengths}


def _origin(kind: Kind, fields: Collection[str]) -> list[str]:
    """Return the paths of the lidar's pose in the frame of its scans, if they have one."""
    paths = [f"{kind.origin}.position.{axis}" for axis in "xy"]
    paths += [f"{kind.origin}.orientation.{axis}" for axis in "xyzw"]
    return paths if set(paths) <= set(fields) else []


def _seen(fields: Mapping[str, FieldColumn], kind: Kind) -> SeenScans:
    angles, origin = _angles(kind), (0.0, 0.0, 0.0)
    columns = {path: np.asarray(column) for path, column in fields.items()}
    if not all(map(len, columns.values())):
        return SeenScans()
    frame = frame_id_path(columns)
    said = "" if frame is None else str(columns[frame][0])
    if place := _origin(kind, columns):
        x, y, *turn = (np.asarray(columns[path][-1:], np.float64) for path in place)
        yaw = float(yaw_of(*turn)[0])
        origin = (float(x[0]), float(y[0]), yaw if np.isfinite(yaw) else 0.0)
    if angles[0] not in columns:
        return SeenScans(said, None, origin)
    first, last, *step = (float(columns[path][-1]) for path in angles)
    if not step:
        step = [(last - first) / max(int(columns[BEAMS][-1]) - 1, 1)]
    return SeenScans(said, (first, last, step[0]), origin)


@dataclass(frozen=True)
class LidarPlace:
    """The place of a lidar in a robot's base frame, by transforms."""

    base: str
    x_m: float  # ahead
    y_m: float  # to the left
    yaw_rad: float
    upside_down: bool


def lidar_place(recording: Recording, edges: Edges, scan_frame: str) -> LidarPlace | None:
    """Place the lidar by the last of the recording's transforms.

    None if they do not, or not sanely.
    """
    if not scan_frame:
        return None
    frames = {frame for child, up in edges.parents.items() for frame in (child, *up)}
    topic, static_topic = transform_topics(recording)
    for base in named_frames(BASE_FRAMES, frames):
        if plain(scan_frame) == base:
            return LidarPlace(base, 0.0, 0.0, 0.0, False)
        if base not in upward(plain(scan_frame), edges.parents):
            continue
        usual = Frames(base, scan_frame, topic=topic, static_topic=static_topic)
        kept = edges.only({base, scan_frame})
        segments, _ = align(kept.topics, Clock(alignment="log_time"), kept.static)
        last = max(int(s.stamp_ns[-1]) for s in segments[-1].topics.values() if len(s.stamp_ns))
        times = [np.zeros(0, np.int64) for _ in segments[:-1]] + [np.array([last])]
        at = Tree(usual, kept, segments).place(scan_frame, times)
        x, y = (float(way) for way in at.translation_m[0, :2])
        yaw = float(at.yaw_rad[0])
        if at.problem[0] == "" and max(abs(x), abs(y)) < MAX_ASIDE_M and np.isfinite(yaw):
            return LidarPlace(base, x, y, yaw, bool(at.rotation[0, 2, 2] < 0))
    return None


def with_lidar(footprint: Footprint, place: LidarPlace | None) -> Footprint:
    """Add the lidar's place by transforms to the footprint, with the base frame as its middle.

    An outline that is guessed is made as large as to hold it. Of one that is measured, a lidar
    outside says that the base frame is not its middle: then only how it is turned is known.
    """
    if place is None:
        return footprint
    turned = replace(footprint, lidar_yaw_rad=place.yaw_rad, upside_down=place.upside_down)
    source = f"of {place.base}, by transforms; that this is the middle is a guess"
    if not footprint.measured:
        sizes = (footprint.length_m, place.x_m), (footprint.width_m, place.y_m)
        length, width = (max(usual, 2 * abs(at)) for usual, at in sizes)
        turned = replace(turned, length_m=length, width_m=width)
    elif abs(place.x_m) > footprint.length_m / 2:
        return replace(turned, lidar_source=f"{place.base} has it {place.x_m:.2f} m ahead, outside")
    return replace(turned, lidar_x_m=place.x_m, lidar_y_m=place.y_m, lidar_source=source)


def range_lines(recording: Recording, topic: str, outline: ScannedOutline | None) -> list[str]:
    """Write the nearest and the farthest range of use, as keys of [task]."""
    low, high, why = _range_m(recording, topic, outline)
    return [
        f"range_min_m = {low:g}{why}",
        f"range_max_m = {high:g}  # lidar ranges beyond it count as free",
    ]


def _range_m(
    recording: Recording, topic: str, outline: ScannedOutline | None
) -> tuple[float, float, str]:
    """Return the nearest and the farthest range of use, at most 4 m, and a comment.

    The comment says why the lidar's own limits are not used. Of a lidar that gives 0 where nothing
    comes back, 0 is no range; nor is one of its own parts.
    """
    if not set(_LIMITS) <= set(recording.leaves(topic)):
        return 0.05, 4.0, ""
    columns = recording.read({topic: _LIMITS})[topic].fields
    low, high = (float(np.median(np.asarray(columns[path]))) for path in _LIMITS)
    if not 0 <= low < high < np.inf:
        return 0.05, 4.0, ""
    own_m = outline.own_range_m + OWN_SPREAD_M if outline and len(outline.own_m) else 0
    why = ""
    if low < MIN_RANGE_M:
        low, why = MIN_RANGE_M, "  # the lidar states less; 0 is where nothing came back"
    if own_m > low:
        low, why = own_m, "  # beyond the robot's own parts, which the lidar sees"
    return round(low, 3), min(round(high, 3), 4.0), why
