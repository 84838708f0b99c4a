"""Poses from transforms (`/tf` and `/tf_static`), and speeds from poses.

Every frame has one parent at a time. At a given time, a frame's transform is the latest at or
before that time (a causal hold, without interpolation): from `/tf` at most `max_age_s` old, from
`/tf_static` of any age. A lookup goes up from both frames to their common ancestor. A transform may
be stamped later than it was sent, as localisation does to keep it usable until the next one. It is
then timed by its reception.

A robot without odometry gets its speed from its poses. A straight line is fitted to the poses of
the `window_s` that end with the latest pose at the tick. Its slope is the motion in the middle of
the window: a longer window removes more of the localiser's noise, and lags more. If the poses in
the window arrived together, they span too little time, and the pose before the window is added. A
tick has no speed if its poses are too close in time, or if its window contains a jump: the robot
cannot have driven so far, so the localiser corrected itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Bools, Ints
from restock.ingest.decoding.columns import Ragged, TopicColumns
from restock.ingest.profile.signal_paths import AXES, TURN, plain, transform_fields
from restock.ingest.profile.tables import Frames
from restock.ingest.steps.align import ClockSegment, LatestMessages
from restock.ingest.steps.clocks import STAMP
from restock.ingest.task.task import wrap_angle

PARENT = "parent"


@dataclass(frozen=True)
class Edges:
    """The transforms of a recording, grouped by topic and child frame, as topics for `align`."""

    topics: dict[str, TopicColumns]  # "/tf odom" -> the transforms in /tf whose child is odom
    static: frozenset[str]  # keys of `topics` whose transforms never age
    parents: dict[str, list[str]]  # frame -> every parent it ever has
    parent_changes: int = 0  # how often a frame is given another parent

    @classmethod
    def of(cls, frames: Frames, topics: Mapping[str, TopicColumns]) -> Edges:
        """Read the transforms from these topics' columns (their `transform_fields`)."""
        edges: dict[str, TopicColumns] = {}
        static, parents, changes = set(), dict[str, list[str]](), 0
        for topic in (frames.static_topic, frames.topic):
            if topic not in topics:
                continue
            for child, columns in _by_child(topics[topic]).items():
                name = f"{topic} {child}"
                edges[name] = columns
                if topic == frames.static_topic:
                    static.add(name)
                parent = columns.fields[PARENT]
                assert isinstance(parent, np.ndarray)
                changes += int((parent[1:] != parent[:-1]).sum())
                known = parents.setdefault(child, [])
                known += [frame for frame in np.unique(parent).tolist() if frame not in known]
        return cls(edges, frozenset(static), parents, changes)

    def only(self, frames: set[str]) -> Edges:
        """Keep only the transforms of these frames and of all frames above them."""
        reached = {up for frame in frames for up in upward(plain(frame), self.parents)}
        kept = {name: c for name, c in self.topics.items() if name.split(" ", 1)[1] in reached}
        parents = {frame: up for frame, up in self.parents.items() if frame in reached}
        return Edges(kept, self.static & kept.keys(), parents, self.parent_changes)

    def missing(self, base: str, fixed: str) -> str | None:
        """Return why transforms never connect the two frames, or None if they do."""
        ways = [upward(plain(frame), self.parents) for frame in (base, fixed)]
        if ways[0] & ways[1]:
            return None
        tops = [sorted(way - self.parents.keys()) or sorted(way) for way in ways]
        have = ", ".join(
            f"{parent} -> {child}" for child, up in self.parents.items() for parent in up
        )
        return (
            f"no transform joins {', '.join(tops[0])} (above {plain(base)}) to"
            f" {', '.join(tops[1])}; there are {have or 'none'}"
        )


