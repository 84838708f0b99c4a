"""The interface between file formats and recordings, which every container implements.

This module also decompresses rosbag2's zstd (of a whole storage file or of each message), and turns
a topic's batches of payloads into columns and an account of losses. Only the wanted fields of a
batch are kept, and for wide fields (a scan's ranges) only the result of a `Reduction`, so that
memory does not grow with the size of a recording.
"""

from __future__ import annotations

import operator
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
import zstandard

from restock.errors import RecordingError, visible
from restock.ingest.decoding.columns import (
    Channel,
    FieldColumn,
    MessageBatch,
    PendingBatch,
    TopicColumns,
    join,
    own,
    take,
)
from restock.ingest.decoding.row_by_row import Decoded

Integrity = Literal["verified", "unverified", "damaged"]
Watch = Callable[[str, int, int], None]  # (activity, how much is done, total)

# Limits of the metadata that is kept from a file; the rest is only counted.
MAX_ENTRIES = 1_000
MAX_TEXT = 4_096  # characters of a name or value
MAX_CUSTOM_DATA = 64 << 10  # characters: the parser is slow
HEAD_BYTES = 64  # first bytes of a file, by which a container recognises it
LEROBOT_INFO, LEROBOT_DATA = "meta/info.json", "data/*/*.parquet"
NOT_KEPT = f"not text, longer than {MAX_TEXT:,} characters, or beyond entry {MAX_ENTRIES:,}"
# The key `custom_data` and its block. Only metadata.yaml indents the key, by two spaces.
_CUSTOM_DATA = re.compile(
    r"^(?P<indent> {0,4})custom_data:(?P<value>.*)(?P<block>(?:\n(?:(?P=indent) .*|[ \t]*$))*)",
    re.MULTILINE,
)


def no_progress(doing: str, done: int, whole: int) -> None:
    """Ignore progress: a `Watch` that does nothing."""


@dataclass
class Damage:
    """A part of a file that could not be read, and the number of messages lost, if known."""

    what: str
    messages: dict[int, int] = field(default_factory=dict)  # by channel id

    def __post_init__(self) -> None:
        self.what = visible(self.what)


@dataclass(frozen=True)
class Extra:
    """An attachment or metadata record of a file."""

    kind: Literal["attachment", "metadata"]
    name: str
    media_type: str
    size_bytes: int

    def __post_init__(self) -> None:
        for name in ("name", "media_type"):
            object.__setattr__(self, name, visible(getattr(self, name)))


class Metadata(NamedTuple):
    """Metadata of a whole recording, from its recorder or added later: name -> text."""

    source: str  # where it was found, for errors
    record: str  # name of the MCAP record; "" for the custom_data of a bag
    entries: Mapping[str, str]


def keep_entries(
    record: Mapping[str, str], kept: Collection[Metadata] = ()
) -> tuple[dict[str, str], int]:
    """Return the record's entries that fit the limits next to `kept`, and how many do not."""
    room = MAX_ENTRIES - sum(len(item.entries) for item in kept)
    short = {n: v for n, v in record.items() if len(n) <= MAX_TEXT and len(v) <= MAX_TEXT}
    entries = dict(list(short.items())[: max(room, 0)])
    return {visible(n): visible(v) for n, v in entries.items()}, len(record) - len(entries)


def custom_data(text: str, source: str, kept: Collection[Metadata] = ()) -> tuple[Metadata, int]:
    """Read rosbag2's `custom_data` from the text of a bag's metadata; `source` names its file.

    Also returns the number of entries left out: those that are not text, and those beyond the
    limits, which hold for `kept` and the new entries together.

    Raises:
        ValueError: it is too long, or not valid YAML.
    """
    record, not_text = _custom_data(text)
    entries, beyond = keep_entries(record, kept)
    return Metadata(f"custom_data in {source}", "", entries), not_text + beyond


def _custom_data(text: str) -> tuple[dict[str, str], int]:
    """Return the entries that are text, and the number of others.

    Only the lines of `custom_data` are parsed. Values stay as written: `007` is not read as 7.
    """
    found = _CUSTOM_DATA.search(text)
    if found is None:
        return {}, 0
    if found["value"].strip() in ("", "~", "null", "{}") and not found["block"].strip():
        return {}, 0
    lines = found[0]
    if len(lines) > MAX_CUSTOM_DATA:
        raise ValueError(f"custom_data has {len(lines):,} characters: not read")
    try:
        values = yaml_value(lines.strip(), "custom_data", kind="base")
    except ValueError as error:
        raise ValueError(f"custom_data cannot be used: {error}") from error
    if not isinstance(values, dict):
        return {}, 1
    entries = {n: v for n, v in values.items() if isinstance(n, str) and isinstance(v, str)}
    return {n: v for n, v in entries.items() if v != "~"}, len(values) - len(entries)


