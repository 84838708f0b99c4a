"""The `[robot]` of a proposed profile, by its description, its scans and its commands."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from restock.errors import ConfigError
from restock.ingest.containers.recording import Recording
from restock.ingest.profile.description import Description, read_description
from restock.ingest.propose.described_robot import described_robot, read_urdf
from restock.ingest.propose.footprint import (
    Footprint,
    SeenScans,
    View,
    descriptions,
    of_urdf,
    outline,
)
from restock.ingest.propose.roles import shared
from restock.ingest.task.robot import OUTLINE, USUAL_STEERING_RAD, Lidar, Robot
from restock.toml import toml_value

WHEELBASE_PART = 0.6  # of the outline's length, if nothing shows it
MAX_BEAMS = 361  # in the twin, as each costs time: every k-th beam of a finer lidar


@dataclass(frozen=True)
class RobotProposal:
    """Values of `[robot]` by their keys, where each is from, and what is to be said."""

    values: dict[str, Any] = field(default_factory=dict)
    origin: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    rolls: bool = True  # False: a description says that it has no wheels
    drive_why: str = "A GUESS: the recording does not tell"

    @property
    def described(self) -> bool:
        """Return whether a description says how it drives."""
        return "drive" in self.values and self.origin.get("drive") != "logs"

    def steered(self, length_m: float, sharpest_rad: float) -> RobotProposal:
        """Add the drive of a robot whose commands are steering angles, if no description has one.

        Args:
            length_m: of its outline, by which the wheelbase is guessed.
            sharpest_rad: of its commands.
        """
        if self.described:
            return self
        values = self.values | {
            "drive": "ackermann",
            "wheelbase_m": round(WHEELBASE_PART * length_m, 3),
        }
        origin = self.origin | {"drive": "logs", "wheelbase_m": "default"}
        if sharpest_rad > USUAL_STEERING_RAD:
            values["max_steering_rad"] = round(min(sharpest_rad, 1.3), 3)
            origin["max_steering_rad"] = "logs"
        why = "its commands are steering angles"
        return replace(self, values=values, origin=origin, rolls=True, drive_why=why)

    def limited(self, speed_mps: float | None, yaw_rate_radps: float | None) -> RobotProposal:
        """Replace the limits of a description by those that its logs show."""
        logged = {"max_speed_mps": speed_mps, "max_yaw_rate_radps": yaw_rate_radps}
        found = {key: value for key, value in logged.items() if value is not None}
        origin = self.origin | dict.fromkeys(found, "logs")
        return replace(self, values=self.values | found, origin=origin)

    def lines(self, speed_mps: float, yaw_rate_radps: float, *, outline_guessed: bool) -> list[str]:
        """Write the TOML, without limits below what was commanded (m/s, rad/s), which are noted."""
        if not self.rolls:
            return [*(f"# [robot]  # {note}" for note in self.notes), ""]
        values, notes = dict(self.values), list(self.notes)
        for key, commanded in (
            ("max_speed_mps", speed_mps),
            ("max_yaw_rate_radps", yaw_rate_radps),
        ):
            if values.get(key, math.inf) < commanded * 0.999:
                limit = values.pop(key)
                notes.append(f"{key} = {limit:g} is not its limit: {commanded:g} was commanded")
        own = {key: value for key, value in values.items() if "." not in key}
        lidar = {key[6:]: value for key, value in values.items() if key.startswith("lidar.")}
        drive, reported = own.pop("drive", None), self.described
        guesses = {} if reported else {"wheelbase_m": "  # A GUESS from the outline: MEASURE IT"}
        lines = [
            "[robot]  # what the twin builds; missing values follow from the size of the outline",
            *(f"# {note}" for note in notes),
            *([] if reported else [f"# {line}" for line in textwrap.wrap(self.drive_why, 98)]),
            f'drive = "{drive or "differential"}"',
            *(f"{key} = {toml_value(value)}{guesses.get(key, '')}" for key, value in own.items()),
        ]
        if lidar:
            lines += ["", "[robot.lidar]", *(f"{k} = {toml_value(v)}" for k, v in lidar.items())]
        origin = {key: self.origin[key] for key in values if key in self.origin}
        if origin or outline_guessed:
            lines += ["", "[robot.origin]"]
            lines += [f'{_key(key)} = "{value}"' for key, value in origin.items()]
        if outline_guessed:
            lines += [f'{OUTLINE} = "default"  # a guess: remove this once task.body is measured']
        return [*lines, ""]


def check_urdf(path: Path) -> Description:
    """Read the description of a robot on wheels from a URDF file.

    Raises:
        ConfigError: it cannot be read, is no URDF, or has no wheels.
    """
    description = read_description(read_urdf(path))
    problem: str | None
    if isinstance(description, str):
        problem = description
    elif (problem := described_robot(description, 0.0).problem) is None:
        return description
    raise ConfigError(problem, where=str(path), remedy="give the URDF of a wheeled robot")


def urdf_footprint(path: Path, scan_frame: str) -> Footprint | None:
    """Return the outline in a URDF file; None if its shapes are meshes.

    Raises:
        ConfigError: it cannot be read, is no URDF, or has no wheels.
    """
    check_urdf(path)
    text = read_urdf(path)
    found = of_urdf(text, scan_frame, source=path.name)
    return found if isinstance(found, Footprint) and found.sane else None


def propose_robot(
    recording: Recording,
    urdf: Path | None,
    scan: SeenScans | None,
    *,
    upside_down: bool = False,
    lidar_yaw_rad: float = 0.0,
) -> RobotProposal:
    """Return the robot that a URDF file, else the recording's description, and its scans describe.

    Args:
        recording: what is read.
        urdf: the file, if there is one.
        scan: what the scans say of the lidar.
        upside_down: the lidar hangs so.
        lidar_yaw_rad: by which the twin's lidar, which is in the middle, covers what this one does.

    Raises:
        ConfigError: the file cannot be used: it has no wheels, say.
    """
    texts: Iterable[tuple[str, str]] = descriptions(recording)
    if urdf is not None:
        texts = [(urdf.name, read_urdf(urdf))]
    values: dict[str, Any] = {}
    origin: dict[str, str] = {}
    notes: list[str] = []
    unfit: list[str] = []
    for source, text in texts:
        description = read_description(text)
        if isinstance(description, str):
            notes.append(f"{source}: {description}")
            continue
        shapes = outline(description)
        middle = 0.0 if shapes is None else float(shapes[0][0] + shapes[1][0]) / 2
        found = described_robot(description, middle, scan.frame if scan is not None else "")
        if found.problem is not None:
            if urdf is not None:
                raise ConfigError(
                    found.problem, where=str(urdf), remedy="give the URDF of a wheeled robot"
                )
            unfit.append(f"{source}: {found.problem}")  # an arm's, say, beside that of its base
            continue
        kind = "robot_description" if urdf is None else "urdf"
        if urdf is None and (why := shared(recording, source)):
            notes.append(f"{source}: {why}")
        values = _sound(found.values, notes)
        origin = dict.fromkeys(values, kind)
        notes += [f"{source}: {note}" for note in found.notes]
        break
    if unfit and not values:
        return RobotProposal(notes=unfit, rolls=False)
    if scan is not None:
        view = scan.view(upside_down=upside_down)
        seen = {} if view is None else _beams(view.turned(lidar_yaw_rad), notes)
        values |= seen
        origin |= dict.fromkeys(seen, "logs")
    return RobotProposal(values, origin, notes)


def _sound(values: dict[str, Any], notes: list[str]) -> dict[str, Any]:
    """Keep the values that a robot can have, and note the others."""
    kept = {}
    for key, value in values.items():
        try:
            if key.startswith("lidar."):
                Lidar(**{key[6:]: value})
            elif key not in ("drive", "casters_m"):
                Robot(**{key: value})
            kept[key] = value
        except ValueError as error:
            notes.append(f"{key} = {value} is not used: {error}")
    return kept


def _beams(view: View, notes: list[str]) -> dict[str, Any]:
    """Return the beams and the field of view of the twin's lidar."""
    every = -(-view.beams // MAX_BEAMS)
    if every > 1:
        notes.append(f"the twin has every {every}. of the lidar's {view.beams} beams")
    return {
        "lidar.beams": -(-view.beams // every),
        "lidar.angle_min_rad": round(view.low_rad, 5),
        "lidar.angle_max_rad": round(view.high_rad, 5),
    }


def _key(key: str) -> str:
    return f'"{key}"' if "." in key else key
