"""Read camera frames for rows of a store. Frames are stored as recorded, and decoded on demand.

images = [frame.image() for frame in camera_frames(store, "FROM transitions LIMIT 8", "front")]
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.errors import QueryError, StoreError
from restock.ingest.steps.cameras import ImageLayout, ImageProblem, pixels
from restock.replay.store.definitions import install_named
from restock.replay.store.store import Store

BATCH_BYTES = 32 << 20  # bytes of frames that are in memory at a time
_LAYOUT = ("encoding", "width", "height", "channels", "bits", "row_bytes", "big_endian")
_OWN = ("topic", "log_time_ns", "stamp_ns", "size_bytes", "sha256", "data")


@dataclass(frozen=True)
class CameraFrame:
    """The camera frame in force at a transition's step, and its source."""

    transition_id: int
    recording_id: str
    camera: str
    frame_index: int  # index of the frame's message in its topic, by log time
    topic: str
    log_time_ns: int
    stamp_ns: int  # time of the frame on the recording's alignment clock
    age_s: float  # age of the frame at the step
    size_bytes: int
    sha256: str  # hash of the frame's bytes as recorded
    source_file: str
    data: bytes
    layout: ImageLayout

    def image(self) -> NDArray[np.generic]:
        """Decode the pixels, (H, W) or (H, W, C): RGB or RGBA; uint8, uint16 or float32.

        Raises:
            StoreError: its bytes differ from the recorded ones, or are not an image.
        """
        where = f"frame {self.frame_index} of {self.topic}, recording {self.recording_id}"
        if hashlib.sha256(self.data).hexdigest() != self.sha256:
            raise StoreError(
                "its bytes differ from those that were recorded",
                where=where,
                remedy="restore the store's file from a copy, or ingest the recording again",
            )
        try:
            return pixels(self.data, self.layout)
        except ImageProblem as problem:
            raise StoreError(
                str(problem),
                where=where,
                remedy=f"the recording has it like this: leave out its rows ({self.source_file})",
            ) from problem


def camera_frames(
    store: Store, rows: str | Sequence[int], camera: str | None = None
) -> Iterator[CameraFrame]:
    """Yield the frames in force at the steps of some rows, by recording, step and camera.

    Rows without a frame in force are left out. About BATCH_BYTES of frames are in memory at a time.

    Args:
        store: an open store.
        rows: transition ids, or SQL over the store's views that gives a column `transition_id`.
        camera: the camera's name in the profile; None: every camera.

    Raises:
        StoreError: the store has no such camera.
        QueryError: the query fails, or has no column transition_id.
    """
    have = cameras_of(store)
    if camera is not None and camera not in have:
        raise StoreError(
            f"it has no frames of a camera {camera!r}",
            where=str(store.path),
            remedy=f"it has {', '.join(have)}"
            if have
            else "name [cameras.NAME] in the profile and ingest its recordings again",
        )
    if isinstance(rows, str):
        relation = store.sql(rows.strip().rstrip(";"))
        if "transition_id" not in relation.columns:
            raise QueryError("the query gives no transition_id", where=str(store.path))
        ids = relation.project("transition_id").to_arrow_table()["transition_id"].to_pylist()
    else:
        ids = [int(one) for one in rows]
    install_named(store.connection, "transition_frames")
    found = store.connection.execute(
        "SELECT transition_id, recording_id, camera, frame_index, age_s, size_bytes"
        " FROM transition_frames"
        " WHERE transition_id BETWEEN ? AND ?"  # which skips the files of other recordings
        " AND transition_id IN (SELECT unnest(?)) AND (? IS NULL OR camera = ?)"
        " ORDER BY recording_id, transition_id, camera",
        [min(ids, default=0), max(ids, default=0), ids, camera, camera],
    ).fetchall()
    sources = dict(store.sql("SELECT recording_id, source_file FROM recordings").fetchall())
    begin = size = 0
    for place, (*_, size_bytes) in enumerate(found):
        size += size_bytes
        if size >= BATCH_BYTES or place == len(found) - 1:
            yield from _read(store, found[begin : place + 1], sources)
            begin, size = place + 1, 0


def cameras_of(store: Store) -> list[str]:
    """Return the names of the cameras that a store has frames of."""
    rows = store.sql("SELECT DISTINCT camera FROM frames ORDER BY ALL").fetchall()
    return [str(name) for (name,) in rows]


def _read(
    store: Store, found: Sequence[tuple[Any, ...]], sources: Mapping[str, str]
) -> Iterator[CameraFrame]:
    """Yield the frames of rows (transition_id, recording_id, camera, frame_index, age_s, …)."""
    keys = sorted({row[1:4] for row in found})
    recordings, cameras, indices = zip(*keys, strict=True)
    named = ", ".join(f"stored.{name}" for name in (*_OWN, *_LAYOUT))
    rows = store.connection.execute(
        f"SELECT stored.recording_id, stored.camera, stored.frame_index, {named}"
        " FROM stored_frames AS stored"
        " JOIN (SELECT unnest(?) AS recording_id, unnest(?) AS camera, unnest(?) AS frame_index)"
        " USING (recording_id, camera, frame_index)",
        [list(recordings), list(cameras), list(indices)],
    ).fetchall()
    frames = {row[:3]: row[3:] for row in rows}
    for transition_id, recording_id, camera, index, age_s, _ in found:
        values = frames[recording_id, camera, index]
        own = dict(zip(_OWN, values[: len(_OWN)], strict=True))
        yield CameraFrame(
            transition_id=transition_id,
            recording_id=recording_id,
            camera=camera,
            frame_index=index,
            age_s=age_s,
            source_file=sources[recording_id],
            layout=ImageLayout(**dict(zip(_LAYOUT, values[len(_OWN) :], strict=True))),
            **own,
        )
