"""The gap between open-loop replays and their log: pose and signals at each horizon's end.

There are two references beside the twins. `odometry` is the logged wheel odometry, dead-reckoned
from the same first pose: a twin should be better than that. `floor` is the gap of a perfect twin:
the twin's own paths with localisation and sensor noise, from a first pose with the error of a
localised one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Bools
from restock.ingest.task.task import wrap_angle
from restock.train.twin.calibration.logged_steps import NOMINAL, LoggedSteps
from restock.train.twin.calibration.open_loop import (
    LoggedSegments,
    lay_onto,
    log_segments,
    replay_segments,
    whole_periods_s,
)
from restock.train.twin.calibration.twin_gap import GapConfig
from restock.train.twin.physics.perturbation import Perturbation
from restock.train.twin.physics.robot_model import RobotModel, stand_in
from restock.train.twin.physics.sensing import DRIFT_TIME_S

SIGNALS = {
    "wheel_speed_mps": "m/s",
    "wheel_yaw_rate_radps": "rad/s",
    "gyro_yaw_rate_radps": "rad/s",
    "localised_speed_mps": "m/s",
    "accel_x_mps2": "m/s²",
}
QUANTITIES = {"position": "m", "heading": "rad", **SIGNALS}
ODOMETRY, FLOOR = "odometry", "floor"
_AT_ONCE = 4096  # segments replayed at a time: bounds memory


@dataclass(frozen=True)
class SensorNoise:
    """Standard deviations of the noise that a log's sensors add."""

    position_m: float  # white, of each axis, as measured in the log
    heading_rad: float  # white, as measured in the log
    drift_m: float  # wanders over DRIFT_TIME_S, of each axis; as the twin assumes it
    encoder_radps: float
    gyro_radps: float
    accel_mps2: float


@dataclass(frozen=True)
class PathGap:
    """The gaps of S segments of one horizon."""

    horizon_s: float
    episode_id: NDArray[np.str_]  # (S,)
    holds: dict[str, Bools]  # condition -> (S,) counted for it
    gaps: dict[tuple[str, str], F64]  # (source, quantity) -> (S,); NaN where not known
    left_out: dict[str, int]


def path_gap(
    steps: LoggedSteps,
    horizon_s: float,
    twins: Mapping[str, Perturbation],
    noise: SensorNoise,
    config: GapConfig,
) -> PathGap:
    """Replay segments of `horizon_s`, which overlap by half.

    A gap of a pose is at the segment's end, of a signal its root mean square on the way.

    Raises:
        ConfigError: a horizon that is not some control periods.
    """
    cut, chosen = overlapping_segments(steps, horizon_s, config)
    used = np.flatnonzero(np.any(list(chosen.values()), axis=0))
    rng = np.random.default_rng([config.seed, cut.horizon_steps, 1])
    parts = [
        _gaps(cut.take(used[begin : begin + _AT_ONCE]), twins, noise, rng, config)
        for begin in range(0, len(used), _AT_ONCE)
    ]
    return PathGap(
        horizon_s=horizon_s,
        episode_id=cut.episode_id[used],
        holds={name: mask[used] for name, mask in chosen.items()},
        gaps={key: np.concatenate([part[key] for part in parts]) for key in (parts or [{}])[0]},
        left_out=dict(cut.left_out),
    )


def overlapping_segments(
    steps: LoggedSteps, horizon_s: float, config: GapConfig
) -> tuple[LoggedSegments, dict[str, Bools]]:
    """Cut half-overlapping segments of `horizon_s`; also return which (S,) count per condition.

    A segment counts for every condition that holds at any of its steps; for `nominal` where none
    does. At most `max_segments` are drawn of each.

    Raises:
        ConfigError: a horizon that is not some control periods.
    """
    period = steps.task.control_period_s
    stride_s = max(round(horizon_s / 2 / period), 1) * period
    cut = log_segments(steps, whole_periods_s(steps.task, horizon_s), stride_s=stride_s)
    rng = np.random.default_rng([config.seed, cut.horizon_steps])
    return cut, _choose(steps, cut, config.max_segments, rng)


