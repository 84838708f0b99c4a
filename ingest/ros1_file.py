"""ROS 1 bags, through `rosbags`."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

from rosbags.rosbag1 import Reader, ReaderError

from restock.errors import RecordingError
from restock.ingest.columns import Batch
from restock.ingest.storage import Channel, Damage, Integrity

BYTES_PER_BATCH = 32 << 20


class Ros1File:
    """One ROS 1 bag of format 2.0, read only. The format has no checksums: never verified.

    Raises:
        RecordingError: it cannot be opened; a bag that was cut short has no index.
    """

    def __init__(self, path: Path) -> None:
        self.integrity: Integrity = "unverified"
        self.damage: list[Damage] = []
        self.notes: list[str] = []
        self._reader = Reader(path)
        try:
            self._reader.open()
        except (ReaderError, AssertionError, ValueError, KeyError, IndexError) as error:
            raise RecordingError(
                f"a ROS 1 bag that cannot be read: {error}",
                where=str(path),
                remedy="`rosbag reindex` mends a bag whose recording was cut short",
            ) from error
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
        self.counts = {item.id: item.msgcount for item in self._reader.connections}
        held = any(self.counts.values())
        self.span_ns = (self._reader.start_time, self._reader.end_time - 1) if held else None

    def batches(self, channels: Collection[int]) -> Iterator[tuple[int, Batch]]:
        """In the order of the bag's index, which is by time."""
        wanted = [item for item in self._reader.connections if item.id in channels]
        if not wanted:
            return
        held: dict[int, list[tuple[int, bytes]]] = {}
        size = 0
        try:
            for connection, stamp, data in self._reader.messages(wanted):
                held.setdefault(connection.id, []).append((stamp, bytes(data)))
                size += len(data) + 64
                if size >= BYTES_PER_BATCH:
                    yield from _batches(held)
                    held, size = {}, 0
        except (ReaderError, AssertionError, ValueError, OSError, EOFError, RuntimeError) as error:
            self.integrity = "damaged"
            self.damage.append(Damage(f"what follows the damage is lost: {error}"))
        yield from _batches(held)

    def close(self) -> None:
        """Let go of the file."""
        self._reader.close()


def _batches(held: dict[int, list[tuple[int, bytes]]]) -> Iterator[tuple[int, Batch]]:
    for channel, rows in held.items():
        stamps = [stamp for stamp, _ in rows]
        yield channel, Batch.of([data for _, data in rows], stamps, stamps)