def yaml_value(text: str, key: str, *, kind: str = "safe") -> Any:
    """Parse a YAML document and return the value of a key.

    Raises:
        ValueError: it is not valid YAML, or has no such key.
    """
    from ruamel.yaml import YAML  # slow to import, and MCAP files do not need it
    from ruamel.yaml.error import YAMLError

    try:
        return YAML(typ=kind, pure=True).load(text)[key]
    except (  # the document is invalid, or the library does not expect it
        *(YAMLError, KeyError, IndexError, TypeError, ValueError, AttributeError, AssertionError),
        *(RecursionError, OverflowError, NotImplementedError),
    ) as error:
        why = (str(error).splitlines() or [type(error).__name__])[0]
        raise ValueError(visible(why[:200])) from error


class Storage(ABC):
    """An open file of messages.

    A subclass calls `__init__` and sets `channels`, `counts` (messages per channel id, by the
    container's own count) and `span_ns` (the first and last log time; None without messages).
    `damage` is complete once everything wanted has been read. `notes` tell the user about things
    that lose no data. `extras` lists attachments and metadata records; `metadata` has the entries
    that describe the whole recording.
    """

    channels: dict[int, Channel]
    counts: dict[int, int]
    span_ns: tuple[int, int] | None

    def __init__(self) -> None:
        self.damage: list[Damage] = []
        self.notes: list[str] = []
        self.extras: list[Extra] = []
        self.metadata: list[Metadata] = []

    @property
    def integrity(self) -> Integrity:
        """Return whether checksums confirm what was read so far; most formats have none."""
        return "damaged" if self.damage else "unverified"

    def damaged(self, what: str, messages: Mapping[int, int] | None = None) -> None:
        """Record damage unless it is recorded already; `messages`: lost ones by channel id."""
        if all(item.what != what for item in self.damage):
            self.damage.append(Damage(what, dict(messages or {})))

    @abstractmethod
    def batches(self, channels: Collection[int]) -> Iterator[tuple[int, MessageBatch]]:
        """Yield the messages of these channels, in file order within each channel."""

    @abstractmethod
    def close(self) -> None:
        """Close the file."""


class Opener(Protocol):
    """Opens one file of a container; with `salvage`, also a damaged one, as far as readable."""

    def __call__(self, path: Path, *, salvage: bool, watch: Watch) -> Storage: ...


@dataclass(frozen=True)
class Container:
    """A file format of recordings: a row of `containers.open_recording.CONTAINERS`."""

    name: str
    endings: tuple[str, ...]  # of its file names
    claims: Callable[[bytes], bool]  # whether these first `HEAD_BYTES` are of this format
    open: Opener
    format: str  # value of `format` in the store if a recording is one such file
    bag_format: str  # value of `format` in the store if it is a folder of such files
    # Only for a format that is a folder: yields its files; `claims` gets the start of the first.
    files: Callable[[Path], Iterator[Path]] | None = None


ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
MAX_MESSAGE = 1 << 30
PIECE = 32 << 20  # bytes of decompressed messages that are yielded at a time
BLOCK = 1 << 12  # bytes given to zstd at a time, which become 128 MiB at most
RATIO = 1000  # largest plausible ratio of compression: a larger one is an attack or an accident
CHUNK = 64 << 20  # decompressed bytes that any chunk may have, as so few do no harm
FILE = 256 << 20  # decompressed bytes that any file may have


def max_plausible_bytes(stored: int, at_least: int = CHUNK) -> int:
    """Return the most bytes to which `stored` compressed bytes may plausibly decompress."""
    return max(at_least, RATIO * stored)


def decompress_file(path: Path, target: Path, *, salvage: bool) -> str | None:
    """Decompress a storage file into `target`; return its damage, or None.

    Raises:
        RecordingError: it is damaged or cut short (unless `salvage`), or implausibly large.
    """
    limit = max_plausible_bytes(path.stat().st_size, FILE)
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