def measured_noise(steps: LoggedSteps, twin: Perturbation) -> SensorNoise:
    """Estimate a log's sensor noise: white localisation noise from the log, the rest as assumed.

    Over one step, the distance between the motion of the localised pose and that of the wheels is
    mostly noise (in the median over nominal steps). If it is close to zero, the pose is the
    odometry itself and counts as free of noise.
    """
    now, after, period = steps.now, steps.after, steps.task.control_period_s
    elapsed = (after["pose_stamp_ns"] - now["pose_stamp_ns"]) * 1e-9
    good = steps.followed & steps.conditions[NOMINAL] & (np.abs(elapsed - period) < 0.05 * period)
    heading = now["pose_yaw_rad"][good]
    x, y = ((after[n][good] - now[n][good]) for n in ("pose_x_m", "pose_y_m"))
    turn = wrap_angle(after["pose_yaw_rad"][good] - heading)
    sideways = -np.sin(heading + turn / 2) * x + np.cos(heading + turn / 2) * y
    rate = (now["gyro_yaw_rate_radps"][good] + after["gyro_yaw_rate_radps"][good]) / 2
    straight = np.abs(rate) < 0.1
    if straight.sum() < 20:
        white, yaw = twin.localisation_noise_m, twin.localisation_yaw_noise_rad
    else:
        white = _spread(sideways[straight]) / np.sqrt(2)
        yaw = _spread((turn - rate * period)[straight]) / np.sqrt(2)
    drift = twin.localisation_drift_m
    if white < 0.1 * twin.localisation_noise_m:
        white = yaw = drift = 0.0
    else:  # a step's share of the drift is not white
        keep = np.exp(-period / DRIFT_TIME_S)
        white = float(np.sqrt(max(white**2 - drift**2 * (1 - keep), 0.0)))
    sensors = (twin.encoder_noise_radps, twin.gyro_noise_radps, twin.accel_noise_mps2)
    return SensorNoise(white, float(yaw), drift, *sensors)


