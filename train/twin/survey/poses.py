"""The poses of a robot in a recording, from a pose topic or from transforms.

Unlike steps, which must not see the future, a survey uses the whole drive, so poses are
interpolated between messages. Times are kept on both clocks of a recording (header stamps and log
time), as scans and poses are matched by a clock that both topics have.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from restock.arrays import F64, Bools, Ints
from restock.ingest.containers.recording import Recording
from restock.ingest.decoding.columns import TopicColumns
from restock.ingest.profile.profile import Profile
from restock.ingest.profile.signal_paths import AXES, FRAME_ID, TURN, plain
from restock.ingest.profile.tables import Frames
from restock.ingest.propose.pose_choice import (
    chain_between,
    on_map,
    transform_edges,
    transform_frames,
)
from restock.ingest.propose.roles import KINDS, topics_for
from restock.ingest.steps.clocks import STAMP
from restock.ingest.steps.input_columns import fixes_of
from restock.ingest.task.task import yaw_of

MAX_APART_NS = 1_000_000_000  # longest time from an interpolated pose to the nearest on each side
JUMP_M = 1.0  # if two poses are farther apart, the robot was carried or relocalised
WELL_PLACED = 0.9  # poses are trusted if at least this share is on free floor
FURTHEST_M = 1e5  # poses that are farther from the median pose are faulty


@dataclass(frozen=True)
class Times:
    """The times of N messages in ns on two clocks."""

    stamp_ns: Ints  # (N,) header stamps; 0 if unknown
    log_ns: Ints  # (N,) log times

    @classmethod
    def of(cls, columns: TopicColumns) -> Times:
        """Return the times of a topic's messages."""
        stamp = columns.fields.get(STAMP)
        none = np.zeros(len(columns), np.int64)
        stamps = np.asarray(stamp).astype(np.int64) if isinstance(stamp, np.ndarray) else none
        return cls(stamps, columns.log_time_ns)

    @property
    def stamped(self) -> bool:
        return bool(len(self.stamp_ns)) and bool((self.stamp_ns != 0).mean() > 0.9)

    def clock(self, *, by_stamp: bool) -> Ints:
        return self.stamp_ns if by_stamp else self.log_ns


def shared_clock(one: Times, other: Times) -> bool:
    """Return whether both are stamped by one clock: most stamps of `other` are in `one`'s span."""
    if not (one.stamped and other.stamped):
        return False
    low, high = one.stamp_ns.min() - MAX_APART_NS, one.stamp_ns.max() + MAX_APART_NS
    return bool(((other.stamp_ns >= low) & (other.stamp_ns <= high)).mean() > 0.5)


@dataclass(frozen=True)
class Poses:
    """N poses of a robot's base in a frame, in the order of their log time."""

    times: Times
    x_m: F64
    y_m: F64
    yaw_rad: F64  # unwrapped; NaN if unknown
    frame: str
    source: str  # description of the pose source, for people

    def __len__(self) -> int:
        return len(self.x_m)

    @property
    def places_m(self) -> F64:
        """Return the positions, (N, 2)."""
        return np.stack([self.x_m, self.y_m], axis=-1)

    @property
    def driven_m(self) -> float:
        """Return the length of the path, in steps of at least a decimetre and without jumps."""
        kept, way = self.places_m[:1], 0.0
        for place in self.places_m[1:]:
            step = float(np.hypot(*(place - kept[-1])))
            if step >= 0.1:
                way, kept = way + step * (step <= JUMP_M), place[None]
        return way

    def at(self, times: Times, *, by_stamp: bool) -> tuple[F64, Bools]:
        """Return poses (M, 3) at these times, and which (M,) are known, as in `interpolated`."""
        values = np.stack([self.x_m, self.y_m, self.yaw_rad], axis=-1)
        return interpolated(
            self.times.clock(by_stamp=by_stamp), values, times.clock(by_stamp=by_stamp)
        )


