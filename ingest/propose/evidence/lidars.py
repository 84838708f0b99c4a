"""The lidars of a robot that has several, or one beside its middle: whose scans are joined."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from restock.ingest.containers.recording import Recording
from restock.ingest.containers.topic_reading import TopicInfo
from restock.ingest.decoding.columns import FieldColumn
from restock.ingest.profile.inputs import SCANS
from restock.ingest.propose.evidence.footprint import Footprint
from restock.ingest.propose.evidence.roles import Kind, Roles
from restock.ingest.propose.evidence.scanned_outline import ROOM_M, lidar_place
from restock.ingest.steps.frames import FRAME_ID, Edges, plain
from restock.ingest.urdf.description import BASE_FRAMES

WIDE_RAD = math.radians(150)  # a depth camera's scan is narrower, and of no height of a lidar
_ANGLES = ("angle_min", "angle_max", "angle_increment")
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
    if abs(footprint.lidar_y_m) <= ROOM_M:
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
        at_m = place.x_m - middle_m[0], place.y_m - middle_m[1]
        lidar = MountedLidar(*at_m, place.yaw_rad, place.upside_down)
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
    )


def scans_of(recording: Recording, fits: Sequence[tuple[TopicInfo, Kind]]) -> dict[str, SeenScans]:
    """topic -> what its scans say of their lidar: of all topics in one pass."""
    wanted = {}
    for topic, _ in fits:
        leaves = set(recording.leaves(topic.name))
        angles = _ANGLES if leaves.issuperset(_ANGLES) else ()
        wanted[topic.name] = [path for path in (FRAME_ID, *angles) if path in leaves]
    columns = recording.read(wanted) if wanted else {}
    return {
        name: _seen(columns[name].fields) if name in columns else SeenScans() for name in wanted
    }


def _seen(fields: Mapping[str, FieldColumn]) -> SeenScans:
    columns = {path: np.asarray(column) for path, column in fields.items()}
    if not all(map(len, columns.values())):
        return SeenScans()
    frame = str(columns[FRAME_ID][0]) if FRAME_ID in columns else ""
    if _ANGLES[0] not in columns:
        return SeenScans(frame)
    first, last, step = (float(columns[path][-1]) for path in _ANGLES)
    return SeenScans(frame, (first, last, step))


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
