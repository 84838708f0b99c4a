"""A perturbation: how the floor, the robot and its sensors differ from the nominal twin.

Every field is a number with a unit and a range; the defaults are the nominal twin, which has
small noise as every robot has.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from restock.errors import ConfigError

T = TypeVar("T")

RANGES: dict[str, tuple[float, float]] = {
    "friction_scale": (0.05, 2.0),
    "patch_friction_scale": (0.05, 20.0),
    "left_friction_scale": (0.05, 20.0),
    "payload_kg": (0.0, 150.0),
    "wheel_radius_scale": (0.9, 1.1),
    "track_scale": (0.9, 1.1),
    "latency_s": (0.0, 0.5),
    "gain": (0.5, 1.5),
    "left_gain": (0.5, 1.5),
    "slope_x": (-0.15, 0.15),
    "slope_y": (-0.15, 0.15),
    "lidar_noise_m": (0.0, 0.2),
    "lidar_dropout": (0.0, 0.9),
    "lidar_period_s": (0.0, 2.0),
    "localisation_period_s": (0.0, 2.0),
    "localisation_noise_m": (0.0, 0.2),
    "localisation_drift_m": (0.0, 0.5),
    "localisation_yaw_noise_rad": (0.0, 0.2),
    "encoder_noise_radps": (0.0, 2.0),
    "encoder_bias_radps": (-1.0, 1.0),
    "gyro_noise_radps": (0.0, 0.5),
    "gyro_bias_radps": (-0.5, 0.5),
    "accel_noise_mps2": (0.0, 2.0),
    "accel_bias_mps2": (-2.0, 2.0),
    "timestep_s": (0.0005, 0.02),
}

_FIELDS = f"the fields are name, {', '.join(RANGES)}"


class Perturbation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One set of effective parameters. `Perturbation()` is the nominal twin."""

    name: str = "nominal"
    friction_scale: float = 1.0  # times the floor's friction of .8
    patch_friction_scale: float = 1.0  # times the friction of each slippery patch
    left_friction_scale: float = 1.0  # times the friction under the left wheel (a worn tyre)
    payload_kg: float = 0.0  # on top of the chassis
    wheel_radius_scale: float = 1.0  # the controller and the odometry do not know it
    track_scale: float = 1.0  # times the distance between the wheels, unknown likewise
    latency_s: float = 0.05  # from a command to the wheels' set point
    gain: float = 1.0  # of the wheel set points
    left_gain: float = 1.0  # of the left wheel's, on top
    slope_x: float = 0.0  # rise of the whole floor eastward, metres a metre
    slope_y: float = 0.0  # and northward
    lidar_noise_m: float = 0.01  # standard deviation of a range
    lidar_dropout: float = 0.005  # share of beams without a return
    lidar_period_s: float = 0.0  # between scans, in whole control steps; 0: one every step
    localisation_period_s: float = 0.0  # between poses, likewise
    localisation_noise_m: float = 0.004  # standard deviation, anew at every step
    localisation_drift_m: float = 0.02  # standard deviation of an error that wanders over 3 s
    localisation_yaw_noise_rad: float = 0.004
    encoder_noise_radps: float = 0.03  # of a wheel's speed
    encoder_bias_radps: float = 0.0  # of both wheels' speeds
    gyro_noise_radps: float = 0.005
    gyro_bias_radps: float = 0.0
    accel_noise_mps2: float = 0.05
    accel_bias_mps2: float = 0.0
    timestep_s: float = 0.01  # of the physics; the same for every environment of a vector

    def __post_init__(self) -> None:
        for field, (low, high) in RANGES.items():
            value = getattr(self, field)
            if not low <= value <= high:
                raise ValueError(f"{field} must be in [{low}, {high}], got {value}")

    def changed(self) -> dict[str, float]:
        """The fields that are not the nominal twin's: what every transition keeps."""
        found = {field: getattr(self, field) for field in RANGES}
        return {field: value for field, value in found.items() if value != NOMINAL[field]}


