"""Optional parts of a proposed profile: fields as custom signals, and cameras.

The tables are written as comments, because a person must decide what a store should hold: frames
are most of a recording, and the units of fields are guessed.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from restock.ingest.containers.recording import Recording
from restock.ingest.containers.storage import TopicInfo
from restock.ingest.decoding.columns import Ragged, TopicColumns
from restock.ingest.profile.tables import CustomSignal, name_problem
from restock.ingest.steps.cameras import TYPES
from restock.ingest.steps.custom_columns import column_of, custom_reduction

MAX_A_TOPIC = 8
MAX_WORDS = 8  # different texts of a topic that become numbers
# A field's path -> its unit, by the end of the path. Messages of ROS use SI units (REP 103).
UNITS = (
    (r"angular_velocity\.\w|angular\.[xyz]|velocity\[.*\]", "rad/s"),
    (r"linear_acceleration\.\w|accel\.linear\.\w", "m/s²"),
    (r"linear\.[xyz]", "m/s"),
    (r"position\.[xyz]|translation\.[xyz]|altitude|ranges?(\[.*\])?", "m"),
    (r"position\[.*\]|orientation|angle\w*", "rad"),
    (r"effort\[.*\]", "N·m"),
    (r"voltage", "V"),
    (r"current", "A"),
    (r"charge|capacity", "Ah"),
    (r"temperature", "°C"),
    (r"fluid_pressure", "Pa"),
    (r"latitude|longitude", "deg"),
)
# A unit -> how a name ends that is in it.
ENDINGS = {"rad/s": "radps", "m/s²": "mps2", "m/s": "mps", "N·m": "nm", "°C": "c"}
# In these, what a name or a stamp says is not for a column.
_SKIPPED = re.compile(r"(^|\.)(header|covariance|\w*_covariance|frame_id|stamp)(\.|\[|$)")
_IGNORED_TYPES = re.compile(
    r"rcl_interfaces/|rosgraph_msgs/|tf2?_msgs/|tf/|nav_msgs/msg/(Path|OccupancyGrid)|"
    r"sensor_msgs/msg/(PointCloud2?|Image|CompressedImage|CameraInfo)"
)


@dataclass(frozen=True)
class Candidate:
    """A signal that a profile might have."""

    name: str
    topic: TopicInfo
    path: str
    unit: str  # "" if nothing shows it
    more: str = ""  # further TOML
    saw: str = ""  # what was seen, for a comment

    def signal(self) -> CustomSignal:
        """Return the signal that its table declares."""
        lines = "\n".join(self.toml(None)[1:])
        return msgspec.convert(tomllib.loads(lines), CustomSignal)

    def toml(self, max_age_s: float | None) -> list[str]:
        """Write its table, as lines."""
        unit = self.unit or "1"
        lines = [
            f"[signals.{self.name}]" + (f"  # {self.saw}" if self.saw else ""),
            f"topic = {json.dumps(self.topic.name)}",
            f'type = "{self.topic.type}"',
            f"path = {json.dumps(self.path)}",
            f'unit = "{unit}"' + ("" if self.unit else "  # a guess: check it"),
        ]
        if max_age_s is not None:
            lines.append(f"max_age_s = {max_age_s:g}")
        return [*lines, *([self.more] if self.more else [])]


def candidates(
    recording: Recording, *, without: Collection[str] = (), used: Collection[tuple[str, str]] = ()
) -> list[Candidate]:
    """List what might become custom signals, by topic: what can be read, and changes.

    `without` are topics to leave out, `used` fields (topic, path).
    """
    named: dict[str, Candidate] = {}
    for topic in recording.topics.values():
        if topic.skipped or topic.expected < 2 or _IGNORED_TYPES.search(topic.type):
            continue
        if topic.name in without:
            continue
        possible = [c for c in _of_topic(recording, topic) if (topic.name, c.path) not in used]
        for one in _changing(recording, topic, possible)[:MAX_A_TOPIC]:
            name, count = one.name, 2
            while name in named or name_problem(name):
                name, count = f"{one.name}_{count}", count + 1
            named[name] = replace(one, name=name)
    return list(named.values())


def _changing(recording: Recording, topic: TopicInfo, possible: list[Candidate]) -> list[Candidate]:
    """Keep the candidates that take more than one value in the recording."""
    if not possible:
        return []
    signals = {str(index): one.signal() for index, one in enumerate(possible)}
    columns = recording.read({topic.name: []}, {topic.name: custom_reduction(signals)})[topic.name]
    values = [column_of(name, signal, columns).values.values for name, signal in signals.items()]
    return [
        one
        for one, column in zip(possible, values, strict=True)
        if len(np.unique(np.asarray(column)[np.isfinite(np.asarray(column))])) > 1
    ]


def _of_topic(recording: Recording, topic: TopicInfo) -> Iterator[Candidate]:
    fields = {field.path: field for field in recording.fields(topic.name)}
    if {"status[].name", "status[].values[].key", "status[].values[].value"} <= fields.keys():
        yield from _diagnostics(recording, topic)
        return
    if topic.type.endswith("sensor_msgs/msg/LaserScan"):
        yield _one(topic, "ranges[:]", 'reduce = "min"', "the nearest return of a scan")
        return
    if "name" in fields and fields["name"].kind == "string" and fields["name"].dims:
        yield from _named(recording, topic, [p for p in fields if "." not in p and p != "name"])
        return
    for path, field in fields.items():
        if _SKIPPED.search(path) or "[]" in path or len(field.dims) > 1:
            continue
        if field.kind == "string" and not field.dims:
            yield from _text(recording, topic, path)
        elif re.search(r"(^|\.)orientation\.x$", path):
            quaternion = path.removesuffix(".x")
            yield _one(topic, quaternion, 'reduce = "yaw"', "", "yaw")
        elif "orientation." in path or "rotation." in path or field.kind in ("string", "time"):
            continue
        elif field.dims:
            size = f"{field.dims[0]} a message" if field.dims[0] else "a list"
            yield _one(topic, f"{path}[0]", "", f"the first of {size}")
        else:
            yield _one(topic, path)


def _one(topic: TopicInfo, path: str, more: str = "", saw: str = "", ending: str = "") -> Candidate:
    unit = next((u for pattern, u in UNITS if re.search(rf"(^|[._])({pattern})$", path)), "")
    last = [part for part in re.split(r"[.\[\]=:]+", path) if part and part != "data"][-3:]
    words = [*topic.name.strip("/").split("/"), *last, *([ending] if ending else [])]
    suffix = ENDINGS.get(unit, unit.lower())
    words += [suffix] if suffix and suffix != words[-1] else []
    name = re.sub(r"\W+", "_", "_".join(words).lower()).strip("_")
    name = re.sub(r"_+", "_", name)
    return Candidate(name if name[:1].isalpha() else f"s_{name}", topic, path, unit, more, saw)


def _named(recording: Recording, topic: TopicInfo, paths: list[str]) -> Iterator[Candidate]:
    """Yield lists whose elements a sibling `name[]` names: the joints of a JointState."""
    columns = recording.read({topic.name: ["name", *paths]})[topic.name]
    names = columns.fields["name"]
    assert isinstance(names, Ragged)
    for path in ("velocity", "position", *paths):
        column = columns.fields.get(path)
        if isinstance(column, Ragged) and np.asarray(column.values).dtype.kind == "f":
            full = column.lengths == names.lengths
            rows = np.flatnonzero(full & (names.lengths > 0))
            if path in paths and len(rows):
                paths = [other for other in paths if other != path]
                for name in np.unique(np.asarray(names.take(rows).values)).tolist():
                    if "]" not in name and name == name.strip() and not _number(name):
                        yield _one(topic, f"{path}[{name}]")


def _diagnostics(recording: Recording, topic: TopicInfo) -> Iterator[Candidate]:
    """Yield numbers in diagnostics, by the name of their status and their key."""
    status, key, value = "status[].name", "status[].values[].key", "status[].values[].value"
    columns = recording.read({topic.name: [status, key, value]})[topic.name].fields
    names, keys, values = columns[status], columns[key], columns[value]
    assert isinstance(names, Ragged)
    assert isinstance(keys, Ragged)
    assert isinstance(values, Ragged)
    seen: dict[tuple[str, str], str] = {}
    inner, texts = keys.values, values.values
    assert isinstance(inner, Ragged)
    assert isinstance(texts, Ragged)
    owner = np.repeat(np.asarray(names.values), inner.lengths)
    triples = zip(owner, np.asarray(inner.values), np.asarray(texts.values), strict=True)
    for name, one, text in triples:
        seen.setdefault((name, one), text)
    for (name, one), text in sorted(seen.items()):
        plain = not any(mark in name + one for mark in "]=") and (name, one) == (
            name.strip(),
            one.strip(),
        )
        if plain and _number(text):
            path = f"status[name={name}].values[key={one}].value"
            about = _one(topic, f"{name}.{one}", "", f"such as {text}")
            yield replace(about, path=path)


def _text(recording: Recording, topic: TopicInfo, path: str) -> Iterator[Candidate]:
    """Yield a text that takes few values, as numbers."""
    columns: TopicColumns = recording.read({topic.name: [path]})[topic.name]
    texts = sorted({str(text) for text in np.asarray(columns.fields[path])})
    if 1 < len(texts) <= MAX_WORDS and all(len(text) <= 40 for text in texts):
        if all(_number(text) for text in texts):
            yield _one(topic, path)
            return
        table = ", ".join(f"{json.dumps(text)} = {index}" for index, text in enumerate(texts))
        yield replace(_one(topic, path, f"values = {{ {table} }}"), unit="1")


def _number(text: str) -> bool:
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False


ENOUGH_HZ = 5.0  # a control period has no more; a faster camera is thinned
_MAX_AGE_S = 0.5  # the profile's default


def camera_lines(topics: Iterable[TopicInfo], recorded_s: float) -> list[str]:
    """Write a table in comments for each topic of images, and say what to do with them."""
    cameras = sorted((one for one in topics if one.type in TYPES), key=lambda one: one.name)
    if not cameras:
        return []
    lines = [
        "# Cameras: frames kept beside the rows, as recorded. To keep those of one, remove the "
        "first #",
        "# of its lines; docs/profile.md describes what is kept.",
        "",
    ]
    for topic in cameras:
        name = re.sub(r"[^a-z0-9]+", "_", topic.name.lower()).strip("_")[:56]
        name = name if name[:1].isalpha() else f"camera_{name}"
        rate_hz = topic.expected / recorded_s if recorded_s > 0 else 0.0
        lines += [
            f"# [cameras.{name}]  # {rate_hz:.1f} Hz",
            f"# topic = {json.dumps(topic.name)}",
        ]
        if rate_hz > ENOUGH_HZ:
            lines.append(f"# max_hz = {ENOUGH_HZ:g}  # frames kept per second")
        elif rate_hz and 2 / rate_hz > _MAX_AGE_S:
            lines.append(f"# max_age_s = {2 / rate_hz:.2g}  # two of its periods")
        lines.append("")
    return lines
