"""The inputs of a profile that a recording has, by name: their fields as columns.

Positions are in the fixed frame, from the profile's `origin_m`: a pose by latitude and longitude is
projected into it, and goals and plans that were given in another frame are put into it by their
`Placement`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property

import numpy as np

from restock.arrays import F64, Bools, Ints
from restock.errors import RecordingError
from restock.ingest.containers.topic_reading import Fields, Reduction
from restock.ingest.decoding.columns import FieldColumn, Ragged, TopicColumns
from restock.ingest.profile.inputs import Input
from restock.ingest.profile.profile import Profile
from restock.ingest.profile.signal_paths import (
    Convention,
    PathProblem,
    conventions_of,
    element_of,
    pressed_in,
    said_in,
)
from restock.ingest.steps.align import NS
from restock.ingest.steps.fixes import FixedPoses, fixes_of
from restock.ingest.steps.frames import Placement, frame_path, plain
from restock.ingest.task.signals import yaw_of


class InputColumns:
    """The inputs of a profile that a recording has, and their columns."""

    def __init__(self, profile: Profile, topics: Mapping[str, TopicColumns]) -> None:
        self.topics = topics
        self.origin_m = np.array(profile.origin_m or (0.0, 0.0))  # of all positions
        self.placed: dict[str, Placement] = {}  # of each message of an input in another frame
        self.by_name: dict[str, Input] = {  # those whose topic the recording has
            name: source
            for name, source in profile.sources.items()
            if source.topic in topics and not (source.optional and not len(topics[source.topic]))
        }

    def column(self, name: str, key: str) -> FieldColumn:
        """Return a field of an input as it was read."""
        source = self.by_name[name]
        fields = self.topics[source.topic].fields
        path, place = element_of(source.fields[key])
        return fields[path] if place is None else said_in(fields, source.fields[key])

    def numbers(self, name: str, key: str) -> F64:
        """Return a field of an input, one number a message (N,)."""
        if name == "pose" and key in ("x_m", "y_m"):
            return self._numbers(name, key) - float(self.origin_m["xy".index(key[0])])
        return self._numbers(name, key)

    def _numbers(self, name: str, key: str) -> F64:
        if self.by_name[name].by_fix and key in ("x_m", "y_m", "yaw_rad"):
            return np.asarray(getattr(self.fixed, key), np.float64)
        if key == "yaw_rad" and "orientation" in self.by_name[name].fields:
            return self._yaw(name)
        if key == "yaw_rate_radps" and self.by_name[name].wheelbase_m is not None:
            turn = np.tan(self.numbers(name, "steering_rad")) / self.by_name[name].wheelbase_m
            return self.numbers(name, "speed_mps") * turn
        if key == "pressed":
            return self._pressed(name)
        column = self.column(name, key)
        if isinstance(column, Ragged) or column.ndim != 1 or column.dtype.kind not in "biuf":
            source = self.by_name[name]
            raise RecordingError(
                f"{source.fields[key]!r} of {source.topic} is not one number per message",
                remedy=f"correct `inputs.{name}.fields.{key}` in the profile",
            )
        none = self.no_estimate(name, key)
        return np.where(none, np.nan, column) if none.any() else np.asarray(column, np.float64)

    def _pressed(self, name: str) -> F64:
        source = self.by_name[name]
        columns = self.topics[source.topic]
        try:
            found = pressed_in(columns.fields, source.fields["pressed"], len(columns))
        except PathProblem as problem:
            raise RecordingError(
                f"{source.fields['pressed']!r} of {source.topic} {problem}",
                remedy=f"correct `inputs.{name}.fields.pressed` in the profile",
            ) from None
        return np.asarray(found, np.float64)

    def no_estimate(self, name: str, key: str) -> Bools:
        """Return which messages (N,) report that they have no estimate of this field."""
        source = self.by_name[name]
        columns = self.topics[source.topic]
        none = np.zeros(len(columns), np.bool_)
        for rule in _said_of(source, source.fields.get(key, "")):
            none |= _flags(columns, rule)
        return none

    def unestimated(self) -> Iterator[tuple[str, str, int, str]]:
        """List inputs that have messages without an estimate: name, field, count, and how."""
        for name, source in self.by_name.items():
            columns = self.topics[source.topic]
            rules = (rule for path in source.fields.values() for rule in _said_of(source, path))
            for rule in dict.fromkeys(rules):
                if count := int(_flags(columns, rule).sum()):
                    yield name, rule.values[0], count, rule.words

    def texts(self, name: str) -> list[str]:
        """Return the text of an input, one a message."""
        return [str(text) for text in np.asarray(self.column(name, "text"), object)]

    @cached_property
    def fixed(self) -> FixedPoses:
        """Return the pose of each message whose position is by latitude and longitude."""
        source = self.by_name["pose"]
        columns, yaw = self.topics[source.topic], None
        if "heading" in self.by_name:
            yaw = self._heading_at(columns.log_time_ns)
        fixes = fixes_of(columns, source.fields, yaw)
        if (none := self.no_estimate("pose", "latitude_deg")).any():
            fixes = replace(fixes, status=np.where(none, -1.0, 0.0))
        return fixes.poses(source.origin_deg, source.max_std_m, source.track_m)

    def _heading_at(self, time_ns: Ints) -> F64:
        """Return the heading (N,) received last at these log times; NaN if none is known."""
        source = self.by_name["heading"]
        said_ns, yaw = self.topics[source.topic].log_time_ns, self.numbers("heading", "yaw_rad")
        order = np.argsort(said_ns, kind="stable")
        said_ns, yaw = said_ns[order], yaw[order]
        last = np.searchsorted(said_ns, time_ns, "right") - 1
        known = last >= 0
        if source.max_age_s is not None and len(said_ns):
            known &= time_ns - said_ns[last] <= source.max_age_s * NS
        return np.where(known, yaw[last], np.nan) if len(yaw) else np.full(len(time_ns), np.nan)

    @cached_property
    def plans(self) -> list[F64]:
        """Return each plan's points (P, 2); P is 0 if the planner found none."""
        x, y = self.column("plan", "x_m"), self.column("plan", "y_m")
        points = [
            np.stack([np.asarray(x[row], np.float64), np.asarray(y[row], np.float64)], axis=-1)
            for row in range(len(x))
        ]
        if "plan" not in self.placed:
            return [plan - self.origin_m for plan in points]
        at = self.placed["plan"]
        return [
            plan @ at.rotation[row, :2, :2].T + at.translation_m[row, :2] - self.origin_m
            for row, plan in enumerate(points)
        ]

    @cached_property
    def goals(self) -> F64:
        """Return each goal (G, 2)."""
        goals = np.stack([self.numbers("goal", axis) for axis in ("x_m", "y_m")], axis=1)
        if "goal" not in self.placed:
            return np.asarray(goals - self.origin_m)
        at = self.placed["goal"]
        turned = np.einsum("nij,nj->ni", at.rotation[:, :2, :2], goals)
        return np.asarray(turned + at.translation_m[:, :2] - self.origin_m)

    def frames_of(self, name: str) -> list[str]:
        """Return the frame of each message of an input; empty if messages do not say."""
        source = self.by_name.get(name)
        fields = {} if source is None else self.topics[source.topic].fields
        path = None if source is None else frame_path(source, fields)
        if path is None:
            return []
        frames = [str(one) for one in np.asarray(fields[path], object)]
        names = {frame: plain(frame) for frame in set(frames)}
        return [names[frame] for frame in frames]

    def _yaw(self, name: str) -> F64:
        """Quaternions (N,) to yaw in (-pi, pi], REP 103: about z, counter-clockwise."""
        source = self.by_name[name]
        fields = self.topics[source.topic].fields
        path = source.fields["orientation"]
        x, y, z, w = (np.asarray(fields[f"{path}.{axis}"], np.float64) for axis in "xyzw")
        none = self.no_estimate(name, "orientation")
        return np.where(none, np.nan, yaw_of(x, y, z, w)) if none.any() else yaw_of(x, y, z, w)


