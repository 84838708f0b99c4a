"""What a recording held at its ticks of a stretch of time: scans, plans and goals, to be shown."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from restock.arrays import F64, Ints
from restock.ingest.containers.recording import Recording
from restock.ingest.decoding.columns import Ragged
from restock.ingest.profile.profile import Profile
from restock.ingest.steps.aligned_inputs import AlignedInputs, align_inputs
from restock.ingest.steps.clearance import angle_keys, beam_angles
from restock.ingest.steps.needs import read_topics


@dataclass(frozen=True)
class SeenScan:
    """One lidar scan as it was recorded, its angles as seen from above."""

    stamp_ns: int  # when it was measured, on the alignment clock
    ranges_m: F64  # (B,); inf and NaN as the lidar has them
    angle_min_rad: float
    angle_increment_rad: float


@dataclass(frozen=True)
class Seen:
    """What was known at T ticks. None where the profile has no such input, or nothing was fresh."""

    stamp_ns: Ints  # (T,)
    scans: list[SeenScan | None]
    plans_m: list[F64 | None]  # of (P, 2) points in the fixed frame
    goals_m: list[tuple[float, float] | None]


def seen_between(recording: Recording, profile: Profile, low_ns: int, high_ns: int) -> Seen:
    """What the ticks in [low_ns, high_ns] of the alignment clock saw.

    Raises:
        RecordingError: the recording does not fit the profile.
    """
    aligned = align_inputs(profile, read_topics(recording, profile, reduced=False))
    inside = [stamps[(stamps >= low_ns) & (stamps <= high_ns)] for stamps in aligned.ticks]
    aligned = replace(aligned, ticks=inside)
    stamps = np.concatenate(inside) if inside else np.zeros(0, np.int64)
    return Seen(stamps, _scans(aligned, stamps), _plans(aligned, stamps), _goals(aligned, stamps))


def _scans(aligned: AlignedInputs, stamps: Ints) -> list[SeenScan | None]:
    if "scan" not in aligned.inputs.by_name:
        return [None] * len(stamps)
    latest = aligned.latest("scan")
    ranges = aligned.inputs.column("scan", "ranges_m")
    source = aligned.inputs.by_name["scan"]
    first, last = (aligned.inputs.numbers("scan", key) for key in angle_keys(source.fields))
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
