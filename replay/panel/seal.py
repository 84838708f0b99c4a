"""How a panel is kept from changing unseen: read-only files, sizes, checksums, a sealed header.

Opening a panel always checks the header's seal, and of every file its size and a sample of its
blocks, which costs a few milliseconds whatever its size. Checking every byte is `verify`.
"""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from restock.errors import PanelError

AGAIN = "make it again with `restock mix`"
SAMPLED_BLOCKS, BLOCK_BYTES = 16, 4096


class FileRecord(msgspec.Struct, frozen=True):
    """Size and checksums of one file, when it was written."""

    bytes: int
    blake2b: str  # of all of it
    sample: str  # of some blocks of it

    @classmethod
    def of(cls, path: Path) -> FileRecord:
        return cls(path.stat().st_size, checksum(path), sample_checksum(path))

    def check(self, path: Path, *, verify: bool) -> None:
        """Raises PanelError where the file is not as it was written."""
        if sys.byteorder != "little":
            raise PanelError("panels need a little-endian machine", where=str(path))
        if not path.is_file():
            raise PanelError("this file of the panel is missing", where=str(path), remedy=AGAIN)
        size = path.stat().st_size
        if size != self.bytes:
            raise PanelError(
                f"it has {size} bytes, not the {self.bytes} that were written",
                where=str(path),
                remedy=AGAIN,
            )
        actual, expected = sample_checksum(path), self.sample
        if verify and actual == expected:
            actual, expected = checksum(path), self.blake2b
        if actual != expected:
            raise PanelError(
                f"its checksum is {actual}, not {expected}: it was changed or damaged",
                where=str(path),
                remedy=AGAIN,
            )


def checksum(path: Path) -> str:
    """blake2b of a file's content, 32 hex digits."""
    digest = hashlib.blake2b(digest_size=16)
    with path.open("rb") as file:
        while chunk := file.read(1 << 20):
            digest.update(chunk)
    return digest.hexdigest()


def sample_checksum(path: Path) -> str:
    """blake2b of blocks spread evenly over a file, its first and last among them, 32 hex digits."""
    digest = hashlib.blake2b(digest_size=16)
    room = max(path.stat().st_size - BLOCK_BYTES, 0)
    with path.open("rb") as file:
        for block in range(SAMPLED_BLOCKS):
            file.seek(room * block // (SAMPLED_BLOCKS - 1))
            digest.update(file.read(BLOCK_BYTES))
    return digest.hexdigest()


T = TypeVar("T", bound=msgspec.Struct)


def seal(header: msgspec.Struct) -> bytes:
    """A header as indented JSON, with a checksum over its values."""
    values = msgspec.to_builtins(header)
    return msgspec.json.format(msgspec.json.encode(values | {"seal": _seal_of(values)}), indent=1)


class _Version(msgspec.Struct):
    packing_version: int | None = None


def packed_by(content: bytes) -> int | None:
    """The version of the packing that a header names; None where there is none to read."""
    try:
        return msgspec.json.decode(content, type=_Version).packing_version
    except (msgspec.DecodeError, ValueError):
        return None


def unseal(content: bytes, kind: type[T], where: Path) -> T:
    """What `seal` was given. Raises PanelError for what is no such header, or was edited."""
    try:
        values = msgspec.json.decode(content, type=dict[str, Any])
        given_seal = values.pop("seal", None)
        header = msgspec.convert(values, kind)
    except (msgspec.DecodeError, ValueError) as error:
        raise PanelError(
            f"its header cannot be read: {error}", where=str(where), remedy=AGAIN
        ) from error
    if given_seal != _seal_of(values):
        raise PanelError(
            "its header was changed after it was written",
            where=str(where),
            remedy="a panel never changes: mix another from a changed mixture",
        )
    return header


def _seal_of(values: dict[str, Any]) -> str:
    encoded = msgspec.json.encode(values, order="sorted")
    return hashlib.blake2b(encoded, digest_size=16).hexdigest()
