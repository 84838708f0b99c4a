"""A camera's frames as an image feature of LeRobot: one picture per step, by episode.

JPEG and PNG with three channels of 8 bits are exported byte for byte as recorded. Other images are
converted to RGB and encoded as PNG. Images with more than 8 bits per channel (depth) are refused.
"""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.errors import StoreError
from restock.ingest.steps.cameras import JPEG, PNG
from restock.replay.export.trajectory import Trajectory
from restock.replay.store.frames import CameraFrame, camera_frames, cameras_of
from restock.replay.store.store import Store

SAMPLES = 100  # pictures per episode from which statistics are computed, as in LeRobot
SMALL_PX = 150  # pictures are subsampled for statistics, the longer side to about this size


@dataclass
class ImageFeature:
    """The feature `observation.images.CAMERA` of a data set, and counts of its pictures so far."""

    camera: str
    shape: tuple[int, int] | None = None  # height, width; None before the first picture
    as_recorded: int = 0  # pictures exported byte for byte
    packed: Counter[str] = field(default_factory=Counter)  # encoding -> pictures re-encoded as PNG

    @property
    def name(self) -> str:
        return f"observation.images.{self.camera}"

    def describe(self) -> dict[str, Any]:
        """Return the feature's entry in info.json."""
        height, width = self.shape or (0, 0)
        names = ["height", "width", "channels"]
        return {"dtype": "image", "shape": [height, width, 3], "names": names}

    def note(self) -> str:
        """Return the note on how the camera's pictures were exported."""
        packed = "".join(f"; {count:,} of {what} as PNG" for what, count in self.packed.items())
        return f"{self.name}: {self.as_recorded:,} pictures as they were recorded{packed}"

    def picture(self, frame: CameraFrame) -> tuple[bytes, NDArray[np.uint8] | None]:
        """Return a frame as an encoded file, and its pixels if it was re-encoded.

        Raises:
            StoreError: the frame has another size than earlier ones, or more than 8 bits per
                channel.
        """
        layout = frame.layout
        size = (layout.height, layout.width)
        where = f"frame {frame.frame_index} of {frame.topic}, {frame.source_file}"
        if self.shape is not None and self.shape != size:
            raise StoreError(
                f"camera {self.camera!r} has frames of {size[1]} x {size[0]} and of"
                f" {self.shape[1]} x {self.shape[0]} pixels",
                where=where,
                remedy="a data set has one image size: export these recordings apart, with --query",
            )
        if layout.bits > 8:
            raise StoreError(
                f"camera {self.camera!r} has {layout.bits} bits a channel ({layout.encoding}),"
                " but LeRobot's pictures have 8",
                where=where,
                remedy="name the other cameras with --cameras, or none",
            )
        self.shape = size
        if layout.encoding in (JPEG, PNG) and layout.channels == 3 and layout.bits == 8:
            self.as_recorded += 1
            return frame.data, None
        pixels = to_rgb(frame.image())
        self.packed[f"{layout.encoding}, {layout.channels} channels"] += 1
        return png(pixels), pixels


def to_rgb(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Convert pixels to (H, W, 3): repeat grey three times, drop alpha."""
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    return np.ascontiguousarray(image[..., :3], np.uint8)


def png(image: NDArray[np.uint8]) -> bytes:
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(image).save(out, "PNG")
    return out.getvalue()


def chosen_cameras(store: Store, named: Sequence[str] | None) -> list[str]:
    """Return the cameras whose frames are exported: `named`, or all if it is None.

    Raises:
        StoreError: the store has no such camera.
    """
    have = cameras_of(store)
    if missing := sorted(set(named or ()) - set(have)):
        raise StoreError(
            f"no frames of a camera {missing[0]!r}",
            where=str(store.path),
            remedy=f"it has {', '.join(have) or 'none'}: [cameras.NAME] of a profile names them",
        )
    return have if named is None else list(dict.fromkeys(named))


def pictures(
    store: Store, trajectory: Trajectory, features: Sequence[ImageFeature]
) -> Iterator[tuple[ImageFeature, list[dict[str, Any]], NDArray[np.uint8]]]:
    """Yield each camera's pictures of a trajectory, one per step (T).

    For each camera: the feature, the encoded pictures as rows of a LeRobot column, and subsampled
    pixels of up to SAMPLES pictures for statistics, (N, h, w, 3).

    Raises:
        StoreError: see `ImageFeature.picture`; or a frame is damaged.
    """
    if not features:
        return
    ids = [int(one) for one in trajectory.carried["transition_id"]]
    sampled = {ids[place] for place in np.linspace(0, len(ids) - 1, SAMPLES).astype(int)}
    for feature in features:
        files: dict[int, bytes] = {}
        small: list[NDArray[np.uint8]] = []
        known: dict[int, tuple[bytes, NDArray[np.uint8] | None]] = {}  # caches the last frame
        for frame in camera_frames(store, ids, feature.camera):
            if frame.frame_index not in known:
                known = {frame.frame_index: feature.picture(frame)}
            file, seen = known[frame.frame_index]
            files[frame.transition_id] = file
            if frame.transition_id in sampled:
                seen = to_rgb(frame.image()) if seen is None else seen
                step = max(max(seen.shape[:2]) // SMALL_PX, 1)
                small.append(seen[::step, ::step])
        rows = [{"bytes": files[one], "path": None} for one in ids]
        yield feature, rows, np.stack(small)