def estimate_reduction(sources: Iterable[Input], fields: Collection[str]) -> Reduction | None:
    """Build the reduction that finds messages without an estimate of what these inputs take.

    None if messages with these fields never say so.
    """
    rules = list(
        dict.fromkeys(
            rule
            for source in sources
            for path in source.fields.values()
            for rule in _said_of(source, path)
            if set(rule.fields) <= set(fields)
        )
    )
    if not rules:
        return None

    def apply(columns: Fields) -> dict[str, FieldColumn]:
        return {_key(rule): rule.flags(columns) for rule in rules}

    return Reduction(tuple(dict.fromkeys(path for rule in rules for path in rule.fields)), apply)


def _said_of(source: Input, path: str) -> list[Convention]:
    return [rule for rule in conventions_of(source.type, path) if rule.of_messages]


def _key(rule: Convention) -> str:
    """Name a convention among its topic's columns; names of fields hold no space."""
    return f"no estimate of {rule.values[0]}"


def _flags(columns: TopicColumns, rule: Convention) -> Bools:
    """(N,) which messages say so; none of them where they do not have the fields for it."""
    if _key(rule) in columns.fields:
        return np.asarray(columns.fields[_key(rule)], np.bool_)
    if set(rule.fields) <= columns.fields.keys():  # whole, as no recording's reader gives them
        return rule.flags(columns.fields)
    return np.zeros(len(columns), np.bool_)
