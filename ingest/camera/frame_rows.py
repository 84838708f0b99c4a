"""The frames of a recording as rows: its images are read again, and those in force kept."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from restock.arrays import Ints
from restock.ingest.camera.frame_columns import (
    BIG_ENDIAN,
    BITS,
    CHANNELS,
    ENCODING,
    HEIGHT,
    ROW_BYTES,
    SHA256,
    SIZE,
    WIDTH,
    image_bytes,
    image_fields,
)
from restock.ingest.camera.frames import CameraFrames
from restock.ingest.containers.recording import Recording
from restock.ingest.task.schema import frame_schema, transition_ids

BATCH_BYTES = 32 << 20  # of images that are in memory together


@dataclass(frozen=True)
class KeptFrames:
    """The frames of one camera that a step of the recording has: K of its N messages."""

    name: str
    frames: CameraFrames
    row: Ints  # (K,) ascending
    first: Ints  # (K,) tick
    last: Ints  # (K,)
    steps: int  # that have one

    @classmethod
    def of(cls, name: str, frames: CameraFrames, ticks: Ints) -> KeptFrames:
        """`ticks` are the steps that belong to an episode, in any order."""
        ticks = np.unique(ticks)
        return cls(name, frames, *frames.in_force(ticks), int((frames.at_tick[ticks] >= 0).sum()))

    def manifest_row(self, recording: Recording, file: str) -> dict[str, Any]:
        """What became of its messages, as `recordings.cameras` holds it."""
        topic = recording.topics[self.frames.camera.topic]
        sizes = np.asarray(self.frames.columns.fields[SIZE], np.int64)
        return {
            "camera": self.name,
            "topic": topic.name,
            "type": topic.type,
            "expected": topic.expected,
            **self.frames.account(len(self.row), self.steps),
            "size_bytes": int(sizes[self.row].sum()),
            "file": file,
        }


def kept_frames(cameras: Mapping[str, CameraFrames], ticks: Ints) -> list[KeptFrames]:
    """The frames of each camera that steps in episodes have."""
    return [KeptFrames.of(name, frames, ticks) for name, frames in cameras.items()]


def frame_rows(recording: Recording, kept: KeptFrames) -> Iterator[pa.RecordBatch]:
    """Rows by `frame_schema`, some megabytes of images at a time.

    A frame is known by its log time and its hash: a message that holds the same at the same moment
    is the same frame.
    """
    columns, camera = kept.frames.columns, kept.frames.camera
    topic = recording.topics[camera.topic]
    hashes = np.asarray(columns.fields[SHA256], np.uint8)
    waiting: dict[tuple[int, bytes], list[int]] = {}
    for place, row in enumerate(kept.row.tolist()):
        key = int(columns.log_time_ns[row]), hashes[row].tobytes()
        waiting.setdefault(key, []).append(place)
    wanted = {log_ns for log_ns, _ in waiting}
    taken: list[tuple[int, bytes]] = []
    size = 0
    for log_ns, fields in recording.batches(topic.name, image_fields(topic.type)):
        if wanted.isdisjoint(log_ns.tolist()):
            continue
        for at, data in zip(log_ns.tolist(), image_bytes(fields), strict=True):
            if at not in wanted:
                continue
            for place in waiting.pop((at, hashlib.sha256(data).digest()), ()):
                taken.append((place, data))
                size += len(data)
        if size >= BATCH_BYTES:
            yield _batch(recording, kept, taken)
            taken, size = [], 0
    if taken:
        yield _batch(recording, kept, taken)


def _batch(
    recording: Recording, kept: KeptFrames, taken: list[tuple[int, bytes]]
) -> pa.RecordBatch:
    taken = sorted(taken, key=lambda one: one[0])
    place = np.array([place for place, _ in taken])
    row, columns, camera = kept.row[place], kept.frames.columns, kept.frames.camera
    topic, count = recording.topics[camera.topic], len(taken)
    fields = columns.fields
    first, last = (
        transition_ids(recording.recording_id, ticks[place]) for ticks in (kept.first, kept.last)
    )
    values: dict[str, Any] = {
        "recording_id": [recording.recording_id] * count,
        "camera": [kept.name] * count,
        "frame_index": row,
        "topic": [topic.name] * count,
        "type": [topic.type] * count,
        "log_time_ns": columns.log_time_ns[row],
        "stamp_ns": kept.frames.stamp_ns[row],
        "first_transition_id": first,
        "last_transition_id": last,
        "encoding": np.asarray(fields[ENCODING])[row].tolist(),
        "sha256": [one.tobytes().hex() for one in np.asarray(fields[SHA256])[row]],
        "data": [data for _, data in taken],
        "big_endian": np.asarray(fields[BIG_ENDIAN])[row] != 0,
    }
    numbers = {"width": WIDTH, "height": HEIGHT, "channels": CHANNELS, "bits": BITS}
    numbers |= {"row_bytes": ROW_BYTES, "size_bytes": SIZE}
    values |= {name: np.asarray(fields[column])[row] for name, column in numbers.items()}
    schema = frame_schema()
    return pa.record_batch([pa.array(values[f.name], f.type) for f in schema], schema=schema)
