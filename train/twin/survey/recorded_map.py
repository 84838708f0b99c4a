"""The map that a recording holds: its last `nav_msgs/OccupancyGrid` that is no costmap.

Map servers say 0, 100 or -1; some SLAM (Cartographer) says how likely each cell is occupied. Below
25 percent counts as free and above 65 as occupied, as when `map_saver` writes a `map.yaml`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from restock.errors import RecordingError
from restock.ingest.containers.recording import Recording
from restock.ingest.containers.topic_reading import TopicInfo
from restock.ingest.decoding.columns import Ragged
from restock.ingest.task.signals import yaw_of
from restock.train.twin.floors.occupancy_grid import (
    FREE,
    MAX_CELLS,
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
)
from restock.train.twin.floors.occupancy_map import FURTHEST_M

TYPE = "nav_msgs/msg/OccupancyGrid"
FREE_BELOW, OCCUPIED_ABOVE = 25, 65  # percent
_OTHERS = ("costmap", "cost_map", "transformed", "local", "_updates")  # in the topic's name
_INFO = (
    "info.resolution",
    "info.width",
    "info.height",
    "info.origin.position.x",
    "info.origin.position.y",
    *(f"info.origin.orientation.{axis}" for axis in "xyzw"),
)
_FRAME = "header.frame_id"


def map_topic(recording: Recording) -> TopicInfo | None:
    """The topic of the recording's map: `/map` before any other."""
    found = [
        topic
        for topic in recording.topics.values()
        if topic.type == TYPE and topic.expected and not topic.skipped
        if not any(word in topic.name.lower() for word in _OTHERS)
    ]
    return min(found, key=lambda t: (t.name.split("/")[-1] != "map", t.name), default=None)


def recorded_map(recording: Recording) -> tuple[OccupancyGrid, str] | None:
    """The last map of the recording and where it is from, in words; None where it has none.

    Raises:
        RecordingError: the message is not a map: its size, resolution or origin are not.
    """
    topic = map_topic(recording)
    if topic is None:
        return None
    columns = recording.read({topic.name: [*_INFO, _FRAME, "data"]}).get(topic.name)
    if columns is None or not len(columns):
        return None
    fields = columns.fields
    values: list[Any] = [np.asarray(fields[path])[-1] for path in _INFO]
    cell_m, width, height, x, y = (float(value) for value in values[:5])
    yaw = float(yaw_of(*(np.array([float(value)]) for value in values[5:]))[0])
    data = fields["data"]
    cells = np.asarray(data[len(data) - 1] if isinstance(data, Ragged) else data[-1]).ravel()
    where = f"{recording.path}, {topic.name}"
    wrong = ""
    if width < 1 or height < 1:
        wrong = f"an empty map of {width:.0f} x {height:.0f} cells"
    elif width * height > MAX_CELLS:
        wrong = f"{width:,.0f} x {height:,.0f} cells, more than the {MAX_CELLS:,} that can be read"
    elif len(cells) != width * height:
        wrong = f"{len(cells):,} cells of data for {width:.0f} x {height:.0f}"
    elif not 0.001 <= cell_m <= 1:
        wrong = f"a resolution of {cell_m:g} m, which must be from .001 to 1 m"
    elif not (np.abs([x, y, yaw]) <= FURTHEST_M).all():
        wrong = f"an origin at {x:g}, {y:g}, turned by {yaw:g} rad"
    if wrong:
        raise RecordingError(
            f"its map has {wrong}",
            where=where,
            remedy="give the map as a file (--map map.yaml), or --by scans, or --by corridor",
        )
    percent = cells.astype(np.int16).reshape(int(height), int(width)).T
    occupancy = np.full(percent.shape, UNKNOWN, np.int8)
    occupancy[(percent >= 0) & (percent < FREE_BELOW)] = FREE
    occupancy[(percent > OCCUPIED_ABOVE) & (percent <= 100)] = OCCUPIED
    frame = str(np.asarray(fields[_FRAME], object)[-1]).strip("/")
    grid = OccupancyGrid(np.ascontiguousarray(occupancy), cell_m, (x, y, yaw), frame)
    count = f", the last of {len(columns)}" if len(columns) > 1 else ""
    return grid, f"{topic.name} of {recording.path.name}{count}"
