"""Open recordings: their topics, the columns of their messages, and an account of each topic.

For every container, columns are in the order of log time, and the account counts the messages that
were expected, read, decoded and skipped.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Self

from blake3 import blake3

from restock.arrays import Ints
from restock.errors import RecordingError
from restock.ingest.containers.storage import (
    Account,
    Damage,
    Extra,
    Fields,
    Integrity,
    LostMessages,
    Metadata,
    Reduction,
    Storage,
    TopicInfo,
    TopicReading,
    Watch,
    decompress_batch,
    join_small_batches,
    no_progress,
)
from restock.ingest.decoding.columns import (
    CannotDecode,
    Channel,
    Leaf,
    MessageType,
    TopicColumns,
    suggest_fields,
)
from restock.ingest.decoding.decoders import decoder_of, type_of
from restock.ingest.decoding.row_by_row import Decoder

MAX_DEFINED_BYTES = 8 << 20  # limit of all message definitions: parsing takes about 1 s per MB


@dataclass(frozen=True)
class _Stream:
    """A channel of one of the recording's files."""

    storage: Storage
    channel: Channel

    def payloads(self) -> Iterator[bytes]:
        """Yield the serialised messages in file order, decompressed."""
        for _, batch in self.storage.batches([self.channel.id]):
            for plain, _ in decompress_batch(batch):
                yield from plain.payloads()


def content_id(files: Sequence[Path], watch: Watch = no_progress) -> str:
    """Return 16 hex digits of the BLAKE3 hash of files' sizes and contents, not their paths."""
    digest = blake3()  # with blake2b, hashing a bag with images took a third of its ingest
    done, whole = 0, sum(file.stat().st_size for file in files)
    for file in files:
        digest.update(str(file.stat().st_size).encode())
        with file.open("rb") as content:
            while block := content.read(1 << 20):
                digest.update(block)
                done += len(block)
                watch("checking content, bytes", done, whole)
    return digest.hexdigest(8)


