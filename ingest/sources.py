"""A profile's inputs in a recording's columns: the fields each one names, as numbers or texts."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.errors import RecordingError
from restock.ingest.align import STAMP
from restock.ingest.columns import FieldColumn, Ragged, TopicColumns
from restock.ingest.profile import FALLBACKS, Input, Profile

F64 = NDArray[np.float64]


class Sources:
    """The inputs of a profile that a recording has, and their columns."""

    def __init__(self, profile: Profile, topics: Mapping[str, TopicColumns]) -> None:
        self.topics = topics
        self.inputs = {
            name: source
            for name, source in profile.inputs.items()
            if source.topic in topics and not (source.optional and not len(topics[source.topic]))
        }

    def present(self, name: str) -> Input | None:
        """The input, if the profile names it and the recording has its topic."""
        return self.inputs.get(name)

    def column(self, name: str, key: str) -> FieldColumn:
        """A field of an input as it was read."""
        source = self.inputs[name]
        return self.topics[source.topic].fields[source.fields[key]]

    def numbers(self, name: str, key: str) -> F64:
        """A field of an input, one number a message (N,)."""
        if key == "yaw_rad" and "orientation" in self.inputs[name].fields:
            return self._yaw(name)
        column = self.column(name, key)
        if isinstance(column, Ragged) or column.ndim != 1 or column.dtype.kind not in "biuf":
            source = self.inputs[name]
            raise RecordingError(
                f"{source.fields[key]!r} of {source.topic} is not one number a message",
                remedy=f"mend `inputs.{name}.fields.{key}` in the profile",
            )
        return np.asarray(column, np.float64)

    def texts(self, name: str) -> list[str]:
        """The text of an input, one a message."""
        return [str(text) for text in np.asarray(self.column(name, "text"), object)]

    def beams(self, rows: NDArray[np.intp]) -> NDArray[np.int64]:
        """How many ranges each of these scans holds, (N,)."""
        ranges = self.column("scan", "ranges_m")
        if isinstance(ranges, Ragged):
            return ranges.lengths[rows]
        return np.full(len(rows), ranges.shape[1] if ranges.ndim > 1 else 1, np.int64)

    @cached_property
    def plans(self) -> list[F64]:
        """Each plan's points (P, 2); P is 0 where the planner found none."""
        x, y = self.column("plan", "x_m"), self.column("plan", "y_m")
        return [
            np.stack([np.asarray(x[row], np.float64), np.asarray(y[row], np.float64)], axis=-1)
            for row in range(len(x))
        ]

    def _yaw(self, name: str) -> F64:
        """Quaternions (N,) to yaw in (-pi, pi], REP 103: about z, counter-clockwise."""
        source = self.inputs[name]
        fields = self.topics[source.topic].fields
        path = source.fields["orientation"]
        x, y, z, w = (np.asarray(fields[f"{path}.{axis}"], np.float64) for axis in "xyzw")
        with np.errstate(over="ignore", invalid="ignore"):  # what is no number stays none
            return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def wanted_fields(
    profile: Profile, available: Mapping[str, Any], stamped: Mapping[str, bool]
) -> dict[str, list[str]]:
    """topic -> the field paths to read for this profile, of the topics that are `available`.

    `available` maps a topic to something with a `type` and an `expected` count; `stamped` says
    which topics' messages carry a header.

    Raises:
        RecordingError: a required topic is missing, or holds another type than the profile says.
    """
    wanted: dict[str, list[str]] = {}
    problems = input_problems(profile, available)
    if problems:
        have = ", ".join(sorted(available)) or "none"
        raise RecordingError(
            f"does not fit the profile {profile.name!r}: {'; '.join(problems)}",
            remedy=f"its topics are {have}; choose another --profile or see `restock info`",
        )
    for source in (source for _, source in profile.inputs.items() if source.topic in available):
        paths = wanted.setdefault(source.topic, [])
        for key, path in source.fields.items():
            paths += [f"{path}.{axis}" for axis in "xyzw"] if key == "orientation" else [path]
        if stamped[source.topic]:
            paths.append(STAMP)
    return {topic: list(dict.fromkeys(paths)) for topic, paths in wanted.items()}


def input_problems(profile: Profile, available: Mapping[str, Any]) -> list[str]:
    """Why a recording with these topics does not fit the profile, a line a topic."""
    needed: dict[str, list[str]] = {}
    wrong: dict[str, list[str]] = {}
    for name, source in profile.inputs.items():
        found = available.get(source.topic)
        if (found is None or not found.expected) and not source.optional:
            what = "no message of" if found is not None else "no topic"
            needed.setdefault(f"{what} {source.topic}", []).append(name)
        elif found is not None and found.type != source.type:
            said = f"{source.topic} holds {found.type}, not {source.type}"
            wrong.setdefault(said, []).append(name)
    return [
        f"{what} ({', '.join(names)})"
        for what, names in itertools.chain(needed.items(), wrong.items())
    ]


def stand_ins(profile: Profile, topics: Mapping[str, TopicColumns]) -> dict[str, str]:
    """Inputs that this recording does not fill -> what stands in for each."""
    absent = {
        name: FALLBACKS[name]
        for name, source in profile.inputs.items()
        if source.optional and not (source.topic in topics and len(topics[source.topic]))
    }
    return profile.fallbacks | absent
