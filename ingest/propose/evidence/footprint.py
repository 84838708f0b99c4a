"""How large a robot is: by its description in a recording, else by what its lidar never saw inside.

A description (URDF, on `/robot_description`) has the boxes, cylinders and spheres of its links:
those that move with the base as one body, and its wheels, are put where their joints say. Meshes
have no size that is in the recording.

Nothing stands where the robot is, so no return comes from within its outline: the nearest that any
did is a bound. A robot also keeps its distance: a guess that reached that far would make a near
collision of every such pass, so it leaves the room that is no near collision. Parts of the robot
that its lidar sees stay at one range whichever way it faces, which nothing around it does: they
belong to the outline, and are no obstacles.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Bools, Ints
from restock.errors import ConfigError
from restock.ingest.containers.recording import Recording
from restock.ingest.containers.topic_reading import Fields, Reduction, TopicInfo
from restock.ingest.decoding.columns import FieldColumn, Ragged
from restock.ingest.profile.inputs import Input
from restock.ingest.propose.evidence.roles import Kind, shared, sort_own_first
from restock.ingest.steps.clearance import angle_keys, beam_angles
from restock.ingest.steps.motion import PoseSeries
from restock.ingest.urdf.description import Description, Place, extent, read_description

OUTLINE = ("fixed", "continuous")  # joints of what is always part of it; no arms
SIZES_M = (0.02, 30.0)  # of a robot that this can be


MIN_ASIDE_M = 0.05  # of the middle
DESCRIBED = "as described"  # the source of a lidar's place
UPSIDE_DOWN = (
    "the lidar hangs upside down by its frame, so its scans are turned over; if its driver does "
    "that already, left and right are swapped now: remove upside_down"
)


@dataclass(frozen=True)
class Footprint:
    """A robot's outline, and where its lidar is."""

    length_m: float
    width_m: float
    source: str  # of the outline, in words
    lidar_x_m: float | None = None  # ahead of the middle; None: nothing says
    lidar_y_m: float = 0.0  # to the left
    lidar_yaw_rad: float | None = None
    lidar_source: str = DESCRIBED
    upside_down: bool = False  # the lidar
    lidar_unplaced: str = ""  # the frame of its scans, if nothing gives its direction
    measured: bool = True  # False: a guess, though with a reason

    @property
    def lidar_aside(self) -> bool:
        """Return whether the lidar is so far beside the middle that its input gives its place."""
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
        ConfigError: it is not that.
    """
    match = re.fullmatch(r"\s*([\d.]+)\s*[x,]\s*([\d.]+)\s*", text)
    try:
        length, width = (float(part) for part in match.groups()) if match else (0.0, 0.0)
    except ValueError:
        length = width = 0.0
    footprint = Footprint(length, width, "as given by --footprint")
    if not footprint.sane:
        raise ConfigError(
            f"--footprint {text!r} is not LENGTHxWIDTH in metres,"
            f" each from {SIZES_M[0]:g} to {SIZES_M[1]:g}",
            remedy="for a robot .6 m long and .5 m wide: --footprint 0.6x0.5",
        )
    return footprint


def footprint_of(recording: Recording, scan_frame: str = "") -> tuple[Footprint | None, list[str]]:
    """Return the footprint that the recording holds of its robot, or None.

    Also return notes on descriptions of no use.

    Of several robots in the recording, the one to propose for.
    """
    notes: list[str] = []
    for name, text in descriptions(recording):
        found = of_urdf(text, scan_frame, source=name)
        if isinstance(found, str):
            notes.append(f"{name}: {found}")
        elif found.sane:
            why = shared(recording, name)
            return replace(found, source=f"{found.source}; {why}") if why else found, notes
        else:
            notes.append(f"{found.source}: {found.length_m:.3g} x {found.width_m:.3g} m, no robot")
    return None, notes


def descriptions(recording: Recording) -> Iterator[tuple[str, str]]:
    """Yield the topics of the robot's descriptions, and the last text of each.

    Of several robots in the recording, those of the one to propose for, then those of none in
    particular.
    """
    for name, topic in sort_own_first(recording, recording.topics.items()):
        if topic.skipped or not topic.expected or topic.type != "std_msgs/msg/String":
            continue
        if name.split("/")[-1] != "robot_description":
            continue
        texts = np.asarray(recording.read({name: ["data"]})[name].fields["data"], object)
        yield from ((name, str(text)) for text in texts[-1:])


def of_urdf(text: str, scan_frame: str = "", *, source: str) -> Footprint | str:
    """Return the outline that a robot's description has, or why there is none."""
    description = read_description(text)
    if isinstance(description, str):
        return description
    shapes = outline(description)
    if shapes is None:
        return "its base has no box, cylinder or sphere (a mesh's size is not in the recording)"
    low, high, count = shapes
    places = description.places(OUTLINE)
    length, width = (float(side) for side in (high - low)[:2])
    middle_x, middle_y = (float(low[axis] + high[axis]) / 2 for axis in (0, 1))
    found = Footprint(
        length,
        width,
        f"shapes of {count} links in {source}",
    )
    if (lidar := _lidar(places, scan_frame)) is None:
        return found
    at_m, yaw, upside_down = lidar
    return replace(
        found,
        lidar_x_m=at_m[0] - middle_x,
        lidar_y_m=at_m[1] - middle_y,
        lidar_yaw_rad=yaw,
        upside_down=upside_down,
    )


