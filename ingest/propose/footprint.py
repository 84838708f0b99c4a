"""Finds a robot's outline and its lidar's place, from its description, transforms and scans.

A description (URDF, on `/robot_description`) has the boxes, cylinders and spheres of the links. The
outline is around the links that are fixed to the base, and the wheels, placed by their joints. The
size of a mesh is not in the recording.

No return comes from inside the robot, so the nearest return bounds the outline. A robot also keeps
its distance: with an outline up to that bound, every such pass would be a near collision, so the
guess is smaller by the clearance of one. Parts of the robot that its lidar sees stay at the same
range whichever way the robot faces, unlike its surroundings. They belong to the outline and are not
obstacles.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Bools, Ints
from restock.errors import ConfigError
from restock.ingest.containers.recording import Recording
from restock.ingest.containers.storage import Fields, Reduction, TopicInfo
from restock.ingest.decoding.columns import FieldColumn, Ragged
from restock.ingest.profile.description import (
    BASE_FRAMES,
    Description,
    Place,
    extent,
    read_description,
)
from restock.ingest.profile.signal_paths import frame_id_path, plain
from restock.ingest.profile.tables import Input
from restock.ingest.propose.pose_choice import mount_of, named_frames
from restock.ingest.propose.roles import Kind, sharing_warning, sort_own_first
from restock.ingest.steps.frames import Edges, PoseSeries, upward
from restock.ingest.steps.needs import BEAMS, angle_keys, beam_angles

OUTLINE = ("fixed", "continuous")  # types of joint whose links count for the outline; arms do not
SIZES_M = (0.02, 30.0)  # smallest and largest plausible length or width of a robot


MIN_ASIDE_M = 0.05  # a lidar this far left or right of the middle counts as aside


@dataclass(frozen=True)
class Footprint:
    """A robot's outline, and where its lidar is."""

    length_m: float
    width_m: float
    source: str  # where the outline is from, in words
    lidar_x_m: float | None = None  # ahead of the middle; None: unknown
    lidar_y_m: float = 0.0  # to the left of the middle
    lidar_yaw_rad: float | None = None
    lidar_source: str = "a guess"  # where `lidar_x_m` is from, in words
    upside_down: bool = False  # whether the lidar is mounted upside down
    lidar_unplaced: str = ""  # frame of the lidar's scans, if nothing gives its direction, else ""
    measured: bool = True  # False: the outline is a guess

    @property
    def lidar_aside(self) -> bool:
        """Return whether the lidar is so far off the middle that [inputs.scan] must say where."""
        return abs(self.lidar_y_m) > MIN_ASIDE_M

    @property
    def sane(self) -> bool:
        low, high = SIZES_M
        return low <= self.length_m <= high and low <= self.width_m <= high


GUESS = Footprint(
    0.6, 0.5, "A GUESS, as the recording does not contain it: MEASURE IT", measured=False
)


def parse_footprint(text: str) -> Footprint:
    """Parse `LxW` in metres, as in `0.6x0.5`.

    Raises:
        ConfigError: it is not of this form, or not the size of a robot.
    """
    match = re.fullmatch(r"\s*(\d*\.?\d+)\s*[x,]\s*(\d*\.?\d+)\s*", text)
    length, width = (float(part) for part in match.groups()) if match else (0.0, 0.0)
    footprint = Footprint(length, width, "as given by --footprint")
    if not footprint.sane:
        raise ConfigError(
            f"--footprint {text!r} is not LENGTHxWIDTH in metres,"
            f" each from {SIZES_M[0]:g} to {SIZES_M[1]:g}",
            remedy="for a robot .6 m long and .5 m wide: --footprint 0.6x0.5",
        )
    return footprint


@dataclass(frozen=True)
class RobotText:
    """The text of a robot description (URDF), and its source."""

    source: str  # a topic, or a file's name
    text: str
    kind: str = "robot_description"  # or "urdf"
    check: str = ""  # why the description may be another robot's; "": it is this robot's

    @cached_property
    def description(self) -> Description | str:
        """Return the parsed description, or why it cannot be used."""
        return read_description(self.text)


