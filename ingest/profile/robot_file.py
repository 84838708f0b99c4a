"""A robot's own MuJoCo model (`[robot] mjcf`): its text, read once and carried in the profile.

The text may be anyone's: it opens no other file, and is not longer, nor describes more, than a
wheeled robot needs. What it must hold is told in docs/robot.md, and checked by the twin that builds
it.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path
from typing import Any

from restock.errors import ConfigError
from restock.files import first_line

MAX_BYTES = 200_000
MOST = {"body": 100, "geom": 300, "joint": 60, "site": 100, "actuator": 60}
TIMESTEP_S = (1e-4, 0.05)
# What makes many things of one, opens other files, runs other code, or reserves memory.
REFUSED = (
    *("include", "plugin", "extension", "composite", "flexcomp", "flex", "replicate", "attach"),
    *("skin", "mesh", "hfield", "texture", "model", "memory"),
)
REMEDY = "docs/robot.md says what the model must contain, and has an example"


def with_robot_file(document: dict[str, Any], folder: Path | None, where: str) -> dict[str, Any]:
    """Replace the name in `[robot] mjcf = "my_robot.xml"` of a profile's TOML by the file's text.

    The name must stay in the profile's folder: profiles are passed between strangers.

    Raises:
        ConfigError: no such file, one that lies elsewhere, or one that `mjcf_problem` refuses.
    """
    robot = document.get("robot")
    given = robot.get("mjcf") if isinstance(robot, dict) else None
    if not isinstance(given, str) or not isinstance(robot, dict):
        return document

    def refused(what: str, remedy: str | None = None) -> ConfigError:
        return ConfigError(f"`robot.mjcf` {what}", where=where, remedy=remedy)

    if _is_text(given):
        if problem := mjcf_problem(given):
            raise refused(problem, REMEDY)
        return document
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
    return document | {"robot": robot | {"mjcf": text}}


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