def _spread(values: F64) -> float:
    """Return a robust standard deviation."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def _choose(
    steps: LoggedSteps, cut: LoggedSegments, most: int, rng: np.random.Generator
) -> dict[str, Bools]:
    """Draw at most `most` segments (S,) of each condition."""
    rows = cut.row[:, None] + np.arange(cut.horizon_steps)
    chosen = {}
    for name, holds in steps.conditions.items():
        mask = holds[rows].all(axis=1) if name == NOMINAL else holds[rows].any(axis=1)
        members = np.flatnonzero(mask)
        if len(members) > most:
            mask[rng.permutation(members)[most:]] = False
        chosen[name] = mask
    return chosen


def _gaps(
    part: LoggedSegments,
    twins: Mapping[str, Perturbation],
    noise: SensorNoise,
    rng: np.random.Generator,
    config: GapConfig,
) -> dict[tuple[str, str], F64]:
    """Return (source, quantity) -> gaps (S,) of these segments."""
    replayed = replay_segments(
        part, list(twins.values()), timestep_s=config.timestep_s, nthread=config.nthread
    )
    logged = {name: part.signals[name] for name in SIGNALS}
    fresh = part.pose_fresh[:, -1]
    gaps = {}
    for index, name in enumerate(twins):
        path = replayed.pose[index]
        signals = {signal: replayed.signals[signal][index] for signal in SIGNALS}
        gaps[name] = _gap(path, signals, part.pose, logged, fresh)
        for values in gaps[name].values():
            values[replayed.diverged[index]] = np.nan
    gaps[ODOMETRY] = _gap(_dead_reckon(part), {}, part.pose, logged, fresh)
    # Of the last twin, which is the calibrated one if there is one.
    localised = path + _pose_noise(path.shape, noise, part.task.control_period_s, rng)
    robot = part.robot or stand_in(part.task.body)
    sensed = _sense(signals, localised, path, noise, robot, part.task.control_period_s, rng)
    gaps[FLOOR] = _gap(lay_onto(path, localised[:, 0]), signals, localised, sensed, fresh)
    return {(source, name): gap for source, each in gaps.items() for name, gap in each.items()}


def _gap(
    pose: F64, signals: Mapping[str, F64], goal: F64, logged: Mapping[str, F64], fresh: Bools
) -> dict[str, F64]:
    off = pose[:, -1] - goal[:, -1]
    gaps = {
        "position": np.where(fresh, np.hypot(off[:, 0], off[:, 1]), np.nan),
        "heading": np.where(fresh, np.abs(wrap_angle(off[:, 2])), np.nan),
    }
    for name, values in signals.items():
        squared = (values[:, 1:] - logged[name][:, 1:]) ** 2
        gaps[name] = np.sqrt(squared.mean(axis=1))
    return gaps


def _dead_reckon(part: LoggedSegments) -> F64:
    """Integrate the wheel odometry from the first logged pose: poses (S, K + 1, 3)."""
    period = part.task.control_period_s
    speed, rate = part.signals["wheel_speed_mps"], part.signals["wheel_yaw_rate_radps"]
    turn = (rate[:, 1:] + rate[:, :-1]) / 2 * period
    ahead = (speed[:, 1:] + speed[:, :-1]) / 2 * period
    start = part.pose[:, :1]
    heading = np.concatenate([start[..., 2], start[..., 2] + np.cumsum(turn, axis=1)], axis=1)
    middle = (heading[:, 1:] + heading[:, :-1]) / 2
    pose = np.empty((*heading.shape, 3))
    pose[..., 2] = heading
    for axis, share in enumerate((np.cos(middle), np.sin(middle))):
        pose[:, 0, axis] = start[:, 0, axis]
        pose[:, 1:, axis] = start[..., axis] + np.cumsum(ahead * share, axis=1)
    return pose


def _pose_noise(
    shape: tuple[int, ...], noise: SensorNoise, period_s: float, rng: np.random.Generator
) -> F64:
    """Draw localisation errors (S, K + 1, 3): white noise and a wandering drift."""
    white = np.array([noise.position_m, noise.position_m, noise.heading_rad])
    error = rng.standard_normal(shape) * white
    keep = float(np.exp(-period_s / DRIFT_TIME_S))
    drift = rng.standard_normal((shape[0], shape[1], 2))
    for step in range(1, shape[1]):
        drift[:, step] = keep * drift[:, step - 1] + np.sqrt(1 - keep**2) * drift[:, step]
    error[..., :2] += noise.drift_m * drift
    return np.asarray(error, np.float64)


def _sense(
    truth: Mapping[str, F64],
    localised: F64,
    path: F64,
    noise: SensorNoise,
    robot: RobotModel,
    period_s: float,
    rng: np.random.Generator,
) -> dict[str, F64]:
    """Add sensor noise to true signals."""
    shape = path.shape[:2]
    wheels = rng.standard_normal((2, *shape)) * noise.encoder_radps
    speed, rate = robot.body_velocity(wheels[0], wheels[1])
    step = np.diff(localised[..., :2] - path[..., :2], axis=1, prepend=0.0)
    heading = path[..., 2]
    along = (np.cos(heading) * step[..., 0] + np.sin(heading) * step[..., 1]) / period_s
    added = {
        "wheel_speed_mps": speed,
        "wheel_yaw_rate_radps": rate,
        "gyro_yaw_rate_radps": rng.standard_normal(shape) * noise.gyro_radps,
        "localised_speed_mps": along,
        "accel_x_mps2": rng.standard_normal(shape) * noise.accel_mps2,
    }
    return {name: values + added[name] for name, values in truth.items()}