def descriptions(recording: Recording) -> Iterator[RobotText]:
    """Yield the last robot description of each topic that has one.

    If the recording has several robots, descriptions in the chosen robot's namespace come first,
    then those in no robot's namespace.
    """
    for name in sort_own_first(recording, recording.topics):
        topic = recording.topics[name]
        if topic.skipped or not topic.expected or topic.type != "std_msgs/msg/String":
            continue
        if name.split("/")[-1] != "robot_description":
            continue
        texts = np.asarray(recording.read({name: ["data"]})[name].fields["data"], object)
        for text in texts[-1:]:
            yield RobotText(name, str(text), check=sharing_warning(recording, name))


def footprint_of(
    texts: Iterable[RobotText], scan_frame: str = ""
) -> tuple[Footprint | None, list[str]]:
    """Return the first plausible footprint; also return notes on the descriptions before it."""
    notes: list[str] = []
    for one in texts:
        found = of_urdf(one, scan_frame)
        if isinstance(found, str):
            notes.append(f"{one.source}: {found}")
        elif found.sane:
            source = "; ".join(filter(None, (found.source, one.check)))
            return replace(found, source=source), notes
        else:
            notes.append(f"{found.source}: {found.length_m:.3g} x {found.width_m:.3g} m, no robot")
    return None, notes


def of_urdf(text: RobotText, scan_frame: str = "") -> Footprint | str:
    """Return the footprint from a robot's description, or why there is none."""
    description = text.description
    if isinstance(description, str):
        return description
    shapes = outline(description)
    if shapes is None:
        return "its base has no box, cylinder or sphere (a mesh's size is not in the recording)"
    low, high, count = shapes
    places = description.places(OUTLINE)
    length, width = (float(side) for side in (high - low)[:2])
    middle_x, middle_y = (float(low[axis] + high[axis]) / 2 for axis in (0, 1))
    found = Footprint(length, width, f"shapes of {count} links in {text.source}")
    if (lidar := _lidar(places, scan_frame)) is None:
        return found
    at_m, yaw, upside_down = lidar
    return replace(
        found,
        lidar_x_m=at_m[0] - middle_x,
        lidar_y_m=at_m[1] - middle_y,
        lidar_yaw_rad=yaw,
        lidar_source="as described",
        upside_down=upside_down,
    )


def outline(description: Description) -> tuple[F64, F64, int] | None:
    """Return the lowest and highest corner of the links in the outline, and their number.

    None if no link that is rigid with the base has a shape.
    """
    links, places = description.links, description.places(OUTLINE)
    boxes = {name: extent(links[name], place) for name, place in places.items() if name in links}
    known = {name: box for name, box in boxes.items() if box is not None}
    if not any(places[name].rigid for name in known):
        return None
    low = np.min([box[0] for box in known.values()], axis=0)
    high = np.max([box[1] for box in known.values()], axis=0)
    return low, high, len(known)


def _lidar(places: dict[str, Place], frame: str) -> tuple[tuple[float, float], float, bool] | None:
    """Return the lidar's place (m ahead and to the left), its yaw, and whether it is upside down.

    None if the description does not place it.
    """
    frame = frame.strip("/")
    near = [n for n in places if n == frame or n.split("/")[-1] == frame.split("/")[-1]]
    if not frame or not near:
        return None
    place = places[near[0]]
    x, y = float(place.at_m[0]), float(place.at_m[1])
    yaw = float(np.arctan2(place.rotation[1, 0], place.rotation[0, 0]))
    return ((x, y), yaw, bool(place.rotation[2, 2] < 0)) if np.isfinite([x, y, yaw]).all() else None


