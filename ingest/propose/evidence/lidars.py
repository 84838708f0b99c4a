"""The lidars of a robot that has several, or one beside its middle: whose scans are joined."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from restock.ingest.containers.recording import Recording
from restock.ingest.containers.topic_reading import Fields, Reduction, TopicInfo
from restock.ingest.decoding.columns import FieldColumn, Ragged
from restock.ingest.profile.inputs import SCANS
from restock.ingest.propose.evidence.footprint import Footprint
from restock.ingest.propose.evidence.roles import Kind, Roles
from restock.ingest.propose.evidence.scanned_outline import lidar_place
from restock.ingest.steps.clearance import BEAMS
from restock.ingest.steps.frames import Edges, frame_id_path, plain
from restock.ingest.task.signals import yaw_of
from restock.ingest.urdf.description import BASE_FRAMES

MIN_ASIDE_M = 0.05  # of the middle: a lidar whose input must say where it is
WIDE_RAD = math.radians(150)  # a depth camera's scan is narrower, and of no height of a lidar
Place = tuple[float, float, float]  # ahead and to the left (m), and turned (rad)
_TURN = 2 * math.pi
_BINS = 360  # of the circle


@dataclass(frozen=True)
class MountedLidar:
    """Where a lidar is in the frame of the outline's middle, and how its scans lie there."""

    x_m: float = 0.0  # ahead
    y_m: float = 0.0  # to the left
    yaw_rad: float = 0.0
    upside_down: bool = False

    def lines(self) -> list[str]:
        """The keys of its input."""
        at = f"[{round(self.x_m, 3) + 0.0:g}, {round(self.y_m, 3) + 0.0:g}]"
        return [
            f"lidar_at_m = {at}  # ahead of the middle, and to the left",
            f"lidar_yaw_rad = {round(self.yaw_rad, 4) + 0.0:g}",
        ]


@dataclass(frozen=True)
class View:
    """The beams of a scan's last message, as seen from above, in the lidar's own frame."""

    low_rad: float
    high_rad: float
    step_rad: float
    beams: int


@dataclass(frozen=True)
class SeenScans:
    """What a topic's scans say of the lidar that made them."""

    frame: str = ""  # that the first one is in; "": it does not say
    angles: tuple[float, float, float] | None = None  # first, last, step (rad), of the last one
    origin: Place = (0.0, 0.0, 0.0)  # of the last one's lidar in its frame

    def seen_from(self, x_m: float, y_m: float, yaw_rad: float, *, upside_down: bool) -> Place:
        """Where the lidar is, and its zero, if its frame is here."""
        ahead, left, turn = self.origin
        left, turn = (-left, -turn) if upside_down else (left, turn)
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        at_m = x_m + cos * ahead - sin * left, y_m + sin * ahead + cos * left
        return *at_m, math.remainder(yaw_rad + turn, _TURN) if turn else yaw_rad

    def view(self, *, upside_down: bool = False) -> View | None:
        """What the last scan covers; None where it does not say, or not sanely."""
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
        return View(low, min(high, low + _TURN), abs(step), count)


def lidars_of(
    recording: Recording,
    fits: Sequence[tuple[TopicInfo, Kind]],
    scanned: Mapping[str, SeenScans],
    edges: Edges,
    footprint: Footprint,
) -> dict[str, tuple[TopicInfo, Kind, MountedLidar]]:
    """By the name of its input, each lidar whose place its input must say; empty where the robot
    has one lidar, ahead of or behind the middle of its outline.

    Several are those of different places on the base of the first, by transforms, that see 150
    degrees or more. A topic in the frame of the base has been made of the others
    (`made_of_others_first`).
    """
    if not fits:
        return {}
    found = _several(recording, fits, scanned, edges, footprint.middle_m) if len(fits) > 1 else {}
    if len(found) > 1:
        return found
    if abs(footprint.lidar_y_m) <= MIN_ASIDE_M:
        return {}
    lidar = MountedLidar(
        footprint.lidar_x_m or 0.0,
        footprint.lidar_y_m,
        footprint.lidar_yaw_rad or 0.0,
        footprint.upside_down,
    )
    return {SCANS[0]: (*fits[0], lidar)}


