"""What separates replays from their log: residuals by channel, in the units of the signals.

Position and heading are compared after each predicted path was laid onto the logged one as a rigid
piece (by the mean heading and the mean position of the segment's fresh poses): a localiser's error
at a segment's first pose would else turn and shift the whole path.

The twin's commands take effect at a physics step, so a replay knows latencies only in multiples of
the timestep. Between two of them residuals are interpolated, which makes the fit smooth.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from restock.ingest.task.signals import wrap_angle
from restock.train.twin.calibration.open_loop import Replayed, replay_segments
from restock.train.twin.calibration.segments import LoggedSegments
from restock.train.twin.physics.perturbation import Perturbation

F64 = NDArray[np.float64]

# Channel -> (unit, noise to begin with). What the log's noise is comes from the residuals later.
CHANNELS: dict[str, tuple[str, float]] = {
    "wheel speed": ("m/s", 0.02),
    "wheel yaw rate": ("rad/s", 0.04),
    "gyro": ("rad/s", 0.04),
    "position": ("m", 0.04),
    "heading": ("rad", 0.02),
}
_KEPT = 512  # replays of single perturbations that are kept


class Mismatch:
    """Residuals (prediction less log) of any perturbation on one set of segments.

    Args:
        channels: of `CHANNELS`, those the recording can be trusted in.
    """

    def __init__(
        self,
        segments: LoggedSegments,
        channels: Sequence[str] = tuple(CHANNELS),
        *,
        timestep_s: float = 0.01,
        nthread: int = 1,
    ) -> None:
        self.segments, self.channels = segments, tuple(channels)
        self.timestep_s, self.nthread = timestep_s, nthread
        self.replays = 0  # perturbations driven so far
        self._known: dict[Perturbation, dict[str, F64]] = {}

    def of(self, perturbations: Sequence[Perturbation]) -> dict[str, F64]:
        """Residuals by channel, (P, S, R) each: R is K + 1, for a position twice that."""
        parts = [self._between(perturbation) for perturbation in perturbations]
        self._drive([twin for pair in parts for twin, weight in pair if weight])
        found = {
            channel: np.stack(
                [
                    sum((w * self._known[twin][channel] for twin, w in pair if w), 0.0)
                    for pair in parts
                ]
            )
            for channel in self.channels
        }
        if "gyro" in found:
            bias = np.array([perturbation.gyro_bias_radps for perturbation in perturbations])
            found["gyro"] = found["gyro"] + bias[:, None, None]
        return found

    def _between(self, perturbation: Perturbation) -> list[tuple[Perturbation, float]]:
        """The replays that make up a perturbation, and their weights."""
        ticks = perturbation.latency_s / self.timestep_s
        low = int(np.floor(ticks + 1e-6))
        above = max(ticks - low, 0.0)
        pair = [(low, 1 - above), (low + 1, above if above > 1e-6 else 0.0)]
        return [
            (
                msgspec.structs.replace(
                    perturbation,
                    name="",
                    gyro_bias_radps=0.0,
                    latency_s=min(tick * self.timestep_s, 0.5),
                ),
                weight,
            )
            for tick, weight in pair
        ]

    def _drive(self, twins: Sequence[Perturbation]) -> None:
        new = [twin for twin in dict.fromkeys(twins) if twin not in self._known]
        if len(self._known) + len(new) > _KEPT:
            self._known.clear()
            new = list(dict.fromkeys(twins))
        if not new:
            return
        replayed = replay_segments(
            self.segments, new, timestep_s=self.timestep_s, nthread=self.nthread
        )
        self.replays += len(new)
        found = residuals(self.segments, replayed)
        for index, twin in enumerate(new):
            self._known[twin] = {name: found[name][index] for name in self.channels}


def residuals(segments: LoggedSegments, replayed: Replayed) -> dict[str, F64]:
    """Every channel's residuals, (P, S, R) each; 0 where the log says nothing."""
    predicted, logged = replayed.signals, segments.signals
    found = {
        channel: predicted[name] - logged[name]
        for channel, name in (
            ("wheel speed", "wheel_speed_mps"),
            ("wheel yaw rate", "wheel_yaw_rate_radps"),
            ("gyro", "gyro_yaw_rate_radps"),
        )
    }
    weight = segments.pose_fresh / segments.pose_fresh.sum(axis=1, keepdims=True)  # (S, K + 1)
    pose, goal = replayed.pose, segments.pose
    off = wrap_angle(pose[..., 2] - goal[..., 2])  # (P, S, K + 1)
    turn = (off * weight).sum(axis=-1, keepdims=True)
    found["heading"] = np.where(segments.pose_fresh, wrap_angle(off - turn), 0.0)
    cos, sin = np.cos(-turn), np.sin(-turn)
    x, y = pose[..., 0] - goal[:, :1, 0], pose[..., 1] - goal[:, :1, 1]
    to = goal[..., :2] - goal[:, :1, :2]
    parts = []
    for value, aim in ((cos * x - sin * y, to[..., 0]), (sin * x + cos * y, to[..., 1])):
        gap = value - aim
        gap = gap - (gap * weight).sum(axis=-1, keepdims=True)
        parts.append(np.where(segments.pose_fresh, gap, 0.0))
    found["position"] = np.concatenate(parts, axis=-1)
    return found


def position_gap_m(segments: LoggedSegments, replayed: Replayed) -> F64:
    """How far the twin is from the logged position, (P, S, K + 1), from a common first pose."""
    gap: F64 = np.hypot(
        replayed.signals["pose_x_m"] - segments.signals["pose_x_m"],
        replayed.signals["pose_y_m"] - segments.signals["pose_y_m"],
    )
    return gap