BINS = 60  # bins of bearing in the full circle
NEAREST = "nearest return by bearing"  # (N, BINS) float32, m; no field has a space in its name
MIN_SCANS = 20
OFTEN = 0.005  # a nearest return counts if this share of scans (at least 3) has one as near
TIGHT_PER_WIDTH = 0.3  # clearance below this share of the robot's width is a near collision
MIN_M = 0.05  # smallest half length of a robot
OWN_WITHIN_M, OWN_SPREAD_M = 0.5, 0.015
# The robot's own parts are found if it faced MIN_FACINGS directions (sectors of FACING_RAD) during
# MIN_A_FACING scans each. MOSTLY is the share of scans, and of directions, that must agree.
FACING_RAD, MIN_FACINGS, MIN_A_FACING, MOSTLY = np.pi / 6, 4, 5, 0.8
_LIMITS = ("range_min", "range_max")


@dataclass(frozen=True)
class ScannedOutline:
    """The bounds that scans put on the outline."""

    nearest_m: float  # range of the nearest return not of the robot's own parts; inf: no return
    own_m: F64  # (P, 2) the robot's own parts, in the lidar's frame

    @property
    def own_range_m(self) -> float:
        """Return the range of the farthest own part; 0 if the lidar sees none."""
        return float(np.hypot(*self.own_m.T).max(initial=0.0))

    def footprint(self, guess: Footprint) -> Footprint | None:
        """Return `guess`, corrected by these scans; None if they leave it the same."""
        half_m = max(self.nearest_m / (1 + 2 * TIGHT_PER_WIDTH), min(MIN_M, self.nearest_m))
        own = 2 * np.abs(self.own_m).max(axis=0, initial=0.0)
        length, width = (
            max(min(usual, 2 * half_m), float(least))
            for usual, least in zip((guess.length_m, guess.width_m), own, strict=True)
        )
        if (length, width) == (guess.length_m, guess.width_m):
            return None
        source = f"A GUESS from the lidar, which saw nothing nearer than {self.nearest_m:.2f} m"
        if len(self.own_m):
            source += f", its own parts at up to {self.own_range_m:.2f} m aside"
        return Footprint(length, width, f"{source}: MEASURE IT", measured=False)


def scanned_outline(
    recording: Recording, fit: tuple[TopicInfo, Kind], poses: PoseSeries | None
) -> ScannedOutline | None:
    """Bound the outline by a topic's scans; None if there are too few scans.

    Without poses, the robot's own parts cannot be found.
    """
    topic, source = fit[0].name, Input(fit[0].name, fit[0].type, fit[1].fields)
    leaves = recording.leaves(topic)
    paths = [*source.fields.values(), *(path for path in _LIMITS if path in leaves)]
    reduction = Reduction(tuple(paths), partial(_nearest, source))
    columns = recording.read({topic: []}, {topic: reduction})[topic]
    nearest = np.asarray(columns.fields[NEAREST], np.float32)
    if len(nearest) < MIN_SCANS:
        return None
    own = np.zeros(BINS, np.bool_)
    if poses is not None and len(poses):
        at = np.searchsorted(poses.stamp_ns, columns.log_time_ns, "right") - 1
        own = _own(nearest[at >= 0], poses.yaw_rad[at[at >= 0]])
    each = np.sort(np.where(own, np.inf, nearest).min(axis=1))
    place = max(3, int(np.ceil(OFTEN * len(each)))) - 1
    bearing = (np.flatnonzero(own) + 0.5) * (2 * np.pi / BINS) - np.pi
    range_m = np.median(nearest[:, own], axis=0).astype(np.float64)
    parts = np.stack([range_m * np.cos(bearing), range_m * np.sin(bearing)], axis=1)
    return ScannedOutline(float(each[place]), parts)


