"""Between which frames a recording's transforms say where its robot is: a guess by their names."""

from __future__ import annotations

from dataclasses import dataclass

from restock.ingest.containers.recording import Recording
from restock.ingest.profile.tables import Frames
from restock.ingest.propose.evidence.roles import robots_in
from restock.ingest.steps.frames import FIELDS, Edges, upward
from restock.ingest.urdf.description import BASE_FRAMES

FIXED_FRAMES = ("map", "odom", "world")  # best first


@dataclass(frozen=True)
class FrameGuess:
    """Two frames that transforms join, and all that there are."""

    fixed: str
    base: str
    chain: str
    localised: bool  # it leads to a map

    def lines(self, *, used: bool) -> list[str]:
        """The `[frames]` of a profile, commented out where it is not `used`."""
        mark = "" if used else "# "
        why = "poses from /tf and /tf_static" if used else "instead of inputs.pose, from /tf"
        return [
            f"{mark}[frames]  # {why}: {self.chain}",
            f'{mark}fixed = "{self.fixed}"',
            f'{mark}base = "{self.base}"',
            f"{mark}max_age_s = 0.5",
            "",
        ]


def transform_edges(recording: Recording) -> Edges:
    """The transforms of /tf and /tf_static; none where it has no such topics."""
    usual = Frames()
    wanted = {
        name: list(FIELDS)
        for name in (usual.topic, usual.static_topic)
        if name in recording.topics and set(FIELDS) <= set(recording.leaves(name))
    }
    return Edges.of(usual, recording.read(wanted) if wanted else {})


def transform_frames(recording: Recording) -> FrameGuess | None:
    """The map's and the robot's frame, or None where no transforms join any such two."""
    edges = transform_edges(recording)
    frames = {frame for child, up in edges.parents.items() for frame in (child, *up)}
    others = {robot.rpartition("/")[2] for robot in robots_in(recording)[1:]}
    frames = {frame for frame in frames if frame.split("/")[0] not in others}
    for fixed in named_frames(FIXED_FRAMES, frames):
        for base in named_frames(BASE_FRAMES, frames):
            if fixed in upward(base, edges.parents):
                chain = " -> ".join(_chain(base, fixed, edges))
                return FrameGuess(fixed, base, chain, fixed.split("/")[-1] == "map")
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