def _several(
    recording: Recording,
    fits: Sequence[tuple[TopicInfo, Kind]],
    scanned: Mapping[str, SeenScans],
    edges: Edges,
    middle_m: tuple[float, float],
) -> dict[str, tuple[TopicInfo, Kind, MountedLidar]]:
    found: dict[str, tuple[TopicInfo, Kind, MountedLidar]] = {}
    base, taken = "", set[str]()
    for topic, kind in fits:
        frame, view = scanned[topic.name].frame, scanned[topic.name].view()
        wide = view is not None and view.high_rad - view.low_rad >= WIDE_RAD
        apart = wide and frame not in taken and plain(frame) not in BASE_FRAMES
        place = lidar_place(recording, edges, frame) if apart else None
        if place is None and not found:  # the others are no reason to leave the first
            return {}
        if place is None or (found and place.base != base):  # another robot's is on another base
            continue
        base = place.base
        taken.add(frame)
        at = (place.x_m - middle_m[0], place.y_m - middle_m[1], place.yaw_rad)
        at = scanned[topic.name].seen_from(*at, upside_down=place.upside_down)
        lidar = MountedLidar(*at, place.upside_down)
        found[SCANS[len(found)]] = (topic, kind, lidar)
        if len(found) == len(SCANS):
            break
    return found


def made_of_others_first(
    fits: Sequence[tuple[TopicInfo, Kind]], scanned: Mapping[str, SeenScans]
) -> list[tuple[TopicInfo, Kind]]:
    """The scans' topics, those in the frame of the base first: of several lidars, as a node that
    puts their scans together publishes them."""
    return sorted(fits, key=lambda fit: plain(scanned[fit[0].name].frame) not in BASE_FRAMES)


def with_scans(roles: Roles, lidars: Mapping[str, tuple[TopicInfo, Kind, MountedLidar]]) -> Roles:
    """The roles with an input for each lidar, after that of the first one."""
    found: Roles = {}
    for role, fits in roles.items():
        if role != SCANS[0]:
            found[role] = fits
            continue
        taken = {topic.name for topic, _, _ in lidars.values()}
        others = [fit for fit in fits if fit[0].name not in taken]
        for name, (topic, kind, _) in lidars.items():
            found[name] = [(topic, kind), *(others if name == SCANS[0] else [])]
    return found


def seen_from_middle(footprint: Footprint, lidars: Sequence[MountedLidar]) -> Footprint:
    """The footprint where the lidars' inputs say where they are; a guess holds them all."""
    length, width = footprint.length_m, footprint.width_m
    if not footprint.measured:
        length = max(length, *(2 * abs(lidar.x_m) for lidar in lidars))
        width = max(width, *(2 * abs(lidar.y_m) for lidar in lidars))
    return replace(
        footprint,
        length_m=length,
        width_m=width,
        lidar_x_m=0.0,
        lidar_y_m=0.0,
        lidar_yaw_rad=0.0,
        upside_down=False,
        lidar_unplaced=footprint.lidar_unplaced if len(lidars) == 1 else "",
    )


def moved_in_frame(footprint: Footprint, scans: SeenScans) -> Footprint:
    """The footprint, whose lidar is where its frame is, with the lidar where scans say it is."""
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
    """topic -> what its scans say of their lidar: of all topics in one pass."""
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
    """Where scans say the angles of their first and last beam, and if they do, the step."""
    fields = kind.fields
    step = [fields["angle_increment_rad"]] if "angle_increment_rad" in fields else []
    return [fields["angle_min_rad"], fields.get("angle_max_rad", "angle_max"), *step]


def _beam_counts(fields: Fields) -> dict[str, FieldColumn]:
    (ranges,) = fields.values()
    lengths = ranges.lengths if isinstance(ranges, Ragged) else np.full(*ranges.shape)
    return {BEAMS: lengths}


def _origin(kind: Kind, fields: Collection[str]) -> list[str]:
    """Where scans say where in their frame the lidar is, if they do."""
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


def joined_view(views: Sequence[tuple[View, float]]) -> View | None:
    """What several lidars cover together, in the robot's frame: each with how it is turned (rad).

    None where that is all around.
    """
    covered = np.zeros(_BINS, np.bool_)
    for view, yaw_rad in views:
        first = round((view.low_rad + yaw_rad) / _TURN * _BINS)
        count = round((view.high_rad - view.low_rad + view.step_rad) / _TURN * _BINS)
        covered[np.arange(first, first + min(count, _BINS)) % _BINS] = True
    gaps = np.flatnonzero(~covered)
    if not len(gaps):
        return None
    # From the end of the widest gap to its start: the circle is opened there.
    runs = np.split(gaps, np.flatnonzero(np.diff(gaps) > 1) + 1)
    if len(runs) > 1 and gaps[0] == 0 and gaps[-1] == _BINS - 1:
        runs = [np.concatenate([runs[-1] - _BINS, runs[0]]), *runs[1:-1]]
    widest = max(runs, key=len)
    low = (int(widest[-1]) + 1) / _BINS * _TURN
    high = low + (_BINS - len(widest)) / _BINS * _TURN
    back = _TURN * round((low + high) / 2 / _TURN)  # the middle of it within half a turn
    step = min(view.step_rad for view, _ in views)
    return View(low - back, high - back, step, round((high - low) / step) + 1)