def _by_child(topic: TopicColumns) -> dict[str, TopicColumns]:
    """Group a topic's transforms by child frame."""
    layout = transform_fields(topic.fields)
    assert layout is not None
    columns = [topic.fields[path] for path in layout]
    lengths = columns[0].lengths if isinstance(columns[0], Ragged) else np.ones(len(topic), int)
    message = np.repeat(np.arange(len(lengths)), lengths)
    stamp, of_parent, of_child, *parts = (
        np.asarray(one.values if isinstance(one, Ragged) else one) for one in columns
    )
    codes, names = _plain_codes(of_child)
    order = np.argsort(codes, kind="stable")
    transform = dict(zip((*AXES, *TURN), parts, strict=True))
    parent_codes, parents = _plain_codes(of_parent)
    parent = np.array([*parents, None], object)[parent_codes]
    edges = {}
    begins = np.searchsorted(codes[order], np.arange(len(names) + 1))
    for name, begin, end in zip(names, begins[:-1].tolist(), begins[1:].tolist(), strict=True):
        rows = order[begin:end]
        fields: dict[str, Any] = {
            STAMP: stamp[rows],
            PARENT: parent[rows],
            **{part: values[rows] for part, values in transform.items()},
        }
        edges[name] = TopicColumns(
            topic.log_time_ns[message[rows]],
            topic.publish_time_ns[message[rows]],
            fields,
            None if topic.lap is None else topic.lap[message[rows]],
        )
    return edges


def _plain_codes(frames: NDArray[Any]) -> tuple[Ints, list[str]]:
    """Return the plain names of frames (N,), sorted, and each frame's index among them, (N,)."""
    place: dict[str, int] = {}  # name as written -> its index, in order of appearance
    place_of = [place.setdefault(name, len(place)) for name in frames.tolist()]
    each = [plain(name) for name in place]
    names = sorted(set(each))
    number = {name: code for code, name in enumerate(names)}
    return np.array([number[name] for name in each], np.int64)[np.array(place_of, np.int64)], names


def upward(frame: str, parents: Mapping[str, Sequence[str]]) -> set[str]:
    """Return a frame and all frames that are ever its ancestors."""
    reached, open_ = set[str](), {frame}
    while open_:
        ancestor = open_.pop()
        reached.add(ancestor)
        open_ |= set(parents.get(ancestor, ())) - reached
    return reached


@dataclass(frozen=True)
class Placement:
    """Pose of a frame in the fixed frame, at each of T times."""

    rotation: F64  # (T, 3, 3)
    translation_m: F64  # (T, 3)
    stamp_ns: Ints  # (T,) of the newest moving transform used; if all are static, the time itself
    problem: NDArray[Any]  # (T,) why the pose is unknown, or ""

    @classmethod
    def nowhere(cls, count: int) -> Placement:
        """Return `count` identity poses, to be set by `fill`."""
        return cls(
            np.tile(np.eye(3), (count, 1, 1)),
            np.zeros((count, 3)),
            np.zeros(count, np.int64),
            np.full(count, "", object),
        )

    def fill(self, rows: Any, other: Placement, order: Any) -> None:
        """Copy the rows `order` of another placement to `rows`."""
        for to, source in zip(self._parts(), other._parts(), strict=True):
            to[rows] = source[order]

    def _parts(self) -> tuple[NDArray[Any], ...]:
        return self.rotation, self.translation_m, self.stamp_ns, self.problem

    @property
    def yaw_rad(self) -> F64:
        return np.arctan2(self.rotation[:, 1, 0], self.rotation[:, 0, 0])


@dataclass
class _Transform:
    """A frame's transform to its parent at T times."""

    row: Ints  # (T,) row of the transform in its topic of `Edges.topics`
    parent: Ints  # (T,) number of the parent frame; -1 if no transform is known
    fresh: NDArray[np.bool_]
    moving: NDArray[np.bool_]
    stamp_ns: Ints
    rotation: F64  # (T, 3, 3)
    translation: F64  # (T, 3)