def _own(nearest: NDArray[np.float32], yaw_rad: F64) -> Bools:
    """Return the bearings (BINS,) of own parts: there, the range is the same for any heading."""
    facing = np.floor(yaw_rad / FACING_RAD).astype(np.int64)
    ways, counts = np.unique(facing, return_counts=True)
    ways = ways[counts >= MIN_A_FACING]
    if len(ways) < MIN_FACINGS:
        return np.zeros(BINS, np.bool_)
    ranges = np.where(np.isfinite(nearest), nearest, 1e3)
    middle = np.median(ranges, axis=0)
    same = np.abs(ranges - middle) < OWN_SPREAD_M  # (scans, BINS)
    stays = np.array([same[facing == way].mean(axis=0) for way in ways]) >= MOSTLY
    return np.asarray((middle < OWN_WITHIN_M) & (stays.mean(axis=0) >= MOSTLY), np.bool_)


def _nearest(source: Input, fields: Fields) -> dict[str, FieldColumn]:
    """Return the nearest valid range of each scan in each bin (N, BINS); inf without a return."""
    ranges = fields[source.fields["ranges_m"]]
    count = len(ranges)
    low, high = (
        np.asarray(fields.get(path, np.full(count, usual)), np.float64)
        for path, usual in zip(_LIMITS, (0.0, np.inf), strict=True)
    )
    if not isinstance(ranges, Ragged):
        ranges = Ragged(ranges.reshape(-1), np.arange(count + 1) * ranges.shape[1])
    first, last = (
        np.asarray(fields[source.fields[key]], np.float64) for key in angle_keys(source.fields)
    )
    first, step = beam_angles(source, first, last, ranges.lengths)
    row: Ints = np.repeat(np.arange(count), ranges.lengths)
    beam = np.arange(len(row)) - ranges.offsets[:-1][row]
    values = np.asarray(ranges.values, np.float32)
    with np.errstate(invalid="ignore"):
        turn = (first[row] + beam * step[row] + np.pi) % (2 * np.pi) * (BINS / (2 * np.pi))
        valid = np.isfinite(turn) & (values > 0) & (values >= low[row]) & (values <= high[row])
    found = np.full((count, BINS), np.inf, np.float32)
    place = np.minimum(turn[valid].astype(np.int64), BINS - 1)
    np.minimum.at(found, (row[valid], place), values[valid])
    return {NEAREST: found}


MAX_ASIDE_M = 3.0  # a lidar farther from the middle is implausible
MIN_RANGE_M = 0.01
_TURN = 2 * math.pi


@dataclass(frozen=True)
class SeenScans:
    """The frame and angles of a topic's scans."""

    frame: str = ""  # frame of the first scan; "": unknown
    angles: tuple[float, float, float] | None = None  # first, last, step (rad), of the last scan

    def view(
        self, yaw_rad: float = 0.0, *, upside_down: bool = False
    ) -> tuple[float, float, int] | None:
        """Return the lowest and highest angle and the beams of the last scan, seen from above.

        Angles are relative to the robot, on which the lidar is turned by `yaw_rad`. None if the
        scan has no plausible angles.
        """
        if self.angles is None:
            return None
        sign = -1 if upside_down else 1
        first, last, step = (sign * one + 0.0 for one in self.angles)  # avoid -0.0
        if not np.isfinite([first, last, step]).all() or abs(step) <= 1e-4:
            return None
        beams = round((last - first) / step) + 1
        low, high = min(first, last), max(first, last)
        if beams < 4 or not 0 < high - low < _TURN + 0.1 or max(abs(low), abs(high)) > 7:
            return None
        high = min(high, low + _TURN)
        if yaw_rad:  # keep the middle of the view within half a turn
            yaw_rad -= _TURN * round(((low + high) / 2 + yaw_rad) / _TURN)
        return low + yaw_rad, high + yaw_rad, beams


