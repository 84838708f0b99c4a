"""How large a robot is, by what a recording says: its description, or its costmap's footprint.

A description (URDF, on `/robot_description`) has the boxes, cylinders and spheres of its links:
those that move with the base as one body, and its wheels, are put where their joints say. Meshes
have no size that is in the recording. A costmap has its footprint as a polygon on a topic, or as
a parameter in `/parameter_events`.
"""

from __future__ import annotations

import itertools
import json
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.errors import ConfigError
from restock.ingest.containers.recording import Recording
from restock.ingest.decoding.columns import Ragged
from restock.ingest.propose.roles import BASE_FRAMES

F64 = NDArray[np.float64]
LARGEST_URDF = 4_000_000  # letters
SIZES_M = (0.02, 30.0)  # of a robot that this can be
_RIGID = ("fixed", "continuous")  # joints of what is always part of the outline; no arms
_POLYGONS = ("geometry_msgs/msg/PolygonStamped", "geometry_msgs/msg/Polygon")


@dataclass(frozen=True)
class Footprint:
    """A robot's outline, and where its lidar is."""

    length_m: float
    width_m: float
    source: str  # where that is from, in words
    lidar_x_m: float | None = None  # ahead of the middle; None: nothing says
    lidar_yaw_rad: float | None = None

    @property
    def sane(self) -> bool:
        low, high = SIZES_M
        return low <= self.length_m <= high and low <= self.width_m <= high


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
    """The footprint that the recording holds, or None; and what was found and is of no use."""
    notes: list[str] = []
    for found in (
        *_descriptions(recording, scan_frame, notes),
        *_polygons(recording),
        *_parameters(recording),
    ):
        if found.sane:
            return found, notes
        notes.append(f"{found.source}: {found.length_m:.3g} x {found.width_m:.3g} m, no robot")
    return None, notes


def _descriptions(recording: Recording, frame: str, notes: list[str]) -> Iterator[Footprint]:
    for name, topic in recording.topics.items():
        if topic.skipped or not topic.expected or topic.type != "std_msgs/msg/String":
            continue
        if name.split("/")[-1] != "robot_description":
            continue
        texts = np.asarray(recording.read({name: ["data"]})[name].fields["data"], object)
        for text in [str(text) for text in texts][-1:]:
            found = of_urdf(text, frame, source=name)
            if isinstance(found, str):
                notes.append(f"{name}: {found}")
            else:
                yield found


def _polygons(recording: Recording) -> Iterator[Footprint]:
    named = [t for t in recording.topics.values() if "footprint" in t.name and not t.skipped]
    for topic in named:
        if topic.type not in _POLYGONS or not topic.expected:
            continue
        path = "polygon.points[]." if topic.type == _POLYGONS[0] else "points[]."
        fields = recording.read({topic.name: [path + axis for axis in "xy"]})[topic.name].fields
        x, y = (fields[path + axis][-1] for axis in "xy")
        points = np.stack([np.asarray(x, np.float64), np.asarray(y, np.float64)], axis=-1)
        if found := of_polygon(points, f"the polygon of {topic.name}; its longer side ahead"):
            yield found


def _parameters(recording: Recording) -> Iterator[Footprint]:
    """`footprint` and `robot_radius` among the parameters that nodes announced."""
    for topic in recording.topics.values():
        if topic.type != "rcl_interfaces/msg/ParameterEvent" or topic.skipped:
            continue
        for group in ("new_parameters[].", "changed_parameters[]."):
            paths = [group + p for p in ("name", "value.double_value", "value.string_value")]
            if not topic.expected or not set(paths) <= set(recording.leaves(topic.name)):
                continue
            fields = recording.read({topic.name: paths})[topic.name].fields
            columns = [f.values if isinstance(f, Ragged) else f for f in map(fields.get, paths)]
            for name, number, text in zip(*(np.asarray(c, object) for c in columns), strict=True):
                source = f"the parameter {name} in {topic.name}"
                if str(name).split(".")[-1] == "robot_radius" and float(number) > 0:
                    yield Footprint(2 * float(number), 2 * float(number), source)
                named = str(name).split(".")[-1] == "footprint"
                if named and (found := of_text(str(text), source)):
                    yield found


def of_text(text: str, source: str) -> Footprint | None:
    """A footprint as Nav2 writes it: `[[x, y], [x, y], …]`, x ahead."""
    try:
        points = np.asarray(json.loads(text), np.float64)
    except (ValueError, RecursionError):
        return None
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 3:
        return None
    length, width = np.ptp(points, axis=0).tolist()
    return Footprint(length, width, source)


def of_polygon(points_m: F64, source: str) -> Footprint | None:
    """The smallest rectangle around a polygon (N, 2) that is turned in any way."""
    if len(points_m) < 3 or not np.isfinite(points_m).all() or len(points_m) > 1000:
        return None
    best: tuple[float, float] | None = None
    for along in np.diff(points_m, axis=0, append=points_m[:1]):
        size = float(np.hypot(*along))
        if size > 0:
            ahead = along / size
            turned = points_m @ np.array([ahead, [-ahead[1], ahead[0]]]).T
            sides = sorted(np.ptp(turned, axis=0).tolist(), reverse=True)
            if best is None or sides[0] * sides[1] < best[0] * best[1]:
                best = (sides[0], sides[1])
    return Footprint(*best, source) if best else None


