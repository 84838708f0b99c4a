"""How a panel is kept from changing unseen: read-only files, sizes, checksums, a sealed header.

Opening a panel always checks the header's seal, and of every file its size and a sample of its
blocks, which costs a few milliseconds whatever its size. Checking every byte is `verify`. The
checksum of a file is the BLAKE3 of the BLAKE3s of its leaves, stretches of equal length: so they
are hashed as they are written, in any order, and by several threads.
"""

from __future__ import annotations

import hashlib
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from blake3 import blake3

from restock.errors import PanelError

AGAIN = "make it again with `restock mix`"
SAMPLED_BLOCKS, BLOCK_BYTES = 16, 4096
DIGEST_BYTES = 16
LEAF_BYTES = 1 << 20
MAX_THREADS = 8


class FileRecord(msgspec.Struct, frozen=True):
    """Size and checksums of one file, when it was written."""

    bytes: int
    blake3: str  # of all of it, by leaves
    sample: str  # of some blocks of it
    leaf_bytes: int  # of each leaf

    @classmethod
    def of(cls, path: Path) -> FileRecord:
        """Return the record of a file as it is now."""
        size = path.stat().st_size
        return cls(size, checksum(path, LEAF_BYTES), sample_checksum(path), LEAF_BYTES)

    def check(self, path: Path, *, verify: bool) -> None:
        """Raise PanelError where the file is not as it was written."""
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
            actual, expected = checksum(path, self.leaf_bytes), self.blake3
        if actual != expected:
            raise PanelError(
                f"its checksum is {actual}, not {expected}: it was changed or damaged",
                where=str(path),
                remedy=AGAIN,
            )


class Leaves:
    """The leaves of a file's checksum, hashed in any order, by several threads.

    Args:
        size: bytes of the file.
        leaf_bytes: of each leaf; the last has the rest.
    """

    def __init__(self, size: int, leaf_bytes: int) -> None:
        self._leaf_bytes = leaf_bytes
        self.count = max(-(-size // leaf_bytes), 1)
        self._digests = [b""] * self.count

    def add(self, number: int, content: bytes | memoryview) -> None:
        """Hash the content of one leaf."""
        self._digests[number] = blake3(content).digest(DIGEST_BYTES)

    def root(self) -> str:
        """Return the checksum, 32 hex digits, of leaves that were all added."""
        return blake3(b"".join(self._digests)).hexdigest(DIGEST_BYTES)

    def record(self, path: Path) -> FileRecord:
        """Return the record of a file whose leaves were all added."""
        size, sample = path.stat().st_size, sample_checksum(path)
        return FileRecord(size, self.root(), sample, self._leaf_bytes)


def checksum(path: Path, leaf_bytes: int) -> str:
    """Compute the BLAKE3 of a file from its leaves of `leaf_bytes`, 32 hex digits."""
    leaves = Leaves(path.stat().st_size, leaf_bytes)
    descriptor = os.open(path, os.O_RDONLY)

    threads = min(os.cpu_count() or 1, MAX_THREADS)

    def add_from(first: int) -> None:
        for number in range(first, leaves.count, threads):
            # Short where the file was cut meanwhile: then the checksum is another.
            leaves.add(number, os.pread(descriptor, leaf_bytes, number * leaf_bytes))

    try:
        with ThreadPoolExecutor(threads, "restock-checksum") as pool:
            list(pool.map(add_from, range(threads)))
    finally:
        os.close(descriptor)
    return leaves.root()


def sample_checksum(path: Path) -> str:
    """blake2b of blocks spread evenly over a file, its first and last among them, 32 hex digits."""
    digest = hashlib.blake2b(digest_size=DIGEST_BYTES)
    room = max(path.stat().st_size - BLOCK_BYTES, 0)
    with path.open("rb") as file:
        for block in range(SAMPLED_BLOCKS):
            file.seek(room * block // (SAMPLED_BLOCKS - 1))
            digest.update(file.read(BLOCK_BYTES))
    return digest.hexdigest()


T = TypeVar("T", bound=msgspec.Struct)


def seal(header: msgspec.Struct) -> bytes:
    """Return a header as indented JSON, with a checksum over its values."""
    values = msgspec.to_builtins(header)
    return msgspec.json.format(msgspec.json.encode(values | {"seal": _seal_of(values)}), indent=1)


class _Version(msgspec.Struct):
    packing_version: int | None = None


def packed_by(content: bytes) -> int | None:
    """Return the version of the packing that a header names; None where there is none to read."""
    try:
        return msgspec.json.decode(content, type=_Version).packing_version
    except (msgspec.DecodeError, ValueError):
        return None


def unseal(content: bytes, kind: type[T], where: Path) -> T:
    """Return what `seal` was given. Raises PanelError for what is no such header, or was edited."""
    try:
        values = msgspec.json.decode(content, type=dict[str, Any])
        given_seal = values.pop("seal", None)
        header = msgspec.convert(values, kind)
    except (msgspec.DecodeError, ValueError) as error:
        raise PanelError(
            f"its header is damaged, or of another version of Restock: {error}",
            where=str(where),
            remedy=AGAIN,
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
