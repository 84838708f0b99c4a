"""Reading of one topic: batches of payloads in, columns out, and an account of losses.

Of a batch only the wanted fields stay, and of wide ones (a scan's ranges) only what a `Reduction`
makes of them: what is in memory does not grow with a recording's bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from restock.arrays import Ints
from restock.ingest.containers.storage import decompressed
from restock.ingest.decoding.columns import (
    FieldColumn,
    GrowingArray,
    GrowingRagged,
    MessageBatch,
    PendingBatch,
    TopicColumns,
    growing,
    take,
)
from restock.ingest.decoding.row_by_row import Decoded

SMALL_ROWS = 1024  # batches of fewer messages are put together, up to
TOGETHER_ROWS = 4096
TOGETHER_BYTES = 4 << 20
LATEST_NS = 2**63 - 1
IMPLAUSIBLE = "logged at an implausible time, before 1970 or after 2262"

Fields = Mapping[str, FieldColumn]


@dataclass(frozen=True)
class TopicInfo:
    """Description of a topic before anything is read."""

    name: str
    type: str  # "nav_msgs/msg/Odometry"; "" where the container names none
    expected: int  # messages, by the container's own count
    encoding: str  # "cdr", "json", "protobuf", "ros1", …
    definition: str  # "embedded", a distribution's name, or "" where it cannot be decoded
    skipped: str | None  # why it cannot be decoded, or None


FAR_BACK_NS = 100_000_000  # between two messages of a topic, as they lie in the file


@dataclass
class Account:
    """Account of a topic's messages: expected = decoded + lost, always."""

    topic: str
    type: str
    expected: int  # by the container's own count
    read: int = 0  # payloads that came out of the container
    decoded: int = 0
    reasons: dict[str, int] = field(default_factory=dict)  # why the rest were not decoded
    log_backsteps: int = 0  # messages logged before the one that lies before them in the file

    @property
    def lost(self) -> int:
        """Count messages that the container counts and that gave no row."""
        return max(self.expected - self.decoded, 0)


@dataclass(frozen=True)
class LostMessages:
    """Messages or bytes of a recording that could not be read, and why."""

    topic: str | None  # None: of the file as a whole
    messages: int | None  # None: unknown
    reason: str


@dataclass(frozen=True)
class Reduction:
    """Fields of a topic that are read to be made into others, batch by batch, and not kept.

    `apply` gets columns of N messages and answers with columns of N rows, each row made of its
    own message alone, so that it does not matter which messages come together.
    """

    fields: tuple[str, ...]
    apply: Callable[[Fields], dict[str, FieldColumn]]


class TopicReading:
    """Columns and account of one topic so far."""

    def __init__(
        self, topic: TopicInfo, wanted: Iterable[str], reduction: Reduction | None = None
    ) -> None:
        self._account = Account(topic.name, topic.type, topic.expected)
        self._wanted, self._reduction = list(dict.fromkeys(wanted)), reduction
        no_times = np.zeros(0, np.int64)
        self._log = GrowingArray(no_times)
        self._publish: GrowingArray | None = None  # None while all are sent when they are logged
        self._fields: dict[str, GrowingArray | GrowingRagged] = {}
        self.decodable = False
        self.interleaved = False  # channels of one file: each batch has one, the file mixes them

    @property
    def paths(self) -> list[str]:
        """Return the fields to decode: those wanted, and those that are reduced."""
        return list(dict.fromkeys([*self._wanted, *self._reduced]))

    @property
    def _reduced(self) -> tuple[str, ...]:
        return self._reduction.fields if self._reduction else ()

    def use(self, empty: Fields) -> None:
        """Make columns for the fields decoded, even if no message comes."""
        self.decodable = True
        for path, column in self._kept(empty).items():
            self._fields.setdefault(path, growing(column))

    def skip(self, reason: str, count: int) -> None:
        """Count messages that are not read at all."""
        self._add({reason: count})

    def take(self, decode: Callable[[MessageBatch], Decoded], batch: MessageBatch) -> None:
        """Decode a batch and keep its columns."""
        self._account.read += len(batch)
        for plain, damaged in decompressed(batch):
            if damaged:
                self._add({"its zstd data is damaged": damaged})
            self._take(decode, plain)

    def _take(self, decode: Callable[[MessageBatch], Decoded], batch: MessageBatch) -> None:
        account = self._account
        sane = (batch.log_time_ns >= 0) & (batch.log_time_ns < LATEST_NS)
        if not sane.all():
            self._add({IMPLAUSIBLE: int((~sane).sum())})
            batch = batch.select(np.flatnonzero(sane))
        decoded = decode(batch)
        self._add(decoded.bad)
        account.decoded += len(decoded.rows)
        self._add_times(batch.log_time_ns[decoded.rows], batch.publish_time_ns[decoded.rows])
        for path, column in self._kept(decoded.fields).items():
            self._fields[path].add(column, account.expected)

    def _add_times(self, log_ns: Ints, publish_ns: Ints) -> None:
        if self._publish is None and not np.array_equal(log_ns, publish_ns):
            self._publish = GrowingArray(log_ns[:0])
            self._publish.add(self._log.column(), self._account.expected)
        self._log.add(log_ns, self._account.expected)
        if self._publish is not None:
            self._publish.add(publish_ns, self._account.expected)

    def _kept(self, fields: Fields) -> dict[str, FieldColumn]:
        kept = {path: fields[path] for path in self._wanted}
        if self._reduction:
            kept |= self._reduction.apply({path: fields[path] for path in self._reduced})
        return kept

    def _add(self, reasons: Mapping[str, int]) -> None:
        for reason, count in reasons.items():
            self._account.reasons[reason] = self._account.reasons.get(reason, 0) + count

    def close(self, lost: Mapping[str, int]) -> Account:
        """Reconcile and return the account: messages that are counted but missing are lost too."""
        account = self._account
        self._add(lost)
        unexplained = account.expected - account.decoded - sum(account.reasons.values())
        if unexplained > 0:
            self._add({"counted by the container, but missing": unexplained})
        return account

    def columns(self) -> TopicColumns:
        """Return all columns, in the order of log time."""
        log = self._log.column()
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
        if self._publish is not None:
            publish = self._publish.column() if order is None else self._publish.column()[order]
        for path in list(self._fields):  # one by one: the unordered column is freed first
            column = self._fields.pop(path).column()
            fields[path] = column if order is None else take(column, order)
        return TopicColumns(log, publish, fields, lap)


def together(batches: Iterable[tuple[int, MessageBatch]]) -> Iterator[tuple[int, MessageBatch]]:
    """Yield the same messages in the same order, with small batches of a channel put together.

    Decoding has a cost per batch, besides that per message: of a topic of few messages a second
    there are only a handful in 8 MiB of a recording.
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
