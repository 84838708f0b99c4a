"""The fields that a profile reads of a recording, and why a recording does not fit it.

Of a laser scan, only the clearance per sector is kept, not the ranges.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from restock.arrays import F64, Ints
from restock.errors import RecordingError, counted
from restock.ingest.containers.recording import Recording
from restock.ingest.containers.storage import Fields, Reduction
from restock.ingest.decoding.columns import (
    FieldColumn,
    Ragged,
    TopicColumns,
    cut,
    suggest_fields,
    take,
)
from restock.ingest.profile.description import FIXED_FRAMES
from restock.ingest.profile.profile import Profile, without_lidar
from restock.ingest.profile.signal_paths import (
    FIELDS,
    element_of,
    frame_id_path,
    frame_path,
    plain,
    pressed_paths,
    transform_fields,
)
from restock.ingest.profile.tables import CLOUD, SCANS, CustomSignal, Input
from restock.ingest.steps.align import CLOCK_FIELD, CLOCK_TOPIC, clock_drifts
from restock.ingest.steps.aligned_inputs import sideways_path, without_cameras
from restock.ingest.steps.cameras import TYPES, frame_reduction, wrong_field
from restock.ingest.steps.clocks import STAMP
from restock.ingest.steps.clouds import CLOUD_PATHS, cloud_reduction
from restock.ingest.steps.custom_columns import custom_reduction
from restock.ingest.steps.input_columns import estimate_reduction
from restock.ingest.task.surroundings import MovedMap, SectorMap
from restock.ingest.task.task import Task
from restock.ingest.task.tracks import SECTORS as FINE_SECTORS
from restock.ingest.task.tracks import Lidar

if TYPE_CHECKING:
    from restock.ingest.decoding.columns import Leaf

NEARLY = 0.8  # similarity above which a topic may be a misspelling; /plan and /scan are below
MAX_LISTED = 20  # most topics in an error: a fleet's nightly ingest may print many such errors
OTHER_FIELDS = (
    "correct the profile; if the messages changed with an update of the robot, ingest the "
    "recordings from before and after it with a profile each: a copy with the other field and "
    "another `name`"
)


def read_topics(
    recording: Recording, profile: Profile, *, reduced: bool = True
) -> dict[str, TopicColumns]:
    """Read the columns that a profile needs of a recording.

    If header stamps run at another pace than log time, `/clock` is read too, as it gives the pace.
    With `reduced`, only what steps need is kept: clearance of scans, values of custom signals, and
    layouts of images. Otherwise the needed fields are kept as recorded; but images are left out,
    and clouds become scans.

    Raises:
        RecordingError: as `wanted_fields`; or a point cloud's frame does not move with the robot.
    """
    if not reduced:
        profile = msgspec.structs.replace(profile, cameras={})  # images do not fit into memory
    topics = recording.topics
    leaves = {topic: recording.fields(topic) for topic in profile.topics if topic in topics}
    wanted, made = wanted_fields(profile, topics, leaves), reductions(profile, topics, leaves)
    for name, scan in profile.inputs.scans.items():
        frame = _first_frame(recording, scan.topic) if scan.type == CLOUD else ""
        if frame.split("/")[-1] in FIXED_FRAMES:
            raise RecordingError(
                f"{scan.topic} ({name}) has its points in the frame {frame}, not in the robot's",
                remedy="name a topic of clouds in the lidar's own frame",
            )
    if not reduced:
        clouds = {
            scan.topic: cloud_reduction(scan, profile.task.range_min_m)
            for scan in profile.inputs.scans.values()
            if scan.type == CLOUD and scan.topic in wanted
        }
        for topic in made.keys() & wanted.keys() - clouds.keys():
            wanted[topic] = [*wanted[topic], *made[topic].fields]
        made = clouds
    columns = recording.read(wanted, made)
    by_stamp = profile.clock.alignment == STAMP and CLOCK_TOPIC not in columns
    half_period_s = profile.task.control_period_s / 2
    clocks = without_cameras(profile, columns)
    if by_stamp and CLOCK_TOPIC in topics and clock_drifts(clocks, half_period_s):
        columns |= recording.read({CLOCK_TOPIC: [CLOCK_FIELD]})
    return columns


def _list(profile: Profile, available: Mapping[str, Any]) -> str:
    """List a recording's topics; if there are many, only those of types that the profile uses."""
    types = {source.type for source in profile.sources.values()}
    usable = [topic for topic in sorted(available) if available[topic].type in types]
    topics = sorted(available) if len(available) <= MAX_LISTED else usable[:MAX_LISTED]
    others = len(available) - len(topics)
    more = [f"{others:,} others, which `restock info` lists"] if others else []
    return ", ".join([*topics, *more]) or "none"


