"""The frames of a recording's cameras: their layout, the choice of frames to keep, their pixels.

A recording's images do not fit into memory. When its topics are read, only the layout and the hash
of each frame are kept; frames that steps need are read again when they are written as rows. Frames
are checked without decoding them: the header of a JPEG or PNG contains its size, and its end shows
whether the file was cut. `pixels` decodes a frame for viewing.
"""

from __future__ import annotations

import hashlib
import io
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from restock.arrays import Bools, Ints
from restock.ingest.containers.recording import Recording
from restock.ingest.containers.storage import Fields, Reduction
from restock.ingest.decoding.columns import DTYPES, FieldColumn, Leaf, Ragged, TopicColumns
from restock.ingest.profile.tables import Camera
from restock.ingest.task.schema import frame_schema, transition_ids

COMPRESSED, RAW = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image"
TYPES = (COMPRESSED, RAW)
MAX_PIXELS = 100_000_000  # largest size of a frame; no camera has more
JPEG, PNG = "jpeg", "png"
# Encoding of raw images -> NumPy type, number of channels, and the channels' order that gives red,
# green, blue (and alpha).
ENCODINGS: dict[str, tuple[str, int, tuple[int, ...]]] = {
    "rgb8": ("u1", 3, (0, 1, 2)),
    "bgr8": ("u1", 3, (2, 1, 0)),
    "8UC3": ("u1", 3, (2, 1, 0)),  # OpenCV's order
    "rgba8": ("u1", 4, (0, 1, 2, 3)),
    "bgra8": ("u1", 4, (2, 1, 0, 3)),
    "8UC4": ("u1", 4, (2, 1, 0, 3)),
    "mono8": ("u1", 1, (0,)),
    "8UC1": ("u1", 1, (0,)),
    "mono16": ("u2", 1, (0,)),
    "16UC1": ("u2", 1, (0,)),
    "32FC1": ("f4", 1, (0,)),
}
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"IEND\xaeB`\x82"
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}  # colour type -> channels; a palette (3) has RGB
_PLAIN_MODES = {"P": "RGB", "CMYK": "RGB", "YCbCr": "RGB", "LA": "RGBA", "1": "L"}
_JPEG_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # markers that begin a frame header


class ImageProblem(ValueError):
    """A message has no image that can be kept; such messages are counted by this error's text."""


@dataclass(frozen=True)
class ImageLayout:
    """Size and format of an image, as needed to decode its bytes."""

    encoding: str  # jpeg, png, or one of ENCODINGS
    width: int
    height: int
    channels: int
    bits: int  # bits per channel
    row_bytes: int = 0  # bytes per row of a raw image; 0 for JPEG and PNG
    big_endian: bool = False


def compressed_layout(data: bytes, message_format: str) -> ImageLayout:
    """Read the layout of a JPEG or PNG from its header; only errors mention `message_format`.

    Raises:
        ImageProblem: the file is neither, its header is damaged, or its end is missing.
    """
    if data.startswith(b"\xff\xd8"):
        layout = _jpeg(data)
    elif data.startswith(_PNG_SIGNATURE):
        layout = _png(data)
    elif not data:
        raise ImageProblem("no bytes")
    else:
        raise ImageProblem(f"neither JPEG nor PNG (its format is {message_format[:60]!r})")
    _check_size(layout)
    return layout


def raw_layout(
    size_bytes: int, encoding: str, width: int, height: int, row_bytes: int, big_endian: bool
) -> ImageLayout:
    """Build the layout of a raw image from the fields of its message.

    Raises:
        ImageProblem: the encoding is unknown, or there are too few bytes for the size.
    """
    if encoding not in ENCODINGS:
        raise ImageProblem(f"unknown encoding {encoding[:60]!r}")
    kind, channels, _ = ENCODINGS[encoding]
    bits = np.dtype(kind).itemsize * 8
    layout = ImageLayout(encoding, width, height, channels, bits, row_bytes, big_endian)
    _check_size(layout)
    if row_bytes < width * channels * bits // 8:
        raise ImageProblem("rows shorter than their width")
    if size_bytes < row_bytes * height:
        raise ImageProblem("cut short: fewer bytes than its rows have")
    return layout