def interpolated(known_ns: Ints, values: F64, wanted_ns: Ints) -> tuple[F64, Bools]:
    """Interpolate values (N, K) at times (M,); also return which have a near sample on each side.

    Near means within `MAX_APART_NS`.
    """
    if not len(known_ns):
        return np.zeros((len(wanted_ns), values.shape[1])), np.zeros(len(wanted_ns), np.bool_)
    order = np.argsort(known_ns, kind="stable")
    known, values = known_ns[order], values[order]
    first = np.flatnonzero(np.diff(known, prepend=known[0] - 1) > 0)
    known, values = known[first], values[first]
    after = np.clip(np.searchsorted(known, wanted_ns), 0, len(known) - 1)
    before = np.maximum(after - 1, 0)
    origin = known[0]
    found = np.stack(
        [np.interp(wanted_ns - origin, known - origin, column) for column in values.T], axis=-1
    )
    near = np.abs(known[after] - wanted_ns) <= MAX_APART_NS
    near &= np.abs(wanted_ns - known[before]) <= MAX_APART_NS
    return found, near & np.isfinite(found).all(axis=1)


def candidate_poses(recording: Recording, profile: Profile | None = None) -> list[Poses]:
    """Return the poses of each pose source of a recording, best source first; empty without any.

    With a profile, only its source of poses is used. Otherwise the order is: transforms from a map,
    pose topics (localised ones first), other transforms. Satellite fixes are the last resort.
    """
    if profile is not None:
        at, (x_m, y_m) = _read_by_profile(recording, profile), profile.origin_m or (0.0, 0.0)
        return [] if at is None else [replace(at, x_m=at.x_m - x_m, y_m=at.y_m - y_m)]
    guess = transform_frames(recording, transform_edges(recording))
    along = None
    if guess is not None:
        along = along_transforms(recording, guess)
    kinds = topics_for(recording, KINDS["pose"])
    fixes = {topic.name: kind.fields for topic, kind in kinds if kind.by_fix}
    found = _read_topics(recording, {t.name: k.fields for t, k in kinds if t.name not in fixes})
    if not found and along is None:  # fixes have a frame of their own, and no heading
        found = [p for name, of in fixes.items() for p in [_read_fixes(recording, name, of)] if p]
    return [p for p in ((along, *found) if on_map(guess) else (*found, along)) if p is not None]


def choose_poses(candidates: Sequence[Poses], on_map: Callable[[F64], Bools]) -> Poses | None:
    """Return the first candidate that moves and is on free floor, else the one most on free floor.

    `on_map` returns which places (N, 2) are free. If a localiser never ran, its poses stand still
    or lie in walls.
    """
    furthest = max((poses.driven_m for poses in candidates), default=0.0)
    moving = [p for p in candidates if len(p) > 1 and p.driven_m >= furthest / 2]
    shares = [float(on_map(poses.places_m).mean()) for poses in moving]
    for poses, share in zip(moving, shares, strict=True):
        if share >= WELL_PLACED:
            return poses
    return moving[int(np.argmax(shares))] if moving else None


def _read_by_profile(recording: Recording, profile: Profile) -> Poses | None:
    source = profile.inputs.pose
    if source is not None and source.topic in recording.topics:
        if source.by_rates:
            return None
        if source.by_fix:
            settings = source.origin_deg, source.max_std_m, source.track_m
            return _read_fixes(recording, source.topic, source.fields, *settings)
        found = _read_topics(recording, {source.topic: source.fields})
        return found[0] if found else None
    return None if profile.frames is None else along_transforms(recording, profile.frames)


def _read_topics(recording: Recording, topics: Mapping[str, Mapping[str, str]]) -> list[Poses]:
    """Read poses from topics with these fields; topics that lack a field are left out."""
    wanted: dict[str, list[str]] = {}
    for topic, fields in topics.items():
        leaves = set(recording.leaves(topic))
        requested = _paths(fields)
        if set(requested) <= leaves:
            wanted[topic] = requested + [path for path in (STAMP, FRAME_ID) if path in leaves]
    found = []
    for topic, columns in recording.read(wanted).items():
        fields = topics[topic]
        x, y, *turn = (np.asarray(columns.fields[p], np.float64) for p in _paths(fields))
        yaw = yaw_of(*turn) if len(turn) == 4 else turn[0] if turn else np.full(len(x), np.nan)
        frames = np.asarray(columns.fields.get(FRAME_ID, [""]), object)
        if len(columns) and (
            poses := _poses(
                Times.of(columns), x, y, yaw, plain(str(frames[-1])), f"poses of {topic}"
            )
        ):
            found.append(poses)
    return found


