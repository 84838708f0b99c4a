"""A profile's inputs in a recording's columns: the fields each one names, as numbers or texts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from restock.errors import RecordingError
from restock.ingest.decoding.columns import FieldColumn, Ragged, TopicColumns
from restock.ingest.profile.inputs import FALLBACKS, POSE_FALLBACK, Input
from restock.ingest.profile.profile import Profile
from restock.ingest.steps.align import Segment
from restock.ingest.steps.frames import Placement, Tree
from restock.ingest.steps.transforms import FRAME_ID, Edges, plain
from restock.ingest.task.signals import yaw_of

F64 = NDArray[np.float64]


class Sources:
    """The inputs of a profile that a recording has, and their columns."""

    def __init__(self, profile: Profile, topics: Mapping[str, TopicColumns]) -> None:
        self.topics = topics
        self.placed: dict[str, Placement] = {}  # of each message of an input in another frame
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

    @cached_property
    def plans(self) -> list[F64]:
        """Each plan's points (P, 2); P is 0 where the planner found none."""
        x, y = self.column("plan", "x_m"), self.column("plan", "y_m")
        points = [
            np.stack([np.asarray(x[row], np.float64), np.asarray(y[row], np.float64)], axis=-1)
            for row in range(len(x))
        ]
        if "plan" not in self.placed:
            return points
        at = self.placed["plan"]
        return [
            plan @ at.rotation[row, :2, :2].T + at.translation_m[row, :2]
            for row, plan in enumerate(points)
        ]

    @cached_property
    def goals(self) -> F64:
        """Each goal (G, 2)."""
        goals = np.stack([self.numbers("goal", axis) for axis in ("x_m", "y_m")], axis=1)
        if "goal" not in self.placed:
            return goals
        at = self.placed["goal"]
        return np.asarray(
            np.einsum("nij,nj->ni", at.rotation[:, :2, :2], goals) + at.translation_m[:, :2]
        )

    def frames_of(self, name: str) -> list[str]:
        """The frame that each message of an input is in; empty where messages do not say."""
        source = self.inputs.get(name)
        column = None if source is None else self.topics[source.topic].fields.get(FRAME_ID)
        if column is None:
            return []
        return [plain(str(frame)) for frame in np.asarray(column, object)]

    def _yaw(self, name: str) -> F64:
        """Quaternions (N,) to yaw in (-pi, pi], REP 103: about z, counter-clockwise."""
        source = self.inputs[name]
        fields = self.topics[source.topic].fields
        path = source.fields["orientation"]
        x, y, z, w = (np.asarray(fields[f"{path}.{axis}"], np.float64) for axis in "xyzw")
        return yaw_of(x, y, z, w)


def stand_ins(profile: Profile, topics: Mapping[str, TopicColumns]) -> dict[str, str]:
    """Inputs and signals that this recording does not fill -> what stands in for each."""
    absent = {
        name: FALLBACKS.get(name, POSE_FALLBACK)
        for name, source in profile.inputs.items()
        if source.optional and not (source.topic in topics and len(topics[source.topic]))
    }
    silent = {
        f"signals.{name}": f"null: no message of {signal.topic}"
        for name, signal in profile.signals.items()
        if not (signal.topic in topics and len(topics[signal.topic]))
    }
    return profile.fallbacks | absent | silent


def transforms_of(profile: Profile, sources: Sources) -> Edges:
    """The transforms that the pose, goals and plans need; none where the profile has no frames.

    Raises:
        RecordingError: the pose is to come from them, and none of them joins its two frames.
    """
    frames = profile.frames
    if frames is None:
        return Edges({}, frozenset(), {})
    edges = Edges.of(frames, sources.topics)
    if sources.present("pose") is None and (why := edges.missing(frames.base, frames.fixed)):
        raise RecordingError(
            why, remedy="mend `frames` in the profile; see `restock profile check`"
        )
    said = {frame for name in ("goal", "plan") for frame in sources.frames_of(name)}
    return edges.only({frames.base, frames.fixed, *said})


def place_messages(sources: Sources, tree: Tree, segments: Sequence[Segment]) -> None:
    """Find where in the fixed frame goals and plans are that were given in another one."""
    fixed = plain(tree.frames.fixed)
    for name in ("goal", "plan"):
        said = np.array([*sources.frames_of(name), None], object)[:-1]
        others = sorted(set(said.tolist()) - {fixed, ""})
        if not others:
            continue
        at = sources.placed[name] = Placement.nowhere(len(said))
        topic = sources.inputs[name].topic
        for frame in others:
            samples = [segment.topics[topic] for segment in segments]
            mine = [said[one.row] == frame for one in samples]
            times = [one.stamp_ns[keep] for one, keep in zip(samples, mine, strict=True)]
            rows = np.concatenate([one.row[keep] for one, keep in zip(samples, mine, strict=True)])
            # A latched message stands again at the start of later segments: the first counts.
            at.fill(rows[::-1], tree.place(frame, times), slice(None, None, -1))


def frame_notes(profile: Profile, sources: Sources, edges: Edges) -> list[str]:
    """What is odd about the frames of a recording."""
    notes = []
    if edges.parent_changes:
        notes.append(f"transforms: a frame was given another parent {edges.parent_changes} times")
    if profile.frames is None:
        said = {name: set(sources.frames_of(name)) - {""} for name in ("goal", "plan")}
        frames = sorted(said["goal"] | said["plan"])
        if len(frames) > 1:
            notes.append(
                f"goals and plans are in the frames {', '.join(frames)}, and are taken as if in"
                " one: the profile has no [frames]"
            )
    return notes
