"""Lidar scans of a recording, each placed where the robot was when it was taken.

Left out, and counted: scans without a pose within a second on both sides, those taken while the
robot turned fast (a scan takes up to .2 s, and the pose is known less well), and most of those
taken where it stood. Beams without a return say nothing, whether they are inf, NaN or 0.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import numpy as np

from restock.arrays import F64, Bools, Ints
from restock.ingest.containers.recording import Recording
from restock.ingest.containers.topic_reading import Fields, Reduction, TopicInfo
from restock.ingest.decoding.columns import FieldColumn, Ragged, TopicColumns, offsets_of
from restock.ingest.profile.profile import Profile
from restock.ingest.propose.evidence.footprint import Footprint
from restock.ingest.propose.evidence.lidars import SeenScans, scans_of
from restock.ingest.propose.evidence.roles import KINDS, Kind, topics_for, usable_topics
from restock.ingest.steps.clearance import angle_keys
from restock.ingest.steps.clocks import STAMP
from restock.ingest.urdf.description import BASE_FRAMES
from restock.train.twin.survey.poses import Poses, Times, mount_of, shared_clock

BEAMS = 360  # at most, of a scan: more are thinned out
SCANS = 3000  # at most, of a recording
MOVED_M, TURNED_RAD, WAITED_S = 0.05, 0.05, 2.0  # since the scan before: else it is left out
FAST_RADPS = 0.6  # turning
_LIMITS = ("range_min", "range_max")  # where scans have them


@dataclass(frozen=True)
class PlacedScans:
    """Scans in the frame of the poses: from `origin_m`, beam by beam, to `hit_m`."""

    origin_m: F64  # (N, 2) of the lidar
    hit_m: list[F64]  # N of (B, 2)
    order: list[Ints]  # N of (B,): which beam of its scan each is
    source: str
    notes: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.origin_m)


def placed_scans(
    recording: Recording, poses: Poses, profile: Profile | None, footprint: Footprint | None
) -> list[PlacedScans]:
    """Place a recording's lidar scans on the map, once per clock shared with the poses.

    Header stamps come first, then log time, since the clocks of two computers may differ. Empty if
    there are no scans, or none that can be placed.
    """
    fit = _topic(recording, profile)
    if fit is None:
        return []
    topic, kind = fit[0].name, fit[1]
    leaves, ranges = set(recording.leaves(topic)), kind.fields["ranges_m"]
    angles = [kind.fields[key] for key in angle_keys(kind.fields)]
    if not {ranges, *angles} <= leaves:
        return []
    paths = [path for path in (*angles, *_LIMITS, STAMP) if path in leaves]
    read = recording.read({topic: paths}, {topic: Reduction((ranges,), partial(_thinned, ranges))})
    columns = read.get(topic)
    if columns is None or not len(columns):
        return []
    notes: list[str] = []
    seen = scans_of(recording, [fit])[topic]
    turn, place = _mount(recording, seen, profile, footprint, notes)
    first, last = (np.asarray(columns.fields[path], np.float64) for path in angles)
    if "angle_max_rad" in kind.fields:  # of so many beams
        last = (last - first) / np.maximum(np.asarray(columns.fields["count"]) - 1, 1)
    times = Times.of(columns)
    clocks = [True, False] if shared_clock(poses.times, times) else [False]
    placed = [
        _placed(columns, poses, topic, (turn, place), (first, last), notes, by_stamp=by_stamp)
        for by_stamp in clocks
    ]
    return [scans for scans in placed if len(scans)]


def _placed(
    columns: TopicColumns,
    poses: Poses,
    topic: str,
    mount: tuple[F64, F64],
    bearings: tuple[F64, F64],
    notes: list[str],
    *,
    by_stamp: bool,
) -> PlacedScans:
    """Place the scans of a topic at the poses of one clock.

    `bearings` (N,) are those of each scan's first beam, and the steps from beam to beam.
    """
    times, (turn, place), notes = Times.of(columns), mount, list(notes)
    pose, known = poses.at(times, by_stamp=by_stamp)
    chosen = _keyframes(pose, known, times.log_ns, topic, notes)
    numbers = {
        name: np.asarray(columns.fields[name], np.float64)
        for name in _LIMITS
        if name in columns.fields
    }
    ranges, beams = columns.fields["thinned"], columns.fields["beams"]
    origins, hits, order = np.zeros((len(chosen), 2)), [], []
    for index, row in enumerate(chosen.tolist()):
        reach = np.asarray(ranges[row], np.float64)
        beam = np.asarray(beams[row], np.int64)
        low = numbers["range_min"][row] if "range_min" in numbers else 0.0
        high = numbers["range_max"][row] if "range_max" in numbers else 0.0
        good = np.isfinite(reach) & (reach > max(low, 0.02))
        good &= reach < (high if high > 0 else np.inf)
        reach, beam = reach[good], beam[good]
        bearing = bearings[0][row] + beam * bearings[1][row]
        own = np.stack([reach * np.cos(bearing), reach * np.sin(bearing), 0 * reach], axis=-1)
        body = own @ turn.T + place
        cos, sin = np.cos(pose[row, 2]), np.sin(pose[row, 2])
        planar = np.array([[cos, sin], [-sin, cos]])
        origins[index] = place[:2] @ planar + pose[row, :2]
        hits.append(body[:, :2] @ planar + pose[row, :2])
        order.append(beam)
    clock = "header stamps" if by_stamp else "log time"
    return PlacedScans(origins, hits, order, f"scans of {topic} by {clock}", notes)


def _topic(recording: Recording, profile: Profile | None) -> tuple[TopicInfo, Kind] | None:
    """Return the topic of the lidar's scans, and their fields."""
    if profile is not None:
        scan = profile.inputs.scan
        named = None if scan is None else recording.topics.get(scan.topic)
        if scan is None or named is None or not named.expected or named.skipped:
            return None
        origin = next((kind.origin for kind in KINDS["scan"] if kind.type == scan.type), "")
        return named, Kind(scan.type, scan.fields, origin=origin)
    found = topics_for(recording, usable_topics(recording), KINDS["scan"])
    return min(found, key=lambda fit: "fake" in fit[0].name or "sim" in fit[0].name, default=None)


