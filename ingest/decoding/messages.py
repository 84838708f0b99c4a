"""Serialised messages, as containers hand them to decoders: channels, and batches of payloads.

Names come out of files, and go to terminals, tables and reports: control characters in them are
written out (`visible`) where they come in.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from restock.arrays import Ints
from restock.errors import visible
from restock.ingest.decoding.columns import offsets_of

_SHORT_NAME = re.compile(r"(\w+)/(\w+)")


@dataclass(frozen=True)
class Channel:
    """A stream of messages of one type in one file.

    Some writers leave the `msg` out of a ROS type's name: the type has it.
    """

    id: int
    topic: str
    type: str  # "nav_msgs/msg/Odometry"
    encoding: str  # of the messages: "cdr", "json", "protobuf", "ros1", …
    definition_format: str = ""  # "ros2msg", "ros2idl", "ros1msg", "jsonschema", "protobuf" or ""
    definition: bytes = b""
    qos: str = ""  # the profiles that its publishers offered, as the file has them: YAML

    def __post_init__(self) -> None:
        for name in ("topic", "type", "encoding", "definition_format"):
            object.__setattr__(self, name, visible(getattr(self, name)))
        if short := _SHORT_NAME.fullmatch(self.type):
            object.__setattr__(self, "type", "/msg/".join(short.groups()))


@dataclass(frozen=True)
class MessageBatch:
    """Serialised messages of one channel: slices of one buffer, in file order."""

    buffer: NDArray[np.uint8]
    start: Ints  # (N,) first byte of each payload in `buffer`
    stop: Ints  # (N,) one past its last
    log_time_ns: Ints  # (N,)
    publish_time_ns: Ints  # (N,)

    def __len__(self) -> int:
        return len(self.start)

    def select(self, rows: NDArray[np.intp]) -> MessageBatch:
        """Select rows, in the same buffer."""
        return MessageBatch(
            self.buffer,
            self.start[rows],
            self.stop[rows],
            self.log_time_ns[rows],
            self.publish_time_ns[rows],
        )

    @property
    def size_bytes(self) -> int:
        """Return the bytes of all payloads."""
        return int((self.stop - self.start).sum())

    def payloads(self) -> list[bytes]:
        """Return the bytes of each message."""
        view = self.buffer.data
        bounds = zip(self.start.tolist(), self.stop.tolist(), strict=True)
        return [bytes(view[start:stop]) for start, stop in bounds]

    @classmethod
    def of(cls, payloads: Sequence[bytes], log_time_ns: Any, publish_time_ns: Any) -> MessageBatch:
        """Payloads laid one after the other."""
        offsets = offsets_of(np.fromiter(map(len, payloads), np.int64, len(payloads)))
        return cls(
            np.frombuffer(b"".join(payloads), np.uint8),
            offsets[:-1],
            offsets[1:],
            np.asarray(log_time_ns, np.int64),
            np.asarray(publish_time_ns, np.int64),
        )


class PendingBatch:
    """Messages of one channel that wait for more of them, to be decoded together."""

    def __init__(self) -> None:
        self._payloads = list[bytes]()
        self._log_time_ns, self._publish_time_ns = list[Ints](), list[Ints]()
        self.size_bytes = 0

    def __len__(self) -> int:
        return len(self._payloads)

    def add(self, payloads: Sequence[bytes], log_time_ns: Ints, publish_time_ns: Ints) -> None:
        """Add messages, in file order."""
        self._payloads += payloads
        self._log_time_ns.append(log_time_ns)
        self._publish_time_ns.append(publish_time_ns)
        self.size_bytes += sum(map(len, payloads))

    def batch(self) -> MessageBatch:
        """Return all of them as one batch."""
        log, publish = np.concatenate(self._log_time_ns), np.concatenate(self._publish_time_ns)
        return MessageBatch.of(self._payloads, log, publish)
