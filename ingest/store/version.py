"""Parse versions of a store, and check that Restock can read and write its tables.

A version is a number, or a time, which stands for the newest version at that time. Every commit to
`transitions` makes a new version of the store. Older versions stay readable as long as the files
that they need are kept (`RETENTION_HOURS` after they were replaced).

The description of each table contains the store's format. This Restock reads only FORMAT.

Other tools may set features that change what a file's rows mean (deletion vectors, column mapping),
or that every writer must follow (constraints, change feeds). Delta's library opens some of these
tables, but Restock reads the Parquet files directly. So features that Restock does not know are
refused by name.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Collection, Sequence
from datetime import UTC, datetime
from pathlib import Path

from deltalake import DeltaTable

from restock.errors import StoreError

Version = int | datetime
# Description in each table's metadata. Raise the number if columns, meanings or summaries change.
FORMAT = "restock-store/2"
_TIME = r"\d{4}-\d{2}-\d{2}(?:[T ][\d:.,]+(?:Z|[+-]\d{2}:?\d{2})?)?"
LOG = "_delta_log"  # folder of a table's log
_SHORT = 1024  # bytes; only smaller commits are checked: cut after commitInfo, one has 1/3 of it
_AFTER_AT = re.compile(rf"(?P<path>.+)@(?P<version>\d+|{_TIME})")


def parse_version(text: str) -> Version:
    """Parse `12`, or an ISO 8601 time such as `2026-11-01T08:00Z`, in UTC if it names no zone.

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
            remedy="give a number such as 12, or a time such as 2026-11-01T08:00Z",
        ) from None
    return moment


def split_version(place: str) -> tuple[str, Version | None]:
    """Split `store@12` or `store@2026-11-01` into path and version (None if there is no `@`).

    If `place` is itself an existing path, its `@` does not begin a version.
    """
    match = _AFTER_AT.fullmatch(place)
    if match is None or Path(place).exists():
        return place, None
    return match["path"], parse_version(match["version"])


def version_at(table: DeltaTable, moment: datetime, *, where: str) -> int:
    """Return the version of a table that was the newest at a moment (UTC if it has no time zone).

    Raises:
        StoreError: the table's first version is later.
    """
    moment = moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)
    # The commit's own timestamp: copying a store changes the write times of its files.
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


def expect_whole(log: Path, version: int, *, where: str, least_bytes: int = _SHORT) -> None:
    """Check that all commits that a version is read from are complete.

    Delta's library silently accepts an empty or truncated commit: rows would be missing. Commits of
    `least_bytes` and more are not read.

    Raises:
        StoreError: a commit is empty, truncated or otherwise damaged.
    """
    for number in range(version, -1, -1):
        file = log / f"{number:020}.json"
        try:
            if (log / f"{number:020}.checkpoint.parquet").exists():
                return
            problem = _problem_of_commit(file) if file.stat().st_size < least_bytes else None
        except FileNotFoundError:  # deleted, as a checkpoint of another format has it
            return
        if problem:
            raise StoreError(
                f"its file {log.parent.name}/{LOG}/{file.name} {problem}",
                where=where,
                remedy="restore it from a copy, or delete it, as it is the last commit: the store"
                " is then as it was before; then run the command that made it again"
                if number == version
                else "restore it from a copy; if there is none, ingest the recordings into a new"
                " store",
            )


def expect_readable_commits(log: Path, *, where: str) -> None:
    """Name the newest damaged commit of a log that Delta's library could not read.

    Raises:
        StoreError: a commit is damaged.
    """
    newest = max((int(one.stem) for one in log.glob("*.json") if one.stem.isdigit()), default=-1)
    expect_whole(log, newest, where=where, least_bytes=sys.maxsize)


def _problem_of_commit(file: Path) -> str | None:
    try:
        actions = [json.loads(line) for line in file.read_bytes().splitlines() if line.strip()]
    except (ValueError, RecursionError):
        return "is damaged: it is not lines of JSON"
    if not all(isinstance(action, dict) for action in actions):
        return "is damaged: it is not a Delta commit"
    if not actions:
        return "is empty"
    info = actions[0].get("commitInfo")
    if len(actions) == 1 and isinstance(info, dict):
        ours = str(info.get("operation_name", "")).startswith("restock")
        # Other tools may write commits with only this line, which change nothing.
        if ours or info.get("operation") in ("ADD COLUMN", "CREATE TABLE"):
            return "is truncated: it does not list its changes"
    return None


