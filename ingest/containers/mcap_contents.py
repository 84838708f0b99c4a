"""Finds the contents of an MCAP file in one walk: chunks, loose messages, channels and counts.

A loose message is one outside chunks. The summary at the file's end is used for counts, and its
schemas and channels are compared with the data's. In an intact file its offsets are not used: the
walk over the top-level records is cheap (a few records per chunk), and also finds everything if the
summary is wrong or missing. See https://mcap.dev/spec.

Beyond damage, reading resumes at chunks whose position can be proven (`resume`). If the summary is
intact, its chunk index gives the positions, and each chunk's record must agree with it. Otherwise a
compressed chunk is recognised by the name of its compression and two lengths that must agree. Its
CRC is checked when it is read, as always.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from restock.errors import visible
from restock.ingest.containers.chunks import FileBytes
from restock.ingest.containers.mcap_records import (
    HEAD_SIZE,
    MAGIC,
    PREFIX,
    Chunk,
    Definitions,
    Malformed,
    Op,
    parse,
    walk,
)
from restock.ingest.containers.storage import Extra, Metadata, Watch, keep_entries, no_progress

# Limits of what the survey keeps, whatever the file contains.
MAX_CHUNKS = 1_000_000
MAX_NAMED = 10_000  # attachments and metadata records; further ones are only counted
MAX_DAMAGED = 100
FOOTER_BYTES = 20  # footer's size; its last 4: CRC of all bytes from the summary's start up to them
TELL_EVERY = 65_536  # records between two calls of `watch`
ROSBAG2 = "rosbag2"  # name of the metadata record of rosbag2's storage
MAX_OTHERS = 1_000_000  # records whose kind is not in `_MANY`
_MANY = (Op.MESSAGE, Op.CHUNK, Op.MESSAGE_INDEX, Op.CHUNK_INDEX)


class Statistics(NamedTuple):
    """The numbers of messages that the file claims to contain."""

    messages: int
    by_channel: dict[int, int]


@dataclass
class Contents:
    """The contents of an MCAP file, as found by a walk over its top-level records."""

    chunks: list[Chunk] = field(default_factory=list)
    loose: dict[int, list[int]] = field(default_factory=dict)  # channel -> records outside chunks
    definitions: Definitions = field(default_factory=Definitions)  # outside chunks
    copies: Definitions = field(default_factory=Definitions)  # definitions repeated in the summary
    summary_proven: bool = False  # whether the summary's CRC matches
    statistics: Statistics | None = None
    data_end: tuple[int, int] = (0, 0)  # where the data section ends, and its CRC (0: unchecked)
    cut: Malformed | None = None  # where and why the walk ended early
    cut_chunk: Chunk | None = None  # the chunk at the cut, as far as the file has it
    resumed: bool = False  # whether reading went on beyond the cut, up to an intact summary
    damaged: list[str] = field(default_factory=list)  # records that could not be parsed
    extras: list[Extra] = field(default_factory=list)  # attachments and metadata records
    unnamed: int = 0  # number of further extras
    metadata: list[Metadata] = field(default_factory=list)
    left_out: int = 0  # number of metadata entries that are not kept
    rosbag2: str = ""  # the metadata.yaml that rosbag2 writes into a metadata record

    def indexed_counts(self) -> Counter[int]:
        """Count messages per channel as far as possible without reading chunks."""
        counts = Counter({channel: len(positions) for channel, positions in self.loose.items()})
        for chunk in self.chunks:
            counts.update(chunk.counts())
        return counts

    def claimed_counts(self) -> dict[int, int] | None:
        """Return messages per channel from the statistics; None if missing or incomplete."""
        if self.statistics is None or (self.cut is not None and not self.resumed):
            return None
        # Counts per channel are optional; the total is not.
        total, by_channel = self.statistics
        return by_channel if sum(by_channel.values()) == total else None

    def distrust_index(self) -> None:
        """Drop the message indexes, so that every chunk is walked."""
        # Do not copy chunks without an index: `cut_chunk`, which may be one, is found by identity.
        self.chunks = [replace(c, index={}) if c.index else c for c in self.chunks]


def survey(file: FileBytes, watch: Watch = no_progress, *, only: Collection[int] = ()) -> Contents:
    """Read the top-level records, or those with opcodes in `only`; report to `watch`."""
    contents = Contents()
    end = len(file)
    finished = False
    others = 0
    try:
        for number, (opcode, at, stop) in enumerate(walk(file, len(MAGIC), end)):
            if number % TELL_EVERY == 0:
                watch("looking through the file, bytes", at, end)
            others += opcode not in _MANY
            if others > MAX_OTHERS:
                raise Malformed(f"more than {MAX_OTHERS:,} records that hold no messages", at)
            if opcode == Op.FOOTER:
                finished = file[stop : stop + len(MAGIC)] == MAGIC
                contents.damaged += check_summary(contents, file, at, stop)
                break
            try:
                if not only or opcode in only:
                    take_record(contents, file, opcode, at, stop)
            except Malformed as bad:
                if len(contents.damaged) < MAX_DAMAGED:
                    contents.damaged.append(f"record at byte {at - PREFIX:,}: {bad.what}")
    except Malformed as cut:
        contents.cut = cut
    if not finished and contents.cut is None:
        contents.cut = Malformed("its footer is missing", end)
    if contents.cut is not None:
        if contents.chunks:  # the last whole chunk's index may be incomplete: drop it
            contents.chunks[-1] = replace(contents.chunks[-1], index={})
        contents.cut_chunk = cut_chunk_at(file, contents.cut.at, end)
    return contents


def take_record(contents: Contents, file: FileBytes, opcode: int, at: int, stop: int) -> None:
    """Add a top-level record to `contents`; the record's content is file[at:stop].

    Raises:
        Malformed: its fields reach beyond it.
    """
    if opcode == Op.MESSAGE and stop - at >= HEAD_SIZE - PREFIX:
        channel = int.from_bytes(file[at : at + 2], "little")
        contents.loose.setdefault(channel, []).append(at - PREFIX)
    elif opcode == Op.CHUNK:
        if len(contents.chunks) >= MAX_CHUNKS:
            raise Malformed(f"more than {MAX_CHUNKS:,} chunks: not read", at)
        contents.chunks.append(_parse_chunk(file, at, stop))
    elif opcode == Op.MESSAGE_INDEX and contents.chunks:
        index = parse(Op.MESSAGE_INDEX, file, at, stop)
        contents.chunks[-1].index[index["channel_id"]] = index["records"]
    elif opcode in (Op.SCHEMA, Op.CHANNEL):
        beyond = contents.data_end[0] > 0
        (contents.copies if beyond else contents.definitions).take(opcode, file, at, stop)
    elif opcode == Op.STATISTICS:
        contents.statistics = statistics_at(file, at, stop)
    elif opcode == Op.DATA_END:
        contents.data_end = at - PREFIX, parse(Op.DATA_END, file, at, stop)["data_section_crc"]
    elif opcode == Op.ATTACHMENT:
        attached = parse(Op.ATTACHMENT, file, at, stop)
        low, high = attached["data"]
        media = attached["media_type"]
        _add_extra(contents, Extra("attachment", attached["name"], media, high - low))
    elif opcode == Op.METADATA:
        named = parse(Op.METADATA, file, at, stop)
        _add_extra(contents, Extra("metadata", named["name"], "", stop - at))
        _add_metadata(contents, file.path.name, named["name"], named["metadata"])


def check_summary(contents: Contents, file: FileBytes, at: int, stop: int) -> list[str]:
    """Check the summary by the CRC in the footer, whose content is file[at:stop].

    If the CRC differs, drop the summary's definitions and statistics. Returns the problems.
    """
    if stop - at < FOOTER_BYTES:
        return ["its footer is too short"]
    footer = parse(Op.FOOTER, file, at, stop)
    if not footer["summary_crc"]:
        return []
    start = footer["summary_start"] or at - PREFIX
    if start < at and file.crc(start, at + FOOTER_BYTES - 4) == footer["summary_crc"]:
        contents.summary_proven = True
        return []
    contents.copies, contents.statistics = Definitions(), None
    return ["the CRC of its summary does not match: its data section is read without it"]


def statistics_at(file: FileBytes, at: int, stop: int) -> Statistics:
    """Read the statistics record whose content is file[at:stop]."""
    record = parse(Op.STATISTICS, file, at, stop)
    return Statistics(record["message_count"], record["channel_message_counts"])


def _add_extra(contents: Contents, extra: Extra) -> None:
    if len(contents.extras) < MAX_NAMED:
        contents.extras.append(extra)
    else:
        contents.unnamed += 1


def _add_metadata(contents: Contents, file: str, name: str, record: dict[str, str]) -> None:
    """Keep the entries of a metadata record.

    rosbag2 writes its metadata.yaml into such a record when it opens a file, and into another one
    when it closes the file: the last one is kept.
    """
    if name == ROSBAG2:
        contents.rosbag2 = record.get("serialized_metadata", "")
        return
    entries, left_out = keep_entries(record, contents.metadata)
    contents.left_out += left_out
    if entries:
        source = f"metadata record {visible(name)!r} of {file}"
        contents.metadata.append(Metadata(source, name, entries))


def _parse_chunk(file: FileBytes, at: int, stop: int) -> Chunk:
    record = parse(Op.CHUNK, file, at, stop)
    return Chunk(
        at,
        record["records"][0],
        record["records"][1],
        record["uncompressed_size"],
        record["uncompressed_crc"],
        record["compression"],
        (record["message_start_time"], record["message_end_time"]),
    )


def cut_chunk_at(file: FileBytes, at: int, end: int) -> Chunk | None:
    """Read the head of the chunk record at position `at`, whatever its length field is.

    The chunk's content is taken to stop at `end` at the latest. None if no chunk begins there, or
    `end` comes before its content.
    """
    if at < 0 or at + PREFIX + 40 > end or file[at] != Op.CHUNK:
        return None
    head = at + PREFIX
    start_ns, end_ns, size = (
        int.from_bytes(file[head + place : head + place + 8], "little") for place in (0, 8, 16)
    )
    crc = int.from_bytes(file[head + 24 : head + 28], "little")
    length = int.from_bytes(file[head + 28 : head + 32], "little")
    records = head + 32 + length + 8
    if records >= end:
        return None
    compression = file[head + 32 : head + 32 + length].decode("utf-8", "backslashreplace")
    stored = int.from_bytes(file[records - 8 : records], "little")
    stop = min(records + stored, end)
    return Chunk(at, records, stop, size, crc, compression, (start_ns, end_ns))


FOOTER_SIZE = PREFIX + FOOTER_BYTES
BEFORE_COMPRESSION = PREFIX + 28  # bytes of a chunk's record: prefix, times, size and CRC
_NAMES = (b"\x04\x00\x00\x00zstd", b"\x03\x00\x00\x00lz4")


def resume(file: FileBytes, contents: Contents) -> list[str]:
    """Add the contents after the position where the walk ended; return descriptions of the losses.

    If no later chunk can be proven, only the part before the damage is read, with the intact part
    of the truncated chunk.
    """
    cut = contents.cut
    if cut is None:
        return []
    summary = _read_summary(file)
    if summary is not None and summary.statistics is not None and summary.indexed:
        return _resume_by_index(file, contents, summary, cut.at)
    return _resume_by_scan(file, contents, cut.at)


class _Summary:
    """The records of the summary section."""

    def __init__(self) -> None:
        self.indexed: list[dict[str, Any]] = []  # chunk index records
        self.definitions: list[tuple[int, int, int]] = []  # opcode, start, stop
        self.statistics: Statistics | None = None
        self.start = 0
        self.proven = False  # whether the summary's CRC matches


def _read_summary(file: FileBytes) -> _Summary | None:
    """Read the summary section; None if it is damaged or missing."""
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


def _resume_by_index(file: FileBytes, contents: Contents, summary: _Summary, cut: int) -> list[str]:
    """Take the chunks whose records agree with the summary's chunk index; return the losses."""
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
    # Drop messages that the walk found outside chunks, but that lie in the damage or in a chunk.
    contents.loose = {
        channel: whole
        for channel, places in contents.loose.items()
        if (whole := [at for at in places if at < cut and not _in_a_chunk(at, contents.chunks)])
    }
    contents.cut_chunk = None
    contents.resumed = True
    return lost


