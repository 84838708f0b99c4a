"""How large a robot can be, by what its lidar never saw inside; and which returns are its own.

Nothing stands where the robot is, so no return comes from within its outline: the nearest that any
did is a bound. A robot also keeps its distance: a guess that reached that far would make a near
collision of every such pass, so it leaves the room that is no near collision. Parts of the robot
that its lidar sees stay at one range whichever way it faces, which nothing around it does: they
belong to the outline, and are no obstacles.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Bools, Ints
from restock.ingest.containers.recording import Recording
from restock.ingest.containers.topic_reading import Fields, Reduction, TopicInfo
from restock.ingest.decoding.columns import FieldColumn, Ragged
from restock.ingest.profile.inputs import Input
from restock.ingest.propose.evidence.footprint import Footprint
from restock.ingest.propose.evidence.roles import Kind
from restock.ingest.steps.clearance import angle_keys, beam_angles
from restock.ingest.steps.motion import PoseSeries

BINS = 60  # of the full circle
NEAREST = "nearest return by bearing"  # (N, BINS) float32, m; no field's name holds a space
MIN_SCANS = 20
OFTEN = 0.005  # of the scans, and at least three: one odd return says nothing
TIGHT_PER_WIDTH = 0.3  # room, by the robot's width: less is a near collision
MIN_M = 0.05  # half of a robot's length
OWN_WITHIN_M, OWN_SPREAD_M = 0.5, 0.015
# It must have turned so far, with so many scans each way it faced; and so many say the same.
FACING_RAD, MIN_FACINGS, MIN_A_FACING, MOSTLY = np.pi / 6, 4, 5, 0.8
_LIMITS = ("range_min", "range_max")


@dataclass(frozen=True)
class ScannedOutline:
    """What the scans say of the outline."""

    nearest_m: float  # that anything but the robot's own parts came to the lidar; inf: nothing did
    own_m: F64  # (P, 2) the robot's own parts, in the lidar's frame

    @property
    def own_range_m(self) -> float:
        """How far the farthest of its own parts is; 0 where it sees none."""
        return float(np.hypot(*self.own_m.T).max(initial=0.0))

    def footprint(self, guess: Footprint) -> Footprint | None:
        """The outline by these scans, where they say more than the guess that there is without."""
        half_m = max(self.nearest_m / (1 + 2 * TIGHT_PER_WIDTH), min(MIN_M, self.nearest_m))
        own = 2 * np.abs(self.own_m).max(axis=0, initial=0.0)
        length, width = (
            max(min(usual, 2 * half_m), float(least))
            for usual, least in zip((guess.length_m, guess.width_m), own, strict=True)
        )
        if (length, width) == (guess.length_m, guess.width_m):
            return None
        parts = (
            f", its own parts at up to {self.own_range_m:.2f} m aside" if len(self.own_m) else ""
        )
        return Footprint(
            length,
            width,
            f"A GUESS from the lidar, which saw nothing nearer than {self.nearest_m:.2f} m{parts}:"
            " MEASURE IT",
            measured=False,
        )


def scanned_outline(
    recording: Recording, fit: tuple[TopicInfo, Kind], poses: PoseSeries | None
) -> ScannedOutline | None:
    """What a topic's scans say; None where it has too few. Without poses no own parts are found."""
    topic, source = fit[0].name, Input(fit[0].name, fit[0].type, fit[1].fields)
    leaves = recording.leaves(topic)
    paths = [*source.fields.values(), *(path for path in _LIMITS if path in leaves)]
    reduction = Reduction(tuple(paths), partial(_nearest, source))
    columns = recording.read({topic: []}, {topic: reduction})[topic]
    nearest = np.asarray(columns.fields[NEAREST], np.float32)
    if len(nearest) < MIN_SCANS:
        return None
    own = np.zeros(BINS, np.bool_)
    if poses is not None and len(poses):
        at = np.searchsorted(poses.stamp_ns, columns.log_time_ns, "right") - 1
        own = _own(nearest[at >= 0], poses.yaw_rad[at[at >= 0]])
    each = np.sort(np.where(own, np.inf, nearest).min(axis=1))
    place = max(3, int(np.ceil(OFTEN * len(each)))) - 1
    bearing = (np.flatnonzero(own) + 0.5) * (2 * np.pi / BINS) - np.pi
    range_m = np.median(nearest[:, own], axis=0).astype(np.float64)
    parts = np.stack([range_m * np.cos(bearing), range_m * np.sin(bearing)], axis=1)
    return ScannedOutline(float(each[place]), parts)


def _own(nearest: NDArray[np.float32], yaw_rad: F64) -> Bools:
    """The bearings (BINS,) at which the range stays, whichever way the robot faces."""
    facing = np.floor(yaw_rad / FACING_RAD).astype(np.int64)
    ways, counts = np.unique(facing, return_counts=True)
    ways = ways[counts >= MIN_A_FACING]
    if len(ways) < MIN_FACINGS:
        return np.zeros(BINS, np.bool_)
    ranges = np.where(np.isfinite(nearest), nearest, 1e3)
    middle = np.median(ranges, axis=0)
    same = np.abs(ranges - middle) < OWN_SPREAD_M  # (scans, BINS)
    stays = np.array([same[facing == way].mean(axis=0) for way in ways]) >= MOSTLY
    return np.asarray((middle < OWN_WITHIN_M) & (stays.mean(axis=0) >= MOSTLY), np.bool_)


def _nearest(source: Input, fields: Fields) -> dict[str, FieldColumn]:
    """The nearest valid return of each scan in each bin of bearings (N, BINS); inf without one."""
    ranges = fields[source.fields["ranges_m"]]
    count = len(ranges)
    low, high = (
        np.asarray(fields.get(path, np.full(count, usual)), np.float64)
        for path, usual in zip(_LIMITS, (0.0, np.inf), strict=True)
    )
    if not isinstance(ranges, Ragged):
        ranges = Ragged(ranges.reshape(-1), np.arange(count + 1) * ranges.shape[1])
    first, last = (
        np.asarray(fields[source.fields[key]], np.float64) for key in angle_keys(source.fields)
    )
    first, step = beam_angles(source, first, last, ranges.lengths)
    row: Ints = np.repeat(np.arange(count), ranges.lengths)
    beam = np.arange(len(row)) - ranges.offsets[:-1][row]
    values = np.asarray(ranges.values, np.float32)
    with np.errstate(invalid="ignore"):
        turn = (first[row] + beam * step[row] + np.pi) % (2 * np.pi) * (BINS / (2 * np.pi))
        valid = np.isfinite(turn) & (values > 0) & (values >= low[row]) & (values <= high[row])
    found = np.full((count, BINS), np.inf, np.float32)
    place = np.minimum(turn[valid].astype(np.int64), BINS - 1)
    np.minimum.at(found, (row[valid], place), values[valid])
    return {NEAREST: found}
