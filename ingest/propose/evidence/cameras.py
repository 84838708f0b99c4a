"""Camera topics of a recording as `[cameras.NAME]` of a proposed profile, with what they cost.

The tables stand in comments, as those of custom signals do: frames are most of a recording, and
whether a store should hold them is for a person to say.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass

from restock.ingest.camera.frames import image_bytes, image_fields, layouts
from restock.ingest.camera.images import TYPES, ImageProblem
from restock.ingest.containers.recording import Recording
from restock.ingest.containers.topic_reading import TopicInfo

ENOUGH_HZ = 5.0  # a control period has no more; a faster camera is thinned
_MAX_AGE_S = 0.5  # the profile's default
_SAYS_NOTHING = re.compile(r"image(_(raw|rect|color|mono))*|compressed(depth)?|color|rgb|raw")


@dataclass(frozen=True)
class CameraTopic:
    """A topic of images, and what its first whole frame is."""

    name: str  # of its table
    topic: TopicInfo
    rate_hz: float | None
    frame: str  # "jpeg, 640 x 480", or why none of its first messages is a frame
    size_bytes: int  # of that frame; 0 where there is none
    usable: bool

    def lines(self) -> list[str]:
        """Its table in comments, or why there is none."""
        if not self.usable:
            return [f"# {self.topic.name}: no frame that can be kept: {self.frame}"]
        rate = "" if self.rate_hz is None else f"{self.rate_hz:.1f} Hz, "
        lines = [f"[cameras.{self.name}]  # {rate}{self.frame}"]
        if self.rate_hz is not None:
            hourly = self.size_bytes * min(self.rate_hz, ENOUGH_HZ) * 3600 / 1e9
            lines[0] += f", {self.size_bytes / 1000:,.0f} kB: {hourly:.2g} GB an hour as below"
        lines.append(f"topic = {json.dumps(self.topic.name)}")
        if self.rate_hz is not None and self.rate_hz > ENOUGH_HZ:
            lines.append(f"max_hz = {ENOUGH_HZ:g}  # frames kept per second")
        elif self.rate_hz and 2 / self.rate_hz > _MAX_AGE_S:
            lines.append(f"max_age_s = {2 / self.rate_hz:.2g}  # two of its periods")
        return ["# " + line for line in lines]


def camera_topics(recording: Recording, seconds: float) -> list[CameraTopic]:
    """The topics of images that ingest can keep, by name; only the first frames are read."""
    found: list[CameraTopic] = []
    for topic in sorted(recording.topics.values(), key=lambda topic: topic.name):
        if topic.type not in TYPES or topic.skipped or not topic.expected:
            continue
        rate = topic.expected / seconds if seconds > 0 and topic.expected > 1 else None
        what, size, usable = _first_frame(recording, topic)
        name = _name(topic.name, {one.name for one in found})
        found.append(CameraTopic(name, topic, rate, what, size, usable))
    return found


def camera_lines(cameras: list[CameraTopic]) -> list[str]:
    """Their tables in comments, and what to do with them."""
    if not cameras:
        return []
    lines = [
        "# Cameras: frames kept beside the rows, as recorded. To keep those of one, remove the "
        "first #",
        "# of its lines; docs/profile.md describes what is kept.",
        "",
    ]
    for camera in cameras:
        lines += [*camera.lines(), ""]
    return lines


def _first_frame(recording: Recording, topic: TopicInfo) -> tuple[str, int, bool]:
    """What the first whole frame of the first messages is, its bytes, and whether there is one."""
    problem = "none of its messages could be read"
    for _, fields in recording.batches(topic.name, image_fields(topic.type)):
        payloads = image_bytes(fields)
        layout = layouts(topic.type, fields)
        for row, data in enumerate(payloads):
            try:
                one = layout(row, data)
            except ImageProblem as reason:
                problem = str(reason)
                continue
            return f"{one.encoding}, {one.width} x {one.height}", len(data), True
        if payloads:
            break
    return problem, 0, False


def _name(topic: str, taken: set[str]) -> str:
    """What of a topic's name says which camera it is, as a name that a profile may have."""
    parts = [re.sub(r"[^a-z0-9_]+", "_", part.lower()).strip("_") for part in topic.split("/")]
    said = [part for part in parts if part and not _SAYS_NOTHING.fullmatch(part)]
    name = "_".join(said)[:56] or "camera"
    name = name if name[0].isalpha() else f"camera_{name}"
    number = next(n for n in range(1, len(taken) + 2) if _numbered(name, n) not in taken)
    return _numbered(name, number)


def _numbered(name: str, number: int) -> str:
    return name if number == 1 else f"{name}_{number}"


__all__ = ["CameraTopic", "camera_lines", "camera_topics"]