class Recording:
    """An open recording: an MCAP file, or a bag with all its files.

    `topics` has every topic with its type and count; `read` decodes some of them. After `read`,
    `accounts` counts the expected, read, decoded and skipped messages of each topic read, and
    `lost_messages` lists what is missing. Use it as a context manager, or call `close`.
    """

    def __init__(
        self,
        path: Path,
        format: str,
        files: Sequence[Path],
        storages: Sequence[Storage],
        distro: str,
        damage: Sequence[Damage] = (),
        notes: Sequence[str] = (),
        cleanup: Sequence[Callable[[], None]] = (),
        *,
        metadata: Sequence[Metadata] = (),
    ) -> None:
        self.path, self.format, self.files, self.distro = path, format, tuple(files), distro
        self.accounts: dict[str, Account] = {}
        self.watch: Watch = no_progress  # called with the progress of a long read
        self.robot: str | None = None  # namespace of the chosen robot, if it has several
        self._storages = tuple(storages)
        self.notes = [*notes, *(note for storage in self._storages for note in storage.notes)]
        self._bag_damage, self._cleanup = list(damage), tuple(cleanup)
        self._bag_metadata, self._closed = tuple(metadata), False
        self._streams: dict[str, list[_Stream]] = {}
        # (storage index, channel id) -> type of its messages, or why they cannot be decoded
        self._types: dict[tuple[int, int], MessageType | CannotDecode] = {}
        self._defined: dict[tuple[str, str, int], int] = {}  # type, format, hash -> bytes
        for storage in self._storages:
            for channel in storage.channels.values():
                self._streams.setdefault(channel.topic, []).append(_Stream(storage, channel))
        several = map(self._note_several_types, sorted(self._streams))
        self.notes += [note for note in several if note]

    @cached_property
    def recording_id(self) -> str:
        """Return the `content_id` of its files."""
        return content_id(self.files, self.watch)

    @cached_property
    def topics(self) -> dict[str, TopicInfo]:
        """Return every topic by name, in alphabetical order."""
        return {name: self._topic_info(name) for name in sorted(self._streams)}

    def _topic_info(self, name: str) -> TopicInfo:
        streams = self._streams[name]
        first = streams[0].channel
        expected = sum(stream.storage.counts.get(stream.channel.id, 0) for stream in streams)
        try:
            source, skipped = self._type(streams[0]).source, None
        except CannotDecode as reason:
            source, skipped = "", str(reason)
        return TopicInfo(name, first.type, expected, first.encoding, source, skipped)

    def _note_several_types(self, topic: str) -> str | None:
        """Return a note if a topic's messages have several types."""
        counts = Counter[str]()
        for stream in self._streams[topic]:
            counts[stream.channel.type] += stream.storage.counts.get(stream.channel.id, 0)
        if len(counts := +counts) < 2:
            return None
        each = ", ".join(f"{count:,} of {name}" for name, count in counts.items())
        return f"{topic} has messages of several types: {each}"

    def _type(self, stream: _Stream) -> MessageType:
        key = self._storages.index(stream.storage), stream.channel.id
        if key not in self._types:
            try:
                self._bound_definitions(stream.channel)
                self._types[key] = type_of(stream.channel, self.distro, stream.payloads)
            except CannotDecode as reason:  # stored, as parsing again takes time
                self._types[key] = reason
        kind = self._types[key]
        if isinstance(kind, CannotDecode):
            raise kind
        return kind

    def _bound_definitions(self, channel: Channel) -> None:
        self._defined[channel.type, channel.definition_format, hash(channel.definition)] = len(
            channel.definition
        )
        if sum(self._defined.values()) > MAX_DEFINED_BYTES:
            raise CannotDecode(
                f"the definitions up to its own have more than {MAX_DEFINED_BYTES:,} bytes"
            )

    @property
    def size_bytes(self) -> int:
        """Return the total size of its files."""
        return sum(file.stat().st_size for file in self.files)

    def qos(self, topic: str) -> str:
        """Return the quality of service that a topic's publishers offered, YAML; "" if unknown."""
        return next((one.channel.qos for one in self._channels(topic) if one.channel.qos), "")

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Return the first and last log time; None for a recording without messages."""
        spans = [storage.span_ns for storage in self._storages if storage.span_ns]
        if not spans:
            return None
        return min(low for low, _ in spans), max(high for _, high in spans)

    @property
    def messages(self) -> int:
        """Return the number of messages of all topics, by the container's own count."""
        return sum(topic.expected for topic in self.topics.values())

    @property
    def integrity(self) -> Integrity:
        """Return whether checksums confirm what was read; final after `read`."""
        states = {storage.integrity for storage in self._storages}
        if "damaged" in states or self._bag_damage:
            return "damaged"
        return "unverified" if "unverified" in states else "verified"

    @property
    def damage(self) -> list[Damage]:
        """Return the parts of its files that could not be read."""
        return self._bag_damage + [item for storage in self._storages for item in storage.damage]

    @property
    def extras(self) -> list[Extra]:
        """Return its attachments and metadata records, by name."""
        return [extra for storage in self._storages for extra in storage.extras]

    @property
    def metadata(self) -> list[Metadata]:
        """Return the metadata of the whole recording: custom_data of a bag, metadata records."""
        every = [*self._bag_metadata, *(m for storage in self._storages for m in storage.metadata)]
        return [item for item in every if item.entries]

    @property
    def lost_messages(self) -> list[LostMessages]:
        """Return the losses in the files and in the topics that were read, each loss once."""
        damaged = {item.what for item in self.damage}
        lost = [LostMessages(None, _lost_count(item), item.what) for item in self._bag_damage]
        for storage in self._storages:
            for item in storage.damage:
                of = {storage.channels.get(number) for number, n in item.messages.items() if n}
                channel = of.pop() if len(of) == 1 else None
                topic = channel.topic if channel else None
                lost.append(LostMessages(topic, _lost_count(item), item.what))
        for account in self.accounts.values():
            lost += [
                LostMessages(account.topic, count, why)
                for why, count in account.reasons.items()
                if count and why not in damaged
            ]
        return lost

    def leaves(self, topic: str) -> list[str]:
        """Return every field path of a topic's messages; [] if they cannot be decoded."""
        return [leaf.path for leaf in self.fields(topic)]

    def fields(self, topic: str) -> list[Leaf]:
        """Return every field of a topic's messages; [] if they cannot be decoded."""
        try:
            return self._type(self._channels(topic)[0]).leaves()
        except CannotDecode:
            return []

    def read(
        self, wanted: Mapping[str, Sequence[str]], reductions: Mapping[str, Reduction] | None = None
    ) -> dict[str, TopicColumns]:
        """Read fields of topics as columns, arrays (N, …) or Ragged, in the order of log time.

        `wanted` maps each topic to its field paths. A topic that cannot be decoded is left out;
        `accounts` has the reason. `reductions` replaces wide fields of some topics by smaller ones
        while they are read.

        Raises:
            RecordingError: a topic or field does not exist, or the recording is closed.
        """
        for topic in wanted:
            self._channels(topic)
        self._expect_open()
        readings = {
            topic: TopicReading(self.topics[topic], paths, (reductions or {}).get(topic))
            for topic, paths in wanted.items()
        }
        done, whole = 0, sum(self.topics[topic].expected for topic in wanted)
        for storage in self._storages:
            for count in self._read_storage(storage, readings):
                done += count
                self.watch("reading, messages", done, whole)
        columns = {}
        for topic, reading in readings.items():
            self.accounts[topic] = reading.close(self._lost(topic))
            if reading.decodable:
                columns[topic] = reading.columns()
        for storage in self._storages:
            self.notes += [note for note in storage.notes if note not in self.notes]
        return columns

    def batches(self, topic: str, fields: Sequence[str]) -> Iterator[tuple[Ints, Fields]]:
        """Yield log times (N,) and columns of a topic's fields, batch by batch in file order.

        Messages that cannot be decoded are left out. After the last batch, `accounts` counts them,
        unless the topic was read before.
        """
        self._expect_open()
        reading = TopicReading(self.topics[topic], fields)
        for storage in self._storages:
            decoders = self._make_decoders(storage, topic, reading)
            for channel, batch in storage.batches(list(decoders)):
                for plain, decoded in reading.decoded(decoders[channel].decode, batch):
                    yield plain.log_time_ns[decoded.rows], decoded.fields
        self.accounts.setdefault(topic, reading.close(self._lost(topic)))

    def _channels(self, topic: str) -> list[_Stream]:
        if topic not in self._streams:
            has, where = ", ".join(sorted(self._streams)) or "no topics", str(self.path)
            raise RecordingError(f"no topic named {topic!r}", where=where, remedy=f"it has {has}")
        return self._streams[topic]

    def _expect_open(self) -> None:
        if self._closed:  # closed files would look like files without messages
            raise RecordingError("it is closed", where=str(self.path), remedy="open it again")

    def _read_storage(
        self, storage: Storage, readings: Mapping[str, TopicReading]
    ) -> Iterator[int]:
        """Read one file; yield the number of messages of each batch."""
        decoders: dict[int, Decoder] = {}
        topics: dict[int, str] = {}
        for topic, reading in readings.items():
            found = self._make_decoders(storage, topic, reading)
            for decoder in found.values():
                reading.use(decoder.empty())
            reading.interleaved |= len(found) > 1
            decoders |= found
            topics |= dict.fromkeys(found, topic)
        for channel, batch in join_small_batches(storage.batches(list(decoders))):
            readings[topics[channel]].take(decoders[channel].decode, batch)
            yield len(batch)

    def _make_decoders(
        self, storage: Storage, topic: str, reading: TopicReading
    ) -> dict[int, Decoder]:
        """Make the decoders of a topic's channels in one file; skip what cannot be decoded."""
        decoders: dict[int, Decoder] = {}
        for stream in self._streams[topic]:
            if stream.storage is storage:
                try:
                    decoders[stream.channel.id] = self._make_decoder(topic, stream, reading.paths)
                except CannotDecode as reason:
                    reading.skip(str(reason), storage.counts.get(stream.channel.id, 0))
        return decoders

    def _make_decoder(self, topic: str, stream: _Stream, paths: Sequence[str]) -> Decoder:
        kind, first = self._type(stream), self._type(self._streams[topic][0])
        leaves = list[Leaf]()
        for path in paths:
            expected, leaf = first.by_path.get(path), kind.by_path.get(path)
            if expected is None:
                problem, where = suggest_fields(path, [*first.by_path]), f"{self.path}, {topic}"
                raise RecordingError(f"{first.name} has {problem}", where=where)
            if leaf is None or (leaf.kind, leaf.dims) != (expected.kind, expected.dims):
                raise CannotDecode(f"{path} of {kind.name} is missing, or not as in {first.name}")
            leaves.append(leaf)
        return decoder_of(stream.channel, kind, leaves)

    def _lost(self, topic: str) -> dict[str, int]:
        """Count the messages of a topic that are known to be lost to damage, by reason."""
        lost = Counter[str]()
        for stream in self._streams[topic]:
            for item in stream.storage.damage:
                if count := item.messages.get(stream.channel.id):
                    lost[item.what] += count
        return lost

    def close(self) -> None:
        """Close its files; the recording can then no longer be read."""
        self._closed = True
        for storage in self._storages:
            storage.close()
        for clean in self._cleanup:
            clean()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _lost_count(damage: Damage) -> int | None:
    """Return the number of messages lost to damage; None if it is not known."""
    return sum(damage.messages.values()) or None
