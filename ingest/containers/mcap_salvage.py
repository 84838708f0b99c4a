"""Beyond the damage in an MCAP file: chunks whose place can be proven are read again.

Where the summary at the file's end is whole, its chunk index gives the places of chunks; a chunk's
record must agree. Without one, a compressed chunk is recognised by the name of its
compression and two lengths that must agree. Its CRC is checked when it is read, as always.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from restock.ingest.containers.formats.mcap_chunk import Chunk
from restock.ingest.containers.formats.mcap_records import (
    MAGIC,
    PREFIX,
    FileBytes,
    Malformed,
    Op,
    parse,
    walk,
)
from restock.ingest.containers.mcap_contents import (
    FOOTER_BYTES,
    Contents,
    Statistics,
    check_summary,
    cut_chunk_at,
    statistics_at,
    take_record,
)

FOOTER_SIZE = PREFIX + FOOTER_BYTES
BEFORE_COMPRESSION = PREFIX + 28  # of a chunk's record: times, size, CRC
_NAMES = (b"\x04\x00\x00\x00zstd", b"\x03\x00\x00\x00lz4")


def resume(file: FileBytes, contents: Contents) -> list[str]:
    """Add what lies beyond the place where the walk ended; what is lost, in words.

    Where nothing can be proven, the file is read up to the damage, and what there is of the
    chunk that was cut.
    """
    cut = contents.cut
    if cut is None:
        return []
    summary = _summary(file)
    if summary is not None and summary.statistics is not None and summary.indexed:
        return _by_index(file, contents, summary, cut.at)
    return _by_scan(file, contents, cut.at)


class _Summary:
    """The records of the summary section."""

    def __init__(self) -> None:
        self.indexed: list[dict[str, Any]] = []  # chunk index records
        self.definitions: list[tuple[int, int, int]] = []  # schemas, channels: opcode, start, stop
        self.statistics: Statistics | None = None
        self.start = 0
        self.proven = False  # by its CRC


def _summary(file: FileBytes) -> _Summary | None:
    """The summary section, if it is whole."""
    end = len(file) - len(MAGIC)
    at = end - FOOTER_SIZE
    if at < len(MAGIC) or file[end:] != MAGIC or file[at] != Op.FOOTER:
        return None
    footer = parse(Op.FOOTER, file, at + PREFIX, end)
    summary = _Summary()
    summary.start = footer["summary_start"]
    if not len(MAGIC) <= summary.start <= at:
        return None
    if footer["summary_crc"]:
        if file.crc(summary.start, end - 4) != footer["summary_crc"]:
            return None
        summary.proven = True
    try:
        for opcode, start, stop in walk(file, summary.start, at):
            if opcode == Op.CHUNK_INDEX:
                summary.indexed.append(parse(Op.CHUNK_INDEX, file, start, stop))
            elif opcode == Op.STATISTICS:
                summary.statistics = statistics_at(file, start, stop)
            elif opcode in (Op.SCHEMA, Op.CHANNEL):
                summary.definitions.append((opcode, start, stop))
    except Malformed:
        return None
    return summary


def _by_index(file: FileBytes, contents: Contents, summary: _Summary, cut: int) -> list[str]:
    """The chunks are those of the chunk index whose records agree with it."""
    lost = []
    chunks = []
    for record in summary.indexed:
        at = record["chunk_start_offset"]
        chunk = cut_chunk_at(file, at, min(at + record["chunk_length"], summary.start))
        if (
            chunk is None
            or (chunk.size, chunk.compression)
            != (record["uncompressed_size"], record["compression"])
            or chunk.stop - chunk.start != record["compressed_size"]
        ):
            lost.append(f"chunk at byte {at:,} is lost: its record is damaged")
        else:
            chunks.append(chunk)
    contents.chunks = sorted(chunks, key=lambda chunk: chunk.at)
    for opcode, start, stop in summary.definitions:
        contents.copies.take(opcode, file, start, stop)
    contents.statistics, contents.summary_proven = summary.statistics, summary.proven
    # What the walk took for messages outside chunks, but lies within the damage, is dropped.
    contents.loose = {
        channel: whole
        for channel, places in contents.loose.items()
        if (whole := [at for at in places if at < cut and not _within(at, contents.chunks)])
    }
    contents.cut_chunk = None
    contents.resumed = True
    return lost


def _within(at: int, chunks: list[Chunk]) -> bool:
    return any(chunk.at <= at < chunk.stop for chunk in chunks)


def _by_scan(file: FileBytes, contents: Contents, cut: int) -> list[str]:
    """Go on at each next chunk that can be recognised, walking from it to the next damage."""
    lost = []
    for at in _recognised(file, cut + 1):
        if at < cut:
            continue  # within what was walked since
        if contents.cut_chunk is not None:  # it ends where the next begins, at the latest
            contents.cut_chunk = cut_chunk_at(file, contents.cut_chunk.at, at)
        lost.append(f"{_lost(contents, cut, at)}: reading goes on at the next chunk")
        if contents.cut_chunk is not None:
            contents.chunks.append(contents.cut_chunk)
            contents.cut_chunk = None
        try:
            for opcode, start, stop in walk(file, at, len(file)):
                cut = stop
                if opcode == Op.FOOTER:
                    lost += check_summary(contents, file, start, stop)
                    contents.resumed = contents.statistics is not None
                    return lost
                take_record(contents, file, opcode, start, stop)
        except Malformed as next_cut:
            cut = next_cut.at
            contents.cut_chunk = cut_chunk_at(file, cut, len(file))
    return [*lost, _lost(contents, cut, len(file))] if cut < len(file) else lost


def _lost(contents: Contents, cut: int, until: int) -> str:
    """What is lost between two places, in words; a chunk that begins at the first is read as far
    as it goes."""
    at = f"{until - cut:,} bytes from byte {cut:,} on"
    if contents.cut_chunk is None or contents.cut_chunk.at != cut:
        return f"{at} are lost"
    return f"{at} are a part of a chunk: only the messages that are whole in it are read"


def _recognised(file: FileBytes, start: int) -> Iterator[int]:
    """Where chunks with a compression by name are, by two lengths that agree."""
    nearest = {name: file.find(name, start) for name in _NAMES}
    while places := {at: name for name, at in nearest.items() if at >= 0}:
        place = min(places)
        name = places[place]
        nearest[name] = file.find(name, place + 1)
        at = place - BEFORE_COMPRESSION
        if at < start or file[at] != Op.CHUNK:
            continue
        length = int.from_bytes(file[at + 1 : at + PREFIX], "little")
        inner = place + len(name)
        stored = int.from_bytes(file[inner : inner + 8], "little")
        if inner + 8 + stored == at + PREFIX + length <= len(file):
            yield at
