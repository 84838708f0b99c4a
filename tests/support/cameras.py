"""The driven robot with cameras: frames whose colour says which message they are."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from restock.ingest.decoding.columns import Ragged, TopicColumns, offsets_of
from restock.ingest.profile.profile import Profile, parse_profile
from restock.ingest.steps.cameras import COMPRESSED, RAW
from support.driven_robot import Drive, columns, typed_topics, write_topics
from support.profile_texts import WAREHOUSE

FRONT, REAR = "/front/image/compressed", "/rear/image"
WIDTH, HEIGHT = 48, 32
PERIOD_S = 0.1  # of the frames
CAMERAS = f"""
[cameras.front]
topic = "{FRONT}"

[cameras.rear]
topic = "{REAR}"
"""


def profile_with(text: str = CAMERAS) -> Profile:
    return parse_profile(WAREHOUSE + text, where="test")


def picture(number: int, channels: int = 3) -> NDArray[np.uint8]:
    """Return an image (H, W, C) whose colour is its number, and whose left half is darker."""
    image = np.full((HEIGHT, WIDTH, channels), 40 + 2 * (number % 100), np.uint8)
    image[:, : WIDTH // 2] //= 2
    image[..., 0] //= 2
    return image


def file_of(image: NDArray[np.uint8], kind: str = "JPEG") -> bytes:
    out = io.BytesIO()
    Image.fromarray(image.squeeze()).save(out, kind, quality=95)
    return out.getvalue()


def compressed(
    files: Sequence[bytes], time_s: NDArray[np.float64] | None = None, said: str = "jpeg"
) -> tuple[str, TopicColumns]:
    """Files as messages of a topic."""
    times = np.arange(len(files)) * PERIOD_S if time_s is None else time_s
    data = Ragged(
        np.frombuffer(b"".join(files), np.uint8), offsets_of(np.array([len(one) for one in files]))
    )
    fields = {"format": np.full(len(files), said, object), "data": data}
    return COMPRESSED, columns(times, fields)


def raw(images: Sequence[NDArray[np.generic]], encoding: str = "rgb8") -> tuple[str, TopicColumns]:
    """Arrays (H, W, …) as messages of a topic."""
    count, rows = len(images), [image.tobytes() for image in images]
    height, width = images[0].shape[:2]
    data = Ragged(
        np.frombuffer(b"".join(rows), np.uint8), offsets_of(np.array([len(one) for one in rows]))
    )
    fields = {
        "height": np.full(count, height),
        "width": np.full(count, width),
        "encoding": np.full(count, encoding, object),
        "is_bigendian": np.zeros(count, np.int64),
        "step": np.full(count, len(rows[0]) // height),
        "data": data,
    }
    return RAW, columns(np.arange(count) * PERIOD_S, fields)


def front_and_rear(count: int = 60) -> dict[str, tuple[str, TopicColumns]]:
    return {
        FRONT: compressed([file_of(picture(number)) for number in range(count)]),
        REAR: raw([picture(number) for number in range(count)]),
    }


def camera_bag(
    folder: Path,
    cameras: Mapping[str, tuple[str, TopicColumns]] | None = None,
    *,
    storage: str = "sqlite3",
    duration_s: float = 6.0,
) -> Path:
    """Return a drive with these topics beside it."""
    topics = typed_topics(Drive(duration_s=duration_s)) | dict(cameras or front_and_rear())
    return write_topics(topics, folder, storage=storage)
