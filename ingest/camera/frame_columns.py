"""Camera topics as columns: what each message's image is, and not its bytes.

A recording's images do not fit into memory. As its topics are read, each frame becomes its layout
and the hash of its bytes; those that steps need are read again when they are written.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence

import numpy as np

from restock.ingest.camera.images import (
    COMPRESSED,
    ImageLayout,
    ImageProblem,
    compressed_layout,
    raw_layout,
)
from restock.ingest.containers.topic_reading import Fields, Reduction
from restock.ingest.decoding.columns import FieldColumn, Ragged
from restock.ingest.decoding.field_paths import DTYPES, Leaf

# Names of fields hold no space.
ENCODING, PROBLEM, SHA256 = "frame encoding", "frame problem", "frame sha256"
SIZE, WIDTH, HEIGHT = "frame size_bytes", "frame width", "frame height"
CHANNELS, BITS, ROW_BYTES = "frame channels", "frame bits", "frame row_bytes"
BIG_ENDIAN = "frame big_endian"
_NUMBERS = (SIZE, WIDTH, HEIGHT, CHANNELS, BITS, ROW_BYTES, BIG_ENDIAN)
_COMPRESSED_FIELDS = ("format", "data")
_RAW_FIELDS = ("encoding", "width", "height", "step", "is_bigendian", "data")


def image_fields(kind: str) -> tuple[str, ...]:
    """The field paths of a message of one of the two types."""
    return _COMPRESSED_FIELDS if kind == COMPRESSED else _RAW_FIELDS


def other_field(kind: str, leaves: Sequence[Leaf]) -> str | None:
    """The first field that a message of this type does not have as ROS defines it, by the
    definition that its file brings; None where it has all."""
    found = {leaf.path.removesuffix("[]"): leaf for leaf in leaves}
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
    """What makes the columns of a camera's messages of this type."""

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
            said = (one.width, one.height, one.channels, one.bits, one.row_bytes, one.big_endian)
            for name, value in zip(_NUMBERS[1:], said, strict=True):
                numbers[name][row] = value
        return {**numbers, ENCODING: encoding, PROBLEM: problem, SHA256: hashes}

    return Reduction(image_fields(kind), apply)


def image_bytes(fields: Fields) -> list[bytes]:
    """The bytes of each message's image."""
    column = fields["data"]
    assert isinstance(column, Ragged)
    view = np.ascontiguousarray(np.asarray(column.values, np.uint8)).data
    bounds = zip(column.offsets[:-1].tolist(), column.offsets[1:].tolist(), strict=True)
    return [bytes(view[start:stop]) for start, stop in bounds]


def layouts(kind: str, fields: Fields) -> Callable[[int, bytes], ImageLayout]:
    """What gives the layout of a message's image by its row and bytes, or raises ImageProblem."""
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