def outline(description: Description) -> tuple[F64, F64, int] | None:
    """Return the lowest and highest corner of what moves with the base, and its number of links.

    None if there is none.
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

    None if a description does not place it.
    """
    frame = frame.strip("/")
    near = [n for n in places if n == frame or n.split("/")[-1] == frame.split("/")[-1]]
    if not frame or not near:
        return None
    place = places[near[0]]
    x, y = float(place.at_m[0]), float(place.at_m[1])
    yaw = float(np.arctan2(place.rotation[1, 0], place.rotation[0, 0]))
    return ((x, y), yaw, bool(place.rotation[2, 2] < 0)) if np.isfinite([x, y, yaw]).all() else None


BINS = 60  # of the full circle
NEAREST = "nearest return by bearing"  # (N, BINS) float32, m; no field's name holds a space
MIN_SCANS = 20
OFTEN = 0.005  # of the scans, and at least three: one odd return says nothing
TIGHT_PER_WIDTH = 0.3  # room, by the robot's width: less is a near collision
MIN_M = 0.05  # half of a robot's length
OWN_WITHIN_M, OWN_SPREAD_M = 0.5, 0.015
# It must have turned so far, with so many scans each way it faced; and so many say the same.
FACING_RAD, MIN_FACINGS, MIN_A_FACING, MOSTLY = np.pi / 6, 4, 5, 0.8
_LIMITS = ("range_min", "range_max")


@dataclass(frozen=True)
class ScannedOutline:
    """The bounds that scans put on the outline."""

    nearest_m: float  # that anything but the robot's own parts came to the lidar; inf: nothing did
    own_m: F64  # (P, 2) the robot's own parts, in the lidar's frame

    @property
    def own_range_m(self) -> float:
        """Return how far the farthest of its own parts is; 0 if it sees none."""
        return float(np.hypot(*self.own_m.T).max(initial=0.0))

    def footprint(self, guess: Footprint) -> Footprint | None:
        """Return the outline by these scans.

        None if they say no more than the guess without them.
        """
        half_m = max(self.nearest_m / (1 + 2 * TIGHT_PER_WIDTH), min(MIN_M, self.nearest_m))
        own = 2 * np.abs(self.own_m).max(axis=0, initial=0.0)
        length, width = (
            max(min(usual, 2 * half_m), float(least))
            for usual, least in zip((guess.length_m, guess.width_m), own, strict=True)
        )
        if (length, width) == (guess.length_m, guess.width_m):
            return None
        parts = (
            f", its own parts at up to {self.own_range_m:.2f} m aside" if len(self.own_m) else ""
        )
        return Footprint(
            length,
            width,
            f"A GUESS from the lidar, which saw nothing nearer than {self.nearest_m:.2f} m{parts}:"
            " MEASURE IT",
            measured=False,
        )


def scanned_outline(
    recording: Recording, fit: tuple[TopicInfo, Kind], poses: PoseSeries | None
) -> ScannedOutline | None:
    """Bound the outline by a topic's scans.

    None if it has too few. Without poses no own parts are found.
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
    """Return the bearings (BINS,) at which the range stays, whichever way the robot faces."""
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
    """Return the nearest valid return of each scan in each bin of bearings (N, BINS).

    A bin without a return is inf.
    """
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
