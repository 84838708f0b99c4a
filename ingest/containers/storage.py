"""What every container of messages offers: the seam between file formats and recordings."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from typing import Literal, Protocol

from restock.errors import visible
from restock.ingest.decoding.messages import Channel, MessageBatch

Integrity = Literal["verified", "unverified", "damaged"]


@dataclass
class Damage:
    """What of a file could not be read, and how many messages that cost where it is known."""

    what: str
    messages: dict[int, int] = field(default_factory=dict)  # by channel id

    def __post_init__(self) -> None:
        self.what = visible(self.what)


@dataclass(frozen=True)
class Extra:
    """What a file holds besides messages."""

    kind: Literal["attachment", "metadata"]
    name: str
    media_type: str
    size_bytes: int

    def __post_init__(self) -> None:
        for name in ("name", "media_type"):
            object.__setattr__(self, name, visible(getattr(self, name)))


class Storage(Protocol):
    """One open file of messages.

    `counts` are the messages by the container's own count, per channel id; `span_ns` the first and
    last log time, or None when it holds no message. `damage` is final once everything wanted
    has been read. `notes` are for the user to know and lose nothing. `extras` are listed, not read.
    """

    channels: dict[int, Channel]
    counts: dict[int, int]
    span_ns: tuple[int, int] | None
    damage: list[Damage]
    notes: list[str]
    extras: list[Extra]

    @property
    def integrity(self) -> Integrity:
        """Whether checksums confirm what was read so far."""
        ...

    def batches(self, channels: Collection[int]) -> Iterator[tuple[int, MessageBatch]]:
        """The messages of these channels, by channel, in file order within each channel."""
        ...

    def close(self) -> None:
        """Close the file."""
        ...