NOMINAL: dict[str, float] = {field: getattr(Perturbation(), field) for field in RANGES}


class Schedule(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A perturbation drawn anew for every episode: uniform in `ranges`, the rest from `base`."""

    ranges: dict[str, tuple[float, float]]
    base: Perturbation = Perturbation()
    name: str = "schedule"

    def __post_init__(self) -> None:
        for field, (low, high) in self.ranges.items():
            if field not in RANGES or field == "timestep_s":
                known = ", ".join(name for name in RANGES if name != "timestep_s")
                raise ValueError(f"no such range: {field!r}; the fields are {known}")
            least, most = RANGES[field]
            if not least <= low <= high <= most:
                raise ValueError(
                    f"the range of {field} must rise within [{least}, {most}], got [{low}, {high}]"
                )

    def draw(self, rng: np.random.Generator) -> Perturbation:
        """One perturbation, named like the schedule."""
        drawn = {field: float(rng.uniform(*self.ranges[field])) for field in sorted(self.ranges)}
        return msgspec.structs.replace(self.base, name=self.name, **drawn)


def load_perturbation(path: Path) -> Perturbation:
    """Read a perturbation from TOML: one `field = number` a line.

    Raises:
        ConfigError: no such file, a field that does not exist, or a value out of its range.
    """
    return _load(path, Perturbation)


def load_schedule(path: Path) -> Schedule:
    """Read a schedule from TOML: `[ranges]` with `field = [low, high]`, and `[base]`.

    Raises:
        ConfigError: as `load_perturbation`.
    """
    return _load(path, Schedule)


def find_perturbation(asked: str | Mapping[str, Any], *, where: str) -> Perturbation | Schedule:
    """A ready-made perturbation by its name, what a TOML file holds, or what a table says.

    Raises:
        ConfigError: there is no such one, or it is none.
    """
    if not isinstance(asked, str):
        return _convert(asked, where)
    if asked in PERTURBATIONS:
        return PERTURBATIONS[asked]
    path = Path(asked)
    if path.suffix != ".toml":
        raise ConfigError(
            f"there is no perturbation {asked!r}",
            where=where,
            remedy=f"give {', '.join(PERTURBATIONS)}, or a file that ends in .toml",
        )
    try:
        found = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(
            f"cannot be read: {error.strerror}", where=asked, remedy="check the path"
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"is not TOML: {error}", where=asked) from error
    return _convert(found, asked)


def _convert(table: Mapping[str, Any], where: str) -> Perturbation | Schedule:
    try:
        if "ranges" in table:
            return msgspec.convert(table, Schedule)
        return msgspec.convert(table, Perturbation)
    except msgspec.ValidationError as error:
        raise ConfigError(str(error), where=where, remedy=_FIELDS) from error


def _load(path: Path, kind: type[T]) -> T:
    try:
        return msgspec.toml.decode(path.read_bytes(), type=kind)
    except OSError as error:
        raise ConfigError(
            f"cannot be read: {error.strerror}", where=str(path), remedy="check the path"
        ) from error
    except (msgspec.ValidationError, msgspec.DecodeError) as error:
        raise ConfigError(str(error), where=str(path), remedy=_FIELDS) from error


# Ready-made ones for evaluation: each changes one thing, by about what a fleet shows.
PERTURBATIONS: dict[str, Perturbation] = {
    item.name: item
    for item in (
        Perturbation(),
        Perturbation(name="friction", friction_scale=0.5, patch_friction_scale=0.8),
        Perturbation(name="latency", latency_s=0.2),
        Perturbation(name="payload", payload_kg=60.0),
        Perturbation(name="wheels", wheel_radius_scale=0.95, gain=0.95),
        Perturbation(
            name="sensors",
            lidar_noise_m=0.04,
            lidar_dropout=0.1,
            localisation_noise_m=0.01,
            localisation_drift_m=0.06,
            encoder_noise_radps=0.1,
            gyro_noise_radps=0.03,
            gyro_bias_radps=0.03,
        ),
    )
}
