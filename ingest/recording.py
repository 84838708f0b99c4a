"""One recording, open: its topics, its columns, and the account of what became of each message.

Whatever the container, messages come in the order of their log time, and what was expected, read,
decoded and skipped is kept per topic.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from restock.errors import RecordingError
from restock.ingest.cdr import ColumnDecoder
from restock.ingest.columns import I64, Batch, FieldColumn, TopicColumns, join, take
from restock.ingest.compression import decompress_messages
from restock.ingest.definitions import CannotDecode, MessageType, message_type
from restock.ingest.storage import Channel, Damage, Integrity, Storage


@dataclass(frozen=True)
class TopicInfo:
    """What a recording says about a topic before anything is read."""

    name: str
    type: str  # "nav_msgs/msg/Odometry"; "" where the container names none
    expected: int  # messages, by the container's own count
    encoding: str  # "cdr", "json", "protobuf", "ros1", …
    definition: str  # "embedded", a distribution's name, or "" where it cannot be decoded
    skipped: str | None  # why it cannot be decoded, or None


@dataclass
class Account:
    """What became of a topic's messages: expected = decoded + lost, always."""

    topic: str
    type: str
    expected: int  # by the container's own count
    read: int = 0  # payloads that came out of the container
    decoded: int = 0
    reasons: dict[str, int] = field(default_factory=dict)  # why the rest were not decoded

    @property
    def lost(self) -> int:
        """Messages that the container counts and that gave no row."""
        return max(self.expected - self.decoded, 0)


@dataclass(frozen=True)
class Loss:
    """Messages or bytes of a recording that could not be had, and why."""

    topic: str | None  # None: of the file as a whole
    messages: int | None  # None: unknown
    reason: str


@dataclass(frozen=True)
class _Stream:
    """A channel of one of the recording's files."""

    storage: Storage
    channel: Channel