@dataclass
class Tree:
    """The frames of a recording and their transforms over time."""

    frames: Frames
    edges: Edges
    segments: Sequence[ClockSegment]
    _numbers: dict[str, int] = field(default_factory=dict)  # frame -> its number

    def place(self, frame: str, times: Sequence[Ints]) -> Placement:
        """Return the pose of `frame` in the fixed frame at these times, given per segment."""
        source, fixed = self._number(frame), self._number(self.frames.fixed)
        count = sum(map(len, times))
        out = Placement.nowhere(count)
        out.stamp_ns[:] = np.concatenate([*times, np.zeros(0, np.int64)])
        transforms = self._hold_above(frame, times)
        if not transforms:
            out.problem[:] = self._describe_gap([source], [fixed])
            return out
        ups = np.stack([one.parent for one in transforms.values()], axis=1)  # (T, C)
        trees, which = np.unique(ups, axis=0, return_inverse=True)
        for index, tree in enumerate(trees):
            rows = np.flatnonzero(which.reshape(-1) == index)
            parent = {child: int(up) for child, up in zip(transforms, tree, strict=True) if up >= 0}
            self._fill(out, rows, transforms, _path_up(source, parent), _path_up(fixed, parent))
        return out

    def times(self, frame: str) -> list[Ints]:
        """Return the stamps of moving transforms between `frame` and the fixed one, per segment."""
        topics = self.edges.only({frame, self.frames.fixed}).topics
        moving = [name for name in topics if name.split(" ", 1)[0] == self.frames.topic]
        return [
            np.unique(
                np.concatenate([np.zeros(0, np.int64), *(s.topics[n].stamp_ns for n in moving)])
            )
            for s in self.segments
        ]

    def way(self, frame: str, time: Sequence[Ints]) -> list[tuple[str, str, int, int]]:
        """Return the transforms between `frame` and the fixed frame at one time.

        Each is (topic, child frame, row in `edges.topics["TOPIC FRAME"]`, stamp in ns).
        """
        transforms = self._hold_above(frame, time)
        parent = {
            child: int(one.parent[0]) for child, one in transforms.items() if one.parent[0] >= 0
        }
        up, other = (
            _path_up(number, parent) for number in map(self._number, (frame, self.frames.fixed))
        )
        top = next(number for number in up if number in other)
        return [
            (
                self.frames.topic if transforms[child].moving[0] else self.frames.static_topic,
                self._name(child),
                int(transforms[child].row[0]),
                int(transforms[child].stamp_ns[0]),
            )
            for child in (*up[: up.index(top)], *other[: other.index(top)])
        ]

    def _hold_above(self, frame: str, times: Sequence[Ints]) -> dict[int, _Transform]:
        """Return frame number -> transform, for this frame, the fixed one and all above them."""
        children = sorted(self.edges.only({frame, self.frames.fixed}).parents)
        return {self._number(child): self._hold(child, times) for child in children}

    def _fill(
        self,
        out: Placement,
        rows: Ints,
        transforms: dict[int, _Transform],
        up: list[int],
        other: list[int],
    ) -> None:
        """Set the poses at times `rows`; `up` and `other` are both frames' paths to the root."""
        meet = next((frame for frame in up if frame in other), None)
        if meet is None:
            out.problem[rows] = self._describe_gap(up, other)
            return
        outward = self._compose(out, rows, transforms, up[: up.index(meet)])
        homeward = self._compose(out, rows, transforms, other[: other.index(meet)])
        inverse = np.swapaxes(homeward[0], 1, 2)
        out.rotation[rows] = inverse @ outward[0]
        out.translation_m[rows] = np.einsum("nij,nj->ni", inverse, outward[1] - homeward[1])
        moving = [transforms[f] for f in (*up[: up.index(meet)], *other[: other.index(meet)])]
        stamps = [
            np.where(one.moving, one.stamp_ns, np.iinfo(np.int64).min)[rows] for one in moving
        ]
        if stamps:
            newest = np.max(stamps, axis=0)
            known = newest > np.iinfo(np.int64).min
            out.stamp_ns[rows[known]] = newest[known]

    def _compose(
        self, out: Placement, rows: Ints, transforms: dict[int, _Transform], way: list[int]
    ) -> tuple[F64, F64]:
        """Compose the transforms along a path: rotation (N, 3, 3) and translation (N, 3)."""
        rotation, translation = np.tile(np.eye(3), (len(rows), 1, 1)), np.zeros((len(rows), 3))
        for frame in way:
            one = transforms[frame]
            step = one.rotation[rows]
            translation = np.einsum("nij,nj->ni", step, translation) + one.translation[rows]
            rotation = step @ rotation
            names = f"{self._name(int(one.parent[rows[0]]))} -> {self._name(frame)}"
            sane = np.isfinite(step).all(axis=(1, 2)) & np.isfinite(one.translation[rows]).all(1)
            for bad, reason in ((~one.fresh[rows], "stale"), (~sane, "not finite")):
                first = rows[bad & (out.problem[rows] == "")]
                out.problem[first] = f"transform {names}: {reason}"
        return rotation, translation

    def _describe_gap(self, up: list[int], other: list[int]) -> str:
        return f"no transform from {self._name(other[-1])} to {self._name(up[-1])} yet"

    def _hold(self, child: str, times: Sequence[Ints]) -> _Transform:
        """Return a frame's transform at these times: from `/tf` if there is one, else static."""
        moving = self._hold_in(f"{self.frames.topic} {child}", times, self.frames.max_age_s)
        still = self._hold_in(f"{self.frames.static_topic} {child}", times, None)
        if moving is None or still is None:
            only = moving if moving is not None else still
            assert only is not None
            only.moving[:] = moving is not None
            return only
        use = moving.parent >= 0
        both = {}
        for name in ("row", "parent", "fresh", "stamp_ns", "rotation", "translation"):
            a, b = getattr(moving, name), getattr(still, name)
            both[name] = np.where(use.reshape(-1, *[1] * (a.ndim - 1)), a, b)
        return _Transform(moving=use, **both)

    def _hold_in(
        self, name: str, times: Sequence[Ints], max_age_s: float | None
    ) -> _Transform | None:
        columns = self.edges.topics.get(name)
        if columns is None:
            return None
        latest = LatestMessages.join(
            [
                segment.topics[name].hold(stamps, max_age_s)
                for segment, stamps in zip(self.segments, times, strict=True)
            ]
        )
        row, fields = latest.row, columns.fields
        quaternion = [np.asarray(fields[part])[row] for part in TURN]
        parents = np.array([self._number(name) for name in np.asarray(fields[PARENT]).tolist()])
        return _Transform(
            row,
            np.where(latest.known, parents[row], -1) if len(parents) else np.full(len(row), -1),
            latest.fresh,
            np.zeros(len(row), np.bool_),
            np.concatenate(times) - latest.age_ns,
            rotations(*quaternion),
            np.stack([np.asarray(fields[axis])[row] for axis in AXES], axis=1),
        )

    def _number(self, frame: str) -> int:
        return self._numbers.setdefault(plain(frame), len(self._numbers))

    def _name(self, number: int) -> str:
        return next(name for name, known in self._numbers.items() if known == number)