def as_recorded(profile: Profile, available: Mapping[str, Any]) -> Profile:
    """Return the profile for a recording with these topics: without lidar if it has no scans.

    `available` is as in `wanted_fields`. The lidar is left out if its scan is optional and no
    message can be read, so that rows with and without clearance never share a task.
    """
    scan = profile.inputs.scan
    if scan is None or not scan.optional:
        return profile
    topic = available.get(scan.topic)
    readable = topic is not None and topic.expected and not topic.skipped
    return profile if readable else without_lidar(profile)


def wanted_fields(
    profile: Profile, available: Mapping[str, Any], leaves: Mapping[str, Sequence[Leaf]]
) -> dict[str, list[str]]:
    """Return available topic -> field paths to keep for this profile.

    Fields that only `reductions` read are not listed. Skipped topics are listed, so that they are
    read and their messages are counted as lost.

    Args:
        profile: the profile.
        available: topic -> an object with its `type`, `expected` number of messages, and the reason
            if the topic is `skipped`.
        leaves: topic -> all fields of its messages.

    Raises:
        RecordingError: a required topic is missing, cannot be decoded or has another type than in
            the profile, or its messages lack a field.
    """
    if problems := input_problems(profile, available, leaves):
        raise RecordingError(
            f"does not fit the profile {profile.name!r}: {'; '.join(problems)}",
            remedy=f"its topics are {_list(profile, available)}; choose another --profile, or let"
            " `restock profile new RECORDING` propose one (`restock start RECORDING` does so and "
            "continues)"
            if input_problems(profile, available)
            else OTHER_FIELDS,
        )
    wanted: dict[str, list[str]] = {}
    optional = set[str]()
    for name, source in profile.sources.items():
        if source.topic not in available:
            continue
        paths = wanted.setdefault(source.topic, [])
        if name not in SCANS:
            paths += field_paths(source)
        if name in ("pose", "wheels", "goal", "plan"):
            frame = frame_path(source, {leaf.path for leaf in leaves[source.topic]})
            paths += [frame] if frame else []
        optional.add(aside := sideways_path(source) if name == "command" else "")
        paths += [aside] if aside else []
    for topic in profile.transform_topics:
        if topic in available:
            has = {leaf.path for leaf in leaves[topic]}
            wanted.setdefault(topic, []).extend(transform_fields(has) or FIELDS)
    beside = [signal.topic for signal in profile.signals.values()]
    for topic in (*beside, *(camera.topic for camera in profile.cameras.values())):
        if topic in available:
            wanted.setdefault(topic, [])
    for topic, paths in wanted.items():
        has = {leaf.path for leaf in leaves[topic]}
        kept = [path for path in paths if path not in optional or path in has]
        wanted[topic] = list(dict.fromkeys(kept + ([STAMP] if STAMP in has else [])))
    return wanted


def reductions(
    profile: Profile, available: Mapping[str, Any], leaves: Mapping[str, Sequence[Leaf]]
) -> dict[str, Reduction]:
    """Return topic -> reduction that is applied to its messages while they are read.

    Reductions compute clearance, custom signals, layouts of images, and flags of messages without
    an estimate.
    """
    parts: dict[str, list[Reduction]] = {}
    has = {topic: {leaf.path for leaf in some} for topic, some in leaves.items()}
    inputs: dict[str, list[Input]] = {}
    for source in profile.sources.values():
        inputs.setdefault(source.topic, []).append(source)
    for topic, sources in inputs.items():
        if estimates := estimate_reduction(sources, has.get(topic, ())):
            parts.setdefault(topic, []).append(estimates)
    for scan in profile.inputs.scans.values():
        if scan.topic in available:
            parts.setdefault(scan.topic, []).append(scan_reduction(profile.task, scan))
    signals: dict[str, dict[str, CustomSignal]] = {}
    for name, signal in profile.signals.items():
        if signal.topic in available:
            signals.setdefault(signal.topic, {})[name] = signal
    for topic, here in signals.items():
        parts.setdefault(topic, []).append(custom_reduction(here, has.get(topic, ())))
    for topic in dict.fromkeys(camera.topic for camera in profile.cameras.values()):
        if topic in available:
            parts.setdefault(topic, []).append(frame_reduction(available[topic].type))
    return {topic: _combine(some) for topic, some in parts.items()}


