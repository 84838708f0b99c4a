"""Between which frames a recording's transforms say where its robot is: a guess by their names."""

from __future__ import annotations

from dataclasses import dataclass

from restock.ingest.containers.recording import Recording
from restock.ingest.profile.tables import Frames
from restock.ingest.propose.evidence.roles import robots_in
from restock.ingest.steps.frames import Edges, transform_fields, upward
from restock.ingest.urdf.description import BASE_FRAMES

FOXGLOVES_TRANSFORMS = ("foxglove.FrameTransform", "foxglove.FrameTransforms")
FIXED_FRAMES = ("map", "odom", "world")  # best first


@dataclass(frozen=True)
class FrameGuess:
    """Two frames that transforms join, and all that there are."""

    fixed: str
    base: str
    chain: str
    localised: bool  # it leads to a map
    topic: str = Frames().topic
    static_topic: str = Frames().static_topic

    @property
    def frames(self) -> Frames:
        """The `[frames]` of a profile."""
        return Frames(self.fixed, self.base, topic=self.topic, static_topic=self.static_topic)

    def lines(self, *, used: bool) -> list[str]:
        """The `[frames]` of a profile, commented out where it is not `used`."""
        mark = "" if used else "# "
        why = f"instead of inputs.pose, from {self.topic}"
        if used:
            why = f"poses from {self.topic} and {self.static_topic}"
        topics = [f'topic = "{self.topic}"', f'static_topic = "{self.static_topic}"']
        lines = [
            f"[frames]  # {why}: {self.chain}",
            f'fixed = "{self.fixed}"',
            f'base = "{self.base}"',
            "max_age_s = 0.5",
            *(topics if self.topic != Frames().topic else []),
        ]
        return [*(mark + line for line in lines), ""]


def transform_topics(recording: Recording) -> tuple[str, str]:
    """The topics of the moving and the static transforms of the robot to propose for: of its own
    namespace, else `/tf` and `/tf_static`, else of the only namespace that has any, else the only
    topic of Foxglove's."""
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


def transform_edges(recording: Recording) -> Edges:
    """The transforms of `transform_topics`; none where it has no such topics."""
    topic, static_topic = transform_topics(recording)
    wanted = {
        name: fields
        for name in (topic, static_topic)
        if name in recording.topics and (fields := transform_fields(recording.leaves(name)))
    }
    frames = Frames(topic=topic, static_topic=static_topic)
    return Edges.of(frames, recording.read(wanted) if wanted else {})


def transform_frames(recording: Recording, edges: Edges) -> FrameGuess | None:
    """The map's and the robot's frame, by its transforms (`transform_edges`); None where they join
    no such two."""
    frames = {frame for child, up in edges.parents.items() for frame in (child, *up)}
    others = {robot.rpartition("/")[2] for robot in robots_in(recording)[1:]}
    frames = {frame for frame in frames if frame.split("/")[0] not in others}
    for fixed in named_frames(FIXED_FRAMES, frames):
        for base in named_frames(BASE_FRAMES, frames):
            if fixed in upward(base, edges.parents):
                chain = " -> ".join(_chain(base, fixed, edges))
                localised = fixed.split("/")[-1] == "map"
                return FrameGuess(fixed, base, chain, localised, *transform_topics(recording))
    return None


def named_frames(words: tuple[str, ...], frames: set[str]) -> list[str]:
    """The frames of these names, a robot's prefix before them or not; best first."""
    return [name for word in words for name in sorted(frames) if name.split("/")[-1] == word]


def _chain(base: str, fixed: str, edges: Edges) -> list[str]:
    """The frames from the fixed one down to the base."""
    way = [base]
    while way[-1] != fixed:
        ups = [up for up in edges.parents[way[-1]] if fixed in upward(up, edges.parents)]
        if not ups or ups[0] in way:
            break
        way.append(ups[0])
    return way[::-1]
