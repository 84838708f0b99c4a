"""The containers that recordings come in: a new one is a file with its `Container`, and a row."""

from __future__ import annotations

from restock.ingest.containers import mcap_file, ros1_file, sqlite_file
from restock.ingest.containers.storage import Container

CONTAINERS: tuple[Container, ...] = (
    mcap_file.CONTAINER,
    sqlite_file.CONTAINER,
    ros1_file.CONTAINER,
)


def claiming(head: bytes) -> Container | None:
    """Return the container that claims a file by its first bytes, or None."""
    return next((one for one in CONTAINERS if one.claims(head)), None)


def endings() -> tuple[str, ...]:
    """Return how the names of recordings' files end, without and with rosbag2's compression."""
    plain = [ending for one in CONTAINERS for ending in one.endings]
    return (*plain, *(ending + packed for packed in (".zstd", ".zst") for ending in plain))