class Recording:
    """One recording, open: an MCAP file, or a bag with all its files.

    `topics` names every topic with its type and count; `read` decodes some of them. After it
    `accounts` says per topic what was expected, read, decoded and skipped, and `losses` what is
    missing. Use as a context manager, or call `close`.
    """

    def __init__(
        self,
        path: Path,
        format: str,
        files: Sequence[Path],
        storages: Sequence[Storage],
        distro: str,
    ) -> None:
        self.path, self.format, self.files, self.distro = path, format, tuple(files), distro
        self.accounts: dict[str, Account] = {}
        self.notes: list[str] = []
        self._storages = tuple(storages)
        self._cleanup: list[Callable[[], None]] = []
        self._bag_damage: list[Damage] = []
        self._streams: dict[str, list[_Stream]] = {}
        for storage in self._storages:
            for channel in storage.channels.values():
                self._streams.setdefault(channel.topic, []).append(_Stream(storage, channel))

    def adopt(
        self,
        damage: Sequence[Damage],
        notes: Sequence[str],
        cleanup: Sequence[Callable[[], None]],
    ) -> None:
        """Take over what was found, and what is to be done at the end, from who opened it."""
        self._bag_damage += damage
        self.notes += [*notes, *(note for storage in self._storages for note in storage.notes)]
        self._cleanup += cleanup

    @cached_property
    def recording_id(self) -> str:
        """16 hex digits of the content of its files, in order: the same wherever it lies."""
        digest = hashlib.blake2b(digest_size=8)
        for file in self.files:
            digest.update(str(file.stat().st_size).encode())
            with file.open("rb") as content:
                while block := content.read(1 << 20):
                    digest.update(block)
        return digest.hexdigest()

    @cached_property
    def topics(self) -> dict[str, TopicInfo]:
        """Every topic by name, in alphabetical order."""
        return {name: self._info(name) for name in sorted(self._streams)}

    def _info(self, name: str) -> TopicInfo:
        streams = self._streams[name]
        first = streams[0].channel
        expected = sum(stream.storage.counts.get(stream.channel.id, 0) for stream in streams)
        try:
            source, skipped = self._type(first).source, None
        except CannotDecode as reason:
            source, skipped = "", str(reason)
        return TopicInfo(name, first.type, expected, first.encoding, source, skipped)

    def _type(self, channel: Channel) -> MessageType:
        if channel.encoding not in ("cdr", "ros1"):
            raise CannotDecode(f"messages encoded as {channel.encoding!r} are not read")
        return message_type(channel, self.distro)

    @property
    def size_bytes(self) -> int:
        """Of all its files."""
        return sum(file.stat().st_size for file in self.files)

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """First and last log time; None in a recording without messages."""
        spans = [storage.span_ns for storage in self._storages if storage.span_ns]
        if not spans:
            return None
        return min(low for low, _ in spans), max(high for _, high in spans)

    @property
    def messages(self) -> int:
        """Of all topics, by the container's own count."""
        return sum(topic.expected for topic in self.topics.values())

    @property
    def integrity(self) -> Integrity:
        """Whether checksums vouch for what was read; final after `read`."""
        found = {storage.integrity for storage in self._storages}
        if "damaged" in found or self._bag_damage:
            return "damaged"
        return "unverified" if "unverified" in found else "verified"

    @property
    def damage(self) -> list[Damage]:
        """What of its files could not be read."""
        return self._bag_damage + [item for storage in self._storages for item in storage.damage]

    @property
    def losses(self) -> list[Loss]:
        """What is missing: of the files, and of the topics that were read."""
        found = [Loss(None, sum(item.messages.values()) or None, item.what) for item in self.damage]
        for account in self.accounts.values():
            found += [Loss(account.topic, n, reason) for reason, n in account.reasons.items() if n]
        return found

    def leaves(self, topic: str) -> list[str]:
        """Every field path of a topic's messages; empty where it cannot be decoded."""
        try:
            return [leaf.path for leaf in self._type(self._streams[topic][0].channel).leaves()]
        except CannotDecode:
            return []

    def read(self, wanted: Mapping[str, Sequence[str]]) -> dict[str, TopicColumns]:
        """Columns of these topics: field paths to arrays (N, …) or Ragged, by log time.

        A topic that cannot be decoded is not in the answer; `accounts` says why.

        Raises:
            RecordingError: the recording has no such topic, or its messages no such field.
        """
        unknown = [topic for topic in wanted if topic not in self._streams]
        if unknown:
            raise RecordingError(
                f"no topic named {unknown[0]!r}",
                where=str(self.path),
                remedy=f"it has {', '.join(sorted(self._streams)) or 'none'}",
            )
        readings = {topic: _Reading(self.topics[topic]) for topic in wanted}
        for storage in self._storages:
            self._read_storage(storage, wanted, readings)
        columns = {}
        for topic, reading in readings.items():
            self.accounts[topic] = reading.close(self._lost(topic))
            if reading.decodable:
                columns[topic] = reading.columns()
        for storage in self._storages:
            self.notes += [note for note in storage.notes if note not in self.notes]
        return columns

    def _read_storage(
        self,
        storage: Storage,
        wanted: Mapping[str, Sequence[str]],
        readings: Mapping[str, _Reading],
    ) -> None:
        decoders: dict[int, ColumnDecoder] = {}
        topics: dict[int, str] = {}
        for topic, paths in wanted.items():
            for stream in self._streams[topic]:
                if stream.storage is not storage:
                    continue
                topics[stream.channel.id] = topic
                try:
                    decoder = self._decoder(topic, stream.channel, paths)
                    readings[topic].use(decoder)
                    decoders[stream.channel.id] = decoder
                except CannotDecode as reason:
                    count = storage.counts.get(stream.channel.id, 0)
                    readings[topic].skip(str(reason), count)
        for channel, batch in storage.batches(list(decoders)):
            readings[topics[channel]].take(decoders[channel], batch)

    def _decoder(self, topic: str, channel: Channel, paths: Sequence[str]) -> ColumnDecoder:
        kind = self._type(channel)
        if channel.type != self.topics[topic].type:
            raise CannotDecode(f"it also carries {channel.type}, beside {self.topics[topic].type}")
        try:
            leaves = [kind.leaf(path) for path in paths]
        except RecordingError as error:
            raise RecordingError(
                error.what, where=f"{self.path}, {topic}", remedy=error.remedy
            ) from None
        return ColumnDecoder(kind, leaves, ros1=channel.encoding == "ros1")

    def _lost(self, topic: str) -> dict[str, int]:
        """Messages of a topic that damage is known to have cost, by reason."""
        lost: dict[str, int] = {}
        for stream in self._streams[topic]:
            for item in stream.storage.damage:
                if count := item.messages.get(stream.channel.id):
                    lost[item.what] = lost.get(item.what, 0) + count
        return lost

    def close(self) -> None:
        """Let go of its files."""
        for storage in self._storages:
            storage.close()
        for clean in self._cleanup:
            clean()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class _Reading:
    """What has come of one topic so far."""

    def __init__(self, topic: TopicInfo) -> None:
        self._account = Account(topic.name, topic.type, topic.expected)
        self._times: list[tuple[I64, I64]] = []  # log and publish time
        self._fields: dict[str, list[FieldColumn]] = {}
        self.decodable = False

    def use(self, decoder: ColumnDecoder) -> None:
        """Make columns for the decoder's fields, even if no message comes."""
        self.decodable = True
        for path, column in decoder.empty().items():
            self._fields.setdefault(path, [column])

    def skip(self, reason: str, count: int) -> None:
        """Messages that are not read at all."""
        self._add({reason: count})

    def take(self, decoder: ColumnDecoder, batch: Batch) -> None:
        """Decode a batch and keep its columns."""
        self._account.read += len(batch)
        batch, damaged = decompress_messages(batch)
        if damaged:
            self._add({"its zstd data is damaged": damaged})
        decoded = decoder.decode(batch)
        self._add(decoded.bad)
        self._account.decoded += len(decoded.rows)
        self._times.append((batch.log_time_ns[decoded.rows], batch.publish_time_ns[decoded.rows]))
        for path, column in decoded.fields.items():
            self._fields[path].append(column)

    def _add(self, reasons: Mapping[str, int]) -> None:
        for reason, count in reasons.items():
            self._account.reasons[reason] = self._account.reasons.get(reason, 0) + count

    def close(self, lost: Mapping[str, int]) -> Account:
        """The account, reconciled: what the container counts beyond what came is a loss too."""
        account = self._account
        self._add(lost)
        unsaid = account.expected - account.decoded - sum(account.reasons.values())
        if unsaid > 0:
            self._add({"counted by the container, but not in it": unsaid})
        return account

    def columns(self) -> TopicColumns:
        """All of it, in the order of log time."""
        none = np.zeros(0, np.int64)
        log = np.concatenate([log for log, _ in self._times] or [none])
        publish = np.concatenate([publish for _, publish in self._times] or [none])
        fields = {path: join(parts) for path, parts in self._fields.items()}
        if (np.diff(log) < 0).any():
            order = np.argsort(log, kind="stable")
            log, publish = log[order], publish[order]
            fields = {path: take(column, order) for path, column in fields.items()}
        return TopicColumns(log, publish, fields)
