"""The parameters that can be fitted, their ranges, and which of them a log can identify."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from restock.arrays import F64
from restock.errors import ConfigError
from restock.ingest.profile.profile import load_profile
from restock.ingest.task.robot import Robot
from restock.ingest.task.task import Task
from restock.replay.store.store import Store
from restock.train.twin.physics.perturbation import RANGES, Perturbation

# Channel -> (unit, noise to begin with). What the log's noise is comes from the residuals later.
CHANNELS: dict[str, tuple[str, float]] = {
    "wheel speed": ("m/s", 0.02),
    "wheel yaw rate": ("rad/s", 0.04),
    "gyro": ("rad/s", 0.04),
    "position": ("m", 0.04),
    "heading": ("rad", 0.02),
}
_ODOMETRY = "nav_msgs/msg/Odometry"
_GOAL = "geometry_msgs/msg/PoseStamped"  # a goal's type as often as a localiser's
_POSE_TYPES = (
    "PoseWithCovarianceStamped",
    "PoseStamped",
    "TFMessage",
    "Pose",
    "PoseWithCovariance",
)


@dataclass(frozen=True)
class Parameter:
    """A field of a `Perturbation` that a log can identify."""

    name: str
    unit: str
    step: float  # of a difference quotient; of a `ratio` the relative step
    useful: float  # a 95 % interval wider than +- this (of a ratio: its logarithm) says too little
    ratio: bool = False  # searched by its logarithm
    default: bool = True
    own_body: bool = False  # says something of the twin's own body only


PARAMETERS: dict[str, Parameter] = {
    item.name: item
    for item in (
        # The floor's grip, and that of the left wheel: seen where wheels slide.
        Parameter("friction_scale", "", 0.04, 0.4, ratio=True, own_body=True),
        Parameter("left_friction_scale", "", 0.04, 0.4, ratio=True, own_body=True, default=False),
        Parameter("payload_kg", "kg", 2.0, 20.0, own_body=True),  # seen while speeds change
        Parameter("wheel_radius_scale", "", 0.004, 0.02),  # way over ground, by the wheels' way
        Parameter("track_scale", "", 0.004, 0.02),  # turn over ground, by the wheels' turn
        Parameter("latency_s", "s", 0.01, 0.03),  # from an observation to the wheels' set point
        Parameter("gain", "", 0.005, 0.02),  # wheel speed, by the commanded one
        Parameter("gyro_bias_radps", "rad/s", 0.001, 0.01),  # what the gyroscope says at rest
    )
}
MEASURED = ("wheel_radius_m", "track_m", "mass_kg", "max_accel_mps2", "max_yaw_accel_radps2")
DEFAULT = tuple(item.name for item in PARAMETERS.values() if item.default)


class Coordinates:
    """The map between perturbations and points z of the unit cube, an axis per fitted parameter.

    Parameters that are not fitted stay as in `base`.
    """

    def __init__(self, names: Sequence[str], base: Perturbation, task: Task) -> None:
        self.names, self.base, self.task = tuple(names), base, task
        self.parameters = [PARAMETERS[name] for name in names]
        ends = np.array([RANGES[name] for name in names], np.float64).reshape(-1, 2)
        if "latency_s" in self.names:  # four commands are kept, and a later one is not simulated
            most = min(RANGES["latency_s"][1], 4 * task.control_period_s)
            ends[self.names.index("latency_s"), 1] = most
        self._ratio = np.array([item.ratio for item in self.parameters], np.bool_)
        ends[self._ratio] = np.log(ends[self._ratio])
        self._low, self._span = ends[:, 0], ends[:, 1] - ends[:, 0]

    def __len__(self) -> int:
        return len(self.names)

    @property
    def steps(self) -> F64:
        """Return the step sizes of difference quotients, (n,) in z."""
        return np.array([item.step for item in self.parameters]) / self._span

    @property
    def useful(self) -> F64:
        """Return the half widths (n,) in z above which an interval says too little to be of use."""
        return np.array([item.useful for item in self.parameters]) / self._span

    def values(self, z: F64) -> F64:
        """Return the parameters (..., n) at points (..., n)."""
        inner = self._low + np.asarray(z) * self._span
        return np.where(self._ratio, np.exp(np.where(self._ratio, inner, 0.0)), inner)

    def point(self, perturbation: Perturbation) -> F64:
        """Return the point (n,) of a perturbation, clipped to the cube."""
        values = np.array([getattr(perturbation, name) for name in self.names], np.float64)
        inner = np.where(self._ratio, np.log(np.where(self._ratio, values, 1.0)), values)
        return np.clip((inner - self._low) / self._span, 0.0, 1.0)

    def perturbation(self, z: F64) -> Perturbation:
        """Return the perturbation at a point (n,)."""
        # Rounded so that equal points are equal, and ends of ranges are within them.
        values = dict(zip(self.names, (round(float(v), 9) for v in self.values(z)), strict=True))
        return msgspec.structs.replace(self.base, **values)

    def drivable(self, z: F64, timestep_s: float) -> F64:
        """Return the point (n,) with its latency rounded to whole physics steps."""
        moved = z.copy()
        if "latency_s" in self.names:
            at = self.names.index("latency_s")
            tick = timestep_s / self._span[at]
            moved[at] = np.clip(np.round(z[at] / tick), 0, np.floor(1 / tick + 1e-9)) * tick
        return moved

    def without(self, name: str) -> Coordinates:
        """Return these coordinates without one parameter, which stays as in `base`."""
        return Coordinates([other for other in self.names if other != name], self.base, self.task)


@dataclass(frozen=True)
class FitScope:
    """Parameters and channels that a log can identify, and the reasons why not the others."""

    names: tuple[str, ...]
    channels: tuple[str, ...]
    refused: dict[str, str]  # parameter -> why it cannot be fitted
    notes: tuple[str, ...]


def fit_scope(
    store: Store,
    task: Task,
    names: Sequence[str],
    recordings: Sequence[str],
    robot: Robot | None = None,
) -> FitScope:
    """Return which of `names` these recordings (all by default) can identify at all.

    `robot` is the profile's own; None: the twin's stand-in stands for the log's.

    Raises:
        ConfigError: nothing.
    """
    refused: dict[str, str] = {}
    notes: list[str] = []
    channels = list(CHANNELS)
    twin = load_profile("warehouse_amr").task.body
    if robot is not None:
        guessed = [name for name in MEASURED if robot.origin_of(name) == "default"]
        if "payload_kg" in names:
            refused["payload_kg"] = (
                "the motor strength of the profile's robot is not known, so the payload cannot be "
                "identified from the lag of the wheels"
            )
        if robot.drive == "ackermann" and "track_scale" in names:
            refused["track_scale"] = (
                "a robot that steers turns by its steering angle, so its track cannot be identified"
            )
        if guessed:
            notes.append(
                f"{', '.join(guessed)} of the robot are not known: fitted values are relative to "
                "a guess from its outline"
            )
        if "wheel_radius_m" not in guessed or "track_m" not in guessed:
            reported = "wheel_radius_scale and track_scale are"
            if robot.drive == "ackermann":
                reported = "wheel_radius_scale is"
            notes.append(
                f"{reported} relative to the profile's robot; its odometry still uses the "
                "profile's values, as in the log"
            )
    elif (task.body.length_m, task.body.width_m) != (twin.length_m, twin.width_m):
        body = f"{task.body.length_m:g} x {task.body.width_m:g} m"
        why = f"the log's robot ({body}) is not the twin's: its mass and its contacts differ"
        refused |= {name: why for name in names if PARAMETERS[name].own_body}
        notes.append(
            f"the log's robot is {body}, the twin's {twin.length_m:g} x {twin.width_m:g} m with"
            " other wheels, mass and ramps: fitted values are ratios of commanded, wheel and "
            "ground motion, not dimensions of that robot"
        )
    wanted = _recording_filter(recordings)
    fallbacks = {row[0] for row in store.sql(
        f"SELECT DISTINCT unnest(stand_ins).input FROM recordings {wanted}"
    ).fetchall()}  # fmt: skip
    if "imu" in fallbacks:
        channels.remove("gyro")
        notes.append("no IMU: yaw rate is known only from headings")
        if "gyro_bias_radps" in names:
            refused["gyro_bias_radps"] = "the log has no gyroscope"
    if _pose_is_odometry(store, wanted):
        channels = [name for name in channels if name not in ("position", "heading")]
        why = "the log's pose is the wheels' odometry: nothing measures the motion over ground"
        refused |= {name: why for name in names if name in ("wheel_radius_scale", "friction_scale")}
        notes.append("the pose is odometry: positions and headings are not compared in the fit")
        if "gyro" not in channels and "track_scale" in names:
            refused["track_scale"] = (
                "neither gyroscope nor localisation measures the turn over ground"
            )
    kept = tuple(name for name in names if name not in refused)
    if not kept:
        raise ConfigError(
            "this log can identify none of these parameters: "
            + "; ".join(f"{name}: {reason}" for name, reason in refused.items()),
            where=str(store.path),
            remedy="choose others with --parameters, or use another log",
        )
    return FitScope(kept, tuple(channels), refused, tuple(notes))


def _recording_filter(recordings: Sequence[str]) -> str:
    quoted = ", ".join("'" + name.replace("'", "''") + "'" for name in recordings)
    return f"WHERE recording_id IN ({quoted})" if recordings else ""


def _pose_is_odometry(store: Store, wanted: str) -> bool:
    """Return whether all recordings were read with odometry but without a localiser's topic."""
    rows = store.sql(
        "SELECT recording_id, coalesce(list(DISTINCT type) FILTER (decoded > 0), [])"
        f" FROM recordings LEFT JOIN topics USING (recording_id) {wanted} GROUP BY recording_id"
    ).fetchall()
    return all(
        _ODOMETRY in types and not any(kind.endswith(_POSE_TYPES) for kind in {*types} - {_GOAL})
        for _, types in rows
    )
