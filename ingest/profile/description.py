"""Descriptions of a robot by strangers: URDF, and a MuJoCo model of its own (`[robot] mjcf`).

Of a URDF it reads the links, where their joints put them, and how large their shapes are. A model's
text is read once and carried in the profile; the twin that builds it checks what it must contain
(docs/robot.md).

The text is untrusted: entities and documents that are too long are refused, invalid numbers are
read as unknown, and no other file is opened, so a mesh has no size. The base is the link with a
usual name, else the root link. Whether that is the body or a footprint below it makes no
difference: heights are over the floor.
"""

from __future__ import annotations

import itertools
import re
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.errors import ConfigError
from restock.files import first_line

BASE_FRAMES = ("base_link", "base_footprint", "base")  # best first
FIXED_FRAMES = ("map", "odom", "world")  # best first
F64 = NDArray[np.float64]
MAX_LETTERS = 4_000_000  # letters of a description
MAX_LINKS = 5_000
ANY = ("fixed", "continuous", "revolute", "prismatic", "floating", "planar")
HEAVIEST_KG = 100_000.0  # of a link


@dataclass(frozen=True)
class Joint:
    """A joint, from its parent to its child."""

    name: str
    kind: str
    parent: str
    child: str
    element: ET.Element


@dataclass(frozen=True)
class Description:
    """A description that was read."""

    name: str
    links: dict[str, ET.Element]
    joints: list[Joint]
    base: str  # the link that poses are of
    root: ET.Element

    def places(self, kinds: Collection[str] = ANY) -> dict[str, Place]:
        """Return where links are that joints of these kinds connect to the base, all at zero."""
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
    """Read a description, or say why it cannot be used."""
    if len(text) > MAX_LETTERS:
        return f"{len(text):,} characters are too many for a robot's description"
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        return "a robot's description must not declare entities"
    try:
        robot = ET.fromstring(text)  # no entities: checked above
    except (ET.ParseError, ValueError) as error:
        return f"is not XML ({error})"
    if any(_of_xacro(element) for element in robot.iter()):
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
            return _no_base(roots)
        base = roots[0]
    return Description(str(robot.get("name") or "robot"), links, joints, base, robot)


def _of_xacro(element: ET.Element) -> bool:
    """Return whether it is still to be expanded by xacro."""
    values = element.attrib.values()
    in_namespace = element.tag.startswith("{") and "xacro" in element.tag.split("}")[0]
    return in_namespace or any("${" in value or "$(" in value for value in values)


def _no_base(roots: list[str]) -> str:
    """Say why no link can be taken for the base."""
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
    """The place of a link in the base's frame."""

    rotation: F64  # (3, 3)
    at_m: F64  # (3,)
    rigid: bool  # joined by fixed joints alone

    def then(self, origin: ET.Element | None, *, rigid: bool = True) -> Place:
        xyz, rpy = (three(None if origin is None else origin.get(key)) for key in ("xyz", "rpy"))
        turn = _rotation(rpy)
        return Place(self.rotation @ turn, self.rotation @ xyz + self.at_m, self.rigid and rigid)


def extent(link: ET.Element, place: Place) -> tuple[F64, F64] | None:
    """Return the lowest and highest corner of a link's collision shapes, else visible ones."""
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
    """Return three numbers of a description, 0 for those it lacks."""
    numbers = [number(part) for part in itertools.islice((text or "").split(), 3)]
    return np.array([*numbers, *[0.0] * (3 - len(numbers))])


def lengths(text: str | None, count: int) -> F64:
    """Return so many numbers (count,) of 0 or more.

    All NaN if the text does not have just these.
    """
    parts = (text or "").split(maxsplit=count)
    found = np.array([number(part) for part in parts[:count]])
    sound = len(parts) == count and bool((found >= 0).all())
    return found if sound else np.full(count, np.nan)


def number(text: Any) -> float:
    """Read a number of a description; NaN, which no outline survives, if it is none."""
    try:
        return float(text) if abs(float(text)) < 1e6 else float("nan")
    except (TypeError, ValueError):
        return float("nan")