def rotations(x: F64, y: F64, z: F64, w: F64) -> F64:
    """Return rotation matrices (N, 3, 3) of quaternions (N,); NaN for a quaternion of length 0."""
    with np.errstate(all="ignore"):
        size = np.sqrt(x * x + y * y + z * z + w * w)
        x, y, z, w = (np.where(size > 1e-9, part / size, np.nan) for part in (x, y, z, w))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _path_up(frame: int, parent: Mapping[int, int]) -> list[int]:
    """Return the frames from this one up to the root; in a loop, stop before a frame repeats."""
    way = [frame]
    while way[-1] in parent and parent[way[-1]] not in way:
        way.append(parent[way[-1]])
    return way


SCATTER_M = 0.05  # two poses may be this much farther apart, due to noise, without a jump
_CHUNK = 4096  # ticks processed at a time: bounds memory


@dataclass(frozen=True)
class PoseSeries:
    """The poses of one stretch of a recording, in the order of their stamps."""

    stamp_ns: Ints  # (N,) ascending
    x_m: F64
    y_m: F64
    yaw_rad: F64

    @classmethod
    def of(cls, stamp_ns: Ints, x_m: F64, y_m: F64, yaw_rad: F64) -> PoseSeries:
        """Build a series of the finite poses; among equal stamps, the last is kept."""
        keep = np.isfinite(x_m) & np.isfinite(y_m) & np.isfinite(yaw_rad)
        keep[:-1] &= np.diff(stamp_ns) > 0
        return cls(stamp_ns[keep], x_m[keep], y_m[keep], yaw_rad[keep])

    @classmethod
    def joined(cls, parts: Sequence[PoseSeries]) -> PoseSeries:
        """Concatenate consecutive series."""
        return cls.of(
            *(np.concatenate([getattr(part, name) for part in parts]) for name in _COLUMNS)
        )

    def __len__(self) -> int:
        return len(self.stamp_ns)


_COLUMNS = ("stamp_ns", "x_m", "y_m", "yaw_rad")


def poses_along(tree: Tree) -> list[PoseSeries]:
    """Return every pose of a tree's base in its fixed frame, per segment."""
    times = tree.times(tree.frames.base)
    at = tree.place(tree.frames.base, times)
    x, y = (np.where(at.problem == "", column, np.nan) for column in at.translation_m.T[:2])
    ends = np.cumsum([len(stamps) for stamps in times])[:-1]
    parts = zip(times, *(np.split(column, ends) for column in (x, y, at.yaw_rad)), strict=True)
    return [PoseSeries.of(*part) for part in parts]