def pixels(data: bytes, layout: ImageLayout) -> NDArray[np.generic]:
    """Decode an image to (H, W), or (H, W, C) in the order red, green, blue (and alpha).

    The type is uint8, uint16 or float32.

    Raises:
        ImageProblem: the bytes are damaged, or do not have this layout.
    """
    if layout.encoding in (JPEG, PNG):
        return _decode(data, layout)
    kind, channels, order = ENCODINGS[layout.encoding]
    size = layout.row_bytes * layout.height
    if len(data) < size:
        raise ImageProblem("cut short: fewer bytes than its rows have")
    rows = np.frombuffer(data, np.uint8, size).reshape(layout.height, layout.row_bytes)
    wide = np.ascontiguousarray(rows[:, : layout.width * channels * layout.bits // 8])
    values = wide.view(np.dtype(kind).newbyteorder(">" if layout.big_endian else "<"))
    image = values.astype(kind).reshape(layout.height, layout.width, channels)
    return image[:, :, 0] if channels == 1 else np.ascontiguousarray(image[:, :, list(order)])


def _decode(data: bytes, layout: ImageLayout) -> NDArray[np.generic]:
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(io.BytesIO(data), formats=["JPEG", "PNG"]) as image:
            if image.size != (layout.width, layout.height):
                raise ImageProblem("its size differs from its header")
            plain = _PLAIN_MODES.get(image.mode)
            array = np.asarray(image.convert(plain) if plain else image)
    except ImageProblem:
        raise
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError, struct.error) as error:
        raise ImageProblem(f"cannot be decoded: {error}") from error
    return array.astype(np.uint16) if array.dtype.kind == "i" else array


def _check_size(layout: ImageLayout) -> None:
    if layout.width < 1 or layout.height < 1:
        raise ImageProblem("no pixels")
    if layout.width * layout.height > MAX_PIXELS:
        raise ImageProblem(f"claims more than {MAX_PIXELS:,} pixels")


def _jpeg(data: bytes) -> ImageLayout:
    """Read the layout of a JPEG from the markers before its image data."""
    if data[-4096:].rstrip(b"\x00")[-2:] != b"\xff\xd9":  # some cameras pad with zeros
        raise ImageProblem("truncated JPEG: its end is missing")
    at = 2
    while at + 9 < len(data):
        if data[at] != 0xFF:
            break
        marker = data[at + 1]
        if marker == 0xFF or marker == 0x01 or 0xD0 <= marker <= 0xD8:  # a marker without length
            at += 1 if marker == 0xFF else 2
            continue
        if marker in _JPEG_FRAMES:
            bits, height, width, channels = struct.unpack_from(">BHHB", data, at + 4)
            return ImageLayout(JPEG, width, height, channels, bits)
        if marker in (0xD9, 0xDA):
            break
        at += 2 + int(struct.unpack_from(">H", data, at + 2)[0])
    raise ImageProblem("damaged JPEG: no header of a frame")


def _png(data: bytes) -> ImageLayout:
    if len(data) < 33 or data[12:16] != b"IHDR":
        raise ImageProblem("damaged PNG: no header")
    width, height, bits, color = struct.unpack_from(">IIBB", data, 16)
    if color not in _PNG_CHANNELS:
        raise ImageProblem("damaged PNG: no header")
    if data.rstrip(b"\x00")[-len(_PNG_END) :] != _PNG_END:
        raise ImageProblem("truncated PNG: its end is missing")
    return ImageLayout(PNG, width, height, _PNG_CHANNELS[color], 8 if color == 3 else bits)


# Names of columns computed from frames. They have spaces, so as not to clash with field names.
ENCODING, PROBLEM, SHA256 = "frame encoding", "frame problem", "frame sha256"
SIZE, WIDTH, HEIGHT = "frame size_bytes", "frame width", "frame height"
CHANNELS, BITS, ROW_BYTES = "frame channels", "frame bits", "frame row_bytes"
BIG_ENDIAN = "frame big_endian"
_NUMBERS = (SIZE, WIDTH, HEIGHT, CHANNELS, BITS, ROW_BYTES, BIG_ENDIAN)
_COMPRESSED_FIELDS = ("format", "data")
_RAW_FIELDS = ("encoding", "width", "height", "step", "is_bigendian", "data")


def image_fields(kind: str) -> tuple[str, ...]:
    """Return the field paths that an image message of this type has."""
    return _COMPRESSED_FIELDS if kind == COMPRESSED else _RAW_FIELDS


def wrong_field(kind: str, leaves: Sequence[Leaf]) -> str | None:
    """Return the first field that is missing or not as ROS defines it; None if all are right."""
    found = {leaf.path: leaf for leaf in leaves}
    fields = image_fields(kind)
    return next((name for name in fields if not _is_field(name, found.get(name))), None)


def _is_field(name: str, leaf: Leaf | None) -> bool:
    if leaf is None:
        return False
    if name in ("format", "encoding"):
        return leaf.kind == "string" and not leaf.dims
    number = DTYPES.get(leaf.kind)
    if number is None or number.kind not in "biu":
        return False
    return leaf.dims == (None,) and number.itemsize == 1 if name == "data" else not leaf.dims


def frame_reduction(kind: str) -> Reduction:
    """Build the reduction of a camera's messages to columns of their layouts and hashes."""

    def apply(fields: Fields) -> dict[str, FieldColumn]:
        payloads = image_bytes(fields)
        layout = layouts(kind, fields)
        count = len(payloads)
        numbers = {name: np.zeros(count, np.int64) for name in _NUMBERS}
        encoding, problem = np.full(count, "", object), np.full(count, "", object)
        hashes = np.zeros((count, 32), np.uint8)
        for row, data in enumerate(payloads):
            numbers[SIZE][row] = len(data)
            try:
                one = layout(row, data)
            except ImageProblem as reason:
                problem[row] = str(reason)
                continue
            hashes[row] = np.frombuffer(hashlib.sha256(data).digest(), np.uint8)
            encoding[row] = one.encoding
            values = (one.width, one.height, one.channels, one.bits, one.row_bytes, one.big_endian)
            for name, value in zip(_NUMBERS[1:], values, strict=True):
                numbers[name][row] = value
        return {**numbers, ENCODING: encoding, PROBLEM: problem, SHA256: hashes}

    return Reduction(image_fields(kind), apply)


def image_bytes(fields: Fields) -> list[bytes]:
    """Return the image bytes of each message."""
    column = fields["data"]
    assert isinstance(column, Ragged)
    view = np.ascontiguousarray(np.asarray(column.values, np.uint8)).data
    bounds = zip(column.offsets[:-1].tolist(), column.offsets[1:].tolist(), strict=True)
    return [bytes(view[start:stop]) for start, stop in bounds]


def layouts(kind: str, fields: Fields) -> Callable[[int, bytes], ImageLayout]:
    """Return a function (row, image bytes) -> the image's layout, which raises ImageProblem."""
    if kind == COMPRESSED:
        formats = np.asarray(fields["format"], object)
        return lambda row, data: compressed_layout(data, str(formats[row]))
    encodings = np.asarray(fields["encoding"], object)
    names = ("width", "height", "step", "is_bigendian")
    width, height, step, big = (np.asarray(fields[name], np.int64) for name in names)

    def raw(row: int, data: bytes) -> ImageLayout:
        numbers = (int(width[row]), int(height[row]), int(step[row]), bool(big[row]))
        return raw_layout(len(data), str(encodings[row]), *numbers)

    return raw


NS = 1_000_000_000
OFF_CLOCK = "its stamp does not fit the clock"
MAX_REASONS = 20  # the most frequent reasons are counted one by one, all others together


@dataclass(frozen=True)
class CameraFrames:
    """A camera's N messages, and the frame in force at each of T ticks."""

    camera: Camera
    columns: TopicColumns  # layouts and hashes, by `frame_reduction`
    stamp_ns: Ints  # (N,) on the alignment clock; -1 if the stamp does not fit the clock
    usable: Bools  # (N,) whether an image was read, its stamp fits, and `max_hz` keeps it
    at_tick: Ints  # (T,) index of the last usable frame that is not too old, or -1

    @property
    def problems(self) -> Counter[str]:
        """Count the messages that have no usable image, by reason."""
        words = np.asarray(self.columns.fields[PROBLEM], object)
        off = (words == "") & (self.stamp_ns < 0)
        counted = Counter([word for word in words if word])
        most = Counter(dict(counted.most_common(MAX_REASONS)))
        rest = {"other problems": counted.total() - most.total(), OFF_CLOCK: int(off.sum())}
        return most + Counter(rest)

    def in_force(self, ticks: Ints) -> tuple[Ints, Ints, Ints]:
        """Return the K frames in force at these ticks, and the first and last tick of each."""
        at = self.at_tick[ticks]
        seen = at >= 0
        frames, which = np.unique(at[seen], return_inverse=True)
        first = np.full(len(frames), np.iinfo(np.int64).max)
        last = np.full(len(frames), -1)
        np.minimum.at(first, which, ticks[seen])
        np.maximum.at(last, which, ticks[seen])
        return frames, first, last

    def account(self, kept: int, steps: int) -> dict[str, Any]:
        """Count the decoded messages as kept, thinned, unused or problems: each is one of these."""
        problems = self.problems
        usable, decoded = int(self.usable.sum()), len(self.columns)
        return {
            "decoded": decoded,
            "kept": kept,
            "thinned": decoded - usable - problems.total(),
            "unused": usable - kept,
            "problems": [{"reason": why, "count": n} for why, n in problems.most_common()],
            "steps": steps,
        }


def usable_frames(columns: TopicColumns, row: Ints, stamp_ns: Ints, max_hz: float | None) -> Bools:
    """Return which messages (S,), in stamp order, have a usable image.

    With `max_hz`, only the first in each interval of 1 / max_hz seconds of the alignment clock.
    """
    problem = np.asarray(columns.fields[PROBLEM], object)[row]
    usable = np.asarray((problem == "") & (stamp_ns >= 0), np.bool_)
    if max_hz is not None:
        fine = np.flatnonzero(usable)
        bins = stamp_ns[fine] // max(round(NS / max_hz), 1)
        usable[fine[1:]] = bins[1:] != bins[:-1]
    return usable


BATCH_BYTES = 32 << 20  # a batch of rows is written once its images reach this size


@dataclass(frozen=True)
class KeptFrames:
    """The frames of one camera that are in force at some step: K of its N messages."""

    name: str
    frames: CameraFrames
    row: Ints  # (K,) index of each frame's message, ascending
    first: Ints  # (K,) first tick at which the frame is in force
    last: Ints  # (K,) last tick at which the frame is in force
    steps: int  # number of steps with a frame

    @classmethod
    def of(cls, name: str, frames: CameraFrames, ticks: Ints) -> KeptFrames:
        """Keep the frames in force at `ticks` (in any order), the steps that are in an episode."""
        ticks = np.unique(ticks)
        return cls(name, frames, *frames.in_force(ticks), int((frames.at_tick[ticks] >= 0).sum()))

    def manifest_row(self, recording: Recording, file: str) -> dict[str, Any]:
        """Return the counts of the camera's messages, as a row of `recordings.cameras`."""
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


def frame_rows(recording: Recording, kept: KeptFrames) -> Iterator[pa.RecordBatch]:
    """Yield batches of rows of `frame_schema`, each with about BATCH_BYTES of images.

    Frames are identified by log time and hash: messages that are equal in both are the same frame.
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