def decompress_batch(batch: MessageBatch) -> Iterator[tuple[MessageBatch, int]]:
    """Yield the batch with zstd payloads decompressed, and the number of damaged payloads.

    The batch comes in pieces of about PIECE bytes, as decompression may multiply its size.

    The first four bytes of a payload show whether it is compressed: CDR starts with two zeros, or
    with a zero and another small number.
    """
    if not _has_zstd(batch):
        yield batch, 0
        return
    payloads, good, size, bad = list[bytes](), list[int](), 0, 0
    for row in range(len(batch)):
        payload = batch.buffer[batch.start[row] : batch.stop[row]].tobytes()
        try:
            payloads.append(_decompress(payload))
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


def _decompress(payload: bytes) -> bytes:
    if not payload.startswith(ZSTD_MAGIC):
        return payload
    limit = min(max_plausible_bytes(len(payload)), MAX_MESSAGE)
    size = zstandard.frame_content_size(payload)
    if 0 <= size <= limit:
        return bytes(zstandard.ZstdDecompressor().decompress(payload, max_output_size=limit))
    if size >= 0:
        raise zstandard.ZstdError("implausibly large")
    # Its size is not given: decompress it block by block.
    decoder, parts, total = zstandard.ZstdDecompressor().decompressobj(), list[bytes](), 0
    for at in range(0, len(payload), BLOCK):
        parts.append(decoder.decompress(payload[at : at + BLOCK]))
        total += len(parts[-1])
        if total > limit:
            raise zstandard.ZstdError("implausibly large")
        if decoder.eof:
            return b"".join(parts)
    raise zstandard.ZstdError("cut short")


def _has_zstd(batch: MessageBatch) -> bool:
    long = batch.start[batch.stop - batch.start >= len(ZSTD_MAGIC)]
    long = long[batch.buffer[long] == ZSTD_MAGIC[0]]
    same = [batch.buffer[long + at] == byte for at, byte in enumerate(ZSTD_MAGIC)]
    return bool(np.logical_and.reduce(same).any())


SMALL_ROWS = 1024  # batches with fewer messages are joined, up to the next two limits
TOGETHER_ROWS = 4096
TOGETHER_BYTES = 4 << 20
LATEST_NS = 2**63 - 1
IMPLAUSIBLE = "logged at an implausible time, before 1970 or after 2262"

Fields = Mapping[str, FieldColumn]


@dataclass(frozen=True)
class TopicInfo:
    """Description of a topic before anything is read."""

    name: str
    type: str  # "nav_msgs/msg/Odometry"; "" if the container has none
    expected: int  # messages, by the container's own count
    encoding: str  # "cdr", "json", "protobuf", "ros1", …
    definition: str  # "embedded", a distribution's name, or "" if it cannot be decoded
    skipped: str | None  # why it cannot be decoded, or None


FAR_BACK_NS = 100_000_000  # if a topic's log time goes back further, the clock was set back


@dataclass
class Account:
    """Account of a topic's messages: expected = decoded + lost, always."""

    topic: str
    type: str
    expected: int  # by the container's own count
    read: int = 0  # payloads that came out of the container
    decoded: int = 0
    reasons: dict[str, int] = field(default_factory=dict)  # reason -> messages not decoded
    log_backsteps: int = 0  # messages with a log time before that of their predecessor

    @property
    def lost(self) -> int:
        """Return the number of messages that the container counts but that gave no row."""
        return max(self.expected - self.decoded, 0)


@dataclass(frozen=True)
class LostMessages:
    """Messages or bytes of a recording that could not be read, and why."""

    topic: str | None  # None: the file as a whole
    messages: int | None  # None: unknown
    reason: str


@dataclass(frozen=True)
class Reduction:
    """Fields of a topic that are read only to compute others from them, batch by batch.

    `apply` takes columns of N messages and returns columns of N rows. Each row depends on its own
    message alone, so it does not matter which messages are in a batch.
    """

    fields: tuple[str, ...]
    apply: Callable[[Fields], dict[str, FieldColumn]]