def _read_fixes(
    recording: Recording,
    topic: str,
    fields: Mapping[str, str],
    origin_deg: tuple[float, float] | None = None,
    max_std_m: float | None = None,
    track_m: float | None = None,
) -> Poses | None:
    """Read poses from a satellite receiver's fixes; their yaw is the direction of travel."""
    leaves = recording.leaves(topic)
    wanted = [*fields.values(), *(path for path in (STAMP, FRAME_ID) if path in leaves)]
    columns = recording.read({topic: wanted})[topic]
    at = fixes_of(columns, fields).poses(origin_deg, max_std_m, track_m)
    known = np.flatnonzero(at.problem == "")
    times, yaw = Times.of(columns), at.yaw_rad[known]
    kept = Times(times.stamp_ns[known], times.log_ns[known])
    return _poses(kept, at.x_m[known], at.y_m[known], yaw, "", f"fixes of {topic}")


def _paths(fields: Mapping[str, str]) -> list[str]:
    turn = [f"{fields['orientation']}.{axis}" for axis in "xyzw"] if "orientation" in fields else []
    if not turn and "yaw_rad" in fields:
        turn = [fields["yaw_rad"]]
    return [fields["x_m"], fields["y_m"], *turn]


def _poses(times: Times, x: F64, y: F64, yaw: F64, frame: str, source: str) -> Poses | None:
    known = np.isfinite(x) & np.isfinite(y)
    if not known.any():
        return None
    sane = known & (np.abs(x - np.median(x[known])) < FURTHEST_M)
    sane &= np.abs(y - np.median(y[known])) < FURTHEST_M
    kept = Times(times.stamp_ns[sane], times.log_ns[sane])
    x, y, yaw = x[sane], y[sane], yaw[sane]
    if np.isfinite(yaw).all():
        yaw = np.unwrap(yaw)
    return Poses(kept, x, y, yaw, frame, source)


def along_transforms(recording: Recording, frames: Frames) -> Poses | None:
    """Compute the poses of `frames.base` in `frames.fixed`; None if no transforms connect them.

    The poses have the times of the moving transform that is sent most often.
    """
    edges = transform_edges(recording, frames)
    chain = chain_between(edges, frames.base, frames.fixed)
    if not chain:
        return None
    moving = [(len(edges.topics[name]), name) for name in chain if name not in edges.static]
    clock = Times.of(edges.topics[max(moving)[1] if moving else chain[0]])
    x, y, yaw = (np.zeros(len(clock.log_ns)) for _ in range(3))
    sane = np.ones(len(x), np.bool_)
    for name in chain:  # from the base to the fixed frame
        columns = edges.topics[name]
        step = np.stack(_planar(columns), axis=-1)
        if name in edges.static or len(columns) == 1:
            found = np.repeat(step[-1:], len(x), axis=0)
        else:
            by_stamp = shared_clock(clock, Times.of(columns))
            found, near = interpolated(
                Times.of(columns).clock(by_stamp=by_stamp), step, clock.clock(by_stamp=by_stamp)
            )
            sane &= near
        cos, sin = np.cos(found[:, 2]), np.sin(found[:, 2])
        x, y = cos * x - sin * y + found[:, 0], sin * x + cos * y + found[:, 1]
        yaw = yaw + found[:, 2]
    kept = Times(clock.stamp_ns[sane], clock.log_ns[sane])
    way = " -> ".join(name.split(" ", 1)[1] for name in reversed(chain))
    source = f"transforms {plain(frames.fixed)} -> {way}"
    return _poses(kept, x[sane], y[sane], yaw[sane], plain(frames.fixed), source)


def _planar(columns: TopicColumns) -> tuple[F64, F64, F64]:
    """Return x, y and the unwrapped yaw of N transforms, (N,) each."""
    x, y = (np.asarray(columns.fields[axis], np.float64) for axis in AXES[:2])
    yaw = yaw_of(*(np.asarray(columns.fields[part], np.float64) for part in TURN))
    return x, y, np.unwrap(yaw)
