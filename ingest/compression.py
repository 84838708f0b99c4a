"""rosbag2's own zstd: around a whole storage file, or around each message."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import zstandard

from restock.errors import RecordingError
from restock.ingest.columns import Batch
from restock.ingest.discover import ZSTD_MAGIC

# What decompresses to more than both is taken for an attack (or for an accident).
PLAUSIBLE_SIZE = 256 << 20
PLAUSIBLE_RATIO = 1000
LARGEST_MESSAGE = 1 << 30
BLOCK = 1 << 12  # bytes given to zstd at a time: at its most that makes 128 MiB of them


def decompress_file(path: Path, target: Path, *, salvage: bool) -> str | None:
    """Decompress a storage file into `target`; what is wrong with it, if it is to be salvaged.

    Raises:
        RecordingError: it is damaged, cut short, or decompresses to implausibly much.
    """
    limit = max(PLAUSIBLE_SIZE, PLAUSIBLE_RATIO * path.stat().st_size)
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


def decompress_messages(batch: Batch) -> tuple[Batch, int]:
    """The batch with zstd payloads decompressed, and how many could not be.

    Whether a payload is compressed shows in its first four bytes: CDR starts with two zeros, or
    a zero and another small number.
    """
    if not _any_zstd(batch):
        return batch, 0
    payloads, good = [], []
    decoder = zstandard.ZstdDecompressor()
    for row, payload in enumerate(batch.payloads()):
        if payload.startswith(ZSTD_MAGIC):
            try:
                if zstandard.frame_content_size(payload) > LARGEST_MESSAGE:
                    continue
                payload = decoder.decompress(payload, max_output_size=LARGEST_MESSAGE)
            except zstandard.ZstdError:
                continue
        payloads.append(payload)
        good.append(row)
    rows = np.asarray(good, np.intp)
    plain = Batch.of(payloads, batch.log_time_ns[rows], batch.publish_time_ns[rows])
    return plain, len(batch) - len(plain)


def _any_zstd(batch: Batch) -> bool:
    long = batch.start[batch.stop - batch.start >= len(ZSTD_MAGIC)]
    long = long[batch.buffer[long] == ZSTD_MAGIC[0]]
    same = [batch.buffer[long + at] == byte for at, byte in enumerate(ZSTD_MAGIC)]
    return bool(np.logical_and.reduce(same).any())
