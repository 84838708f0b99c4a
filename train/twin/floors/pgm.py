"""Greymaps (PGM, netpbm's P2 and P5), as occupancy maps have them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from restock.errors import ConfigError

MAX_PIXELS = 64_000_000
_SPACE = re.compile(rb"(?:\s|#[^\r\n]*[\r\n])*")
_TOKEN = re.compile(rb"[^\s#]+")


def read_pgm(path: Path) -> NDArray[np.float64]:
    """Pixels (H, W) in [0, 1], the first row on top.

    Raises:
        ConfigError: no such file, no PGM, or one that is cut short or absurdly large.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError(
            f"cannot be read: {error.strerror}",
            where=str(path),
            remedy="image in map.yaml is a path beside it",
        ) from error
    if data[:2] not in (b"P2", b"P5"):
        raise ConfigError(
            f"is no PGM: it begins with {data[:2]!r}",
            where=str(path),
            remedy="convert it, such as with `convert map.png map.pgm`",
        )
    place, header = 2, []
    for name in ("width", "height", "largest value"):
        number, place = _number(data, place, name, path)
        header.append(number)
    width, height, largest = header
    if not (width > 0 and height > 0 and width * height <= MAX_PIXELS and 0 < largest < 65536):
        raise ConfigError(
            f"its header says {width} x {height} pixels of 0 to {largest}",
            where=str(path),
            remedy=f"at most {MAX_PIXELS:,} pixels of 0 to 65535",
        )
    count = width * height
    if data[:2] == b"P5":
        kind = np.dtype(np.uint8 if largest < 256 else ">u2")
        body = data[place + 1 : place + 1 + count * kind.itemsize]
        values = np.frombuffer(body[: len(body) // kind.itemsize * kind.itemsize], kind)
    else:
        text = re.sub(rb"#[^\r\n]*", b"", data[place:])
        try:
            values = np.array(text.split()[:count], np.int64)
        except ValueError as error:
            raise ConfigError("has a pixel that is no number", where=str(path)) from error
    if len(values) < count:
        raise ConfigError(f"is cut short: {len(values):,} of {count:,} pixels", where=str(path))
    if values.max() > largest or values.min() < 0:
        raise ConfigError(f"has a pixel outside 0 to {largest}", where=str(path))
    shares: NDArray[np.float64] = values.astype(np.float64) / largest
    return shares.reshape(height, width)


def _number(data: bytes, place: int, name: str, path: Path) -> tuple[int, int]:
    skipped = _SPACE.match(data, place)
    found = _TOKEN.match(data, skipped.end() if skipped else place)
    if found is None or not found[0].isdigit() or len(found[0]) > 9:
        raise ConfigError(f"its header has no {name}", where=str(path))
    return int(found[0]), found.end()


def write_pgm(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Write pixels (H, W) as P5."""
    height, width = pixels.shape
    path.write_bytes(b"P5\n%d %d\n255\n" % (width, height) + pixels.tobytes())
