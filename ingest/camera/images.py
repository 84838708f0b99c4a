"""Images as messages hold them: what their bytes claim, whether they are whole, and pixels of them.

Nothing is decoded to see whether a frame can be kept: the headers of JPEG and PNG say its size, and
their ends whether the file was cut. `pixels` decodes, and is called when somebody looks.
"""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

COMPRESSED, RAW = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image"
TYPES = (COMPRESSED, RAW)
MAX_PIXELS = 100_000_000  # of a frame: more is no camera's
JPEG, PNG = "jpeg", "png"
# Of raw images: type, channels, and the order in which they are red, green, blue (and alpha).
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
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}  # a palette's colours are three
_PLAIN_MODES = {"P": "RGB", "CMYK": "RGB", "YCbCr": "RGB", "LA": "RGBA", "1": "L"}
_JPEG_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # markers that begin a frame's header


class ImageProblem(ValueError):
    """Why a message holds no image that can be kept; the same words for messages alike."""


@dataclass(frozen=True)
class ImageLayout:
    """Size and format of an image, as needed to read its bytes."""

    encoding: str  # jpeg, png, or one of ENCODINGS
    width: int
    height: int
    channels: int
    bits: int  # of a channel
    row_bytes: int = 0  # of raw images
    big_endian: bool = False


def compressed_layout(data: bytes, said: str) -> ImageLayout:
    """Read the layout of a JPEG or PNG file from its header; `said` is the message's format.

    Raises:
        ImageProblem: it is neither, its header is damaged, or its end is missing.
    """
    if data.startswith(b"\xff\xd8"):
        layout = _jpeg(data)
    elif data.startswith(_PNG_SIGNATURE):
        layout = _png(data)
    elif not data:
        raise ImageProblem("no bytes")
    else:
        raise ImageProblem(f"neither JPEG nor PNG (its format says {said[:60]!r})")
    _bound(layout)
    return layout


def raw_layout(
    size_bytes: int, encoding: str, width: int, height: int, row_bytes: int, big_endian: bool
) -> ImageLayout:
    """Build the layout of a raw image from the fields of its message.

    Raises:
        ImageProblem: an unknown encoding, or bytes that are not as many as the rest says.
    """
    if encoding not in ENCODINGS:
        raise ImageProblem(f"unknown encoding {encoding[:60]!r}")
    kind, channels, _ = ENCODINGS[encoding]
    bits = np.dtype(kind).itemsize * 8
    layout = ImageLayout(encoding, width, height, channels, bits, row_bytes, big_endian)
    _bound(layout)
    if row_bytes < width * channels * bits // 8:
        raise ImageProblem("rows shorter than their width")
    if size_bytes < row_bytes * height:
        raise ImageProblem("cut short: fewer bytes than its rows have")
    return layout


def pixels(data: bytes, layout: ImageLayout) -> NDArray[np.generic]:
    """Decode: (H, W) or (H, W, C) of red, green, blue (and alpha), uint8, uint16 or float32.

    Raises:
        ImageProblem: the bytes are damaged, or not of this layout.
    """
    if layout.encoding in (JPEG, PNG):
        return _decoded(data, layout)
    kind, channels, order = ENCODINGS[layout.encoding]
    size = layout.row_bytes * layout.height
    if len(data) < size:
        raise ImageProblem("cut short: fewer bytes than its rows have")
    rows = np.frombuffer(data, np.uint8, size).reshape(layout.height, layout.row_bytes)
    wide = np.ascontiguousarray(rows[:, : layout.width * channels * layout.bits // 8])
    values = wide.view(np.dtype(kind).newbyteorder(">" if layout.big_endian else "<"))
    image = values.astype(kind).reshape(layout.height, layout.width, channels)
    return image[:, :, 0] if channels == 1 else np.ascontiguousarray(image[:, :, list(order)])


def _decoded(data: bytes, layout: ImageLayout) -> NDArray[np.generic]:
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


def _bound(layout: ImageLayout) -> None:
    if layout.width < 1 or layout.height < 1:
        raise ImageProblem("no pixels")
    if layout.width * layout.height > MAX_PIXELS:
        raise ImageProblem(f"claims more than {MAX_PIXELS:,} pixels")


def _jpeg(data: bytes) -> ImageLayout:
    """Read the layout of a JPEG from the markers before its scan."""
    if data[-4096:].rstrip(b"\x00")[-2:] != b"\xff\xd9":  # some cameras pad with zeros
        raise ImageProblem("truncated JPEG: its end is missing")
    at = 2
    while at + 9 < len(data):
        if data[at] != 0xFF:
            break
        marker = data[at + 1]
        if marker == 0xFF or marker == 0x01 or 0xD0 <= marker <= 0xD8:  # no length follows
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
