"""Perturbations: how floor, robot and sensors differ from the nominal twin.

Every field but the name is a number with a unit and a range. The defaults are the nominal twin,
which has a little noise, as every robot has.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from restock.errors import ConfigError
from restock.toml import Checked, read_toml, typed

Scale = Annotated[float, Meta(ge=0.05, le=20)]
NearOne = Annotated[float, Meta(ge=0.9, le=1.1)]
Gain = Annotated[float, Meta(ge=0.5, le=1.5)]
Slope = Annotated[float, Meta(ge=-0.15, le=0.15)]
UpToFifth = Annotated[float, Meta(ge=0, le=0.2)]
UpToHalf = Annotated[float, Meta(ge=0, le=0.5)]
UpToTwo = Annotated[float, Meta(ge=0, le=2)]


class Perturbation(Checked, frozen=True):
    """A set of effective parameters. `Perturbation()` is the nominal twin."""

    name: str = "nominal"
    friction_scale: Annotated[float, Meta(ge=0.05, le=2)] = 1.0  # factor on the floor's .8
    patch_friction_scale: Scale = 1.0  # factor on the friction of slippery patches
    left_friction_scale: Scale = 1.0  # factor on friction under the left wheels (a worn tyre)
    payload_kg: Annotated[float, Meta(ge=0, le=150)] = 0.0  # mass on top of the chassis
    wheel_radius_scale: NearOne = 1.0  # factor, unknown to controller and odometry
    track_scale: NearOne = 1.0  # factor, unknown to controller and odometry
    latency_s: UpToHalf = 0.05  # delay from a command to the wheels' set points
    gain: Gain = 1.0  # factor on the wheels' set points
    left_gain: Gain = 1.0  # additional factor on the left wheels' set points
    slope_x: Slope = 0.0  # rise of the floor to the east, metres per metre
    slope_y: Slope = 0.0  # rise of the floor to the north
    lidar_noise_m: UpToFifth = 0.01  # standard deviation of a range
    lidar_dropout: Annotated[float, Meta(ge=0, le=0.9)] = 0.005  # share of beams without a return
    lidar_period_s: UpToTwo = 0.0  # rounded to whole control steps; 0: a scan every step
    localisation_period_s: UpToTwo = 0.0  # rounded to whole control steps; 0: a pose every step
    localisation_noise_m: UpToFifth = 0.004  # standard deviation, drawn at every step
    localisation_drift_m: UpToHalf = 0.02  # standard deviation of an error that varies over 3 s
    localisation_yaw_noise_rad: UpToFifth = 0.004
    encoder_noise_radps: UpToTwo = 0.03  # standard deviation of a wheel's speed
    encoder_bias_radps: Annotated[float, Meta(ge=-1, le=1)] = 0.0  # bias of both wheels' speeds
    gyro_noise_radps: UpToHalf = 0.005
    gyro_bias_radps: Annotated[float, Meta(ge=-0.5, le=0.5)] = 0.0
    accel_noise_mps2: UpToTwo = 0.05
    accel_bias_mps2: Annotated[float, Meta(ge=-2, le=2)] = 0.0
    timestep_s: Annotated[float, Meta(ge=5e-4, le=0.02)] = 0.01  # one for a vector environment

    def changed(self) -> dict[str, float]:
        """Return the values that are not nominal; they are stored with every transition."""
        values = {field: getattr(self, field) for field in RANGES}
        return {field: value for field, value in values.items() if value != NOMINAL[field]}


RANGES: dict[str, tuple[float, float]] = {
    field.name: (field.type.ge, field.type.le)  # type: ignore[misc]
    for field in msgspec.inspect.type_info(Perturbation).fields  # type: ignore[attr-defined]
    if isinstance(field.type, msgspec.inspect.FloatType)
}
NOMINAL: dict[str, float] = {field: getattr(Perturbation(), field) for field in RANGES}
_FIELDS = f"the fields are name, {', '.join(RANGES)}"


class Schedule(Checked, frozen=True):
    """A perturbation drawn for every episode: uniform in `ranges`, the rest from `base`."""

    ranges: dict[str, tuple[float, float]]
    base: Perturbation = Perturbation()
    name: str = "schedule"

    def check(self) -> None:
        for field, (low, high) in self.ranges.items():
            if field not in RANGES or field == "timestep_s":
                known = ", ".join(name for name in RANGES if name != "timestep_s")
                raise ValueError(f"unknown range {field!r}; the fields are {known}")
            least, most = RANGES[field]
            if not least <= low <= high <= most:
                raise ValueError(
                    f"the range of {field} must rise within [{least:g}, {most:g}], got"
                    f" [{low}, {high}]"
                )

    def draw(self, rng: np.random.Generator) -> Perturbation:
        """Draw one perturbation, named like the schedule."""
        drawn = {field: float(rng.uniform(*self.ranges[field])) for field in sorted(self.ranges)}
        return msgspec.structs.replace(self.base, name=self.name, **drawn)


def load_perturbation(path: Path | str) -> Perturbation:
    """Read a perturbation from TOML, with one `field = number` per line.

    Raises:
        ConfigError: no such file, a field that does not exist, a value out of its range, or a
            schedule.
    """
    values = read_toml(Path(path))
    if "ranges" in values:
        raise schedule_error(str(path))
    return typed(values, Perturbation, where=str(path), remedy=_FIELDS)


def schedule_error(where: str) -> ConfigError:
    """Return the error for a schedule given where one set of parameters is needed."""
    return ConfigError(
        "is a schedule, whose parameters differ from episode to episode: here they must be fixed",
        where=where,
        remedy="give the TOML file of one perturbation (`restock twin fit` without "
        "--per-recording writes one)",
    )


def find_perturbation(given: str | Mapping[str, Any], *, where: str) -> Perturbation | Schedule:
    """Return a perturbation from a built-in name, a TOML file or a table.

    Raises:
        ConfigError: there is no such perturbation or file, or a value is not valid.
    """
    if not isinstance(given, str):
        values, source = given, where
    elif given in PERTURBATIONS:
        return PERTURBATIONS[given]
    elif given.endswith(".toml"):
        values, source = read_toml(Path(given)), given
    else:
        raise ConfigError(
            f"there is no perturbation {given!r}",
            where=where,
            remedy=f"give {', '.join(PERTURBATIONS)}, or a file that ends in .toml",
        )
    if "ranges" in values:
        return typed(values, Schedule, where=source, remedy=_FIELDS)
    return typed(values, Perturbation, where=source, remedy=_FIELDS)


# Built-in perturbations for evaluation. Each changes one thing, by about as much as in real fleets.
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