class TopicReading:
    """Collects the columns and the account of one topic."""

    def __init__(
        self, topic: TopicInfo, wanted: Iterable[str], reduction: Reduction | None = None
    ) -> None:
        self._account = Account(topic.name, topic.type, topic.expected)
        self._wanted, self._reduction = list(dict.fromkeys(wanted)), reduction
        self._log, self._publish = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
        self._fields: dict[str, list[FieldColumn]] = {}  # parts of each column, in file order
        self.decodable = False
        self.interleaved = False  # several channels in a file: batches are out of file order

    @property
    def paths(self) -> list[str]:
        """Return the fields to decode: the wanted ones, and the inputs of the reduction."""
        return list(dict.fromkeys([*self._wanted, *self._reduced]))

    @property
    def _reduced(self) -> tuple[str, ...]:
        return self._reduction.fields if self._reduction else ()

    def use(self, empty: Fields) -> None:
        """Create columns for the decoded fields, even if no message comes."""
        self.decodable = True
        for path, column in self._kept(empty).items():
            self._fields.setdefault(path, [column])

    def skip(self, reason: str, count: int) -> None:
        """Count messages that are not read at all."""
        self._add({reason: count})

    def take(self, decode: Callable[[MessageBatch], Decoded], batch: MessageBatch) -> None:
        """Decode a batch and keep its columns."""
        for plain, decoded in self.decoded(decode, batch):
            rows = decoded.rows
            log_ns, publish_ns = plain.log_time_ns[rows], plain.publish_time_ns[rows]
            self._log.append(log_ns)
            # Most recorders do not know when a message was sent: then both are one array.
            self._publish.append(log_ns if np.array_equal(log_ns, publish_ns) else publish_ns)
            for path, column in self._kept(decoded.fields).items():
                self._fields[path].append(own(column))

    def decoded(
        self, decode: Callable[[MessageBatch], Decoded], batch: MessageBatch
    ) -> Iterator[tuple[MessageBatch, Decoded]]:
        """Decode a batch; yield its messages and their columns in pieces, and count both."""
        account = self._account
        account.read += len(batch)
        for plain, damaged in decompress_batch(batch):
            if damaged:
                self._add({"its zstd data is damaged": damaged})
            sane = (plain.log_time_ns >= 0) & (plain.log_time_ns < LATEST_NS)
            if not sane.all():
                self._add({IMPLAUSIBLE: int((~sane).sum())})
                plain = plain.select(np.flatnonzero(sane))
            decoded = decode(plain)
            self._add(decoded.bad)
            account.decoded += len(decoded.rows)
            yield plain, decoded

    def _kept(self, fields: Fields) -> dict[str, FieldColumn]:
        kept = {path: fields[path] for path in self._wanted}
        if self._reduction:
            kept |= self._reduction.apply({path: fields[path] for path in self._reduced})
        return kept

    def _add(self, reasons: Mapping[str, int]) -> None:
        for reason, count in reasons.items():
            self._account.reasons[reason] = self._account.reasons.get(reason, 0) + count

    def close(self, lost: Mapping[str, int]) -> Account:
        """Add `lost` messages, and those that are counted but never came; return the account."""
        account = self._account
        self._add(lost)
        unexplained = account.expected - account.decoded - sum(account.reasons.values())
        if unexplained > 0:
            self._add({"counted by the container, but missing": unexplained})
        return account

    def columns(self) -> TopicColumns:
        """Return all columns in the order of log time."""
        log = np.concatenate(self._log)
        fields: dict[str, FieldColumn] = {}
        order, lap = None, None
        backsteps = int((log[1:] < log[:-1]).sum())
        self._account.log_backsteps = 0 if self.interleaved else backsteps
        if backsteps:
            order = np.argsort(log, kind="stable")
            set_back = np.diff(log, prepend=log[:1]) < -FAR_BACK_NS
            if set_back.any() and not self.interleaved:
                lap = np.cumsum(set_back, dtype=np.int64)[order]
            log = log[order]
        publish = log
        if not all(map(operator.is_, self._log[1:], self._publish[1:])):
            publish = np.concatenate(self._publish)
            publish = publish if order is None else publish[order]
        for path in list(self._fields):  # one by one, so that the parts are freed
            column = join(self._fields.pop(path))
            fields[path] = column if order is None else take(column, order)
        return TopicColumns(log, publish, fields, lap)


def join_small_batches(
    batches: Iterable[tuple[int, MessageBatch]],
) -> Iterator[tuple[int, MessageBatch]]:
    """Join small batches of a channel; its messages stay in order.

    Decoding has a cost per batch besides the cost per message, and a slow topic has only a handful
    of messages in 8 MiB of a recording.
    """
    pending: dict[int, PendingBatch] = {}
    for channel, batch in batches:
        if len(batch) < SMALL_ROWS and batch.size_bytes < TOGETHER_BYTES // 4:
            waiting = pending.setdefault(channel, PendingBatch())
            waiting.add(batch.payloads(), batch.log_time_ns, batch.publish_time_ns)
            if len(waiting) >= TOGETHER_ROWS or waiting.size_bytes >= TOGETHER_BYTES:
                yield channel, pending.pop(channel).batch()
            continue
        if channel in pending:
            yield channel, pending.pop(channel).batch()
        yield channel, batch
    for channel, waiting in pending.items():
        yield channel, waiting.batch()