def _combine(parts: Sequence[Reduction]) -> Reduction:
    """Combine several reductions of one topic."""
    if len(parts) == 1:
        return parts[0]

    def apply(fields: Fields) -> dict[str, FieldColumn]:
        return {name: column for part in parts for name, column in part.apply(fields).items()}

    return Reduction(tuple(dict.fromkeys(f for part in parts for f in part.fields)), apply)


def field_paths(source: Input) -> list[str]:
    """Return the field paths that an input reads."""
    if source.type == CLOUD:
        return list(CLOUD_PATHS)
    paths: list[str] = []
    for key, field in source.fields.items():
        if key == "pressed":
            paths += [path for read in pressed_paths(field) for path in read.wanted()]
            continue
        field, _ = element_of(field)
        paths += [f"{field}.{axis}" for axis in "xyzw"] if key == "orientation" else [field]
    return paths


def input_problems(
    profile: Profile,
    available: Mapping[str, Any],
    leaves: Mapping[str, Sequence[Leaf]] | None = None,
) -> list[str]:
    """Return all reasons why a recording with these topics and fields does not fit the profile."""
    needed: dict[str, list[str]] = {}
    types: dict[str, str] = {}  # message type of each entry of `needed`
    wrong: dict[str, list[str]] = {}
    fields: list[str] = []
    sources: dict[str, Input | CustomSignal] = {**profile.sources}
    sources |= {f"signals.{name}": signal for name, signal in profile.signals.items()}
    for name, source in sources.items():
        topic = available.get(source.topic)
        required = isinstance(source, Input) and not source.optional
        if required and (topic is None or not topic.expected):
            what = "no message of" if topic is not None else "no topic"
            needed.setdefault(f"{what} {source.topic}", []).append(name)
            types[f"{what} {source.topic}"] = source.type
        elif topic is not None and topic.skipped:
            if required:
                wrong.setdefault(_skipped(source.topic, available), []).append(name)
        elif topic is not None and topic.type != source.type:
            what = f"{source.topic} holds {topic.type}, not {source.type}"
            wrong.setdefault(what, []).append(name)
        elif topic is not None and leaves is not None:
            fields += _field_problems(name, source, leaves[source.topic])
    for name, camera in profile.cameras.items():
        if (topic := available.get(camera.topic)) is None or topic.skipped:
            continue
        if topic.type not in TYPES:
            what = f"{camera.topic} holds {topic.type}, which is not an image"
            wrong.setdefault(what, []).append(f"cameras.{name}")
        elif leaves is not None and (field := wrong_field(topic.type, leaves[camera.topic])):
            has = f"its {topic.type} has no {field!r} as ROS defines it"
            fields.append(f"`cameras.{name}`: {camera.topic}: {has}")
    hints = {what: near(what.split()[-1], available, types[what]) for what in needed}
    lacking = [
        f"{what} ({', '.join(names)})" + (f": {hints[what]}" if hints.get(what) else "")
        for what, names in itertools.chain(needed.items(), wrong.items())
    ]
    return lacking + fields + _transform_problems(profile, available, leaves or {})


def renamed_inputs(profile: Profile, available: Mapping[str, Any]) -> list[str]:
    """Return a note for each optional input whose topic is missing but may have another name.

    An unused topic of the same type may be it: names differ between robots, or after an update.
    Types of std_msgs are not considered, as their messages may contain anything.
    """
    used = profile.topics
    found = []
    for name, source in profile.sources.items():
        if not source.optional or source.topic in available or source.type.startswith("std_msgs/"):
            continue
        alike = {topic: info for topic, info in available.items() if info.type == source.type}
        if hint := near(source.topic, {t: alike[t] for t in alike if t not in used}, source.type):
            found.append(f"{name}: no topic {source.topic} in this recording: {hint}")
    return found


def near(topic: str, available: Mapping[str, Any], kind: str | None = None) -> str:
    """Return a question that suggests another topic for a missing one, or "".

    It suggests a topic that is spelled nearly the same, or the most similar topic of type `kind`.
    """
    if topic in available:
        return ""
    alike = [name for name, info in available.items() if kind is not None and info.type == kind]
    close = get_close_matches(topic, available, n=1, cutoff=NEARLY) or get_close_matches(
        topic, alike, n=1, cutoff=0.0
    )
    return f"did you mean {close[0]}?" if close else ""


def _field_problems(name: str, source: Input | CustomSignal, leaves: Sequence[Leaf]) -> list[str]:
    """Describe the fields that the topic of an input or signal lacks, and suggest others."""
    if isinstance(source, CustomSignal):
        problem = source.problem(leaves)
        return [f"`{name}.path`: {source.topic}: {problem}"] if problem else []
    has = {leaf.path for leaf in leaves}
    key = name if "." in name else f"inputs.{name}"
    return [
        f"`{key}.fields`: {source.topic}: {suggest_fields(path, sorted(has))}"
        for path in field_paths(source)
        if path not in has
    ]


