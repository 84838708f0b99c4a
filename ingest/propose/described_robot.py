"""Reads a robot from its description (URDF): drive, wheels, mass and lidar.

A wheel is a link on a joint that turns endlessly about an axis across the robot. Missing values
stay unknown. Links that have only meshes are counted in a note: their size is in other files, which
are not read.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from restock.errors import counted
from restock.ingest.profile.description import (
    BASE_FRAMES,
    F64,
    HEAVIEST_KG,
    Description,
    Joint,
    Place,
    extent,
    number,
)

MIN_M = 0.005  # smallest radius of a wheel
MAX_ABOVE = 2  # moving joints between base and wheel (a suspension); an arm has more
ENDLESS_RAD = 6 * np.pi  # a joint that may turn this far counts as endless
DRIVES = {  # kind of drive -> words in names of links and of simulator plugins that show it
    "omnidirectional": ("mecanum", "omni_wheel", "omniwheel", "planar_move", "holonomic"),
    "ackermann": ("ackermann",),
    "skid_steer": ("skid_steer", "skidsteer"),
}


@dataclass(frozen=True)
class DescribedRobot:
    """Values of `[robot]` by key, notes, and why the description cannot be used."""

    values: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    problem: str | None = None


@dataclass(frozen=True)
class _Wheel:
    joint: Joint
    place: Place
    radius_m: float  # NaN: its shape is a mesh, or it has no shape
    swivels: bool  # a joint above it turns about the vertical without a limit: a caster
    steers: bool  # a joint above it turns about the vertical within limits

    @property
    def x_m(self) -> float:
        return float(self.place.at_m[0])

    @property
    def y_m(self) -> float:
        return float(self.place.at_m[1])


def described_robot(
    description: Description, middle_x_m: float, scan_frame: str = ""
) -> DescribedRobot:
    """Return the robot of a URDF; the middle of its outline is `middle_x_m` ahead of its base."""
    places = description.places()
    wheels = _wheels(description, places)
    driven = _driven(wheels)
    if not driven:
        return DescribedRobot(problem=_no_wheels(description, wheels))
    notes: list[str] = []
    if description.base.split("/")[-1] not in BASE_FRAMES:
        why = f"as it is the root of the other links: none is named {', '.join(BASE_FRAMES)}"
        notes.append(f"{description.base!r} is taken for the base, {why}")
    radius = float(np.median([wheel.radius_m for wheel in driven]))
    axles = sorted(_axles(driven, radius), reverse=True)
    middle = (axles[0] + axles[-1]) / 2
    drive = _drive(description, wheels, axles)
    track = 2 * float(np.mean([abs(wheel.y_m) for wheel in driven]))
    values: dict[str, Any] = {"drive": drive, "wheel_radius_m": radius, "track_m": track}
    if len(axles) > 1:
        values["wheelbase_m"] = axles[0] - axles[-1]
    values["axle_x_m"] = middle - middle_x_m
    mass = sum(_mass(link) for name, link in description.links.items() if name in places)
    if mass > 0:
        values["mass_kg"] = mass
    floor = float(np.median([wheel.place.at_m[2] for wheel in driven])) - radius
    boxes = {
        name: box
        for name, place in places.items()
        if name in description.links and (box := extent(description.links[name], place))
    }
    if boxes:
        values["height_m"] = max(float(high[2]) for _, high in boxes.values()) - floor
    if lidar := _lidar_z(places, scan_frame, floor):
        values["lidar.z_m"] = lidar
    if meshes := sum(
        name not in boxes and link.find(".//mesh") is not None
        for name, link in description.links.items()
    ):
        notes.append(f"only meshes, whose size is in other files: {counted(meshes, 'link')}")
    rounded = {
        key: round(value, 4) + 0.0 if isinstance(value, float) else value
        for key, value in values.items()
        if not isinstance(value, float) or np.isfinite(value)
    }
    return DescribedRobot(rounded, notes)


def _wheels(description: Description, places: dict[str, Place]) -> list[_Wheel]:
    above = {joint.child: joint for joint in description.joints}
    ground = _ground(description, places)
    found = []
    for joint in description.joints:
        place = places.get(joint.child)
        if not _endless(joint) or place is None or not np.isfinite(place.at_m).all():
            continue
        if abs(_axis(joint, place)[1]) < 0.9:
            continue
        upward, seen, moving = above.get(joint.parent), {joint.child}, 0
        swivels = steers = False
        while upward is not None and upward.child not in seen:
            seen.add(upward.child)
            moving += upward.kind != "fixed"
            turning = places.get(upward.child)
            if turning is not None and abs(_axis(upward, turning)[2]) > 0.7:
                swivels |= _endless(upward)
                steers |= upward.kind == "revolute"
            upward = above.get(upward.parent)
        if moving > MAX_ABOVE:
            continue
        radius = _radius(description.links.get(joint.child))
        if not radius > MIN_M and ground is not None:  # a mesh
            radius = float(place.at_m[2]) - ground
        found.append(_Wheel(joint, place, radius, swivels, steers))
    return found


def _ground(description: Description, places: dict[str, Place]) -> float | None:
    """Return the height of `base_footprint`, or else of the lowest point of all shapes."""
    for name, place in places.items():
        if name.split("/")[-1] == "base_footprint":
            return float(place.at_m[2])
    links = description.links
    boxes = [extent(links[name], place) for name, place in places.items() if name in links]
    return min((float(box[0][2]) for box in boxes if box is not None), default=None)


def _endless(joint: Joint) -> bool:
    """Return whether a joint turns endlessly, or nearly so."""
    if joint.kind == "continuous":
        return True
    limit = joint.element.find("limit")
    if joint.kind != "revolute" or limit is None:
        return False
    return bool(number(limit.get("upper")) - number(limit.get("lower")) > ENDLESS_RAD)


def _axis(joint: Joint, place: Place) -> F64:
    """Return the direction (3,) of a joint's axis in the base's frame, or zeros."""
    axis = joint.element.find("axis")
    text = "1 0 0" if axis is None else axis.get("xyz", "1 0 0")
    direction = np.array([number(part) for part in text.split()[:3]])
    length = float(np.linalg.norm(direction)) if len(direction) == 3 else 0.0
    if not np.isfinite(length) or length < 1e-9 or joint.kind == "fixed":
        return np.zeros(3)
    return np.asarray(place.rotation @ direction / length, np.float64)


def _radius(link: ET.Element | None) -> float:
    for shape in () if link is None else (*link.findall("collision"), *link.findall("visual")):
        for kind in ("cylinder", "sphere"):
            found = shape.find(f"geometry/{kind}")
            if found is not None and (radius := number(found.get("radius"))) > 0:
                return radius
    return float("nan")


def _driven(wheels: list[_Wheel]) -> list[_Wheel]:
    """Return the driven wheels: large, not swivelling; [] if they are not on both sides."""
    able = [
        wheel
        for wheel in wheels
        if wheel.radius_m > MIN_M
        and not wheel.swivels
        and "caster" not in wheel.joint.child.lower()
        and "castor" not in wheel.joint.child.lower()
        and abs(wheel.y_m) > MIN_M
    ]
    largest = max((wheel.radius_m for wheel in able), default=0.0)
    able = [wheel for wheel in able if wheel.radius_m > 0.5 * largest]
    sides = {wheel.y_m > 0 for wheel in able}
    return able if len(sides) == 2 else []


def _axles(driven: list[_Wheel], radius: float) -> list[float]:
    """Return how far ahead of the base each axle is, in m."""
    axles: list[list[float]] = []
    for x in sorted(wheel.x_m for wheel in driven):
        if axles and x - axles[-1][-1] < radius / 2:
            axles[-1].append(x)
        else:
            axles.append([x])
    return [float(np.mean(axle)) for axle in axles]


def _drive(description: Description, wheels: list[_Wheel], axles: list[float]) -> str:
    if len(axles) > 1 and any(wheel.steers for wheel in wheels):
        return "ackermann"
    plugins = [
        f"{e.get('filename')} {e.get('name')} {e.text}" for e in description.root.iter("plugin")
    ]
    words = " ".join([*description.links, *plugins]).lower()
    for drive, known in DRIVES.items():
        if any(word in words for word in known) and (drive != "skid_steer" or len(axles) > 1):
            return drive
    return "skid_steer" if len(axles) > 1 else "differential"


def _mass(link: ET.Element) -> float:
    found = link.find("inertial/mass")
    mass = number(found.get("value")) if found is not None else 0.0
    return mass if 0 < mass < HEAVIEST_KG else 0.0


def _lidar_z(places: dict[str, Place], frame: str, floor: float) -> float | None:
    wanted = frame.strip("/").split("/")[-1]
    place = next((p for n, p in places.items() if n.split("/")[-1] == wanted), None)
    if not wanted or place is None or not np.isfinite(place.at_m).all():
        return None
    return float(place.at_m[2]) - floor


def _no_wheels(description: Description, wheels: list[_Wheel]) -> str:
    """Return the problem of a robot without usable wheels."""
    if wheels:
        return (
            f"{description.name!r} has {counted(len(wheels), 'wheel')}, but no driven "
            "pair on both sides with a known radius (a mesh has none): give wheel_radius_m and "
            "track_m in [robot]"
        )
    return (
        f"{description.name!r} has no wheels: no joint of it turns without end about an axis across"
        " the robot"
    )