def of_urdf(text: str, scan_frame: str = "", *, source: str) -> Footprint | str:
    """The outline that a robot's description has, or why there is none."""
    if len(text) > LARGEST_URDF:
        return f"{len(text):,} letters are too long for a robot's description"
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        return "a robot's description declares no entities"
    try:
        robot = ET.fromstring(text)  # no entities: checked above
    except (ET.ParseError, ValueError) as error:
        return f"is no XML ({error})"
    links = {str(link.get("name")): link for link in robot.findall("link")}
    base = next(
        (name for word in BASE_FRAMES for name in links if name.split("/")[-1] == word), None
    )
    if base is None:
        return f"has none of the links {', '.join(BASE_FRAMES)}"
    places = _places(robot, base)
    boxes = {name: _box(links[name], place) for name, place in places.items() if name in links}
    known = {name: box for name, box in boxes.items() if box is not None}
    body = [name for name in known if places[name].rigid]
    if not body:
        return "its base has no box, cylinder or sphere (a mesh's size is not in the recording)"
    low = np.min([box[0] for box in known.values()], axis=0)
    high = np.max([box[1] for box in known.values()], axis=0)
    length, width = (float(side) for side in (high - low)[:2])
    x, yaw = _lidar(places, scan_frame)
    return Footprint(
        length,
        width,
        f"shapes of {len(known)} links in {source}",
        None if x is None else x - float(low[0] + high[0]) / 2,
        yaw,
    )


@dataclass(frozen=True)
class _Place:
    """Where a link is in the base's frame."""

    rotation: F64  # (3, 3)
    at_m: F64  # (3,)
    rigid: bool  # joined by fixed joints alone

    def then(self, origin: ET.Element | None, *, rigid: bool = True) -> _Place:
        xyz, rpy = (_three(None if origin is None else origin.get(key)) for key in ("xyz", "rpy"))
        turn = _rotation(rpy)
        return _Place(self.rotation @ turn, self.rotation @ xyz + self.at_m, self.rigid and rigid)


def _places(robot: ET.Element, base: str) -> dict[str, _Place]:
    """Every link that joints of the outline lead to from the base."""
    children: dict[str, list[tuple[str, ET.Element]]] = {}
    for joint in robot.findall("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is not None and child is not None and joint.get("type") in _RIGID:
            children.setdefault(str(parent.get("link")), []).append((str(child.get("link")), joint))
    places = {base: _Place(np.eye(3), np.zeros(3), True)}
    waiting = [base]
    while waiting:
        parent_name = waiting.pop()
        for name, joint in children.get(parent_name, []):
            if name not in places:
                fixed = joint.get("type") == "fixed"
                places[name] = places[parent_name].then(joint.find("origin"), rigid=fixed)
                waiting.append(name)
    return places


def _box(link: ET.Element, place: _Place) -> tuple[F64, F64] | None:
    """The lowest and highest corner of a link's collision shapes, else of those one sees."""
    for kind in ("collision", "visual"):
        boxes = [
            box
            for shape in link.findall(kind)
            if (box := _extent(shape, place.then(shape.find("origin")))) is not None
        ]
        if boxes:
            return np.min([low for low, _ in boxes], axis=0), np.max([h for _, h in boxes], axis=0)
    return None


def _extent(shape: ET.Element, place: _Place) -> tuple[F64, F64] | None:
    geometry = shape.find("geometry")
    if geometry is None:
        return None
    box, cylinder, sphere = (geometry.find(kind) for kind in ("box", "cylinder", "sphere"))
    if box is not None:
        half = np.abs(place.rotation) @ (_three(box.get("size")) / 2)
    elif cylinder is not None:
        radius, length = (_number(cylinder.get(key)) for key in ("radius", "length"))
        axis = place.rotation[:, 2]
        half = radius * np.sqrt(np.maximum(1 - axis**2, 0)) + length / 2 * np.abs(axis)
    elif sphere is not None:
        half = np.full(3, _number(sphere.get("radius")))
    else:
        return None
    low, high = place.at_m - half, place.at_m + half
    return (low, high) if np.isfinite(low).all() and np.isfinite(high).all() else None


def _lidar(places: dict[str, _Place], frame: str) -> tuple[float | None, float | None]:
    """How far ahead of the base, and turned how, the lidar is."""
    frame = frame.strip("/")
    near = [n for n in places if n == frame or n.split("/")[-1] == frame.split("/")[-1]]
    if not frame or not near:
        return None, None
    place = places[near[0]]
    x, yaw = float(place.at_m[0]), float(np.arctan2(place.rotation[1, 0], place.rotation[0, 0]))
    return (x, yaw) if np.isfinite([x, yaw]).all() else (None, None)


def _rotation(rpy: F64) -> F64:
    (sr, sp, sy), (cr, cp, cy) = np.sin(rpy), np.cos(rpy)
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return np.asarray(about_z @ about_y @ about_x, np.float64)


def _three(text: str | None) -> F64:
    numbers = [_number(part) for part in itertools.islice((text or "").split(), 3)]
    return np.array([*numbers, *[0.0] * (3 - len(numbers))])


def _number(text: Any) -> float:
    """A number of a description; NaN, which no outline survives, for what is none."""
    try:
        return float(text) if abs(float(text)) < 1e6 else float("nan")
    except (TypeError, ValueError):
        return float("nan")
