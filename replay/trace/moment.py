"""What a robot perceived: scans, plan and goal at ticks, and ranges from observations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from restock.arrays import F32, F64, Ints
from restock.ingest.decoding.columns import Ragged
from restock.ingest.profile.tables import Input
from restock.ingest.steps.aligned_inputs import AlignedInputs
from restock.ingest.steps.needs import angle_keys, beam_angles
from restock.ingest.task.surroundings import outline_reach
from restock.ingest.task.task import Body, Task

BINS = 720  # bins of bearing in a merged scan


@dataclass(frozen=True)
class SeenScan:
    """A lidar's scan as recorded, with angles counterclockwise as seen from above."""

    stamp_ns: int  # when it was measured, on the alignment clock
    ranges_m: F64  # (B,); inf and NaN as in the message
    angle_min_rad: float
    angle_increment_rad: float


@dataclass(frozen=True)
class Seen:
    """Scans, plans and goals at T ticks; None if the profile lacks the input or it is stale."""

    stamp_ns: Ints  # (T,)
    scans: list[SeenScan | None]
    plans_m: list[F64 | None]  # (P, 2) points in the fixed frame
    goals_m: list[tuple[float, float] | None]


def seen_of(aligned: AlignedInputs, low_ns: int, high_ns: int) -> Seen:
    """Return scans, plans and goals at the ticks in [low_ns, high_ns] from aligned inputs."""
    inside = [stamps[(stamps >= low_ns) & (stamps <= high_ns)] for stamps in aligned.ticks]
    aligned = replace(aligned, ticks=inside)
    stamps = np.concatenate(inside) if inside else np.zeros(0, np.int64)
    return Seen(stamps, _scans(aligned, stamps), _plans(aligned, stamps), _goals(aligned, stamps))


def _scans(aligned: AlignedInputs, stamps: Ints) -> list[SeenScan | None]:
    """Return the scan at each stamp.

    A scan is returned as recorded. If the profile has mounting positions of lidars, their scans are
    merged into one scan, as seen from the position of the body's lidar.
    """
    scans = aligned.profile.inputs.scans
    if not scans or not scans.keys() <= aligned.inputs.by_name.keys():
        return [None] * len(stamps)
    seen = [_scans_of(aligned, name, stamps) for name in scans]
    sources, body = list(scans.values()), aligned.profile.task.body
    if sources[0].lidar_at_m is None:
        return seen[0]
    return [_from_the_middle(body, sources, parts) for parts in zip(*seen, strict=True)]


def _from_the_middle(
    body: Body, sources: Sequence[Input], scans: Sequence[SeenScan | None]
) -> SeenScan | None:
    """Merge the scans of several lidars at a tick: take the nearest return in each of BINS bins."""
    nearest, stamp_ns = np.full(BINS, np.inf), [scan.stamp_ns for scan in scans if scan is not None]
    for source, scan in zip(sources, scans, strict=True):
        if scan is None:
            continue
        back = np.flatnonzero(np.isfinite(scan.ranges_m) & (scan.ranges_m > 0))
        bearing = scan.angle_min_rad + scan.angle_increment_rad * back
        bearing += source.lidar_yaw_rad or 0.0
        ahead_m, left_m = source.lidar_at_m or (body.lidar_x_m, 0.0)
        x = ahead_m - body.lidar_x_m + scan.ranges_m[back] * np.cos(bearing)
        y = left_m + scan.ranges_m[back] * np.sin(bearing)
        place = ((np.arctan2(y, x) + np.pi) * (BINS / (2 * np.pi))).astype(np.int64)
        np.minimum.at(nearest, np.minimum(place, BINS - 1), np.hypot(x, y))
    width = 2 * np.pi / BINS
    first = width / 2 - np.pi - body.lidar_yaw_rad
    return SeenScan(max(stamp_ns), nearest, first, width) if stamp_ns else None


def _scans_of(aligned: AlignedInputs, name: str, stamps: Ints) -> list[SeenScan | None]:
    latest = aligned.latest(name)
    ranges = aligned.inputs.column(name, "ranges_m")
    source = aligned.inputs.by_name[name]
    first, last = (aligned.inputs.numbers(name, key) for key in angle_keys(source.fields))
    scans: list[SeenScan | None] = []
    for row, age, fresh, stamp in zip(latest.row, latest.age_ns, latest.fresh, stamps, strict=True):
        if not fresh:
            scans.append(None)
            continue
        one = ranges[row]
        values = np.atleast_1d(np.asarray(one.values if isinstance(one, Ragged) else one, float))
        this, beams = slice(row, row + 1), np.array([len(values)])
        angles = beam_angles(source, first[this], last[this], beams)
        scans.append(SeenScan(int(stamp) - int(age), values, *(float(one[0]) for one in angles)))
    return scans


def _plans(aligned: AlignedInputs, stamps: Ints) -> list[F64 | None]:
    if "plan" not in aligned.inputs.by_name:
        return [None] * len(stamps)
    latest, plans = aligned.latest("plan"), aligned.inputs.plans
    known = zip(latest.row, latest.fresh, strict=True)
    return [plans[row] if fresh and len(plans[row]) else None for row, fresh in known]


def _goals(aligned: AlignedInputs, stamps: Ints) -> list[tuple[float, float] | None]:
    if "goal" not in aligned.inputs.by_name:
        return [None] * len(stamps)
    latest, goals = aligned.latest("goal"), aligned.inputs.goals
    known = zip(latest.row, latest.fresh, strict=True)
    return [(float(goals[row, 0]), float(goals[row, 1])) if ok else None for row, ok in known]


def sector_ranges(task: Task, observations: F32) -> tuple[F64, F64]:
    """Return the bearing of each sector, (S,), and the ranges in N observations, (N, S); inf: free.

    Bearings and ranges are seen from the lidar; bearing 0 is ahead. The task must have a lidar.
    """
    names = task.observation_names
    first = next(i for i, name in enumerate(names) if name.startswith("clearance_"))
    near = observations[:, first : first + task.sectors].astype(np.float64)
    width = 2 * np.pi / task.sectors
    bearing: F64 = np.asarray((np.arange(task.sectors) + 0.5) * width - np.pi, np.float64)
    clearance = np.asarray(near**2 * task.range_max_m, np.float64)
    ranges = np.add(clearance, outline_reach(bearing, task.body))
    ranges[clearance >= task.range_max_m * (1 - 1e-6)] = np.inf
    return bearing, ranges
