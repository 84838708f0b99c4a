"""Proposes the `[robot]` of a profile, from its description, its scans and how it turned.

A robot with two driven sides turns on the spot; one that steers never does. If nothing describes
the robot, its drive is found by whether it followed commands to turn on the spot.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from restock.arrays import F64
from restock.errors import ConfigError
from restock.ingest.profile.description import MAX_LETTERS
from restock.ingest.propose.described_robot import described_robot
from restock.ingest.propose.footprint import RobotText, SeenScans, outline
from restock.ingest.steps.frames import PoseSeries
from restock.ingest.task.robot import OUTLINE, USUAL_STEERING_RAD, Lidar, Robot
from restock.ingest.task.task import wrap_angle
from restock.toml import toml_value

SETTLED_S = 1.0  # longest time that a command counts
ANSWERED_S = 0.5  # a turn counts as an answer up to this long after the command ended
# A command to turn on the spot has at most this speed, and at least this share of the sharpest yaw
# rate and TURNS_RADPS.
STANDS_MPS, MUCH = 0.02, 0.3
TURNS_RADPS = 0.15
# Evidence needed: total angle and number of such turns commanded. A robot that turned FOLLOWS of
# the angle can turn on the spot.
MIN_ASKED_RAD, MIN_SPELLS, FOLLOWS = 2.0, 2, 0.15
MIN_MOVED_M = 0.05  # a robot that moved less may have been unable to move


@dataclass(frozen=True)
class DriveEvidence:
    """How a robot followed commands to turn on the spot; a car cannot follow them."""

    moved_m: float = 0.0  # diagonal of the area it drove in
    requested_rad: float = 0.0  # total angle of the commands to turn on the spot
    spells: int = 0  # number of uninterrupted turns on the spot that were commanded
    followed_rad: float = 0.0  # total angle turned in the commanded direction

    @property
    def steers(self) -> bool:
        """Return whether the robot moved, but did not turn on the spot when commanded to."""
        reported = self.requested_rad >= MIN_ASKED_RAD and self.spells >= MIN_SPELLS
        followed = self.followed_rad >= FOLLOWS * self.requested_rad
        return reported and self.moved_m >= MIN_MOVED_M and not followed

    @property
    def why(self) -> str:
        """Return the evidence in words, as the rest of a sentence about the robot."""
        if not self.requested_rad:
            return "it was never commanded to turn on the spot"
        return (
            f"commanded to turn on the spot, by {self.requested_rad:.1f} rad in all, it turned by"
            f" {max(self.followed_rad, 0.0):.1f}, and it moved by {self.moved_m:.1f} m"
        )


def drive_evidence(
    command_s: F64, command_mps: F64, command_radps: F64, poses: PoseSeries
) -> DriveEvidence:
    """Return the evidence of one drive on whether its robot steers like a car.

    Args:
        command_s, command_mps, command_radps: the commands (N,), in order, on the clock of `poses`.
        poses: the robot's poses, with the same zero of time.
    """
    if len(command_s) < 2 or len(poses) < 3:
        return DriveEvidence()
    at_s = np.asarray(poses.stamp_ns * 1e-9, np.float64)
    heading = np.concatenate([[0.0], np.cumsum(wrap_angle(np.diff(poses.yaw_rad)))])
    return DriveEvidence(
        float(np.hypot(np.ptp(poses.x_m), np.ptp(poses.y_m))),
        *_on_the_spot(command_s, command_mps, command_radps, at_s, heading),
    )


def _on_the_spot(
    command_s: F64, command_mps: F64, command_radps: F64, at_s: F64, heading: F64
) -> tuple[float, int, float]:
    """Return the angle (rad) and number of commanded turns on the spot, and the angle turned."""
    sharp = float(np.percentile(np.abs(command_radps), 98))
    side = np.sign(command_radps) * (
        (np.abs(command_mps) <= STANDS_MPS)
        & (np.abs(command_radps) >= max(MUCH * sharp, TURNS_RADPS))
    )
    hold = np.minimum(np.append(np.diff(command_s), SETTLED_S), SETTLED_S)
    begins = np.flatnonzero(np.append(True, np.diff(side) != 0))
    requested, spells, followed = 0.0, 0, 0.0
    for first, behind in zip(begins, np.append(begins[1:], len(side)), strict=True):
        begin, end = command_s[first], command_s[behind - 1] + hold[behind - 1]
        if not side[first] or begin < at_s[0] or end > at_s[-1]:
            continue
        turned = np.diff(np.interp([begin, end + ANSWERED_S], at_s, heading))[0] * side[first]
        requested += float((np.abs(command_radps) * hold)[first:behind].sum())
        followed += float(turned)
        spells += 1
    return requested, spells, followed


WHEELBASE_PART = 0.6  # guess for an unknown wheelbase, as a share of the outline's length
_OF_STEERING = ("drive", "wheelbase_m", "max_steering_rad")
MAX_BEAMS = 361  # beams cost time in the twin; of a lidar with more, every k-th beam is used


@dataclass(frozen=True)
class RobotProposal:
    """Values of `[robot]` by key, the origin of each, and notes."""

    values: dict[str, Any] = field(default_factory=dict)
    origin: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    rolls: bool = True  # False: the description shows no wheels
    drive_why: str = "A GUESS: the recording does not show it"

    @property
    def described(self) -> bool:
        """Return whether the robot's drive is from a description."""
        return "drive" in self.values and self.origin.get("drive") != "logs"

    @property
    def guessed_steering(self) -> bool:
        """Return whether only the logs, not a description, suggest that it steers like a car."""
        return self.values.get("drive") == "ackermann" and not self.described

    def driven(
        self, shown: DriveEvidence, length_m: float, *, command_rad: float | None = None
    ) -> RobotProposal:
        """Add the kind of drive that the logs show, if no description gives one.

        Args:
            shown: how the robot turned.
            length_m: length of its outline, from which the wheelbase is guessed.
            command_rad: the sharpest command, if commands are steering angles.
        """
        if self.described:
            return self
        values = {k: v for k, v in self.values.items() if k not in _OF_STEERING}
        origin = {key: said for key, said in self.origin.items() if key in values}
        if command_rad is None and not shown.steers:
            return replace(self, values=values, origin=origin, drive_why=shown.why)
        wheelbase_m = round(WHEELBASE_PART * length_m, 3)
        values |= {"drive": "ackermann", "wheelbase_m": wheelbase_m}
        origin |= {"drive": "logs", "wheelbase_m": "default"}
        why = f"CONFIRM THAT IT STEERS LIKE A CAR: {shown.why}"
        if command_rad is not None:
            why = "its commands are steering angles"
            if command_rad > USUAL_STEERING_RAD:
                values["max_steering_rad"] = round(min(command_rad, 1.3), 3)
                origin["max_steering_rad"] = "logs"
        return replace(self, values=values, origin=origin, rolls=True, drive_why=why)

    def limited(self, speed_mps: float | None, yaw_rate_radps: float | None) -> RobotProposal:
        """Add the speed limits that the logs show; None: no limit."""
        logged = {"max_speed_mps": speed_mps, "max_yaw_rate_radps": yaw_rate_radps}
        found = {key: value for key, value in logged.items() if value is not None}
        origin = self.origin | dict.fromkeys(found, "logs")
        return replace(self, values=self.values | found, origin=origin)

    def lines(self, *, outline_guessed: bool) -> list[str]:
        """Write the TOML."""
        if not self.rolls:
            return [*(f"# [robot]  # {note}" for note in self.notes), ""]
        own = {key: value for key, value in self.values.items() if "." not in key}
        lidar = {key[6:]: value for key, value in self.values.items() if key.startswith("lidar.")}
        drive, reported = own.pop("drive", None), self.described
        guesses = {} if reported else {"wheelbase_m": "  # A GUESS from the outline: MEASURE IT"}
        lines = [
            "[robot]  # what the twin builds; missing values follow from the size of the outline",
            *(f"# {note}" for note in self.notes),
            *([] if reported else [f"# {line}" for line in textwrap.wrap(self.drive_why, 98)]),
            f'drive = "{drive or "differential"}"',
            *(f"{key} = {toml_value(value)}{guesses.get(key, '')}" for key, value in own.items()),
        ]
        if lidar:
            lines += ["", "[robot.lidar]", *(f"{k} = {toml_value(v)}" for k, v in lidar.items())]
        origin = {key: self.origin[key] for key in self.values if key in self.origin}
        if origin or outline_guessed:
            lines += ["", "[robot.origin]"]
            lines += [f'{_key(key)} = "{value}"' for key, value in origin.items()]
        if outline_guessed:
            lines += [f'{OUTLINE} = "default"  # a guess: remove this once task.body is measured']
        return [*lines, ""]


