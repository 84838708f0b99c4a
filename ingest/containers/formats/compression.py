"""rosbag2's own zstd: around a whole storage file, or around each message."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import zstandard

from restock.errors import RecordingError
from restock.ingest.decoding.messages import MessageBatch

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
MAX_MESSAGE = 1 << 30
PIECE = 32 << 20  # of messages decompressed at a time
BLOCK = 1 << 12  # bytes given to zstd at a time: at its most that makes 128 MiB of them
RATIO = 1000  # bytes that a stored one may hold: what claims more is an attack, or an accident
CHUNK = 64 << 20  # of a few bytes: as much is nothing to fear
FILE = 256 << 20


def most_bytes(stored: int, at_least: int = CHUNK) -> int:
    """Return the largest plausible size of `stored` compressed bytes."""
    return max(at_least, RATIO * stored)


def decompress_file(path: Path, target: Path, *, salvage: bool) -> str | None:
    """Decompress a storage file into `target`; what is wrong with it, if it is to be salvaged.

    Raises:
        RecordingError: it is damaged, cut short, or decompresses to implausibly much.
    """
    limit = most_bytes(path.stat().st_size, FILE)
    size = 0
    problem = None
    with path.open("rb") as source, target.open("wb") as sink:
        decoder = zstandard.ZstdDecompressor().decompressobj()
        while block := source.read(BLOCK):
            try:
                part = decoder.decompress(block)
            except zstandard.ZstdError as error:
                problem = f"its zstd data is damaged ({error})"
                break
            size += len(part)
            if size > limit:
                raise RecordingError(
                    f"decompresses to more than {limit:,} bytes: refused", where=str(path)
                )
            sink.write(part)
            if decoder.eof:
                break
    if problem is None and not decoder.eof:
        problem = "cut short: its zstd data ends early"
    if problem and not salvage:
        raise RecordingError(
            problem, where=str(path), remedy="`--salvage` reads what can still be read of it"
        )
    return problem


def decompressed(batch: MessageBatch) -> Iterator[tuple[MessageBatch, int]]:
    """Yield the batch with zstd payloads decompressed, and how many could not be.

    It comes in pieces of about PIECE bytes, as it may hold many times more than the batch.

    Whether a payload is compressed shows in its first four bytes: CDR starts with two zeros, or
    a zero and another small number.
    """
    if not _any_zstd(batch):
        yield batch, 0
        return
    payloads, good, size, bad = list[bytes](), list[int](), 0, 0
    for row in range(len(batch)):
        payload = batch.buffer[batch.start[row] : batch.stop[row]].tobytes()
        try:
            payloads.append(_plain(payload))
            good.append(row)
            size += len(payloads[-1])
        except zstandard.ZstdError:
            bad += 1
        if size >= PIECE:
            yield _piece(batch, payloads, good), bad
            payloads, good, size, bad = [], [], 0, 0
    yield _piece(batch, payloads, good), bad


def _piece(batch: MessageBatch, payloads: list[bytes], good: list[int]) -> MessageBatch:
    rows = np.asarray(good, np.intp)
    return MessageBatch.of(payloads, batch.log_time_ns[rows], batch.publish_time_ns[rows])


def _plain(payload: bytes) -> bytes:
    if not payload.startswith(ZSTD_MAGIC):
        return payload
    limit = min(most_bytes(len(payload)), MAX_MESSAGE)
    size = zstandard.frame_content_size(payload)
    if 0 <= size <= limit:
        return bytes(zstandard.ZstdDecompressor().decompress(payload, max_output_size=limit))
    if size >= 0:
        raise zstandard.ZstdError("implausibly large")
    # Its size is not given: nothing is allocated for it.
    decoder, parts, total = zstandard.ZstdDecompressor().decompressobj(), list[bytes](), 0
    for at in range(0, len(payload), BLOCK):
        parts.append(decoder.decompress(payload[at : at + BLOCK]))
        total += len(parts[-1])
        if total > limit:
            raise zstandard.ZstdError("implausibly large")
        if decoder.eof:
            return b"".join(parts)
    raise zstandard.ZstdError("cut short")


def _any_zstd(batch: MessageBatch) -> bool:
    long = batch.start[batch.stop - batch.start >= len(ZSTD_MAGIC)]
    long = long[batch.buffer[long] == ZSTD_MAGIC[0]]
    same = [batch.buffer[long + at] == byte for at, byte in enumerate(ZSTD_MAGIC)]
    return bool(np.logical_and.reduce(same).any())
