"""Chooses where poses come from, and how speeds follow from them without odometry.

Transforms give poses if they join a fixed frame with the robot's, by the frames' names. Speeds are
the slope of the last poses in a window. The noise of poses is found from third differences, which
smooth motion does not have: for white noise with standard deviation s, theirs is s x sqrt(20). A
slope over a window of n poses then has s / period x sqrt(12 / (n (n² - 1))). The shortest window in
which that is small enough is proposed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from restock.arrays import F64
from restock.ingest.containers.recording import Recording
from restock.ingest.profile.description import BASE_FRAMES, FIXED_FRAMES
from restock.ingest.profile.signal_paths import AXES, TURN, plain, transform_fields
from restock.ingest.profile.tables import Clock, Frames
from restock.ingest.propose.roles import Roles, robots_in
from restock.ingest.steps.align import align
from restock.ingest.steps.frames import (
    PARENT,
    Edges,
    PoseSeries,
    Tree,
    poses_along,
    rotations,
    upward,
)
from restock.ingest.steps.input_columns import MAX_STD_M, TRACK_M, Fixes, fixes_of
from restock.ingest.task.task import wrap_angle, yaw_of

FOXGLOVES_TRANSFORMS = ("foxglove.FrameTransform", "foxglove.FrameTransforms")


def on_map(frames: Frames | None) -> bool:
    """Return whether these frames lead to a map."""
    return frames is not None and frames.fixed.split("/")[-1] == "map"


def frame_lines(frames: Frames, *, used: bool) -> list[str]:
    """Write the `[frames]` of a profile, commented out if they are not `used`."""
    mark, use = ("", "poses") if used else ("# ", "instead of inputs.pose: poses")
    usual = frames.topic == Frames().topic
    lines = [
        f"[frames]  # {use} from {frames.topic}",
        f'fixed = "{frames.fixed}"',
        f'base = "{frames.base}"',
        f"max_age_s = {frames.max_age_s:g}",
        *([] if usual else [f'topic = "{frames.topic}"']),
        *([] if usual else [f'static_topic = "{frames.static_topic}"']),
    ]
    return [*(mark + line for line in lines), ""]


def transform_topics(recording: Recording) -> tuple[str, str]:
    """Return the topics of the robot's moving and static transforms.

    The first of these that exist are used: topics in the robot's namespace; `/tf` and `/tf_static`;
    topics in the only namespace with transforms; the only topic with Foxglove's transforms.
    """
    names = Frames().topic, Frames().static_topic
    held = {
        end: [name.removesuffix(end) for name in recording.topics if name.endswith(end)]
        for end in names
    }
    for end in names:
        spaces = [space for space in held[end] if transform_fields(recording.leaves(space + end))]
        one = spaces if len(spaces) == 1 else []
        for space in (*robots_in(recording)[:1], "", *one):
            if space in spaces:
                return space + names[0], space + names[1]
    of_foxglove = [
        name for name, topic in recording.topics.items() if topic.type in FOXGLOVES_TRANSFORMS
    ]
    return (of_foxglove[0], names[1]) if len(of_foxglove) == 1 else names


def transform_edges(recording: Recording, frames: Frames | None = None) -> Edges:
    """Read the transforms of the topics in `frames`, by default of `transform_topics`."""
    if frames is None:
        topic, static_topic = transform_topics(recording)
        frames = Frames(topic=topic, static_topic=static_topic)
    wanted = {
        name: fields
        for name in (frames.topic, frames.static_topic)
        if name in recording.topics and (fields := transform_fields(recording.leaves(name)))
    }
    return Edges.of(frames, recording.read(wanted) if wanted else {})


def mount_of(edges: Edges, sensor: str, base: str) -> tuple[F64, F64] | None:
    """Return rotation (3, 3) and place (3,) of a sensor's frame in the base's; None if unknown.

    The last message of each transform is used.
    """
    turn, place = np.eye(3), np.zeros(3)
    chain = chain_between(edges, sensor, base) if sensor else []
    for name in chain:
        fields = edges.topics[name].fields
        step = rotations(*(np.asarray(fields[part], np.float64)[-1:] for part in TURN))[0]
        place = step @ place + [float(np.asarray(fields[axis])[-1]) for axis in AXES]
        turn = step @ turn
    known = bool(chain) or plain(sensor) == plain(base)
    return (turn, place) if known and np.isfinite([*turn, place]).all() else None


def chain_between(edges: Edges, base: str, fixed: str) -> list[str]:
    """Return the keys in `edges.topics` of the transforms from `base` up to `fixed`, or []."""
    chain, here = list[str](), plain(base)
    while here != plain(fixed):
        names = [name for name in edges.topics if name.split(" ", 1)[1] == here]
        if not names or len(chain) > len(edges.topics):
            return []
        # If a frame is sent both as static and as moving, use the moving transform.
        name = min(names, key=lambda name: (name in edges.static, -len(edges.topics[name])))
        chain.append(name)
        here = str(np.asarray(edges.topics[name].fields[PARENT], object)[-1])
    return chain


def transform_frames(recording: Recording, edges: Edges) -> Frames | None:
    """Guess the map's and the robot's frame from transforms (`transform_edges`).

    None if they do not join two such frames.
    """
    frames = {frame for child, up in edges.parents.items() for frame in (child, *up)}
    others = {robot.rpartition("/")[2] for robot in robots_in(recording)[1:]}
    frames = {frame for frame in frames if frame.split("/")[0] not in others}
    for fixed in named_frames(FIXED_FRAMES, frames):
        for base in named_frames(BASE_FRAMES, frames):
            if fixed in upward(base, edges.parents):
                topic, static_topic = transform_topics(recording)
                return Frames(fixed, base, topic=topic, static_topic=static_topic)
    return None


def named_frames(words: tuple[str, ...], frames: set[str]) -> list[str]:
    """Return the frames with these names, with or without a robot's prefix; best first."""
    return [name for word in words for name in sorted(frames) if name.split("/")[-1] == word]