def _in_a_chunk(at: int, chunks: list[Chunk]) -> bool:
    return any(chunk.at <= at < chunk.stop for chunk in chunks)


def _resume_by_scan(file: FileBytes, contents: Contents, cut: int) -> list[str]:
    """Continue at each recognisable chunk, and walk to the next damage; return the losses."""
    lost = []
    for at in _find_chunks(file, cut + 1):
        if at < cut:
            continue  # already walked
        if contents.cut_chunk is not None:  # the cut chunk cannot reach beyond `at`
            contents.cut_chunk = cut_chunk_at(file, contents.cut_chunk.at, at)
        lost.append(f"{_describe_loss(contents, cut, at)}: reading continues at the next chunk")
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
    return [*lost, _describe_loss(contents, cut, len(file))] if cut < len(file) else lost


def _describe_loss(contents: Contents, cut: int, until: int) -> str:
    """Describe what is lost between the positions `cut` and `until`.

    A chunk that begins at `cut` is read as far as possible.
    """
    at = f"{until - cut:,} bytes from byte {cut:,} on"
    if contents.cut_chunk is None or contents.cut_chunk.at != cut:
        return f"{at} are lost"
    return f"{at} are part of a chunk: only its complete messages are read"


def _find_chunks(file: FileBytes, start: int) -> Iterator[int]:
    """Yield the positions of compressed chunks, recognised by two lengths that agree."""
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