MAX_BYTES = 200_000
MOST = {"body": 100, "geom": 300, "joint": 60, "site": 100, "actuator": 60}
TIMESTEP_S = (1e-4, 0.05)
# What makes many things of one, opens other files, runs other code, or reserves memory.
REFUSED = (
    *("include", "plugin", "extension", "composite", "flexcomp", "flex", "replicate", "attach"),
    *("skin", "mesh", "hfield", "texture", "model", "memory"),
)
REMEDY = "docs/robot.md says what the model must contain, and has an example"


def mjcf_text(given: str, folder: Path | None, where: str) -> str:
    """Return the text of the file that `[robot] mjcf = "my_robot.xml"` of a profile's TOML names.

    The name must stay in the profile's folder: profiles are passed between strangers.

    Raises:
        ConfigError: no such file, one that lies elsewhere, or one that `mjcf_problem` refuses.
    """

    def refused(what: str, remedy: str | None = None) -> ConfigError:
        return ConfigError(f"`robot.mjcf` {what}", where=where, remedy=remedy)

    if _is_text(given):
        if problem := mjcf_problem(given):
            raise refused(problem, REMEDY)
        return given
    if folder is None:
        raise refused(
            "gives a file name, which needs a profile that is a file: the name is "
            "relative to its folder"
        )
    path = (folder / given).resolve()
    if Path(given).is_absolute() or not path.is_relative_to(folder.resolve()):
        raise refused(
            f"is outside the profile's folder: {given}", "put it into the profile's folder"
        )
    try:
        if path.stat().st_size > MAX_BYTES:
            raise refused(
                f"is larger than {MAX_BYTES:,} bytes: {given}",
                "leave out meshes: boxes, cylinders and spheres are enough to drive",
            )
        text = path.read_text(encoding="utf-8").lstrip("\ufeff \t\r\n")
    except (OSError, UnicodeDecodeError) as error:
        raise refused(f"cannot be read: {given}: {first_line(error)}", "check its path") from error
    if problem := mjcf_problem(text):
        raise refused(f"{given}: {problem}", REMEDY)
    return text


def mjcf_problem(text: str) -> str | None:
    """Say why this text cannot be a robot's model; None if its form allows it."""
    if len(text) > MAX_BYTES:
        return f"is longer than {MAX_BYTES:,} characters"
    if not _is_text(text):
        return "is not XML: give a .xml file in the profile's folder"
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        return "has a DOCTYPE or entities, which are not allowed"
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        return f"is not XML: {error}"
    if root.tag != "mujoco":
        return f"is not MJCF: its root is <{root.tag}>, not <mujoco>"
    counts: Counter[str] = Counter()
    for element in root.iter():
        tag = str(element.tag)
        if tag in REFUSED:
            return f"has a <{tag}>, which is not allowed"
        if "file" in element.attrib:
            return f"refers to a file in a <{tag}>: no other file is read"
        for key, value in element.attrib.items():
            if re.search(r"\b(nan|inf|infinity)\b", value, re.IGNORECASE) and key != "name":
                return f"has {key}={value!r} in a <{tag}>, which is not a finite number"
        counts["joint" if tag == "freejoint" else tag] += 1
    counts["actuator"] = sum(len(part) for part in root.iter("actuator"))
    for tag, most in MOST.items():
        if counts[tag] > most:
            return f"has {counts[tag]} of <{tag}>, more than {most}"
    for option in root.iter("option"):
        given = option.get("timestep", "0.002")
        try:
            sound = TIMESTEP_S[0] <= float(given) <= TIMESTEP_S[1]
        except ValueError:
            sound = False
        if not sound:
            least, most_s = TIMESTEP_S
            return f"has option timestep={given!r}, which must be from {least:g} to {most_s:g} s"
    return None


def _is_text(given: str) -> bool:
    return given.lstrip().startswith("<")
