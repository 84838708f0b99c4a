"""The inputs of a profile: which topic fills which of Restock's own signals."""

from __future__ import annotations

from collections.abc import Iterator

import msgspec

from restock.errors import ConfigError

# What each input must and may say of a message: signal-side name -> whether it is required.
# `orientation` is a quaternion's path and becomes a yaw.
INPUT_FIELDS: dict[str, dict[str, bool]] = {
    "command": {"speed_mps": True, "yaw_rate_radps": True},
    "pose": {"x_m": True, "y_m": True, "orientation": False, "yaw_rad": False},
    "wheels": {"speed_mps": True, "yaw_rate_radps": True},
    "imu": {"yaw_rate_radps": True, "accel_x_mps2": True},
    "scan": {"ranges_m": True, "angle_min_rad": True, "angle_increment_rad": True},
    "goal": {"x_m": True, "y_m": True},
    "plan": {"x_m": True, "y_m": True},
    "bumper": {"pressed": True},
    "behaviour_policy": {"text": True},
    "true_condition": {"text": True},
    "perturbation": {"text": True},
}

# What stands in for an input that a profile leaves out, or marks optional and a recording lacks.
FALLBACKS: dict[str, str] = {
    "scan": "no lidar: every bearing counts as free up to range_max_m",
    "imu": "gyro yaw rate taken from the wheels, acceleration 0",
    "bumper": "never pressed",
    "behaviour_policy": "the profile's behaviour_policy",
    "true_condition": "unknown: labels are not scored",
    "perturbation": "unknown: null, as of hardware",
}
POSE_FALLBACK = "from transforms, by [frames]"
ROUTE_FALLBACK = "none: the task has no goal, progress is forward displacement"


class Input(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One topic, and which of its fields fill what."""

    topic: str
    type: str
    fields: dict[str, str]
    max_age_s: float | None = None  # None: latched, held until the next message
    optional: bool = False


class Inputs(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The `[inputs]` of a profile."""

    command: Input
    wheels: Input
    pose: Input | None = None
    scan: Input | None = None
    imu: Input | None = None
    goal: Input | None = None
    plan: Input | None = None
    bumper: Input | None = None
    behaviour_policy: Input | None = None
    true_condition: Input | None = None
    perturbation: Input | None = None

    def items(self) -> Iterator[tuple[str, Input]]:
        for name in self.__struct_fields__:
            source = getattr(self, name)
            if source is not None:
                yield name, source


def check_input(name: str, source: Input, where: str, *, framed: bool) -> None:
    """That an input says what it must; `framed` where transforms can stand in for its pose.

    Raises:
        ConfigError: it does not; names the key.
    """
    known = INPUT_FIELDS[name]
    unknown = sorted(source.fields.keys() - known.keys())
    missing = sorted(
        key for key, required in known.items() if required and key not in source.fields
    )
    if name == "pose" and not source.fields.keys() & {"orientation", "yaw_rad"}:
        missing.append("orientation")
    if unknown or missing:
        said = [f"unknown {key!r}" for key in unknown] + [f"missing {key!r}" for key in missing]
        raise ConfigError(
            f"`inputs.{name}.fields`: {', '.join(said)}",
            where=where,
            remedy=f"{name} takes {', '.join(known)}",
        )
    if source.optional and name not in FALLBACKS and not (name == "pose" and framed):
        raise ConfigError(
            f"`inputs.{name}.optional`: nothing can stand in for {name}",
            where=where,
            remedy=f"optional may be {', '.join(FALLBACKS)}, and pose where there is [frames]",
        )
