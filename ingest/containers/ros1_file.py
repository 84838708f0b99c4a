"""ROS 1 bags: the messages of each chunk, read once, in the order of the file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TypeAlias

import numpy as np

from restock.arrays import Ints
from restock.errors import RecordingError
from restock.ingest.containers.ros1_bag import BROKEN, Bag, Walked, walk
from restock.ingest.containers.storage import (
    Container,
    Damage,
    Extra,
    Integrity,
    Metadata,
    Packed,
    Watch,
    unwatched,
)
from restock.ingest.decoding.messages import Channel, MessageBatch

# Whose places are remembered, of 24 bytes: who proposes a profile reads topic after topic, and
# walking a chunk takes longer than inflating it.
MAX_REMEMBERED = 1 << 20  # messages
# Start, end and stamp of a chunk's messages (N, 3), by connection; and where it is damaged.
_Places: TypeAlias = tuple[dict[int, Ints], int | None]


class Ros1File:
    """One ROS 1 bag of format 2.0, read only. The format has no checksums: never verified.

    Raises:
        RecordingError: it cannot be opened; a bag that was cut short has no index, and is read
            only with `salvage`.
    """

    from_ros2 = False

    def __init__(self, path: Path, *, salvage: bool = False, watch: Watch = unwatched) -> None:
        self.integrity: Integrity = "unverified"
        self.damage: list[Damage] = []
        self.notes: list[str] = []
        self.extras: list[Extra] = []
        self.metadata: list[Metadata] = []  # the format has no place for it
        self.packed: list[Packed] = []
        self._places: dict[int, _Places] = {}  # by the position of the chunk
        self._room = MAX_REMEMBERED
        self._reader = Bag(path)
        try:
            self._reader.open()
            walked = None
        except BROKEN as error:
            if not salvage:
                raise RecordingError(
                    f"ROS 1 bag cannot be read: {error}",
                    where=str(path),
                    remedy="`--salvage` reads what can still be read of it; or `rosbag reindex`"
                    " repairs a bag whose recording was cut short",
                ) from error
            self._reader = Bag(path)
            walked = self._salvaged(path, error, watch)
        self.channels = {
            connection.id: Channel(
                connection.id,
                connection.topic,
                connection.msgtype,
                "ros1",
                "ros1msg",
                connection.msgdef.data.encode(),
            )
            for connection in self._reader.connections
        }
        self.packed = self._reader.packed()
        # Messages of each channel in each chunk.
        self._counts = self._by_index() if walked is None else walked.counts
        self.counts = dict.fromkeys(self.channels, 0)
        for counts in self._counts.values():
            for channel in counts.keys() & self.channels.keys():
                self.counts[channel] += counts[channel]
        stamps = [
            (info.start_time, info.end_time - 1)
            for info in self._reader.chunk_infos
            if info.connection_counts
        ] + [(index[0].time, index[-1].time) for index in self._reader.indexes.values() if index]
        stamps += [] if walked is None else walked.spans
        self.span_ns = (
            (min(low for low, _ in stamps), max(high for _, high in stamps)) if stamps else None
        )

    def _salvaged(self, path: Path, error: Exception, watch: Watch) -> Walked:
        """What its chunks hold, where it has no index.

        Raises:
            RecordingError: nothing.
        """
        try:
            walked = self._reader.open_without_index(watch)
        except BROKEN as broken:
            raise RecordingError(f"ROS 1 bag cannot be read: {broken}", where=str(path)) from broken
        if not walked.counts:
            self._reader.close()
            raise RecordingError(
                f"ROS 1 bag cannot be read: {error}; and no chunk of it is whole enough to read",
                where=str(path),
                remedy="copy or record it again: nothing in it can be salvaged",
            ) from error
        self.integrity = "damaged"
        size = path.stat().st_size
        beyond = f"; nothing after byte {walked.stop:,} of {size:,}" if walked.stop < size else ""
        self.damage.append(
            Damage(
                f"no index ({error}): read chunk by chunk{beyond}; the number of lost messages is "
                "not known"
            )
        )
        return walked

    def _by_index(self) -> dict[int, Counter[int]]:
        """Messages per chunk and channel, by the bag's two indexes; by walking a chunk of which
        they say different things."""
        counts = {position: Counter[int]() for position in self._reader.chunks}
        for channel, index in self._reader.indexes.items():
            for entry in index:
                counts[entry.chunk_pos][channel] += 1
        for info in self._reader.chunk_infos:
            claimed = Counter(info.connection_counts)
            if counts[info.pos] != claimed or claimed.keys() - self.channels.keys():
                self.notes.append(
                    f"chunk at byte {info.pos:,}: its indexes contradict each other; walked"
                )
                try:
                    found, _ = walk(self._reader.inflated(info.pos))
                    counts[info.pos] = Counter({key: len(rows) for key, rows in found.items()})
                except BROKEN:  # said when it is read
                    counts[info.pos] |= claimed
        return counts

    def batches(self, channels: Collection[int]) -> Iterator[tuple[int, MessageBatch]]:
        """Chunk by chunk, by what it holds, whatever the index says; one that is damaged costs
        only its own messages."""
        wanted = set(channels)
        for position in sorted(self._reader.chunks):
            if position in self._places and not wanted & self._places[position][0].keys():
                continue
            counts = {key: self._counts[position][key] for key in sorted(self.channels)}
            try:
                data = self._reader.inflated(position)
            except BROKEN as error:
                lost = {key: count for key, count in counts.items() if count}
                self._damaged(f"chunk at byte {position:,} is lost: {error}", lost)
                continue
            found, cut = self._walked(position, data)
            for key, rows in found.items():
                if key in wanted:
                    yield key, _batch(data, rows)
                elif key not in self.channels:
                    what = f"{len(rows)} messages of connection {key}, which the bag never names"
                    self._damaged(f"chunk at byte {position:,}: {what}", {key: len(rows)})
            if cut is not None:
                fewer = {key: count - len(found.get(key, ())) for key, count in counts.items()}
                lost = {key: count for key, count in fewer.items() if count > 0}
                self._damaged(f"chunk at byte {position:,}: damaged at its byte {cut:,}", lost)

    def _walked(self, position: int, data: bytes) -> _Places:
        """Walk a chunk, or remember where its messages are."""
        if position in self._places:
            return self._places[position]
        found, cut = walk(data)
        places = {key: np.array(rows, np.int64) for key, rows in found.items()}
        self._room -= sum(map(len, places.values()))
        if self._room >= 0:
            self._places[position] = places, cut
        return places, cut

    def _damaged(self, what: str, messages: dict[int, int]) -> None:
        self.integrity = "damaged"
        if all(item.what != what for item in self.damage):
            self.damage.append(Damage(what, messages))

    def close(self) -> None:
        """Close the file."""
        self._reader.close()


def _batch(data: bytes, places: Ints) -> MessageBatch:
    """The messages that lie at these places of a chunk."""
    start, stop, times = places.T
    return MessageBatch(np.frombuffer(data, np.uint8), start, stop, times, times)


CONTAINER = Container(
    name="ros1",
    endings=(".bag",),
    claims=lambda head: head.startswith(b"#ROSBAG V"),
    open=Ros1File,
    format="ros1",
    bag_format="ros1",
)
