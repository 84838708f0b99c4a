"""What of a robot's description (URDF) cannot be used: which value of which link or joint, and what
stands in for it.

Meshes are counted elsewhere, and values that are only missing (a link without a mass) are no
faults: these are the values that someone wrote and that would otherwise be dropped unseen.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator

import numpy as np

from restock.ingest.urdf.description import (
    ANY,
    HEAVIEST_KG,
    SIZES,
    Description,
    Place,
    lengths,
    number,
    three,
)

MOST_TOLD = 6
LONGEST_SHOWN = 40  # letters of a value or a name
WORTH = ("inertial", "collision", "visual")  # parts of a link that it would be missed for
NO_SHAPE = "this shape is left out of the outline"


def unusable(description: Description, places: dict[str, Place]) -> list[str]:
    """A sentence for each value that cannot be used, the first few, and how many more there are.

    Args:
        description: that has them.
        places: where its links are, of those that joints lead to from its base.
    """
    found = [note for name, link in description.links.items() for note in _of_link(name, link)]
    for joint in description.root.findall("joint"):
        found += [
            f"joint {_shown(joint.get('name'))}: {note}" for note in _of_joint(joint, description)
        ]
    found += [
        f"no joint leads from the base to {_shown(name)}: left out"
        for name, link in description.links.items()
        if name not in places and any(link.find(part) is not None for part in WORTH)
    ]
    more = len(found) - MOST_TOLD
    return found if more <= 0 else [*found[:MOST_TOLD], f"{more} more values cannot be used"]


def _of_link(name: str, link: ET.Element) -> Iterator[str]:
    where = f"link {_shown(name)}"
    mass = link.find("inertial/mass")
    if mass is not None and not 0 <= number(mass.get("value")) < HEAVIEST_KG:
        told = _given(mass, "value")
        yield f"{where}: {told} is not from 0 to {HEAVIEST_KG:,.0f} kg: counted as 0"
    for kind in ("collision", "visual"):
        for shape in link.findall(kind):
            for note in _of_origin(shape.find("origin"), NO_SHAPE):
                yield f"{where}: {kind} {note}"
            for form in shape.findall("geometry/*"):
                if (fault := _of_form(form)) is not None:
                    yield f"{where}: {fault}: {NO_SHAPE}"


def _of_form(form: ET.Element) -> str | None:
    if form.tag == "mesh":
        return None
    if form.tag not in SIZES:
        return f"{_cut(form.tag)} is not a box, cylinder, sphere or mesh"
    for key, count in SIZES[form.tag].items():
        if form.get(key) is None:
            return f"{form.tag} has no {key}"
        if np.isnan(lengths(form.get(key), count)).any():
            return f"{_given(form, key)} is not {_numbers(count)} of 0 or more{_comma(form, key)}"
    return None


def _of_origin(origin: ET.Element | None, instead: str) -> Iterator[str]:
    for key in ("xyz", "rpy"):
        given = None if origin is None else origin.get(key)
        if origin is None or given is None:
            continue
        count = len(given.split())
        if np.isnan(three(given)).any():
            yield f"origin {key}={_shown(given)} is not 3 numbers{_comma(origin, key)}: {instead}"
        elif count != 3:
            kept = "0 for what is missing" if count < 3 else "the first 3 are used"
            yield f"origin {key}={_shown(given)} is not 3 numbers: {kept}"


def _of_joint(joint: ET.Element, description: Description) -> Iterator[str]:
    kind = joint.get("type")
    for end in ("parent", "child"):
        named = joint.find(end)
        if named is None:
            yield f"has no {end}: left out"
            return
        if named.get("link") not in description.links:
            yield f"{end} link={_shown(named.get('link'))} is not described: left out"
            return
    if kind not in ANY:
        yield f"type={_shown(kind)} is not a joint's: what it carries is left out"
        return
    yield from _of_origin(joint.find("origin"), "shapes of what it carries are left out")
    if kind not in ("continuous", "revolute"):
        return
    axis, limit = joint.find("axis"), joint.find("limit")
    along = "1 0 0" if axis is None else axis.get("xyz", "1 0 0")
    if len(along.split()) < 3 or not np.linalg.norm(three(along)) > 0:
        yield f"axis xyz={_shown(along)} is not a direction: it is not taken for a wheel"
    if limit is None:
        return
    for key in ("lower", "upper") if kind == "revolute" else ():
        if limit.get(key) is not None and np.isnan(number(limit.get(key))):
            yield f"{_given(limit, key)} is not a number below 1e6: it is not taken for a wheel"
    if limit.get("velocity") is not None and not _speed(limit.get("velocity", "")):
        yield f"{_given(limit, 'velocity')} is not a number of 0 or more: it is not used"


def _speed(text: str) -> bool:
    """Whether it is a speed, however large: some write one for "no limit"."""
    try:
        return float(text) >= 0
    except ValueError:
        return False


def _given(element: ET.Element, key: str) -> str:
    value = element.get(key)
    return f"{element.tag} {key}={'(missing)' if value is None else _shown(value)}"


def _numbers(count: int) -> str:
    return "a number" if count == 1 else f"{count} numbers"


def _comma(element: ET.Element, key: str) -> str:
    return " (decimals take a point)" if "," in element.get(key, "") else ""


def _shown(text: str | None) -> str:
    return "(no name)" if text is None else repr(_cut(text))


def _cut(text: str) -> str:
    return text if len(text) <= LONGEST_SHOWN else f"{text[: LONGEST_SHOWN - 1]}…"
