"""The gap between open-loop replays and their log: poses and signals, for each horizon.

For comparison, `odometry` is the logged wheel odometry, integrated from the same first pose. A twin
should be better than that.
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
    log_segments,
    replay_segments,
)
from restock.train.twin.calibration.twin_gap import GapConfig
from restock.train.twin.physics.perturbation import Perturbation

SIGNALS = {
    "wheel_speed_mps": "m/s",
    "wheel_yaw_rate_radps": "rad/s",
    "gyro_yaw_rate_radps": "rad/s",
    "localised_speed_mps": "m/s",
    "accel_x_mps2": "m/s²",
}
QUANTITIES = {"position": "m", "heading": "rad", **SIGNALS}
ODOMETRY = "odometry"
_AT_ONCE = 4096  # segments that are replayed together; limits memory


@dataclass(frozen=True)
class PathGap:
    """The gaps of S segments of one horizon."""

    horizon_s: float
    episode_id: NDArray[np.str_]  # (S,)
    holds: dict[str, Bools]  # condition -> (S,) whether a segment counts for it
    gaps: dict[tuple[str, str], F64]  # (source, quantity) -> (S,); NaN if unknown
    left_out: dict[str, int]  # reason -> number of steps at which no segment begins


def path_gap(
    steps: LoggedSteps,
    horizon_s: float,
    twins: Mapping[str, Perturbation],
    config: GapConfig,
) -> PathGap:
    """Replay segments of `horizon_s` that overlap by half, and measure their gaps.

    A segment counts for every condition that holds at any of its steps, and for `nominal` if none
    does. At most `max_segments` are drawn per condition. For poses, the gap is measured at the
    segment's end. For signals, it is the root mean square over the segment.

    Raises:
        ConfigError: the horizon is not a multiple of the control period.
    """
    period = steps.task.control_period_s
    stride_s = max(round(horizon_s / 2 / period), 1) * period
    cut = log_segments(steps, horizon_s, stride_s=stride_s)
    rows = cut.row[:, None] + np.arange(cut.horizon_steps)
    holds = {
        name: held[rows].all(axis=1) if name == NOMINAL else held[rows].any(axis=1)
        for name, held in steps.conditions.items()
    }
    rng = np.random.default_rng([config.seed, cut.horizon_steps])
    chosen = draw_per_condition(holds, config.max_segments, rng)
    used = np.flatnonzero(np.any(list(chosen.values()), axis=0))
    parts = [
        _gaps(cut.take(used[begin : begin + _AT_ONCE]), twins, config)
        for begin in range(0, len(used), _AT_ONCE)
    ]
    return PathGap(
        horizon_s=horizon_s,
        episode_id=cut.episode_id[used],
        holds={name: mask[used] for name, mask in chosen.items()},
        gaps={key: np.concatenate([part[key] for part in parts]) for key in (parts or [{}])[0]},
        left_out=dict(cut.left_out),
    )


def draw_per_condition(
    holds: Mapping[str, Bools], most: int, rng: np.random.Generator
) -> dict[str, Bools]:
    """Draw at most `most` of the rows (N,) for which each condition holds; return their masks."""
    drawn = {}
    for name, mask in holds.items():
        drawn[name] = np.zeros(len(mask), np.bool_)
        drawn[name][rng.permutation(np.flatnonzero(mask))[:most]] = True
    return drawn


def _gaps(
    part: LoggedSegments, twins: Mapping[str, Perturbation], config: GapConfig
) -> dict[tuple[str, str], F64]:
    """Return the gaps (S,) of these segments by source and quantity; NaN if physics diverged."""
    replayed = replay_segments(
        part, list(twins.values()), timestep_s=config.timestep_s, nthread=config.nthread
    )
    gaps = {}
    for index, name in enumerate(twins):
        signals = {signal: replayed.signals[signal][index] for signal in SIGNALS}
        gaps[name] = _gap(part, replayed.pose[index], signals)
        for values in gaps[name].values():
            values[replayed.diverged[index]] = np.nan
    gaps[ODOMETRY] = _gap(part, _dead_reckon(part), {})
    return {(source, name): gap for source, each in gaps.items() for name, gap in each.items()}


def _gap(part: LoggedSegments, pose: F64, signals: Mapping[str, F64]) -> dict[str, F64]:
    """Return the gaps (S,) between poses (S, K + 1, 3) and signals and the logged ones."""
    off, fresh = pose[:, -1] - part.pose[:, -1], part.pose_fresh[:, -1]
    gaps = {
        "position": np.where(fresh, np.hypot(off[:, 0], off[:, 1]), np.nan),
        "heading": np.where(fresh, np.abs(wrap_angle(off[:, 2])), np.nan),
    }
    for name, values in signals.items():
        squared = (values[:, 1:] - part.signals[name][:, 1:]) ** 2
        gaps[name] = np.sqrt(squared.mean(axis=1))
    return gaps


def _dead_reckon(part: LoggedSegments) -> F64:
    """Integrate the wheel odometry from the first logged pose; return poses (S, K + 1, 3)."""
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