SMALL_MPS, SMALL_RADPS = 0.04, 0.08  # acceptable standard deviations of computed speeds
MIN_S, MAX_S = 0.2, 2.0  # limits of the window over which speeds are computed from poses
MIN_POSES = 3
MIN_CHANGES = 20


@dataclass(frozen=True)
class MotionChoice:
    """The proposed `[motion]`, or why there can be none."""

    window_s: float
    why: str = ""
    problem: str = ""

    def lines(self) -> list[str]:
        why = "no usable odometry: speeds are the slope of the last poses, and show no slip"
        return [f"[motion]  # {why}", f"window_s = {self.window_s:g}  # {self.why}", ""]


def choose_motion(recording: Recording, poses: PoseSeries, source: str) -> MotionChoice:
    """Choose the window in which speeds are computed from poses; `source` names the poses."""
    gaps = np.diff(poses.stamp_ns) * 1e-9
    period, usual = (float(np.percentile(gaps, p)) if len(gaps) else 0.0 for p in (50, 90))
    least = (MIN_POSES - 1) * usual * 1.1
    if len(poses) < MIN_POSES or least > MAX_S:
        span = recording.span_ns or (0, 0)
        problem = (
            f"no odometry, and {source} has {len(poses)} poses in {(span[1] - span[0]) * 1e-9:.0f}"
            " s: too few, or too far apart, to compute speeds from;"
            " record nav_msgs/msg/Odometry, or a pose at least every"
            f" {MAX_S / MIN_POSES:.1f} s"
        )
        return MotionChoice(0.0, problem=problem)
    poses = _changes(poses)  # repeated poses do not show the noise
    period = max(period, float(np.median(np.diff(poses.stamp_ns))) * 1e-9)
    noise_m = float(np.hypot(_scatter(poses.x_m), _scatter(poses.y_m)) / np.sqrt(2))
    noise_rad = _scatter(np.concatenate([[0.0], np.cumsum(wrap_angle(np.diff(poses.yaw_rad)))]))
    window = float(np.ceil(max(MIN_S, least) * 10) / 10)
    while window < MAX_S and not _small(noise_m, noise_rad, period, window):
        window = round(window + 0.1, 1)
    scatter = f"{noise_m * 1e3:.1f} mm and {noise_rad * 1e3:.1f} mrad"
    return MotionChoice(window, f"{source} scatters by {scatter}, every {period:.3g} s")