@dataclass(frozen=True)
class Motion:
    """Speeds at T ticks, in the body frame; each is that in the middle of a window of poses."""

    forward_mps: F64
    lateral_mps: F64
    yaw_rate_radps: F64
    problem: NDArray[Any]  # (T,) why the speed is unknown, or ""


def motion_at(
    poses: PoseSeries,
    tick_ns: Ints,
    window_s: float,
    max_jump_m: float,
    fastest_mps: float = math.inf,
) -> Motion:
    """Compute the speeds at ticks (T,) from the `window_s` of poses up to each tick's latest pose.

    A step between poses is a jump if it is longer than `max_jump_m`, or longer than a robot drives
    at `fastest_mps` in the time of the step plus `window_s`. The extra time allows for jitter of
    stamps, and for a robot that is faster than commanded.
    """
    count = len(tick_ns)
    out = Motion(np.zeros(count), np.zeros(count), np.zeros(count), np.full(count, "", object))
    end = np.searchsorted(poses.stamp_ns, tick_ns, "right")
    latest = np.maximum(end - 1, 0)
    if not len(poses):
        out.problem[:] = "no pose yet"
        return out
    window_ns, latest_ns = round(window_s * 1e9), poses.stamp_ns[latest]
    begin = np.searchsorted(poses.stamp_ns, latest_ns - window_ns)
    together = latest_ns - poses.stamp_ns[begin] < window_ns // 2
    earlier = np.maximum(begin - 1, 0)
    together &= latest_ns - poses.stamp_ns[earlier] <= 2 * window_ns
    begin = np.where(end > 0, np.where(together, earlier, begin), end)
    few = (end == 0) | (latest_ns - poses.stamp_ns[begin] < window_ns // 2)
    out.problem[few] = f"no pose from {window_s / 2:g} to {2 * window_s:g} s before the last one"
    reach_m = fastest_mps * (np.diff(poses.stamp_ns) * 1e-9 + window_s) + SCATTER_M
    steps_m = np.hypot(np.diff(poses.x_m), np.diff(poses.y_m))
    jumps = steps_m > np.minimum(reach_m, max_jump_m)
    before = np.concatenate([[0], np.cumsum(jumps)])  # number of jumps up to each pose
    jumped = ~few & (before[latest] > before[np.minimum(begin, len(poses) - 1)])
    out.problem[jumped] = f"a pose jump within {window_s:g} s"
    turned = np.concatenate([[0.0], np.cumsum(wrap_angle(np.diff(poses.yaw_rad)))])
    heading = poses.yaw_rad[:1] + turned  # continuous, not wrapped at pi
    usable = np.flatnonzero(~few & ~jumped)
    for start in range(0, len(usable), _CHUNK):
        rows = usable[start : start + _CHUNK]
        _fill(out, rows, poses, heading, begin[rows], end[rows])
    return out


def _fill(out: Motion, rows: Ints, poses: PoseSeries, heading: F64, begin: Ints, end: Ints) -> None:
    """Fit the slopes of poses `begin` to `end` (exclusive), and write them to these rows."""
    most = int((end - begin).max())
    at = begin[:, None] + np.arange(most)  # (R, P) the poses of each row
    inside: Bools = at < end[:, None]
    at = np.minimum(at, len(poses) - 1)
    weight = inside / inside.sum(axis=1, keepdims=True)
    since = (poses.stamp_ns[at] - poses.stamp_ns[end - 1][:, None]) * 1e-9
    since -= (since * weight).sum(axis=1, keepdims=True)
    spread = (since**2 * weight).sum(axis=1)

    def slope(values: F64) -> F64:
        column = values[at] - values[end - 1][:, None]
        return np.asarray((since * column * weight).sum(axis=1) / spread, np.float64)

    vx, vy = slope(poses.x_m), slope(poses.y_m)
    ahead = (heading[at] * weight).sum(axis=1)
    cos, sin = np.cos(ahead), np.sin(ahead)
    out.forward_mps[rows] = cos * vx + sin * vy
    out.lateral_mps[rows] = cos * vy - sin * vx
    out.yaw_rate_radps[rows] = slope(heading)