def _transform_problems(
    profile: Profile, available: Mapping[str, Any], leaves: Mapping[str, Sequence[Leaf]]
) -> list[str]:
    """Describe why the transforms that a profile with [frames] needs are unusable."""
    pose, frames = profile.inputs.pose, profile.frames
    if frames is None:
        return []
    there = [topic for topic in profile.transform_topics if topic in available]
    skipped = [topic for topic in there if available[topic].skipped]
    others = [
        f"{topic} holds {available[topic].type}, not transforms (frames)"
        for topic in there
        if topic in leaves
        and topic not in skipped
        and not transform_fields({leaf.path for leaf in leaves[topic]})
    ]
    seen = any(available[topic].expected for topic in there if topic not in skipped)
    if others or seen or (pose is not None and pose.topic in available):
        return others
    return [f"{_skipped(topic, available)} (pose, by [frames])" for topic in skipped] or [
        f"no message of {frames.topic} or {frames.static_topic} (pose, by [frames])"
    ]


def _skipped(topic: str, available: Mapping[str, Any]) -> str:
    """Describe why the messages of a topic cannot be decoded."""
    info = available[topic]
    return f"{topic} is skipped, with {counted(info.expected, 'message')}: {info.skipped}"


def _first_frame(recording: Recording, topic: str) -> str:
    path = frame_id_path(recording.leaves(topic))
    if path is not None:
        for _, fields in recording.batches(topic, [path]):
            for frame in np.asarray(fields[path], object)[:1]:
                return plain(str(frame))
    return ""


# Names of columns computed from a scan. They have spaces, so as not to clash with field names.
SECTORS = "clearance of each sector"  # (N, sectors) float64, m
FINE = "nearest return of each fine sector"  # (N, FINE_SECTORS) float64, m; if the task has tracks
BEAMS = "number of beams"  # (N,) int64
CLOSE = "whether a beam is too close to be measured"  # (N,) bool: -inf (REP 117)
BLIND = "whether no beam has a valid range"  # (N,) bool; inf is valid: nothing was hit
UNAIMED = "whether its angles are unusable"  # (N,) bool

_VALUES = 1 << 18  # ranges reduced at a time, so that intermediate arrays stay in the CPU's cache
_MAPS = 64  # scan geometries that are cached; a lidar usually has one
_TURNS_RAD = 4 * np.pi  # angles beyond two turns are not in radians


def scan_reduction(task: Task, source: Input) -> Reduction:
    """Build the reduction of an input's scans to SECTORS, BEAMS, CLOSE, BLIND, UNAIMED and FINE.

    Its `apply` raises RecordingError if an angle is not one number per message.
    """
    reducer = _ScanReducer(task, source)
    if source.type == CLOUD:
        cloud = cloud_reduction(source, task.range_min_m)
        return Reduction(cloud.fields, lambda fields: reducer(cloud.apply(fields)))
    return Reduction(tuple(dict.fromkeys(reducer.paths)), reducer)


def angle_keys(fields: Mapping[str, str]) -> tuple[str, str]:
    """Return the keys of the fields with the angles of a scan's beams, for `beam_angles`."""
    last = "angle_max_rad" if "angle_max_rad" in fields else "angle_increment_rad"
    return "angle_min_rad", last


def beam_angles(source: Input, first: F64, last: F64, beams: Ints) -> tuple[F64, F64]:
    """Return the angle of the first beam and the increment per beam, (N,) each.

    Both are counter-clockwise, seen from above. `last` is the scans' increment or the angle of the
    last beam, as in `angle_keys`.
    """
    increment = last
    if "angle_max_rad" in source.fields:
        with np.errstate(invalid="ignore", over="ignore"):
            increment = np.asarray((last - first) / np.maximum(beams - 1, 1))
    return (-first, -increment) if source.upside_down else (first, increment)


_Maps = tuple[SectorMap | MovedMap, Lidar | None]  # None: the task has no tracks