def pose_series(
    recording: Recording, roles: Roles, frames: Frames | None, edges: Edges
) -> tuple[PoseSeries, str]:
    """Return every pose at its log time, and its source in words.

    They come from the transforms `edges` between `frames`; without `frames`, from the pose topic.
    """
    if frames is not None:
        edges = edges.only({frames.base, frames.fixed})
        segments, _ = align(edges.topics, Clock(alignment="log_time"))
        series = PoseSeries.joined(poses_along(Tree(frames, edges, segments)))
        return series, f"{frames.fixed} -> {frames.base} of {frames.topic}"
    topic, kind = roles["pose"][0]
    if kind.by_fix:
        fixes = fixes_in(recording, topic.name, kind.fields)
        at = fixes.poses()
        order = np.argsort(fixes.time_ns, kind="stable")
        columns = (column[order] for column in (at.x_m, at.y_m, at.yaw_rad))
        return PoseSeries.of(fixes.time_ns[order], *columns), topic.name
    position = [kind.fields["x_m"], kind.fields["y_m"]]
    turned = kind.fields.get("orientation")
    turn = [f"{turned}.{axis}" for axis in "xyzw"] if turned else [kind.fields["yaw_rad"]]
    read = recording.read({topic.name: [*position, *turn]})[topic.name]
    x, y, *parts = (np.asarray(read.fields[p], np.float64) for p in (*position, *turn))
    yaw = yaw_of(*parts) if turned else parts[0]
    order = np.argsort(read.log_time_ns, kind="stable")
    return PoseSeries.of(read.log_time_ns[order], x[order], y[order], yaw[order]), topic.name


def fixes_in(recording: Recording, topic: str, fields: Mapping[str, str]) -> Fixes:
    """Read the satellite fixes in these fields of a topic."""
    return fixes_of(recording.read({topic: list(fields.values())})[topic], fields)


def fix_lines(recording: Recording, topic: str, fields: Mapping[str, str]) -> list[str]:
    """Write the keys for satellite fixes: origin, accuracy, and distance that gives the yaw."""
    fixes = fixes_in(recording, topic, fields)
    origin, usual = fixes.origin_deg(), _usual_std_m(fixes)
    how = "without a stated accuracy" if usual is None else f"of {usual:.2g} m, mostly"
    return [
        f"# Fixes {how}. Yaw is the direction of the last track_m driven (backing up reverses it),",
        "# or by an IMU that knows north: [inputs.heading], orientation of sensor_msgs/msg/Imu.",
        *([f"origin_deg = [{origin[0]:.7f}, {origin[1]:.7f}]  # the first fix"] if origin else []),
        f"max_std_m = {MAX_STD_M:g}  # fixes with a larger standard deviation are not used",
        f"track_m = {max(TRACK_M, round(3 * (usual or 0.0), 1)):g}",
    ]


def fix_noise_lines(
    recording: Recording, topic: str, fields: Mapping[str, str], driven_m: float
) -> list[str]:
    """Return the profile's tables [episodes] and [noise], as lines, for poses by satellite fixes.

    `driven_m` is how far the robot may drive between two fixes.
    """
    usual = _usual_std_m(fixes_in(recording, topic, fields)) or 1.0
    return [
        "[episodes]",
        f"max_pose_jump_m = {max(1.0, round(driven_m + 3 * usual, 1)):g}  # between two fixes",
        "",
        "[noise]",
        f"localiser_m = {max(usual, 0.01):.2g}  # as the fixes state; less would be taken for slip",
        "",
    ]


def _usual_std_m(fixes: Fixes) -> float | None:
    """Return the median of the standard deviations that fixes contain (m); None without any."""
    std_m = fixes.std_m()
    reported = std_m[np.isfinite(std_m)]
    return float(np.median(reported)) if len(reported) else None


def _changes(poses: PoseSeries) -> PoseSeries:
    """Drop poses that repeat the pose before, if enough others remain to show the noise."""
    columns = (poses.x_m, poses.y_m, poses.yaw_rad)
    new = np.concatenate([[True], np.any([np.diff(column) != 0 for column in columns], axis=0)])
    if new.sum() < MIN_CHANGES:
        return poses
    return PoseSeries(poses.stamp_ns[new], *(column[new] for column in columns))


def _scatter(values: F64) -> float:
    """Return the standard deviation of white noise on a smooth curve, ignoring outliers."""
    third = np.diff(values, n=3)
    return float(np.median(np.abs(third)) / 0.6745 / np.sqrt(20)) if len(third) else 0.0


def _slope_scatter(noise: float, period_s: float, window_s: float) -> float:
    count = max(np.floor(window_s / period_s) + 1, 2)
    return float(noise / period_s * np.sqrt(12 / (count * (count**2 - 1))))


def _small(noise_m: float, noise_rad: float, period_s: float, window_s: float) -> bool:
    return (
        _slope_scatter(noise_m, period_s, window_s) <= SMALL_MPS
        and _slope_scatter(noise_rad, period_s, window_s) <= SMALL_RADPS
    )