def read_urdf(path: Path) -> RobotText:
    """Read the description of a robot on wheels from a URDF file.

    Raises:
        ConfigError: it cannot be read, is not a URDF, or has no wheels.
    """
    remedy = "give the URDF of a wheeled robot, as XML in UTF-8"
    try:
        with path.open("rb") as file:
            text = file.read(4 * MAX_LETTERS + 1).decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot be read: {error}", where=str(path), remedy=remedy) from error
    found = RobotText(path.name, text, "urdf")
    described = found.description
    wrong = described if isinstance(described, str) else described_robot(described, 0.0).problem
    if wrong is not None:
        raise ConfigError(wrong, where=str(path), remedy=remedy)
    return found


def propose_robot(
    texts: Iterable[RobotText],
    scan: SeenScans | None,
    *,
    upside_down: bool = False,
    lidar_yaw_rad: float = 0.0,
) -> RobotProposal:
    """Return the robot by the first description that has wheels, and by the robot's scans.

    Args:
        texts: the descriptions.
        scan: the frame and angles of the robot's scans.
        upside_down: whether the lidar hangs upside down.
        lidar_yaw_rad: yaw with which a lidar in the robot's middle covers the same directions.
    """
    values: dict[str, Any] = {}
    origin: dict[str, str] = {}
    notes: list[str] = []
    unfit: list[str] = []
    for one in texts:
        description = one.description
        if isinstance(description, str):
            notes.append(f"{one.source}: {description}")
            continue
        shapes = outline(description)
        middle = 0.0 if shapes is None else float(shapes[0][0] + shapes[1][0]) / 2
        found = described_robot(description, middle, scan.frame if scan is not None else "")
        if found.problem is not None:
            unfit.append(f"{one.source}: {found.problem}")  # it may describe an arm
            continue
        if one.check:
            notes.append(f"{one.source}: {one.check}")
        values = _keep_valid(found.values, notes)
        origin = dict.fromkeys(values, one.kind)
        notes += [f"{one.source}: {note}" for note in found.notes]
        break
    if unfit and not values:
        return RobotProposal(notes=unfit, rolls=False)
    if scan is not None:
        view = scan.view(lidar_yaw_rad, upside_down=upside_down)
        seen = {} if view is None else _beams(*view, notes)
        values |= seen
        origin |= dict.fromkeys(seen, "logs")
    return RobotProposal(values, origin, notes)


def _keep_valid(values: dict[str, Any], notes: list[str]) -> dict[str, Any]:
    """Keep the values that a robot can have; add notes on the others."""
    kept = {}
    for key, value in values.items():
        try:
            if key.startswith("lidar."):
                Lidar(**{key[6:]: value})
            elif key != "drive":
                Robot(**{key: value})
            kept[key] = value
        except ValueError as error:
            notes.append(f"{key} = {value} is not used: {error}")
    return kept


def _beams(low_rad: float, high_rad: float, beams: int, notes: list[str]) -> dict[str, Any]:
    """Return the beams and the field of view of the twin's lidar."""
    every = -(-beams // MAX_BEAMS)
    if every > 1:
        notes.append(f"the twin has every {every}. of the lidar's {beams} beams")
    return {
        "lidar.beams": -(-beams // every),
        "lidar.angle_min_rad": round(low_rad, 5),
        "lidar.angle_max_rad": round(high_rad, 5),
    }


def _key(key: str) -> str:
    return f'"{key}"' if "." in key else key
