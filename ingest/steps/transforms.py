"""The transforms of a recording: `/tf` and `/tf_static` taken apart, frame by frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.ingest.decoding.columns import Ragged, TopicColumns
from restock.ingest.profile.profile import Frames
from restock.ingest.steps.clocks import STAMP

Ints = NDArray[np.int64]

AXES = ("translation.x", "translation.y", "translation.z")
TURN = ("rotation.x", "rotation.y", "rotation.z", "rotation.w")
FIELDS = (
    "transforms[].header.stamp",
    "transforms[].header.frame_id",
    "transforms[].child_frame_id",
    *(f"transforms[].transform.{part}" for part in (*AXES, *TURN)),
)
PARENT = "parent"
FRAME_ID = "header.frame_id"


@dataclass(frozen=True)
class Edges:
    """The transforms of a recording, a topic a frame and source, for `align` to put in order."""

    topics: dict[str, TopicColumns]  # "/tf odom" -> the transforms whose child is odom
    static: frozenset[str]  # of those topics, the ones that never age
    parents: dict[str, list[str]]  # frame -> every parent it ever has
    parent_changes: int = 0  # times that a frame is given another parent

    @classmethod
    def of(cls, frames: Frames, topics: Mapping[str, TopicColumns]) -> Edges:
        """The transforms in these topics' columns (those of `FIELDS`)."""
        found: dict[str, TopicColumns] = {}
        static, parents, changes = set(), dict[str, list[str]](), 0
        for topic in (frames.static_topic, frames.topic):
            if topic not in topics:
                continue
            for child, columns in _by_child(topics[topic]).items():
                name = f"{topic} {child}"
                found[name] = columns
                if topic == frames.static_topic:
                    static.add(name)
                says = columns.fields[PARENT]
                assert isinstance(says, np.ndarray)
                changes += int((says[1:] != says[:-1]).sum())
                known = parents.setdefault(child, [])
                known += [parent for parent in np.unique(says).tolist() if parent not in known]
        return cls(found, frozenset(static), parents, changes)

    def only(self, frames: set[str]) -> Edges:
        """Only the transforms that may lead up from these frames."""
        reached, open_ = set[str](), {plain(frame) for frame in frames}
        while open_:
            frame = open_.pop()
            reached.add(frame)
            open_ |= set(self.parents.get(frame, [])) - reached
        kept = {name: c for name, c in self.topics.items() if name.split(" ", 1)[1] in reached}
        parents = {frame: up for frame, up in self.parents.items() if frame in reached}
        return Edges(kept, self.static & kept.keys(), parents, self.parent_changes)

    def missing(self, base: str, fixed: str) -> str | None:
        """Why no transform of the recording can lead from one frame to the other, or None."""
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


def plain(frame: str) -> str:
    """A frame's name as ROS 2 writes it: without the slash that ROS 1 put before it."""
    return frame.strip("/")


def _by_child(topic: TopicColumns) -> dict[str, TopicColumns]:
    """The transforms of a topic, by the frame that they place."""
    children = topic.fields["transforms[].child_frame_id"]
    assert isinstance(children, Ragged)
    message = np.repeat(np.arange(len(children)), children.lengths)
    names = np.array([plain(name) for name in np.asarray(children.values).tolist()], object)
    found = {}
    for name in sorted(set(names.tolist())):
        rows = np.flatnonzero(names == name)

        def column(path: str, rows: Ints = rows) -> NDArray[Any]:
            values = topic.fields[f"transforms[].{path}"]
            assert isinstance(values, Ragged)
            return np.asarray(values.values)[rows]

        parents = [plain(parent) for parent in column("header.frame_id").tolist()]
        fields: dict[str, Any] = {
            STAMP: column("header.stamp"),
            PARENT: np.array([*parents, None], object)[:-1],
            **{part: column(f"transform.{part}") for part in (*AXES, *TURN)},
        }
        found[name] = TopicColumns(
            topic.log_time_ns[message[rows]], topic.publish_time_ns[message[rows]], fields
        )
    return found


def upward(frame: str, parents: Mapping[str, Sequence[str]]) -> set[str]:
    """A frame and all that are ever above it."""
    reached, open_ = set[str](), {frame}
    while open_:
        here = open_.pop()
        reached.add(here)
        open_ |= set(parents.get(here, ())) - reached
    return reached