class _ScanReducer:
    def __init__(self, task: Task, source: Input) -> None:
        self.task, self.source = task, source
        fields = source.fields
        self.paths = [fields[key] for key in ("ranges_m", *angle_keys(fields))]
        self._maps: dict[tuple[float, float, int], _Maps] = {}

    def __call__(self, fields: Fields) -> dict[str, FieldColumn]:
        ranges = fields[self.paths[0]]
        first, last = (self._angle(fields, path) for path in self.paths[1:])
        if isinstance(ranges, Ragged):
            beams = ranges.lengths
        else:
            beams = np.full(len(ranges), ranges.shape[1] if ranges.ndim > 1 else 1, np.int64)
        first, increment = beam_angles(self.source, first, last, beams)
        clearance = np.full((len(beams), self.task.sectors), float(self.task.range_max_m))
        fine = np.full((len(beams), FINE_SECTORS if self.task.tracks else 0), np.inf)
        close, blind = np.zeros((2, len(beams)), np.bool_)
        with np.errstate(invalid="ignore", over="ignore"):
            angles = np.maximum(np.abs(first), np.abs(first + increment * (beams - 1)))
        unaimed = (beams > 0) & ~(angles <= _TURNS_RAD)  # true for NaN, too
        unaimed |= (beams > 1) & (increment == 0)
        geometry = np.stack([first, increment, np.where(unaimed, 0, beams)], axis=1)
        if len(geometry) and (geometry == geometry[0]).all():
            self._fill(clearance, fine, close, blind, ranges, None, geometry[0])
        else:
            kinds, kind = np.unique(geometry, axis=0, return_inverse=True)
            for index, one in enumerate(kinds):
                rows = np.flatnonzero(kind == index)
                self._fill(clearance, fine, close, blind, ranges, rows, one)
        made: dict[str, FieldColumn] = {
            SECTORS: clearance,
            BEAMS: beams,
            CLOSE: close,
            BLIND: blind,
            UNAIMED: unaimed,
        }
        return made | ({FINE: fine} if self.task.tracks else {})

    def _fill(
        self,
        clearance: NDArray[np.float64],
        fine: NDArray[np.float64],
        close: NDArray[np.bool_],
        blind: NDArray[np.bool_],
        ranges: FieldColumn,
        rows: NDArray[np.intp] | None,
        geometry: NDArray[np.float64],
    ) -> None:
        """Write the columns of the scans `rows` (None: all), which share one geometry."""
        first, increment, beams = float(geometry[0]), float(geometry[1]), int(geometry[2])
        if not beams:
            return
        (sectors, lidar), task = self._map(first, increment, beams), self.task
        count = len(clearance) if rows is None else len(rows)
        some = max(_VALUES // beams, 1)
        for start in range(0, count, some):
            stop = min(start + some, count)
            if rows is None:
                here: Any = slice(start, stop)
                part = cut(ranges, start, stop)
            else:
                here = rows[start:stop]
                part = take(ranges, here)
            values = part.values if isinstance(part, Ragged) else part
            table = np.asarray(values).reshape(stop - start, beams)
            found = sectors.clearance(table, task.range_min_m, task.range_max_m)
            clearance[here] = found
            if lidar is not None:
                fine[here] = lidar.scan(np.asarray(table, np.float64), task.range_min_m)
            close[here] = np.isneginf(table).any(axis=1)
            seen = (found < task.range_max_m).any(axis=1)  # False for NaN: no beam ends there
            free = np.flatnonzero(~seen | close[here])
            if len(free):
                blind[start + free if rows is None else rows[start + free]] = ~(
                    table[free] >= task.range_min_m  # False for NaN
                ).any(axis=1)

    def _map(self, first: float, increment: float, beams: int) -> _Maps:
        key = (first, increment, beams)
        if key not in self._maps:
            if len(self._maps) >= _MAPS:
                self._maps.clear()
            bearings: F64 = first + increment * np.arange(beams, dtype=np.float64)
            count, body, at_m = self.task.sectors, self.task.body, self.source.lidar_at_m
            sectors: SectorMap | MovedMap
            if at_m is None:
                turned, from_m = bearings + body.lidar_yaw_rad, (0.0, 0.0)
                sectors = SectorMap.build(bearings, count, body)
            else:
                turned = bearings + (self.source.lidar_yaw_rad or 0.0)
                sectors = MovedMap.build(turned, count, body, at_m)
                from_m = sectors.from_m
            self._maps[key] = sectors, Lidar(turned, from_m) if self.task.tracks else None
        return self._maps[key]

    def _angle(self, fields: Fields, path: str) -> NDArray[np.float64]:
        column = fields[path]
        if isinstance(column, Ragged) or column.ndim != 1 or column.dtype.kind not in "biuf":
            raise RecordingError(
                f"{path!r} of {self.source.topic} is not one number per message",
                remedy="correct the `fields` of this scan in the profile's inputs",
            )
        return np.asarray(column, np.float64)
