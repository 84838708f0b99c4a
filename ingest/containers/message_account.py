"""What a recording says of its topics, and what became of each message."""

from __future__ import annotations

from dataclasses import dataclass, field


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
    log_backsteps: int = 0  # messages logged before the one that lies before them in the file

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
