"""Which lidars point in a direction that neither the profile nor the recording says."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from restock.ingest.containers.recording import Recording
from restock.ingest.decoding.columns import Ragged
from restock.ingest.profile.profile import Profile
from restock.ingest.steps.frames import FIELDS, frame_id_path, plain, transform_fields
from restock.ingest.urdf.description import BASE_FRAMES

MAX_TRANSFORMS = 20_000  # messages of a topic; what places a lidar is published all the time
_ENDS = ("tf", "tf_static", "robot_description")


def unknown_directions(recording: Recording, profile: Profile) -> list[str]:
    """Return a note for each lidar whose zero is taken to point ahead though nothing says so.

    A profile says so by an angle other than 0, or by any angle in the lidar's own input. Transforms
    say so if one places the frame of the scans; a recorded description may say it.
    """
    unsaid = {
        name: source
        for name, source in profile.inputs.scans.items()
        if source.lidar_yaw_rad is None
        and (source.lidar_at_m is not None or profile.task.body.lidar_yaw_rad == 0)
        and source.topic in recording.topics
    }
    if not unsaid or any(name.endswith("/robot_description") for name in recording.topics):
        return []
    frames = {name: _first_frame(recording, source.topic) for name, source in unsaid.items()}
    frames = {
        name: frame
        for name, frame in frames.items()
        if frame and frame.split("/")[-1] not in BASE_FRAMES
    }
    left = set(frames.values())
    for topic in recording.topics if left else ():
        for child in _children(recording, topic):
            left.discard(child)
            if not left:
                return []
    return [
        f"{name}: no transform places {frame}, the frame of {unsaid[name].topic}: that its zero"
        " points straight ahead is a guess; if it does, say so: lidar_at_m and lidar_yaw_rad = 0 in"
        f" [inputs.{name}]"
        for name, frame in frames.items()
        if frame in left
    ]


def _first_frame(recording: Recording, topic: str) -> str:
    path = frame_id_path(recording.leaves(topic))
    if path is not None:
        for _, fields in recording.batches(topic, [path]):
            for frame in np.asarray(fields[path], object)[:1]:
                return plain(str(frame))
    return ""


def _children(recording: Recording, topic: str) -> Iterator[str]:
    """Yield the frames that a topic of transforms places, again and again."""
    layout = transform_fields(recording.leaves(topic))
    if layout is None or recording.topics[topic].skipped:
        return
    path, count = layout[FIELDS.index("transforms[].child_frame_id")], 0
    for times, fields in recording.batches(topic, [path]):
        column = fields[path]
        values = column.values if isinstance(column, Ragged) else column
        children = set(map(str, np.asarray(values, object).ravel()))
        yield from {plain(child) for child in children}
        count += len(times)
        if count > MAX_TRANSFORMS:
            return
