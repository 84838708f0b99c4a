"""Optional parts of a proposed profile: fields that may become custom signals.

Their tables are written as comments, because a person must decide what a store should hold, and
the units of fields are guessed.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from restock.ingest.containers.recording import Recording
from restock.ingest.containers.storage import TopicInfo
from restock.ingest.decoding.columns import Ragged
from restock.ingest.profile.tables import CustomSignal, name_problem
from restock.ingest.propose.roles import usable_topics
from restock.ingest.steps.custom_columns import column_of, custom_reduction

MAX_A_TOPIC = 8
# Rules for the unit of a field: (pattern for the end of its path, unit, suffix of the signal's
# name). ROS messages use SI units (REP 103).
UNITS = (
    (r"angular_velocity\.\w|angular\.[xyz]|velocity\[.*\]", "rad/s", "radps"),
    (r"linear_acceleration\.\w|accel\.linear\.\w", "m/s²", "mps2"),
    (r"linear\.[xyz]", "m/s", "mps"),
    (r"position\.[xyz]|translation\.[xyz]|altitude|ranges?(\[.*\])?", "m", "m"),
    (r"position\[.*\]|angle\w*", "rad", "rad"),
    (r"effort\[.*\]", "N·m", "nm"),
    (r"voltage", "V", "v"),
    (r"current", "A", "a"),
    (r"charge|capacity", "Ah", "ah"),
    (r"temperature", "°C", "c"),
    (r"fluid_pressure", "Pa", "pa"),
    (r"latitude|longitude", "deg", "deg"),
)
_SKIPPED = re.compile(
    r"(^|\.)(header|covariance|\w*_covariance|stamp|orientation|rotation)(\.|\[|$)|\[\]"
)
_IGNORED_TYPES = re.compile(
    r"rcl_interfaces/|rosgraph_msgs/|tf2?_msgs/|tf/|nav_msgs/msg/(Path|OccupancyGrid)|"
    r"sensor_msgs/msg/(PointCloud2?|Image|CompressedImage|CameraInfo|LaserScan)"
)


@dataclass(frozen=True)
class Candidate:
    """A numeric field that may become a custom signal."""

    name: str
    topic: TopicInfo
    path: str
    unit: str  # "" if unknown

    def signal(self) -> CustomSignal:
        """Return the custom signal that the table of `toml` declares."""
        return CustomSignal(self.topic.name, self.topic.type, self.path, self.unit or "1")

    def toml(self, max_age_s: float | None) -> list[str]:
        """Return the TOML lines of the [signals.NAME] table."""
        lines = [
            f"[signals.{self.name}]",
            f"topic = {json.dumps(self.topic.name)}",
            f'type = "{self.topic.type}"',
            f"path = {json.dumps(self.path)}",
            f'unit = "{self.unit}"' if self.unit else 'unit = "1"  # a guess: check it',
        ]
        return lines if max_age_s is None else [*lines, f"max_age_s = {max_age_s:g}"]


def candidates(
    recording: Recording, *, without: Collection[str] = (), used: Collection[tuple[str, str]] = ()
) -> list[Candidate]:
    """List the numeric fields that change, topic by topic: they may become custom signals.

    Topics in `without` and fields (topic, path) in `used` are left out.
    """
    named: dict[str, Candidate] = {}
    for topic in usable_topics(recording).values():
        if topic.expected < 2 or topic.name in without or _IGNORED_TYPES.search(topic.type):
            continue
        possible = [
            _candidate(topic, path, words)
            for path, words in _paths(recording, topic)
            if (topic.name, path) not in used
        ]
        for one in _keep_changing(recording, topic, possible)[:MAX_A_TOPIC]:
            name, count = one.name, 2
            while name in named or name_problem(name):
                name, count = f"{one.name}_{count}", count + 1
            named[name] = replace(one, name=name)
    return list(named.values())


def _keep_changing(
    recording: Recording, topic: TopicInfo, possible: list[Candidate]
) -> list[Candidate]:
    """Keep the candidates that take more than one value in the recording."""
    if not possible:
        return []
    signals = {str(index): one.signal() for index, one in enumerate(possible)}
    columns = recording.read({topic.name: []}, {topic.name: custom_reduction(signals)})[topic.name]
    values = [
        np.asarray(column_of(name, signal, columns).values.values)
        for name, signal in signals.items()
    ]
    return [
        one
        for one, column in zip(possible, values, strict=True)
        if len(np.unique(column[np.isfinite(column)])) > 1
    ]


def _paths(recording: Recording, topic: TopicInfo) -> Iterator[tuple[str, str]]:
    """Yield (path, words) of each number in a topic; the signal's name is made from the words.

    Of the numbers in lists, only those with a name or key beside them are included.
    """
    fields = {field.path: field for field in recording.fields(topic.name)}
    if "name" in fields and fields["name"].kind == "string" and fields["name"].dims:
        columns = recording.read({topic.name: ["name", "velocity", "position"]})[topic.name]
        names = columns.fields["name"]
        assert isinstance(names, Ragged)
        for path in ("velocity", "position"):
            column = columns.fields.get(path)
            if isinstance(column, Ragged):
                rows = np.flatnonzero((column.lengths == names.lengths) & (names.lengths > 0))
                for name in np.unique(np.asarray(names.take(rows).values)).tolist():
                    if _is_selectable(name) and not _is_number(name):
                        yield (f"{path}[{name}]",) * 2
        return
    status = "status[].name", "status[].values[].key", "status[].values[].value"
    if fields.keys() >= {*status}:  # diagnostic_msgs/DiagnosticArray
        read: Any = recording.read({topic.name: status})[topic.name].fields
        names, keys, texts = (read[path].values for path in status)
        triples = zip(
            np.repeat(np.asarray(names), keys.lengths), keys.values, texts.values, strict=True
        )
        for name, key in sorted({(n, k) for n, k, text in triples if _is_number(text)}):
            if _is_selectable(name) and _is_selectable(key):
                yield f"status[name={name}].values[key={key}].value", f"{name}.{key}"
        return
    for path, field in fields.items():
        if not (field.dims or field.kind in ("string", "time") or _SKIPPED.search(path)):
            yield path, path


def _candidate(topic: TopicInfo, path: str, words: str) -> Candidate:
    """Return the candidate of a field, named after the topic, `words` and the unit."""
    units = (found for pattern, *found in UNITS if re.search(rf"(^|[._])({pattern})$", words))
    unit, ending = next(units, ("", ""))
    last = [part for part in re.split(r"[.\[\]]+", words) if part and part != "data"][-3:]
    last += [ending] if ending and ending != last[-1] else []
    name = re.sub(r"[\W_]+", "_", "_".join([topic.name, *last]).lower()).strip("_")
    return Candidate(name if name[:1].isalpha() else f"s_{name}", topic, path, unit)


def _is_selectable(name: str) -> bool:
    """Return whether a path can select an element by this name."""
    return name == name.strip() and not any(mark in name for mark in "]=")


def _is_number(text: str) -> bool:
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False