# Features that Restock supports: they concern a column type, checkpoints and vacuum, not row files.
_READ = {"timestampNtz", "v2Checkpoint", "vacuumProtocolCheck"}
_WRITTEN = {"timestampNtz", "v2Checkpoint"}
_NEWEST_READER, _NEWEST_WRITER = 3, 7  # protocols; these list the features that a table may use
# Feature -> pattern of the property (of the table or a column) without which it has no effect.
_PROPERTIES = {
    "appendOnly": r"delta\.appendOnly=true",
    "checkConstraints": r"delta\.constraints\..*",
    "changeDataFeed": r"delta\.enableChangeDataFeed=true",
    "columnMapping": r"delta\.columnMapping\.mode=(?!none).*",
    "invariants": r"delta\.invariants=.*",
    "generatedColumns": r"delta\.generationExpression=.*",
    "identityColumns": r"delta\.identity\..*",
}
_REMOVE = (
    "take it off the table with the tool that set it (in Spark: ALTER TABLE … DROP FEATURE, DROP"
    " CONSTRAINT or UNSET TBLPROPERTIES)"
)
_AGAIN = "ingest the recordings into a new store"
_EARLIER = f"name a version from before, as in STORE@12, or {_AGAIN}"
_UNSUPPORTED = re.compile(r"Feature '([^']+)' is not supported")  # error text of Delta's library


def expect_format(table: DeltaTable, *, where: str) -> None:
    """Raise StoreError if another version of Restock, or another tool, made a store's table."""
    found = table.metadata().description
    if found != FORMAT:
        raise StoreError(
            f"the format of this store is {found or 'unknown'}; this Restock reads {FORMAT}",
            where=where,
            remedy="make a new store of its recordings: `restock ingest RECORDINGS --store NEW`",
        )


def expect_readable(table: DeltaTable, *, where: str) -> None:
    """Check that Restock knows every feature of a table that changes what its files mean.

    Raises:
        StoreError: the table uses a feature that Restock cannot read.
    """
    protocol = table.protocol()
    if protocol.min_reader_version == 1:  # has no such features
        return
    if protocol.min_reader_version > _NEWEST_READER:
        raise _unreadable(f"reader version {protocol.min_reader_version}", _name(table), where)
    used = _features_used(table, protocol.reader_features, _READ)
    if unknown := [one for one in used if one not in _PROPERTIES or one == "columnMapping"]:
        raise _unreadable(f"feature `{unknown[0]}`", _name(table), where)


def expect_writable(table: DeltaTable, *, where: str, removing: bool = False) -> None:
    """Check that Restock may commit to a store's table and, if `removing`, remove its files.

    Raises:
        StoreError: the table uses a feature that Restock cannot write.
    """
    protocol = table.protocol()
    if protocol.min_writer_version > _NEWEST_WRITER:
        raise _unwritable(f"writer version {protocol.min_writer_version}", _name(table), where)
    for feature in _features_used(table, protocol.writer_features, _WRITTEN):
        if feature != "appendOnly" or removing:
            raise _unwritable(f"feature `{feature}`", _name(table), where)


def _features_used(
    table: DeltaTable, listed: Sequence[str] | None, supported: Collection[str]
) -> list[str]:
    """Return the features that a table lists or that its or its columns' properties turn on.

    Those in `supported` are left out.
    """
    columns = [field.metadata for field in table.schema().fields]
    found = [
        f"{key}={value}"
        for properties in (table.metadata().configuration, *columns)
        for key, value in properties.items()
    ]
    turned_on = [
        feature
        for feature, pattern in _PROPERTIES.items()
        if any(re.fullmatch(pattern, one, re.DOTALL) for one in found)
    ]
    return [
        *(one for one in listed or () if one not in supported and one not in _PROPERTIES),
        *turned_on,
    ]


def _name(table: DeltaTable) -> str:
    return str(table.table_uri.rstrip("/").rpartition("/")[2])


def unsupported(error: Exception, name: str, *, where: str) -> StoreError | None:
    """Return the error for table `name` if Delta's library does not support one of its features.

    Return None for any other `error`.
    """
    named = _UNSUPPORTED.search(str(error))
    if named is None:
        return None
    # Naming an older version does not help: the library opens the newest first.
    return _unreadable(f"feature `{named[1]}`", name, where, otherwise=_AGAIN)


def _unreadable(what: str, name: str, where: str, otherwise: str = _EARLIER) -> StoreError:
    return StoreError(
        f"its table `{name}` uses Delta's {what}, which Restock cannot read",
        where=where,
        remedy=f"{_REMOVE}, or {otherwise}",
    )


def _unwritable(what: str, name: str, where: str) -> StoreError:
    return StoreError(
        f"its table `{name}` uses Delta's {what}, which Restock cannot write: nothing changed",
        where=where,
        remedy=f"{_REMOVE}, or {_AGAIN}",
    )
