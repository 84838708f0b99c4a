"""Which version of a store: a number, or the moment whose newest version it was.

Every commit to a store makes a version of its transitions table; older ones stay readable for as
long as the files they need are kept (`RETENTION_HOURS` after they were replaced).
"""

from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path

from deltalake import DeltaTable

from restock.errors import StoreError

Version = int | datetime
_TIME = r"\d{4}-\d{2}-\d{2}(?:[T ][\d:.,]+(?:Z|[+-]\d{2}:?\d{2})?)?"
_AFTER_AT = re.compile(rf"(?P<path>.+)@(?P<version>\d+|{_TIME})")


def parse_version(text: str) -> Version:
    """`12`, or an ISO 8601 time such as `2026-11-01T08:00Z`; UTC where it names no zone.

    Raises:
        StoreError: it is neither.
    """
    if text.isascii() and text.isdigit():
        return int(text)
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise StoreError(
            f"{text!r} is neither the number of a version nor a time",
            where="--version",
            remedy="give a number such as 12, or a time such as 2026-11-01T08:00Z",
        ) from None
    return moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)


def given_version(text: str | None) -> Version | None:
    """What `--version` was given. Raises StoreError as `parse_version` does."""
    return None if text is None else parse_version(text)


def split_version(place: str) -> tuple[str, Version | None]:
    """`store@12` or `store@2026-11-01` as path and version; None where it names none.

    A folder that exists is taken as it is called.
    """
    match = _AFTER_AT.fullmatch(place)
    if match is None or Path(place).exists():
        return place, None
    return match["path"], parse_version(match["version"])


def version_at(table: DeltaTable, moment: datetime, *, where: str) -> int:
    """The newest version of a table that was there at a moment.

    Raises:
        StoreError: it was made later.
    """
    # The time that a commit says, not that of its file, which a copy of the store changes.
    made = {
        int(commit["version"]): datetime.fromtimestamp(commit["timestamp"] / 1000, UTC)
        for commit in table.history()
    }
    before = [version for version, at in made.items() if at <= moment]
    if not before:
        first = min(made.values()).isoformat(timespec="milliseconds")
        raise StoreError(
            f"there was no version at {moment.isoformat()}: the first is from {first}", where=where
        )
    return max(before)