def scans_of(recording: Recording, fits: Sequence[tuple[TopicInfo, Kind]]) -> dict[str, SeenScans]:
    """Read the frame and angles of each topic's scans; all topics are read in one pass."""
    wanted, counted = dict[str, list[str]](), dict[str, Reduction]()
    for topic, kind in fits:
        leaves = set(recording.leaves(topic.name))
        frame, angles = frame_id_path(leaves), _angles(kind)
        kept = angles if leaves.issuperset(angles) else []
        wanted[topic.name] = [*([frame] if frame else []), *kept]
        if len(kept) == 2:  # the step follows from the number of beams
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


def _seen(fields: Mapping[str, FieldColumn], kind: Kind) -> SeenScans:
    angles = _angles(kind)
    columns = {path: np.asarray(column) for path, column in fields.items()}
    if not all(map(len, columns.values())):
        return SeenScans()
    frame = frame_id_path(columns)
    said = "" if frame is None else str(columns[frame][0])
    if angles[0] not in columns:
        return SeenScans(said)
    first, last, *step = (float(columns[path][-1]) for path in angles)
    if not step:
        step = [(last - first) / max(int(columns[BEAMS][-1]) - 1, 1)]
    return SeenScans(said, (first, last, step[0]))


def with_lidar(footprint: Footprint, edges: Edges, scan_frame: str) -> Footprint:
    """Add the lidar's position and yaw from the recording's last transforms, if plausible.

    This assumes that the base frame is in the middle of the outline. If the lidar would then be
    outside a measured outline, the assumption is wrong, and only the yaw is added.
    """
    frames = {frame for child, up in edges.parents.items() for frame in (child, *up)}
    bases = [
        base
        for base in named_frames(BASE_FRAMES, frames)
        if base in (plain(scan_frame), *upward(plain(scan_frame), edges.parents))
    ]
    found = mount_of(edges, scan_frame, bases[0]) if bases else None
    if found is None or (np.abs(found[1][:2]) >= MAX_ASIDE_M).any():
        return footprint
    turn, (x_m, y_m, _) = found
    yaw_rad = float(np.arctan2(turn[1, 0], turn[0, 0]))
    turned = replace(footprint, lidar_yaw_rad=yaw_rad, upside_down=bool(turn[2, 2] < 0))
    if footprint.measured and abs(x_m) > footprint.length_m / 2:
        why = f"a guess; {bases[0]} has it {x_m:.2f} m ahead, outside"
        return replace(turned, lidar_source=why)
    length_m, width_m = footprint.length_m, footprint.width_m
    if not footprint.measured:  # enlarge a guess to include the lidar
        length_m, width_m = max(length_m, 2 * abs(x_m)), max(width_m, 2 * abs(y_m))
    return replace(
        turned,
        length_m=length_m,
        width_m=width_m,
        lidar_x_m=float(x_m),
        lidar_y_m=float(y_m),
        lidar_source=f"of {bases[0]}, by transforms; that this is the middle is a guess",
    )


def range_lines(recording: Recording, topic: str, outline: ScannedOutline | None) -> list[str]:
    """Write the smallest and largest usable range of the lidar (at most 4 m) as keys of [task].

    The smallest range excludes the robot's own parts, and the 0 of some lidars for "no return".
    """
    low, high, why = 0.05, 4.0, ""
    if set(_LIMITS) <= set(recording.leaves(topic)):
        columns = recording.read({topic: _LIMITS})[topic].fields
        stated = [float(np.median(np.asarray(columns[path]))) for path in _LIMITS]
        if 0 <= stated[0] < stated[1] < np.inf:
            low, high = stated
            own_m = outline.own_range_m + OWN_SPREAD_M if outline and len(outline.own_m) else 0
            if low < MIN_RANGE_M:
                low, why = MIN_RANGE_M, "  # the lidar states less; 0 is where nothing came back"
            if own_m > low:
                low, why = own_m, "  # beyond the robot's own parts, which the lidar sees"
    return [
        f"range_min_m = {round(low, 3):g}{why}",
        f"range_max_m = {min(round(high, 3), 4.0):g}  # lidar ranges beyond it count as free",
    ]
