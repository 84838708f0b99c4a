"""How large a robot is, by its description in a recording.

A description (URDF, on `/robot_description`) has the boxes, cylinders and spheres of its links:
those that move with the base as one body, and its wheels, are put where their joints say. Meshes
have no size that is in the recording.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from restock.errors import ConfigError
from restock.ingest.containers.recording import Recording
from restock.ingest.propose.evidence.roles import own_first, shared
from restock.ingest.urdf.description import Description, Place, extent, read_description

F64 = NDArray[np.float64]
OUTLINE = ("fixed", "continuous")  # joints of what is always part of it; no arms
SIZES_M = (0.02, 30.0)  # of a robot that this can be


MIN_ASIDE_M = 0.05  # of the middle
DESCRIBED = "as described"  # where a lidar's place is from
UPSIDE_DOWN = (
    "the lidar hangs upside down by its frame, so its scans are turned over; if its driver does "
    "that already, left and right are swapped now: remove upside_down"
)


@dataclass(frozen=True)
class Footprint:
    """A robot's outline, and where its lidar is."""

    length_m: float
    width_m: float
    source: str  # where that is from, in words
    lidar_x_m: float | None = None  # ahead of the middle; None: nothing says
    lidar_y_m: float = 0.0  # to the left
    lidar_yaw_rad: float | None = None
    lidar_source: str = DESCRIBED
    upside_down: bool = False  # the lidar
    lidar_unplaced: str = ""  # the frame of its scans, where nothing says which way it points
    measured: bool = True  # False: a guess, though with a reason

    @property
    def lidar_aside(self) -> bool:
        """Whether the lidar is so far beside the middle that its input must say where it is."""
        return abs(self.lidar_y_m) > MIN_ASIDE_M

    @property
    def sane(self) -> bool:
        low, high = SIZES_M
        return low <= self.length_m <= high and low <= self.width_m <= high


GUESS = Footprint(
    0.6, 0.5, "A GUESS, as the recording does not contain it: MEASURE IT", measured=False
)


def parse_footprint(text: str) -> Footprint:
    """`LxW` in metres, as in `0.6x0.5`.

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
    """The footprint that the recording holds of its robot, or None; and what was found and is of
    no use.

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
    """The topics of the robot's descriptions, and the last text of each.

    Of several robots in the recording, those of the one to propose for, then those of none in
    particular.
    """
    for name, topic in own_first(recording, recording.topics.items()):
        if topic.skipped or not topic.expected or topic.type != "std_msgs/msg/String":
            continue
        if name.split("/")[-1] != "robot_description":
            continue
        texts = np.asarray(recording.read({name: ["data"]})[name].fields["data"], object)
        yield from ((name, str(text)) for text in texts[-1:])


def of_urdf(text: str, scan_frame: str = "", *, source: str) -> Footprint | str:
    """The outline that a robot's description has, or why there is none."""
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
    """The lowest and highest corner of what moves with the base, and of how many links; or None."""
    links, places = description.links, description.places(OUTLINE)
    boxes = {name: extent(links[name], place) for name, place in places.items() if name in links}
    known = {name: box for name, box in boxes.items() if box is not None}
    if not any(places[name].rigid for name in known):
        return None
    low = np.min([box[0] for box in known.values()], axis=0)
    high = np.max([box[1] for box in known.values()], axis=0)
    return low, high, len(known)


def _lidar(places: dict[str, Place], frame: str) -> tuple[tuple[float, float], float, bool] | None:
    """How far ahead of the base and to its left the lidar is, turned how, and whether it is upside
    down; None where that is not known."""
    frame = frame.strip("/")
    near = [n for n in places if n == frame or n.split("/")[-1] == frame.split("/")[-1]]
    if not frame or not near:
        return None
    place = places[near[0]]
    x, y = float(place.at_m[0]), float(place.at_m[1])
    yaw = float(np.arctan2(place.rotation[1, 0], place.rotation[0, 0]))
    return ((x, y), yaw, bool(place.rotation[2, 2] < 0)) if np.isfinite([x, y, yaw]).all() else None