def _thinned(path: str, fields: Fields) -> dict[str, FieldColumn]:
    """Keep at most BEAMS beams per scan; return ranges, beam indices and beam counts."""
    ranges = fields[path]
    rows = [np.asarray(ranges[row], np.float32).ravel() for row in range(len(ranges))]
    kept = [np.arange(0, len(row), max(len(row) // BEAMS, 1)) for row in rows]
    offsets = offsets_of(np.array([len(beams) for beams in kept], np.int64))
    none = np.zeros(0, np.float32)
    values = np.concatenate([none, *(row[beams] for row, beams in zip(rows, kept, strict=True))])
    beams = np.concatenate([np.zeros(0, np.int32), *(one.astype(np.int32) for one in kept)])
    count = np.array([len(row) for row in rows], np.int64)
    return {
        "thinned": Ragged(values, offsets),
        "beams": Ragged(beams, offsets),
        "count": count,
    }


def _mount(
    recording: Recording,
    seen: SeenScans,
    profile: Profile | None,
    footprint: Footprint | None,
    notes: list[str],
) -> tuple[F64, F64]:
    """Return the lidar's rotation (3, 3) and place (3,) on the robot."""
    frame = seen.frame
    in_frame, moved = _turn(seen.origin[2]), np.array([*seen.origin[:2], 0.0])
    over = np.diag([1.0, -1.0, -1.0])
    scan = None if profile is None else profile.inputs.scan
    bases = [profile.frames.base] if profile is not None and profile.frames is not None else []
    for base in (*bases, *BASE_FRAMES):
        if found := mount_of(recording, frame, base):
            place, turn = found[0] @ moved + found[1], found[0] @ in_frame
            if scan is None or scan.upside_down == (turn[2, 2] < 0):
                return turn, place
            way = "upside down" if scan.upside_down else "upright"
            notes.append(f"the lidar is {way} by inputs.scan of the profile, and not by {frame}")
            return turn @ over, place
    ahead: float | None = None
    yaw: float | None = None
    if profile is not None:
        ahead, yaw = profile.task.body.lidar_x_m, profile.task.body.lidar_yaw_rad
    elif footprint is not None:
        ahead, yaw = footprint.lidar_x_m, footprint.lidar_yaw_rad
    left = 0.0
    if scan is not None and scan.lidar_at_m is not None:
        (ahead, left), yaw = scan.lidar_at_m, scan.lidar_yaw_rad or 0.0
    if ahead is None or yaw is None:
        notes.append(
            "the position of the lidar is not known: it is assumed to be in the robot's middle, "
            "facing ahead"
        )
    turn = _turn(yaw or 0.0)
    if scan is not None and scan.upside_down:
        turn = turn @ over
    return turn, np.array([ahead or 0.0, left, 0.0])


def _turn(yaw_rad: float) -> F64:
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _keyframes(pose: F64, known: Bools, log_ns: Ints, topic: str, notes: list[str]) -> Ints:
    """Choose the scans to use: placed, not while turning fast, and where it moved or waited."""
    rows = np.flatnonzero(known)
    if len(rows) < len(known):
        notes.append(
            f"{len(known) - len(rows):,} of {len(known):,} scans of {topic} have no pose within a"
            " second before and after: left out"
        )
    if not len(rows):
        return rows
    elapsed = np.maximum(np.diff(log_ns[rows]) * 1e-9, 1e-3)
    rate = np.abs(np.diff(pose[rows, 2])) / elapsed
    turning = np.maximum(np.append(rate, 0.0), np.append(0.0, rate)) > FAST_RADPS
    if turning.any():
        notes.append(
            f"{int(turning.sum()):,} scans taken while turning by more than {FAST_RADPS:g} rad/s:"
            " left out"
        )
    rows = rows[~turning]
    kept: list[int] = []
    for row in rows.tolist():
        if kept:
            moved = float(np.hypot(*(pose[row, :2] - pose[kept[-1], :2])))
            turned = abs(pose[row, 2] - pose[kept[-1], 2])
            waited = (log_ns[row] - log_ns[kept[-1]]) * 1e-9
            if moved < MOVED_M and turned < TURNED_RAD and waited < WAITED_S:
                continue
        kept.append(row)
    if len(kept) > SCANS:
        kept = [kept[k] for k in np.linspace(0, len(kept) - 1, SCANS).astype(int)]
    return np.array(kept, np.int64)
