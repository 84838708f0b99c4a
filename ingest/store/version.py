"""Which version of a store: a number, or the moment whose newest version it was.

Every commit to a store makes a version of its transitions table, an entry of the table's log; older
ones stay readable for as long as the files they need are kept (`RETENTION_HOURS` after they were
replaced).
"""

from __future__ import annotations

import json
import re
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from deltalake import DeltaTable

from restock.errors import StoreError

Version = int | datetime
_TIME = r"\d{4}-\d{2}-\d{2}(?:[T ][\d:.,]+(?:Z|[+-]\d{2}:?\d{2})?)?"
_LOG = "_delta_log"
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


def refuse_empty_entry(table: Path, newest: int) -> None:
    """See that no entry of a table's log up to a version is empty, as one may be after a power
    failure: Delta's library takes it for a commit without files.

    Raises:
        StoreError: one is; names it.
    """
    first = 0
    with suppress(OSError, ValueError):  # what was before a checkpoint is in the checkpoint
        first = json.loads((table / _LOG / "_last_checkpoint").read_text())["version"] + 1
    for version in range(first, newest + 1):
        with suppress(FileNotFoundError):
            entry = _entry(table, version)
            if entry.stat().st_size <= 2 and not entry.read_text().strip():
                raise _damaged(entry, "is empty")


def name_damaged_entry(table: Path) -> StoreError | None:
    """Which entry of a table's log is damaged or missing; None where that is not what is wrong."""
    entries = sorted((table / _LOG).glob("[0-9]" * 20 + ".json"))
    for place, entry in enumerate(entries):
        expected = int(entries[0].stem) + place
        if int(entry.stem) != expected:
            return _damaged(_entry(table, expected), "is missing")
        try:
            lines = [line for line in entry.read_text(encoding="utf-8").splitlines() if line]
            whole = lines and all(isinstance(json.loads(line), dict) for line in lines)
        except (OSError, ValueError):
            whole = False
        if not whole:
            return _damaged(entry, "is empty" if not entry.stat().st_size else "is damaged")
    return None


def _damaged(entry: Path, what: str) -> StoreError:
    """The error for an entry of a log, and what to do."""
    return StoreError(
        f"this entry of the store's log {what}: which files belong to the store is not known",
        where=str(entry),
        remedy="restore it from a copy of the store; where there is none, ingest the recordings "
        "into a new store",
    )


def _entry(table: Path, version: int) -> Path:
    return table / _LOG / f"{version:020}.json"
