"""Reader of robot descriptions (URDF): links, their positions by joints, and their shapes' sizes.

The text is untrusted: entities and documents that are too long are refused, invalid numbers are
read as unknown, and no other file is opened, so a mesh has no size. The base is the link with a
usual name, or else the root link. It may be the body or a footprint below it, as heights are
measured from the floor.
"""

from __future__ import annotations

import itertools
import xml.etree.ElementTree as ET
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

BASE_FRAMES = ("base_link", "base_footprint", "base")  # usual names of the base link, best first
FIXED_FRAMES = ("map", "odom", "world")  # usual frames that do not move with the robot, best first
F64 = NDArray[np.float64]
MAX_LETTERS = 4_000_000  # longest description, in characters
MAX_LINKS = 5_000
ANY = ("fixed", "continuous", "revolute", "prismatic", "floating", "planar")
HEAVIEST_KG = 100_000.0  # a link with a larger mass counts as one without a mass


@dataclass(frozen=True)
class Joint:
    """A joint between a parent link and a child link."""

    name: str
    kind: str
    parent: str
    child: str
    element: ET.Element


@dataclass(frozen=True)
class Description:
    """A parsed robot description."""

    name: str
    links: dict[str, ET.Element]
    joints: list[Joint]
    base: str  # name of the link whose pose counts as the robot's pose
    root: ET.Element

    def places(self, kinds: Collection[str] = ANY) -> dict[str, Place]:
        """Return the pose of each link that joints of these kinds alone connect to the base.

        The poses are those with every joint at position 0.
        """
        children: dict[str, list[Joint]] = {}
        for joint in self.joints:
            if joint.kind in kinds:
                children.setdefault(joint.parent, []).append(joint)
        places = {self.base: Place(np.eye(3), np.zeros(3), True)}
        waiting = [self.base]
        while waiting:
            parent = waiting.pop()
            for joint in children.get(parent, []):
                if joint.child not in places:
                    origin = joint.element.find("origin")
                    places[joint.child] = places[parent].then(origin, rigid=joint.kind == "fixed")
                    waiting.append(joint.child)
        return places


def read_description(text: str) -> Description | str:
    """Parse a description; if it cannot be used, return the reason as text."""
    if len(text) > MAX_LETTERS:
        return f"{len(text):,} characters are too many for a robot's description"
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        return "a robot's description must not declare entities"
    try:
        robot = ET.fromstring(text)  # safe: texts that declare entities were refused above
    except (ET.ParseError, ValueError) as error:
        return f"is not XML ({error})"
    if any(_is_xacro(element) for element in robot.iter()):
        return "is a xacro file, not a URDF: convert it first (`xacro FILE > robot.urdf`)"
    if robot.tag != "robot":
        return f"is not a URDF: it begins with <{robot.tag}>, not with <robot>"
    links = {str(link.get("name")): link for link in robot.findall("link")}
    if len(links) > MAX_LINKS:
        return f"{len(links):,} links are too many for a robot"
    joints = [
        Joint(str(j.get("name")), str(j.get("type")), str(p.get("link")), str(c.get("link")), j)
        for j in robot.findall("joint")
        if (p := j.find("parent")) is not None and (c := j.find("child")) is not None
    ]
    if not links:
        return "has no links"
    named = (n for word in BASE_FRAMES for n in links if n.split("/")[-1] == word)
    base = next(named, None)
    if base is None:
        placed = {joint.child for joint in joints}
        roots = [name for name in links if name not in placed]
        if len(roots) != 1:
            return _describe_no_base(roots)
        base = roots[0]
    return Description(str(robot.get("name") or "robot"), links, joints, base, robot)


def _is_xacro(element: ET.Element) -> bool:
    """Return whether an element must still be expanded by xacro."""
    values = element.attrib.values()
    in_namespace = element.tag.startswith("{") and "xacro" in element.tag.split("}")[0]
    return in_namespace or any("${" in value or "$(" in value for value in values)


def _describe_no_base(roots: list[str]) -> str:
    """Describe why no link can be the base."""
    why = "every link hangs on another"
    if roots:
        more = f" and {len(roots) - 4:,} more" if len(roots) > 4 else ""
        why = f"{', '.join(map(repr, roots[:4]))}{more} are not joined to each other"
    return (
        f"has none of the links {', '.join(BASE_FRAMES)}, and {why}: name the robot's own link "
        f"{BASE_FRAMES[0]}, or join all links in one tree below it"
    )


@dataclass(frozen=True)
class Place:
    """The pose of a link in the base's frame."""

    rotation: F64  # (3, 3)
    at_m: F64  # (3,) position
    rigid: bool  # whether only fixed joints connect the link to the base

    def then(self, origin: ET.Element | None, *, rigid: bool = True) -> Place:
        xyz, rpy = (three(None if origin is None else origin.get(key)) for key in ("xyz", "rpy"))
        turn = _rotation(rpy)
        return Place(self.rotation @ turn, self.rotation @ xyz + self.at_m, self.rigid and rigid)


def extent(link: ET.Element, place: Place) -> tuple[F64, F64] | None:
    """Return the lowest and highest corner (3,) of the box around a link, in the base's frame.

    The box encloses the collision shapes, or else the visual ones; None if no size is known.
    """
    for kind in ("collision", "visual"):
        boxes = [
            box
            for shape in link.findall(kind)
            if (box := _shape_extent(shape, place.then(shape.find("origin")))) is not None
        ]
        if boxes:
            return np.min([low for low, _ in boxes], axis=0), np.max([h for _, h in boxes], axis=0)
    return None


def _shape_extent(shape: ET.Element, place: Place) -> tuple[F64, F64] | None:
    geometry = shape.find("geometry")
    if geometry is None:
        return None
    box, cylinder, sphere = (geometry.find(kind) for kind in ("box", "cylinder", "sphere"))
    if box is not None:
        half = np.abs(place.rotation) @ (lengths(box.get("size"), 3) / 2)
    elif cylinder is not None:
        radius, length = (lengths(cylinder.get(key), 1)[0] for key in ("radius", "length"))
        axis = place.rotation[:, 2]
        half = radius * np.sqrt(np.maximum(1 - axis**2, 0)) + length / 2 * np.abs(axis)
    elif sphere is not None:
        half = np.full(3, lengths(sphere.get("radius"), 1)[0])
    else:
        return None
    low, high = place.at_m - half, place.at_m + half
    return (low, high) if np.isfinite(low).all() and np.isfinite(high).all() else None


def _rotation(rpy: F64) -> F64:
    (sr, sp, sy), (cr, cp, cy) = np.sin(rpy), np.cos(rpy)
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return np.asarray(about_z @ about_y @ about_x, np.float64)


def three(text: str | None) -> F64:
    """Parse up to three numbers of a description; missing ones are 0."""
    numbers = [number(part) for part in itertools.islice((text or "").split(), 3)]
    return np.array([*numbers, *[0.0] * (3 - len(numbers))])


def lengths(text: str | None, count: int) -> F64:
    """Parse `count` numbers of 0 or more, (count,); all are NaN if the text has anything else."""
    parts = (text or "").split(maxsplit=count)
    found = np.array([number(part) for part in parts[:count]])
    sound = len(parts) == count and bool((found >= 0).all())
    return found if sound else np.full(count, np.nan)


def number(text: Any) -> float:
    """Parse a number of a description; an invalid one becomes NaN and makes an outline unknown."""
    try:
        return float(text) if abs(float(text)) < 1e6 else float("nan")
    except (TypeError, ValueError):
        return float("nan")
